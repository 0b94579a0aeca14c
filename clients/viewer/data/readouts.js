// Geometry, beam and nearest parts: of the machine now or, while a data set is open, of the image
// of it that is shown. Headings say which.
import { $, el, fixed, isNumber, setText, term } from "./dom.js";
import { about, heading, ofData } from "./fingerprint.js";
import { partWords } from "./figures.js";
import { imageMade, on, store } from "./link.js";
/**
 * @import { About } from "./fingerprint.js"
 * @import { GeometryState, State } from "../web/viewer.d.ts"
 */

/** @type {Array<[name: string, text: (g: GeometryState) => string]>} */
const ROWS = [
  ["SOD", (g) => `${fixed(g.SOD_mm, 2)} mm`],
  ["SDD", (g) => `${fixed(g.SDD_mm, 2)} mm`],
  ["magnification", (g) => `${fixed(g.magnification, 4)}×`],
  ["voxel", (g) => `${fixed(g.voxel_size_mm * 1000, 2)} µm`],
  ["field of view", (g) => g.field_of_view_mm.map((v) => fixed(v, 1)).join(" × ") + " mm"],
  ["cone angle", (g) => `${fixed(g.cone_angle_deg, 2)}°`],
  ["piercing point", (g) => g.piercing_point_px.map((v) => fixed(v, 1)).join(", ") + " px"],
  ["axis column", (g) => `${fixed(g.axis_column_px, 1)} px`],
];

/**
 * @param {State["tube"]} tube
 * @returns {string}
 */
function beam(tube) {
  if (!tube.on) return "off";
  const waits = !tube.ready && tube.ready_in_s !== null;
  return waits ? `ready in ${fixed(tube.ready_in_s, 0)} s` : power(tube);
}

/** @param {{ kV: number | null; power_W: number | null }} t */
const power = (t) => `${fixed(t.kV, 0)} kV, ${fixed(t.power_W, 0)} W`;
/** @type {Record<string, string | undefined>} */
const TIPS = {
  SOD: "Source to object: from the focal spot to the rotation axis",
  SDD: "Source to detector: from the focal spot to the panel",
  magnification: "SDD / SOD",
  voxel: "A pixel of the image, as large as it is at the sample",
  "field of view": "What of the sample the image holds, width × height",
  "cone angle": "Opening, in height, of the beam that meets the image",
  "piercing point":
    "Pixel (column, row) in which the perpendicular from the focal spot meets the panel",
  "axis column": "Column in which the rotation axis appears",
};
const cells = [...ROWS.map(([name]) => name), "beam"].map((name) => {
  const dd = el("dd");
  const tip = TIPS[name];
  $("#readouts").append(el("dt", {}, tip ? term(name, tip) : name), dd);
  return dd;
});

/**
 * What the readouts are of.
 * @returns {About}
 */
function subject() {
  const name = store.recorded;
  if (name === null) return { kind: "now" };
  const image = store.image?.recorded ? store.image : null;
  return about(image ? imageMade(image) : ofData(name), store.now ?? {});
}
function readouts() {
  const s = store.state;
  if (!s) return;
  const live = store.recorded === null;
  const recorded = store.image?.recorded;
  const geometry = live ? s.geometry : recorded?.geometry;
  ROWS.forEach(([, words], k) => {
    setText(cells[k], geometry ? words(geometry) : "–");
  });
  setText(cells[ROWS.length], live ? beam(s.tube) : recordedBeam(recorded?.tube ?? null));
  setText($("#geometry-title"), heading("Geometry", subject()));
  $("#nearest").hidden = !live; // all that is told here is of one moment
  const of = live ? "" : "nominal, as scanned";
  const none = () => (live ? (s.missing["geometry"] ?? "") : "not known");
  setText($("#geometry-of"), geometry ? of : none());
}

/** @param {{ kV: number | null; power_W: number | null; on: boolean } | null} tube */
function recordedBeam(tube) {
  if (!tube) return "–";
  return tube.on ? power(tube) : "off";
}
on("image", readouts);
on("recorded", readouts);
on("state", () => {
  readouts();
  near();
});

const METER_MM = 200;
const TOUCH_MM = 2;
function near() {
  const box = $("#near");
  const parts = store.near;
  const mm = parts?.mm;
  if (!box.childElementCount) {
    const pair = el("span", { class: "pair" });
    const distance = el("b", { class: "mm mono" });
    box.append(el("div", { class: "row between" }, pair, distance));
    box.append(el("div", { class: "meter", title: `full from ${METER_MM} mm on` }, el("i")));
  }
  setText($(".pair", box), parts?.pair.length ? parts.pair.map(partWords).join(" – ") : "–");
  setText($(".mm", box), isNumber(mm) ? `${fixed(mm, 1)} mm` : "");
  const meter = $(".meter", box);
  meter.className = `meter ${parts?.close ? ((mm ?? 0) < TOUCH_MM ? "touch" : "close") : ""}`;
  const filled = isNumber(mm) ? Math.min(100, (100 * mm) / METER_MM) : 0;
  $("i", meter).style.width = `${filled.toFixed(0)}%`;
}
