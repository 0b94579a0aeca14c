// The one moment that the page is about: now, an image of a data set, or a planned time. What
// arrives is shown only under a moment that it fits, else marked with its age by the twin's clock.
import { differences } from "./fingerprint.js";
/**
 * @import { Fingerprint, Quantity } from "./fingerprint.js"
 * @import { ClockState } from "../web/viewer.d.ts"
 */

/**
 * `missing`: an image that cannot be shown leaves no other in its place.
 * @typedef {{ kind: "now" }
 *   | { kind: "image"; dataset: string; index: number | null; missing: boolean }
 *   | { kind: "plan"; time_s: number }} Moment
 */

/**
 * Something that came: of what it was made, and when, by the twin's clock.
 * @typedef {object} Arrival
 * @property {Fingerprint} made
 * @property {number} time_s
 */

/**
 * The newest state: what stands and is set, when that was so, what the twin's clock shows by
 * now, and how many seconds of ours ago the state was true.
 * @typedef {object} Present
 * @property {Fingerprint} made
 * @property {number} told_s
 * @property {number} time_s
 * @property {number} since_s
 */

/**
 * In what an arrival differs from now, and how long it has not been so, in seconds of the twin;
 * of one that fits the newest state, how many seconds of ours nothing newer has been read.
 * @typedef {object} Age
 * @property {Quantity[]} differ
 * @property {number} age_s
 */

/** Age from which something is said to be old, in seconds of the twin's clock. */
export const OLD_S = 1;

/** @type {Moment} */
export const NOW = { kind: "now" };

/**
 * Whether an arrival may be shown under a moment: live ones now and beside a plan, those of a data
 * set while that one is open.
 * @param {Fingerprint} made
 * @param {Moment} moment
 * @returns {boolean}
 */
export function belongs(made, moment) {
  const dataset = made.dataset ?? null;
  if (moment.kind !== "image") return dataset === null;
  if (dataset !== moment.dataset) return false;
  return !moment.missing || made.frame === moment.index;
}

/**
 * Keeps until when the newest arrival has been of now; a state that it fits renews it, and speaks
 * for OLD_S.
 * @returns {(arrival: Arrival, present: Present) => Age}
 */
export function aging() {
  /** @type {Arrival["made"] | null} */
  let of = null;
  let true_s = -Infinity;
  return ({ made, time_s }, present) => {
    if (made !== of) {
      of = made;
      true_s = time_s;
    }
    const differ = differences(made, present.made);
    if (!differ.length) {
      true_s = Math.max(true_s, present.told_s);
      return { differ, age_s: present.since_s > OLD_S ? present.since_s : 0 };
    }
    // Another run counts from 0 again.
    if (differ.includes("twin")) return { differ, age_s: Infinity };
    return { differ, age_s: Math.max(0, present.time_s - true_s) };
  };
}

/**
 * What the twin's clock shows, so many seconds of ours after it was told.
 * @param {ClockState} clock
 * @param {number} since_s
 * @returns {number}
 */
export function clockNow({ time_s, speed_up, real_time_factor }, since_s) {
  const pace = real_time_factor ?? (speed_up === "max" ? 1 : speed_up);
  return time_s + Math.max(0, since_s) * pace;
}

/**
 * The one name of an image everywhere: that of its file, without its folder and ending.
 * @param {string} file
 * @returns {string}
 */
export const nameOf = (file) => (file.split(/[\\/]/).pop() ?? file).replace(/\.[^.]*$/, "");

/** @param {string} name */
const numbered = (name) => /^(.*?)(\d+)$/.exec(name);

/**
 * Which image of a data set has a name, of the images that were told or counted on from them;
 * null for none.
 * @param {string} name
 * @param {{ files: string[]; indices: number[]; images: number }} told
 * @returns {number | null}
 */
export function indexOf(name, { files, indices, images }) {
  const names = files.map(nameOf);
  const k = names.indexOf(name);
  if (k >= 0) return indices[k];
  const [, prefix, number] = numbered(name) ?? [];
  const near = names.findLastIndex((each) => {
    const [, own, at] = numbered(each) ?? [];
    return own !== undefined && own === prefix && Number(at) < Number(number);
  });
  if (near < 0) return null;
  const index = indices[near] + Number(number) - Number(numbered(names[near])?.[2]);
  const end = indices[near + 1] ?? images;
  return index < end ? index : null;
}
