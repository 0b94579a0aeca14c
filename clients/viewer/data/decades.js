// Shares in bins that are equally wide in their logarithm, as a histogram over decades takes them.
/** @import { Pair, TransmissionShares } from "../web/viewer.d.ts" */

/**
 * @typedef {object} Decades
 * @property {number[]} counts
 * @property {Pair} range Base-10 logarithms of the first bin's lower and the last bin's upper
 *   end.
 */

/**
 * The wire's first bin begins at 0 and its last share has no upper end: both are counted in the
 * bin beside them.
 * @param {TransmissionShares} shares
 * @returns {Decades}
 */
export function decades({ edges, shares }) {
  const bins = edges.length - 2;
  const counts = shares.slice(1, 1 + bins);
  counts[0] += shares[0];
  counts[bins - 1] += shares.slice(1 + bins).reduce((sum, share) => sum + share, 0);
  return { counts, range: [Math.log10(edges[1]), Math.log10(edges[edges.length - 1])] };
}
