// Values that others follow: a signal is set, a computed value is what its function says of
// other values, and an effect runs again whenever a value that it has read is another one.

/**
 * @typedef {object} Follower
 * @property {() => void} run
 * @property {Set<Set<Follower>>} of
 */

/** @type {Follower | null} */
let reading = null;
let held = 0;
/** @type {Set<Follower>} */
const due = new Set();

/**
 * @template T
 * @typedef {object} Signal
 * @property {() => T} get
 * @property {(value: T) => void} set
 */

/**
 * @template T
 * @typedef {Pick<Signal<T>, "get">} Readable
 */

/**
 * @template T
 * @param {T} value
 * @returns {Signal<T>}
 */
export function signal(value) {
  /** @type {Set<Follower>} */
  const followers = new Set();
  return {
    get: () => {
      if (reading) {
        followers.add(reading);
        reading.of.add(followers);
      }
      return value;
    },
    set: (next) => {
      if (Object.is(next, value)) return;
      value = next;
      batch(() => {
        for (const follower of followers) due.add(follower);
      });
    },
  };
}

/**
 * Runs `work` now, and again whenever a value that it has read changes; returns what ends it.
 * @param {() => unknown} work
 * @returns {() => void}
 */
export function effect(work) {
  /** @type {Follower} */
  const me = { run, of: new Set() };
  function forget() {
    for (const followers of me.of) followers.delete(me);
    me.of.clear();
  }
  function run() {
    forget();
    const before = reading;
    reading = me;
    try {
      work();
    } finally {
      reading = before;
    }
  }
  run();
  return () => {
    forget();
    due.delete(me);
  };
}

/**
 * @template T
 * @param {() => T} f
 * @returns {Readable<T>}
 */
export function computed(f) {
  const value = signal(/** @type {T} */ (undefined));
  effect(() => {
    value.set(f());
  });
  return value;
}

/**
 * Sets several values; effects run once, after the last.
 * @param {() => void} work
 */
export function batch(work) {
  held++;
  try {
    work();
    if (held > 1) return;
    while (due.size) {
      const [next] = due;
      due.delete(next);
      next.run();
    }
  } finally {
    held--;
  }
}
