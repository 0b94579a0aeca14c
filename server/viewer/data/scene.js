// Runs in each viser frame before viser: at most one picture every `gap` ms, from the page's choice.
(() => {
  const gap = Number(new URLSearchParams(location.search).get("gap") ?? 0);
  if (!(gap > 0)) return;
  const ask = window.requestAnimationFrame.bind(window), drop = window.cancelAnimationFrame.bind(window);
  const waiting = new Map();
  let next = 1, last = 0;
  window.requestAnimationFrame = (callback) => {
    const id = next++;
    const go = () => waiting.set(id, { frame: ask((time) => { waiting.delete(id); last = performance.now(); callback(time); }) });
    const wait = last + gap - performance.now();
    if (wait <= 0 || performance.now() - last < 2) go(); else waiting.set(id, { timer: setTimeout(go, wait) });
    return id;
  };
  window.cancelAnimationFrame = (id) => {
    const entry = waiting.get(id);
    if (entry?.timer) clearTimeout(entry.timer);
    if (entry?.frame) drop(entry.frame);
    waiting.delete(id);
  };
})();
