// What is said of a scan: its state, who ended it, how long it takes, and what stands elsewhere
// than where it began.
import { fixed, seconds } from "./figures.js";
/** @import { AxisState, JobStatus, State } from "../web/viewer.d.ts" */

/** @type {Array<JobStatus["state"]>} */
const FINAL = ["done", "failed", "aborted", "incomplete"];
const MOVED = 0.01; // mm or degrees
const NAMED_MOTORS = 3;

/**
 * @param {JobStatus} job
 * @returns {boolean}
 */
export const isOver = (job) => FINAL.includes(job.state);

/**
 * Whether it was taken off the queue before its turn: it has no images, no place where it began
 * and no end, and no scan has ended with it.
 * @param {Pick<JobStatus, "state" | "start" | "frames_done">} job
 * @returns {boolean}
 */
export const neverBegan = ({ state, start, frames_done: done }) =>
  state === "aborted" && !start && !done;

/**
 * Whether images of it are missing that `job.resume` makes.
 * @param {JobStatus} job
 * @returns {boolean}
 */
export const isUnfinished = (job) => isOver(job) && job.state !== "done" && !neverBegan(job);

/**
 * What a scan that was just submitted does, by its own status among all that the twin knows.
 * @param {string} job
 * @param {JobStatus[]} all
 * @returns {string}
 */
export function submittedWords(job, all) {
  const mine = all.find((each) => each.job === job);
  const name = mine?.name || job;
  if (!mine) return `${name} is in the queue`;
  if (isOver(mine)) return `${name} is ${neverBegan(mine) ? "off the queue" : mine.state}`;
  const before = all.filter((each) => each !== mine && !isOver(each)).length;
  if (mine.state === "queued" && before) return `${name} waits: ${before} before it`;
  return `${name} begins`;
}

/**
 * @param {JobStatus} job
 * @returns {string}
 */
export const problem = (job) =>
  typeof job.error?.message === "string" ? job.error.message : "";

/**
 * @param {JobStatus} job
 * @param {(name: string) => string} doer
 * @returns {string}
 */
export function stateWords(job, doer) {
  const by = job.ended_by;
  if (neverBegan(job)) return "taken off the queue";
  if (job.state === "aborted" && by) return `aborted by ${doer(by)}`;
  if (isOver(job)) return job.state;
  const pace =
    job.speed_up === "max" ? " · max" : job.speed_up === 1 ? "" : ` · ${job.speed_up}×`;
  return `${job.state}${pace}`;
}

/**
 * The part that is done, from 0 to 1.
 * @param {JobStatus} job
 * @returns {number}
 */
export function progress(job) {
  if (job.frames_total) return job.frames_done / job.frames_total;
  return job.state === "done" ? 1 : 0;
}

/**
 * What a scan took, or how long it still takes, where that is known.
 * @param {JobStatus} job
 * @param {number | null} left_s
 * @returns {string}
 */
export function timeLeft(job, left_s) {
  if (neverBegan(job)) return "";
  if (isOver(job)) return seconds(job.elapsed_s);
  return left_s === null ? "" : `${seconds(left_s)} left`;
}

/** @typedef {Record<string, Pick<AxisState, "position" | "moving" | "unit">>} Axes */

/**
 * @typedef {object} Moved
 * @property {string} motor
 * @property {number} now
 * @property {number} start
 */

/**
 * The motors that do not stand where they stood when the scan began.
 * @param {JobStatus} job
 * @param {Axes} axes
 * @returns {Moved[]}
 */
export function moved(job, axes) {
  const known = Object.entries(job.start ?? {}).filter(([motor]) => motor in axes);
  const all = known.map(([motor, start]) => ({ motor, now: axes[motor].position, start }));
  return all.filter(({ now, start }) => Math.abs(now - start) > MOVED);
}

/**
 * The command's numbers with two decimals at most, as the page has them.
 * @param {string} what
 */
const rounded = (what) =>
  what.replace(/-?\d+\.\d{3,}/g, (value) => fixed(Number(value), 2).replace("-", "−"));

/**
 * What the scan does, or what it has left behind.
 * @param {JobStatus} job
 * @param {State | null} state
 * @returns {string}
 */
export function whatWords(job, state) {
  if (!isOver(job)) {
    if (state?.projector && job.state === "running") return `waits: ${state.projector}`;
    return problem(job) || `${job.line ? `line ${job.line}: ` : ""}${rounded(job.what)}`;
  }
  const why = job.state === "done" ? "" : problem(job);
  const stands = job.state === "done" || !state ? [] : [xrays(state), places(job, state)];
  return [why, ...stands].filter(Boolean).join(" · ");
}

/**
 * @param {State} state
 * @returns {string}
 */
function xrays({ tube }) {
  return tube.on ? "X-rays are on" : "X-rays are off";
}

/**
 * @param {JobStatus} job
 * @param {State} state
 * @returns {string}
 */
function places(job, { axes }) {
  if (!job.start) return ""; // it has not begun anywhere
  const all = moved(job, axes);
  if (!all.length) return "everything stands where it began";
  const words = all.slice(0, NAMED_MOTORS).map(({ motor, now, start }) => {
    const unit = axes[motor].unit === "deg" ? "°" : " mm";
    return `${motor} at ${fixed(now, 2)}${unit}, began at ${fixed(start, 2)}${unit}`;
  });
  const more = all.length - words.length;
  return `${words.join(", ")}${more > 0 ? `, and ${more} more motors` : ""}`;
}
