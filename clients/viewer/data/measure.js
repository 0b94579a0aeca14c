// Measuring in the radiograph: a loupe, the profile along a line, the statistics of a region,
// the ray of a pixel. Places are (column, row) of the full image; what was marked stays and is
// measured anew in every image.
import { along, curve } from "./plots.js";
import { $, $select, field, fixed, parsed, setText, words } from "./dom.js";
import { call } from "./link.js";
/** @import { Pair, Shown } from "../web/viewer.d.ts" */

const LOUPE = { radius: 72, times: 4 };
const SAMPLES = 512;
/** @typedef {number[]} Places */

/** @type {Record<string, string>} */
const HINTS = {
  pan: "",
  loupe: "",
  profile: "drag a line, or type its ends: column row column row",
  region: "drag a box, or type its corners: column row column row",
  ray: "click a pixel, or type it: column row",
};

/** @type {Record<string, Places | null>} */
const shapes = { profile: null, region: null, ray: null };
const many = () => (tool === "ray" ? 2 : 4);
let tool = "pan";
let drawing = false;
/** @type {() => void} */
let redraw = () => {};

const typed = field(
  {
    id: "measure-at",
    "aria-label": "Ends of the line, corners of the box, or the pixel: column row, column row",
  },
  apply,
  () => {
    typed.classList.remove("typed");
    redraw();
  },
);
$("#measure-row").prepend(typed);
function apply() {
  const found = typed.value
    .trim()
    .split(/[\s;]+|,\s+/)
    .map(parsed);
  if (found.length === many() && found.every(Number.isFinite)) {
    shapes[tool] = found.map(Math.round);
    typed.classList.remove("typed");
    redraw();
  } else
    setText(
      $("#measured"),
      `${many() === 2 ? "two" : "four"} numbers: ${HINTS[tool].split(": ")[1]}`,
    );
}

/** @param {() => void} again */
export function start(again) {
  redraw = again;
  $select("#tool").addEventListener("change", () => {
    tool = $select("#tool").value;
    typed.classList.remove("typed");
    again();
  });
}

/**
 * Whether a press or a move of the pointer is the tool's, and not the picture's.
 * @param {Pair} place
 * @returns {boolean}
 */
export function press(place) {
  drawing = tool in shapes;
  if (drawing) shapes[tool] = [...place, ...place].slice(0, many());
  return drawing;
}

/**
 * @param {Pair} place
 * @returns {boolean}
 */
export function drag(place) {
  if (drawing) shapes[tool]?.splice(many() - 2, 2, ...place);
  return drawing;
}
export function release() {
  if (drawing) {
    drawing = false;
    redraw();
  }
}

/** @returns {boolean} */
export const follows = () => tool === "loupe";

/**
 * The pixels of a box whose corners are both within it: how many, mean, deviation, least and
 * greatest.
 * @param {Shown} i
 * @param {Places} places
 */
export function region(i, [c0, r0, c1, r1]) {
  const f = i.full[1] / i.shape[1];

  /**
   * @param {number} v
   * @param {number} n
   */
  const inside = (v, n) => Math.min(n - 1, Math.max(0, Math.floor((v + 0.5) / f)));
  const [left, right] = [c0, c1].sort((a, b) => a - b).map((v) => inside(v, i.shape[1]));
  const [top, bottom] = [r0, r1].sort((a, b) => a - b).map((v) => inside(v, i.shape[0]));
  let n = 0;
  let mean = 0;
  let m2 = 0;
  let low = Infinity;
  let high = -Infinity;
  for (let r = top; r <= bottom; r++)
    for (let c = left; c <= right; c++) {
      const v = i.low + i.scale * i.pixels[r * i.shape[1] + c];
      const d = v - mean;
      n++;
      mean += d / n;
      m2 += d * (v - mean);
      low = Math.min(low, v);
      high = Math.max(high, v);
    }
  return { n, mean, deviation: n > 1 ? Math.sqrt(m2 / (n - 1)) : NaN, low, high };
}

/**
 * The values along a line, from pixel centre to pixel centre, at most a pixel apart where they
 * are few enough.
 * @typedef {(column: number, row: number) => number} Value
 */

/**
 * @param {Value} value
 * @param {Places} places
 * @returns {number[]}
 */
export function profile(value, [c0, r0, c1, r1]) {
  const n = Math.min(SAMPLES, Math.ceil(Math.hypot(c1 - c0, r1 - r0)) + 1);
  return Array.from({ length: n }, (_, k) => {
    const t = n > 1 ? k / (n - 1) : 0;
    return value(Math.round(c0 + t * (c1 - c0)), Math.round(r0 + t * (r1 - r0)));
  });
}

/**
 * Over the picture, in its coordinates; `unit` is a CSS pixel.
 * @param {CanvasRenderingContext2D} x
 * @param {number} unit
 */
export function draw(x, unit) {
  for (const [name, colour] of [
    ["profile", "#ffd54a"],
    ["region", "#7cf0ff"],
    ["ray", "#ff3ca0"],
  ]) {
    const s = shapes[name];
    if (!s || tool !== name) continue;
    x.strokeStyle = colour;
    x.lineWidth = 1.5 * unit;
    x.beginPath();
    if (name === "ray") {
      x.arc(s[0] + 0.5, s[1] + 0.5, 6 * unit, 0, 7);
    } else if (name === "profile") {
      x.moveTo(s[0] + 0.5, s[1] + 0.5);
      x.lineTo(s[2] + 0.5, s[3] + 0.5);
    } else {
      const [left, right] = [s[0], s[2]].sort((a, b) => a - b);
      const [top, bottom] = [s[1], s[3]].sort((a, b) => a - b);
      x.rect(left, top, right - left + 1, bottom - top + 1);
    }
    x.stroke();
  }
}

/**
 * @param {CanvasRenderingContext2D} x
 * @param {HTMLCanvasElement} buffer
 * @param {Shown} i
 * @param {Pair} pixel
 * @param {number} unit
 */
export function loupe(x, buffer, i, [c, r], unit) {
  const radius = LOUPE.radius * unit;
  const t = LOUPE.times;
  x.save();
  x.beginPath();
  x.arc(c, r, radius, 0, 7);
  x.clip();
  x.imageSmoothingEnabled = false;
  x.fillStyle = "#05070a";
  x.fillRect(c - radius, r - radius, 2 * radius, 2 * radius);
  x.drawImage(buffer, c - c * t, r - r * t, i.full[1] * t, i.full[0] * t);
  x.restore();
  x.strokeStyle = "#cfe3ff";
  x.lineWidth = 1.5 * unit;
  x.beginPath();
  x.arc(c, r, radius, 0, 7);
  x.stroke();
}

// The ray of a pixel of the live image at rest: a line in the scenes, and what it goes through.
let rayed = "";
let through = "";
/** @param {Shown | null} i */
function ray(i) {
  const s =
    tool === "ray" && i && !i.recorded && !drawing && i.code === "deflate" ? shapes.ray : null;
  const key = s && i ? `${s.join()} ${i.seq}` : "";
  if (key === rayed) return;
  if (rayed && !s) call("viewer.ray").catch(() => {});
  rayed = key;
  through = s ? "…" : "";
  if (s)
    void call("viewer.ray", { pixel: [s[0], s[1]] })
      .then(({ paths_mm, length_mm }) => {
        const parts = Object.entries(paths_mm)
          .filter(([, mm]) => mm > 1e-4)
          .map(([name, mm]) => `${name} ${fixed(mm, 3)} mm`);
        const met = parts.join(" · ") || "nothing in its way";
        return `${met} · ${fixed(length_mm, 1)} mm from the focal spot`;
      }, words)
      .then((said) => {
        if (rayed === key) {
          through = said;
          redraw();
        }
      });
}

const host = $("#profile");
const plot = curve(host);

/**
 * What was marked, measured in this image.
 * @param {Shown | null} i
 * @param {Value} value
 */
export function tell(i, value) {
  const s = shapes[tool];
  const marks = tool in shapes;
  ray(i);
  $("#measure-row").hidden = !marks;
  host.hidden = tool !== "profile" || !s || !i;
  if (!marks) return;
  if (!typed.classList.contains("typed") && document.activeElement !== typed)
    typed.value = s ? s.join(" ") : "";
  if (!s || !i) {
    setText($("#measured"), HINTS[tool]);
    return;
  }
  if (tool === "ray") {
    setText($("#measured"), i.recorded ? "of live images only" : through || "at rest only");
    return;
  }
  /** @param {number} v */
  const number = (v) => fixed(v, i.kind === "counts" ? 1 : 4);
  if (tool === "region") {
    const m = region(i, s);
    const ratio = m.deviation > 0 ? ` · signal to noise ${fixed(m.mean / m.deviation, 1)}` : "";
    const mean = `mean ${number(m.mean)} ± ${number(m.deviation)}`;
    const ends = `${number(m.low)} to ${number(m.high)}`;
    setText($("#measured"), `${mean} · ${ends} · ${m.n} pixels${ratio}`);
    return;
  }
  const values = profile(value, s).filter(Number.isFinite);
  const low = Math.min(...values);
  const high = Math.max(...values);
  if (!values.length) {
    setText($("#measured"), "outside the image");
    return;
  }
  const length_px = Math.hypot(s[2] - s[0], s[3] - s[1]);
  setText($("#measured"), `${number(low)} to ${number(high)} · ${fixed(length_px, 1)} px`);
  const of = i.kind === "counts" ? "counts" : "−log T";
  plot.draw({ places: along(length_px, values.length), values, unit: "px", of });
}
