// Keys: hold to move an axis, where the Move tab says so. W A S D Q E and the arrows stay with
// the scene's camera.
import { $dialog, $input, el, keep, within } from "./dom.js";
import { jogStart, jogStop, jogStopAll } from "./axes.js";
import { command, on, store } from "./link.js";
import { estop } from "./status.js";
import { tasks } from "./help_tasks.js";
import { layout, nearSample } from "./views.js";

// Key -> axis, direction, what it does.
/** @type {Record<string, [axis: string, direction: number, what: string]>} */
export const JOGS = {
  KeyI: ["ver_tube", 1, "source up"],
  KeyK: ["ver_tube", -1, "source down"],
  KeyJ: ["tra_tube", -1, "source left"],
  KeyL: ["tra_tube", 1, "source right"],
  KeyT: ["mag_obj", 1, "sample away from source"],
  KeyG: ["mag_obj", -1, "sample towards source"],
  KeyF: ["tra_obj", -1, "sample left"],
  KeyH: ["tra_obj", 1, "sample right"],
  KeyR: ["rot_obj", -1, "turn anticlockwise"],
  KeyY: ["rot_obj", 1, "turn clockwise"],
  KeyU: ["ver_obj", -1, "source and detector up"],
  KeyO: ["ver_obj", 1, "source and detector down"],
  Digit8: ["ver_det", 1, "detector up"],
  Digit2: ["ver_det", -1, "detector down"],
  Digit4: ["tra_det", 1, "detector left"],
  Digit6: ["tra_det", -1, "detector right"],
  Digit9: ["mag_det", 1, "detector away"],
  Digit7: ["mag_det", -1, "detector towards source"],
};
const HELP =
  "With “keys move” ticked in the Move tab, an axis moves while its key is held. " +
  "Space stops wherever the focus is, except in text, lists and checkboxes; " +
  "Enter presses a button. In a scene: drag to turn, right drag to pan, wheel to zoom; " +
  "W A S D Q E and the arrows fly the camera. " +
  "In the radiograph: wheel to zoom, drag to pan, double click to reset.";
const TWIN =
  "Motors, X-rays and images here are computed: no machine moves, and no X-rays are emitted.";
const byKey = $input("#key-jog");
const KEY = "flexdt-keys";
byKey.checked = localStorage.getItem(KEY) === "on";
byKey.addEventListener("change", () => keep(KEY, byKey.checked ? "on" : "off"));
/** @type {Record<string, string>} */
const LAYOUTS = {
  Digit1: "four",
  Digit2: "iso",
  Digit3: "beam",
  Digit4: "side",
  Digit5: "free",
};

/** @param {string} code */
const name = (code) => code.replace(/^Key|^Digit/, "");

/**
 * Where Space has a meaning of its own. Numbers need none, and buttons are for Enter.
 * @param {Event} e
 */
const spaced = (e) =>
  within(
    e.target,
    "textarea, select, [contenteditable], " +
      "input:not([type=range], [type=file], [type=number], .num)",
  );
/** @param {Event} e */
const typing = (e) =>
  within(
    e.target,
    "input:not([type=range]):not([type=checkbox]), textarea, select, [contenteditable]",
  );

/** @param {KeyboardEvent} e */
function down(e) {
  if (e.code === "Space" && e.shiftKey) {
    e.preventDefault();
    if (!e.repeat) void estop();
    return;
  }
  if (e.code === "Space" && !e.ctrlKey && !e.metaKey && !e.altKey && !spaced(e)) {
    e.preventDefault();
    if (!e.repeat) {
      jogStopAll();
      void command("axes.stop", {}, "Stop");
    }
    return;
  }
  if (
    e.key === "Enter" &&
    e.repeat &&
    /** @type {Partial<Element> | null} */ (e.target)?.tagName === "BUTTON"
  ) {
    e.preventDefault();
    return;
  } // held, it would press what comes next, too
  if (e.key === "Escape" && $dialog("#help-dialog").open) {
    toggleHelp();
    return;
  }
  if (e.key === "F1") {
    e.preventDefault();
    toggleHelp();
    return;
  }
  if (typing(e) || e.ctrlKey || e.metaKey || $dialog("#help-dialog").open) return;
  if (e.altKey && LAYOUTS[e.code]) {
    e.preventDefault();
    layout(LAYOUTS[e.code]);
    return;
  }
  if (e.altKey && e.code === "Digit0") {
    e.preventDefault();
    nearSample();
    return;
  }
  if (e.altKey || !byKey.checked) return; // single letters move nothing until somebody wishes it
  const jog = JOGS[e.code.replace("Numpad", "Digit")];
  if (jog && !e.repeat && jog[0] in (store.state?.axes ?? {})) {
    e.preventDefault();
    jogStart(jog[0], jog[1], `key:${e.code}`);
  }
}

/** @param {KeyboardEvent} e */
function up(e) {
  // some browsers click here
  if (e.code === "Space" && (e.shiftKey || !spaced(e))) e.preventDefault();
  jogStop(`key:${e.code}`);
}

/** @param {Window} target */
export function listen(target) {
  // In the capture phase, so that no element further in can keep the stop keys for itself.
  target.addEventListener("keydown", down, true);
  target.addEventListener("keyup", up, true);
  target.addEventListener("blur", jogStopAll);
}
on("frame", listen);

export function toggleHelp() {
  const dialog = $dialog("#help-dialog");
  if (dialog.open) {
    dialog.close();
    return;
  }
  if (!dialog.childElementCount) {
    const grid = el("div", { class: "keys of-keys" });
    const jogs = Object.entries(JOGS).map(([code, [, , what]]) => [name(code), what]);
    for (const [key, what] of [
      ...jogs,
      ["Space", "stop all axes"],
      ["Shift+Space", "emergency stop"],
      ["Alt+1…5", "views"],
      ["Alt+0", "the sample close up"],
      ["F1", "this help"],
    ])
      grid.append(el("kbd", {}, key), el("span", {}, what));
    const scanner = store.hello?.machine ?? "X-ray CT";
    const close = el("button", { class: "primary", onclick: () => dialog.close() }, "Close");
    const viser = { href: "https://viser.studio", target: "_blank", class: "muted" };
    dialog.append(
      el("div", { class: "row between" }, el("h2", {}, "What would you like to do?"), close),
      el(
        "p",
        { id: "what-this-is" },
        `flexdt is a digital twin of the ${scanner} scanner. ${TWIN}`,
      ),
      tasks(() => dialog.close()),
      el("h2", { class: "of-keys" }, "Keys"),
      grid,
      el("p", { class: "muted of-keys" }, HELP),
      el("a", viser, "3-D by viser"),
    );
  }
  dialog.show();
}
