// How much of the page the radiograph has: a splitter between it and the scene, and all of it.
import { $, $button, $dialog, keep, setText } from "./dom.js";
import { on } from "./link.js";

const KEY = "flexdt-right";
const LEAST = 280;
const STEP = 32;
const page = $("main");
const splitter = $("#splitter");
/** @type {number | null} */
let wide = null;
/** @param {number} width */
function set(width) {
  const most = Math.max(LEAST, page.clientWidth - $("#left").offsetWidth - 160);
  wide = Math.round(Math.min(most, Math.max(LEAST, width)));
  page.style.setProperty("--right", `${wide}px`);
  splitter.setAttribute("aria-valuenow", String(wide));
  splitter.setAttribute("aria-valuemin", String(LEAST));
  splitter.setAttribute("aria-valuemax", String(Math.round(most)));
}
splitter.addEventListener("pointerdown", (e) => {
  e.preventDefault();
  splitter.setPointerCapture(e.pointerId);
});
splitter.addEventListener("pointermove", (e) => {
  if (splitter.hasPointerCapture(e.pointerId))
    set(page.getBoundingClientRect().right - e.clientX);
});
splitter.addEventListener("pointerup", () => keep(KEY, String(wide)));
splitter.addEventListener("dblclick", () => {
  page.style.removeProperty("--right");
  localStorage.removeItem(KEY);
});
splitter.addEventListener("keydown", (e) => {
  const step = e.key === "ArrowLeft" ? STEP : e.key === "ArrowRight" ? -STEP : 0;
  if (step) {
    e.preventDefault();
    e.stopPropagation();
    set($("#right").offsetWidth + step);
    keep(KEY, String(wide));
  }
});
const kept = Number(localStorage.getItem(KEY));
if (kept > 0) set(kept);
else splitter.setAttribute("aria-valuenow", String($("#right").offsetWidth));

/** @param {boolean} on */
export function large(on) {
  document.body.classList.toggle("large", on);
  $button("#film-large").setAttribute("aria-pressed", String(on));
  setText($button("#film-large"), on ? "back" : "enlarge");
}
$button("#film-large").addEventListener("click", () =>
  large(!document.body.classList.contains("large")),
);
// What is laid over the whole page begins below what always stands on top: the way back is seen.
const NARROW = matchMedia("(max-width: 740px)");
const above = () => {
  const px = NARROW.matches ? $("#top").offsetHeight : $("main").offsetTop;
  document.body.style.setProperty("--above", `${px}px`);
};
const tops = new ResizeObserver(above);
for (const id of ["#top", "#scan-bar"]) tops.observe($(id));
// What is brought into view in the left column is not under what stands at its foot.
const foot = $("#nearest");
new ResizeObserver(() =>
  document.body.style.setProperty("--foot", `${foot.offsetHeight}px`),
).observe(foot);
// Window and tools of the radiograph are closed until somebody opens them; this browser remembers.
const TOOLS = "flexdt-tools";
/** @type {HTMLDetailsElement} */
const tools = $("#film-tools");
tools.open = localStorage.getItem(TOOLS) === "open";
tools.addEventListener("toggle", () => keep(TOOLS, tools.open ? "open" : "closed"));
on("tab", () => large(false));
// An image of a data set is in view, though a volume was looked at before.
on("recorded", (name) => {
  large(false);
  if (name !== null) $("#right").scrollTop = 0;
});
window.addEventListener(
  "keydown",
  (e) => {
    if (
      e.key === "Escape" &&
      document.body.classList.contains("large") &&
      !$dialog("#help-dialog").open
    ) {
      e.stopImmediatePropagation();
      large(false);
    }
  },
  true,
);
