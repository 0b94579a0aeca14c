// What an image, a report or a prediction was made of, and whether that is still so. Nothing else
// decides what is "now", "old" or "of a data set": headings, marks and notes ask here.
/** @import { HelloResult, ImageOrigin, State, Value, VolumeMessage } from "../web/viewer.d.ts" */

/**
 * Quantities by name; a thing has those that it depends on.
 * @typedef {object} Quantities
 * @property {Value} twin
 * @property {Value} machine
 * @property {Value} dataset
 * @property {Value} frame
 * @property {Value} file
 * @property {Value} sample
 * @property {Value} placement
 * @property {Value} pose
 * @property {Value} motors
 * @property {Value} distances
 * @property {Value} camera
 * @property {Value} tube
 * @property {Value} lit
 * @property {Value} correction
 */

/** @typedef {keyof Quantities} Quantity */

/** @typedef {Partial<Quantities>} Fingerprint */

/** @type {Record<Quantity, string>} */
export const WORDS = {
  twin: "run of the twin",
  machine: "machine",
  dataset: "data set",
  frame: "image",
  file: "file",
  sample: "sample",
  placement: "placement of the sample",
  pose: "pose",
  motors: "motor positions",
  distances: "distances",
  camera: "camera setting",
  tube: "tube setting",
  lit: "X-ray state",
  correction: "correction",
};
const CONE_TOLERANCE_MM = 1e-3;
const SHOWN_TOLERANCE = 5e-3; // mm or degrees: what the page shows of them
const SETTING_TOLERANCE = 1e-6; // relative
/** @typedef {Pick<ImageOrigin, "mode" | "roi" | "exposure_ms" | "averages">} Made */

/**
 * @param {State["sample"]["offset"]} o
 * @returns {Value}
 */
const placed = (o) => [o.x, o.y, o.z, o.rx, o.ry, o.rz];

/**
 * @param {string | null} name
 * @param {string | null} revision
 * @param {string | null} material
 */
const content = (name, revision, material) => [
  name || "empty",
  revision,
  name ? material : null,
];

/**
 * @param {Made} c
 * @returns {Value}
 */
const settings = (c) => [c.mode, c.roi, c.exposure_ms, c.averages];

/**
 * Everything that stands and is set now.
 * @param {State} state
 * @param {readonly number[] | null} coneVec
 * @param {HelloResult | null} hello
 * @returns {Quantities}
 */
export function ofNow(state, coneVec, hello) {
  const { sample, tube, camera, correction } = state;
  return {
    twin: hello?.instance ?? null,
    machine: hello ? [hello.machine, hello.profile] : null,
    dataset: null,
    frame: null,
    file: null,
    sample: content(sample.name, sample.revision, sample.material),
    placement: placed(sample.offset),
    pose: coneVec,
    motors: Object.entries(state.axes)
      .filter(([, axis]) => !axis.virtual)
      .map(([name, axis]) => [name, axis.position]),
    distances: state.geometry && [state.geometry.SOD_mm, state.geometry.SDD_mm],
    camera: settings(camera),
    tube: [tube.kV, tube.power_W],
    lit: tube.on && tube.ready,
    correction: correction?.name ?? null,
  };
}

/**
 * A live image, or a virtual one: by what the twin says of it, and its geometry.
 * @param {ImageOrigin | null} origin
 * @param {readonly number[] | null} coneVec
 * @param {string} twin
 * @returns {Fingerprint}
 */
export function ofImage(origin, coneVec, twin) {
  const pose = coneVec ? { pose: coneVec } : {};
  if (origin === null) return { dataset: null, ...pose };
  return {
    ...(twin ? { twin } : {}),
    ...pose,
    dataset: null,
    sample: content(origin.sample, origin.revision, origin.material),
    placement: placed(origin.offset),
    camera: settings(origin),
    tube: [origin.kV, origin.power_W],
    lit: origin.lit,
    correction: origin.correction,
  };
}

/**
 * A volume or an image, by what its data set says.
 * @param {NonNullable<VolumeMessage["made"]>} told
 * @returns {Fingerprint}
 */
export const ofVolume = ({ sample, revision, material, offset, correction }) => ({
  sample: content(sample, revision, material),
  ...(offset ? { placement: placed(offset) } : {}),
  correction,
});

/**
 * What is of a data set: an image of it by number and name, or all of it.
 * @param {string} dataset
 * @param {number | null} [frame]
 * @param {string} [file]
 * @returns {Fingerprint}
 */
export const ofData = (dataset, frame = null, file = "") => ({
  dataset,
  frame,
  file,
});

/**
 * @param {Fingerprint} of
 * @param {...Quantity} quantities
 * @returns {Fingerprint}
 */
export function only(of, ...quantities) {
  return Object.fromEntries(quantities.filter((q) => q in of).map((q) => [q, of[q]]));
}

/**
 * The quantities that both have and in which they differ; of what is of a data set, just that.
 * @param {Fingerprint} made
 * @param {Fingerprint} now
 * @returns {Quantity[]}
 */
export function differences(made, now) {
  const both = /** @type {Quantity[]} */ (Object.keys(WORDS)).filter(
    (q) => known(q, made) && known(q, now),
  );
  const differ = both.filter((q) => !same(q, made[q] ?? null, now[q] ?? null));
  return differ.includes("dataset") ? ["dataset"] : differ;
}

/**
 * @param {Quantity} quantity
 * @param {number} a
 * @param {number} b
 * @returns {number}
 */
function tolerance(quantity, a, b) {
  if (quantity === "pose") return CONE_TOLERANCE_MM;
  if (quantity === "motors" || quantity === "distances") return SHOWN_TOLERANCE;
  return SETTING_TOLERANCE * Math.max(Math.abs(a), Math.abs(b));
}

/**
 * Nothing is said of a twin or a machine that has not introduced itself.
 * @param {Quantity} quantity
 * @param {Fingerprint} of
 * @returns {boolean}
 */
function known(quantity, of) {
  if (!(quantity in of)) return false;
  return of[quantity] !== null || (quantity !== "twin" && quantity !== "machine");
}

/**
 * @param {Quantity} quantity
 * @param {Value} a
 * @param {Value} b
 * @returns {boolean}
 */
function same(quantity, a, b) {
  if (Array.isArray(a) && Array.isArray(b)) {
    return (
      a.length === b.length &&
      // eslint-disable-next-line @typescript-eslint/no-unsafe-argument -- sees no casts
      a.every((/** @type {Value} */ v, k) => same(quantity, v, /** @type {Value} */ (b[k])))
    );
  }
  if (typeof a !== "number" || typeof b !== "number") return a === b;
  return Math.abs(a - b) <= tolerance(quantity, a, b);
}

/**
 * @typedef {{ kind: "now" }
 *   | { kind: "old"; differ: Quantity[] }
 *   | { kind: "data set"; dataset: string; file: string }} About
 */

/**
 * What something says of now: that it is so, that it is old, or that it is of a data set.
 * @param {Fingerprint} made
 * @param {Fingerprint} now
 * @returns {About}
 */
export function about(made, now) {
  if (typeof made.dataset === "string") {
    const file = typeof made.file === "string" ? made.file : "";
    return { kind: "data set", dataset: made.dataset, file };
  }
  const differ = differences(made, now);
  return differ.length ? { kind: "old", differ } : { kind: "now" };
}

/**
 * A heading in words: "Geometry now", "Geometry of scan-3, scan_000004".
 * @param {string} title
 * @param {About} a
 * @returns {string}
 */
export function heading(title, a) {
  if (a.kind === "now") return `${title} now`;
  if (a.kind === "old") return `${title} of another ${listed(a.differ)}`;
  return `${title} of ${a.dataset}${a.file ? `, ${a.file}` : ""}`;
}

/**
 * Names of quantities in words: "pose", "sample and pose", "sample, tube setting and pose".
 * @param {Quantity[]} quantities
 * @returns {string}
 */
export function listed(quantities) {
  const words = quantities.map((q) => WORDS[q]);
  const last = words.pop() ?? "";
  return words.length ? `${words.join(", ")} and ${last}` : last;
}

/**
 * The sample's name in a fingerprint; "" where it is not known.
 * @param {Fingerprint} made
 * @returns {string}
 */
export function sampleOf(made) {
  const name = Array.isArray(made.sample) ? /** @type {Value} */ (made.sample[0]) : null;
  return typeof name === "string" ? name : "";
}
