// The radiograph: window and level, zoom, the value under the pointer, beads and flags drawn
// over it, and its difference from a frame that was kept.
import { histogram as plotted } from "./plots.js";
import {
  $,
  $button,
  $canvas,
  $input,
  $select,
  context2d,
  fixed,
  setText,
  slid,
} from "./dom.js";
import { call, emit, on, store } from "./link.js";
import * as measure from "./measure.js";
import * as compare from "./compare.js";
import * as marks from "./marks.js";
import { beamWords, MANY_SATURATED, rating, scanSaturated } from "./image_words.js";
import { nameOf } from "./moment.js";
import { signed } from "./slices.js";
/** @import { Four, Kind, Pair, Shown } from "../web/viewer.d.ts" */

const canvas = $canvas("#film-canvas");
const context = context2d(canvas);
const film = $("#film");
const buffer = document.createElement("canvas");
const pixels2d = context2d(buffer);
// Zoom is relative to the whole image fitted in; x, y is the middle in pixels of the image.
const view = { zoom: 1, x: 0, y: 0 };
const SLIMMEST = 0.75;
const FLATTEST = 3; // of the film; a narrower image gets black edges
const CLICK = 4; // pixels of the screen that a click may move
const SATURATED = 0xff3040ff;
const STARVED = 0xff30b0ff; // drawn in red and orange
/** @type {Pair} */
let range = [0, 1];
/** @type {Pair} */
let windowed = [0, 1];
let due = false;
/** @type {Pair | null} */
let pointer = null;
export const shown = { count: 0, at: 0 };

/** @type {Shown | null} */
let reference = null;

/**
 * What is shown: the newest image, its virtual one, or by how much it differs from that or from
 * the reference, as an image of its own.
 * @returns {Shown | null}
 */
function frame() {
  const i = store.image;
  if (!i) return null;
  const { virtual } = i;
  const way = virtual ? compare.how() : "";
  if (virtual && (way === "virtual" || way === "curtain")) return compare.beside(i, virtual);
  const r =
    virtual && way === "difference"
      ? { ...i, pixels: virtual }
      : $input("#difference").checked
        ? reference
        : null;
  if (!r || r.kind !== i.kind || r.full.join() !== i.full.join()) return i;
  if (apart?.of === i && apart.from === r.pixels) return apart;
  const [rows, cols] = i.shape;
  const f = r.shape[1] / cols;
  const values = new Float32Array(rows * cols);
  for (let k = 0; k < values.length; k++) {
    const row = Math.min(r.shape[0] - 1, Math.floor((Math.floor(k / cols) + 0.5) * f));
    const col = Math.min(r.shape[1] - 1, Math.floor(((k % cols) + 0.5) * f));
    values[k] =
      i.low + i.scale * i.pixels[k] - (r.low + r.scale * r.pixels[row * r.shape[1] + col]);
  }
  const sizes = values
    .filter((_, k) => k % EVERY === 0)
    .map(Math.abs)
    .sort();
  const span = Math.max(1e-6, 1.2 * sizes[Math.floor(0.995 * sizes.length)]);
  const scale =
    Math.max(
      span,
      values.reduce((a, v) => Math.max(a, Math.abs(v)), 0),
    ) / 32767;
  return (apart = {
    ...i,
    of: i,
    from: r.pixels,
    signed: true,
    low: -32768 * scale,
    scale,
    pixels: Uint16Array.from(values, (v) => Math.round(v / scale) + 32768),
    window: [-span, span],
  });
}

/** @type {Shown | null} */
let apart = null;

/**
 * @param {number} column
 * @param {number} row
 * @returns {number}
 */
export function value(column, row) {
  const i = frame();
  if (!i) return NaN;
  const f = i.full[1] / i.shape[1];
  const c = Math.floor((column + 0.5) / f);
  const r = Math.floor((row + 0.5) / f);
  return c < 0 || r < 0 || c >= i.shape[1] || r >= i.shape[0]
    ? NaN
    : i.low + i.scale * i.pixels[r * i.shape[1] + c];
}

/**
 * Values between which a pixel is neither starved nor saturated: the twin says so with each
 * image. Counts of a recorded one are judged by the same camera, its line integrals by nothing
 * that is known.
 * @param {Shown} i
 * @returns {Pair}
 */
function good(i) {
  const f = i.flags ?? store.state?.image;
  return (i.kind === "counts" ? f?.good_counts : i.flags?.good_lines) ?? [NaN, NaN];
}

/**
 * @param {Shown} i
 * @returns {Pair}
 */
function limits(i) {
  if (i.signed) return i.window;
  if (i.kind === "counts") return [0, Math.max(good(i)[1] || 0, i.window[1])];
  return [Math.min(0, i.low), Math.max(i.low + i.scale * 65535, 0.1)];
}

const lowEnd = () => $input("#low").valueAsNumber;
const highEnd = () => $input("#high").valueAsNumber;
/** @param {Shown} i */
function chooseWindow(i) {
  range = limits(i);
  const span = range[1] - range[0];
  if ($input("#auto-window").checked) {
    windowed = i.window;
    $input("#low").value = String((1000 * (windowed[0] - range[0])) / span);
    $input("#high").value = String((1000 * (windowed[1] - range[0])) / span);
  } else windowed = [range[0] + (span * lowEnd()) / 1000, range[0] + (span * highEnd()) / 1000];
}

/** @param {Shown} i */
function develop(i) {
  const [rows, cols] = i.shape;
  if (buffer.width !== cols || buffer.height !== rows) {
    buffer.width = cols;
    buffer.height = rows;
  }
  const out = pixels2d.createImageData(cols, rows);
  const data = new Uint32Array(out.data.buffer);
  const low = windowed[0];
  const high = windowed[1] > low ? windowed[1] : low + 1e-6;
  const a = (255 * i.scale) / (high - low);
  const b = (255 * (i.low - low)) / (high - low);
  const flip = $input("#invert").checked;
  const gamma = i.signed ? 1 : $input("#gamma").valueAsNumber;
  const tone = Uint8Array.from({ length: 256 }, (_, g) =>
    Math.round(255 * (g / 255) ** (1 / gamma)),
  );
  const counts = i.kind === "counts";
  const flags = $input("#show-flags").checked && !i.signed && !(counts && unlit(i));
  const p = i.pixels;
  const [least, most] = good(i).map((v) => (v - i.low) / i.scale);
  const top = most - (i.code === "jpeg" ? 128.5 : 0.5); // half a step of the code
  for (let k = 0; k < data.length; k++) {
    let g = a * p[k] + b;
    g = tone[g < 0 ? 0 : g > 255 ? 255 : g | 0];
    if (flip) g = 255 - g;
    data[k] = i.signed ? signed(g) : 0xff000000 | (g << 16) | (g << 8) | g;
    if (flags) {
      if (p[k] < least) data[k] = counts ? STARVED : SATURATED;
      else if (p[k] >= top) data[k] = counts ? SATURATED : STARVED;
    }
  }
  pixels2d.putImageData(out, 0, 0);
}

// An image taken with the beam off says so: it is dark, or drawn as though the beam were on.
/** @param {Shown | null} i */
const unlit = (i) => i !== null && !i.recorded && i.origin?.lit === false;

/** @param {Shown | null} i */
function beam(i) {
  const state = store.state;
  const about = i && { lit: !unlit(i), counts: i.kind === "counts", signed: i.signed };
  const live = about && !i?.recorded && state;
  const words = live ? beamWords(about, state.tube, state.image?.saturated ?? 0) : "";
  $("#film-beam").hidden = !words;
  setText($("#film-beam"), words);
}

/**
 * The part of the beam that comes through: from the thickest place (all but one in a hundred
 * let more through) on.
 * @param {Shown} i
 */
function transmission(i) {
  if (i.kind !== "line_integral" || i.signed)
    return i.signed
      ? `difference from the ${i.from === reference?.pixels ? "reference" : "virtual image"}`
      : "transmission: choose line integral";
  const through = [];
  for (let k = 0; k < i.pixels.length; k += EVERY)
    through.push(Math.exp(-(i.low + i.scale * i.pixels[k])));
  through.sort((a, b) => a - b);
  const dark = through[Math.floor(0.01 * through.length)];
  const mean = through.reduce((a, v) => a + v, 0) / through.length;
  const darkest = `${(100 * dark).toFixed(1)} % or less in the darkest 1 % of the pixels`;
  const cut = !i.recorded && (store.state?.image?.saturated ?? 0) >= MANY_SATURATED;
  const though = cut
    ? "as though no pixel were saturated"
    : scanSaturated(i.recorded?.saturated);
  return `transmission ${darkest} · mean ${(100 * mean).toFixed(1)} %${though && ` · ${though}`}`;
}

export function draw() {
  due = false;
  const i = frame();
  beam(i);
  $input("#difference").disabled = !reference;
  $("#film-recorded").hidden = !store.recorded;
  if (store.recorded) setText($("#film-recorded"), compare.words(i));
  if (!i) {
    canvas.width = canvas.height = 1;
    setText($("#film-note"), "");
    tell();
    measure.tell(null, value);
    return;
  }
  chooseWindow(i);
  develop(i);
  const aspect = Math.min(FLATTEST, Math.max(SLIMMEST, i.full[1] / i.full[0]));
  film.style.setProperty("--aspect", String(aspect));
  const dpr = Math.min(devicePixelRatio, 2);
  const w = Math.round(film.clientWidth * dpr);
  const h = Math.round(film.clientHeight * dpr);
  if (canvas.width !== w || canvas.height !== h) {
    canvas.width = w;
    canvas.height = h;
  }
  clampView();
  const s = dpr * scale();
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = "#05070a";
  context.fillRect(0, 0, w, h);
  context.imageSmoothingEnabled = view.zoom < 2;
  context.setTransform(s, 0, 0, s, w / 2 - view.x * s, h / 2 - view.y * s);
  context.drawImage(buffer, 0, 0, i.full[1], i.full[0]);
  overlay(i, s, dpr);
  measure.draw(context, dpr / s);
  if (pointer && measure.follows()) measure.loupe(context, buffer, i, at(pointer), dpr / s);
  measure.tell(i, value);
  drawHistogram(i);
  setText($("#transmission"), transmission(i));
  film.classList.toggle("zoomed", view.zoom >= 2);
  $("#film-note").dataset.seq = String(i.seq);
  shown.count++;
  shown.at = performance.now();
  // A finger moves the page over an image that is fitted in and has no other use for it.
  const own = view.zoom > 1 || $select("#tool").value !== "pan";
  canvas.style.touchAction = own ? "none" : "pan-y";
  tellRate();
  tell();
  const { moment } = store;
  const which = [
    i.recorded || !i.origin?.file ? "" : nameOf(i.origin.file),
    i.recorded || i.kind === "counts" ? "" : "without the noise of a scan",
    moment.kind === "plan" ? `live; ghost: plan at ${fixed(moment.time_s, 1)} s` : "",
  ].map((words) => words && `${words}  ·  `);
  const [low, high] = windowed.map((v) => fixed(v, i.kind === "counts" ? 0 : 2));
  const zoom = view.zoom !== 1 ? `  ·  ${view.zoom.toFixed(1)}×` : "";
  const alone =
    reference && $input("#difference").checked && !i.signed
      ? "  ·  no difference: the reference is of another kind or size"
      : "";
  setText(
    $("#film-note"),
    `${which.join("")}${i.full[1]} × ${i.full[0]}  ·  window ${low} – ${high}${zoom}${alone}`,
  );
}

const rate = rating();
const tellRate = () =>
  setText($("#film-rate"), rate(store.image, performance.now(), store.imageAge));
on("age", tellRate);

// What the window leaves out is pale.
const BINS = 128;
const EVERY = 7;
const host = $("#histogram");
const chart = plotted(host);

/**
 * @param {Shown} i
 * @param {Pair} window
 * @returns {Float64Array}
 */
export function histogram(i, [low, high]) {
  const counts = new Float64Array(BINS);
  const step = BINS / (high - low);
  for (let k = 0; k < i.pixels.length; k += EVERY) {
    const bin = Math.floor((i.low + i.scale * i.pixels[k] - low) * step);
    counts[Math.min(BINS - 1, Math.max(0, bin))]++;
  }
  return counts;
}

/** @param {Shown} i */
function drawHistogram(i) {
  const text = getComputedStyle(host).getPropertyValue("--text");
  chart.draw({
    counts: histogram(i, range),
    range,
    unit: i.kind === "counts" ? "counts" : "−log T",
    window: windowed,
    marks: windowed.map((at) => ({ at, colour: text, handle: true })),
  });
}
// The nearer end of the window follows the pointer.
/** @type {HTMLInputElement | null} */
let pulled = null;
slid(chart.area, (part) => {
  const to = 1000 * part;
  pulled ??=
    Math.abs(to - lowEnd()) <= Math.abs(to - highEnd()) ? $input("#low") : $input("#high");
  pulled.value = String(to);
  pulled.dispatchEvent(new Event("input"));
});
for (const end of ["pointerup", "pointercancel"])
  chart.area.addEventListener(end, () => {
    pulled?.dispatchEvent(new Event("change"));
    pulled = null;
  });
let wasDark = false;
/** @param {number} part */
const percent = (part) => `${(100 * part).toFixed(part && part < 0.1 ? 1 : 0)} %`;
on("state", (s) => {
  const shares = store.recorded
    ? { saturated: store.image?.recorded?.saturated, starved: null }
    : s.image;
  const unknown = store.recorded ? ": not known of this scan" : " –";
  for (const what of /** @type {const} */ (["saturated", "starved"])) {
    const part = shares?.[what] ?? null;
    setText($(`#${what}`), `${what}${part === null ? unknown : ` ${percent(part)}`}`);
  }
  const dark = unlit(store.image);
  if (dark !== wasDark) ask(); // a dark image has no flags
  wasDark = dark;
  beam(store.image);
});

/**
 * @param {Shown} i
 * @param {number} s
 * @param {number} dpr
 */
function overlay(i, s, dpr) {
  context.lineWidth = (1.5 * dpr) / s;
  if ($input("#show-beads").checked) {
    context.strokeStyle = "#36e28f";
    for (const [c, r] of i.beads) {
      context.beginPath();
      context.arc(c + 0.5, r + 0.5, (9 * dpr) / s, 0, 7);
      context.stroke();
    }
  }
  compare.draw(context, i, dpr / s);
  const g = store.state?.geometry;
  if (g && !i.recorded) {
    const [c, r] = g.piercing_point_px;
    const d = (7 * dpr) / s;
    context.strokeStyle = "#5ab0ff";
    context.beginPath();
    context.moveTo(c + 0.5 - d, r + 0.5);
    context.lineTo(c + 0.5 + d, r + 0.5);
    context.moveTo(c + 0.5, r + 0.5 - d);
    context.lineTo(c + 0.5, r + 0.5 + d);
    context.stroke();
  }
}

function ask() {
  if (!due) {
    due = true;
    requestAnimationFrame(draw);
  }
}

/** CSS pixels a pixel of the image: fitted in, and zoomed. */
function fitted() {
  const i = store.image;
  return i ? Math.min(film.clientWidth / i.full[1], film.clientHeight / i.full[0]) : 1;
}
function scale() {
  return fitted() * view.zoom;
}

/**
 * @param {Pair} client
 * @returns {Pair}
 */
function at([x, y]) {
  const box = canvas.getBoundingClientRect();
  const s = scale();
  return [
    (x - box.left - box.width / 2) / s + view.x,
    (y - box.top - box.height / 2) / s + view.y,
  ];
}
function clampView() {
  const i = store.image;
  const s = scale();
  if (!i) return;

  /**
   * @param {number} middle
   * @param {number} size
   * @param {number} room
   */
  const inside = (middle, size, room) =>
    size <= room ? size / 2 : Math.min(Math.max(middle, room / 2), size - room / 2);
  view.x = inside(view.x, i.full[1], film.clientWidth / s);
  view.y = inside(view.y, i.full[0], film.clientHeight / s);
}

const TOUCH = matchMedia("(hover: none)").matches;
/** The value under the pointer, also when the image changes under it. */
function tell() {
  const i = frame();
  if (!i || !pointer) {
    setText($("#pixel"), TOUCH ? "tap the image to read a value" : "point at the image");
    return;
  }
  const [c, r] = at(pointer).map(Math.floor);
  const v = value(c, r);
  const plain =
    i.kind === "counts"
      ? `${fixed(v, 0)} counts`
      : `${fixed(v, 3)}  ·  T ${(100 * Math.exp(-v)).toFixed(1)} %`;
  const other = i.virtual ? "the virtual image" : "the reference";
  const words = i.signed
    ? `${fixed(v, i.kind === "counts" ? 0 : 4)} more than ${other}`
    : plain;
  setText($("#pixel"), Number.isFinite(v) ? `(${c}, ${r})  ${words}` : "–");
}

/**
 * The newest image as windowed, every pixel of it and nothing drawn over it (flags, if they are
 * on): a PNG.
 * @returns {string | null}
 */
export function picture() {
  const i = frame();
  if (!i) return null;
  const whole = document.createElement("canvas");
  whole.width = i.full[1];
  whole.height = i.full[0];
  chooseWindow(i);
  develop(i);
  context2d(whole).drawImage(buffer, 0, 0, whole.width, whole.height);
  return whole.toDataURL("image/png");
}

/**
 * @param {number} zoom
 * @param {Pair | null} [place]
 */
function zoomTo(zoom, place = null) {
  const before = scale();
  const [x, y] = place ? at(place) : [view.x, view.y];
  view.zoom = zoom;
  view.x = x - ((x - view.x) * before) / scale();
  view.y = y - ((y - view.y) * before) / scale();
  ask();
}
canvas.addEventListener(
  "wheel",
  (e) => {
    e.preventDefault();
    if (store.image)
      zoomTo(Math.min(40, Math.max(1, view.zoom * Math.exp(-e.deltaY / 400))), [
        e.clientX,
        e.clientY,
      ]);
  },
  { passive: false },
);
/** @type {Four | null} */
let drag = null;
/** @type {Pair} */
let down = [0, 0];

/**
 * @param {PointerEvent} e
 * @param {Shown} image
 * @returns {Pair}
 */
function place(e, { full: [rows, cols] }) {
  const [c, r] = at([e.clientX, e.clientY]);

  /**
   * @param {number} v
   * @param {number} n
   */
  const inside = (v, n) => Math.min(n - 1, Math.max(0, Math.floor(v)));
  return [inside(c, cols), inside(r, rows)];
}
canvas.addEventListener("pointerdown", (e) => {
  canvas.setPointerCapture(e.pointerId);
  pointer = down = [e.clientX, e.clientY];
  const i = store.image;
  if (
    i &&
    (measure.press(place(e, i)) || compare.press(at([e.clientX, e.clientY]), 1 / scale()))
  )
    ask();
  else drag = [e.clientX, e.clientY, view.x, view.y];
  tell();
});
canvas.addEventListener("pointerup", (e) => {
  if (Math.hypot(e.clientX - down[0], e.clientY - down[1]) < CLICK) marks.click(at(down));
});
for (const end of ["pointerup", "pointercancel"])
  canvas.addEventListener(end, () => {
    drag = null;
    measure.release();
    compare.release();
  });
canvas.addEventListener("pointermove", (e) => {
  pointer = [e.clientX, e.clientY];
  const i = store.image;
  if ((i && (measure.drag(place(e, i)) || compare.drag(at(pointer)))) || measure.follows())
    ask();
  if (drag) {
    view.x = drag[2] - (e.clientX - drag[0]) / scale();
    view.y = drag[3] - (e.clientY - drag[1]) / scale();
    clampView();
    ask();
  }
  tell();
});
canvas.addEventListener("pointerleave", (e) => {
  if (e.pointerType === "touch") return; // what a finger touched last stays read
  pointer = null;
  tell();
  if (measure.follows()) ask();
});

/** @type {Record<string, Pair | undefined>} */
const STEPS = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, -1],
  ArrowDown: [0, 1],
};

/** @type {Record<string, number | undefined>} */
const TIMES = { "+": 1.25, "=": 1.25, "-": 0.8 };
canvas.addEventListener("keydown", (e) => {
  const step = STEPS[e.key];
  const times = TIMES[e.key];
  if (
    !store.image ||
    e.ctrlKey ||
    e.metaKey ||
    e.altKey ||
    (!step && !times && !["0", "Enter"].includes(e.key))
  )
    return;
  e.preventDefault();
  e.stopPropagation();
  if (e.key === "Enter") marks.click([view.x, view.y]);
  else if (step && marks.shift(step, e.shiftKey)) return;
  else if (step) {
    view.x += (40 * step[0]) / scale();
    view.y += (40 * step[1]) / scale();
    ask();
  } else zoomTo(times ? Math.min(40, Math.max(1, view.zoom * times)) : 1);
});
measure.start(ask);
$button("#keep-reference").addEventListener("click", () => {
  reference = store.image;
  emit(
    "note",
    reference ? "good" : "warning-note",
    "Reference",
    reference
      ? "this image is kept; tick “difference” to see what changes"
      : "no image has come yet",
  );
  ask();
});
$input("#difference").addEventListener("change", () => {
  $input("#auto-window").checked = true;
});
const reset = () => zoomTo(1);
canvas.addEventListener("dblclick", reset);
$button("#film-reset").addEventListener("click", reset);
$button("#film-actual").addEventListener("click", () =>
  zoomTo(1 / (fitted() * Math.min(devicePixelRatio, 2))),
);
// Neither end of the window goes past the other.
$input("#low").addEventListener("input", () => {
  $input("#low").value = String(Math.min(lowEnd(), highEnd() - 1));
});
$input("#high").addEventListener("input", () => {
  $input("#high").value = String(Math.max(highEnd(), lowEnd() + 1));
});
for (const id of ["#low", "#high"])
  $(id).addEventListener("input", () => {
    $input("#auto-window").checked = false;
    ask();
  });
for (const id of ["#low", "#high", "#auto-window"])
  $(id).addEventListener("change", () => {
    const own =
      !$input("#auto-window").checked &&
      store.image?.kind === "line_integral" &&
      !frame()?.signed;
    call("viewer.window", own ? { low: windowed[0], high: windowed[1] } : {}).catch(() => {});
    ask();
  });
for (const id of ["#invert", "#show-beads", "#show-flags", "#auto-window", "#difference"])
  $(id).addEventListener("change", ask);
$input("#gamma").addEventListener("input", () => {
  setText($("#gamma-is"), fixed($input("#gamma").valueAsNumber));
  ask();
});
$select("#kind").addEventListener("change", () => {
  $input("#auto-window").checked = true;
  call("viewer.feed", { kind: /** @type {Kind} */ ($select("#kind").value) }).catch(() => {});
});
on("image", ask);
on("moment", ask);
on("open", () => {
  if ($select("#kind").value !== "line_integral")
    call("viewer.feed", { kind: /** @type {Kind} */ ($select("#kind").value) }).catch(() => {});
});
new ResizeObserver(ask).observe(film);
