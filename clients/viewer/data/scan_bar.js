// The scan in the bar: how far it is, what it waits for or who ended it, and what can be done
// now.
import { $, $button, clicks, setText } from "./dom.js";
import { command, doer, emit, on, store } from "./link.js";
import {
  isOver,
  isUnfinished,
  moved,
  progress,
  stateWords,
  timeLeft,
  whatWords,
} from "./job_words.js";
import { estimates } from "./estimate.js";
import { forgetJob } from "./scan_job.js";
import { folder, open as openData } from "./data.js";
import { hindered } from "./warnings.js";
/** @import { JobStatus } from "../web/viewer.d.ts" */

const bar = $("#scan-bar");
const left = estimates();
let dismissed = ""; // the ended scan that a person has put away

for (const action of /** @type {const} */ (["pause", "resume", "step", "abort"])) {
  const act = () => command(`job.${action}`, { job: store.job?.job }, `Cannot ${action}`);
  clicks({ [`job-${action}`]: act });
}
clicks({
  "job-forget": forgetJob,
  "job-back": backToStart,
  "job-close": () => {
    dismissed = store.job?.job ?? "";
    draw();
  },
  "job-data": () => {
    emit("show-tab", "data");
    void openData(folder(store.job), null, true);
  },
});

/** Every motor where it stood when the scan began, around obstacles. */
async function backToStart() {
  const targets = store.job?.start;
  if (targets) await command("axes.move", { targets, plan: true }, "The motors stay");
}

function draw() {
  const job = store.job;
  if (job && !isOver(job)) dismissed = "";
  bar.hidden = job === null || job.job === dismissed;
  if (!job) return;
  setText($("#job-name"), job.name || job.job);
  setText($("#job-state"), stateWords(job, doer));
  setText($("#job-frames"), `${job.frames_done} / ${job.frames_total} frames`);
  setText($("#job-left"), timeLeft(job, left(job, performance.now() / 1000)));
  const what = whatWords(job, store.twin ? store.state : null);
  setText($("#job-what"), what);
  $("#job-what").title = what;
  drawProgress(job);
  offer(job);
}

/** @param {JobStatus} job */
function drawProgress(job) {
  const meter = $("#job-bar");
  const percent = 100 * progress(job);
  meter.className = `progress ${isUnfinished(job) ? "failed" : job.state}`;
  meter.setAttribute("aria-valuenow", percent.toFixed(0));
  $("i", meter).style.width = `${percent.toFixed(1)}%`;
}

/**
 * The buttons of what can be done with the scan now.
 * @param {JobStatus} job
 */
function offer(job) {
  const over = isOver(job);
  /** @type {Record<string, boolean>} */
  const shown = {
    pause: !over,
    step: !over,
    abort: !over,
    resume: over ? isUnfinished(job) && job.frames_done < job.frames_total : true,
    scrub: over,
    data: over,
    forget: over,
    close: over,
    back: over && store.state !== null && moved(job, store.state.axes).length > 0,
  };
  $("#scan-bar").toggleAttribute("data-over", over);
  for (const [name, visible] of Object.entries(shown))
    $button(`#job-${name}`).hidden = !visible;
  $button("#job-pause").disabled = job.state !== "running";
  const down = hindered(store.state) !== "";
  $button("#job-step").disabled = down || job.state !== "paused";
  $button("#job-resume").disabled = down || (job.state !== "paused" && !isUnfinished(job));
  $button("#job-back").disabled = down || Boolean(store.state?.job);
}
on("scan", draw);
on("state", draw);
on("session", draw);
on("connection", draw);
