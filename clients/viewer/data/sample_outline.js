// Whether the sample stays in the picture over a whole turn, by the cylinder about the axis that
// holds it.
/** @import { CameraState, GeometryState, SampleState } from "../web/viewer.d.ts" */

const HALF_PX = 0.5;
/** Where a scan that runs has moved the sample: there it takes its flat images. */
export const OUTSIDE = "Sample is outside the image";
/** @typedef {readonly [from: number, to: number]} Interval */

/**
 * Diameter [mm] of the cylinder that holds a sample, about an upright axis through its origin:
 * of its shape, where that is known and stands upright, else of its box; null where nobody has
 * said its size.
 * @param {SampleState} sample
 * @param {number | null} shape_mm
 */
export function across({ size_mm: size, offset }, shape_mm) {
  if (!size) return null;
  if (offset.rx || offset.ry) return Math.hypot(...size);
  return Math.min(Math.hypot(size[0], size[1]), shape_mm ?? Infinity);
}

/**
 * What the picture lacks, for people; nothing where the sample is inside. `shape_mm` is the
 * diameter of the cylinder about the sample's z axis that holds it, where that is known.
 * @param {SampleState} sample
 * @param {GeometryState} g
 * @param {CameraState} camera
 * @param {number} sampleHeight_mm
 * @param {number | null} [shape_mm]
 * @returns {string[]}
 */
export function outline(sample, g, camera, sampleHeight_mm, shape_mm = null) {
  const size = sample.size_mm;
  const width = across(sample, shape_mm);
  const axis = g.axis_column_px;
  if (!size || width === null || axis === null || !Number.isFinite(axis)) return [];
  const o = sample.offset;
  const upright = !o.rx && !o.ry;
  const radius = 0.5 * width + Math.hypot(o.x, o.y);
  if (radius >= g.SOD_mm) return ["the sample reaches the source"];
  const reach = (radius * g.SDD_mm) / Math.sqrt(g.SOD_mm ** 2 - radius ** 2) / camera.pixel_mm;
  /** @type {Interval} */
  const sideways = [axis - reach, axis + reach];
  const height = upright ? size[2] : width;
  const nearest = g.SDD_mm / (g.SOD_mm - radius) / camera.pixel_mm;
  const raised = ((o.z + sampleHeight_mm) * g.magnification) / camera.pixel_mm;
  const middle = g.piercing_point_px[1] - raised;
  /** @type {Interval} */
  const along = [middle - (height / 2) * nearest, middle + (height / 2) * nearest];
  const [rows, cols] = camera.shape;
  if (outside(sideways, cols) || outside(along, rows)) return [OUTSIDE];
  /** @type {string[]} */
  const cut = [];
  if (beyond(sideways, cols)) cut.push("at the sides during a full turn");
  const [above, below] = [along[0] < -HALF_PX, along[1] > rows - HALF_PX];
  if (above || below)
    cut.push(`at the ${above && below ? "top and bottom" : above ? "top" : "bottom"}`);
  return cut.length ? [`Sample cut off ${cut.join(", and ")}`] : [];
}

/**
 * @param {Interval} interval
 * @param {number} count
 */
const outside = ([from, to], count) => to < -HALF_PX || from > count - HALF_PX;

/**
 * @param {Interval} interval
 * @param {number} count
 */
const beyond = ([from, to], count) => from < -HALF_PX || to > count - HALF_PX;
