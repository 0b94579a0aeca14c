// Bar, readouts, warnings and notes: who holds control, how near things are, what went wrong.
import { $, $$, $button, $dialog, $input, el, fixed, isNumber, setText, term } from "./dom.js";
import type { GeometryState, State } from "./viewer.js";
import { command, OLD_S, on, person, rename, store } from "./link.js";

const ROWS: Array<[name: string, text: (g: GeometryState) => string]> = [
  ["SOD", (g) => `${fixed(g.SOD_mm, 2)} mm`],
  ["SDD", (g) => `${fixed(g.SDD_mm, 2)} mm`],
  ["magnification", (g) => `${fixed(g.magnification, 4)}×`],
  ["voxel", (g) => `${fixed(g.voxel_size_mm * 1000, 2)} µm`],
  ["field of view", (g) => g.field_of_view_mm.map((v) => fixed(v, 1)).join(" × ") + " mm"],
  ["cone angle", (g) => `${fixed(g.cone_angle_deg, 2)}°`],
  ["piercing point", (g) => g.piercing_point_px.map((v) => fixed(v, 1)).join(", ") + " px"],
  ["axis column", (g) => `${fixed(g.axis_column_px, 1)} px`],
];
const beam = (t: State["tube"]) =>
  t.on
    ? !t.ready && t.ready_in_s !== null
      ? `ready in ${fixed(t.ready_in_s, 0)} s`
      : power(t)
    : "off";
const power = (t: { kV: number | null; power_W: number | null }) =>
  `${fixed(t.kV, 0)} kV, ${fixed(t.power_W, 0)} W`;
const TIPS: Record<string, string | undefined> = {
  SOD: "Source to object: from the focal spot to the rotation axis",
  SDD: "Source to detector: from the focal spot to the panel",
  magnification: "SDD / SOD",
  voxel: "A pixel of the image, as large as it is at the sample",
  "field of view": "What of the sample the image holds, width × height",
  "cone angle": "Opening of the beam that meets the image",
  "piercing point":
    "Pixel (column, row) in which the perpendicular from the focal spot meets the panel",
  "axis column": "Column in which the rotation axis appears",
};
const cells = [...ROWS.map(([name]) => name), "beam"].map((name) => {
  const dd = el("dd"),
    tip = TIPS[name];
  $("#readouts").append(el("dt", {}, tip ? term(name, tip) : name), dd);
  return dd;
});

export function note(
  kind: string,
  title: string,
  body = "",
  life = kind === "error" ? 12000 : 6000,
) {
  const box = $("#notes");
  $$("#notes > *")
    .find((n) => n.dataset.key === title + body)
    ?.remove();
  const node: HTMLElement = el(
    "div",
    { class: `note ${kind}`, "data-key": title + body },
    el("b", {}, title),
    el("span", {}, body),
    el("button", { "aria-label": "close", onclick: () => node.remove() }, "×"),
  );
  box.append(node);
  while (box.childElementCount > 5) box.firstChild?.remove();
  setTimeout(() => node.remove(), life);
}
on("note", (kind, title, body) => note(kind, title, body));
on("log", (entry) => {
  if (["warning", "error"].includes(entry.level))
    note(entry.level === "error" ? "error" : "warning-note", "Twin", entry.message);
});

// Does the sample stay in the picture over a whole turn? The cylinder about the axis that holds it.
export function truncated(s: State): string[] {
  const size = s.sample.size_mm,
    g = s.geometry,
    c = s.camera;
  const axis = g.axis_column_px;
  if (!size || !isNumber(axis)) return [];
  const o = s.sample.offset,
    upright = !o.rx && !o.ry;
  const radius =
    (upright ? 0.5 * Math.hypot(size[0], size[1]) : 0.5 * Math.hypot(...size)) +
    Math.hypot(o.x, o.y);
  const height = upright ? size[2] : 2 * radius,
    out: string[] = [];
  if (radius >= g.SOD_mm) return ["the sample reaches the source"];
  const reach = (radius * g.SDD_mm) / Math.sqrt(g.SOD_mm ** 2 - radius ** 2) / c.pixel_mm;
  if (axis - reach < -0.5 || axis + reach > c.shape[1] - 0.5)
    out.push("truncated sideways over a full turn");
  const near = g.SDD_mm / (g.SOD_mm - radius) / c.pixel_mm,
    middle =
      g.piercing_point_px[1] -
      ((o.z + (store.framing?.sample_height_mm ?? 0)) * g.magnification) / c.pixel_mm;
  if (middle - (height / 2) * near < -0.5 || middle + (height / 2) * near > c.shape[0] - 0.5)
    out.push("truncated at top or bottom");
  return out;
}

// Axes that the page found at an end of their travel: a machine may well be at home there.
let parked: Set<string> | null = null;

function warnings(s: State) {
  const list: Array<[kind: string, words: string]> = [];
  if (isDown(s)) list.push(["bad", stopped(s)]);
  if (s.unsaved)
    list.push([
      "bad",
      `Not saved: ${s.unsaved}. A server that is killed now comes back without the last change`,
    ]);
  for (const w of s.safety.warnings) list.push(["", w]);
  if (store.near?.close)
    list.push([
      (store.near.mm ?? 0) < 2 ? "bad" : "",
      `${store.near.pair.join(" and ")} are ${fixed(store.near.mm, 1)} mm apart`,
    ]);
  const there = Object.entries(s.axes)
    .filter(
      ([, a]) =>
        !a.moving &&
        !a.virtual &&
        (Math.abs(a.position - a.limits[0]) < 0.05 ||
          Math.abs(a.limits[1] - a.position) < 0.05),
    )
    .map(([n]) => n);
  parked ??= new Set(there);
  for (const name of parked) if (!there.includes(name)) parked.delete(name);
  const ends = there.filter((n) => !parked?.has(n));
  if (ends.length) list.push(["", `${ends.join(", ")} at the end of travel`]);
  const cut = truncated(s);
  if (cut.length) list.push(["", `Sample ${cut.join(", ")}`]);
  const flags = s.image,
    are = s.tube.on ? "are" : "would be"; // flags are judged as though X-rays were on
  if (flags && flags.saturated > 0.001)
    list.push([
      flags.saturated > 0.05 ? "bad" : "",
      `${share(flags.saturated)} of the pixels ${are} saturated: less power, shorter exposure or more filter`,
    ]);
  if (flags && flags.starved > 0.001)
    list.push([
      "",
      `${share(flags.starved)} of the pixels ${are} starved: hardly a count above dark`,
    ]);
  if (s.job?.state === "paused")
    list.push([
      "",
      `Scan paused${typeof s.job.error?.message === "string" ? `: ${s.job.error.message}` : ""}`,
    ]);
  return list;
}
const share = (part: number) => (part < 0.01 ? "some" : `${fixed(100 * part, 0)} %`);
let lastWarnings = "";

// Of the machine or, while a data set is open, of the image of it that is shown: nominal, as it was scanned.
function readouts() {
  const s = store.state,
    name = store.recorded,
    about = store.image?.recorded;
  if (!s) return;
  const g = name === null ? s.geometry : about?.geometry,
    tube = about?.tube;
  ROWS.forEach(([, f], k) => {
    setText(cells[k], g ? f(g) : "–");
  });
  setText(
    cells[ROWS.length],
    name === null ? beam(s.tube) : !tube ? "–" : tube.on ? power(tube) : "off",
  );
  setText(
    $("#geometry-of"),
    name === null
      ? ""
      : `of ${name}${about ? `, image ${about.index + 1}` : ""}: ${g ? "nominal" : "not known"}`,
  );
  $("#near-live").hidden = name === null;
}
on("image", readouts);
on("recorded", readouts);

on("state", (s) => {
  readouts();
  const list = warnings(s),
    key = JSON.stringify(list);
  if (key !== lastWarnings) {
    lastWarnings = key;
    $("#warnings").replaceChildren(
      ...list.map(([kind, text]) => el("div", { class: `warning ${kind}` }, text)),
    );
  }
  const factor = s.clock.real_time_factor;
  setText(
    $("#clock"),
    `t = ${fixed(s.clock.time_s, 1)} s · ${factor ? `${factor >= 10 ? fixed(factor, 0) : fixed(factor, 2)}×` : s.clock.speed_up === "max" ? "max" : `${s.clock.speed_up}×`}`,
  );
  release(s);
  if (s.safety.estop && s.safety.stop !== pressed?.after) {
    pressed = null;
    for (const n of $$("#notes .note")) if (n.dataset.key?.startsWith(UNCONFIRMED)) n.remove();
  } else if (
    pressed !== null &&
    store.fresh !== null &&
    performance.now() - Math.max(pressed.at, store.fresh) > 2000 * OLD_S
  ) {
    pressed = null;
    note("error", "The emergency stop did not take effect", "press it again");
  }
  near();
  holder();
});

function near() {
  const n = store.near,
    mm = n?.mm,
    box = $("#near");
  if (!box.childElementCount)
    box.append(
      el(
        "div",
        { class: "row between" },
        el("span", { class: "pair" }),
        el("b", { class: "mm mono" }),
      ),
      el("div", { class: "meter" }, el("i")),
    );
  setText($(".pair", box), n?.pair.length ? n.pair.join(" – ") : "–");
  setText($(".mm", box), isNumber(mm) ? `${fixed(mm, 1)} mm` : "");
  const meter = $(".meter", box);
  meter.className = `meter ${n?.close ? ((mm ?? 0) < 2 ? "touch" : "close") : ""}`;
  $("i", meter).style.width = isNumber(mm) ? `${Math.min(100, mm / 2).toFixed(0)}%` : "0";
}

function holder() {
  const pill = $("#holder"),
    who = store.state?.controller ?? null,
    mine = who !== null && who === store.session;
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
  const who = store.state?.controller ?? null,
    action = who === null ? "acquire" : who === store.session ? "release" : "force";
  void command("session.control", { action }, "Control");
});
const me = $input("#person");
me.value = person();
me.addEventListener("change", () => rename(me.value));
$button("#skip").addEventListener("click", () => $("#film-canvas").focus());
const UNCONFIRMED = "E-stop not confirmed";
// Pressed when [ms], after which stop, and not confirmed by a newer one yet.
let pressed: { at: number; after: number | undefined } | null = null;
export async function estop(): Promise<void> {
  const mine = (pressed = { at: performance.now(), after: store.state?.safety.stop });
  const answer = await command("safety.estop", {}, UNCONFIRMED);
  if (answer?.safety.estop && pressed === mine) pressed = null;
}
$button("#estop").addEventListener("click", () => void estop());

// A reset releases the one stop that the page shows, and not before a person has had time to see it.
const SEEN_MS = 1000;
const isDown = (s: State) => s.safety.estop || s.safety.state !== "ok";
function stopped({ safety: { estop, stopped_by: by, message } }: State): string {
  if (!estop) return `Blocked: ${message || "reset to go on"}`;
  return `Emergency stop${by ? ` by ${by === store.session ? "you" : by}` : ""}: nothing moves until it is reset`;
}
let shown: number | null = null;
function release(s: State) {
  const stop = isDown(s) ? s.safety.stop : null,
    reset = $button("#reset"),
    ask = $dialog("#reset-dialog");
  reset.hidden = stop === null;
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
  const ask = $dialog("#reset-dialog"),
    s = store.state;
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

// What is missing: nothing, the viewer's room for this page, the viewer, the twin, or news of either.
function missing(): [word: string, title: string, why: string] {
  if (store.refused)
    return [
      "sent away",
      "The viewer does not serve this page now",
      `${store.refused}; the page tries again by itself`,
    ];
  if (!store.viewer)
    return [
      "no viewer",
      "The viewer is away",
      "it does not answer; the page comes back by itself",
    ];
  if (!store.twin)
    return [
      "no twin",
      "The twin is away",
      `${store.problem || "waiting for it"}; the page comes back by itself`,
    ];
  if (store.state && store.age > OLD_S)
    return [
      `${fixed(store.age, 0)} s old`,
      `What you see is ${fixed(store.age, 0)} s old`,
      "viewer or twin do not answer, or the network is slow; what is done here may come late or not at all",
    ];
  return ["connected", "", ""];
}
function connection() {
  const pill = $("#connection"),
    [word, title, why] = missing(),
    up = title === "";
  const unconfirmed = pressed !== null && performance.now() - pressed.at > 1000 * OLD_S;
  pill.dataset.state = up ? "up" : "down";
  setText(pill, word);
  pill.title = store.problem ?? "";
  $("#veil").hidden = up && !unconfirmed;
  document.body.dataset.old = String(!up);
  setText($("#veil-title"), unconfirmed ? `${UNCONFIRMED}${title && `. ${title}`}` : title);
  setText($("#veil-text"), unconfirmed || !up ? [why, BUTTON].filter(Boolean).join("; ") : "");
}
on("age", () => {
  connection();
  const old = store.imageAge > OLD_S;
  $("#film-old").hidden = !old;
  if (old) setText($("#film-old"), `of another pose: ${fixed(store.imageAge, 0)} s old`);
});
on("connection", () => {
  connection();
  setText(
    $("#machine"),
    store.hello ? `${store.hello.machine} · ${store.hello.profile ?? ""}` : "",
  );
  holder();
});
