// How much of a volume's box its object takes.
import { codeOf, extent, index } from "./slices.js";
/** @import { Block } from "../web/viewer.d.ts" */

// Voxels along an axis between two that are looked at.
const STEP = 4;
// Voxels above the level beside one that counts: noise has none.
const FEWEST_NEIGHBOURS = 4;

/**
 * Greatest distance from the box's centre of what reaches the level, in longest sides of the
 * box; null where nothing does.
 * @param {Block} block
 * @param {number} level
 * @returns {number | null}
 */
export function reach(block, level) {
  const size = extent(block);
  const least = Math.max(1, codeOf(block, level));

  /**
   * @param {number} x
   * @param {number} y
   * @param {number} z
   */
  const solid = (x, y, z) => block.codes[index(block, [x, y, z])] >= least;
  let most = -1;
  for (let z = 1; z < size[2] - 1; z += STEP)
    for (let y = 1; y < size[1] - 1; y += STEP)
      for (let x = 1; x < size[0] - 1; x += STEP) {
        const far = Math.hypot(...[x, y, z].map((v, k) => v + 0.5 - size[k] / 2));
        if (far <= most || !solid(x, y, z)) continue;
        const beside = [
          solid(x - 1, y, z),
          solid(x + 1, y, z),
          solid(x, y - 1, z),
          solid(x, y + 1, z),
          solid(x, y, z - 1),
          solid(x, y, z + 1),
        ];
        if (beside.filter(Boolean).length >= FEWEST_NEIGHBOURS) most = far;
      }
  return most < 0 ? null : (most + STEP) / Math.max(...size);
}
