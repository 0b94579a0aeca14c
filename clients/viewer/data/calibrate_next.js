// What a calibration proposes next, as a button where the page can do it; its command stays
// for a shell.
import { $button, $select, el } from "./dom.js";
import { emit } from "./link.js";

/**
 * @typedef {object} Next
 * @property {string} words
 * @property {() => unknown} act
 */

/**
 * @typedef {object} Actions
 * @property {(free: string[]) => unknown} again
 * @property {(() => unknown) | null} compare
 */

function composed() {
  emit("show-tab", "scan");
  $select("#wish-kind").value = "calibration";
  $button("#compose").click();
}

/**
 * The button for a proposed command; none where the page has no such step.
 * @param {string} line
 * @param {Actions} actions
 * @returns {Next | null}
 */
export function nextOf(line, actions) {
  const free = /--free[ =]([\w,*]+)/.exec(line)?.[1].split(",") ?? [];
  if (/^flexdt script new/.test(line))
    return { words: "Write the scan that tells more", act: composed };
  if (/--compare|--tracks/.test(line) && actions.compare)
    return { words: "Compare over a radiograph", act: actions.compare };
  if (/^flexdt calibrate/.test(line) && free.length)
    return { words: `Estimate ${free.join(", ")}`, act: () => actions.again(free) };
  if (/^flexdt reconstruct/.test(line))
    return { words: "Apply it, then scan again", act: () => $button("#fit-apply").click() };
  return null;
}

/**
 * @param {string} line
 * @param {Actions} actions
 * @returns {HTMLElement}
 */
export function nextStep(line, actions) {
  const next = nextOf(line, actions);
  const summary = el("summary", { class: "muted" }, "as a command");
  const command = el("details", {}, summary, el("code", {}, line));
  const button = next && el("button", { class: "small", onclick: next.act }, next.words);
  return el("div", {}, button, command);
}
