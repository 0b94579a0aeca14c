// The volume that grows while a scan runs: its three middle slices, from the images so far.
import { $, $canvas, $select, fixed, keep, putImage, setText, words } from "./dom.js";
import { call, on, store } from "./link.js";
import { folder } from "./data.js";
const KEY = "flexdt-volume";
const size = $select("#volume-side"), note = $("#volume-note");
size.addEventListener("change", choose);
size.value = localStorage.getItem(KEY) ?? "";
let asked = null;
function ask() {
    const name = store.job?.dataset && store.job.state !== "queued" ? folder(store.job) : null, wish = size.value && name ? `${name} ${size.value}` : "";
    if (wish === (asked ?? ""))
        return;
    const before = asked;
    asked = wish;
    // The folder comes a moment after the job: what is refused is asked again.
    if (wish || before)
        call("viewer.live", wish ? { name, side: Number(size.value) } : {}).catch((error) => {
            if (asked !== wish)
                return;
            setText(note, words(error));
            setTimeout(() => { if (asked === wish) {
                asked = null;
                ask();
            } }, 1000);
        });
    $(".slices").hidden = true;
    setText(note, wish ? "starting; dark, flat and a first image are needed" : "");
}
function choose() { keep(KEY, size.value); ask(); }
on("job", () => { $("#volume-card").hidden = false; ask(); });
on("state", (s) => { if (s.job) {
    $("#volume-card").hidden = false;
    ask();
} });
on("open", () => { asked = null; });
on("volume", (m) => {
    if (!asked?.startsWith(`${m.name} `))
        return;
    if (m.problem) {
        setText(note, m.problem);
        return;
    }
    $(".slices").hidden = false;
    const other = m.side === Number(size.value) ? "" : `${m.side} voxels a side, as another page chose · `;
    setText(note, `${other}${m.views} of ${m.of} views · voxels of ${fixed(1000 * m.voxel_mm, 0)} µm · ${fixed(m.low, 4)} to ${fixed(m.high, 4)} per mm`);
    for (const [name, slice] of Object.entries(m.slices))
        putImage($canvas(`#slice-${name}`), slice);
});
