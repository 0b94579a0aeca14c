// Misalign: the thesis as a story in five steps. The reconstruction gets a wrong geometry, a
// scan of a gear shows what that does to a volume, a short scan of the bead phantom measures the
// right one, and a second scan of the gear is sharp again. Images are the same with a part that
// is displaced and with a reconstruction that believes it displaced: so nothing is bent.
import { $, clicks, el, fixed, setText, words } from "./dom.js";
import { call, command, emit, Failure, on, store } from "./link.js";
import { beliefWords, MEANS, unit } from "./belief.js";
import { apply } from "./calibrate.js";
import { folder } from "./data.js";
import { isOver } from "./job_words.js";
import { scanIt, takeUp, turnOf } from "./scan_it.js";
import { BY_HAND, sameCorrection, STEP, stepOf } from "./story_steps.js";
import { LEAST_VIEWS } from "./view_count.js";
import { reconstruct } from "./volume.js";
import { hindered } from "./warnings.js";
/**
 * @import { Found } from "./belief.js"
 * @import { JobStatus } from "../web/viewer.d.ts"
 */

// What is scanned, and the phantom whose beads tell the geometry.
const OBJECT = "gear";
const PHANTOM = "lego";
const NOT_BEGUN = "The scan did not begin: the note says why.";
// What is estimated: the usual parameters, and the panel's roll. Beads hardly tell its tilt
// from their height.
const FREE = ["dO_x", "dO_y", "dO_z", "alpha", "tau_x", "tau_z", "det_roll"];

/**
 * Offset -> the largest and the first value of its slider, what it does to a volume.
 * @type {Record<string, [most: number, first: number, does: string]>}
 */
const BELIEFS = {
  dO_x: [1, 0.5, "edges double, balls become arcs"],
  det_roll: [3, 1, "slices shear, worse away from the middle"],
  det_pitch: [5, 0, "slices blur with their height"],
  dS_x: [1, 0, "edges double, as of the axis"],
};

/** @type {Array<[id: string, button: string, says: string]>} */
const STEPS = [
  [
    "story-bend",
    "1  Misalign",
    "The machine stays as it is. The sliders are what the reconstruction wrongly believes of it; " +
      "a printed gear goes onto the stage.",
  ],
  ["story-scan", "2  Scan it", "One turn, reconstructed with the geometry of the sliders."],
  ["story-fit", "3  Calibrate", "A bead phantom turns once: its beads tell the true geometry."],
  ["story-apply", "4  Apply", "What the beads say takes the place of what the sliders said."],
  [
    "story-again",
    "5  Scan it again",
    "The same turn, the right geometry. Share it from the volume.",
  ],
];
/**
 * What the story has found out: kept in this tab, so that it goes on after a reload. While it
 * waits, one of `job`, `dataset`, `phantomJob` and `looking` says for what, and `from` in which
 * step.
 * @typedef {object} Told
 * @property {number} from
 * @property {string | null} job
 * @property {string | null} dataset
 * @property {string | null} phantomJob
 * @property {string | null} looking
 * @property {{ correction: Record<string, number>; source: string } | null} found
 * @property {boolean} waiting
 * @property {string} says
 * @property {Record<string, number>} believed
 * @property {Record<string, unknown>} parameters
 * @property {number[]} rms
 */

const KEY = "flexdt-story";
/** @returns {Told} */
const fresh = () => ({
  from: STEP.misalign,
  job: null,
  dataset: null,
  phantomJob: null,
  looking: null,
  found: null,
  waiting: false,
  says: "",
  believed: {},
  parameters: {},
  rms: [],
});
const kept = sessionStorage.getItem(KEY);
let told = kept ? { ...fresh(), .../** @type {Told} */ (JSON.parse(kept)) } : fresh();

/** @param {string} name */
const slider = (name) => /** @type {HTMLInputElement} */ ($(`#story-${name}`));
const [first] = STEPS[0];
const card = el(
  "details",
  { class: "card", id: "story" },
  el("summary", {}, "Misalign: what a wrong geometry does, in five steps"),
  ...Object.entries(BELIEFS).map(([name, [most, start, does]]) =>
    el(
      "div",
      { title: does },
      el(
        "label",
        { for: `story-${name}` },
        `${MEANS[name]} `,
        el("output", { id: `story-${name}-is`, class: "mono" }),
        ` ${unit(name)}`,
      ),
      el("input", {
        type: "range",
        id: `story-${name}`,
        min: -most,
        max: most,
        step: most / 50,
        value: start,
        oninput: () => says(),
      }),
    ),
  ),
  ...STEPS.map(([id, button]) =>
    el("button", { id, class: "small", disabled: id !== first }, button),
  ),
  el("div", { id: "story-says", class: "small-text", "aria-live": "polite" }),
  el("div", { id: "story-found", class: "small-text" }),
);
$("#tab-calibrate").prepend(card);

/** @returns {Record<string, number>} */
function chosen() {
  const names = Object.keys(BELIEFS);
  return Object.fromEntries(names.map((name) => [name, slider(name).valueAsNumber]));
}
function says() {
  for (const [name, value] of Object.entries(chosen())) {
    setText($(`#story-${name}-is`), fixed(value, 2));
  }
}
/**
 * The step that comes next: by the correction in force, whoever has put it there or undone it.
 * Before the first state it is not known.
 */
const step = () => stepOf(told, store.state?.correction ?? null);
function show(says = stepWords()) {
  told.says = says;
  setText($("#story-says"), says);
  allow();
  if (told.waiting || Object.keys(told.believed).length)
    sessionStorage.setItem(KEY, JSON.stringify(told));
}
function stepWords() {
  const at = step();
  if (at === STEP.end) return `Sharp again. ${compared()}`;
  const [, , words] = STEPS[at];
  return at === STEP.calibrate ? `${compared()} ${words}` : words;
}
function allow() {
  const down = hindered(store.state) !== "";
  const at = step();
  STEPS.forEach(([id], k) => {
    /** @type {HTMLButtonElement} */
    const button = $(`#${id}`);
    button.disabled = down || told.waiting || (k !== at && k !== STEP.misalign);
    button.classList.toggle("primary", k === at);
  });
}
let shown = -1;
on("state", ({ correction }) => {
  // A wrong geometry of another tab, or of before a restart: the sliders say what it is.
  if (correction?.comment === BY_HAND && !sameCorrection(told.believed, correction.parameters))
    adopt(correction.parameters);
  const at = step();
  if (told.waiting && at !== told.from) failed("The correction has changed meanwhile.");
  else if (at !== shown && !told.waiting) show();
  else allow();
  shown = at;
});

/** @param {Record<string, number>} believed */
function adopt(believed) {
  told = { ...fresh(), believed };
  setText($("#story-found"), "");
  put(believed);
  says();
}

/**
 * The sliders as a correction has them, which may have more parameters than there are sliders.
 * @param {Record<string, number>} believed
 */
function put(believed) {
  for (const name of Object.keys(BELIEFS)) slider(name).value = String(believed[name] ?? 0);
}

/** @param {string} words */
function wait(words) {
  Object.assign(told, { waiting: true, from: step() });
  show(words);
}
function goOn() {
  told.waiting = false;
  show();
}

/** @returns {string} */
function compared() {
  const values = told.rms.map((one) => `${fixed(one, 5)} /mm`).join(", then ");
  return `Rms difference from the truth: ${values}.`;
}

/** @param {string} why */
function failed(why) {
  Object.assign(told, {
    waiting: false,
    job: null,
    dataset: null,
    phantomJob: null,
    looking: null,
  });
  show(why);
}

async function bend() {
  told = { ...fresh(), believed: chosen() };
  setText($("#story-found"), "");
  const wrong = { parameters: told.believed, source: null, comment: BY_HAND };
  if (!(await command("sample.set", { name: OBJECT }, "The sample stays"))) return;
  await command("calibration.apply", wrong, "Not applied");
}
async function scan() {
  told.dataset = null;
  wait("Scanning; the volume grows in the scene.");
  told.job = await scanIt(OBJECT);
  if (told.job) show(told.says);
  else failed(NOT_BEGUN);
}

/** Scans the phantom; its beads are looked for once its images are there. */
async function fit() {
  wait("The bead phantom is on the stage, and turns once.");
  told.phantomJob = await turnOf(PHANTOM, LEAST_VIEWS);
  if (told.phantomJob) show(told.says);
  else failed(NOT_BEGUN);
}

/** @param {string} scanned */
async function look(scanned) {
  told.looking = scanned;
  show("Finding beads in all images …");
  const asked = { datasets: [scanned], phantom: PHANTOM, free: FREE };
  const report = await call("calibration.fit", asked).catch((/** @type {unknown} */ error) =>
    error instanceof Failure && error.code === 0 ? null : words(error),
  );
  if (report === null) return; // the next connection looks again
  told.looking = null;
  if (typeof report === "string") {
    failed(report);
    return;
  }
  const { correction } = report;
  if (!correction || !report.identifiable) {
    failed(`Nothing is applied: ${report.verdict}`);
    return;
  }
  if (!(await command("sample.set", { name: OBJECT }, "The sample stays"))) {
    failed("The phantom is still on the stage.");
    return;
  }
  told.found = { correction, source: scanned };
  told.parameters = report.parameters;
  tell();
  goOn();
}

/** What the beads say beside what the sliders said when the geometry was bent. */
function tell() {
  if (!told.found) return;
  const rows = Object.keys(BELIEFS).map((name) => {
    const found = /** @type {Found | undefined} */ (told.parameters[name]);
    const words = beliefWords(MEANS[name] ?? name, unit(name), told.believed[name], found);
    return el("div", {}, words);
  });
  $("#story-found").replaceChildren(...rows);
}
async function use() {
  const { found } = told;
  if (found) await apply(found.correction, found.source, "after a story", true);
}
on("job", (/** @type {JobStatus} */ status) => {
  if (!told.waiting || ![told.job, told.phantomJob].includes(status.job)) return;
  if (isOver(status) && status.state !== "done") failed(`The scan is ${status.state}.`);
  if (status.state !== "done") return;
  if (status.job === told.phantomJob) {
    told.phantomJob = null;
    void look(folder(status));
  } else {
    told.job = null;
    told.dataset = folder(status);
    show("Reconstructing, and comparing with the truth …");
  }
});
on("volume", (volume) => {
  if (!told.waiting || !volume.past || volume.name !== told.dataset) return;
  const problem = volume.problem ?? volume.not_compared;
  if (problem) {
    failed(problem);
    return;
  }
  if (!volume.compared) return;
  told.dataset = null;
  told.rms.push(Object.values(volume.compared)[0].rms);
  goOn();
});

// A page that was loaded again, or connected again, takes up what it waited for.
let loaded = true;
on("session", async () => {
  if (!told.waiting) return;
  const { job, dataset, phantomJob, looking } = told;
  if (loaded && job) takeUp(job);
  if (loaded && dataset) reconstruct(dataset, true);
  loaded = false;
  if (looking) void look(looking);
  const asked = job ?? phantomJob;
  if (!asked) {
    if (!dataset && !looking) failed(NOT_BEGUN);
    return;
  }
  const status = await call("job.status", { job: asked }).catch(() => null);
  if (status) emit("job", status);
  else failed("The twin knows nothing of that scan any more.");
});
clicks({
  "story-bend": bend,
  "story-scan": scan,
  "story-fit": fit,
  "story-apply": use,
  "story-again": scan,
});
if (Object.keys(told.believed).length) put(told.believed);
says();
tell();
show(told.says || undefined);
card.open = kept !== null;
export function open() {
  emit("show-tab", "calibrate");
  card.open = true;
}
