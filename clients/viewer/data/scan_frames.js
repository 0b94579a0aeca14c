// Thumbnails of the running scan's images.
import { $, el, putGrey } from "./dom.js";
import { isOver } from "./job_words.js";
import { on, store } from "./link.js";
/** @import { JobStatus, Shown } from "../web/viewer.d.ts" */

const MAX_THUMBS = 40;
const WIDTH_PX = 124;
// The last image may come a little after the scan's end, by our clock, or be of a little after
// it, by the twin's.
const LATE_S = 1.5;
let lastThumb = -1;
let lastImage = 0;
/** @type {{ time_s: number; at_ms: number } | null} */
let ended = null;

on("scan", (fresh) => {
  if (fresh) {
    $("#thumbs").textContent = "";
    lastThumb = -1;
    lastImage = store.received.image;
    ended = null;
  }
  const job = store.job;
  if (!job || !isOver(job) || ended) return;
  ended = { time_s: job.time + LATE_S, at_ms: fresh ? -Infinity : performance.now() };
  thumb();
});
on("image", thumb);

function thumb() {
  const job = store.job;
  const image = store.image;
  if (!job?.frames_done || !image || image.recorded) return;
  if (store.received.image === lastImage || isLate(image)) return;
  const every = Math.max(1, Math.floor(job.frames_total / MAX_THUMBS));
  const number = Math.floor(job.frames_done / every);
  if (number === lastThumb) return;
  lastThumb = number;
  lastImage = store.received.image;
  add(image, job);
}

/**
 * @param {Shown} image
 * @returns {boolean}
 */
function isLate(image) {
  if (!ended) return false;
  return image.time > ended.time_s && performance.now() > ended.at_ms + 1000 * LATE_S;
}

/**
 * @param {Shown} image
 * @param {JobStatus} job
 */
function add(image, job) {
  const [rows, cols] = image.shape;
  const height = Math.max(1, Math.round((WIDTH_PX * rows) / cols));
  const [low, high] = image.window;
  const canvas = el("canvas");
  putGrey(canvas, [height, WIDTH_PX], (k) => {
    const row = Math.floor(((k / WIDTH_PX) | 0) * (rows / height));
    const column = Math.floor(((k % WIDTH_PX) * cols) / WIDTH_PX);
    const value = image.low + image.scale * image.pixels[row * cols + column];
    return Math.min(255, Math.max(0, (255 * (value - low)) / (high - low))) | 0;
  });
  $("#thumb-card").hidden = false;
  $("#thumbs").append(el("figure", {}, canvas, el("figcaption", {}, String(job.frames_done))));
  $("#thumbs").scrollLeft = $("#thumbs").scrollWidth;
}
