// Runs in each viser frame before viser. It tells the page when something has been drawn: an
// empty scene takes fewer calls than ENOUGH a picture, or all is hidden. Without a graphics
// processor (`gap` > 0, the page's choice) a picture is drawn at most every `gap` ms and
// without smoothed edges, so that the rest stays quick; where nothing has changed it is drawn
// anew every REST_MS and not, as viser does, every HEARTBEAT_MS: that took half a core. While
// nobody touches the scene, each picture is followed by a pause of PAUSES times what it took, so
// that a scan which moves the machine leaves the processor to images and volume.
"use strict";
(() => {
  const ENOUGH = 3;
  const LATE_MS = 5000;
  const HEARTBEAT_MS = 1000;
  const REST_MS = 8000;
  const PAUSES = 1;
  const LONGEST_PAUSE_MS = 500;
  const TOUCHED_MS = 2000;
  const LOOK_MS = 25;
  const ask = window.requestAnimationFrame.bind(window);
  const gl = WebGL2RenderingContext.prototype;
  // eslint-disable-next-line @typescript-eslint/unbound-method -- called with its context
  const draw = gl.drawElements;
  let calls = 0;
  let first = Infinity;
  gl.drawElements = function (...all) {
    calls++;
    first = Math.min(first, performance.now());
    draw.apply(this, all);
  };
  const look = () => {
    if (calls >= ENOUGH || performance.now() > first + LATE_MS) {
      gl.drawElements = draw;
      parent.postMessage("drawn", location.origin);
      return;
    }
    calls = 0;
    ask(look);
  };
  ask(look);
  const gap = Number(new URLSearchParams(location.search).get("gap") ?? 0);
  if (!(gap > 0)) return;
  // eslint-disable-next-line @typescript-eslint/unbound-method -- called with its canvas
  const context = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = /** @type {typeof context} */ (
    function (/** @type {string} */ kind, /** @type {object | undefined} */ options) {
      if (!/^webgl/.test(kind)) return context.call(this, kind, options);
      const made = context.call(this, kind, { ...options, antialias: false });
      if (made instanceof WebGL2RenderingContext && made !== glass) {
        glass = made;
        deferSize(this);
      }
      return made;
    }
  );
  /** @type {WebGL2RenderingContext | null} */
  let glass = null;
  let drawn = false;
  // A canvas that is given a size is empty until it is drawn: it gets the size when a picture
  // begins, and shows the old one until then.
  /** @type {Map<string, () => void>} */
  const sizes = new Map();
  /** @param {HTMLCanvasElement} canvas */
  const deferSize = (canvas) => {
    for (const side of /** @type {const} */ (["width", "height"])) {
      const own = Object.getOwnPropertyDescriptor(HTMLCanvasElement.prototype, side);
      let value = canvas[side];
      Object.defineProperty(canvas, side, {
        get: () => value,
        set: (/** @type {number} */ given) => {
          value = given;
          sizes.set(side, () => own?.set?.call(canvas, given));
        },
      });
    }
  };
  // eslint-disable-next-line @typescript-eslint/unbound-method -- called with its context
  const clear = gl.clear;
  gl.clear = function (mask) {
    drawn = true;
    for (const take of sizes.values()) take();
    sizes.clear();
    clear.call(this, mask);
  };
  let touched = -Infinity;
  // A canvas that has another size is empty until it is drawn.
  for (const kind of ["pointerdown", "pointermove", "wheel", "keydown", "resize"])
    window.addEventListener(
      kind,
      () => {
        touched = performance.now();
      },
      { capture: true, passive: true },
    );
  // The end of the pause after a picture, as soon as the graphics have finished it.
  let free = -Infinity;

  /**
   * @param {number} begun
   * @param {WebGLSync | null} done
   */
  const paused = (begun, done) => {
    if (!glass || !done || glass.isContextLost()) return;
    if (glass.clientWaitSync(done, 0, 0) === glass.TIMEOUT_EXPIRED) {
      setTimeout(() => paused(begun, done), LOOK_MS);
      return;
    }
    glass.deleteSync(done);
    const now = performance.now();
    free = now + Math.min(LONGEST_PAUSE_MS, PAUSES * (now - begun));
  };
  const every = window.setInterval.bind(window);

  /**
   * @param {TimerHandler} f
   * @param {number} [ms]
   */
  const beats = (f, ms) => ms === HEARTBEAT_MS && !String(f).includes("retry");
  window.setInterval = /** @type {typeof setInterval} */ (
    (
      /** @type {TimerHandler} */ f,
      /** @type {number | undefined} */ ms,
      /** @type {unknown[]} */ ...more
    ) =>
      // a lost connection is still tried once a second
      every(f, beats(f, ms) ? REST_MS : ms, ...more)
  );
  /** @type {Map<number, FrameRequestCallback>} */
  let queue = new Map();
  let next = 1;
  let last = -Infinity;
  let due = false;
  /** @param {number} time */
  const run = (time) => {
    const now = queue;
    queue = new Map();
    due = false;
    last = performance.now();
    drawn = false;
    for (const callback of now.values()) callback(time);
    if (!drawn || !glass) return;
    const done = glass.fenceSync(glass.SYNC_GPU_COMMANDS_COMPLETE, 0);
    glass.flush();
    paused(last, done);
  };
  const soonest = () => {
    const watched = performance.now() < touched + TOUCHED_MS;
    return Math.max(last + gap, watched ? -Infinity : free) - performance.now();
  };
  /** A touch ends a pause that is under way. */
  const wait = () => {
    const left = soonest();
    if (left > 0) setTimeout(wait, Math.min(left, gap));
    else ask(run);
  };
  window.requestAnimationFrame = (callback) => {
    queue.set(next, callback);
    if (!due) {
      due = true;
      wait();
    }
    return next++;
  };
  window.cancelAnimationFrame = (id) => {
    queue.delete(id);
  };
})();
