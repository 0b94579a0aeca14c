// What the next scan is wished to be: each quantity stands once, and has one field. The designer
// and the script both read it here.
import { $, $input, $select, setText } from "./dom.js";
import { batch, computed, effect, signal } from "./signals.js";
import { on } from "./link.js";
import { LEAST_VIEWS, viewsFor } from "./view_count.js";
/** @import { Compose } from "../web/viewer.d.ts" */

const EXPOSURE_MS = 100;
/** @typedef {NonNullable<Compose["kind"]>} Kind */

const typedFrames = signal(/** @type {number | null} */ (null));
const proposedFrames = signal(LEAST_VIEWS);
const typedExposure_ms = signal(/** @type {number | null} */ (null));
const cameraExposure_ms = signal(EXPOSURE_MS);
export const kind = signal(/** @type {Kind} */ ("fly"));
// Those that the sample needs where it stands, until somebody types another number.
export const frames = computed(() => typedFrames.get() ?? proposedFrames.get());
// The camera's, until somebody types another one.
export const exposure_ms = computed(() => typedExposure_ms.get() ?? cameraExposure_ms.get());

const kindField = $select("#wish-kind");
const framesField = $input("#wish-frames");
const exposureField = $input("#wish-exposure");

/** The fields as they stand, whoever has written into them. */
function read() {
  batch(() => {
    kind.set(/** @type {Kind} */ (kindField.value));
    const count = framesField.valueAsNumber;
    if (!Object.is(count, frames.get())) typedFrames.set(count);
    const typed = exposureField.valueAsNumber;
    if (!Object.is(typed, exposure_ms.get())) setExposure(typed);
  });
}

/** @param {number} ms */
export function setExposure(ms) {
  typedExposure_ms.set(ms);
}
for (const field of [kindField, framesField, exposureField])
  field.addEventListener("input", read);
for (const [field, typed] of /** @type {const} */ ([
  [framesField, typedFrames],
  [exposureField, typedExposure_ms],
]))
  field.addEventListener("keydown", (e) => {
    if (e.key === "Escape") typed.set(null);
  });
effect(() => {
  setText($("#wish-what"), kind.get() === "tiled" ? "frames a tile" : "frames");
});
effect(() => {
  const count = frames.get();
  if (Number.isFinite(count) && framesField.valueAsNumber !== count)
    framesField.value = String(count);
  framesField.classList.toggle("typed", typedFrames.get() !== null);
});
effect(() => {
  const ms = exposure_ms.get();
  const shown = Number(ms.toFixed(3));
  if (Number.isFinite(ms) && exposureField.valueAsNumber !== shown) {
    exposureField.value = String(shown);
  }
  exposureField.classList.toggle("typed", typedExposure_ms.get() !== null);
});
on("state", (state) => {
  cameraExposure_ms.set(state.camera.exposure_ms);
  proposedFrames.set(kind.get() === "calibration" ? LEAST_VIEWS : viewsFor(state));
});

/**
 * @typedef {object} Wish
 * @property {Kind} kind
 * @property {number} frames
 * @property {number} exposure_ms
 */

/**
 * @param {Wish} a
 * @param {Wish} b
 * @returns {boolean}
 */
export const sameWish = (a, b) =>
  a.kind === b.kind && a.frames === b.frames && a.exposure_ms === b.exposure_ms;

/**
 * @param {Wish} wish
 * @returns {string}
 */
export const wishWords = ({ kind: way, frames: count, exposure_ms: ms }) =>
  `${count} frames of ${ms} ms (${way})`;

/**
 * The wish; what is no number of images or no exposure is said in words instead.
 * @returns {Wish | string}
 */
export function wished() {
  read();
  if (!Number.isInteger(frames.get()) || frames.get() < 1)
    return "frames: a whole number above 0";
  if (!(exposure_ms.get() > 0)) return "ms: a number above 0";
  return { kind: kind.get(), frames: frames.get(), exposure_ms: exposure_ms.get() };
}
