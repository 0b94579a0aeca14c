// Runs in each viser frame before viser. It tells the page when something has been drawn: an
// empty scene takes fewer calls than ENOUGH a picture, or all is hidden. Without a graphics
// processor (`gap` > 0, the page's choice) a picture is drawn at most every `gap` ms and
// without smoothed edges, so that the rest stays quick; where nothing has changed it is drawn
// anew every REST_MS and not, as viser does, every HEARTBEAT_MS: that took half a core.
(() => {
  const ENOUGH = 3;
  const LATE_MS = 5000;
  const HEARTBEAT_MS = 1000;
  const REST_MS = 8000;
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
  HTMLCanvasElement.prototype.getContext = function (
    this: HTMLCanvasElement,
    kind: string,
    options?: object,
  ) {
    return context.call(
      this,
      kind,
      /^webgl/.test(kind) ? { ...options, antialias: false } : options,
    );
  } as typeof context;
  const every = window.setInterval.bind(window);
  const beats = (f: TimerHandler, ms?: number) =>
    ms === HEARTBEAT_MS && !String(f).includes("retry");
  window.setInterval = ((f: TimerHandler, ms?: number, ...more: unknown[]) =>
    // a lost connection is still tried once a second
    every(f, beats(f, ms) ? REST_MS : ms, ...more)) as typeof setInterval;
  let queue = new Map<number, FrameRequestCallback>();
  let next = 1;
  let last = -Infinity;
  let due = false;
  const run = (time: number) => {
    const now = queue;
    queue = new Map();
    due = false;
    last = performance.now();
    for (const callback of now.values()) callback(time);
  };
  window.requestAnimationFrame = (callback) => {
    queue.set(next, callback);
    if (!due) {
      due = true;
      setTimeout(() => ask(run), Math.max(0, last + gap - performance.now()));
    }
    return next++;
  };
  window.cancelAnimationFrame = (id) => {
    queue.delete(id);
  };
})();
