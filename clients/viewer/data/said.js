// Notes yield to what the scene is about: one that would stand over source, sample or image is not
// seen while it would. The newest always is, and warnings are.
import { $, $$ } from "./dom.js";
import { emit, on } from "./link.js";
/** @import { Four, View } from "../web/viewer.d.ts" */

/** @type {Partial<Record<View, Four[]>>} */
const subjects = {};

/**
 * Whether two boxes have a point in common.
 * @param {Four} box left, top, right, bottom
 * @param {{ left: number; top: number; right: number; bottom: number }} other
 * @returns {boolean}
 */
export const meet = ([left, top, right, bottom], other) =>
  left < other.right && right > other.left && top < other.bottom && bottom > other.top;

/**
 * The boxes of all views' subjects, in the window.
 * @returns {Four[]}
 */
function inWindow() {
  return $$(".view").flatMap((pane) => {
    const at = pane.getBoundingClientRect();
    const boxes = subjects[/** @type {View} */ (pane.dataset.view)] ?? [];
    return boxes.map(
      ([left, top, right, bottom]) =>
        /** @type {Four} */ ([at.left + left, at.top + top, at.left + right, at.top + bottom]),
    );
  });
}

function arrange() {
  const boxes = inWindow();
  const notes = $$("#notes .note");
  for (const note of notes) {
    const at = note.getBoundingClientRect();
    const over = note !== notes.at(-1) && boxes.some((box) => meet(box, at));
    note.classList.toggle("yields", over);
  }
  emit("said");
}
on("subject", (view, boxes) => {
  subjects[view] = boxes;
  arrange();
});
new MutationObserver(arrange).observe($("#said"), { childList: true, subtree: true });
new ResizeObserver(arrange).observe($("#said"));
