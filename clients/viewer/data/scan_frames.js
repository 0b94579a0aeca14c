// Thumbnails of the running scan: images as they were saved, each by the name of its file.
import { $, $$, el, pressed, putImage, setText } from "./dom.js";
import { folder, open as openData } from "./data.js";
import { isOver } from "./job_words.js";
import { call, on, store } from "./link.js";
import { nameOf } from "./moment.js";
/** @import { Answers } from "../web/viewer.d.ts" */

const MAX_THUMBS = 40;
// Of a scan that was over before its images came here.
const LEAST_THUMBS = 5;
const WIDTH_PX = 124;
let dataset = "";
let asking = false;
/** @type {Set<number>} */
let steps = new Set();

on("scan", (fresh) => {
  const job = store.job;
  if (fresh) {
    $("#thumbs").textContent = "";
    $("#thumb-card").hidden = true;
    steps = new Set();
    dataset = job ? folder(job) : "";
    setText($("#thumbs-of"), `Some images of ${dataset}`);
  }
  if (job?.state === "done" && steps.size < LEAST_THUMBS) void fill(job.frames_total);
});
// A live image of the scan says which file it was saved as: of every n-th that file is shown.
on("image", (image) => {
  const job = store.job;
  const index = image?.origin?.index ?? null;
  if (!job || isOver(job) || index === null) return;
  if (!asking && image?.origin?.dataset === dataset) void show(index, job.frames_total);
});

/** @param {number} total */
async function fill(total) {
  for (let k = 0; k < LEAST_THUMBS; k++)
    await show(Math.floor(((k + 0.5) * total) / LEAST_THUMBS), total);
}

/**
 * @param {number} index
 * @param {number} total
 */
async function show(index, total) {
  const step = Math.floor(index / Math.max(1, Math.floor(total / MAX_THUMBS)));
  if (steps.has(step)) return;
  steps.add(step);
  asking = true;
  const asked = { name: dataset, index, side: WIDTH_PX };
  const small = await call("viewer.thumbnail", asked).catch(() => null);
  asking = false;
  if (small?.name === dataset) add(small);
}

/** @param {Answers["viewer.thumbnail"]} small */
function add({ name, file, index, image }) {
  $("#thumb-card").hidden = false;
  const open = pressed(() => openData(name, index, true));
  const told = { ...open, "data-index": index, "data-file": file, title: `${file} of ${name}` };
  const picture = putImage(el("canvas"), image);
  const made = el("figure", told, picture, el("figcaption", {}, nameOf(file)));
  const later = $$("#thumbs figure").find((one) => Number(one.dataset.index) > index);
  $("#thumbs").insertBefore(made, later ?? null);
  if (!later) $("#thumbs").scrollLeft = $("#thumbs").scrollWidth;
}
