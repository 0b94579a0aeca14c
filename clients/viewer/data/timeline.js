// Draws quantities over one time axis: a lane for each with its name and value, images as
// ticks, a playhead.
import { context2d, fixed } from "./dom.js";

/**
 * Quantities over time; null where one is not known.
 * @typedef {object} Lanes
 * @property {number} duration_s
 * @property {number[]} times
 * @property {Record<string, Array<number | null>>} curves
 * @property {Array<[time: number, kind: string]>} images
 * @property {Record<string, string>} units
 * @property {string} [axis]
 */

/** @type {Record<string, string[]>} */
const COLORS = {
  light: ["#1668c4", "#a85f00", "#6a46e8", "#127a52", "#b52d62", "#00788a"],
  dark: ["#5aa9ff", "#ffb454", "#b09aff", "#4cc38a", "#ff7fa6", "#45d0e0"],
};

/** @type {Record<string, string>} */
const TICKS = {
  dark: "#8892a0",
  flat: "#e0a800",
  projection: "#2f9e63",
  preview: "#b0b8c4",
};
const LANE = 34;
const LEAST = 24;
const LABEL = 13;
const AXIS = 30;
const GAP = 70;

/**
 * The value at a time: the last one told at or before it.
 * @param {number[]} times
 * @param {Array<number | null>} values
 * @param {number} t
 */
function valueAt(times, values, t) {
  let low = 0;
  let high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= t + 1e-9) low = middle;
    else high = middle - 1;
  }
  return values[low];
}

/**
 * @param {number} total
 * @param {number} width
 */
function steps(total, width) {
  const rough = total / Math.max(1, Math.floor(width / GAP));
  const ten = 10 ** Math.floor(Math.log10(rough));
  return [1, 2, 5, 10].map((k) => k * ten).find((s) => s >= rough) ?? 10 * ten;
}

/**
 * @param {HTMLCanvasElement} canvas
 * @param {Lanes} plan
 * @param {number | null} at
 * @param {number | null} running
 */
export function draw(canvas, plan, at, running, room = Infinity) {
  // Lanes give way down to LEAST where the room is short.
  const lanes = Object.entries(plan.curves);
  const lane = Math.min(LANE, Math.max(LEAST, Math.floor((room - AXIS) / lanes.length)));
  const tall = lanes.length * lane + AXIS;
  canvas.style.height = `${tall}px`;
  const dpr = Math.min(devicePixelRatio, 2);
  const w = canvas.clientWidth;
  const total = Math.max(plan.duration_s, 1e-9);
  if (!w) return;
  canvas.width = Math.round(w * dpr);
  canvas.height = Math.round(tall * dpr);
  const x = context2d(canvas);
  const style = getComputedStyle(document.documentElement);
  /** @param {number} t */
  const px = (t) => (t / total) * w;
  const colors = COLORS[document.documentElement.dataset.theme ?? "light"] ?? COLORS.light;
  /** @param {string} name */
  const colour = (name) => style.getPropertyValue(name);
  x.scale(dpr, dpr);
  x.font = "11px system-ui, sans-serif";
  x.lineJoin = "round";
  const step = steps(total, w);
  for (let t = 0; t <= total; t += step) {
    x.fillStyle = colour("--line");
    x.fillRect(px(t), 0, 1, tall - 16);
    const text = `${fixed(t, Math.max(0, -Math.floor(Math.log10(step))))} ${plan.axis ?? "s"}`;
    x.fillStyle = colour("--muted");
    x.textAlign =
      t === 0 ? "left" : px(t) + x.measureText(text).width / 2 > w ? "right" : "center";
    x.fillText(text, x.textAlign === "right" ? w : px(t), tall - 4);
  }
  for (const [t, kind] of plan.images) {
    x.fillStyle = TICKS[kind] ?? "#888";
    x.fillRect(px(t), tall - AXIS + 4, 1, 9);
  }
  x.textAlign = "left";
  /** @type {Array<[words: string, y: number, colour: string]>} */
  const names = [];
  lanes.forEach(([name, values], i) => {
    const known = values.filter((v) => v !== null);
    const unit = plan.units[name] ?? "";
    const top = i * lane + LABEL + 3;
    const bottom = (i + 1) * lane - 3;
    const digits = known.some((v) => Math.abs(v) >= 1000) ? 0 : 2;
    const low = known.reduce((a, v) => Math.min(a, v), Infinity);
    const high = known.reduce((a, v) => Math.max(a, v), -Infinity);
    const now = at === null ? null : valueAt(plan.times, values, at);
    const flat = fixed(low, digits) === fixed(high, digits); // what is not told is not drawn
    x.strokeStyle = x.fillStyle = colors[i % colors.length];
    x.lineWidth = 1.5;
    x.beginPath();
    let pen = false;
    values.forEach((v, k) => {
      if (v === null) {
        pen = false;
        return;
      }
      const y = flat
        ? (top + bottom) / 2
        : bottom - ((v - low) / (high - low)) * (bottom - top);
      if (pen) x.lineTo(px(plan.times[k]), y);
      else x.moveTo(px(plan.times[k]), y);
      pen = true;
    });
    x.stroke();
    const range = flat
      ? `${fixed(low, digits)} ${unit}`
      : `${fixed(low, digits)} to ${fixed(high, digits)} ${unit}`;
    const stands = now === null || now === undefined || flat ? "" : `${fixed(now, digits)} of `;
    const told = `${name}  ${known.length ? `${stands}${range}` : "not known"}`;
    names.push([told, i * lane + LABEL - 2, colors[i % colors.length]]);
  });
  for (const [t, color] of /** @type {const} */ ([
    [running, colour("--ok")],
    [at, colour("--bad")],
  ])) {
    if (t === null) continue;
    x.fillStyle = color;
    x.fillRect(Math.min(px(t), w - 2), 0, 2, tall - 14);
  }
  // What a lane is stands over the playheads, with a rim of the ground about its letters.
  x.lineWidth = 3;
  x.strokeStyle = colour("--soft");
  for (const [words, y, ink] of names) {
    x.strokeText(words, 4, y);
    x.fillStyle = ink;
    x.fillText(words, 4, y);
  }
}
