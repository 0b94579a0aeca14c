// Values that others follow: a signal is set, a computed value is what its function says of other
// values, and an effect runs again whenever a value that it has read is another one.
interface Follower {
  run: () => void;
  of: Set<Set<Follower>>;
}
let reading: Follower | null = null;
let held = 0;
const due = new Set<Follower>();

export interface Signal<T> {
  get: () => T;
  set: (value: T) => void;
}
export type Readable<T> = Pick<Signal<T>, "get">;

export function signal<T>(value: T): Signal<T> {
  const followers = new Set<Follower>();
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

// Runs `work` now, and again whenever a value that it has read changes; returns what ends it.
export function effect(work: () => unknown): () => void {
  const me: Follower = { run, of: new Set() };
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

export function computed<T>(f: () => T): Readable<T> {
  const value = signal<T>(undefined as T);
  effect(() => {
    value.set(f());
  });
  return value;
}

// Sets several values; effects run once, after the last.
export function batch(work: () => void): void {
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
