// The Setup tab: tube, camera, sample on the stage (with upload), layers of the scene.
import { $, base64, el, fixed } from "./dom.js";
import { call, command, emit, on, store } from "./link.js";

const CHUNK = 3 << 20;
const MODES = ["HW1SW1High", "HW2SW1High", "HW2SW2High", "HW1SW1Low", "HW2SW1Low", "HW2SW2Low"];
const FORMATS = ["stl", "obj", "ply", "glb", "off"];
const LAYERS = { beam: "X-ray cone", panel: "image on the panel", axis: "axis, piercing point", ranges: "travel ranges", bodies: "collision bodies", sample: "sample", machine: "machine", orbit: "planned trajectory", gizmos: "handles to drag" };
const touched = new Set();
const number = (id, attributes = {}) => {
  const input = el("input", { type: "number", id, step: "any", ...attributes });
  input.addEventListener("input", () => touched.add(id));
  input.addEventListener("keydown", (e) => { if (e.key === "Enter") input.closest(".card").querySelector("[data-apply]")?.click(); });
  return input;
};
const label = (text, ...inputs) => [el("label", { class: "muted" }, text), inputs.length === 1 ? inputs[0] : el("div", { class: inputs.length === 4 ? "quad" : "triple" }, ...inputs)];

const tube = el("div", { class: "card" }, el("h3", {}, "X-ray tube"), el("div", { class: "form" },
  ...label("voltage [kV]", number("kV")), ...label("power [W]", number("power")),
  el("button", { id: "tube-apply", "data-apply": "", class: "small", onclick: setTube }, "Apply"), el("button", { id: "beam", onclick: () => command("tube.set", { on: !store.state.tube.on }, "The tube refuses") }, "X-rays on")));
const camera = el("div", { class: "card" }, el("h3", {}, "Camera"), el("div", { class: "form" },
  ...label("exposure [ms]", number("exposure")),
  ...label("mode", el("select", { id: "mode", onchange: () => touched.add("mode") }, ...MODES.map((m) => el("option", {}, m)))),
  ...label("averages", number("averages", { min: 1, step: 1 })),
  ...label("ROI l t r b", ...["roi-l", "roi-t", "roi-r", "roi-b"].map((id) => number(id, { step: 1 }))),
  el("button", { id: "camera-apply", "data-apply": "", class: "small", onclick: setCamera }, "Apply"), el("span", { id: "camera-shape", class: "muted mono" })));
const sample = el("div", { class: "card" }, el("h3", {}, "Sample"), el("div", { class: "form" },
  ...label("on the stage", el("select", { id: "sample" })),
  ...label("shift x y z", number("off-x"), number("off-y"), number("off-z")),
  ...label("turn x y z [°]", number("off-rx"), number("off-ry"), number("off-rz")),
  el("button", { id: "sample-apply", "data-apply": "", class: "small", onclick: setSample }, "Put on stage"), el("span", { id: "sample-note", class: "muted" }),
  ...label("opacity", el("input", { type: "range", id: "opacity", min: 0.1, max: 1, step: 0.05, value: 0.6, onchange: (e) => command("viewer.layers", { opacity: Number(e.target.value) }) }))));
const upload = el("div", { class: "card" }, el("h3", {}, "Upload a mesh"), el("div", { class: "form" },
  ...label("file", el("input", { type: "file", id: "mesh-file", accept: FORMATS.map((f) => `.${f}`).join(",") })),
  ...label("unit", el("select", { id: "mesh-unit" }, ...["mm", "um", "cm", "m", "inch"].map((u) => el("option", {}, u)))),
  ...label("material", el("select", { id: "mesh-material" })),
  el("button", { id: "mesh-upload", class: "small", onclick: sendMesh }, "Upload"), el("span", { id: "mesh-note", class: "muted" })));
const layers = el("div", { class: "card" }, el("h3", {}, "Shown in the scenes"), ...Object.entries(LAYERS).map(([name, text]) =>
  el("div", {}, el("label", {}, el("input", { type: "checkbox", id: `layer-${name}`, onchange: (e) => command("viewer.layers", { [name]: e.target.checked }) }), text))));
$("#tab-setup").append(tube, camera, sample, upload, layers);

function changed(ids) { return ids.filter((id) => touched.has(id)); }
function put(id, value, digits = 0) {
  const input = $(`#${id}`);
  if (touched.has(id) || document.activeElement === input) return;
  const text = typeof value === "number" ? String(Number(value.toFixed(digits))) : value;
  if (input.value !== text) input.value = text;
}
function done(ids) { for (const id of ids) touched.delete(id); }

async function setTube() {
  const params = {};
  if (touched.has("kV")) params.kV = Number($("#kV").value);
  if (touched.has("power")) params.power_W = Number($("#power").value);
  if (Object.keys(params).length) await command("tube.set", params, "The tube refuses");
  done(["kV", "power"]);
}
async function setCamera() {
  const roi = ["roi-l", "roi-t", "roi-r", "roi-b"], params = {};
  if (touched.has("exposure")) params.exposure_ms = Number($("#exposure").value);
  if (touched.has("averages")) params.averages = Number($("#averages").value);
  if (touched.has("mode")) params.mode = $("#mode").value;
  if (changed(roi).length) params.roi = roi.map((id) => Number($(`#${id}`).value));
  if (Object.keys(params).length) await command("camera.set", params, "The camera refuses");
  done(["exposure", "averages", "mode", ...roi]);
}
async function setSample() {
  const offset = {};
  for (const k of ["x", "y", "z", "rx", "ry", "rz"]) offset[k] = Number($(`#off-${k}`).value) || 0;
  const answer = await command("sample.set", { name: $("#sample").value, offset }, "The sample stays");
  done(["sample", "off-x", "off-y", "off-z", "off-rx", "off-ry", "off-rz"]);
  for (const warning of answer?.warnings ?? []) emit("note", "warning-note", "Sample", warning);
}

export async function sendMesh() {
  const file = $("#mesh-file").files[0], note = $("#mesh-note");
  if (!file) { emit("note", "warning-note", "Upload", "choose a file first"); return; }
  const format = file.name.split(".").pop().toLowerCase();
  if (!FORMATS.includes(format)) { emit("note", "error", "Upload", `${file.name}: allowed are ${FORMATS.join(", ")}`); return; }
  const name = file.name.replace(/\.[^.]*$/, "").replace(/[^\w.-]+/g, "-") || "mesh", total = file.size;
  const common = { name, format, total, unit: $("#mesh-unit").value, material: $("#mesh-material").value || null };
  for (let start = 0; start < total; start += CHUNK) {
    note.textContent = `${Math.round((100 * start) / total)} %`;
    const data = base64(await file.slice(start, start + CHUNK).arrayBuffer());
    const answer = await command("viewer.mesh", { ...common, start, data }, `${file.name} was not taken`);
    if (answer === null) { note.textContent = ""; return; }
    for (const warning of answer.warnings ?? []) emit("note", "warning-note", name, warning);
  }
  note.textContent = "uploaded";
  await list();
  if (await command("sample.set", { name }, "The sample stays")) emit("note", "good", "Sample", `${name} is on the stage`);
}

export async function list() {
  let answer;
  try { answer = await call("sample.list"); } catch { return; }
  const select = $("#sample"), chosen = touched.has("sample") ? select.value : store.state?.sample.name ?? "empty";
  select.textContent = "";
  for (const s of answer.samples) select.append(el("option", { value: s.name, title: s.description }, s.uploaded ? `${s.name} (uploaded)` : s.name));
  if (![...select.options].some((o) => o.value === chosen)) select.append(el("option", { value: chosen }, chosen));
  select.value = chosen;
  const materials = $("#mesh-material");
  if (materials.options.length !== answer.materials.length) { materials.textContent = ""; for (const m of answer.materials) materials.append(el("option", {}, m)); if (answer.materials.includes("abs")) materials.value = "abs"; }
}
$("#sample").addEventListener("change", () => touched.add("sample"));

let listed;
on("session", list);
on("state", (state) => {
  put("kV", state.tube.kV, 2); put("power", state.tube.power_W, 2);
  const beam = $("#beam");
  beam.textContent = state.tube.on ? "X-rays are ON" : "X-rays on"; beam.classList.toggle("beam-on", state.tube.on);
  const c = state.camera;
  put("exposure", c.exposure_ms, 3); put("averages", c.averages); ["roi-l", "roi-t", "roi-r", "roi-b"].forEach((id, i) => put(id, c.roi[i]));
  const mode = $("#mode");
  if (!touched.has("mode") && mode.value !== c.mode) { if (![...mode.options].some((o) => o.value === c.mode)) mode.append(el("option", {}, c.mode)); mode.value = c.mode; }
  $("#camera-shape").textContent = `${c.shape[1]} × ${c.shape[0]} px, ${fixed(c.pixel_mm * 1000, 1)} µm`;
  const s = state.sample;
  for (const k of ["x", "y", "z", "rx", "ry", "rz"]) put(`off-${k}`, s.offset[k], 4);
  $("#sample-note").textContent = s.size_mm ? s.size_mm.map((v) => fixed(v, 1)).join(" × ") + " mm" : "";
  if (listed !== s.name) { listed = s.name; list(); }
});
on("layers", () => { for (const [name, visible] of Object.entries(store.layers)) { const box = $(`#layer-${name}`); if (box) box.checked = visible; } $("#opacity").value = store.opacity; });
