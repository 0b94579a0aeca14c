// What a reconstruction believed of a geometry, beside what a calibration found: in words.
import { fixed } from "./figures.js";

// What the thesis's names mean, in the words of the page.
/** @type {Record<string, string | undefined>} */
export const MEANS = {
  dO_x: "axis sideways",
  dO_y: "axis height",
  dO_z: "source to axis",
  alpha: "start angle",
  tau_x: "sample off the axis, sideways",
  tau_z: "sample off the axis, along the beam",
  dD_x: "detector sideways",
  dD_y: "detector height",
  dD_z: "source to detector",
  dS_x: "focal spot sideways",
  dS_y: "focal spot height",
  axis_column: "image of the axis, column",
  axis_angle: "image of the axis, angle",
  det_roll: "detector roll",
  det_pitch: "detector pitch",
  det_yaw: "detector yaw",
  axis_tilt_x: "axis towards the detector",
  axis_tilt_z: "axis sideways tilt",
  angle_scale: "scale of angles",
};

/** @param {string} name */
export const unit = (name) =>
  name === "angle_scale" ? "" : /^(alpha|det_|axis_tilt_)/.test(name) ? "°" : "mm";

// A belief that is nearer than so many sigmas is not contradicted.
const CONTRADICTED_SIGMAS = 3;

/**
 * @typedef {object} Found
 * @property {number} value
 * @property {number | null} sigma
 */

/**
 * The distance of a belief from what was found, in sigmas; null where it has none.
 * @param {Found} found
 * @param {number} believed
 * @returns {number | null}
 */
export function missed({ value, sigma }, believed) {
  return sigma ? Math.abs(believed - value) / sigma : null;
}

/**
 * One parameter: `what`, its unit, the value that the reconstruction used, and what was found.
 * @param {string} what
 * @param {string} unit
 * @param {number} believed
 * @param {Found | undefined} found
 * @returns {string}
 */
export function beliefWords(what, unit, believed, found) {
  const belief = `${what}: the slider said ${fixed(believed, 2)} ${unit}`;
  if (!found)
    return `${belief}; the beads do not tell it, so it goes back to the machine file's.`;
  const sigmas = missed(found, believed);
  const error = found.sigma === null ? "" : ` ± ${fixed(found.sigma, 3)}`;
  const measured = `the beads say ${fixed(found.value, 3)}${error} ${unit}`;
  if (sigmas === null) return `${belief}; ${measured}.`;
  const far = `${fixed(sigmas, 1)} sigmas from it`;
  const verdict =
    sigmas >= CONTRADICTED_SIGMAS
      ? `the slider was wrong, ${far}`
      : `the slider agrees, ${far}`;
  return `${belief}; ${measured}: ${verdict}.`;
}
