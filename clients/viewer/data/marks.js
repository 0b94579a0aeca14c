// Beads marked by hand in the recorded images of an open data set, to calibrate from: clicked and
// dragged, or put into the middle by Enter and moved by the arrows.
import { $input, el, fixed, setText } from "./dom.js";
import { emit, on, store } from "./link.js";
/** @import { Mark, Pair } from "../web/viewer.d.ts" */

const COLOUR = "#ff3ca0";
/** @type {Mark[]} */
let marks = [];
/** @type {Mark | null} */
let last = null;
let held = false;
/** @type {string | null} */
let of = null;
const projection = () => store.image?.recorded?.projection ?? null;
const here = () => marks.filter((m) => m.frame === projection());

const tools = el("span", { class: "row", style: "flex-wrap:wrap", hidden: true });
const toggle = el(
  "button",
  {
    id: "mark",
    class: "small",
    "aria-pressed": "false",
    title:
      "Click beads in the images, to calibrate from them; " +
      "in the radiograph Enter marks its middle, " +
      "arrows move the last mark by 0.1 px, with Shift by 5",
    onclick: () => {
      choose(Boolean(tools.hidden));
    },
  },
  "Mark beads",
);
const said = el("span", { class: "muted small-text", "aria-live": "polite" });
const list = el("span", { id: "marks", class: "row", style: "flex-wrap:wrap" });
/** @param {boolean} wanted */
function choose(wanted) {
  tools.hidden = !wanted;
  toggle.setAttribute("aria-pressed", String(wanted));
  again();
}
function again() {
  tell();
  emit("image", store.image);
}

/**
 * The row of the panel; what is marked is handed on by `calibrate`.
 * @param {(marks: Mark[]) => void} calibrate
 * @returns {HTMLElement}
 */
export function row(calibrate) {
  tools.append(
    el(
      "label",
      { class: "inline muted" },
      "bead ",
      el("input", { type: "number", id: "mark-bead", min: 0, value: 0, style: "width:58px" }),
    ),
    list,
    said,
    el(
      "button",
      {
        id: "mark-fit",
        class: "small",
        onclick: () => {
          calibrate(marks);
        },
      },
      "Calibrate from these",
    ),
  );
  return el("div", { class: "row head", id: "mark-row" }, toggle, tools);
}

/**
 * @param {number} n
 * @param {string} what
 */
const several = (n, what) => `${n} ${what}${n === 1 ? "" : "s"}`;
/** @param {Mark} mark */
function remove(mark) {
  marks = marks.filter((m) => m !== mark);
  again();
}
function tell() {
  const frame = projection();
  list.replaceChildren(
    ...here().map((m) =>
      el(
        "button",
        {
          class: "small",
          title: `Remove the mark of bead ${m.marker}`,
          onclick: () => {
            remove(m);
          },
        },
        `${m.marker} ×`,
      ),
    ),
  );
  const at =
    last && here().includes(last)
      ? ` · ${last.marker} at ${fixed(last.column, 1)}, ${fixed(last.row, 1)}`
      : "";
  const images = new Set(marks.map((m) => m.frame)).size;
  setText(
    said,
    frame === null
      ? "no projection is shown"
      : `${several(marks.length, "mark")} in ${several(images, "image")}${at}`,
  );
}
on("recorded", (name) => {
  if (name !== of) {
    of = name;
    marks = [];
    choose(false);
  }
});
on("image", tell);

/**
 * Places are in the picture's coordinates: the middle of its first pixel is (0.5, 0.5) there.
 * @param {Pair} pixel
 */
export function click([column, line]) {
  const frame = projection();
  const bead = $input("#mark-bead");
  const number = Math.max(0, Math.round(bead.valueAsNumber || 0));
  const marker = String(number);
  if (tools.hidden || frame === null) return;
  last = { frame, marker, column: column - 0.5, row: line - 0.5 };
  marks = [...marks.filter((m) => m.frame !== frame || m.marker !== marker), last];
  bead.value = String(number + 1);
  again();
}

/**
 * Whether a press is on a mark, which a drag then moves; a click there is a bead that lies over
 * it.
 * @param {Pair} pixel
 * @param {number} reach
 * @returns {boolean}
 */
export function press([column, line], reach) {
  const near = tools.hidden
    ? undefined
    : here().find((m) => Math.hypot(m.column + 0.5 - column, m.row + 0.5 - line) < reach);
  held = near !== undefined;
  if (near) {
    last = near;
    start = [column, line];
    slack = reach / 2;
  }
  return held;
}

/** @type {Pair} */
let start = [0, 0];
let slack = 0;

/**
 * @param {Pair} pixel
 * @returns {boolean}
 */
export function drag([column, line]) {
  if (held && last && Math.hypot(column - start[0], line - start[1]) >= slack) {
    slack = 0;
    last.column = column - 0.5;
    last.row = line - 0.5;
    again();
  }
  return held;
}
export function release() {
  held = false;
}

/**
 * The arrows: whether there is a mark that they move.
 * @param {Pair} step
 * @param {boolean} far
 * @returns {boolean}
 */
export function shift([x, y], far) {
  if (tools.hidden || !last || !here().includes(last)) return false;
  last.column += x * (far ? 5 : 0.1);
  last.row += y * (far ? 5 : 0.1);
  again();
  return true;
}

/**
 * @param {CanvasRenderingContext2D} x
 * @param {number} unit
 */
export function draw(x, unit) {
  if (tools.hidden) return;
  const arm = 6 * unit;
  x.strokeStyle = x.fillStyle = COLOUR;
  x.lineWidth = 1.5 * unit;
  x.font = `${13 * unit}px sans-serif`;
  x.beginPath();
  for (const m of here()) {
    const c = m.column + 0.5;
    const r = m.row + 0.5;
    x.moveTo(c - arm, r);
    x.lineTo(c + arm, r);
    x.moveTo(c, r - arm);
    x.lineTo(c, r + arm);
    x.fillText(m.marker, c + arm, r - arm);
  }
  x.stroke();
}
