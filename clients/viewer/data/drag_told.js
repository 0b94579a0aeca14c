// Whether the place to which a handle is dragged can be reached: one line, while it is dragged.
import { $, el, fixed } from "./dom.js";
import { on, store } from "./link.js";

const STAYS_MS = 3000;
const line = el("div", { id: "dragged", role: "status", hidden: true });
$("#said").append(line);
/** @type {number | undefined} */
let leaves;

/**
 * @param {string} axis
 * @param {number} to
 */
function place(axis, to) {
  const unit = store.state?.axes[axis]?.unit === "deg" ? "°" : " mm";
  return `${axis} ${fixed(to, 1)}${unit}`;
}

on("drag", ({ targets, why, duration_s }) => {
  const to = Object.entries(targets).map(([axis, value]) => place(axis, value));
  line.className = `note ${why === null ? "good" : "error"}`;
  line.replaceChildren(
    el("b", {}, `${to.join(", ")}: ${why === null ? "can be reached" : "cannot be reached"}`),
    el("span", {}, why ?? `in ${fixed(duration_s, 1)} s`),
  );
  line.hidden = false;
  clearTimeout(leaves);
  leaves = window.setTimeout(() => {
    line.className = ""; // no note any more: what yields to notes comes back
    line.hidden = true;
  }, STAYS_MS);
});
