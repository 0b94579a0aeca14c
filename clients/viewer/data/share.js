// The Share tab: pictures, files that open anywhere, scenes to save and load.
import { $, $input, $select, bytes, chosen, download, el, words } from "./dom.js";
import { command, emit } from "./link.js";
import { picture } from "./film.js";
import { current } from "./views.js";
export async function offer(method, params, title) {
    const a = await command(method, params, title);
    if (!a)
        return;
    download(a.url, a.name);
    emit("note", "good", a.name, bytes(a.bytes));
}
function shot() {
    if (current === "none") {
        emit("note", "error", "No picture", "open a view first");
        return;
    }
    const [width, height] = $select("#shot-size").value.split("x").map(Number);
    void offer("viewer.screenshot", { view: current === "four" ? "iso" : current ?? "iso", width, height }, "No picture");
}
function film() {
    const png = picture();
    if (png)
        download(png, "flexdt-radiograph.png");
    else
        emit("note", "error", "No picture", "no radiograph has come yet");
}
const exported = (format, replay = false) => () => offer("viewer.export", { format, replay }, replay ? "No replay" : "No export");
async function save() {
    const a = await command("scene.save", {}, "Not saved");
    if (!a)
        return;
    const url = URL.createObjectURL(new Blob([JSON.stringify(a.document, null, 2)], { type: "application/json" }));
    download(url, `flexdt-scene-${new Date().toISOString().slice(0, 19).replace(/[:T]/g, "-")}.json`);
    setTimeout(() => URL.revokeObjectURL(url), 10000);
}
const button = (id, text, f) => el("button", { id, class: "small", onclick: f }, text);
const row = (...nodes) => el("div", { class: "row", style: "flex-wrap:wrap" }, ...nodes);
$("#tab-share").append(el("div", { class: "card" }, el("h2", {}, "Picture of a view"), row(el("select", { id: "shot-size", "aria-label": "Size of the picture" }, ...["1280x800", "1920x1080", "3840x2160"].map((s) => el("option", {}, s))), button("shot", "Save PNG", shot), button("shot-film", "Radiograph PNG", film))), el("div", { class: "card" }, el("h2", {}, "The scene as it stands"), row(button("export-html", "One HTML file", exported("html")), button("export-viser", ".viser", exported("viser"))), el("p", { class: "muted" }, "The HTML opens in any browser, without a server.")), el("div", { class: "card" }, el("h2", {}, "A scan as a replay"), row(button("replay-html", "One HTML file", exported("html", true)), button("replay-viser", ".viser", exported("viser", true))), el("p", { class: "muted" }, "Of the script that was last scrubbed in the Scan tab.")), el("div", { class: "card" }, el("h2", {}, "Scenes"), row(button("scene-save", "Save", save), el("input", { type: "file", id: "scene-file", accept: ".json", hidden: true }), button("scene-load", "Load…", () => $input("#scene-file").click())), el("p", { class: "muted" }, "Positions, tube, camera, sample and correction. Loading moves the machine.")));
chosen($input("#scene-file"), async (file) => {
    try {
        if (await command("scene.load", { document: JSON.parse(await file.text()) }, "Not loaded"))
            emit("note", "good", "Scene", `${file.name} is loaded`);
    }
    catch (error) {
        emit("note", "error", "Scene", `${file.name}: ${words(error)}`);
    }
});
