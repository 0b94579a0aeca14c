// Scans that wait, above those that have been made: what comes next stands on top of the list of
// what there is.
import { $, el } from "./dom.js";
import { neverBegan } from "./job_words.js";
import { allJobs, command, emit, on, store } from "./link.js";
/** @import { JobStatus } from "../web/viewer.d.ts" */

const SOON_MS = 200;
const box = $("#data-queue");
/** @type {number | undefined} */
let soon;

/**
 * @param {JobStatus} job
 * @param {number} k place in the queue
 */
function row(job, k) {
  const name = job.name || job.job;
  const take = async () => {
    const answer = await command("job.abort", { job: job.job }, `${name} stays`);
    if (answer && neverBegan(answer)) emit("note", "good", "Scan", `${name} is off the queue`);
  };
  return el(
    "div",
    { class: "data-set queued" },
    el("span", { class: "place", "aria-hidden": "true" }, String(k + 1)),
    el(
      "span",
      {},
      el("b", {}, name),
      el("span", {}, `${job.frames_total} images`),
      el("span", { class: "state queued" }, k ? `waits for ${k} before it` : "comes next"),
    ),
    el(
      "button",
      { class: "small", title: `Take ${name} off the queue`, onclick: () => void take() },
      "Take off",
    ),
  );
}

async function list() {
  if ($("#tab-data").hidden || !store.session) return;
  const jobs = await allJobs().catch(() => null);
  if (!jobs) return;
  const begun = store.job?.state === "queued" ? "" : store.job?.job; // since they were asked for
  const waiting = jobs.filter((job) => job.state === "queued" && job.job !== begun);
  box.replaceChildren(...waiting.map(row));
}

/** Several jobs change at once where one ends and the next begins; a running one tells often. */
function listSoon() {
  soon ??= window.setTimeout(() => {
    soon = undefined;
    void list();
  }, SOON_MS);
}
on("job", listSoon);
on("session", listSoon);
on("tab", listSoon);
