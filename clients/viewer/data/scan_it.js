// "Scan it": one turn of what stands on the stage. The sample fills the image, the views
// follow from its size, the volume grows in the scene meanwhile and then stands beside its
// truth.
import { $, $button, $input, $select, clicks, el, setText, words } from "./dom.js";
import { command, call, emit, on, store } from "./link.js";
import { folder } from "./data.js";
import { isOver } from "./job_words.js";
import { tellSubmitted } from "./scan_job.js";
import { isShown, turning, viewsFor } from "./view_count.js";
import { nearSample } from "./views.js";
import { hindered } from "./warnings.js";
import { reconstruct, wantedOf, watch } from "./volume.js";
/** @import { Answers, State } from "../web/viewer.d.ts" */

const EXPOSURE_MS = 100;
// Part of the image, in width and height, that the sample takes.
const FILL = 0.8;
// How often, and after which time, the page looks for a sample that was just put there.
const SHOWN_TRIES = 20;
const SHOWN_AGAIN_MS = 100;
// Change of the voxel size below which the stage stays where it is.
const SAME = 0.12;
const sample = $select("#scan-it-sample");
const go = $button("#scan-it");
const wanted = $input("#scan-it-views");
const note = $("#scan-it-note");
const EMPTY = "empty";
/** @type {string | null} */
let mine = null;
// From the press of the button until the scan has begun.
let pressed = false;
// Until the twin has answered to a choice.
let exchanging = false;
let exchanged = Promise.resolve();
// From the press of the button until the volume stands beside its truth.
let busy = false;
// The scan whose volume it is then.
let awaited = "";
// Until the first image: then the stage stands where it turns, and the camera goes there.
let far = false;

/**
 * The state of the twin, once the page's own is of the same sample or has had time for it.
 * @returns {Promise<State | null>}
 */
async function current() {
  const state = await command("state.get", {}, "No scan");
  for (let wait = 0; state && !isShown(state.sample) && wait < SHOWN_TRIES; wait++)
    await new Promise((again) => setTimeout(again, SHOWN_AGAIN_MS));
  if (state && !isShown(state.sample))
    emit(
      "note",
      "warning-note",
      "Scan it",
      "the sample’s shape is not here yet: its box counts",
    );
  return state;
}

/**
 * The voxel size [um] at which the sample fills the image.
 * @param {State} state
 * @returns {number | null}
 */
export function filling(state) {
  const size = turning(state);
  const [rows, columns] = state.camera.shape;
  if (!size) return null;
  return (1000 * Math.max(size[0] / columns, size[1] / rows)) / FILL;
}

/**
 * A script of one turn that may run, at a voxel size or where the stage stands; else why not.
 * @param {number} frames
 * @param {number | null} voxel_um
 * @returns {Promise<Answers["viewer.compose"] | string>}
 */
async function composed(frames, voxel_um) {
  const asked = { kind: /** @type {const} */ ("fly"), frames, exposure_ms: EXPOSURE_MS };
  const more = voxel_um === null ? {} : { voxel_um };
  try {
    const made = await call("viewer.compose", { ...asked, ...more });
    const { ok, problems } = await call("script.check", { text: made.text });
    if (ok) return made;
    const error = problems.find(({ severity }) => severity === "error");
    return error?.message ?? "its script is not ready to run";
  } catch (error) {
    return words(error);
  }
}

/**
 * A script for it: nearer or farther where that is possible, else where the stage stands, which
 * is said; with as many views as follow from the sample, unless they are given.
 * @param {State} state
 * @param {number | null} views
 * @returns {Promise<Answers["viewer.compose"] | null>}
 */
async function script(state, views) {
  const now_um = 1000 * (state.geometry?.voxel_size_mm ?? 0.1);
  const wanted_um = filling(state);
  const near = wanted_um !== null && Math.abs(wanted_um / now_um - 1) > SAME ? wanted_um : null;
  let refused = "";
  for (const voxel_um of near === null ? [null] : [near, null]) {
    const frames = views ?? viewsFor(state, voxel_um ?? now_um);
    const made = await composed(frames, voxel_um);
    if (typeof made !== "string") {
      if (refused) emit("note", "warning-note", "Scanned where it stands", refused);
      return made;
    }
    refused = made;
  }
  emit("note", "error", "No scan", refused);
  return null;
}

/**
 * Puts a sample on the stage, unless it stands there, and begins one turn of it that fills the
 * image; its job, or null.
 * @param {string} named
 * @param {number | null} [views]
 * @returns {Promise<string | null>}
 */
export async function turnOf(named, views = null) {
  await exchanged; // what was just chosen is on its way: a state that is older knows nothing of it
  const stands = await command("state.get", {}, "No scan");
  if (!stands) return null;
  const other = named && named !== stands.sample.name;
  if (other && !(await command("sample.set", { name: named }, "The sample stays"))) return null;
  const state = await current();
  const made = state && (await script(state, views));
  const asked = made && { text: made.text, speed_up: /** @type {const} */ ("max") };
  const job = asked && (await command("script.submit", asked, "No scan"));
  return job?.job ?? null;
}

/**
 * Begins a scan of a sample, of the chosen one unless another is named, whose volume grows and
 * then stands beside its truth; its job, or null.
 * @param {string} [named]
 * @returns {Promise<string | null>}
 */
export async function scanIt(named = sample.value) {
  if (!wanted.reportValidity()) return null;
  pressed = true;
  allow();
  try {
    mine = await turnOf(named, wanted.value ? wanted.valueAsNumber : null);
    if (!mine) return null;
    busy = true;
    far = true;
    watch();
    void tellSubmitted("Scan it", mine, named || "the sample");
    return mine;
  } finally {
    pressed = false;
    allow();
  }
}

/**
 * Takes up a scan that this page began before it was loaded again: its volume grows and then stands
 * beside its truth.
 * @param {string} job
 */
export function takeUp(job) {
  mine = job;
  busy = true;
  watch();
}

/** Nothing is scanned of an empty stage, nor where nothing moves for this page. */
function allow() {
  const state = store.state;
  go.disabled = pressed || !state?.sample.name || hindered(state) !== "";
}

on("state", (state) => {
  const offered = [...$select("#sample").options].map((option) => option.value);
  const stands = state.sample.name ?? EMPTY;
  const names = [...new Set([stands, ...offered])];
  const key = names.join("\n");
  // Another volume has taken its place.
  if (mine === null && !pressed && wantedOf() !== awaited) busy = false;
  if (!busy && !exchanging) setText(note, told(state));
  if (sample.dataset.names !== key && document.activeElement !== sample) {
    sample.dataset.names = key;
    sample.replaceChildren(...names.map((name) => el("option", { value: name }, name)));
  }
  if (!exchanging) sample.value = stands;
  allow();
});

/** The list is what stands on the stage, as that of the Setup tab: a choice puts it there. */
async function exchange() {
  exchanging = true;
  setText(note, `${sample.value} is put on the stage …`);
  try {
    await command("sample.set", { name: sample.value }, "The sample stays");
  } finally {
    exchanging = false;
    sample.value = store.state?.sample.name ?? EMPTY;
  }
}

/**
 * @param {State} state
 * @returns {string}
 */
function told(state) {
  const voxel_um = filling(state);
  if (!state.sample.name || voxel_um === null) return "The stage is empty: choose a sample.";
  const own = viewsFor(state, voxel_um);
  wanted.placeholder = String(own);
  const why = hindered(state);
  if (why) return `No scan: ${why}.`;
  const waits = store.job && !isOver(store.job) ? "After the current scan: one" : "One";
  return `${waits} turn of ${wanted.value || own} images; the volume grows in the scene.`;
}
on("job", (job) => {
  if (job.job !== mine) return;
  if (job.state === "done") {
    setText(note, "Reconstructing the whole scan, then comparing it with the truth.");
    mine = null;
    awaited = folder(job);
    reconstruct(awaited, true);
    return;
  }
  if (far && job.frames_done > 0) {
    far = false;
    nearSample();
  }
  setText(note, `${job.frames_done} of ${job.frames_total} images`);
  if (isOver(job)) {
    mine = null;
    busy = false;
  }
});
on("volume", (volume) => {
  const ended = volume.compared || volume.not_compared || volume.problem;
  if (mine === null && ended) busy = false;
});
clicks({ "scan-it": () => scanIt() });
sample.addEventListener("change", () => {
  exchanged = exchange();
});
