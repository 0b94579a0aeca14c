// Three slices of a volume: of the one that grows while a scan runs, or of a past scan's, which is reconstructed on request.
import { $, $button, $canvas, $input, $select, clicks, fixed, keep, putImage, setText, words } from "./dom.js";
import { call, on, store } from "./link.js";
import type { Live } from "./viewer.js";
import { folder } from "./data.js";

const KEY = "flexdt-volume", STARTING = "starting; dark, flat and a first image are needed", SIDES = ["top", "front", "side"] as const;
const size = $select("#volume-side"), note = $("#volume-note"), progress = $<HTMLProgressElement>("#volume-progress");
size.addEventListener("change", choose);
size.value = localStorage.getItem(KEY) ?? "";

// The past scan whose volume is wanted; else it is the running one's.
let past: string | null = null, asked: string | null = null, voxel_mm = 0;
function ask() {
  const running = store.job?.dataset && store.job.state !== "queued" ? folder(store.job) : null, name = past ?? running, wish = size.value && name ? `${name} ${size.value} ${past ? "past" : ""}` : "";
  if (wish === (asked ?? "")) return;
  const before = asked;
  asked = wish;
  // The folder comes a moment after the job: what is refused is asked again.
  if (wish || before) call("viewer.live", wish ? { name, side: Number(size.value) as NonNullable<Live["side"]>, past: past !== null } : {}).catch((error: unknown) => {
    if (asked !== wish) return;
    setText(note, words(error));
    setTimeout(() => { if (asked === wish) { asked = null; ask(); } }, 1000);
  });
  $(".slices").hidden = true; progress.hidden = past === null; progress.value = 0; $button("#volume-cancel").hidden = past === null; setText($button("#volume-cancel"), "Cancel");
  setText($("#volume-title"), past ? `Volume of ${past}` : "Slices so far");
  setText(note, !wish ? "" : past ? "reading the images …" : STARTING);
}
function choose() { if (!size.value) past = null; if (!past) keep(KEY, size.value); ask(); }
function cancel() { past = null; size.value = localStorage.getItem(KEY) ?? ""; ask(); }
clicks({ "volume-cancel": cancel });
on("reconstruct", (name) => {
  past = name;
  size.value ||= "256";
  $("#volume-card").hidden = false; ask();
  $("#volume-card").scrollIntoView({ block: "nearest" });
});
on("job", (job) => {
  $("#volume-card").hidden = false; ask();
  if (note.textContent === STARTING && ["done", "failed", "aborted", "incomplete"].includes(job.state)) setText(note, `the scan has ended (${job.state}) before its first slices`);
});
on("state", (s) => { if (s.job) { $("#volume-card").hidden = false; ask(); } });
on("open", () => { asked = null; });

on("volume", (m) => {
  if (!asked?.startsWith(`${m.name} `) || Boolean(m.past) !== (past !== null)) return;
  if (m.problem) { setText(note, m.problem); progress.hidden = true; return; }
  progress.value = m.done ?? 0;
  const other = m.side === Number(size.value) ? "" : `${m.side} voxels a side, as another page chose · `;
  if (!m.slices) { setText(note, `${other}reconstructing: ${fixed(100 * (m.done ?? 0), 0)} %`); return; }
  progress.hidden = true; setText($button("#volume-cancel"), "Close"); voxel_mm = m.voxel_mm;
  $(".slices").hidden = false;
  setText(note, `${other}${m.views} of ${m.of} views · voxels of ${fixed(1000 * m.voxel_mm, 0)} µm · ${fixed(m.low, 4)} to ${fixed(m.high, 4)} per mm${m.binning ? ` · flexdt reconstruct --binning ${m.binning}` : ""}`);
  for (const side of SIDES) {
    const slider = $input(`#at-${side}`), count = m.size?.[side] ?? 0;
    const grey = m.slices[side];
    if (grey) putImage($canvas(`#slice-${side}`), grey);
    slider.hidden = !count; slider.max = String(count - 1); slider.value = String(Math.floor(count / 2));
    where(side);
  }
});
// Slices are as far apart as voxels are wide, and counted from below, from the source, from the left.
function where(side: string) { const slider = $input(`#at-${side}`); setText($(`#is-${side}`), slider.hidden ? "" : `${fixed((Number(slider.value) - Number(slider.max) / 2) * voxel_mm, 2)} mm`); }
const busy = new Set<string>();
// The newest slice asked for wins; one is on its way at a time.
async function turn(side: (typeof SIDES)[number]) {
  where(side);
  if (busy.has(side)) return;
  busy.add(side);
  const slider = $input(`#at-${side}`), canvas = $canvas(`#slice-${side}`);
  let index = "";
  while (index !== slider.value && !slider.hidden) {
    index = slider.value;
    const s = await call("viewer.slice", { name: side, index: Number(index) }).catch(() => null);
    if (s?.shape && s.data !== undefined && !slider.hidden) { putImage(canvas, { shape: s.shape, data: s.data }); canvas.dataset.index = index; }
  }
  busy.delete(side);
}
for (const side of SIDES) {
  const slider = $input(`#at-${side}`);
  slider.addEventListener("input", () => void turn(side));
  $(`#slice-${side}`).addEventListener("wheel", (e) => {
    if (slider.hidden) return;
    e.preventDefault(); slider.value = String(Number(slider.value) + Math.sign(e.deltaY)); void turn(side);
  }, { passive: false });
}
