// What is said over the radiograph and beside it: of the image that is shown, by what that one was
// made of, and of how often another one comes.
import { OLD_S } from "./moment.js";

// Line integrals are drawn as though no pixel were saturated: said from this part on.
export const MANY_SATURATED = 0.001;
const RATE_MS = 2000;
const FEWEST = 4; // images within that time: of fewer no rate is told

/** @param {number} part */
const percent = (part) => `${(100 * part).toFixed(part < 0.1 ? 1 : 0)} %`;

/**
 * What saturation does to a recorded scan and its volume; nothing where few pixels saturate.
 * @param {number | null | undefined} part of the scan's pixels, as predicted
 * @returns {string}
 */
export const scanSaturated = (part) =>
  (part ?? 0) < MANY_SATURATED
    ? ""
    : `${percent(part ?? 0)} of the pixels saturated: attenuation is too low there`;

/**
 * @param {{ lit: boolean; counts: boolean; signed?: boolean }} image
 * @param {{ on: boolean; ready: boolean }} tube as it is now
 * @param {number} saturated part of the pixels
 * @returns {string}
 */
export function beamWords({ lit, counts, signed }, tube, saturated) {
  if (lit) {
    if (counts || signed || saturated < MANY_SATURATED) return "";
    return `${percent(saturated)} saturated: drawn as though none were`;
  }
  if (tube.on) return tube.ready ? "from before X-rays were on" : "X-rays warming up";
  return counts ? "X-rays off: dark image" : "X-rays off: drawn as though on";
}

/**
 * Follows the images that are shown; told one again, it counts once. Says nothing of few, nor
 * beside an image that is marked as old.
 * @returns {(image: object | null, now_ms: number, age_s: number) => string}
 */
export function rating() {
  /** @type {object | null} */
  let last = null;
  /** @type {number[]} */
  let came = [];
  return (image, now_ms, age_s) => {
    if (image && image !== last) came.push(now_ms);
    last = image;
    came = came.filter((at) => now_ms - at < RATE_MS);
    if (came.length < FEWEST || age_s > OLD_S) return "";
    return `${((1000 * came.length) / RATE_MS).toFixed(0)} images/s`;
  };
}
