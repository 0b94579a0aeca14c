// The Move tab: a slider, a number and two hold-to-jog buttons for every axis, and the keys.
import { partWords } from "./figures.js";
import {
  $,
  $input,
  $select,
  el,
  field,
  fixed,
  isNumber,
  keep,
  parsed,
  setText,
  term,
} from "./dom.js";
import { call, command, emit, Failure, on, store } from "./link.js";
import { reached } from "./reached.js";
/** @import { AxisState, State } from "../web/viewer.d.ts" */

const LEASE_S = 0.5;
const MOST_S = 10;
const RENEW_MS = 180;
const SETTLE_MS = 400;
/** @type {Array<[title: string, tint: string, axes: Record<string, string>]>} */
const GROUPS = [
  ["Source", "#ffb020", { ver_tube: "height", tra_tube: "sideways" }],
  [
    "Sample",
    "#3aa0ff",
    {
      mag_obj: "along the beam",
      tra_obj: "sideways",
      ver_obj: "height, by source and detector",
    },
  ],
  [
    "Detector",
    "#7a5cff",
    { mag_det: "along the beam", ver_det: "height", tra_det: "sideways, left is +" },
  ],
];
const TURN = { rot_obj: "Turn of sample" }; // with what is set most, in plain words first
const JOG_FALLBACK = { mm: 50, deg: 45 };

/**
 * @typedef {object} Row
 * @property {string} name
 * @property {HTMLElement} box
 * @property {HTMLInputElement} slider
 * @property {HTMLInputElement} number
 * @property {HTMLElement} now
 * @property {HTMLElement} goal where it goes to, while it does
 * @property {number} low
 * @property {number} high
 * @property {number} from
 * @property {number} to
 * @property {number} turn
 * @property {boolean} dragging
 * @property {number} asked
 * @property {number} waiting
 */

/**
 * What a scan is planned by; setting one moves motors by as much. Only a machine with all of
 * them has it.
 * @typedef {object} Main
 * @property {string} words
 * @property {string} unit
 * @property {number} digits
 * @property {string} tip
 * @property {(s: State) => number} now
 * @property {string[]} axes
 * @property {(s: State, v: number) => number} shift
 */

/** @param {State} s */
const sod = (s) => s.geometry?.SOD_mm ?? NaN;
/** @param {State} s */
const sdd = (s) => s.geometry?.SDD_mm ?? NaN;
/** @param {State} s */
const voxel_um = (s) => 1000 * (s.geometry?.voxel_size_mm ?? NaN);
const high = () => store.framing?.sample_height_mm ?? NaN;
/** @type {Main[]} */
const MAINS = [
  {
    words: "Source to sample",
    unit: "mm",
    digits: 2,
    tip:
      "SOD: from the focal spot to the rotation axis, along the beam. " +
      "Setting it moves the sample.",
    now: sod,
    axes: ["mag_obj"],
    shift: (s, v) => v - sod(s),
  },
  {
    words: "Source to detector",
    unit: "mm",
    digits: 2,
    tip: "SDD: from the focal spot to the panel. Setting it moves the detector.",
    now: sdd,
    axes: ["mag_det"],
    shift: (s, v) => v - sdd(s),
  },
  {
    words: "Magnification",
    unit: "×",
    digits: 3,
    tip: "How much larger the sample is on the panel: SDD / SOD. Setting it moves the sample.",
    now: (s) => s.geometry?.magnification ?? NaN,
    axes: ["mag_obj"],
    shift: (s, v) => sdd(s) / v - sod(s),
  },
  {
    words: "Voxel size",
    unit: "µm",
    digits: 2,
    tip:
      "A pixel of the image, as large as it is at the sample: pixel / magnification. " +
      "Setting it moves the sample.",
    now: voxel_um,
    axes: ["mag_obj"],
    shift: (s, v) => sod(s) * (v / voxel_um(s) - 1),
  },
  {
    words: "Sample above beam",
    unit: "mm",
    digits: 2,
    tip:
      "Height of the sample's reference point above the focal spot. " +
      "Setting it moves source and detector together.",
    now: high,
    axes: ["ver_tube", "ver_det"],
    shift: (_, v) => high() - v,
  },
];
/** @type {Array<[main: Main, field: HTMLInputElement]>} */
const mains = [];
/** @type {Map<string, Row>} */
const rows = new Map();
/** @type {Map<string, { axis: string; timer: number }>} */
const held = new Map();

/**
 * @param {string} axis
 * @param {number} direction
 * @param {string} token
 */
export function jogStart(axis, direction, token) {
  if (held.has(token)) return;
  const renew = () => {
    const all = store.state;
    const state = all?.axes[axis];
    if (!all || !state) return;
    // The lease runs on the twin's clock, the renewals on ours.
    const pace = all.clock.speed_up;
    const lease = Math.min(MOST_S, LEASE_S * Math.max(1, Number(pace) || 1));
    const top = state.speed ?? JOG_FALLBACK[state.unit];
    const velocity = direction * top * Number($select("#jog-speed").value);
    void command("axes.jog", { axis, velocity, lease_s: lease }, `Cannot jog ${axis}`).then(
      (answer) => {
        // Refused once is enough said: it stops without a second note.
        if (answer === null && drop(token))
          call("axes.jog", { axis, velocity: 0 }).catch(() => {});
      },
    );
  };
  held.set(token, { axis, timer: window.setInterval(renew, RENEW_MS) });
  renew();
}

/** @param {string} token */
function drop(token) {
  const hold = held.get(token);
  if (hold) clearInterval(hold.timer);
  held.delete(token);
  return hold;
}

/** @param {string} token */
export function jogStop(token) {
  const hold = drop(token);
  if (hold)
    void command("axes.jog", { axis: hold.axis, velocity: 0 }, `Cannot stop ${hold.axis}`);
}
export function jogStopAll() {
  for (const token of [...held.keys()]) jogStop(token);
}

/**
 * Where the motors halt instead.
 * @param {unknown} error
 * @returns {Record<string, number>}
 */
function haltsAt(error) {
  if (!(error instanceof Failure)) return {};
  const data = /** @type {{ halts_at?: Record<string, number> } | null} */ (error.data);
  return data?.halts_at ?? {};
}

/**
 * What came of a refused move, in a few words.
 * @param {string} axis
 * @param {unknown} error
 */
function title(axis, error) {
  const halts = haltsAt(error);
  if (axis in halts) return `${axis} goes to ${fixed(halts[axis], 2)} and halts there`;
  return Object.keys(halts).length ? `${axis} halts on its way` : `${axis} does not move`;
}

/**
 * Whether the axes were sent there; the first one names them.
 * @param {Record<string, number>} targets
 * @param {(axis: string, error: unknown) => string | [string, string]} [told] of a refusal
 */
async function send(targets, told = title) {
  const [axis] = Object.keys(targets);
  const answer = await command(
    "axes.move",
    { targets, plan: $input("#around").checked },
    (error) => told(axis, error),
  );
  for (const warning of answer?.warnings ?? []) emit("note", "warning-note", axis, warning);
  return answer !== null;
}

/**
 * @param {string} axis
 * @param {number} value
 */
const move = (axis, value) => send({ [axis]: value });

/**
 * @param {Main} main
 * @param {State} state
 */
function mainRow(main, state) {
  const { words, unit, tip, axes, shift } = main;
  if (axes.some((name) => !(name in state.axes))) return [];
  const input = field({ "aria-label": words }, enter, () => input.blur());
  function enter() {
    const text = input.value;
    const value = parsed(text);
    const s = store.state;
    input.blur();
    if (!s || !(value > 0 || (axes.length > 1 && Number.isFinite(value)))) {
      emit("note", "error", `${words} stays`, `“${text}” is not a number above 0`, axes[0]);
      return;
    }
    const by = shift(s, value);
    /** @type {Record<string, number>} */
    const targets = {};
    for (const name of axes) targets[name] = s.axes[name].position + by;
    void send(targets, (axis, error) => refused(main, s, text, axis, error));
  }
  input.addEventListener("blur", () => {
    if (store.state) drawMains(store.state);
  });
  mains.push([main, input]);
  return [
    el(
      "div",
      { class: "main-row" },
      term(words, tip),
      el("span", {}, input, el("span", { class: "unit" }, unit)),
    ),
  ];
}

/**
 * What came of a value that was refused, in its own unit: the motors are named in the sentence.
 * @param {Main} main
 * @param {State} s when it was typed
 * @param {string} text that was typed
 * @param {string} axis
 * @param {unknown} error
 * @returns {string | [title: string, words: string]}
 */
function refused({ words, unit, digits, now, shift }, s, text, axis, error) {
  const halts = haltsAt(error);
  /** @param {number} place of the motor */
  const of = (place) => reached(now(s), place - s.axes[axis].position, (v) => shift(s, v));
  const at = axis in halts ? of(halts[axis]) : NaN;
  if (Number.isFinite(at)) return `${words} halts at ${fixed(at, digits)} ${unit}`;
  const ends = travel(error, axis).map(of);
  if (!ends.length || !ends.every(Number.isFinite)) return `${words} does not get there`;
  const [low, high] = ends.sort((a, b) => a - b);
  const tenth = 10 ** digits; // an end that was rounded outwards would be refused
  const range = [Math.ceil(low * tenth) / tenth, Math.floor(high * tenth) / tenth];
  const [from, to] = range.map((end) => fixed(end, digits));
  return [`${words} stays`, `${text} ${unit} is outside ${from} to ${to} ${unit}`];
}

/**
 * The ends of a motor's travel that a target was beyond; none of another refusal.
 * @param {unknown} error
 * @param {string} axis
 * @returns {number[]}
 */
function travel(error, axis) {
  const data = /** @type {{ axis?: string; allowed?: unknown } | null} */ (
    error instanceof Failure ? error.data : null
  );
  const allowed = data?.axis === axis ? data.allowed : null;
  return Array.isArray(allowed) && allowed.every(isNumber) ? allowed : [];
}

/** @param {State} state */
function drawMains(state) {
  for (const [{ now, digits }, input] of mains) {
    if (document.activeElement === input) continue;
    const text = fixed(now(state), digits);
    if (input.value !== text) input.value = text;
    input.classList.remove("typed");
  }
}

/**
 * @param {string} axis
 * @param {number} direction
 * @param {string} sign
 */
function jogButton(axis, direction, sign) {
  const token = `${axis}:${direction}`;
  const button = el(
    "button",
    {
      "data-jog": token,
      title: `Hold to jog ${axis} (or hold Enter)`,
      "aria-label": `jog ${axis} ${direction > 0 ? "up" : "down"}`,
    },
    sign,
  );
  const stop = () => {
    button.classList.remove("held");
    jogStop(token);
  };
  const start = () => {
    button.classList.add("held");
    jogStart(axis, direction, token);
  };
  button.addEventListener("pointerdown", (e) => {
    e.preventDefault();
    button.setPointerCapture(e.pointerId);
    start();
  });
  button.addEventListener("keydown", (e) => {
    if (e.key === "Enter" && !e.repeat) start();
  });
  button.addEventListener("keyup", (e) => {
    if (e.key === "Enter") stop();
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture", "blur"])
    button.addEventListener(name, stop);
  return button;
}

/** @param {State} state */
function build(state) {
  const others = Object.keys(state.axes).filter(
    (name) => !(name in TURN) && !GROUPS.some(([, , axes]) => name in axes),
  );
  const box = $("#axes");
  box.textContent = "";
  rows.clear();
  mains.length = 0;
  const turn = Object.entries(TURN)
    .filter(([name]) => name in state.axes)
    .map(([name, what]) => axisRow(name, state.axes[name], what));
  $("#mains").replaceChildren(...MAINS.flatMap((main) => mainRow(main, state)), ...turn);
  for (const [title, tint, axes] of [
    ...GROUPS,
    /** @type {const} */ ([
      "Others",
      "#999",
      Object.fromEntries(others.map((name) => [name, ""])),
    ]),
  ]) {
    const found = Object.entries(axes)
      .filter(([name]) => name in state.axes)
      .map(([name, what]) => axisRow(name, state.axes[name], what));
    if (found.length)
      box.append(
        el("div", { class: "group", style: `--tint:${tint}` }, el("h2", {}, title), ...found),
      );
  }
}

/**
 * @param {string} name
 * @param {AxisState} axis
 * @param {string} what
 */
function axisRow(name, axis, what) {
  const [low, high] = axis.limits;
  const said = name in TURN ? [what, name] : [name, what];
  const slider = el("input", {
    type: "range",
    min: low,
    max: high,
    step: 0.1,
    value: axis.target,
    "aria-label": `${name} slider`,
  });
  const number = field({ "aria-label": `${name} value` }, enter, () => number.blur());
  const now = el("span", { class: "now", title: "where it stands" });
  const goal = el("span", { class: "goal muted mono" });
  const box = el("div", { class: "axis", "data-axis": name });
  /** @type {Row} */
  const row = {
    name,
    box,
    slider,
    number,
    now,
    goal,
    low,
    high,
    from: low,
    to: high,
    turn: NaN,
    dragging: false,
    asked: 0,
    waiting: 0,
  };
  function enter() {
    const text = number.value;
    const value = parsed(text);
    number.blur();
    if (Number.isFinite(value)) void move(name, value);
    else emit("note", "error", `${name} does not move`, `“${text}” is not a number`, name);
  }
  number.addEventListener("blur", () => {
    box.classList.remove("chosen");
    draw(row);
  });
  const letGo = () =>
    setTimeout(() => {
      row.dragging = false;
      draw(row);
    }); // after the change, if there is one
  slider.addEventListener("input", () => {
    row.dragging = true;
    number.value = fixed(Number(slider.value), 3);
    number.classList.add("typed");
  });
  for (const event of ["pointerup", "pointercancel", "blur"])
    slider.addEventListener(event, letGo);
  const slid = async () => {
    row.dragging = false;
    const mine = (row.waiting = ++row.asked);
    // The state that shows the motion may come a little after the answer.
    const wait = (await move(name, Number(slider.value))) ? SETTLE_MS : 0;
    setTimeout(() => {
      if (row.waiting === mine) {
        row.waiting = 0;
        draw(row);
      }
    }, wait);
  };
  slider.addEventListener("change", () => void slid());
  box.append(
    el(
      "div",
      { class: "top" },
      el(
        "span",
        { title: what },
        el("span", { class: "name" }, said[0]),
        el("span", { class: "what" }, said[1]),
        goal,
      ),
      el("span", {}, number, el("span", { class: "unit" }, axis.unit === "deg" ? "°" : "mm")),
    ),
    el(
      "div",
      { class: "line" },
      jogButton(name, -1, "−"),
      el("div", { class: "track" }, slider, now),
      jogButton(name, 1, "+"),
    ),
  );
  rows.set(name, row);
  return box;
}

/**
 * What the chosen speed is of those axes.
 * @param {State} state
 */
function pace(state) {
  /** @param {AxisState["unit"]} unit */
  const of = (unit) => {
    const all = Object.values(state.axes)
      .filter((a) => a.unit === unit && !a.virtual)
      .map((a) => (a.speed ?? JOG_FALLBACK[unit]) * Number($select("#jog-speed").value));
    if (!all.length) return [];
    const low = fixed(Math.min(...all), 1);
    const high = fixed(Math.max(...all), 1);
    return [`${low === high ? low : `${low} to ${high}`} ${unit === "deg" ? "°/s" : "mm/s"}`];
  };
  setText($("#jog-is"), [...of("mm"), ...of("deg")].join(", "));
}

/** @param {State} state */
function refresh(state) {
  pace(state);
  if (!rows.size || Object.keys(state.axes).some((n) => !rows.has(n))) build(state);
  for (const row of rows.values()) draw(row);
  drawMains(state);
}
// Motors are one level below; this browser remembers whether they are open.
/** @type {HTMLDetailsElement} */
const motors = $("#motors");
const MOTORS = "flexdt-motors";
motors.open = localStorage.getItem(MOTORS) === "open";
motors.addEventListener("toggle", () => keep(MOTORS, motors.open ? "open" : "closed"));

/**
 * A slider over many turns is of no use: it goes over the present one.
 * @param {Row} row
 * @param {number} position
 */
function turned(row, position) {
  if (Math.abs(position - row.turn) <= 180) return;
  row.turn = 360 * Math.round(position / 360);
  row.from = Math.max(row.low, row.turn - 180);
  row.to = Math.min(row.high, row.turn + 180);
  row.slider.min = String(row.from);
  row.slider.max = String(row.to);
  row.slider.title = `${row.from}° to ${row.to}°; the number takes all turns`;
}

/**
 * A row as the last state has it, but for what a person is just doing there.
 * @param {Row} row
 */
function draw(row) {
  const axis = store.state?.axes[row.name];
  if (!axis) return;
  if (!row.dragging && !row.waiting && document.activeElement !== row.number) {
    const text = fixed(axis.position, 3);
    if (axis.unit === "deg" && row.high - row.low > 720) turned(row, axis.position);
    row.slider.value = String(axis.moving ? axis.target : axis.position);
    if (row.number.value !== text) row.number.value = text;
    row.number.classList.remove("typed");
  }
  const at = (axis.position - row.from) / (row.to - row.from);
  row.now.style.left = `calc(8px + (100% - 16px) * ${Math.min(1, Math.max(0, at)).toFixed(4)})`;
  row.box.classList.toggle("moving", axis.moving);
  setText(row.goal, axis.moving ? `to ${fixed(axis.target, 2)}` : "");
  const ended =
    !axis.moving && (axis.position - row.low < 0.5 || row.high - axis.position < 0.5);
  row.box.classList.toggle("limit", ended);
  row.box.title = ended ? "at the end of its travel" : "";
}

/**
 * A part that was clicked in a scene selects the motor that moves it, or all that a machine
 * shows of it; its number takes the next key.
 */
on("part", (part, motor) => {
  const row = motor === null ? undefined : rows.get(motor);
  if (!row) {
    emit("note", "", partWords(part), "no motor moves it");
    return;
  }
  emit("show-tab", "move");
  if (row.box.closest("#motors")) motors.open = true;
  row.box.scrollIntoView({ block: "nearest" });
  row.number.focus({ preventScroll: true });
  row.number.select();
  row.box.classList.add("chosen");
});

on("state", refresh);
on("connection", () => {
  if (!store.viewer || !store.twin) for (const token of [...held.keys()]) drop(token);
});
