// What a reconstruction believed of a geometry, beside what a calibration found: in words.
import { fixed } from "./figures.js";

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
