// The Scan tab: a script to write, check, scrub and run.
import { partWords } from "./figures.js";
import {
  $,
  $button,
  $canvas,
  $input,
  $select,
  bytes,
  chosen,
  clicks,
  el,
  fixed,
  isNumber,
  pressed,
  seconds,
  setText,
  slid,
  words,
} from "./dom.js";
import { call, command, emit, enter, Failure, on, store } from "./link.js";
import { rememberedScript, rememberScript } from "./address.js";
import { folder, open as openData } from "./data.js";
import { differences, listed, only } from "./fingerprint.js";
import { draw as drawTimeline } from "./timeline.js";
import * as designer from "./designer.js";
import { isOver } from "./job_words.js";
import { tellSubmitted } from "./scan_job.js";
import { NOW } from "./moment.js";
import { effect } from "./signals.js";
import { exposure_ms, frames, kind, sameWish, wished, wishWords } from "./scan_wish.js";
import { hindered } from "./warnings.js";
/**
 * @import { CheckResult, CheckStep, Pair, PlanDocument, Problem, ScriptInput }
 *   from "../web/viewer.d.ts"
 * @import { Fingerprint, Quantity } from "./fingerprint.js"
 * @import { Lanes } from "./timeline.js"
 * @import { Wish } from "./scan_wish.js"
 */

/** @type {HTMLTextAreaElement} */
const text = $("#script");
const gutter = $("#gutter");
const ink = $("#paint div");
const LINE_PX = 16;
let written = [""];
/** @type {Map<number, "hit" | "soft">} */
let worst = new Map();
/** @type {Problem[]} */
let problems = [];
/** @type {(Lanes & PlanDocument) | null} */
let plan = null;
let planned = "";
let lost = false;
let sent = "";
let starting = false;
// Whether the newest report of the script as it stands says that it may not run.
let unfit = false;

designer.place($("#tab-scan .card"));
clicks({
  "script-open": () => $input("#script-file").click(),
  check: checkAndPlan,
  plan: showPlan,
  run,
  compose: () => compose(),
  unscrub: () => scrub(null),
  "job-scrub": recall,
});

const NO_SCRIPT = $("#empty-note").textContent;
function emptyNote() {
  const job = store.job;
  const runs =
    job && !isOver(job) ? `${job.name || job.job} runs from a script of its own. ` : "";
  setText($("#empty-note"), `${runs}${NO_SCRIPT}`);
}
on("scan", emptyNote);
function marks() {
  written = text.value.split("\n");
  worst = new Map();
  for (const id of ["#check", "#plan"]) $button(id).disabled = !text.value.trim();
  allow();
  $("#empty-note").hidden = text.value.trim() !== "";
  emptyNote();
  for (const p of problems) {
    if (p.line)
      worst.set(p.line, worst.get(p.line) === "hit" || p.severity === "error" ? "hit" : "soft");
  }
  gutter.textContent = "";
  for (let i = 1; i <= Math.min(written.length, 20000); i++) {
    gutter.append(
      worst.has(i) ? el("span", { class: worst.get(i), title: said(i) }, String(i)) : String(i),
      "\n",
    );
  }
  paint();
}

/**
 * Nothing runs where nothing moves for this page, nor another script than the fields ask for, nor
 * one that is not ready; while a scan runs another one waits for it.
 */
function allow() {
  const why = hindered(store.state) || otherScript() || (unfit ? "not ready: see below" : "");
  const run = $button("#run");
  const waits = store.job !== null && !isOver(store.job);
  run.disabled = starting || !text.value.trim() || why !== "";
  run.title = why || (waits ? "It waits for the scan that runs" : "");
  run.classList.toggle("primary", !why && !waits);
  setText(run, starting ? "Starting …" : waits ? "Run next" : "Run");
}
on("state", allow);
on("job", allow);

/** @param {number} line */
const said = (line) =>
  problems
    .filter((p) => p.line === line)
    .map((p) => p.message)
    .join("; ");

/**
 * The lines in sight, under the text itself, which is transparent: component, command, values,
 * comments.
 */
function paint() {
  const first = Math.max(0, Math.floor(text.scrollTop / LINE_PX) - 1);
  const count = Math.ceil(text.clientHeight / LINE_PX) + 2;
  ink.replaceChildren(
    ...written
      .slice(first, first + count)
      .map((line, i) => el("div", { class: worst.get(first + i + 1) ?? "" }, ...inked(line))),
  );
  ink.style.transform = `translate(${-text.scrollLeft}px, ${first * LINE_PX - text.scrollTop}px)`;
  gutter.scrollTop = text.scrollTop;
}

/** @param {string} line */
function inked(line) {
  if (/^\s*(#|\/\/|;)/.test(line)) return [el("i", {}, line)];
  return line
    .slice(0, 2000)
    .split("\t")
    .flatMap((word, k) => [
      k ? "\t" : "",
      k === 0
        ? el("b", {}, word)
        : k > 1 && /^[-+]?[\d.]/.test(word)
          ? el("u", {}, word)
          : word,
    ]);
}

/** What is wrong with the line that the caret is in. */
function tellLine() {
  const line =
    document.activeElement === text && worst.size
      ? text.value.slice(0, text.selectionStart).split("\n").length
      : 0;
  $("#line-note").textContent = worst.has(line) ? `line ${line}: ${said(line)}` : "";
  $("#line-note").className = `small-text ${worst.get(line) === "hit" ? "error" : ""}`;
}
document.addEventListener("selectionchange", tellLine);
new ResizeObserver(paint).observe(text);

/**
 * What was found out belongs to the script as it stood: report, marks and timeline go with an
 * edit.
 */
function outdated() {
  problems = [];
  marks();
  $("#report").textContent = "";
  unfit = false;
  tellWish();
  forget();
  rememberScript(text.value);
}
const dismiss = () => void call("viewer.plan", { text: null }).catch(() => {});
function forget() {
  $("#timeline-card").hidden = true;
  if (plan) dismiss();
  plan = null;
  if (store.moment.kind === "plan") enter(NOW);
  next = null;
  lost = false;
}
text.addEventListener("input", outdated);
text.addEventListener("scroll", paint);
// Tab writes a tab, as scripts need it; Shift+Tab, or Escape and then Tab, leaves.
let leaving = false;
text.addEventListener("keydown", (e) => {
  if (e.key === "Tab" && !e.shiftKey && !leaving) {
    e.preventDefault();
    text.setRangeText("\t", text.selectionStart, text.selectionEnd, "end");
    outdated();
  }
  leaving = e.key === "Escape";
});
text.addEventListener("blur", () => {
  leaving = false;
});
chosen($input("#script-file"), async (file) => {
  setScript(await file.text());
  sent = file.name.replace(/\.[^.]*$/, "");
});

/** @param {string} value */
export function setScript(value) {
  text.value = value;
  sent = "";
  outdated();
}

/** @param {number | null} line */
export function goTo(line) {
  if (!line) return;
  const lines = text.value.split("\n");
  const start = lines.slice(0, line - 1).reduce((n, l) => n + l.length + 1, 0);
  text.focus();
  text.setSelectionRange(start, start + (lines[line - 1]?.length ?? 0));
  text.scrollTop = Math.max(0, (line - 5) * 16);
  text.scrollLeft = 0;
}

/** @param {string[]} [keep] */
async function compose(keep = []) {
  const none = "No script was composed";
  const wish = wished();
  if (typeof wish === "string") {
    emit("note", "error", none, wish);
    return;
  }
  const params = { ...designer.wish(), ...wish, keep };
  const answer = await call("viewer.compose", params).catch(words);
  if (typeof answer === "string") {
    emit("note", "error", none, answer);
    refused = { wish, why: answer, beside: text.value };
    tellWish();
    return;
  }
  refused = null;
  setScript(answer.text);
  const mine = (made = text.value);
  writtenFor = wish;
  tellWish();
  await check();
  if (text.value === mine) offer(answer.moved, keep);
}
// What the written script was wished to be, and the last wish that gave no script: while another
// one stands in the fields, the script beside them is not of it.
/** @type {Wish | null} */
let writtenFor = null;
/** @type {{ wish: Wish; why: string; beside: string } | null} */
let refused = null;
/**
 * Why the script is not what the fields ask for: Write was refused for them. A script of
 * somebody's own, or an edit of one, is meant.
 * @returns {string}
 */
function otherScript() {
  const wish = wished();
  if (!refused || typeof wish === "string" || text.value !== refused.beside) return "";
  if (!sameWish(refused.wish, wish)) return "";
  return "Write was refused: this is the script of before. Change it, or the fields";
}
function tellWish() {
  const wish = wished();
  const note = $("#wish-note");
  allow();
  if (typeof wish === "string") {
    setText(note, wish);
  } else if (refused && sameWish(refused.wish, wish)) {
    const old = otherScript() ? " The script above is the one of before: it does not run." : "";
    setText(note, `Not written: ${refused.why}.${old}`);
  } else if (writtenFor && text.value === made && !sameWish(writtenFor, wish)) {
    setText(note, `The script above is of ${wishWords(writtenFor)}: press Write for these.`);
  } else setText(note, "");
  note.hidden = !note.textContent;
}
effect(() => {
  kind.get();
  frames.get();
  exposure_ms.get();
  tellWish();
});
// The designer rewrites what was written here; a script of somebody's own stays until Write is
// pressed.
let made = "";
on("design", () => {
  if (!text.value || text.value === made) void compose();
});

/**
 * What stands elsewhere than a scan's script would put it may be meant so.
 * @param {Record<string, Pair>} moved
 * @param {string[]} kept
 */
function offer(moved, kept) {
  const axes = Object.entries(moved);
  /** @param {string} axis */
  const unit = (axis) => (store.state?.axes[axis]?.unit === "deg" ? "°" : " mm");
  if (kept.length)
    $("#report").prepend(el("div", { id: "kept" }, `kept where it stands: ${kept.join(", ")}`));
  if (!axes.length) return;
  $("#report").prepend(
    el(
      "div",
      { id: "moved" },
      ...axes.map(([axis, [now, then]]) =>
        el(
          "div",
          {},
          `${axis} stands at ${fixed(now, 2)}${unit(axis)}; ` +
            `the script puts it to ${fixed(then, 2)}`,
        ),
      ),
      el(
        "button",
        {
          id: "keep",
          class: "small",
          onclick: () => compose([...kept, ...Object.keys(moved)]),
        },
        axes.length > 1 ? "Keep them where they stand" : "Keep it where it stands",
      ),
    ),
  );
}

/** @typedef {Omit<CheckResult, "collisions">} Report */

/** @typedef {Partial<Problem> & { message: string }} Told */

async function check() {
  const report = $("#report");
  const asked = text.value;
  const made = now();
  report.textContent = "checking…";
  /** @type {Report} */
  let answer;
  try {
    answer = await call("script.check", { text: asked });
  } catch (error) {
    if (text.value !== asked) return false;
    const data =
      error instanceof Failure
        ? /** @type {Told[] | { problems?: Told[] } | null | undefined} */ (error.data)
        : null;
    const list = Array.isArray(data) ? data : data?.problems;
    if (!Array.isArray(list)) {
      report.textContent = "";
      emit("note", "error", "Check", words(error));
      return false;
    }
    const problems = list.map((p) => ({
      severity: /** @type {const} */ ("error"),
      code: "syntax",
      line: null,
      column: null,
      ...p,
    }));
    answer = {
      ok: false,
      problems,
      steps: [],
      frames: 0,
      bytes: 0,
      duration_s: NaN,
      min_clearance_mm: null,
      min_clearance_pair: null,
    };
  }
  if (text.value !== asked) return false;
  show(answer, made);
  return answer.ok;
}

/** A script that may run is drawn over time, too. */
async function checkAndPlan() {
  if (await check()) await makePlan(text.value, null);
}

const MOVING_PARTS =
  "Other parts than these stand or move together during the script; they may be nearer";

/**
 * @param {Report} report
 * @returns {string}
 */
function clearance({ min_clearance_mm: mm, min_clearance_pair: pair }) {
  if (!isNumber(mm) || problems.some(({ code }) => code === "collision")) return "";
  const parts = pair ? pair.map(partWords).join(" and ") : "moving parts";
  return `of what it moves, ${parts} come closest during it: ${fixed(mm, 1)} mm`;
}

/**
 * Problems, with the collisions of one line's motion together: the first ends it.
 * @param {Problem[]} all
 * @returns {Problem[][]}
 */
function events(all) {
  /** @type {Problem[][]} */
  const found = [];
  for (const p of all) {
    const last = found.at(-1)?.[0];
    const same = last?.code === "collision" && p.code === "collision" && last.line === p.line;
    if (same) found.at(-1)?.push(p);
    else found.push([p]);
  }
  return found;
}

/**
 * @param {Report} r
 * @param {Fingerprint | null} [made]
 */
export function show(r, made = now()) {
  // Each of `collisions` is among the problems already, in words.
  problems = r.problems.map((p) =>
    p.code === "collision" ? { ...p, message: `collision: ${p.message}` } : p,
  );
  marks();
  const box = $("#report");
  box.textContent = "";
  const warnings = problems.filter(({ severity }) => severity !== "error").length;
  const warned = warnings ? `, ${warnings} warning${warnings === 1 ? "" : "s"}` : "";
  const facts = r.frames
    ? [seconds(r.duration_s), `${r.frames} frames`, bytes(r.bytes), clearance(r)]
    : [r.duration_s ? seconds(r.duration_s) : "", clearance(r)];
  box.append(
    el(
      "div",
      {},
      el(
        "span",
        { class: `verdict ${r.ok ? "ok" : "bad"}` },
        r.ok ? `Ready to run${warned}` : "Not ready",
      ),
      el(
        "span",
        {
          class: "muted",
          title: MOVING_PARTS,
        },
        `  ${facts.filter(Boolean).join(" · ")}`,
      ),
    ),
  );
  /** @param {number | null} line */
  const link = (line) =>
    line
      ? el(
          "a",
          pressed(() => goTo(line)),
          `line ${line}`,
        )
      : el("span", { class: "muted" }, "whole");
  /** @param {typeof problems[number]} p */
  const row = (p) =>
    el(
      "div",
      { class: "problem" },
      link(p.line),
      el("span", { class: p.severity === "error" ? "error" : "caution" }, p.message),
    );
  for (const [first, ...rest] of events(problems.slice(0, 100))) {
    box.append(row(first));
    if (!rest.length) continue;
    const more = `${rest.length} more pair${rest.length > 1 ? "s" : ""} of the same motion`;
    box.append(el("details", {}, el("summary", {}, more), ...rest.map(row)));
  }
  if (r.steps.length)
    box.append(el("div", { class: "steps mono" }, ...r.steps.slice(0, 500).map(stepRow)));
  checked = made;
  unfit = !r.ok;
  allow();
}
// A report holds for what a script begins with. While a scan runs, the machine is on its way:
// what it then differs in is known when it has ended, and after a run of this script it is
// checked anew.
const BEGUN_WITH = [
  "twin",
  "machine",
  "sample",
  "placement",
  "motors",
  "camera",
  "tube",
  "correction",
];
/** @type {Fingerprint | null} */
let checked = null;
/** @type {{ job: string; script: string } | null} */
let ran = null;
const now = () =>
  store.now ? only(store.now, .../** @type {Quantity[]} */ (BEGUN_WITH)) : null;
/** @returns {Quantity[]} */
function outdates() {
  const stands = now();
  if (!checked || !stands || store.state?.job) return [];
  return differences(checked, stands);
}
on("state", () => {
  const box = $("#report");
  const differ = box.querySelector(".verdict") === null ? [] : outdates();
  box.classList.toggle("stale", differ.length > 0);
  const old = document.getElementById("stale");
  if (!differ.length) {
    old?.remove();
    return;
  }
  const words = `The machine has changed since (${listed(differ)}): check again`;
  if (old) setText(old, words);
  else box.prepend(el("div", { id: "stale" }, words));
});
on("scan", () => {
  const job = store.job;
  if (!ran || job?.job !== ran.job || !isOver(job)) return;
  const { script } = ran;
  ran = null;
  if (script === text.value && checked) recheck = true;
});
let recheck = false;
on("state", (state) => {
  if (!recheck || state.job || Object.values(state.axes).some((axis) => axis.moving)) return;
  recheck = false;
  void check();
});

/** @param {CheckStep} s */
function stepRow(s) {
  const go = () => {
    goTo(s.line);
    if (plan) void scrub(s.start_s + s.duration_s);
  };
  return el(
    "div",
    pressed(go),
    el("a", {}, String(s.line ?? "")),
    el("span", { class: "muted" }, `${fixed(s.start_s, 1)} s`),
    el("span", { title: s.what }, s.what),
  );
}

/** @param {number | null} [time] */
async function makePlan(script = text.value, time = 0) {
  if (store.recorded) await openData(null);
  const answer = await command("viewer.plan", { text: script }, "No plan");
  if (text.value !== script) {
    if (answer && !plan) dismiss();
    return;
  }
  if (!answer) {
    forget();
    return;
  }
  const units = Object.fromEntries(
    Object.keys(answer.curves).map((axis) => [
      axis,
      store.state?.axes[axis]?.unit === "deg" ? "°" : "mm",
    ]),
  );
  plan = { ...answer, units };
  planned = script;
  $("#timeline-card").hidden = false;
  void scrub(time);
}

/** The timeline may lie below a long report. */
async function showPlan() {
  await makePlan();
  if (plan) $("#timeline-card").scrollIntoView({ block: "nearest" });
}
// A plan lives in the viewer: one that was started again makes it anew, once it has seen the
// twin.
on("open", () => {
  lost = plan !== null;
});
on("layers", () => {
  if (lost) {
    lost = false;
    void makePlan(planned, at());
  }
});

on("recorded", (name) => {
  if (name !== null) forget();
});

/** A scan that was run, as it was planned: its script lies with its data set. */
async function recall() {
  const dataset = folder(store.job);
  const answer = await command(
    "dataset.get",
    { name: dataset, points: 2, script: true },
    "Cannot scrub this scan",
  );
  if (answer?.script) {
    bring(answer.script);
    await showPlan();
  }
}

/** @param {string} script */
function bring(script) {
  emit("show-tab", "scan");
  setScript(script);
}
on("script", bring);

let asking = false;
/** @type {[number | null] | null} */
let next = null;
const at = () => (store.moment.kind === "plan" ? store.moment.time_s : null);
/** @param {number | null} time */
export async function scrub(time) {
  if (time !== null) enter({ kind: "plan", time_s: time });
  else if (store.moment.kind === "plan") enter(NOW);
  next = [time];
  redraw();
  if (asking) return;
  asking = true;
  while (next) {
    /** @type {[number | null]} */
    const [t] = next;
    next = null;
    await command("viewer.scrub", { time_s: t }, "Cannot show this moment");
  }
  asking = false;
}
function redraw() {
  if (!plan) return;
  const now = at();
  drawTimeline(
    $canvas("#timeline"),
    plan,
    now,
    store.job && !isOver(store.job) ? store.job.elapsed_s : null,
  );
  const step = now === null ? null : plan.steps.findLast((s) => s.start_s <= now + 1e-9);
  $("#scrub-at").textContent =
    now === null
      ? `${seconds(plan.duration_s)} in all`
      : `${fixed(now, 1)} s · line ${step?.line ?? "–"} · ${step?.what ?? ""}`;
  $("#scrub-at").title = $("#scrub-at").textContent;
  const told = {
    "aria-valuemax": plan.duration_s,
    "aria-valuenow": now ?? 0,
    "aria-valuetext": $("#scrub-at").textContent,
  };
  for (const [name, value] of Object.entries(told)) canvas.setAttribute(name, String(value));
}
const canvas = $canvas("#timeline");
slid(canvas, (part) => {
  if (plan) void scrub(part * plan.duration_s);
});

/** @type {Record<string, number | undefined>} */
const STEPS = {
  ArrowLeft: -0.01,
  ArrowRight: 0.01,
  Home: -1,
  End: 1,
};
canvas.addEventListener("keydown", (e) => {
  const step = STEPS[e.key];
  if (step && plan) {
    e.preventDefault();
    e.stopPropagation();
    void scrub(
      Math.min(1, Math.max(0, (at() ?? 0) / plan.duration_s + step)) * plan.duration_s,
    );
  }
});
new ResizeObserver(redraw).observe(canvas);

async function run() {
  starting = true;
  allow();
  try {
    await submit();
  } finally {
    starting = false;
    marks();
  }
}
async function submit() {
  const speed = $select("#speed-up").value;
  /** @type {ScriptInput} */
  const params = {
    text: text.value,
    speed_up: speed === "max" ? "max" : Number(speed),
  };
  if (sent)
    params.name = `${sent}-${new Date().toISOString().slice(0, 19).replace(/[:T]/g, "-")}`;
  const answer = await call("script.submit", params).catch((/** @type {unknown} */ error) => {
    emit("note", "error", "The script does not run", words(error));
    if (error instanceof Failure && [-32005, -32002].includes(error.code)) void check();
  });
  if (!answer) return;
  ran = { job: answer.job, script: text.value };
  await tellSubmitted("Scan", answer.job);
  for (const warning of answer.warnings.slice(0, 3))
    emit("note", "warning-note", "Scan", warning);
  if (at() !== null) void scrub(null);
}

on("scan", (fresh) => {
  if (fresh || plan) redraw();
});
marks();
void rememberedScript().then((script) => {
  if (script && !text.value) setScript(script);
});
