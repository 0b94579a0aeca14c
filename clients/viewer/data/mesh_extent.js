// The size of a mesh in the units of its file, read here so that it stands beside the unit before
// anything is sent. Formats that are not read here have none.

/** @typedef {readonly [x: number, y: number, z: number]} Extent */

const STL_HEAD_BYTES = 84;
const STL_FACET_BYTES = 50;
const TEXT_BYTES = 64 << 20; // longer texts are left to the twin

/** @type {Readonly<Record<string, number>>} */
export const MM_PER_UNIT = {
  um: 1e-3,
  mm: 1,
  cm: 10,
  m: 1000,
  inch: 25.4,
};

/** Lowest and highest coordinates of the points that are added. */
function box() {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  return {
    /**
     * @param {number} x
     * @param {number} y
     * @param {number} z
     */
    add(x, y, z) {
      [x, y, z].forEach((v, k) => {
        if (v < low[k]) low[k] = v;
        if (v > high[k]) high[k] = v;
      });
    },
    /** @returns {Extent | null} */
    extent() {
      const size = high.map((v, k) => v - low[k]);
      return size.every(Number.isFinite)
        ? /** @type {Extent} */ (/** @type {unknown} */ (size))
        : null;
    },
  };
}

/**
 * @param {ArrayBuffer} buffer
 * @param {string} format
 * @returns {Extent | null}
 */
export function meshExtent(buffer, format) {
  if (format === "stl" && isBinaryStl(buffer)) return ofBinaryStl(buffer);
  if (buffer.byteLength > TEXT_BYTES || !["stl", "obj", "off"].includes(format)) return null;
  const text = new TextDecoder().decode(buffer);
  if (format === "stl") return ofLines(text, /^\s*vertex\s+(.*)$/gm);
  if (format === "obj") return ofLines(text, /^\s*v\s+(.*)$/gm);
  return ofOff(text);
}

/**
 * @param {ArrayBuffer} buffer
 * @returns {boolean}
 */
function isBinaryStl(buffer) {
  if (buffer.byteLength < STL_HEAD_BYTES) return false;
  const facets = new DataView(buffer).getUint32(80, true);
  return buffer.byteLength === STL_HEAD_BYTES + STL_FACET_BYTES * facets;
}

/**
 * @param {ArrayBuffer} buffer
 * @returns {Extent | null}
 */
function ofBinaryStl(buffer) {
  const view = new DataView(buffer);
  const found = box();
  for (let at = STL_HEAD_BYTES; at < buffer.byteLength; at += STL_FACET_BYTES) {
    for (let corner = 12; corner < 48; corner += 12) {
      const [x, y, z] = [0, 4, 8].map((k) => view.getFloat32(at + corner + k, true));
      found.add(x, y, z);
    }
  }
  return found.extent();
}

/**
 * @param {string} text
 * @param {RegExp} points
 * @returns {Extent | null}
 */
function ofLines(text, points) {
  const found = box();
  for (const [, numbers] of text.matchAll(points)) add(found, numbers);
  return found.extent();
}

/**
 * @param {string} text
 * @returns {Extent | null}
 */
function ofOff(text) {
  const lines = text
    .split("\n")
    .map((line) => line.replace(/#.*/, "").trim())
    .filter((line) => line && !/^[A-Z0-9]*OFF$/.test(line));
  const count = Number(lines[0]?.split(/\s+/)[0]);
  if (!Number.isInteger(count)) return null;
  const found = box();
  for (const line of lines.slice(1, count + 1)) add(found, line);
  return found.extent();
}

/**
 * @param {ReturnType<typeof box>} found
 * @param {string} numbers
 */
function add(found, numbers) {
  const [x, y, z] = numbers.trim().split(/\s+/).map(Number);
  found.add(x, y, z);
}

const SMALLEST_VOXELS = 5;

/**
 * What is absurd about a sample of such a size [mm], in words; "" where nothing is.
 * @param {Extent} size_mm
 * @param {number} voxel_mm
 * @param {number} source_mm
 * @returns {string}
 */
export function absurd(size_mm, voxel_mm, source_mm) {
  const largest = Math.max(...size_mm);
  const smallest = Math.min(...size_mm);
  if (largest < SMALLEST_VOXELS * voxel_mm) {
    const voxels = (largest / voxel_mm).toPrecision(2);
    return `its largest side is ${length(largest)}, ${voxels} voxels: is the unit right?`;
  }
  if (smallest > 2 * source_mm) {
    return `its smallest side is ${length(smallest)}, beyond the source: is the unit right?`;
  }
  return "";
}

/**
 * A length in the unit that reads best.
 * @param {number} mm
 * @returns {string}
 */
export function length(mm) {
  if (mm < 0.1) return `${Number((1000 * mm).toPrecision(3))} µm`;
  if (mm >= 1000) return `${Number((mm / 1000).toPrecision(3))} m`;
  return `${Number(mm.toPrecision(3))} mm`;
}
