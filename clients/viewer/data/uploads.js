// A mesh from a file to the stage: its size beside the unit before anything is sent, one upload
// at a time with its progress, and a question where the size is absurd.
import { $, $button, $input, $select, base64, clicks, el, setText, words } from "./dom.js";
import { allSamples, command, emit, store } from "./link.js";
import { absurd, length, meshExtent, MM_PER_UNIT } from "./mesh_extent.js";
import { sampleName } from "./names.js";
/**
 * @import { Extent } from "./mesh_extent.js"
 * @import { SampleUpload, UploadResult } from "../web/viewer.d.ts"
 */

const CHUNK_BYTES = 3 << 20;
/** @type {Array<SampleUpload["format"]>} */
const FORMATS = ["stl", "obj", "ply", "glb", "off"];
const file = $input("#mesh-file");
const unit = $select("#mesh-unit");
const note = $("#mesh-note");
/** @type {HTMLProgressElement} */
const meter = $("#mesh-progress");
/** @type {Extent | null} */
let extent = null; // of the chosen file, in its own units
/** @type {{ cancelled: boolean } | null} */
let sending = null;

clicks({ "mesh-upload": start, "mesh-cancel": cancel });
file.addEventListener("change", () => void look());
unit.addEventListener("change", say);

/** @param {File} of */
const formatOf = (of) => (of.name.split(".").pop() ?? "").toLowerCase();

/** Reads the size of the file that was chosen. */
async function look() {
  const chosen = file.files?.[0];
  extent = null;
  setText(note, "");
  if (!chosen) return;
  unit.value = formatOf(chosen) === "glb" ? "m" : "mm";
  const content = await chosen.arrayBuffer();
  if (file.files?.[0] !== chosen) return;
  extent = meshExtent(content, formatOf(chosen));
  say();
}

/** The size in the unit that is chosen, and what is absurd about it. */
function say() {
  const box = $("#mesh-size");
  if (!extent) {
    setText(box, file.files?.length ? "size: known when the twin has read it" : "");
    return;
  }
  const size = /** @type {Extent} */ (
    /** @type {unknown} */ (extent.map((v) => v * MM_PER_UNIT[unit.value]))
  );
  const why = wrong(size);
  box.classList.toggle("error", why !== "");
  setText(box, [size.map(length).join(" × "), why].filter(Boolean).join(": "));
}

/**
 * @param {Extent} size_mm
 * @returns {string}
 */
function wrong(size_mm) {
  const geometry = store.state?.geometry;
  return geometry ? absurd(size_mm, geometry.voxel_size_mm, geometry.SOD_mm) : "";
}

/** @param {boolean} to */
function busy(to) {
  $button("#mesh-upload").disabled = to;
  $button("#mesh-cancel").hidden = !to;
  meter.hidden = !to;
}
function cancel() {
  if (sending) sending.cancelled = true;
  $button("#mesh-cancel").hidden = true;
}

async function start() {
  const chosen = file.files?.[0];
  if (sending) return;
  if (!chosen) {
    emit("note", "warning-note", "Upload", "choose a file first");
    return;
  }
  const mine = (sending = { cancelled: false });
  busy(true);
  setText(note, "");
  try {
    const answer = await send(chosen, mine);
    if (answer?.complete) await arrived(answer);
    else if (mine.cancelled) setText(note, "canceled: nothing is kept");
  } finally {
    sending = null;
    busy(false);
  }
}

/**
 * Sends the chunks of a file; null where it was refused, cancelled, or is none.
 * @param {File} chosen
 * @param {{ cancelled: boolean }} mine
 * @returns {Promise<UploadResult | null>}
 */
async function send(chosen, mine) {
  const format = FORMATS.find((f) => f === formatOf(chosen));
  const total = chosen.size;
  /** @param {string} why */
  const refuse = (why) => emit("note", "error", "Upload", `${chosen.name}${why}`);
  if (!format) refuse(`: allowed are ${FORMATS.join(", ")}`);
  else if (!total) refuse(" is empty");
  if (!format || !total) return null;
  const known = await allSamples().catch((/** @type {unknown} */ error) => {
    emit("note", "error", "No upload", words(error));
    return null;
  });
  if (!known) return null;
  const taken = known.samples.map((s) => s.name);
  const common = {
    name: sampleName(chosen.name, taken),
    format,
    total,
    unit: /** @type {SampleUpload["unit"]} */ (unit.value),
    place: /** @type {SampleUpload["place"]} */ ($select("#mesh-place").value),
    material: $select("#mesh-material").value || null,
  };
  /** @type {UploadResult | null} */
  let answer = null;
  for (let at = 0; at < total && !mine.cancelled; at += CHUNK_BYTES) {
    meter.value = at / total;
    const last = at + CHUNK_BYTES >= total;
    setText(note, last ? "the twin reads it …" : `sent ${Math.round((100 * at) / total)} %`);
    if (last) {
      meter.removeAttribute("value");
      $button("#mesh-cancel").hidden = true; // the twin has all of it with this chunk
    }
    const data = base64(await chosen.slice(at, at + CHUNK_BYTES).arrayBuffer());
    const title = `${chosen.name} was not taken`;
    answer = await command("sample.upload", { ...common, start: at, data }, title);
    if (answer === null) {
      setText(note, "");
      return null;
    }
    for (const warning of answer.warnings) emit("note", "warning-note", common.name, warning);
  }
  if (!answer?.complete && !mine.cancelled) refuse(" did not arrive as a whole");
  return answer;
}

/**
 * An upload that the twin has read goes onto the stage; one of an absurd size is asked about.
 * @param {UploadResult} uploaded
 */
async function arrived({ name, sample }) {
  emit("samples");
  const size = sample?.size_mm;
  const why = size ? wrong(size) : "";
  if (!why) {
    await put(name);
    return;
  }
  emit("note", "warning-note", name, why);
  setText(note, `${name} is uploaded; ${why}`);
  const go = { class: "small", id: "mesh-anyway", onclick: () => put(name) };
  note.append(" ", el("button", go, "Put it on the stage all the same"));
}

/** @param {string} name */
async function put(name) {
  setText(note, "onto the stage …");
  const answer = await command("sample.set", { name }, "The sample stays");
  setText(note, answer ? "" : "uploaded");
  if (answer) emit("note", "good", "Sample", `${name} is on the stage`);
}
