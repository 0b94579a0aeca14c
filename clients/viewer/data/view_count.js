// How many images of a turn the page proposes, wherever it proposes a number.
import { across } from "./sample_outline.js";
import { store } from "./link.js";
/** @import { State } from "../web/viewer.d.ts" */

/** For beads, as `flexdt script new --kind calibration` takes; fewer are proposed for nothing. */
export const LEAST_VIEWS = 91;
const MOST_VIEWS = 151;
// Voxels across the image of the volume that is shown.
const SHOWN_VOXELS = 256;

/**
 * Whether the page's own state is of a sample: only then does it know what is across it.
 * @param {State["sample"]} some
 */
export const isShown = (some) =>
  some.name === store.state?.sample.name && some.revision === store.state.sample.revision;

/**
 * Size of what turns, across and upright, in mm; null where nobody has said it.
 * @param {State} state
 * @returns {[across: number, upright: number] | null}
 */
export function turning({ sample: some }) {
  const { x, y, rx, ry } = some.offset;
  const width = across(some, isShown(some) ? store.across_mm : null);
  if (!some.size_mm || width === null) return null;
  return [width + 2 * Math.hypot(x, y), rx || ry ? width : some.size_mm[2]];
}

/**
 * As many views as keep steps at the rim of the sample within a voxel of what is shown.
 * @param {State} state
 * @param {number} [voxel_um] where the stage stands unless given
 * @returns {number}
 */
export function viewsFor(state, voxel_um = 1000 * (state.geometry?.voxel_size_mm ?? 0.1)) {
  const size = turning(state);
  const shown_mm = (voxel_um / 1000) * Math.max(1, state.camera.shape[1] / SHOWN_VOXELS);
  const wanted = size ? Math.ceil((Math.PI / 2) * (size[0] / shown_mm)) : MOST_VIEWS;
  return Math.min(MOST_VIEWS, Math.max(LEAST_VIEWS, wanted)) | 1;
}
