// What is said over the radiograph and beside it: of the image that is shown, by what that one was
// made of, and of how often another one comes.
import { OLD_S } from "./moment.js";

// Line integrals are drawn as though no pixel were saturated: said from this part on.
export const MANY_SATURATED = 0.001;
const RATE_MS = 2000;
const FEWEST = 4; // images within that time: of fewer no rate is told

/**
 * @param {{ lit: boolean; counts: boolean; signed?: boolean }} image
 * @param {{ on: boolean; ready: boolean }} tube as it is now
 * @param {number} saturated part of the pixels
 * @returns {string}
 */
export function beamWords({ lit, counts, signed }, tube, saturated) {
  if (lit) {
    if (counts || signed || saturated < MANY_SATURATED) return "";
    const part = saturated < 0.1 ? (100 * saturated).toFixed(1) : (100 * saturated).toFixed(0);
    return `${part} % saturated: drawn as though none were`;
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
