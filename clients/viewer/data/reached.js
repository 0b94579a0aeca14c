// A quantity that motors set: where it ends when they end elsewhere.
const ROUNDS = 60;
const CLOSE = 1e-9;

/**
 * The value whose shift of the motors is `by`: the inverse of `shift`, which is monotone and 0 at
 * `now`. NaN where none is found.
 * @param {number} now
 * @param {number} by
 * @param {(value: number) => number} shift
 * @returns {number}
 */
export function reached(now, by, shift) {
  let value = now;
  for (let k = 0; k < ROUNDS; k++) {
    const off = shift(value) - by;
    if (Math.abs(off) < CLOSE) return value;
    const step = 1e-6 * Math.max(1, Math.abs(value));
    let to = (off * step) / (shift(value + step) - shift(value));
    // A step of Newton's may pass the pole of a quotient: it gets nearer, or is halved.
    for (let n = 0; n < ROUNDS && Math.abs(shift(value - to) - by) > Math.abs(off); n++)
      to /= 2;
    value -= to;
  }
  return Math.abs(shift(value) - by) < 1e-3 ? value : NaN;
}
