// The Setup tab: tube, camera, sample on the stage (with upload), layers of the scene.
import { detailWords } from "./figures.js";
import {
  $,
  $$,
  $button,
  $input,
  $select,
  clicks,
  el,
  fixed,
  keep,
  numeric,
  parsed,
  setText,
  words,
} from "./dom.js";
import { differences, listed, only } from "./fingerprint.js";
import { allSamples, call, command, emit, on, store } from "./link.js";
import { hindered } from "./warnings.js";
import { curve } from "./plots.js";
/**
 * @import { ExposurePrediction, Placement, PredictedSetting, Requests, State }
 *   from "../web/viewer.d.ts"
 * @import { Fingerprint } from "./fingerprint.js"
 */

const ROI = ["l", "t", "r", "b"];
const SIX = /** @type {const} */ (["x", "y", "z", "rx", "ry", "rz"]);
// What is set here and not yet applied bears the class "typed"; everything else shows the state.
for (const input of /** @type {HTMLInputElement[]} */ ($$("#tab-setup .num"))) {
  numeric(
    input,
    () =>
      /** @type {HTMLElement | null} */ (
        input.closest(".card")?.querySelector("[data-apply]")
      )?.click(),
    () => takeBack(input.id),
  );
}
for (const list of [$select("#mode"), $select("#sample")]) {
  list.addEventListener("change", () => list.classList.add("typed"));
  list.addEventListener("keydown", (e) => {
    if (e.key === "Escape") takeBack(list.id);
  });
}
for (const box of /** @type {HTMLInputElement[]} */ ($$("[data-layer]")))
  box.addEventListener("change", () => void showLayer(box.dataset.layer ?? "", box.checked));
const opacity = $input("#opacity");
opacity.addEventListener("change", () => void reveal({ opacity: Number(opacity.value) }));
clicks({
  "tube-apply": setTube,
  "camera-apply": setCamera,
  "sample-apply": setSample,
  "sample-delete": deleteSample,
  predict,
  beam: () => command("tube.set", { on: !store.state?.tube.on }, "The tube refuses"),
});

/**
 * A field or a list of these.
 * @param {string} id
 */
const of = (id) => /** @type {HTMLInputElement | HTMLSelectElement} */ ($(`#${id}`));
/** @param {string} id */
const typed = (id) => $(`#${id}`).classList.contains("typed");

/**
 * @param {string} id
 * @param {number | string | null} value
 */
function put(id, value, digits = 0) {
  const input = of(id);
  const text =
    typeof value === "number" ? String(Number(value.toFixed(digits))) : (value ?? "");
  input.title = typed(id) ? `not applied yet; the twin has ${text}` : "";
  if (typed(id) || input.value === text) return;
  if (input instanceof HTMLSelectElement && ![...input.options].some((o) => o.value === text))
    input.append(el("option", { value: text }, text));
  input.value = text;
}

/** @param {...string} ids */
function takeBack(...ids) {
  for (const id of ids) $(`#${id}`).classList.remove("typed");
  if (store.state) show(store.state);
}

/**
 * The numbers of some fields; null, and they show the state again, if one is none.
 * @param {...string} ids
 */
function numbers(...ids) {
  const values = ids.map((id) => parsed(of(id).value));
  const wrong = ids.filter((_, i) => !Number.isFinite(values[i]));
  for (const id of wrong) {
    const input = of(id);
    const name = input.labels?.[0]?.textContent ?? input.getAttribute("aria-label") ?? id;
    emit("note", "error", "Not applied", `${name}: “${input.value}” is not a number`);
  }
  takeBack(...wrong);
  return wrong.length ? null : values;
}

/**
 * The fields in which nobody has typed anything else since: an answer may come late, and is
 * theirs alone.
 * @param {string[]} ids
 */
function untouched(ids) {
  const sent = ids.map((id) => of(id).value);
  return () => ids.filter((id, i) => of(id).value === sent[i]);
}

/**
 * Sends what was typed into `fields` (parameter -> field or fields) as one command; after an
 * error the fields show the state again.
 * @template {"tube.set" | "camera.set"} M
 * @param {M} method
 * @param {Record<string, string | string[]>} fields
 * @param {string} title
 */
async function apply(method, fields, title) {
  /** @type {Record<string, unknown>} */
  const params = {};
  const ids = Object.values(fields).flat();
  for (const [name, its] of Object.entries(fields)) {
    const some = [its].flat();
    if (!some.some(typed)) continue;
    const list = of(some[0]);
    const values = list instanceof HTMLSelectElement ? [list.value] : numbers(...some);
    if (!values) return;
    params[name] = Array.isArray(its) ? values : values[0];
  }
  if (!Object.keys(params).length) return;
  const same = untouched(ids);
  const taken = await command(method, /** @type {Requests[M]} */ (params), title);
  if (taken)
    for (const id of same()) $(`#${id}`).classList.remove("typed"); // the state comes by itself
  else takeBack(...same());
}
function setTube() {
  return apply("tube.set", { kV: "kV", power_W: "power" }, "The tube refuses");
}
function setCamera() {
  return apply(
    "camera.set",
    {
      exposure_ms: "exposure",
      averages: "averages",
      mode: "mode",
      roi: ROI.map((k) => `roi-${k}`),
    },
    "The camera refuses",
  );
}
async function setSample() {
  const ids = SIX.map((k) => `off-${k}`);
  const values = numbers(...ids);
  if (!values) return;
  /** @type {Placement} */
  const offset = Object.fromEntries(SIX.map((k, i) => [k, values[i]]));
  const same = untouched(["sample", ...ids]);
  const answer = await command(
    "sample.set",
    { name: $select("#sample").value, offset },
    "The sample stays",
  );
  if (answer) for (const id of same()) $(`#${id}`).classList.remove("typed");
  else takeBack(...same());
  for (const warning of answer?.warnings ?? []) emit("note", "warning-note", "Sample", warning);
}

// Uploads that can be deleted: the twin says why one that is in use stays.
/** @type {string[]} */
let uploads = [];
const deletable = () => {
  $button("#sample-delete").hidden = !uploads.includes($select("#sample").value);
};
$select("#sample").addEventListener("change", deletable);
async function deleteSample() {
  const name = $select("#sample").value;
  if (!(await command("sample.delete", { name }, `${name} stays`))) return;
  emit("note", "good", "Sample", `${name} is deleted`);
  takeBack("sample");
  await list();
}

export async function list() {
  const answer = await allSamples().catch(() => null);
  if (!answer) return;
  const select = $select("#sample");
  const chosen = typed("sample") ? select.value : (store.state?.sample.name ?? "empty");
  select.textContent = "";
  for (const s of answer.samples)
    select.append(
      el(
        "option",
        { value: s.name, title: s.description },
        s.uploaded ? `${s.name} (uploaded)` : s.name,
      ),
    );
  if (![...select.options].some((o) => o.value === chosen))
    select.append(el("option", { value: chosen }, chosen));
  select.value = chosen;
  uploads = answer.samples.filter((s) => s.uploaded).map((s) => s.name);
  deletable();
  const materials = $select("#mesh-material");
  if (materials.options.length !== answer.materials.length) {
    materials.replaceChildren(...answer.materials.map((m) => el("option", {}, m)));
    if (answer.materials.includes("abs")) materials.value = "abs";
  }
}
// What the physics that the twin was started with makes of voltage and filters.
/** @type {Record<string, string>} */
const PHYSICS = {
  ideal:
    "Voltage does not change line integrals here: each material has one attenuation. " +
    "It raises the counts, as power and exposure do. " +
    "Start the twin with --physics poly for spectra.",
  mono:
    "Photons of one energy, as many as the spectrum below would make visible: " +
    "voltage changes brightness and noise, not contrast.",
  poly:
    "Photons of all energies below, through the filters: " +
    "voltage changes contrast, brightness and noise.",
};

/**
 * What a prediction is made of; it goes with that.
 * @returns {Fingerprint}
 */
const predictable = () =>
  store.now ? only(store.now, "twin", "machine", "sample", "tube", "camera", "distances") : {};
/** @type {Fingerprint | null} */
let predicted = null;
async function predict() {
  const made = predictable();
  predicted = null;
  $button("#predict").disabled = true;
  setText($("#predicted"), "a few seconds …");
  const p = await command("exposure.predict", {}, "No prediction");
  $button("#predict").disabled = false;
  setText($("#predicted"), p ? predictionWords(p) : "");
  if (p) predicted = made;
}

/**
 * What a prediction has and the images of a twin with one attenuation for each material do not.
 * @returns {string}
 */
export const spectralWords = () =>
  store.hello?.physics === "ideal"
    ? "By the tube’s spectrum, which the images of this twin do not have"
    : "";

/**
 * @param {ExposurePrediction} p
 * @returns {string}
 */
function predictionWords(p) {
  const told = [`contrast to noise of ${detailWords(p.detail)}: ${setting(p.asked)}`];
  if (p.best.length) told.push(`best: ${setting(p.best[0])}`);
  const dark = `${fixed(100 * p.transmission.p1, 1)} % or less`;
  told.push(`the darkest 1 % of the pixels transmit ${dark}`);
  return [told.join(" · "), spectralWords()].filter(Boolean).join(". ");
}

/**
 * @param {PredictedSetting} predicted
 * @returns {string}
 */
function setting({ kV, filter, cnr }) {
  const quality = cnr === null ? "saturated" : fixed(cnr, 1);
  return `${quality} at ${fixed(kV, 0)} kV${filter ? `, ${filter}` : ""}`;
}
function outdatePrediction() {
  const differ = predicted ? differences(predicted, predictable()) : [];
  if (!differ.length) return;
  predicted = null;
  setText($("#predicted"), `made for another ${listed(differ)}: predict again`);
}
const beam = curve($("#spectrum"), true);
/** @type {number | null} */
let spectrumOf = null;
/** @param {number} kV */
async function spectrum(kV) {
  if (spectrumOf === kV || $("#tab-setup").hidden) return;
  spectrumOf = kV;
  const kind = store.hello?.physics ?? "not told";
  $("#physics").textContent = kind;
  $("#physics-note").textContent =
    PHYSICS[kind] ?? "This twin does not say how it makes its images.";
  const s = await call("viewer.spectrum", { kV }).catch(words);
  if (spectrumOf !== kV) return;
  if (typeof s === "string") {
    $("#filters").textContent = "–";
    $("#spectrum-note").textContent = s;
    return;
  }
  $("#filters").textContent =
    s.filters
      .map((f) => `${fixed(f.thickness_mm, 2)} mm ${f.material.split("@")[0]}`)
      .join(", ") || "none";
  const used = kind === "ideal" ? " · not used by this physics" : "";
  $("#spectrum-note").textContent =
    `${fixed(kV, 0)} kV, behind the filters · mean ${fixed(s.mean_keV, 1)} keV${used}`;
  const places = s.energy_keV.filter((keV) => keV <= Math.max(kV, 1));
  const values = s.photons.slice(0, places.length);
  beam.draw({ places, values, unit: "keV", of: "photons" });
}
on("tab", () => {
  if (store.state) void spectrum(store.state.tube.kV);
});
on("session", () => {
  spectrumOf = null;
});

/** @type {string | null | undefined} */
let listedFor;
on("session", list);
on("samples", list);
on("state", show);
/** @param {State} state */
function show(state) {
  outdatePrediction();
  void spectrum(state.tube.kV);
  put("kV", state.tube.kV, 2);
  put("power", state.tube.power_W, 2);
  const xrays = $button("#beam");
  const { on, ready } = state.tube;
  const is = ready ? "X-rays are ON" : "X-rays warming up";
  xrays.textContent = on ? `${is}: switch off` : "Switch X-rays on";
  xrays.classList.toggle("beam-on", on);
  xrays.title = on ? "Switch X-rays off" : hindered(state) || "Switch X-rays on";
  xrays.disabled = !on && hindered(state) !== "";
  const c = state.camera;
  put("exposure", c.exposure_ms, 3);
  put("averages", c.averages);
  ROI.forEach((k, i) => put(`roi-${k}`, c.roi[i]));
  put("mode", c.mode);
  $("#camera-shape").textContent =
    `${c.shape[1]} × ${c.shape[0]} px, ${fixed(c.pixel_mm * 1000, 1)} µm`;
  const s = state.sample;
  for (const k of SIX) put(`off-${k}`, s.offset[k], 4);
  put("sample", s.name ?? "empty");
  $("#sample-note").textContent = s.size_mm
    ? s.size_mm.map((v) => fixed(v, 1)).join(" × ") + " mm"
    : "";
  if (listedFor !== s.name) {
    listedFor = s.name;
    void list();
  }
}

// What somebody wants to see is theirs alone, and this browser remembers it.
const SHOWN = "flexdt-shown";
/** @typedef {Requests["viewer.layers"]} Seen */

/** @param {Seen} wanted */
const reveal = async (wanted) => {
  if (await command("viewer.layers", wanted))
    keep(SHOWN, JSON.stringify({ ...store.layers, opacity: store.opacity }));
};
on("open", () => {
  const seen = localStorage.getItem(SHOWN);
  if (seen) call("viewer.layers", /** @type {Seen} */ (JSON.parse(seen))).catch(() => {});
});
// A box keeps what was chosen last until the viewer has answered: states that it sent before that
// are older.
/** @type {Map<string, number>} */
const choosing = new Map();

/**
 * @param {string} name
 * @param {boolean} visible
 */
async function showLayer(name, visible) {
  choosing.set(name, (choosing.get(name) ?? 0) + 1);
  await reveal({ [name]: visible });
  choosing.set(name, (choosing.get(name) ?? 1) - 1);
  drawLayers();
}
function drawLayers() {
  for (const [name, visible] of Object.entries(store.layers)) {
    /** @type {HTMLInputElement[]} */
    const boxes = $$(`[data-layer=${name}]`);
    for (const box of boxes) if (!choosing.get(name)) box.checked = visible;
  }
  opacity.value = String(store.opacity);
}
on("layers", drawLayers);
