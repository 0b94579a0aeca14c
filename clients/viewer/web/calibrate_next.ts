// What a calibration proposes next, as a button where the page can do it; its command stays
// for a shell.
import { $button, $select, el } from "./dom.js";
import { emit } from "./link.js";

interface Next {
  words: string;
  act: () => unknown;
}
export interface Actions {
  again: (free: string[]) => unknown;
  compare: (() => unknown) | null;
}

function composed(): void {
  emit("show-tab", "scan");
  $select("#wish-kind").value = "calibration";
  $button("#compose").click();
}
// The button for a proposed command; none where the page has no such step.
export function nextOf(line: string, actions: Actions): Next | null {
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
export function nextStep(line: string, actions: Actions): HTMLElement {
  const next = nextOf(line, actions);
  const summary = el("summary", { class: "muted" }, "as a command");
  const command = el("details", {}, summary, el("code", {}, line));
  const button = next && el("button", { class: "small", onclick: next.act }, next.words);
  return el("div", {}, button, command);
}
