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
 * The plan's own word, where the twin keeps a pace: known from the first second, and believed as
 * long as each step's agrees with the first one's. A status says no more until the next step: in
 * between, time goes by.
 * @returns {(job: Work, now_s: number, fresh: boolean) => number | null}
 */
function planned() {
  let elapsed_s = -1;
  let first_s = Infinity;
  let end_s = Infinity;
  let kept = true;
  return ({ state, speed_up, elapsed_s: at_s, remaining_s }, now_s, fresh) => {
    if (state !== "running" || typeof speed_up !== "number" || remaining_s === null)
      return null;
    if (fresh || at_s !== elapsed_s) {
      elapsed_s = at_s;
      end_s = now_s + remaining_s / speed_up;
      if (fresh) first_s = end_s;
      kept = fresh || (kept && near(end_s, first_s, end_s - now_s));
    }
    return kept && end_s > now_s ? end_s - now_s : null;
  };
}

/** Whether two foretold ends agree, so many seconds before them. */
const near = (/** @type {number} */ a, /** @type {number} */ b, /** @type {number} */ left_s) =>
  Math.abs(a - b) <= AGREE_S + AGREE_PART * left_s;

/**
 * Follows one scan after the other; told a status and our clock [s], it says how many seconds are
 * left, or null while that is not known: by the plan while the twin keeps it, else where all ends
 * that were foretold in the second half of the time so far agree.
 * @returns {(job: Work, now_s: number) => number | null}
 */
export function estimates() {
  const plan = planned();
  let of = "";
  let from = { now_s: 0, done: 0 };
  /** @type {Array<{ now_s: number; end_s: number }>} */
  let foretold = [];
  return (job, now_s) => {
    const key = `${job.job} ${job.state}`;
    const done = part(job);
    const fresh = key !== of || done < from.done;
    const by_plan = plan(job, now_s, fresh);
    if (fresh) {
      of = key; // after a pause it is measured anew
      from = { now_s, done };
      foretold = [];
    }
    if (by_plan !== null) return by_plan;
    if (job.state !== "running" || done - from.done < LEAST_PART) return null;
    const took_s = now_s - from.now_s;
    const left_s = (took_s * (1 - done)) / (done - from.done);
    const end_s = now_s + left_s;
    foretold = foretold.filter((one) => one.now_s >= from.now_s + took_s / 2);
    foretold.push({ now_s, end_s });
    const half = foretold[0].now_s <= from.now_s + 0.75 * took_s;
    return half && foretold.every((one) => near(one.end_s, end_s, left_s)) ? left_s : null;
  };
}
