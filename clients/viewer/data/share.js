// The Share tab: pictures, files that open anywhere, scenes to save and load.
import {
  $input,
  $select,
  bytes,
  chosen,
  clicks,
  download,
  downloadBlob,
  words,
} from "./dom.js";
import { command, emit } from "./link.js";
import { captioned } from "./captioned.js";
import { picture } from "./film.js";
import { current } from "./views.js";
/** @import { Export, Requests, Scene } from "../web/viewer.d.ts" */

/**
 * @template {"viewer.screenshot" | "viewer.export"} M
 * @param {M} method
 * @param {Requests[M]} params
 * @param {string} title
 */
export async function offer(method, params, title) {
  const a = await command(method, params, title);
  if (!a) return;
  download(a.url, a.name);
  emit("note", "good", a.name, bytes(a.bytes));
}
function shot() {
  if (current === "none") {
    emit("note", "error", "No picture", "open a view first");
    return;
  }
  const [width, height] = $select("#shot-size").value.split("x").map(Number);
  void offer(
    "viewer.screenshot",
    { view: current === "four" ? "iso" : (current ?? "iso"), width, height },
    "No picture",
  );
}
async function film() {
  const png = picture();
  if (!png) {
    emit("note", "error", "No picture", "no radiograph has come yet");
    return;
  }
  const made = await captioned(png).catch((/** @type {unknown} */ error) => words(error));
  if (typeof made === "string") emit("note", "error", "No picture", made);
  else downloadBlob(made, "flexdt-radiograph.png");
}

/** @param {Export["format"]} format */
const exported =
  (format, replay = false) =>
  () =>
    offer("viewer.export", { format, replay }, replay ? "No replay" : "No export");
async function save() {
  const a = await command("scene.save", {}, "Not saved");
  if (!a) return;
  const scene = new Blob([JSON.stringify(a.document, null, 2)], { type: "application/json" });
  downloadBlob(
    scene,
    `flexdt-scene-${new Date().toISOString().slice(0, 19).replace(/[:T]/g, "-")}.json`,
  );
}
clicks({
  shot: shot,
  "shot-film": film,
  "export-html": exported("html"),
  "export-viser": exported("viser"),
  "replay-html": exported("html", true),
  "replay-viser": exported("viser", true),
  "scene-save": save,
  "scene-load": () => $input("#scene-file").click(),
});
chosen($input("#scene-file"), async (file) => {
  try {
    if (
      await command(
        "scene.load",
        { document: /** @type {Scene} */ (JSON.parse(await file.text())) },
        "Not loaded",
      )
    )
      emit("note", "good", "Scene", `${file.name} is loaded`);
  } catch (error) {
    emit("note", "error", "Scene", `${file.name}: ${words(error)}`);
  }
});
