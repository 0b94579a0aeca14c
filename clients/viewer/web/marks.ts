// Beads marked by hand in the recorded images of an open data set, to calibrate from.
import { $input, el, setText } from "./dom.js";
import type { Mark } from "./wire.js";
import type { Pair } from "./viewer.js";
import { emit, on, store } from "./link.js";

const COLOUR = "#ff3ca0";
let marks: Mark[] = [], of: string | null = null;
const projection = () => store.image?.recorded?.projection ?? null;
const here = () => marks.filter((m) => m.frame === projection());

const tools = el("span", { class: "row", style: "flex-wrap:wrap", hidden: true });
const toggle = el("button", { id: "mark", class: "small", "aria-pressed": "false", title: "Click beads in the images, to calibrate from them", onclick: () => { choose(Boolean(tools.hidden)); } }, "Mark beads");
const said = el("span", { class: "muted small-text" }), list = el("span", { id: "marks", class: "row", style: "flex-wrap:wrap" });
function choose(wanted: boolean) { tools.hidden = !wanted; toggle.setAttribute("aria-pressed", String(wanted)); again(); }
function again() { tell(); emit("image", store.image); }

// The row of the panel; what is marked is handed on by `calibrate`.
export function row(calibrate: (marks: Mark[]) => void): HTMLElement {
  tools.append(el("label", { class: "inline muted" }, "bead ", el("input", { type: "number", id: "mark-bead", min: 0, value: 0, style: "width:58px" })), list, said,
    el("button", { id: "mark-fit", class: "small", onclick: () => { calibrate(marks); } }, "Calibrate from these"));
  return el("div", { class: "row head", id: "mark-row" }, toggle, tools);
}
const several = (n: number, what: string) => `${n} ${what}${n === 1 ? "" : "s"}`;
function remove(mark: Mark) { marks = marks.filter((m) => m !== mark); again(); }
function tell() {
  const frame = projection();
  list.replaceChildren(...here().map((m) => el("button", { class: "small", title: `Remove the mark of bead ${m.marker}`, onclick: () => { remove(m); } }, `${m.marker} ×`)));
  setText(said, frame === null ? "no projection is shown" : `${several(marks.length, "mark")} in ${several(new Set(marks.map((m) => m.frame)).size, "image")}`);
}
on("recorded", (name) => { if (name !== of) { of = name; marks = []; choose(false); } });
on("image", tell);

// A click in the picture, in its coordinates: the middle of its first pixel is (0.5, 0.5) there. Whether it was a mark.
export function press([column, line]: Pair): boolean {
  const frame = projection(), bead = $input("#mark-bead"), number = Math.max(0, Math.round(bead.valueAsNumber || 0)), marker = String(number);
  if (tools.hidden || frame === null) return false;
  marks = [...marks.filter((m) => m.frame !== frame || m.marker !== marker), { frame, marker, column: column - 0.5, row: line - 0.5 }];
  bead.value = String(number + 1);
  tell();
  return true;
}
export function draw(x: CanvasRenderingContext2D, unit: number): void {
  if (tools.hidden) return;
  const arm = 6 * unit;
  x.strokeStyle = x.fillStyle = COLOUR; x.lineWidth = 1.5 * unit; x.font = `${13 * unit}px sans-serif`; x.beginPath();
  for (const m of here()) {
    const c = m.column + 0.5, r = m.row + 0.5;
    x.moveTo(c - arm, r); x.lineTo(c + arm, r); x.moveTo(c, r - arm); x.lineTo(c, r + arm);
    x.fillText(m.marker, c + arm, r - arm);
  }
  x.stroke();
}
