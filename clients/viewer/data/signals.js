let reading = null;
let held = 0;
const due = new Set();
export function signal(value) {
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
            if (Object.is(next, value))
                return;
            value = next;
            batch(() => {
                for (const follower of followers)
                    due.add(follower);
            });
        },
    };
}
// Runs `work` now, and again whenever a value that it has read changes; returns what ends it.
export function effect(work) {
    const me = { run, of: new Set() };
    function forget() {
        for (const followers of me.of)
            followers.delete(me);
        me.of.clear();
    }
    function run() {
        forget();
        const before = reading;
        reading = me;
        try {
            work();
        }
        finally {
            reading = before;
        }
    }
    run();
    return () => {
        forget();
        due.delete(me);
    };
}
export function computed(f) {
    const value = signal(undefined);
    effect(() => {
        value.set(f());
    });
    return value;
}
// Sets several values; effects run once, after the last.
export function batch(work) {
    held++;
    try {
        work();
        if (held > 1)
            return;
        while (due.size) {
            const [next] = due;
            due.delete(next);
            next.run();
        }
    }
    finally {
        held--;
    }
}
