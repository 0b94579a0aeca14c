// Bar and notes: whether everything is there, who holds control, stops and resets, what went
// wrong.
import { $, $$, $button, $dialog, $input, el, fixed, setText } from "./dom.js";
import { listed, sampleOf } from "./fingerprint.js";
import { toYou } from "./names.js";
import { command, imageMade, isMe, on, person, rename, store, unanswered } from "./link.js";
import { OLD_S } from "./moment.js";
import { hindered, isDown, stopped } from "./warnings.js";
import "./readouts.js";
/** @import { ClockState, State } from "../web/viewer.d.ts" */

/**
 * Removes the notes about a subject.
 * @param {string} about
 */
function settle(about) {
  for (const n of $$("#notes > *")) if (n.dataset.about === about) n.remove();
}
on("settled", settle);

/**
 * A note replaces the last one about its subject (a motor, a request, control): of what has none
 * the words are the subject.
 * @param {string} kind
 * @param {string} title
 */
export function note(kind, title, body = "", about = title + body) {
  const life = kind === "error" ? 12000 : 6000;
  const box = $("#notes");
  settle(about);
  /** @type {HTMLElement} */
  const node = el(
    "div",
    { class: `note ${kind}`, "data-about": about },
    el("b", {}, title),
    el("span", {}, body),
    el("button", { "aria-label": "close", onclick: () => node.remove() }, "×"),
  );
  box.append(node);
  while (box.childElementCount > 5) box.firstChild?.remove();
  setTimeout(() => node.remove(), life);
}
on("note", note);
on("log", ({ level, message, data }) => {
  // What the bar of a stop says is not said twice.
  if (!["warning", "error"].includes(level) || data?.about === "estop") return;
  const kind = level === "error" ? "error" : "warning-note";
  note(kind, "Twin", toYou(message, store.session), data?.about);
});

/**
 * How fast the twin's time runs: as measured, else as asked for.
 * @param {ClockState} clock
 * @returns {string}
 */
function pace({ real_time_factor: factor, speed_up }) {
  if (factor) return `${fixed(factor, factor >= 10 ? 0 : 2)}×`;
  return speed_up === "max" ? "max" : `${speed_up}×`;
}
on("state", (s) => {
  setText($("#clock"), `t = ${fixed(s.clock.time_s, 1)} s · ${pace(s.clock)}`);
  release(s);
  if (s.safety.estop && s.safety.stop !== pressed?.after) {
    pressed = null;
    settle("safety.estop");
  }
  holder();
});

function holder() {
  const pill = $("#holder");
  const who = store.state?.controller ?? null;
  const mine = isMe(who);
  if (mine || who === null) settle("control"); // what is said of another's holds no longer
  // Without the twin nobody knows who may; with it the next state says.
  pill.dataset.state = !store.twin ? "none" : mine ? "mine" : who ? "other" : "none";
  setText(
    pill,
    !store.twin
      ? "control unknown"
      : mine
        ? "you control"
        : who
          ? `held by ${who}`
          : "nobody controls",
  );
  setText($button("#take"), mine ? "Release" : who ? "Take over" : "Take control");
  $button("#take").disabled = !store.twin;
}
$button("#take").addEventListener("click", () => {
  const who = store.state?.controller ?? null;
  const action = who === null ? "acquire" : isMe(who) ? "release" : "force";
  void command("session.control", { action }, "Control");
});
const me = $input("#person");
me.value = person();
me.addEventListener("change", () => rename(me.value));
$button("#skip").addEventListener("click", () => $("#film-canvas").focus());
const UNCONFIRMED = "E-stop not confirmed";
// Pressed when [ms], after which stop, and neither answered nor confirmed by a newer one yet: only
// the twin's answer tells that a press came to nothing, however long states show no stop.
/** @type {{ at: number; after: number | undefined } | null} */
let pressed = null;
export async function estop() {
  const mine = (pressed = { at: performance.now(), after: store.state?.safety.stop });
  await command("safety.estop", {}, UNCONFIRMED);
  if (pressed === mine) pressed = null;
}
$button("#estop").addEventListener("click", () => void estop());

// A reset releases the one stop that the page shows, and not before a person has had time to see
// it.
const SEEN_MS = 1000;
/** @type {number | null} */
let shown = null;
/** @param {State} s */
function release(s) {
  const stop = isDown(s) ? s.safety.stop : null;
  const reset = $button("#reset");
  const ask = $dialog("#reset-dialog");
  reset.hidden = $("#emergency").hidden = stop === null;
  if (stop !== null) setText($("#emergency-what"), stopped(s));
  document.body.dataset.down = String(stop !== null);
  const why = hindered(s);
  for (const id of ["#mains", "#axes"]) $(id).inert = why !== "";
  $("#move-down").hidden = !why;
  setText($("#move-down"), `Nothing moves: ${why}.`);
  $button("#xrays-off").hidden = stop === null || !s.tube.on;
  if (stop === shown) return;
  shown = stop;
  ask.close();
  reset.disabled = true;
  setTimeout(() => {
    if (shown === stop) reset.disabled = false;
  }, SEEN_MS);
}
$button("#reset").addEventListener("click", () => {
  const ask = $dialog("#reset-dialog");
  const s = store.state;
  if (ask.open || !s) {
    ask.close();
    return;
  }
  setText($("#reset-what"), stopped(s));
  setText(
    $("#reset-tube"),
    s.tube.on ? "X-rays are on and stay on." : "X-rays are off and stay off.",
  );
  ask.show();
});
$button("#reset-no").addEventListener("click", () => $dialog("#reset-dialog").close());
$button("#reset-yes").addEventListener("click", () => {
  $dialog("#reset-dialog").close();
  if (shown !== null) void command("safety.reset", { stop: shown }, "Reset");
});
$button("#xrays-off").addEventListener(
  "click",
  () => void command("tube.set", { on: false }, "X-rays off"),
);
const BUTTON = "the machine's own emergency stop button is the one that counts";
$button("#stop").addEventListener("click", () => void command("axes.stop", {}, "Stop"));

/**
 * What is missing: nothing, the viewer's room for this page, the viewer, the twin, or news of
 * either.
 * @typedef {object} Missing
 * @property {string} word
 * @property {string} title
 * @property {string} why
 */

const GREETING_S = 3;
const BACK = "the page comes back by itself";
const LATE =
  "viewer or twin do not answer, or the network is slow; " +
  "what is done here may come late or not at all";
const HERE = `${location.origin}${location.pathname}`;
const UNREACHED =
  "no connection of this page has reached it: a proxy between them must pass WebSockets on, and " +
  `the viewer must know this address (flexdt viewer --public-url ${HERE})`;
/** @returns {Missing | null} */
function missing() {
  if (store.refused) {
    const title = "The viewer does not serve this page now";
    return {
      word: "sent away",
      title,
      why: `${store.refused}; the page tries again by itself`,
    };
  }
  if (!store.viewer) {
    const why = store.hello ? "it does not answer" : UNREACHED;
    return { word: "no viewer", title: "The viewer is away", why: `${why}; ${BACK}` };
  }
  if (!store.twin) {
    const why = `${store.problem || "waiting for it"}; ${BACK}`;
    return { word: "no twin", title: "The twin is away", why };
  }
  if (store.state && store.age > OLD_S) {
    const age = `${fixed(store.age, 0)} s old`;
    return { word: age, title: `What you see is ${age}`, why: LATE };
  }
  return null;
}
// A page that was just opened greets with "connecting": what is not there yet is missing only
// after GREETING_S. A viewer that refuses the page is told at once.
let greeting = true;

/**
 * @param {Missing | null} found
 * @returns {boolean}
 */
function greets(found) {
  const arrived = found === null && store.state !== null;
  if (arrived || store.refused || performance.now() > 1000 * GREETING_S) greeting = false;
  return greeting;
}
function connection() {
  const found = missing();
  const connecting = greets(found);
  const told = connecting ? null : found;
  const kept = unanswered();
  const waits = kept !== null && kept.age > OLD_S ? `${kept.what} not confirmed` : null;
  const estopWaits = pressed !== null && performance.now() - pressed.at > 1000 * OLD_S;
  const unconfirmed = estopWaits ? UNCONFIRMED : waits;
  bar(told, connecting);
  document.body.dataset.old = String(told !== null);
  $("#estop").toggleAttribute("data-dead", store.hello === null);
  $("#veil").hidden = told === null && !unconfirmed;
  $("#veil").dataset.urgent = String(unconfirmed !== null);
  const title = told?.title ?? "";
  setText($("#veil-title"), unconfirmed ? `${unconfirmed}${title && `. ${title}`}` : title);
  const why = [told?.why, BUTTON].filter(Boolean).join("; ");
  setText($("#veil-text"), unconfirmed || told ? why : "");
}

/**
 * @param {Missing | null} told
 * @param {boolean} connecting
 */
function bar(told, connecting) {
  const pill = $("#connection");
  const images = told || connecting ? null : (store.state?.projector ?? null);
  const word = connecting ? "connecting" : (told?.word ?? (images ? "no images" : "connected"));
  setText(pill, word);
  pill.dataset.state = told || images ? "down" : connecting ? "wait" : "up";
  pill.title = images ?? store.problem ?? "";
}
on("age", () => {
  connection();
  const tag = $("#film-old");
  tag.hidden = store.imageAge <= OLD_S;
  if (tag.hidden) return;
  const age = Number.isFinite(store.imageAge) ? `: ${fixed(store.imageAge, 0)} s old` : "";
  setText(tag, `${store.imageDiffers.length ? `of another ${old()}` : "of now?"}${age}`);
});

/**
 * In what the image differs from now; another sample is named.
 * @returns {string}
 */
function old() {
  const image = store.image;
  const words = listed(store.imageDiffers);
  if (!image || !store.imageDiffers.includes("sample")) return words;
  return words.replace("sample", `sample (${sampleOf(imageMade(image)) || "none"})`);
}
on("state", connection);
on("connection", () => {
  connection();
  const hello = store.hello;
  setText($("#machine"), hello ? `${hello.machine} · ${hello.profile ?? ""}` : "");
  holder();
});
