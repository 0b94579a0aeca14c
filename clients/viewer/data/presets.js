// Presets of tube and camera: two for every machine, and those that this browser keeps.
import { $, $button, $input, $select, clicks, el, fixed, keep, setText } from "./dom.js";
import { command, emit, on, store } from "./link.js";
/** @import { Requests, State } from "../web/viewer.d.ts" */

/**
 * What is set together; what is left out stays as it is.
 * @typedef {object} Preset
 * @property {string} name
 * @property {Requests["tube.set"]} [tube]
 * @property {Requests["camera.set"]} camera
 */

/** @type {Preset[]} */
const SHIPPED = [
  { name: "Quick look", camera: { mode: "HW2SW2High", exposure_ms: 50, averages: 1 } },
  { name: "Fine", camera: { mode: "HW1SW1High", exposure_ms: 500, averages: 4 } },
];
const KEPT = "flexdt-presets";
const list = $select("#preset");
const field = $input("#preset-name");

/** @returns {Preset[]} */
function own() {
  try {
    return /** @type {Preset[]} */ (JSON.parse(localStorage.getItem(KEPT) ?? "[]"));
  } catch {
    return []; // another program has written there
  }
}
const all = () => [...SHIPPED, ...own()];
const chosen = () => all().find(({ name }) => name === list.value);

/** @param {Preset} preset */
function wordsOf({ tube, camera }) {
  const mode = [...$select("#mode").options].find((o) => o.value === camera.mode);
  const beam = tube ? [`${fixed(tube.kV, 0)} kV`, `${fixed(tube.power_W, 0)} W`] : [];
  const images = `${fixed(camera.exposure_ms, 0)} ms × ${camera.averages}`;
  return [...beam, mode?.text ?? camera.mode, images].join(" · ");
}

function tell() {
  const preset = chosen();
  setText($("#preset-note"), preset ? wordsOf(preset) : "");
  $button("#preset-use").disabled = !preset;
  $button("#preset-delete").hidden = !own().some(({ name }) => name === list.value);
}

/** @param {string} select */
function draw(select) {
  const none = el("option", { value: "" }, "choose one");
  list.replaceChildren(none, ...all().map(({ name }) => el("option", {}, name)));
  list.value = select;
  if (!chosen()) list.value = "";
  tell();
}

async function use() {
  const preset = chosen();
  if (!preset) return;
  const { tube, camera } = preset;
  if (tube && !(await command("tube.set", tube, "The tube refuses"))) return;
  await command("camera.set", camera, "The camera refuses");
}

/**
 * @param {string} name
 * @param {State} state
 * @returns {Preset}
 */
const asSet = (name, { tube, camera }) => ({
  name,
  tube: { kV: tube.kV, power_W: tube.power_W },
  camera: {
    mode: camera.mode,
    roi: camera.roi,
    exposure_ms: camera.exposure_ms,
    averages: camera.averages,
  },
});

function keepAs() {
  const name = field.value.trim();
  if (!store.state || !name || SHIPPED.some((each) => each.name === name)) {
    emit("note", "error", "Not kept", "give it a name of its own");
    return;
  }
  const others = own().filter((each) => each.name !== name);
  keep(KEPT, JSON.stringify([...others, asSet(name, store.state)]));
  field.value = "";
  draw(name);
}

function forget() {
  keep(KEPT, JSON.stringify(own().filter(({ name }) => name !== list.value)));
  draw("");
}

clicks({ "preset-use": use, "preset-keep": keepAs, "preset-delete": forget });
field.addEventListener("keydown", (e) => {
  if (e.key === "Enter") keepAs();
});
list.addEventListener("change", tell);
on("session", () => draw(list.value));
