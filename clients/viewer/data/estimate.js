// How long a scan still takes: said only where what was said before has come true.

const LEAST_PART = 0.02;
// Part of what is left, and seconds, by which the ends that were foretold may differ.
const AGREE_PART = 0.2;
const AGREE_S = 1;

/**
 * @typedef {object} Work
 * @property {string} job
 * @property {string} state
 * @property {number} frames_done
 * @property {number} frames_total
 * @property {number} elapsed_s
 * @property {number | null} remaining_s
 * @property {number | string} speed_up
 */

/**
 * The part of a scan that is done, from 0 to 1: of its images where nothing but they takes time,
 * else of its plan.
 * @param {Work} job
 * @returns {number}
 */
function part({ speed_up, frames_done, frames_total, elapsed_s, remaining_s }) {
  if (speed_up === "max" || remaining_s === null)
    return frames_total ? frames_done / frames_total : 0;
  const whole = elapsed_s + remaining_s;
  return whole ? elapsed_s / whole : 0;
}

/**
 * Follows one scan after the other; told a status and our clock [s], it says how many seconds are
 * left, or null while that is not known: all ends that were foretold in the second half of the
 * time so far must agree.
 * @returns {(job: Work, now_s: number) => number | null}
 */
export function estimates() {
  let of = "";
  let from = { now_s: 0, done: 0 };
  /** @type {Array<{ now_s: number; end_s: number }>} */
  let foretold = [];
  return (job, now_s) => {
    const key = `${job.job} ${job.state}`;
    const done = part(job);
    if (key !== of || done < from.done) {
      of = key; // after a pause it is measured anew
      from = { now_s, done };
      foretold = [];
    }
    if (job.state !== "running" || done - from.done < LEAST_PART) return null;
    const took_s = now_s - from.now_s;
    const left_s = (took_s * (1 - done)) / (done - from.done);
    const end_s = now_s + left_s;
    foretold = foretold.filter((one) => one.now_s >= from.now_s + took_s / 2);
    foretold.push({ now_s, end_s });
    const near = AGREE_S + AGREE_PART * left_s;
    const half = foretold[0].now_s <= from.now_s + 0.75 * took_s;
    return half && foretold.every((one) => Math.abs(one.end_s - end_s) <= near) ? left_s : null;
  };
}
