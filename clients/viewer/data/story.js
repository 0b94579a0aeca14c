// Misalign: the thesis as a story in five steps. The reconstruction gets a wrong geometry, a
// scan of a gear shows what that does to a volume, a short scan of the bead phantom measures the
// right one, and a second scan of the gear is sharp again. Images are the same with a part that
// is displaced and with a reconstruction that believes it displaced: so nothing is bent.
import { $, clicks, el, fixed, setText, words } from "./dom.js";
import { call, command, emit, on, store } from "./link.js";
import { beliefWords } from "./belief.js";
import { apply } from "./calibrate.js";
import { folder } from "./data.js";
import { isUnfinished } from "./job_words.js";
import { scanIt, turnOf } from "./scan_it.js";
/**
 * @import { Found } from "./belief.js"
 * @import { JobStatus } from "../web/viewer.d.ts"
 */

// What is scanned, and the phantom whose beads tell the geometry.
const OBJECT = "gear";
const PHANTOM = "lego";
// Views of the phantom's turn: beads are found in each.
const PHANTOM_VIEWS = 45;
const NOT_BEGUN = "The scan did not begin: the note says why.";
// What is estimated: the usual parameters, and the panel's roll. Beads hardly tell its tilt
// from their height.
const FREE = ["dO_x", "dO_y", "dO_z", "alpha", "tau_x", "tau_z", "det_roll"];
const COMMENT = "misaligned by hand";

/**
 * Offset -> what it is, its unit, the largest and the first value of its slider, what it
 * does to a volume.
 * @typedef {[what: string, unit: string, most: number, first: number, does: string]} Offset
 */

/** @type {Record<string, Offset>} */
const BELIEFS = {
  dO_x: ["axis aside", "mm", 1, 0.5, "edges double, balls become arcs"],
  det_roll: ["panel rolled", "°", 3, 1, "slices shear, worse away from the middle"],
  det_pitch: ["panel tilted", "°", 5, 0, "slices blur with their height"],
  dS_x: ["source aside", "mm", 1, 0, "edges double, as of the axis"],
};

/** @type {Array<[id: string, button: string, says: string]>} */
const STEPS = [
  [
    "story-bend",
    "1  Misalign",
    "The machine stays as it is. The sliders are what the reconstruction wrongly believes of it; " +
      "a printed gear goes onto the stage.",
  ],
  ["story-scan", "2  Scan it", "One turn, reconstructed with what the sliders say."],
  [
    "story-fit",
    "3  Calibrate",
    "A bead phantom turns once: its beads measure what the machine truly is.",
  ],
  ["story-apply", "4  Apply", "What the beads say takes the place of what the sliders said."],
  [
    "story-again",
    "5  Scan it again",
    "The same turn, the right geometry. Share it from the volume.",
  ],
];
let step = 0;
/** @type {string | null} */
let job = null;
/** @type {string | null} */
let dataset = null;
/** @type {string | null} */
let phantomJob = null;
/** @type {{ correction: Record<string, number>; source: string } | null} */
let found = null;
let waiting = false;
/** @type {Record<string, number>} */
let believed = {};
/** @type {number[]} */
const rms = [];

/** @param {string} name */
const slider = (name) => /** @type {HTMLInputElement} */ ($(`#story-${name}`));
const [first] = STEPS[0];
const card = el(
  "details",
  { class: "card", id: "story" },
  el("summary", {}, "Misalign: what a wrong geometry does, in five steps"),
  ...Object.entries(BELIEFS).map(([name, [what, unit, most, start, does]]) =>
    el(
      "div",
      { title: does },
      el(
        "label",
        { for: `story-${name}` },
        `${what} `,
        el("output", { id: `story-${name}-is`, class: "mono" }),
        ` ${unit}`,
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
function show(says = STEPS[step]?.[2] ?? "") {
  STEPS.forEach(([id], k) => {
    /** @type {HTMLButtonElement} */
    const button = $(`#${id}`);
    button.disabled = waiting || (k !== step && k !== 0);
    button.classList.toggle("primary", k === step);
  });
  setText($("#story-says"), says);
}
function next() {
  waiting = false;
  step += 1;
  show(step < STEPS.length ? undefined : `Sharp again. ${compared()}`);
}

/** @returns {string} */
function compared() {
  const values = rms.map((one) => `${fixed(one, 5)} /mm`).join(", then ");
  return `Rms difference from the truth: ${values}.`;
}

/** @param {string} why */
function failed(why) {
  waiting = false;
  show(why);
}

async function bend() {
  step = 0;
  rms.length = 0;
  setText($("#story-found"), "");
  believed = chosen();
  const wrong = { parameters: believed, source: null, comment: COMMENT };
  if (!(await command("sample.set", { name: OBJECT }, "The sample stays"))) return;
  if (!(await command("calibration.apply", wrong, "Not applied"))) return;
  next();
}
async function scan() {
  waiting = true;
  show("Scanning; the volume grows in the scene.");
  dataset = null;
  job = await scanIt(OBJECT);
  if (!job) failed(NOT_BEGUN);
}

/** Scans the phantom; its beads are looked for once its images are there. */
async function fit() {
  waiting = true;
  show("The bead phantom is on the stage, and turns once.");
  phantomJob = await turnOf(PHANTOM, PHANTOM_VIEWS);
  if (!phantomJob) failed(NOT_BEGUN);
}

/** @param {string} scanned */
async function look(scanned) {
  show("Finding beads in all images …");
  const asked = { datasets: [scanned], phantom: PHANTOM, free: FREE };
  const report = await call("calibration.fit", asked).catch((/** @type {unknown} */ error) =>
    words(error),
  );
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
  found = { correction, source: scanned };
  tell(report.parameters);
  next();
}

/**
 * What the beads say beside what the sliders said when the geometry was bent.
 * @param {Record<string, unknown>} parameters
 */
function tell(parameters) {
  const rows = Object.entries(BELIEFS).map(([name, [what, unit]]) => {
    const found = /** @type {Found | undefined} */ (parameters[name]);
    return el("div", {}, beliefWords(what, unit, believed[name], found));
  });
  $("#story-found").replaceChildren(...rows);
}
async function use() {
  if (!found) return;
  if (await apply(found.correction, found.source, "after a story", true)) next();
}
on("job", (/** @type {JobStatus} */ told) => {
  if (!waiting || (told.job !== job && told.job !== phantomJob)) return;
  if (isUnfinished(told)) failed(`The scan is ${told.state}.`);
  if (told.state !== "done") return;
  if (told.job === phantomJob) {
    phantomJob = null;
    void look(folder(told));
  } else {
    job = null;
    dataset = folder(told);
    show("Reconstructing, and comparing with the truth …");
  }
});
on("volume", (volume) => {
  if (!waiting || !volume.past || volume.name !== dataset) return;
  const problem = volume.problem ?? volume.not_compared;
  if (problem) {
    failed(problem);
    return;
  }
  if (!volume.compared) return;
  dataset = null;
  rms.push(Object.values(volume.compared)[0].rms);
  next();
  if (step === 2) show(`${compared()} ${STEPS[2][2]}`);
});
on("connection", () => {
  if (!store.twin && waiting) failed("The connection was lost meanwhile.");
});
clicks({
  "story-bend": bend,
  "story-scan": scan,
  "story-fit": fit,
  "story-apply": use,
  "story-again": scan,
});
says();
show();
export function open() {
  emit("show-tab", "calibrate");
  card.open = true;
}
