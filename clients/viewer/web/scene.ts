// Runs in each viser frame before viser. Without a graphics processor (`gap` > 0, the page's choice)
// a picture is drawn at most every `gap` ms and without smoothed edges, so that the rest stays quick.
(() => {
  const gap = Number(new URLSearchParams(location.search).get("gap") ?? 0);
  if (!(gap > 0)) return;
  // eslint-disable-next-line @typescript-eslint/unbound-method -- it is called with its canvas below
  const context = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (this: HTMLCanvasElement, kind: string, options?: object) {
    return context.call(this, kind, /^webgl/.test(kind) ? { ...options, antialias: false } : options);
  } as typeof context;
  const ask = window.requestAnimationFrame.bind(window);
  let queue = new Map<number, FrameRequestCallback>(), next = 1, last = -Infinity, due = false;
  const run = (time: number) => {
    const now = queue;
    queue = new Map(); due = false; last = performance.now();
    for (const callback of now.values()) callback(time);
  };
  window.requestAnimationFrame = (callback) => {
    queue.set(next, callback);
    if (!due) { due = true; setTimeout(() => ask(run), Math.max(0, last + gap - performance.now())); }
    return next++;
  };
  window.cancelAnimationFrame = (id) => { queue.delete(id); };
})();
