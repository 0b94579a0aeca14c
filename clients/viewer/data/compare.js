// On an open data set: the recorded image beside the virtual one of its pose, and the beads of a
// fit over it.
import { $, $input, el, fixed, setText } from "./dom.js";
import { emit, on, store } from "./link.js";
import * as marks from "./marks.js";
import { nameOf } from "./moment.js";
/** @import { Pair, Shown, TrackedFrame, TrackedScan } from "../web/viewer.d.ts" */

const AMBER = "#ffb454";
const GREEN = "#36e28f";
const BLUE = "#7cc4ff";
const REACH = 8;
// Folder -> where a fit of this page found its beads, and put them before and after.
/** @type {Map<string, TrackedScan>} */
const tracks = new Map();
const again = () => emit("image", store.image);

/** @type {Record<string, string>} */
const WAYS = {
  recorded: "recorded",
  virtual: "virtual",
  curtain: "curtain: recorded | virtual",
  difference: "recorded − virtual",
};
const TITLE =
  "The image that the twin predicts for this pose: its sample, its correction, the same exposure";
const chosen = () => {
  curtain.hidden = mode.value !== "curtain";
};
const mode = el(
  "select",
  {
    id: "compare-mode",
    "aria-label": "Recorded or virtual image",
    onchange: () => {
      chosen();
      emit("compare");
    },
  },
  ...Object.entries(WAYS).map(([value, text]) => el("option", { value }, text)),
);
const curtain = el("input", {
  type: "range",
  id: "curtain",
  min: 0,
  max: 1000,
  value: 500,
  hidden: true,
  "aria-label": "Curtain between recorded and virtual",
  oninput: again,
});

/**
 * @param {string} id
 * @param {Node} key
 * @param {string} text
 */
const tick = (id, key, text) =>
  el(
    "label",
    { class: "inline" },
    el("input", { type: "checkbox", id, checked: true, onchange: again }),
    key,
    text,
  );
/** @param {string} colour */
const dot = (colour) => el("span", { class: "key", style: `border-color:${colour}` });
const times = el(
  "select",
  {
    id: "compare-times",
    "aria-label": "Errors drawn",
    title: "Draw the distances from the measured beads larger than they are",
    onchange: again,
  },
  ...[1, 10, 100].map((k) =>
    el("option", { value: k }, k === 1 ? "errors as they are" : `errors × ${k}`),
  ),
);

/**
 * @param {string} text
 * @param {string} id
 */
const figure = (text, id) =>
  el(
    "span",
    { class: "figure", title: "rms of the measured beads, per coordinate" },
    el("span", { class: "muted" }, `${text}  `),
    dot(AMBER),
    el("b", { id: `${id}-before` }, "–"),
    "  →  ",
    dot(GREEN),
    el("b", { id: `${id}-after` }, "–"),
  );
const beads = el(
  "span",
  { id: "compare-beads", hidden: true },
  tick(
    "compare-measured",
    el("span", { class: "key cross", style: "color:var(--accent)" }, "+"),
    "measured",
  ),
  tick("compare-before", dot(AMBER), "before"),
  tick("compare-after", dot(GREEN), "after"),
  times,
  figure("this image", "compare-frame"),
  figure("whole scan", "compare-all"),
);
export const row = el("div", { class: "row head", id: "compare-row" }, mode, curtain, beads);

/** @param {TrackedScan} scan */
const folder = (scan) => scan.folder.split(/[\\/]/).pop() ?? "";

/**
 * What a fit told of its data sets; the name of the first.
 * @param {TrackedScan[]} scans
 * @returns {string | null}
 */
export function know(scans) {
  for (const scan of scans) tracks.set(folder(scan), scan);
  tell();
  return scans[0] ? folder(scans[0]) : null;
}

/** @returns {string} */
export const how = () => mode.value;

/**
 * Why a data set has no virtual images; "" where it has.
 * @param {string} why
 */
export function allow(why) {
  mode.disabled = Boolean(why);
  mode.title = why || TITLE;
  if (why) mode.value = "recorded";
  chosen();
  tell();
}

// The recorded image left of the curtain, the virtual one right of it; all virtual without one.
/** @type {Shown | null} */
let made = null;
/** @param {Shown} i */
const column = (i) =>
  mode.value === "curtain" ? Math.round((i.shape[1] * Number(curtain.value)) / 1000) : 0;

/**
 * @param {Shown} i
 * @param {Uint16Array} virtual
 * @returns {Shown}
 */
export function beside(i, virtual) {
  const cols = i.shape[1];
  const from = column(i);
  if (made?.of === i && made.from === from) return made;
  const pixels = i.pixels.slice();
  for (let k = 0; k < pixels.length; k += cols)
    pixels.set(virtual.subarray(k + from, k + cols), k + from);
  return (made = { ...i, of: i, from, pixels });
}

/**
 * @param {Shown | null} i
 * @returns {string}
 */
export function words(i) {
  const way = i?.virtual ? mode.value : "recorded";
  const file = i?.recorded ? nameOf(i.recorded.file) : "no image to be shown";
  return `${WAYS[way].replace("curtain: ", "")} · ${file}`;
}
// Dragging the curtain in the picture; `pixel` is a CSS pixel in its coordinates.
let held = false;

/**
 * @param {Pair} place
 * @param {number} pixel
 * @returns {boolean}
 */
export function press(place, pixel) {
  const i = store.image;
  const [c] = place;
  return (
    marks.press(place, REACH * pixel) ||
    (held =
      i?.virtual !== undefined &&
      mode.value === "curtain" &&
      Math.abs(c - column(i)) < REACH * pixel)
  );
}

/**
 * @param {Pair} pixel
 * @returns {boolean}
 */
export function drag([c, r]) {
  if (marks.drag([c, r])) return true;
  if (held && store.image) {
    curtain.value = String((1000 * c) / store.image.shape[1]);
    again();
  }
  return held;
}
export function release() {
  held = false;
  marks.release();
}

const scanned = () => (store.recorded === null ? undefined : tracks.get(store.recorded));
/** @param {Shown | null} i */
const shown = (i) => scanned()?.frames.find((f) => f.file === i?.recorded?.file);
/** @param {number | null | undefined} v */
const px = (v) => (v === null || v === undefined ? "–" : `${fixed(v, v < 1 ? 3 : 2)} px`);

/**
 * @param {TrackedFrame["measured"]} measured
 * @param {TrackedFrame["after"]} predicted
 */
function rms(measured, predicted) {
  const off = measured.flatMap((m, i) => {
    const p = predicted?.[i];
    return m && p ? [m[0] - p[0], m[1] - p[1]] : [];
  });
  return off.length ? Math.sqrt(off.reduce((sum, d) => sum + d * d, 0) / off.length) : null;
}
function tell() {
  const scan = scanned();
  const f = shown(store.image);
  beads.hidden = !scan;
  if (!scan) return;
  const label = $("#compare-before").closest("label");
  if (label)
    label.title =
      scan.before === "nominal"
        ? "nominal geometry"
        : `correction “${scan.before}”, in force during the scan`;
  for (const way of /** @type {const} */ (["before", "after"])) {
    setText($(`#compare-all-${way}`), px(scan[`rms_${way}_px`]));
    setText($(`#compare-frame-${way}`), px(f && rms(f.measured, f[way])));
  }
}
on("image", tell);

/**
 * Over the picture, in its coordinates; `unit` is a CSS pixel.
 * @param {CanvasRenderingContext2D} x
 * @param {Shown} i
 * @param {number} unit
 */
export function draw(x, i, unit) {
  if (mode.value === "curtain" && i.virtual) {
    x.strokeStyle = "#ffd54a";
    x.lineWidth = 2 * unit;
    x.beginPath();
    x.moveTo(column(i), 0);
    x.lineTo(column(i), i.full[0]);
    x.stroke();
  }
  marks.draw(x, unit);
  const f = shown(i);
  const k = Number(times.value);
  const r = 9 * unit;
  const arm = 5 * unit;
  if (!f) return;
  x.lineWidth = 1.5 * unit;
  for (const [name, colour] of /** @type {const} */ ([
    ["before", AMBER],
    ["after", GREEN],
  ])) {
    if (!$input(`#compare-${name}`).checked) continue;
    x.strokeStyle = colour;
    f[name]?.forEach((p, n) => {
      if (!p) return;
      const m = f.measured[n];
      const [c, q] = m
        ? [m[0] + k * (p[0] - m[0]) + 0.5, m[1] + k * (p[1] - m[1]) + 0.5]
        : [p[0] + 0.5, p[1] + 0.5];
      x.globalAlpha = m ? 1 : 0.4; // faint where no bead was seen
      x.beginPath();
      x.arc(c, q, r, 0, 7);
      if (m) {
        x.moveTo(m[0] + 0.5, m[1] + 0.5);
        x.lineTo(c, q);
      }
      x.stroke();
    });
  }
  x.globalAlpha = 1;
  x.strokeStyle = BLUE;
  x.beginPath();
  if ($input("#compare-measured").checked)
    for (const m of f.measured) {
      if (!m) continue;
      const [c, q] = [m[0] + 0.5, m[1] + 0.5];
      x.moveTo(c - arm, q);
      x.lineTo(c + arm, q);
      x.moveTo(c, q - arm);
      x.lineTo(c, q + arm);
    }
  x.stroke();
}
