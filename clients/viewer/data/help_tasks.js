// Help by task: what somebody may want, each with the button that begins it.
import { $button, el } from "./dom.js";
import { emit } from "./link.js";
import { open as openStory } from "./story.js";

/** @param {string} name */
const tab = (name) => () => emit("show-tab", name);
/** @type {Array<[wish: string, how: string, act: () => unknown]>} */
const TASKS = [
  [
    "See a volume of the sample",
    "one turn, then its volume beside the truth",
    () => $button("#scan-it").click(),
  ],
  ["Put another sample on the stage", "a shipped one, or a mesh of yours", tab("setup")],
  ["Change voltage, power or exposure", "and see what they do to the images", tab("setup")],
  ["Move source, sample or detector", "by magnification, voxel size or motor", tab("move")],
  ["Plan and check a scan", "written for you, or a script of yours", tab("scan")],
  ["Look at a past scan", "image by image, beside the virtual one", tab("data")],
  ["Correct the geometry", "from a bead phantom, or from any turn", tab("calibrate")],
  ["See what a wrong geometry does", "a story in five steps", openStory],
  ["Show it to others", "pictures, scenes and replays as files", tab("share")],
];

/**
 * @param {() => void} close
 * @returns {HTMLElement}
 */
export function tasks(close) {
  return el(
    "div",
    { class: "help-tasks" },
    ...TASKS.map(([wish, how, act]) =>
      el(
        "button",
        {
          onclick: () => {
            close();
            act();
          },
        },
        el("b", {}, wish),
        el("span", { class: "muted small-text" }, how),
      ),
    ),
  );
}
