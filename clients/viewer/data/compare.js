// The comparison: where the geometry before and after a fit puts the beads, over a radiograph of the data set.
import { $, el, fixed, setText } from "./dom.js";
import { command } from "./link.js";

const AMBER = "#ffb454", GREEN = "#36e28f";
const view = { zoom: 1, x: 0, y: 0 };
let scans = [], which = 0, shown = null, asked = 0, buffer = null;

const tick = (id, key, text) => el("label", { class: "inline" }, el("input", { type: "checkbox", id, checked: true, onchange: () => draw() }), key, text);
const dot = (colour) => el("span", { class: "key", style: `border-color:${colour}` });
const scan = el("select", { id: "compare-dataset", "aria-label": "Data set", onchange: () => choose(Number(scan.value), 0) });
const slider = el("input", { type: "range", id: "compare-frame", min: 0, step: 1, value: 0, "aria-label": "Frame", oninput: () => fetchFrame(Number(slider.value)) });
const label = el("span", { id: "compare-file", class: "mono muted" });
const canvas = el("canvas", { id: "compare-canvas" }), context = canvas.getContext("2d");
const times = el("select", {
  id: "compare-times", "aria-label": "Errors drawn", onchange: () => draw(),
  title: "Draw the distances from the measured beads larger than they are",
}, ...[1, 10, 100].map((k) => el("option", { value: k }, k === 1 ? "errors as they are" : `errors × ${k}`)));
const figure = (text, id) => el("span", { class: "figure" },
  el("span", { class: "muted" }, `${text}  `),
  dot(AMBER), el("b", { id: `${id}-before` }, "–"), "  →  ", dot(GREEN), el("b", { id: `${id}-after` }, "–"));
const plate = el("div", { class: "plate" }, canvas);
const panel = el("div", { id: "compare", hidden: true },
  el("div", { class: "row head" }, el("b", {}, "Before and after"), scan, slider, label,
    tick("compare-measured", el("span", { class: "key cross", style: "color:var(--accent)" }, "+"), "measured"),
    tick("compare-before", dot(AMBER), "before"), tick("compare-after", dot(GREEN), "after"), times,
    el("span", { class: "spacer" }), el("button", { id: "compare-close", class: "small", title: "Back to the scene (Escape)", onclick: close }, "Close")),
  plate,
  el("div", { class: "foot" },
    figure("this frame", "compare-frame"), figure("whole scan", "compare-all"),
    el("span", { id: "compare-note", class: "muted small-text" }, "rms of the measured beads, per coordinate · wheel to zoom, drag to pan")));
$("#stage").append(panel);

export function compare(summary) {
  scans = summary;
  scan.replaceChildren(...scans.map((s, i) => el("option", { value: i }, s.dataset)));
  panel.hidden = false;
  plate.append($("#warnings"), $("#notes")); // what is wrong with the machine stays in view, and the panel's head free
  $("#compare-close").focus();
  choose(0, 0);
}
function close() {
  panel.hidden = true;
  $("#stage").append($("#warnings"), $("#notes"));
  $("#fit-compare")?.focus();
}
// Before the page's other keys, so that one Escape closes one thing.
window.addEventListener("keydown", (e) => {
  if (e.key !== "Escape" || panel.hidden || $("#help-dialog").open) return;
  if (e.target.closest?.("input, textarea, select") && !panel.contains(e.target)) return;
  close();
}, true);
function choose(index, frame) {
  which = index;
  const s = scans[which];
  scan.value = index; scan.hidden = scans.length < 2;
  slider.max = s.frames - 1; slider.value = frame;
  setText($("#compare-all-before"), px(s.rms_before_px)); setText($("#compare-all-after"), px(s.rms_after_px));
  $("#compare-before").parentElement.title = s.before === "nominal" ? "nominal geometry" : `correction “${s.before}”, in force during the scan`;
  Object.assign(view, { zoom: 1, x: 0, y: 0 });
  fetchFrame(frame);
}
// The slider may ask faster than frames come: the newest answer that was asked for wins.
async function fetchFrame(frame) {
  const number = ++asked;
  const answer = await command("viewer.compared", { dataset: which, frame }, "No radiograph");
  if (!answer || number !== asked) return;
  const [rows, cols] = answer.shape, raw = atob(answer.pixels);
  buffer = document.createElement("canvas"); buffer.width = cols; buffer.height = rows;
  const pixels = buffer.getContext("2d").createImageData(cols, rows), data = new Uint32Array(pixels.data.buffer);
  for (let k = 0; k < data.length; k++) data[k] = 0xff000000 | (raw.charCodeAt(k) * 0x010101);
  buffer.getContext("2d").putImageData(pixels, 0, 0);
  shown = answer;
  panel.dataset.frame = frame;
  setText(label, `${answer.file} · ${answer.measured.filter(Boolean).length} beads seen`);
  setText($("#compare-frame-before"), px(rms(answer.before))); setText($("#compare-frame-after"), px(rms(answer.after)));
  draw();
}
function rms(predicted) {
  if (!predicted) return null;
  let sum = 0, n = 0;
  shown.measured.forEach((m, i) => { if (m && predicted[i]) { sum += (m[0] - predicted[i][0]) ** 2 + (m[1] - predicted[i][1]) ** 2; n += 2; } });
  return n ? Math.sqrt(sum / n) : null;
}
const px = (v) => (v === null || v === undefined ? "–" : `${fixed(v, v < 1 ? 3 : 2)} px`);

export function draw() {
  if (panel.hidden || !shown) return;
  const dpr = Math.min(devicePixelRatio, 2), w = Math.round(canvas.clientWidth * dpr), h = Math.round(canvas.clientHeight * dpr), [rows, cols] = shown.shape;
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const fit = Math.min(w / cols, h / rows), s = fit * view.zoom;
  context.setTransform(1, 0, 0, 1, 0, 0); context.fillStyle = "#05070a"; context.fillRect(0, 0, w, h);
  context.imageSmoothingEnabled = s < 2;
  context.setTransform(s, 0, 0, s, (w - cols * s) / 2 - view.x * s, (h - rows * s) / 2 - view.y * s);
  context.drawImage(buffer, 0, 0);
  context.lineWidth = (1.6 * dpr) / s;
  const k = Number(times.value), r = (10 * dpr) / s, arm = (5 * dpr) / s;
  const at = (p, m) => (m ? [m[0] + k * (p[0] - m[0]) + 0.5, m[1] + k * (p[1] - m[1]) + 0.5] : [p[0] + 0.5, p[1] + 0.5]);
  for (const [name, colour] of [["before", AMBER], ["after", GREEN]]) {
    if (!$(`#compare-${name}`).checked || !shown[name]) continue;
    context.strokeStyle = colour;
    shown[name].forEach((p, i) => {
      if (!p) return;
      const m = shown.measured[i], [c, q] = at(p, m);
      context.globalAlpha = m ? 1 : 0.4; // faint where no bead was seen
      context.beginPath(); context.arc(c, q, r, 0, 7); context.stroke();
      if (m) { context.globalAlpha = 0.6; context.beginPath(); context.moveTo(m[0] + 0.5, m[1] + 0.5); context.lineTo(c, q); context.stroke(); }
    });
  }
  context.globalAlpha = 1;
  if ($("#compare-measured").checked) {
    context.strokeStyle = "#7cc4ff"; context.beginPath();
    for (const m of shown.measured.filter(Boolean)) {
      const [c, q] = [m[0] + 0.5, m[1] + 0.5];
      context.moveTo(c - arm, q); context.lineTo(c + arm, q); context.moveTo(c, q - arm); context.lineTo(c, q + arm);
    }
    context.stroke();
  }
}

function clampView() {
  if (!shown) return;
  const [rows, cols] = shown.shape, room = 0.5 * (1 - 1 / view.zoom);
  view.x = Math.min(Math.max(view.x, -cols * room), cols * room); view.y = Math.min(Math.max(view.y, -rows * room), rows * room);
}
const scale = () => (shown ? Math.min(canvas.clientWidth / shown.shape[1], canvas.clientHeight / shown.shape[0]) * view.zoom : 1);
canvas.addEventListener("wheel", (e) => {
  e.preventDefault();
  const box = canvas.getBoundingClientRect(), dx = e.clientX - box.left - box.width / 2, dy = e.clientY - box.top - box.height / 2, before = scale();
  view.zoom = Math.min(40, Math.max(1, view.zoom * Math.exp(-e.deltaY / 400)));
  view.x += dx / before - dx / scale(); view.y += dy / before - dy / scale();
  clampView(); draw();
}, { passive: false });
let drag = null;
canvas.addEventListener("pointerdown", (e) => { drag = [e.clientX, e.clientY, view.x, view.y]; canvas.setPointerCapture(e.pointerId); });
canvas.addEventListener("pointerup", () => { drag = null; });
canvas.addEventListener("pointermove", (e) => { if (drag) { view.x = drag[2] - (e.clientX - drag[0]) / scale(); view.y = drag[3] - (e.clientY - drag[1]) / scale(); clampView(); draw(); } });
canvas.addEventListener("dblclick", () => { Object.assign(view, { zoom: 1, x: 0, y: 0 }); draw(); });
new ResizeObserver(() => draw()).observe(canvas);
