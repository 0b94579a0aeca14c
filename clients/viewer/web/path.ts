// From a sample to its volume: a designed scan in the present geometry, a volume that grows meanwhile, and the full one beside the truth.
import { $, $button, $select, clicks, el } from "./dom.js";
import { command, emit, on, store } from "./link.js";
import { folder } from "./data.js";
import { reconstruct, watch } from "./volume.js";

// Words, images of one turn, exposure [ms].
const QUALITIES: Array<[words: string, frames: number, exposure_ms: number]> = [["quick: 91 images", 91, 100], ["good: 181 images", 181, 100], ["fine: 361 images", 361, 200]];
const sample = $select("#path-sample"), quality = $select("#path-quality"), again = $button("#path-volume");
quality.append(...QUALITIES.map(([words], k) => el("option", { value: k }, words)));
let mine: string | null = null;

on("state", ({ sample: now }) => {
  const offered = [...$select("#sample").options].map((o) => o.value).filter(Boolean), names = [...new Set([now.name ?? "", ...offered])].filter(Boolean), key = names.join("\n");
  if (sample.dataset.names === key || document.activeElement === sample) return;
  sample.dataset.names = key;
  sample.replaceChildren(...names.map((name) => el("option", { value: name }, name)));
});
async function scan() {
  const [, frames, exposure_ms] = QUALITIES[Number(quality.value)], none = "No scan";
  again.hidden = true; $button("#path-scan").disabled = true;
  try {
    if (sample.value && sample.value !== store.state?.sample.name && !(await command("sample.set", { name: sample.value }, none))) return;
    const made = await command("viewer.compose", { kind: "fly", frames, exposure_ms }, none);
    const job = made && (await command("script.submit", { text: made.text, speed_up: "max" }, none));
    if (!job) return;
    mine = job.job;
    watch();
    emit("note", "good", "Scan", `${sample.value}: ${job.job} has begun`);
  } finally { $button("#path-scan").disabled = false; }
}
// The scan that has ended last here, or that a data set shows.
const ended = () => (store.job?.job === mine && store.job?.state === "done" ? folder(store.job) : null);
on("job", () => { again.hidden = ended() === null; });
clicks({ "path-scan": scan, "path-volume": () => { const name = ended(); if (name) { again.hidden = true; reconstruct(name, true); } } });
$("#volume-path").addEventListener("change", () => { again.hidden = true; });
