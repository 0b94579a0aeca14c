// The Share tab: pictures, files that open anywhere, scenes to save and load.
import { $, bytes, download, el } from "./dom.js";
import { command, emit, store } from "./link.js";
import { picture } from "./film.js";
import { current } from "./views.js";

const offer = async (method, params, title) => { const a = await command(method, params, title); if (a) { download(a.url, a.name); emit("note", "good", a.name, bytes(a.bytes)); } };
const button = (id, text, f) => el("button", { id, class: "small", onclick: f }, text);
const row = (...nodes) => el("div", { class: "row", style: "flex-wrap:wrap" }, ...nodes);
$("#tab-share").append(
  el("div", { class: "card" }, el("h3", {}, "Picture of a view"), row(
    el("select", { id: "shot-size", "aria-label": "Size of the picture" }, ...["1280x800", "1920x1080", "3840x2160"].map((s) => el("option", {}, s))),
    button("shot", "Save PNG", () => { const [width, height] = $("#shot-size").value.split("x").map(Number); offer("viewer.screenshot", { view: current === "four" ? "iso" : current, width, height }, "No picture"); }),
    button("shot-film", "Radiograph PNG", () => { const png = picture(); if (png) download(png, "flexdt-radiograph.png"); else emit("note", "error", "No picture", "no radiograph has come yet"); }))),
  el("div", { class: "card" }, el("h3", {}, "The scene as it stands"), row(
    button("export-html", "One HTML file", () => offer("viewer.export", { format: "html" }, "No export")), button("export-viser", ".viser", () => offer("viewer.export", { format: "viser" }, "No export"))),
    el("p", { class: "muted" }, "The HTML opens in any browser, without a server.")),
  el("div", { class: "card" }, el("h3", {}, "A scan as a replay"), row(
    button("replay-html", "One HTML file", () => offer("viewer.export", { format: "html", replay: true }, "No replay")), button("replay-viser", ".viser", () => offer("viewer.export", { format: "viser", replay: true }, "No replay"))),
    el("p", { class: "muted" }, "Of the script that was last scrubbed in the Scan tab.")),
  el("div", { class: "card" }, el("h3", {}, "Scenes"), row(
    button("scene-save", "Save", async () => { const a = await command("scene.save", {}, "Not saved"); if (a) { const url = URL.createObjectURL(new Blob([JSON.stringify(a.document, null, 2)], { type: "application/json" })); download(url, `flexdt-scene-${new Date().toISOString().slice(0, 19).replace(/[:T]/g, "-")}.json`); setTimeout(() => URL.revokeObjectURL(url), 10000); } }),
    el("input", { type: "file", id: "scene-file", accept: ".json", hidden: true }), button("scene-load", "Load…", () => $("#scene-file").click())),
    el("p", { class: "muted" }, "Positions, tube, camera, sample and correction. Loading moves the machine.")));
$("#scene-file").addEventListener("change", async (e) => {
  const file = e.target.files[0];
  e.target.value = "";
  try { if (await command("scene.load", { document: JSON.parse(await file.text()) }, "Not loaded")) emit("note", "good", "Scene", `${file.name} is loaded`); }
  catch (error) { emit("note", "error", "Scene", `${file?.name}: ${error.message}`); }
});
