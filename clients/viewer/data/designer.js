// The scan designer: bars for voxel and tube; what the wished scan will look like. A change of
// the wish rewrites the script, unless somebody else's stands there.
import { spectralWords } from "./setup.js";
import { detailWords } from "./figures.js";
import { $input, bytes, el, fixed, seconds, setText, words } from "./dom.js";
import { decades } from "./decades.js";
import { differences, listed, only, sampleOf } from "./fingerprint.js";
import { call, emit, on, store } from "./link.js";
import { histogram } from "./plots.js";
import { effect } from "./signals.js";
import { exposure_ms, frames, kind, setExposure, wished as wishedScan } from "./scan_wish.js";
/**
 * @import { Fingerprint } from "./fingerprint.js"
 * @import { ExposurePrediction, TransmissionShares } from "../web/viewer.d.ts"
 */

const SETTLE_MS = 400;
const CNR_TOLERANCE = 1.02;
const BAR_STEPS = 1000;
const VOXEL_RANGE = 20; // from a pixel's size at this magnification to a pixel's
const DARK_TRANSMISSION = 0.02;

/**
 * Bars are logarithmic where values are; [name, words, unit, digits].
 * @typedef {"voxel_um" | "kV" | "power_W"} Bar
 */

/** @type {Array<[name: Bar, words: string, unit: string, digits: number]>} */
const BARS = [
  ["voxel_um", "voxel", "µm", 1],
  ["kV", "voltage", "kV", 0],
  ["power_W", "power", "W", 0],
];

/**
 * @typedef {object} Scale
 * @property {number} low
 * @property {number} high
 * @property {boolean} log
 */

/** @type {Partial<Record<Bar, Scale>>} */
const scales = {};
const inputs = /** @type {Record<Bar, HTMLInputElement>} */ ({});
let longest_ms = 0; // exposure that the camera takes

/**
 * @param {(typeof BARS)[number]} bar
 * @returns {HTMLElement[]}
 */
function bar([name, words, unit, digits]) {
  const out = el("output", { id: `design-${name}-is`, class: "mono" });
  const say = () => setText(out, `${fixed(value(name), digits)} ${unit}`);
  const id = `design-${name}`;
  const quantity = { "data-quantity": `scan.${name}` };
  const steps = { ...quantity, type: "range", min: 0, max: BAR_STEPS, step: "any" };
  inputs[name] = el("input", { ...steps, id, oninput: say, onchange: changed });
  return [
    el("label", { class: "muted", htmlFor: id }, words),
    el("span", { class: "row" }, inputs[name], out),
  ];
}

/**
 * @param {string} id
 * @param {string} label
 * @param {string} value
 * @param {string} title
 * @returns {HTMLElement[]}
 */
function word(id, label, value, title) {
  const quantity = { "data-quantity": id.replace("design-", "prediction.") };
  return [
    el("label", { class: "muted", htmlFor: id, title }, label),
    el("input", { ...quantity, type: "text", id, value, title, onchange: changed }),
  ];
}
const FILTER = "MATERIAL:MM beside the machine’s own, put there by hand: aluminium:1";
const DETAIL = "What is to be seen on the darkest ray: MATERIAL:MM or void:MM";
const WANTED = "Contrast to noise of the detail that is wished for";
const facts = el("div", { id: "design-facts", class: "small-text", "aria-live": "polite" });
const host = el("div", {
  id: "design-chart",
  role: "img",
  "aria-label": "Predicted histogram of transmission",
});
const form = el(
  "div",
  { class: "form" },
  ...BARS.flatMap(bar),
  ...word("design-filter", "more filter", "", FILTER),
  ...word("design-detail", "detail [mm]", "void:0.5", DETAIL),
  ...word("design-cnr", "CNR wanted", "5", WANTED),
);
const opened = () => {
  if (card.open) void begin();
};
const card = el("details", { id: "designer", ontoggle: opened });
card.append(el("summary", {}, "Design a scan"), form, host, facts);
const chart = histogram(host, "decades");

/**
 * @param {HTMLElement} node
 * @returns {void}
 */
export const place = (node) => node.append(card);

/**
 * @param {Bar} name
 * @returns {number}
 */
function value(name) {
  const { low, high, log } = scales[name] ?? { low: 0, high: 1, log: false };
  const part = Number(inputs[name].value) / BAR_STEPS;
  const exact = log ? low * (high / low) ** part : low + part * (high - low);
  return name === "voxel_um" ? exact : Math.round(exact);
}

/**
 * @param {Bar} name
 * @param {number} to
 */
function put(name, to) {
  const { low, high, log } = scales[name] ?? { low: 0, high: 1, log: false };
  const part = log ? Math.log(to / low) / Math.log(high / low) : (to - low) / (high - low);
  inputs[name].value = String(BAR_STEPS * Math.min(1, Math.max(0, part)));
  inputs[name].dispatchEvent(new Event("input"));
}
const begun = () => scales.kV !== undefined;
const bySliders = () =>
  /** @type {Record<Bar, number>} */ (
    Object.fromEntries(BARS.map(([name]) => [name, value(name)]))
  );

/**
 * What a script is to have beside the wished scan; nothing while the designer is closed.
 * @returns {Partial<Record<Bar, number>>}
 */
export const wish = () => (card.open && begun() ? bySliders() : {});

async function begin() {
  if (begun() || !store.state) return;
  const { tube } = store.state;
  const spectrum = await call("viewer.spectrum", { kV: tube.kV }).catch(() => null);
  if (!spectrum) return;
  const { kV, power_W, exposure_ms: exposures } = spectrum.limits;
  longest_ms = exposures[1];
  scales.kV = { low: kV[0], high: kV[1], log: false };
  scales.power_W = { low: 1, high: power_W[1], log: false };
  put("kV", tube.kV);
  put("power_W", tube.power_W);
  scaleVoxels();
  void predict();
}
// Voxels are pixels of the mode that is set, at the distances that stand.
let pixel_um = 0;
function scaleVoxels() {
  if (!store.state?.geometry) return;
  const { camera, geometry } = store.state;
  pixel_um = 1000 * camera.pixel_mm;
  scales.voxel_um = { low: pixel_um / VOXEL_RANGE, high: pixel_um, log: true };
  put("voxel_um", (pixel_um * geometry.SOD_mm) / geometry.SDD_mm);
}

/** @type {number | undefined} */
let due;
let number = 0;
function changed() {
  clearTimeout(due);
  due = window.setTimeout(() => {
    emit("design");
    void predict();
  }, SETTLE_MS);
}
effect(() => {
  kind.get();
  frames.get();
  exposure_ms.get();
  if (card.open && begun()) changed();
});

/**
 * What a prediction is made of, beside the wish.
 * @returns {Fingerprint}
 */
const made = () =>
  store.now ? only(store.now, "twin", "machine", "sample", "placement", "correction") : {};
/** @type {Fingerprint | null} */
let predicted = null;
let panel = "";

/** @typedef {Record<Bar, number> & { exposure_ms: number }} Asked */

async function predict() {
  const state = store.state;
  if (!state) return;
  const mine = ++number;
  const scan = wishedScan();
  if (typeof scan === "string") {
    fail(scan);
    return;
  }
  predicted = made();
  const { geometry: g, camera } = state;
  if (!g) {
    fail(state.missing["geometry"] ?? "no geometry here");
    return;
  }
  const bars = bySliders();
  setText(facts, `predicting a scan of ${sampleOf(predicted) || "nothing"} …`);
  const sod_mm = (bars.voxel_um / 1000 / camera.pixel_mm) * g.SDD_mm;
  const asked = {
    ...scan,
    kV: bars.kV,
    power_W: bars.power_W,
    averages: 1,
    filter: $input("#design-filter").value.trim(),
    detail: $input("#design-detail").value.trim(),
    sdd_mm: Number(g.SDD_mm.toFixed(4)),
    sod_mm: Number(sod_mm.toFixed(4)),
  };
  const p = await call("exposure.predict", asked).catch(words);
  if (mine !== number) return;
  if (typeof p === "string") fail(p);
  else show(p, { ...bars, exposure_ms: scan.exposure_ms });
}

/** @param {string} why */
function fail(why) {
  setText(facts, why);
  host.hidden = true;
}

/** @param {number} v */
const part = (v) => `${fixed(100 * v, v && v < 0.1 ? 1 : 0)} %`;

/**
 * @param {ExposurePrediction} p
 * @param {Asked} asked
 */
function show(p, asked) {
  /**
   * @param {string} id
   * @param {...(Node | string | null)} nodes
   */
  const line = (id, ...nodes) => el("div", { id: `design-${id}` }, ...nodes);
  const dose = `${fixed(p.asked.kerma_mGy, 2)} mGy on the axis`;
  const dark = `least transmission ${part(p.transmission.least)}`;
  const ends = `saturated ${part(p.saturated)} · starved ${part(p.starved)}`;
  facts.replaceChildren(
    line("time", `${seconds(p.seconds)} · ${bytes(p.bytes)} · ${dose}`),
    line("least", `${dark} · ${ends}`),
    line("quality", `contrast to noise of ${detailWords(p.detail)}: `, ...quality(p, asked)),
    line("best", best(p, asked), ...p.assumed.map((a) => ` · ${a}`)),
    line("spectral", spectralWords()),
  );
  draw(p.transmission);
}

/**
 * Contrast to noise, and the exposure that would reach the wished one: noise of photons goes
 * with the root of the time, what the panel adds falls faster.
 * @param {ExposurePrediction} predicted
 * @param {Asked} asked
 * @returns {Array<Node | string>}
 */
function quality({ asked: { cnr } }, asked) {
  const goal = Number($input("#design-cnr").value);
  const enough = cnr !== null && cnr * CNR_TOLERANCE >= goal;
  const said = cnr === null ? "saturated" : fixed(cnr, 2);
  const verdict = el("b", { class: `verdict ${enough ? "ok" : "bad"}` }, said);
  if (enough || !(goal > 0) || cnr === null) return [verdict];
  const ms = Math.ceil(asked.exposure_ms * (goal / cnr) ** 2);
  if (ms > longest_ms) return [verdict, ` no exposure reaches ${fixed(goal, 1)}`];
  const reach = { class: "small", id: "design-reach", onclick: () => setExposure(ms) };
  return [
    verdict,
    " ",
    el("button", reach, `${fixed(goal, 1)} with ${ms} ms an image, or less`),
  ];
}

/**
 * @param {ExposurePrediction} predicted
 * @param {Asked} asked
 * @returns {string}
 */
function best({ best: settings, asked: own }, asked) {
  const first = settings.at(0);
  if (!first || (first.kV === asked.kV && first.filter === own.filter)) return "";
  const filter = first.filter ? `, ${first.filter}` : "";
  return `best at ${fixed(first.kV, 0)} kV${filter}: ${fixed(first.cnr ?? 0, 2)}`;
}

/** @param {TransmissionShares} transmission */
function draw(transmission) {
  host.hidden = false;
  const { counts, range } = decades(transmission);
  const colour = getComputedStyle(host).getPropertyValue("--warn");
  const marks = [{ at: Math.log10(DARK_TRANSMISSION), colour, handle: false }];
  chart.draw({ counts, range, unit: "transmission", window: range, marks });
}
on("state", (s) => {
  if (!begun()) return;
  const seen = JSON.stringify([s.camera.mode, s.camera.roi, s.geometry?.SDD_mm.toFixed(1)]);
  if (pixel_um !== 1000 * s.camera.pixel_mm) scaleVoxels();
  const other = predicted ? differences(predicted, made()) : [];
  if (card.open && panel && seen !== panel) changed();
  else if (card.open && other.length) void predict();
  else if (other.length) setText(facts, `made for another ${listed(other)}`);
  panel = seen;
});
