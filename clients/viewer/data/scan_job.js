// The scan that runs, waits or has ended last: followed by the twin's events, by its states, and
// by asking where an end was not heard of.
import { allJobs, call, command, doer, emit, Failure, on, store } from "./link.js";
import { isOver, isUnfinished, neverBegan, problem, submittedWords } from "./job_words.js";
/** @import { JobStatus } from "../web/viewer.d.ts" */

const ASK_AGAIN_MS = 1000;
const UNKNOWN_JOB = -32602;

// Jobs come in events of their own and inside states, which may be a little older: those change
// nothing. A twin that starts again counts from 0.
let toldAt_s = -Infinity;
on("connection", () => {
  if (!store.twin) toldAt_s = -Infinity;
});

/** @param {JobStatus} job */
function show(job) {
  const last = store.job;
  const fresh = last?.job !== job.job;
  if (fresh && job.state === "queued" && last && !isOver(last)) return; // its turn comes
  const older = job.time < toldAt_s || (job.time === toldAt_s && last !== null && isOver(last));
  if (!fresh && older) return;
  if (neverBegan(job)) {
    if (!fresh) forget();
    return; // no scan has ended with it
  }
  toldAt_s = job.time;
  store.job = job;
  emit("scan", fresh);
}
function forget() {
  store.job = null;
  emit("scan", true);
}

/**
 * A stop that somebody commanded is no failure: the bar says that the scan is paused.
 * @param {JobStatus} job
 * @returns {boolean}
 */
function isMeant(job) {
  const asked = /** @type {{ asked?: string } | undefined} */ (job.error?.data)?.asked ?? "";
  return job.state === "paused" && ["stop", "E-stop"].includes(asked);
}
on("job", (job) => {
  const before = store.job;
  const news = before?.job === job.job && before.state !== job.state;
  show(job);
  if (news && job.error && !isMeant(job)) {
    emit("note", "error", `Scan ${job.state}`, problem(job));
  }
  const by = job.state === "aborted" && job.ended_by ? doer(job.ended_by) : "you";
  if (news && by !== "you") emit("note", "warning-note", "Scan aborted", `by ${by}`);
});
on("state", (state) => {
  if (state.job) show(state.job);
  else if (store.job && !isOver(store.job)) void catchUp();
});

// No scan runs, and its end was not heard of: the connection was away meanwhile.
let askedAt_ms = -Infinity;
async function catchUp() {
  const job = store.job?.job;
  if (job === undefined || performance.now() < askedAt_ms + ASK_AGAIN_MS) return;
  askedAt_ms = performance.now();
  const status = await call("job.status", { job }).catch((/** @type {unknown} */ error) =>
    error instanceof Failure && error.code === UNKNOWN_JOB ? null : undefined,
  );
  if (store.job?.job !== job || status === undefined) return;
  if (status) show(status);
  else forget(); // a twin that knows nothing of it
}
// A page that was just opened, or a twin that was started again: the last scan, if it is
// unfinished.
on("session", async () => {
  const status = await call("job.status").catch(() => null);
  if (status && !store.job && isUnfinished(status)) show(status);
});

/**
 * Says what a scan does that this page has just submitted: it may have to wait.
 * @param {string} title
 * @param {string} job
 * @param {string} [of] whose it is
 */
export async function tellSubmitted(title, job, of = "") {
  const all = await allJobs().catch(() => []);
  emit("note", "good", title, `${of && `${of}: `}${submittedWords(job, all)}`);
}

export async function forgetJob() {
  const job = store.job?.job;
  if (job === undefined || !(await command("job.forget", { job }, "The job stays"))) return;
  forget();
}
