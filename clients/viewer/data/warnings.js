// What is wrong with the machine, the sample's place and the image, over the scene. A stop has a
// row of its own above it.
import { $, el, fixed } from "./dom.js";
import { partWords } from "./figures.js";
import { doer, isMe, on, store } from "./link.js";
import { OLD_S } from "./moment.js";
import { outline, OUTSIDE } from "./sample_outline.js";
/** @import { State } from "../web/viewer.d.ts" */

const AT_END = 0.05; // mm or degrees from a limit
const FEW = 0.001;
const MANY = 0.05;
const TOUCH_MM = 2;
/** @typedef {[kind: "" | "bad", words: string]} Warning */

/**
 * Whether nothing moves before a reset.
 * @param {State} s
 */
export const isDown = (s) => s.safety.estop || s.safety.state !== "ok";

/**
 * Why nothing moves that this page asks for: a stop, or another's control; "" where it does.
 * @param {State | null} s
 * @returns {string}
 */
export function hindered(s) {
  if (!s) return "";
  if (isDown(s)) return "reset the stop first";
  return s.controller && !isMe(s.controller) ? `${s.controller} controls: take over first` : "";
}

/**
 * @param {State} state
 * @returns {string}
 */
export function stopped({ safety: { estop, stopped_by: by, message } }) {
  if (!estop) return `Blocked: ${message || "reset to go on"}`;
  const who = by ? ` by ${doer(by)}` : "";
  return `Emergency stop${who}: nothing moves until it is reset`;
}

// Axes that the page found at an end of their travel: a machine may well be at home there.
/** @type {Set<string> | null} */
let parked = null;

/**
 * @param {State} s
 * @returns {string[]}
 */
function atEnds(s) {
  const ended = Object.entries(s.axes).filter(([, axis]) => {
    const [low, high] = axis.limits;
    const near = axis.position - low < AT_END || high - axis.position < AT_END;
    return near && !axis.moving && !axis.virtual;
  });
  const names = ended.map(([name]) => name);
  parked ??= new Set(names);
  for (const name of parked) if (!names.includes(name)) parked.delete(name);
  return names.filter((name) => !parked?.has(name));
}

/**
 * Of the machine: what keeps it from moving, what is near, what cannot be kept or computed.
 * @param {State} s
 * @returns {Warning[]}
 */
function ofMachine(s) {
  /** @type {Warning[]} */
  const list = [];
  const lost = "A server that is killed now comes back without the last change";
  if (s.unsaved) list.push(["bad", `Not saved: ${s.unsaved}. ${lost}`]);
  if (s.projector) list.push(["bad", `No new images: ${s.projector}`]);
  for (const words of s.safety.warnings) list.push(["", words]);
  const near = store.near;
  if (near?.close) {
    const kind = (near.mm ?? 0) < TOUCH_MM ? "bad" : "";
    list.push([
      kind,
      `${near.pair.map(partWords).join(" and ")} are ${fixed(near.mm, 1)} mm apart`,
    ]);
  }
  const ends = atEnds(s);
  if (ends.length) list.push(["", `${ends.join(", ")} at the end of travel`]);
  return list;
}

/**
 * Of the image that is made last, judged as though X-rays were on; nothing of one that is old.
 * @param {State} s
 * @returns {Warning[]}
 */
function ofImage(s) {
  const flags = store.imageAge > OLD_S ? null : s.image;
  const are = s.tube.on ? "are" : "would be";
  /** @type {Warning[]} */
  const list = [];
  if (flags && flags.saturated > FEW) {
    const what = `${share(flags.saturated)} of the pixels ${are} saturated`;
    const kind = flags.saturated > MANY ? "bad" : "";
    list.push([kind, `${what}: less power, shorter exposure or more filter`]);
  }
  if (flags && flags.starved > FEW) {
    const what = `${share(flags.starved)} of the pixels ${are} starved`;
    list.push(["", `${what}: hardly a count above dark`]);
  }
  return list;
}

/**
 * The scene has the same image as the radiograph, whose tag says how old it is.
 * @returns {Warning[]}
 */
const ofPanel = () =>
  store.imageAge > OLD_S && store.image && store.layers.panel
    ? [["", "The image on the panel is old, as the radiograph’s tag says"]]
    : [];

/** @param {number} part */
const share = (part) => (part < 0.01 ? "some" : `${fixed(100 * part, 0)} %`);

/**
 * @param {State} state
 * @returns {Warning[]}
 */
function ofScan({ job }) {
  if (job?.state !== "paused") return [];
  const why = job.error?.message;
  return [["", `Scan paused${typeof why === "string" ? `: ${why}` : ""}`]];
}

let last = "";
/** @param {State} s */
function draw(s) {
  const height_mm = store.framing?.sample_height_mm ?? 0;
  const outside = s.geometry
    ? outline(s.sample, s.geometry, s.camera, height_mm, store.across_mm)
    : [];
  const away = s.job?.state === "running"; // the script has put it there
  const seen = outside.filter((words) => !away || words !== OUTSIDE);
  const cut = seen.map((words) => /** @type {Warning} */ (["", words]));
  const list = [...ofMachine(s), ...cut, ...ofImage(s), ...ofPanel(), ...ofScan(s)];
  const key = JSON.stringify(list);
  if (key === last) return;
  last = key;
  const box = $("#warnings");
  box.replaceChildren(
    ...list.map(([kind, text]) => el("div", { class: `warning ${kind}` }, text)),
  );
}
on("state", draw);
on("age", () => {
  if (store.state) draw(store.state);
});
