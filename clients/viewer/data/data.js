// The Data tab: a browser of data sets; one that is open goes through its images, radiograph and
// machine together.
import {
  $,
  $$,
  $button,
  $dialog,
  $input,
  $select,
  clicks,
  el,
  fixed,
  putImage,
  seconds,
  setText,
  slid,
  within,
  words,
} from "./dom.js";
import { allJobs, call, command, emit, enter, on, store } from "./link.js";
import { asked, remember } from "./address.js";
import { differences, ofImage, ofVolume, only, sampleOf } from "./fingerprint.js";
import { scanSaturated } from "./image_words.js";
import { indexOf, nameOf, NOW } from "./moment.js";
import { draw as drawTimeline } from "./timeline.js";
import { offer } from "./share.js";
import * as compare from "./compare.js";
import * as marks from "./marks.js";
/**
 * @import { Fingerprint } from "./fingerprint.js"
 * @import { AboutImage, DatasetInfo, DatasetResult, ImageValue, JobStatus, Kind }
 *   from "../web/viewer.d.ts"
 * @import { Lanes } from "./timeline.js"
 */

const SEARCH_MS = 250;
const AGAIN_MS = 500;
const PLAYED = 300;
const LEAST_MS = 60;
const LEAST_PX = 76;
/** @type {Record<DatasetInfo["state"], string>} */
const WORDS = {
  complete: "complete",
  incomplete: "incomplete",
  running: "running",
  unknown: "cannot be read in full",
};

/**
 * What is open: as it was told first, and once more when it had been measured (at fewer
 * places).
 * @typedef {DatasetResult & { whole?: DatasetResult }} Opened
 */

/** @type {DatasetInfo[]} */
let listed = [];
/** @type {Opened | null} */
let told = null;
/** @type {Lanes | null} */
let plan = null;
let index = 0;
/** @type {number | null} */
let next = null;
let asking = false;
// Of the image that is shown; "" for none.
let imageName = "";
let playing = false;
let number = 0;

const search = $input("#data-search");
clicks({ "data-more": () => list(listed.length) });
/** @type {HTMLInputElement} */
const slider = el("input", {
  type: "range",
  id: "record-frame",
  min: 0,
  step: 1,
  value: 0,
  "aria-label": "Image",
  oninput: () => show(Number(slider.value)),
});
const canvas = el("canvas", {
  id: "record-line",
  role: "img",
  "aria-label": "Motors, clearance and counts over time",
});

/**
 * @param {string} id
 * @param {string} text
 * @param {string} title
 * @param {() => unknown} f
 */
const button = (id, text, title, f) =>
  el("button", { id, class: "small", title, onclick: f }, text);
const panel = el(
  "div",
  { id: "record", hidden: true },
  el(
    "div",
    { class: "row head" },
    el("b", { id: "record-name", class: "cut" }),
    el("span", { id: "record-state", class: "muted cut" }),
    el("span", { class: "spacer" }),
    button(
      "record-fit",
      "Calibrate",
      "Calibrate from this data set: its sample is the phantom",
      () => {
        if (told) emit("calibrate", told.info.name, told.info.sample);
      },
    ),
    button("record-resume", "Resume", "Make the images that are missing", () => {
      if (told) void resume(told.info.name);
    }),
    button("record-align", "Align", "Find the axis of this scan without a phantom", () => {
      if (told) emit("align", told.info.name);
    }),
    button("record-volume", "Reconstruct", "Its volume, as flexdt reconstruct makes it", () => {
      if (told) emit("reconstruct", told.info.name);
    }),
    button("record-script", "Script", "Bring its script into the Scan tab", script),
    button("record-replay", "Replay file", "This scan as one HTML file that plays it", () =>
      offer("viewer.export", { format: "html", replay: true }, "No replay"),
    ),
    button("record-close", "Close", "Back to what is live (Escape)", () =>
      open(null, null, true),
    ),
  ),
  el(
    "div",
    { class: "row head" },
    button("record-play", "▶", "Play", () => play(!playing)),
    button("record-back", "‹", "The image before", () => show(index - 1)),
    slider,
    button("record-next", "›", "The next image", () => show(index + 1)),
    el("span", { id: "record-at", class: "mono small-text cut" }),
  ),
  el(
    "div",
    { class: "row-pair" },
    compare.row,
    marks.row((all) => {
      if (told) emit("calibrate", told.info.name, told.info.sample, all);
    }),
  ),
  el(
    "div",
    {
      class: "lanes",
      tabIndex: 0,
      role: "group",
      "aria-label": "Motors, clearance and counts",
    },
    canvas,
  ),
  el("div", { id: "record-note", class: "muted small-text cut" }),
  el("details", { id: "record-values", hidden: true }),
);
$("#stage").append(panel);

/**
 * Thumbnails come as 8-bit grey.
 * @param {ImageValue | null} small
 */
function thumbnail(small) {
  const none = { class: "none", width: 1, height: 1 };
  return small ? putImage(el("canvas"), small) : el("canvas", none);
}

/** @param {DatasetInfo} info */
const dated = (info) =>
  info.started
    ? info.started.slice(0, 16).replace("T", " ")
    : new Date(1000 * info.modified).toISOString().slice(0, 16).replace("T", " ");
/** @param {DatasetInfo} info */
function settings(info) {
  const saved = info.state === "running" ? " saved" : "";
  const frames =
    info.present < info.projections
      ? `${info.present}${saved} of ${info.projections} projections`
      : `${info.projections} projections`;
  const beam = info.kV === null ? null : `${fixed(info.kV, 0)} kV ${fixed(info.power_W, 0)} W`;
  return [
    frames,
    beam,
    info.exposure_ms === null ? null : `${fixed(info.exposure_ms, 0)} ms`,
    info.sample || null,
    scanSaturated(info.saturated),
  ]
    .filter(Boolean)
    .join(" · ");
}

/**
 * Whether images of an unfinished data set are missing: an abort after the last one leaves none.
 * @param {DatasetInfo} info
 */
const lacks = (info) => info.present < info.projections || info.problem !== "";

/** @param {DatasetInfo} info */
function row(info) {
  const why = info.problem || info.reason;
  const node = el(
    "button",
    {
      class: "data-set",
      "data-name": info.name,
      title: why,
      onclick: () => open(info.name, null, true),
    },
    thumbnail(info.thumbnail),
    el(
      "span",
      {},
      el("b", {}, info.name),
      el("span", { class: "muted" }, dated(info)),
      el("span", { class: "settings" }, settings(info)),
      el(
        "span",
        { class: `state ${info.state}` },
        info.state === "incomplete" && why
          ? `${lacks(info) ? "incomplete" : "all images are there"}: ${why}`
          : info.state === "unknown" && why
            ? why
            : WORDS[info.state],
      ),
    ),
  );
  node.setAttribute("aria-current", String(info.name === told?.info.name));
  if (info.state !== "incomplete" || !lacks(info)) return [node];
  const title = `Make the images of ${info.name} that are missing`;
  const go = { class: "small data-resume", title, onclick: () => resume(info.name) };
  return [node, el("button", go, `Resume ${info.name}`)];
}
async function list(start = 0) {
  const mine = ++number;
  const answer = await call("viewer.datasets", {
    search: search.value.trim().slice(0, 200),
    start,
  }).catch(words);
  if (mine !== number) return;
  if (typeof answer === "string") {
    setText($("#data-count"), answer);
    return;
  }
  listed = [...(start ? listed : []), ...answer.datasets];
  const key = JSON.stringify(listed);
  // A click is lost with its row.
  if (key !== drawn) $("#data-list").replaceChildren(...listed.flatMap(row));
  drawn = key;
  $button("#data-more").hidden = listed.length >= answer.total;
  const left = answer.left_out ? ` · ${answer.left_out} folders left out` : "";
  const none = search.value ? "none is found" : "none yet: run a scan";
  const shown = listed.length < answer.total ? `${listed.length} of ${answer.total} scans` : "";
  const whole = answer.total === 1 ? "1 scan" : `${answer.total} scans`;
  const all = answer.total ? (shown || whole) + left : none;
  setText(
    $("#data-count"),
    answer.unread ? `${answer.total} data sets · reading ${answer.unread} more …` : all,
  );
  if (answer.unread && !$("#tab-data").hidden)
    setTimeout(() => {
      if (mine === number) void list();
    }, AGAIN_MS);
}

/** @type {number | undefined} */
let typing;
let drawn = "";
function listSoon() {
  clearTimeout(typing);
  typing = window.setTimeout(list, SEARCH_MS);
}
search.addEventListener("input", listSoon);
on("tab", (tab) => {
  if (tab === "data" && store.session) void list();
});
on("session", () => {
  if (!$("#tab-data").hidden) void list();
});

/**
 * The images of a data set that are missing: by its job, or by its script under the same name.
 * @param {string} name
 */
async function resume(name) {
  const none = `${name} does not go on`;
  const jobs = await allJobs().catch((/** @type {unknown} */ error) => {
    emit("note", "error", none, words(error));
    return null;
  });
  if (!jobs) return;
  const job = jobs.findLast((each) => folder(each) === name);
  if (job) {
    await command("job.resume", { job: job.job }, none);
    return;
  }
  const data = await command("dataset.get", { name, points: 2, script: true }, none);
  if (data?.script) await command("script.submit", { text: data.script, name }, none);
}

/**
 * @param {JobStatus | null} job
 * @returns {string}
 */
export const folder = (job) => (job?.dataset ?? "").split(/[\\/]/).pop() || "?";
on("job", (job) => {
  if (!$("#tab-data").hidden) listSoon();
  // Open while it was scanned: now it has more images, or all.
  if (
    told?.info.state === "running" &&
    folder(job) === told.info.name &&
    !["queued", "running", "paused"].includes(job.state)
  )
    void open(told.info.name, index);
});

/**
 * Opens a data set at an image, by its number or name, or closes the one that is open (null).
 * @param {string | null} name
 * @param {number | string | null} [at]
 */
export async function open(name, at = null, step = false) {
  void play(false);
  next = null;
  const mine = ++opening;
  const answer =
    name === null
      ? await call("viewer.recorded", { name }).catch(() => null)
      : await command("viewer.recorded", { name }, `${name} cannot be opened`);
  if (mine !== opening || (name !== null && !answer)) return;
  told = name === null ? null : answer;
  plan = null;
  panel.hidden = told === null;
  $("#stage").classList.toggle("recorded", told !== null);
  for (const node of $$("#data-list > *"))
    node.setAttribute("aria-current", String(node.dataset.name === name));
  clearTimeout(kept);
  remember({ data: name, frame: typeof at === "string" ? at : null }, step);
  enter(name === null ? NOW : { kind: "image", dataset: name, index: null, missing: false });
  if (name === null || !told) return;
  const i = told.info;
  const bare = !told.times_s;
  setText($("#record-name"), i.name);
  setText(
    $("#record-state"),
    [
      [WORDS[i.state], i.problem || i.reason].filter(Boolean).join(": "),
      settings(i),
      i.duration_s ? seconds(i.duration_s) : "",
    ]
      .filter(Boolean)
      .join(" · "),
  );
  $("#record-state").title = $("#record-state").textContent;
  compare.allow(
    told.same_machine ? "" : "not this twin’s machine and zeros, or poses that are not known",
  );
  $button("#record-resume").hidden = i.state !== "incomplete";
  $button("#record-replay").disabled = bare || !told.same_machine;
  slider.max = String(Math.max(0, told.images - 1));
  setText($("#record-note"), note());
  showValues(told.provenance);
  lanes();
  const asked = typeof at === "string" ? indexOf(at, told) : at;
  await show(Math.min(Math.max(0, asked ?? told.kinds.indexOf("projection")), told.images - 1));
  const measured = await call("dataset.get", {
    name,
    points: 400,
    measure: true,
  }).catch(() => null);
  if (mine !== opening || !measured) return;
  told = { ...measured, whole: told };
  setText($("#record-note"), note());
  lanes();
}
let opening = 0;

/**
 * Values of another program's file with what became of each; none of flexdt's own scans.
 * @param {DatasetResult["provenance"]} values
 */
function showValues(values) {
  const box = $("#record-values");
  box.hidden = !values.length;
  const unused = values.filter((one) => one.use !== "used").length;
  /** @param {"th" | "td"} tag @param {string[]} texts */
  const row = (tag, texts) => el("tr", {}, ...texts.map((text) => el(tag, {}, text)));
  box.replaceChildren(
    el("summary", {}, `${values.length} values of its file, ${unused} not used`),
    el(
      "table",
      { class: "small-text" },
      row("th", ["field", "value", "use", "consequence"]),
      ...values.map((one) => row("td", [one.field, one.value, one.use, one.consequence])),
    ),
  );
}

/**
 * What the virtual image that is shown was made of; null where there is none.
 * @returns {Fingerprint | null}
 */
function virtualMade() {
  const origin = store.image?.recorded?.virtual_origin;
  return origin ? only(ofImage(origin, null, ""), "sample", "placement", "correction") : null;
}

/**
 * @param {string} scanned
 * @returns {string}
 */
function virtualWords(scanned) {
  const made = virtualMade();
  if (!made) return "";
  const name = sampleOf(made);
  const shown = name === "empty" ? "empty stage" : name;
  const other =
    name === scanned ? "" : ` (the scan says ${scanned || "nothing of its sample"})`;
  const { correction } = made;
  const geometry =
    typeof correction === "string" ? `correction ${correction}` : "nominal geometry";
  return `virtual: ${shown}${other}, ${geometry}`;
}
/**
 * Why the scene draws no sample: another one stands there than the scan's; "" where it is the
 * scan's own.
 * @param {DatasetResult["made"]} made
 */
function apartWords(made) {
  const none = "no sample in the scene:";
  if (!made.offset) return `${none} where the scan’s stood is not known`;
  const differ = differences(only(ofVolume(made), "sample", "placement"), store.now ?? {});
  if (differ.includes("sample"))
    return `${none} now ${store.state?.sample.name || "nothing"} stands there`;
  return differ.length ? `${none} the scan’s has been moved since` : "";
}
/** Those words of the data set that is open; "" without one. */
export const samplesApart = () => (told ? apartWords(told.made) : "");
function note() {
  if (!told) return "";
  /** @type {string[]} */
  const parts = [apartWords(told.made)].filter(Boolean);
  if (!Object.keys(told.positions).length)
    parts.push("poses and times are not known: only images are shown");
  else if (!told.same_machine)
    parts.push(
      "another machine or other zeros than this twin's: its pose is not drawn in the scene",
    );
  if (compare.how() !== "recorded") {
    parts.push(virtualWords(told.info.sample));
  }
  if (told.clearance_of) parts.push(`clearance: ${told.clearance_of}`);
  parts.push(
    told.counts === null
      ? "measuring counts and clearances …"
      : told.counts.some((c) => c === null)
        ? "gaps: images that cannot be read"
        : "",
  );
  return parts.filter(Boolean).join(" · ");
}
function lanes() {
  if (!told) return;
  const { kinds } = told;
  const times = told.times_s ?? told.indices;
  /** @type {Lanes["curves"]} */
  const curves = {};
  /** @type {Lanes["units"]} */
  const units = {};
  for (const [name, values] of Object.entries(told.positions)) {
    const known = values.filter((v) => v !== null);
    const moves = known.some((v) => Math.abs(v - (known[0] ?? v)) > 1e-6);
    if (moves) {
      curves[name] = values;
      units[name] = store.state?.axes[name]?.unit === "deg" ? "°" : "mm";
    }
  }
  if (told.clearance_mm) {
    curves.clearance = told.clearance_mm;
    units.clearance = "mm";
  }
  if (told.counts) {
    curves["mean counts"] = told.counts;
    units["mean counts"] = "";
  }
  plan = {
    duration_s: times.at(-1) ?? 0,
    times,
    curves,
    units,
    images: times.map((t, k) => [t, kinds[k]]),
    axis: told.times_s ? "s" : "",
  };
  redraw();
}

/** @type {number | null} */
let moment = null;
/** @type {number | undefined} */
let kept;
function redraw() {
  if (!plan || panel.hidden) return;
  const rest = panel.offsetHeight - $(".lanes", panel).offsetHeight + 2;
  const room = Math.max(LEAST_PX, 0.45 * $("#stage").clientHeight - rest);
  drawTimeline(canvas, plan, moment, null, room);
  $("#stage").style.setProperty("--record", `${rest + Math.min(canvas.offsetHeight, room)}px`);
}

/** @param {string} name */
const still = (name) => told?.info.name === name;
const kindAsked = () => /** @type {Kind} */ ($select("#kind").value);
/**
 * The newest image asked for wins; one that cannot be shown leaves no other in its place.
 * @param {number} wanted
 */
async function show(wanted) {
  if (!told) return;
  index = Math.min(Math.max(0, wanted), told.images - 1);
  slider.value = String(index);
  next = index;
  if (asking) return;
  asking = true;
  const name = told.info.name;
  while (next !== null && still(name)) {
    /** @type {number} */
    const at = next;
    /** @type {DatasetResult} */
    const kinds = told.whole ?? told;
    const k = kinds.indices.indexOf(at);
    next = null;
    // Dark and flat images have no line integrals; of an image between those told the answer says
    // what it is.
    const kind = k >= 0 && kinds.kinds[k] !== "projection" ? "counts" : kindAsked();
    /** @type {AboutImage | null} */
    let about = null;
    let why = "";
    try {
      about = await call("viewer.recorded_image", {
        index: at,
        kind,
        virtual: compare.how() !== "recorded",
      });
    } catch (error) {
      why = words(error);
      if (kind !== "counts")
        about = await call("viewer.recorded_image", { index: at, kind: "counts" }).catch(
          () => null,
        );
    }
    if (!still(name)) break;
    moment = about ? (about.time_s ?? at) : told.times_s ? null : at;
    enter({ kind: "image", dataset: name, index: at, missing: !about });
    imageName = about ? nameOf(about.file) : "";
    panel.dataset.index = String(at);
    panel.dataset.shown = String(Boolean(about));
    const facts = about && [
      nameOf(about.file),
      about.time_s === null ? "" : `${fixed(about.time_s, 2)} s`,
      about.image === "projection" ? "" : about.image,
      why && `counts: ${why}`,
      about.problem && `no virtual image: ${about.problem}`,
    ];
    setText($("#record-at"), (facts ?? [why]).filter(Boolean).join(" · "));
    $("#record-at").title = $("#record-at").textContent;
    redraw();
  }
  asking = false;
  if (told && next !== null) {
    void show(next);
    return;
  }
  clearTimeout(kept);
  kept = window.setTimeout(() => {
    if (told && imageName) remember({ frame: imageName });
  }, SEARCH_MS);
}

/** @param {boolean} on */
async function play(on) {
  playing = on;
  setText($button("#record-play"), on ? "❚❚" : "▶");
  $button("#record-play").title = on ? "Pause" : "Play";
  if (!on || !told) return;
  if (index >= told.images - 1) index = -1;
  const step = Math.max(1, Math.round(told.images / PLAYED));
  while (playing && told && index < told.images - 1) {
    const begun = performance.now();
    await show(index + step);
    await new Promise((done) =>
      setTimeout(done, Math.max(0, LEAST_MS - (performance.now() - begun))),
    );
  }
  if (playing) void play(false);
}
async function script() {
  if (!told) return;
  const answer = await command(
    "dataset.get",
    { name: told.info.name, points: 2, script: true },
    "No script",
  );
  if (answer?.script) emit("script", answer.script);
}
// The virtual image goes with what the twin has in force: made anew once for each change of that.
let askedFor = "";
const anew = () => {
  if (!told) return;
  setText($("#record-note"), note());
  void show(index);
};
on("compare", anew);
on("image", () => {
  if (told) setText($("#record-note"), note());
});
on("state", () => {
  if (told) setText($("#record-note"), note());
  const made = virtualMade();
  if (!made || !store.now || compare.how() === "recorded") return;
  if (!differences(made, store.now).length) return;
  const key = JSON.stringify(only(store.now, "sample", "placement", "correction"));
  if (key === askedFor) return;
  askedFor = key;
  anew();
});
slid(canvas, (part) => {
  void play(false);
  if (!plan || !told) return;
  const { times, duration_s } = plan;
  const t = part * duration_s;
  const k = times.reduce(
    (best, v, i) => (Math.abs(v - t) < Math.abs(times[best] - t) ? i : best),
    0,
  );
  void show(told.indices[k]);
});
slider.addEventListener("pointerdown", () => void play(false));
new ResizeObserver(redraw).observe(panel);
new MutationObserver(redraw).observe(document.documentElement, {
  attributeFilter: ["data-theme"],
});
$select("#kind").addEventListener("change", () => {
  if (told) void show(index);
});
window.addEventListener("keydown", (e) => {
  if (
    e.key !== "Escape" ||
    panel.hidden ||
    $dialog("#help-dialog").open ||
    within(e.target, "input[type=text], textarea, select")
  )
    return;
  void open(null, null, true);
});
// A viewer that was started again knows nothing of it; a page that was loaded again asks for what
// its address names: once the viewer has seen the twin, and this page has its own connection to
// it.
let lost = false;
let first = true;
let seen = false;
function ready() {
  if (!seen || !store.session) return;
  if (first) {
    first = false;
    restore();
  } else if (lost && told) {
    lost = false;
    void open(told.info.name, index);
  }
}
on("open", () => {
  seen = false;
  lost = told !== null;
});
on("layers", () => {
  seen = true;
  ready();
});
on("session", ready);
export function restore() {
  const name = asked("data");
  const at = asked("frame");
  if (name !== (told?.info.name ?? null)) void open(name, at);
  else if (told && at !== null) void show(indexOf(at, told) ?? index);
}
