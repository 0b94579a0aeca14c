// On an open data set: the recorded image beside the virtual one of its pose, and the beads of a
// fit over it.
import { $, $input, el, fixed, setText } from "./dom.js";
import type { Pair, Shown, TrackedFrame, TrackedScan } from "./viewer.js";
import { emit, on, store } from "./link.js";
import * as marks from "./marks.js";

const AMBER = "#ffb454";
const GREEN = "#36e28f";
const BLUE = "#7cc4ff";
const REACH = 8;
// Folder -> where a fit of this page found its beads, and put them before and after.
const tracks = new Map<string, TrackedScan>();
const again = () => emit("image", store.image);

const WAYS: Record<string, string> = {
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
const tick = (id: string, key: Node, text: string) =>
  el(
    "label",
    { class: "inline" },
    el("input", { type: "checkbox", id, checked: true, onchange: again }),
    key,
    text,
  );
const dot = (colour: string) => el("span", { class: "key", style: `border-color:${colour}` });
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
const figure = (text: string, id: string) =>
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

// What a fit told of its data sets; the name of the first.
const folder = (scan: TrackedScan) => scan.folder.split(/[\\/]/).pop() ?? "";
export function know(scans: TrackedScan[]): string | null {
  for (const scan of scans) tracks.set(folder(scan), scan);
  tell();
  return scans[0] ? folder(scans[0]) : null;
}
export const how = (): string => mode.value;
// Why a data set has no virtual images; "" where it has.
export function allow(why: string): void {
  mode.disabled = Boolean(why);
  mode.title = why || TITLE;
  if (why) mode.value = "recorded";
  chosen();
  tell();
}

// The recorded image left of the curtain, the virtual one right of it; all virtual without one.
let made: Shown | null = null;
const column = (i: Shown) =>
  mode.value === "curtain" ? Math.round((i.shape[1] * Number(curtain.value)) / 1000) : 0;
export function beside(i: Shown, virtual: Uint16Array): Shown {
  const cols = i.shape[1];
  const from = column(i);
  if (made?.of === i && made.from === from) return made;
  const pixels = i.pixels.slice();
  for (let k = 0; k < pixels.length; k += cols)
    pixels.set(virtual.subarray(k + from, k + cols), k + from);
  return (made = { ...i, of: i, from, pixels });
}
export function words(i: Shown | null): string {
  const way = i?.virtual ? mode.value : "recorded";
  const file = i?.recorded ? i.recorded.file : "no image to be shown";
  return `${WAYS[way].replace("curtain: ", "")} · ${file}`;
}
// Dragging the curtain in the picture; `pixel` is a CSS pixel in its coordinates.
let held = false;
export function press(place: Pair, pixel: number): boolean {
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
export function drag([c, r]: Pair): boolean {
  if (marks.drag([c, r])) return true;
  if (held && store.image) {
    curtain.value = String((1000 * c) / store.image.shape[1]);
    again();
  }
  return held;
}
export function release(): void {
  held = false;
  marks.release();
}

const scanned = () => (store.recorded === null ? undefined : tracks.get(store.recorded));
const shown = (i: Shown | null) => scanned()?.frames.find((f) => f.file === i?.recorded?.file);
const px = (v: number | null | undefined) =>
  v === null || v === undefined ? "–" : `${fixed(v, v < 1 ? 3 : 2)} px`;
function rms(measured: TrackedFrame["measured"], predicted: TrackedFrame["after"]) {
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
  for (const way of ["before", "after"] as const) {
    setText($(`#compare-all-${way}`), px(scan[`rms_${way}_px`]));
    setText($(`#compare-frame-${way}`), px(f && rms(f.measured, f[way])));
  }
}
on("image", tell);

// Over the picture, in its coordinates; `unit` is a CSS pixel.
export function draw(x: CanvasRenderingContext2D, i: Shown, unit: number): void {
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
  for (const [name, colour] of [
    ["before", AMBER],
    ["after", GREEN],
  ] as const) {
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
