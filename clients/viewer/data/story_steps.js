// Where the story of a wrong geometry stands: a function of the correction in force and of what
// the story has found out so far. Nothing counts steps: what is undone, or restarted, or put in
// force in another tab, is seen here.
/** @import { Correction } from "../web/viewer.d.ts" */

/** The comment of the story's correction. */
export const BY_HAND = "misaligned by hand";
export const STEP = { misalign: 0, scan: 1, calibrate: 2, apply: 3, again: 4, end: 5 };
const SAME = 1e-9; // mm or degrees: the values come back as they were sent

/**
 * @typedef {object} Known
 * @property {Record<string, number>} believed what the sliders said when it was misaligned
 * @property {{ correction: Record<string, number> } | null} found by the beads
 * @property {number[]} rms of the volumes so far, from the truth
 */

/**
 * Whether two corrections shift the same parts by the same values; a parameter that is left out
 * shifts nothing.
 * @param {Record<string, number>} a
 * @param {Record<string, number>} b
 */
export function sameCorrection(a, b) {
  return [...new Set([...Object.keys(a), ...Object.keys(b)])].every((name) => {
    const none = name === "angle_scale" ? 1 : 0;
    return Math.abs((a[name] ?? none) - (b[name] ?? none)) <= SAME;
  });
}

/**
 * The step that comes next.
 * @param {Known} known
 * @param {Pick<Correction, "comment" | "parameters"> | null} inForce
 * @returns {number}
 */
export function stepOf({ believed, found, rms }, inForce) {
  if (!inForce) return STEP.misalign;
  if (inForce.comment === BY_HAND) {
    if (!sameCorrection(believed, inForce.parameters)) return STEP.scan; // somebody else's
    if (!rms.length) return STEP.scan;
    return found ? STEP.apply : STEP.calibrate;
  }
  if (!found || !sameCorrection(found.correction, inForce.parameters)) return STEP.misalign;
  return rms.length > 1 ? STEP.end : STEP.again;
}
