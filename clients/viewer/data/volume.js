// A volume: the one that grows while a scan runs, or a past scan's, as flexdt reconstruct makes
// it. It comes here as a whole, as slices that scroll and in three dimensions, and beside the
// truth of its sample.
import { along, curve, histogram } from "./plots.js";
import {
  $,
  $button,
  $canvas,
  $input,
  $select,
  clicks,
  el,
  fixed,
  keep,
  setText,
  slid,
  words,
} from "./dom.js";
import { call, emit, on, store } from "./link.js";
import { folder } from "./data.js";
import { reach } from "./filled.js";
import { extent, index, slices, valueOf } from "./slices.js";
import { raycast, ROOM } from "./raycast.js";
import { shared } from "./shared.js";
import { scanSaturated } from "./image_words.js";
import { isOver } from "./job_words.js";
import { otsu } from "./otsu.js";
import { follow } from "./volume_stage.js";
/**
 * @import { Block, Figures, Live, Name, Pair, Vector, VolumeMessage } from "../web/viewer.d.ts"
 */

const KEY = "flexdt-volume";
const STARTING = "starting; dark, flat and a first image are needed";
const BEGINS = "the reconstruction begins";
const COMPARES = "Beside what the sample is made of, with a correction and without";
const GROWS =
  "accuracy and truth come after the scan: open its data set in Data and press Reconstruct";
const WAITED_S = 2;
const EXACT_MS = 60;
// Largest first zoom of a volume in three dimensions, and the room about its object.
const NEAREST = 4;
const MARGIN = 1.1;
/** @type {Record<Name, string>} */
const SHOWN = {
  volume: "volume",
  sigma: "noise (standard deviation)",
  bias_bound: "bound of the bias",
  other: "the other geometry",
  truth: "truth of the sample",
  difference: "volume − truth",
};
const size = $select("#volume-side");
const note = $("#volume-note");
/** @type {HTMLProgressElement} */
const progress = $("#volume-progress");
const shown = $select("#volume-shown");
const histogramHost = $("#volume-histogram");
const chart = histogram(histogramHost);
const profileHost = $("#volume-profile");
const plot = curve(profileHost);
const ends = /** @type {const} */ ([$input("#volume-low"), $input("#volume-high")]);
const level = $input("#volume-level");
size.addEventListener("change", choose);
size.value = localStorage.getItem(KEY) ?? "";

// The past scan whose volume is wanted; else it is the running one's.
/** @type {string | null} */
let past = null;
/** @type {string | null} */
let asked = null;
/** @type {VolumeMessage | null} */
let told = null;
/** @type {Vector | null} */
let pointer = null;
/** @type {Live} */
let of = {};
let wanting = false;
let late = false;
let comparing = false;
/** @type {Map<string, Block>} */
const blocks = new Map();
const three = slices(
  { top: $canvas("#slice-top"), front: $canvas("#slice-front"), side: $canvas("#slice-side") },
  point,
  () => {
    solid?.cross(three.cross);
    drawProfile();
  },
);
let tried = false;
/** @type {Exclude<ReturnType<typeof raycast>, string> | null} */
let solid = null;

function ask() {
  const running = store.job?.dataset && store.job.state !== "queued" ? folder(store.job) : null;
  const name = past ?? running;
  const wish = size.value && name ? `${name} ${size.value} ${past ? "past" : ""}` : "";
  if (wish === (asked ?? "")) return;
  const before = asked;
  asked = wish;
  told = null;
  follow(null);
  comparing = false;
  // The folder comes a moment after the job: what is refused is asked again.
  of = { name, side: /** @type {128} */ (Number(size.value)), past: past !== null };
  if (wish || before)
    call("viewer.live", wish ? of : {}).catch((/** @type {unknown} */ error) => {
      if (asked !== wish) return;
      setText(note, words(error));
      setTimeout(() => {
        if (asked === wish) {
          asked = null;
          ask();
        }
      }, 1000);
    });
  forget();
  progress.hidden = past === null;
  progress.value = 0;
  $button("#volume-cancel").hidden = past === null;
  setText($button("#volume-cancel"), "Cancel");
  entitle();
  setText(note, !wish ? "" : past ? BEGINS : STARTING);
  wait(past ? BEGINS : "");
}
function entitle() {
  const ended = store.job !== null && isOver(store.job);
  const live = ended
    ? `Volume of ${store.job?.name ?? "the scan"}, as it grew`
    : "Volume so far";
  setText($("#volume-title"), past ? `Volume of ${past}` : asked ? live : "Volume");
}
/** Views are added up: before the last one values are that part of what they will be. */
const unit = () =>
  told && !told.past && (told.views ?? 0) < (told.of ?? 0)
    ? `per mm, × ${told.views} / ${told.of}`
    : "per mm";
// Within a stage of the work whose share does not move, its seconds do.
/** @type {number | undefined} */
let waits;
let stage = "";
let since = 0;

/**
 * Says in the note what there is, and below it what the work is at, for how long.
 * @param {string} what "" where nothing is waited for
 * @param {string} before
 */
function wait(what, before = "") {
  clearInterval(waits);
  if (!what) return;
  const now = performance.now();
  const [name] = what.split(":");
  if (name !== stage) since = now;
  stage = name;
  const tell = () => {
    const for_s = (performance.now() - since) / 1000;
    const waited = for_s < WAITED_S ? "" : ` … ${fixed(for_s, 0)} s`;
    setText(note, `${before}${what}${waited}`);
  };
  tell();
  waits = window.setInterval(tell, 1000);
}
function forget() {
  blocks.clear();
  three.show(null);
  kept = null;
  three.beside = null;
  solid?.beside(null);
  $("#volume-beside").hidden = true;
  for (const id of [".slices", "#volume-tools", "#volume-large"]) $(id).hidden = true;
  $("#volume-compared").textContent = "";
  setText($("#volume-verdict"), "");
  offer(["volume"]);
  large(false);
}
function choose() {
  if (!size.value) past = null;
  if (!past) keep(KEY, size.value);
  ask();
}
function cancel() {
  past = null;
  size.value = localStorage.getItem(KEY) ?? "";
  ask();
}

/** @param {boolean} to */
function large(to) {
  document.body.classList.toggle("whole", to);
  $("#volume-large").ariaPressed = String(to);
  setText($("#volume-large"), to ? "back" : "enlarge");
  three.draw();
  solid?.draw();
}
// With `compared` the truth is asked for as soon as the volume is there.
let thenCompare = false;
let reveal = false;
/** @type {Pair | null} */
let kept = null;
/** @param {string} name */
export function reconstruct(name, compared = false) {
  past = name;
  thenCompare = compared;
  if (!size.value || size.value === "128") size.value = "256";
  reveal = true;
  ask();
  $("#volume-card").scrollIntoView({ block: "nearest" });
}
/** The past scan whose volume is wanted here; null for none. */
export const wantedOf = () => past;
export function watch() {
  size.value ||= "128";
  past = null;
  reveal = true;
  ask();
}
on("reconstruct", (name) => reconstruct(name));
on("job", (job) => {
  ask();
  entitle();
  if (note.textContent === STARTING && isOver(job)) {
    setText(note, `the scan has ended (${job.state}) before its first slices`);
  }
});
on("state", (s) => {
  if (s.job) ask();
});
on("open", () => {
  asked = null;
});

on("volume", (m) => {
  if (!asked?.startsWith(`${m.name} `) || m.past !== (past !== null)) return;
  wait("");
  if (m.problem) {
    setText(note, m.problem);
    progress.hidden = true;
    return;
  }
  // What is read at a pointer that rests has the errors of the volume as soon as these are known.
  const more = (m.volumes?.length ?? 0) !== (told?.volumes?.length ?? 0);
  told = m;
  follow(m);
  const other =
    m.side === Number(size.value) ? "" : `${m.side} voxels a side, as another page chose · `;
  const working = m.comparing !== undefined && m.comparing < 1 && !m.not_compared;
  progress.hidden = m.past ? m.done === 1 && !working : true;
  progress.value = working ? (m.comparing ?? 0) : (m.done ?? 0);
  const share = `${fixed(100 * progress.value, 0)} %`;
  const at = m.past && !progress.hidden ? `${m.phase ?? BEGINS}: ${share}` : "";
  if (!m.size) {
    wait(at, other);
    return;
  }
  if (m.past) setText($button("#volume-cancel"), "Close");
  const facts = [
    `${m.views ?? "–"} of ${m.of ?? "–"} views${behind(m)}`,
    `${m.size.join(" × ")} voxels of ${fixed(1000 * (m.voxel_mm ?? 0), 0)} µm`,
    scanSaturated(m.saturated),
    m.geometry,
    m.uncovered && m.uncovered > 5e-4
      ? `${fixed(100 * m.uncovered, 1)} % without data (grey)`
      : "",
    m.binning ? `flexdt reconstruct --binning ${m.binning}` : "",
    m.not_compared,
    ...(m.doubts ?? []),
    m.past ? "" : GROWS,
  ];
  const said = other + facts.filter(Boolean).join(" · ");
  setText(note, said);
  wait(at, `${said} · `);
  note.title = m.details ?? "";
  if (m.volumes) offer(m.volumes, Object.keys(m.compared ?? {})[1]);
  if (more && pointer) point(pointer);
  if (m.views !== undefined && (!m.past || !blocks.size)) void want();
  if (m.compared) compared(m.compared);
  if (m.compared && m.volumes?.includes("truth")) void beside();
  $button("#volume-compare").disabled = !m.past || m.comparing !== undefined;
  $button("#volume-compare").title = m.past ? COMPARES : GROWS;
  if (thenCompare && m.past && m.done === 1 && m.comparing === undefined && !comparing)
    compare();
});
/**
 * How far a volume that grows is behind its scan.
 * @param {VolumeMessage} m
 * @returns {string}
 */
function behind({ past: over, views, of: all }) {
  const job = store.job;
  if (over || !job?.frames_total || isOver(job) || !views || !all) return "";
  const taken = Math.floor((all * job.frames_done) / job.frames_total);
  const late = taken - views > all / 20 ? ` (behind: ${taken} are taken)` : "";
  const step = Math.round(job.frames_total / all);
  return `${step > 1 ? `, one of every ${step} images` : ""}${late}`;
}
// The truth beside the scan, under one slider.
const splitter = $input("#volume-split");
async function beside() {
  if (three.beside || !past) return;
  const mine = asked;
  const truth = await fetched("truth");
  if (!truth || mine !== asked || three.beside) return;
  blocks.set("truth", truth);
  three.beside = truth;
  three.look(three.window);
  solid?.beside(truth);
  $("#volume-beside").hidden = false;
  parted();
}
function parted() {
  three.split = splitter.valueAsNumber / 1000;
  three.draw();
  if (!solid) return;
  solid.split = three.split;
  solid.draw();
}
splitter.addEventListener("input", parted);
function compare() {
  comparing = true;
  $button("#volume-compare").disabled = true;
  // A refusal ends it as a failure of the comparison itself does.
  void call("viewer.compare", of).catch((/** @type {unknown} */ error) => {
    if (told) emit("volume", { ...told, not_compared: words(error) });
  });
}

/**
 * @param {Name} name
 * @returns {Promise<Block | null>}
 */
async function fetched(name) {
  const head = await call("viewer.block", { ...of, what: name }).catch(() => null);
  const raw = head?.url
    ? await fetch(head.url).then(
        (r) => r.arrayBuffer(),
        () => null,
      )
    : null;
  if (!head?.shape || !raw || !told) return null;
  if (raw.byteLength !== 2 * head.shape.reduce((a, n) => a * n)) return null;
  const voxel_mm = (told.voxel_mm ?? 0) * (head.factor ?? 1);
  return { .../** @type {Block} */ (head), codes: new Uint16Array(raw), voxel_mm };
}

/**
 * The volume that is chosen, once; of one that grows the newest, one at a time: what is told
 * meanwhile is fetched afterwards.
 */
async function want() {
  if (wanting) {
    late = true;
    return;
  }
  wanting = true;
  late = false;
  const mine = asked;
  const name = /** @type {Name} */ (shown.value);
  let block = blocks.get(name) ?? null;
  if (!block) {
    block = await fetched(name);
    if (block && name === "difference") {
      const end = Math.max(...(blocks.get("volume")?.window ?? [0, 1])) / 2;
      block.signed = true;
      block.window = [-end, end];
    }
    if (block) block.own = block.signed || name === "sigma" || name === "bias_bound";
    if (block && past) blocks.set(name, block);
  }
  wanting = false;
  if (mine === asked && block) show(block);
  if (late || (mine === asked && name !== shown.value)) void want();
}

/** @param {Block} block */
function show(block) {
  const first = !three.block;
  for (const id of [".slices", "#volume-tools", "#volume-large"]) $(id).hidden = false;
  // The window is kept between volume, truth and the other geometry; errors have their own;
  // while one grows it is chosen anew.
  const same = kept && past && !block.own;
  three.show(block, same ? (kept ?? block.window) : block.window);
  if (!tried) {
    tried = true;
    const made = raycast(
      $canvas("#volume-ray"),
      Number(new URLSearchParams(location.search).get("rays")) || 0,
    );
    if (typeof made === "string")
      $("#volume-ray").replaceWith(el("p", { class: "muted small-text" }, made));
    else solid = made;
  }
  if (!block.own) solid?.show(block);
  put();
  if (!same && !block.own) surface();
  if (first && past) closer(block);
  if (first && reveal) {
    reveal = false;
    $("#volume-card").scrollIntoView({ block: "start" });
  }
}

/**
 * A past scan's volume opens as near as its object allows.
 * @param {Block} block
 */
function closer(block) {
  const far = solid && reach(block, solid.level);
  if (!solid || !far) return;
  solid.zoom = Math.max(1, Math.min(NEAREST, ROOM / 2 / far / MARGIN));
  solid.draw();
}
shown.addEventListener("change", () => void want());

/**
 * Ends of the window and the surface's value, in parts of the block's range about its window.
 * @returns {Pair}
 */
const range = () => {
  const b = three.block;
  if (!b) return [0, 1];
  const [l, h] = b.window;
  const d = h - l;
  return [Math.max(b.low, l - 0.3 * d), Math.min(b.high, h + 1.5 * d)];
};

/** @param {number} v */
const part = (v) => {
  const [l, h] = range();
  return (1000 * (v - l)) / (h - l);
};

/** @param {number} p */
const value = (p) => {
  const [l, h] = range();
  return l + (p * (h - l)) / 1000;
};
function put() {
  ends.forEach((end, k) => {
    end.value = String(part(three.window[k]));
  });
  seen();
}
function seen() {
  if (!three.block?.own) {
    kept = three.window;
    solid?.window(kept);
  }
  drawHistogram();
  drawProfile();
  point(pointer);
}

/** The surface begins at Otsu's threshold of all that is shown. */
function surface() {
  if (!three.block) return;
  const [low, high] = range();
  const counts = three.histogram([low, high]);
  level.value = String(part(low + ((high - low) * otsu(counts)) / counts.length));
  turned();
}
function turned() {
  if (!solid) return;
  solid.level = value(level.valueAsNumber);
  solid.cut = Number($select("#volume-cut").value);
  solid.most = $select("#volume-way").value === "most";
  solid.cross(three.cross);
  solid.draw();
  drawHistogram();
}
for (const end of ends)
  end.addEventListener("input", () => {
    const [l, h] = ends.map((e) => value(e.valueAsNumber));
    three.look([l, Math.max(h, l + 1e-6)]);
    seen();
  });
for (const id of ["#volume-level", "#volume-cut", "#volume-way"])
  $(id).addEventListener("input", turned);
$select("#volume-tool").addEventListener("change", () => {
  three.profiling = $select("#volume-tool").value === "profile";
  drawProfile();
});
slid(chart.area, (at) => {
  const to = 1000 * at;
  const [l, h] = ends.map((e) => Math.abs(e.valueAsNumber - to));
  const end = ends[l <= h ? 0 : 1];
  end.value = String(to);
  end.dispatchEvent(new Event("input"));
});
function drawHistogram() {
  if (!three.block) return;
  const colour = getComputedStyle(histogramHost).getPropertyValue("--warn");
  chart.draw({
    counts: three.histogram(range()),
    range: range(),
    unit: unit(),
    window: three.window,
    marks: [{ at: value(level.valueAsNumber), colour, handle: false }],
  });
}
function drawProfile() {
  const line = three.profiling ? three.profile() : null;
  profileHost.hidden = !line;
  if (three.profiling && !line) setText($("#volume-at"), "drag a line in a slice");
  if (!line) return;
  const { values, mm } = line;
  plot.draw({ places: along(mm, values.length), values, unit: "mm", of: unit() });
  const known = values.filter(Number.isFinite);
  const ends = `${fixed(Math.min(...known), 5)} to ${fixed(Math.max(...known), 5)} ${unit()}`;
  const said = known.length ? `${fixed(mm, 2)} mm · ${ends}` : "no data along this line";
  setText($("#volume-at"), said);
}
// The value under the pointer: of the codes at once, and as exact as the volume is when the
// pointer rests.
/** @type {number | undefined} */
let due;
/** @param {Vector | null} place */
function point(place) {
  const b = three.block;
  pointer = place;
  clearTimeout(due);
  if (three.profiling) return;
  if (!b || !place) {
    setText($("#volume-at"), "point at a slice");
    return;
  }
  const mm = place
    .map((v, k) => fixed((v + 0.5 - extent(b)[k] / 2) * b.voxel_mm, 2))
    .join(", ");
  const code = b.codes[index(b, place)];
  /** @param {string} text */
  const say = (text) => setText($("#volume-at"), `(${mm}) mm  ${text}`);
  say(code ? `${fixed(valueOf(b, code), 5)} per mm` : "no data cover this voxel");
  const at = /** @type {Vector} */ (place.map((v) => Math.floor((v + 0.5) * b.factor)));
  due = window.setTimeout(async () => {
    const exact = await call("viewer.voxel", { ...of, at }).catch(() => null);
    const v = exact?.[shown.value];
    if (pointer !== place || typeof v !== "number") return;
    const { sigma, bias_bound: bias } = shown.value === "volume" ? (exact ?? {}) : {};
    const noise = sigma == null ? "" : ` ± ${sigma.toPrecision(2)}`;
    const off = bias == null ? "" : `, bias at most ${bias.toPrecision(2)}`;
    const digits = sigma ? Math.max(0, 2 - Math.floor(Math.log10(sigma))) : 6;
    say(`${fixed(v, Math.min(8, digits))} ${unit()}${noise}${off}`);
  }, EXACT_MS);
}

// As measured with each geometry, beside the truth.
/**
 * @typedef {[key: Exclude<keyof Figures, "rms">, words: string, times: number, digits: number,
 *   unit: string]} Row
 */

/** @type {Row[]} */
const ROWS = [
  ["attenuation", "attenuation", 1, 5, "/mm"],
  ["void", "void within outlines", 100, 2, "%"],
  ["x_mm", "size along x", 1, 2, "mm"],
  ["y_mm", "along y", 1, 2, "mm"],
  ["z_mm", "along z", 1, 2, "mm"],
];

/**
 * The truth is that of a volume of the same voxels, not of the mesh: its sizes are as coarse.
 * @param {Record<string, Figures>} rows
 * @param {number} [voxel_mm]
 * @returns {HTMLElement}
 */
export function table(rows, voxel_mm) {
  const made = Object.entries(rows);

  /**
   * @param {"td" | "th"} tag
   * @param {string} text
   */
  const cell = (tag, text) => el(tag, {}, text);
  return el(
    "table",
    {},
    el(
      "tr",
      {},
      cell("th", ""),
      cell("th", voxel_mm ? `truth in voxels of ${fixed(1000 * voxel_mm, 0)} µm` : "truth"),
      ...made.map(([name]) => cell("th", name)),
    ),
    ...ROWS.map(([key, text, times, digits, unit]) =>
      el(
        "tr",
        {},
        cell("td", `${text} [${unit}]`),
        cell("td", fixed(times * made[0][1][key][1], digits)),
        ...made.map(([, f]) => cell("td", fixed(times * f[key][0], digits))),
      ),
    ),
    el(
      "tr",
      {},
      cell("td", "rms difference [/mm]"),
      cell("td", "–"),
      ...made.map(([, f]) => cell("td", fixed(f.rms, 5))),
    ),
  );
}

/** @param {Record<string, Figures>} rows */
function compared(rows) {
  if ($("#volume-compared").childElementCount) return;
  $("#volume-compared").replaceChildren(table(rows, told?.voxel_mm));
  setText($("#volume-verdict"), verdict(Object.values(rows)[0]));
}

/**
 * How near a volume is to its truth, in one line.
 * @param {Figures} of
 * @returns {string}
 */
function verdict({ attenuation: [seen, true_mu], x_mm, y_mm, z_mm, rms }) {
  const known = seen !== null && true_mu ? 100 * (seen / true_mu - 1) : null;
  const off =
    known === null ? "" : `attenuation ${known < 0 ? "−" : "+"}${fixed(Math.abs(known), 1)} %`;
  const sizes = [x_mm, y_mm, z_mm].flatMap(([a, b]) =>
    a === null || b === null ? [] : [Math.abs(a - b)],
  );
  const size = sizes.length ? `sizes within ${fixed(Math.max(...sizes), 2)} mm` : "";
  const told = [off, size, `rms ${fixed(rms, 5)} /mm`].filter(Boolean);
  return `Beside the truth: ${told.join(", ")}.`;
}

/**
 * The volumes that there are; the one that was chosen stays so.
 * @param {Name[]} names
 */
function offer(names, other = SHOWN.other) {
  const chosen = shown.value;
  const there = /** @type {Name[]} */ (Object.keys(SHOWN)).filter((name) =>
    names.includes(name),
  );
  if (there.length === shown.options.length) return;
  shown.replaceChildren(
    ...there.map((name) =>
      el("option", { value: name }, name === "other" ? other : SHOWN[name]),
    ),
  );
  shown.value = names.includes(/** @type {Name} */ (chosen)) ? chosen : "volume";
}
clicks({
  "volume-cancel": cancel,
  "volume-compare": compare,
  "volume-large": () => large(!document.body.classList.contains("whole")),
  "volume-share": () => {
    if (three.block && told) void shared(three, solid, told);
  },
});
window.addEventListener(
  "keydown",
  (e) => {
    if (e.key === "Escape" && document.body.classList.contains("whole")) {
      e.stopPropagation();
      large(false);
    }
  },
  true,
);
/** For tests: what is shown. */
export const look = () => ({ three, solid, told, of });
