// A radiograph as a picture that explains itself: scale at the sample, unit and window, when
// and of what.
import { bar } from "./slices.js";
import { fixed } from "./dom.js";
import { store } from "./link.js";

const STRIP_PX = 44;
/** @type {Record<string, string>} */
const UNITS = {
  line_integral: "line integral (no unit)",
  counts: "counts",
};

/**
 * @param {string} url
 * @returns {Promise<HTMLImageElement>}
 */
function loaded(url) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => resolve(image);
    image.onerror = () => reject(new Error("the picture cannot be read"));
    image.src = url;
  });
}

/**
 * What stands below the picture; the scale holds at the rotation axis.
 * @returns {[string, string]}
 */
function lines() {
  const shown = store.image;
  const state = store.state;
  const recorded = shown?.recorded;
  const unit = UNITS[shown?.kind ?? ""] ?? "";
  const window = shown ? `${fixed(shown.window[0], 2)} to ${fixed(shown.window[1], 2)}` : "";
  const sample = state?.sample.name ?? "no sample";
  const what = recorded ? `${recorded.name}, ${recorded.file}` : sample;
  const tube = recorded ? null : state?.tube;
  const beam = tube ? ` · ${fixed(tube.kV, 0)} kV, ${fixed(tube.power_W, 0)} W` : "";
  const when = new Date().toISOString().slice(0, 16).replace("T", " ");
  return [`${unit}, window ${window}`, `${what}${beam} · ${when} UTC · flexdt`];
}

/**
 * A PNG of a data URL with a strip below it.
 * @param {string} url
 * @returns {Promise<Blob>}
 */
export async function captioned(url) {
  const image = await loaded(url);
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("2d");
  if (!context) throw new Error("this browser draws nothing");
  canvas.width = image.width;
  canvas.height = image.height + STRIP_PX;
  context.fillStyle = "#0b0e13";
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.drawImage(image, 0, 0);
  const recorded = store.image?.recorded?.geometry;
  const voxel_mm = (recorded ?? store.state?.geometry)?.voxel_size_mm ?? null;
  const columns = store.image?.full[1] ?? image.width;
  let left = 10;
  context.fillStyle = "#ffd54a";
  context.font = "13px system-ui, sans-serif";
  context.textBaseline = "middle";
  if (voxel_mm) {
    const per_px = (voxel_mm * columns) / image.width;
    const mm = bar(image.width * per_px);
    context.fillRect(left, image.height + 28, mm / per_px, 3);
    context.fillText(`${mm} mm at the axis`, left, image.height + 15);
    left += Math.max(mm / per_px, 110) + 24;
  }
  context.fillStyle = "#e5eaf1";
  lines().forEach((line, k) => context.fillText(line, left, image.height + 14 + 18 * k));
  return new Promise((resolve, reject) => {
    canvas.toBlob(
      (blob) => (blob ? resolve(blob) : reject(new Error("no picture"))),
      "image/png",
    );
  });
}
