// Draws a plan over time: each moving axis as a line, images as ticks, a playhead.
const COLORS = ["#1668c4", "#e08a00", "#7a5cff", "#1a9c6b", "#d6457a", "#00a3b4", "#8a6d3b", "#9aa4b1"];
const TICKS = { dark: "#8892a0", flat: "#e0a800", projection: "#2f9e63", preview: "#b0b8c4" };

export function draw(canvas, plan, at, running) {
  const dpr = Math.min(devicePixelRatio, 2), w = Math.round(canvas.clientWidth * dpr), h = Math.round(canvas.clientHeight * dpr);
  if (!w || !h) return;
  canvas.width = w; canvas.height = h;
  const x = canvas.getContext("2d"), style = getComputedStyle(document.documentElement), total = Math.max(plan.duration_s, 1e-9);
  const px = (t) => (t / total) * w, top = 12 * dpr, bottom = h - 14 * dpr;
  x.clearRect(0, 0, w, h);
  x.font = `${10 * dpr}px system-ui, sans-serif`;
  for (const [t, kind] of plan.images) { x.fillStyle = TICKS[kind] ?? "#888"; x.fillRect(px(t), bottom + 4 * dpr, Math.max(1, dpr * 0.8), 8 * dpr); }
  let left = 4 * dpr;
  Object.entries(plan.curves).forEach(([name, values], i) => {
    const low = Math.min(...values), high = Math.max(...values), color = COLORS[i % COLORS.length];
    x.strokeStyle = color; x.lineWidth = 1.4 * dpr; x.beginPath();
    values.forEach((v, k) => { const y = bottom - ((v - low) / (high - low || 1)) * (bottom - top); k ? x.lineTo(px(plan.times[k]), y) : x.moveTo(px(plan.times[k]), y); });
    x.stroke();
    x.fillStyle = color; x.fillText(name, left, 9 * dpr); left += x.measureText(name).width + 8 * dpr;
  });
  for (const [t, color] of [[running, style.getPropertyValue("--ok")], [at, style.getPropertyValue("--bad")]]) {
    if (t === null || t === undefined) continue;
    x.strokeStyle = color; x.lineWidth = 2 * dpr; x.beginPath(); x.moveTo(px(t), 0); x.lineTo(px(t), h); x.stroke();
  }
}
