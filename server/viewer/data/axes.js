// The Move tab: a slider, a number and two hold-to-jog buttons for every axis, and the keys.
import { $, el, fixed, setText } from "./dom.js";
import { command, emit, on, store } from "./link.js";

const LEASE_S = 0.5, MOST_S = 10, RENEW_MS = 180;
const GROUPS = [
  ["Source", "#ffb020", ["ver_tube", "tra_tube"]],
  ["Sample", "#3aa0ff", ["mag_obj", "tra_obj", "rot_obj", "ver_obj"]],
  ["Detector", "#7a5cff", ["mag_det", "ver_det", "tra_det"]],
];
const WHAT = { ver_tube: "height", tra_tube: "sideways", mag_obj: "to the detector", tra_obj: "sideways", rot_obj: "turn", ver_obj: "source + detector", mag_det: "distance", ver_det: "height", tra_det: "to the left" };
const JOG_FALLBACK = { mm: 50, deg: 45 };
const rows = new Map();
const held = new Map();

export function jogStart(axis, direction, token) {
  if (held.has(token)) return;
  const renew = () => {
    const state = store.state?.axes[axis];
    if (!state) return;
    // The lease runs on the twin's clock, the renewals on ours.
    const pace = store.state.clock?.speed_up, lease = Math.min(MOST_S, LEASE_S * Math.max(1, Number(pace) || 1));
    const top = state.speed ?? JOG_FALLBACK[state.unit];
    command("axes.jog", { axis, velocity: direction * top * Number($("#jog-speed").value), lease_s: lease }, `Cannot jog ${axis}`).then((answer) => { if (answer === null) jogStop(token); });
  };
  held.set(token, { axis, timer: setInterval(renew, RENEW_MS) });
  renew();
}
export function jogStop(token) {
  const hold = held.get(token);
  if (!hold) return;
  clearInterval(hold.timer); held.delete(token);
  command("axes.jog", { axis: hold.axis, velocity: 0 }, `Cannot stop ${hold.axis}`);
}
export function jogStopAll() { for (const token of [...held.keys()]) jogStop(token); }

export async function move(axis, value) {
  if (!Number.isFinite(value)) return;
  const answer = await command("axes.move", { targets: { [axis]: value }, plan: $("#around").checked }, `${axis} does not move`);
  if (answer === null) { const row = rows.get(axis); if (row) row.editing = false; return; }
  for (const warning of answer.warnings ?? []) emit("note", "warning-note", axis, warning);
}

function jogButton(axis, direction, sign) {
  const token = `${axis}:${direction}`;
  const button = el("button", { title: `Hold to jog ${axis}`, "aria-label": `jog ${axis} ${direction > 0 ? "up" : "down"}` }, sign);
  button.dataset.jog = token;
  const stop = () => { button.classList.remove("held"); jogStop(token); };
  button.addEventListener("pointerdown", (e) => { e.preventDefault(); button.setPointerCapture(e.pointerId); button.classList.add("held"); jogStart(axis, direction, token); });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(name, stop);
  return button;
}

function build(state) {
  const groups = GROUPS.map(([title, tint, names]) => [title, tint, names.filter((n) => n in state.axes)]);
  const known = new Set(groups.flatMap((g) => g[2]));
  const others = Object.keys(state.axes).filter((n) => !known.has(n));
  if (others.length) groups.push(["Others", "#999", others]);
  const box = $("#axes"); box.textContent = ""; rows.clear();
  for (const [title, tint, names] of groups) {
    if (!names.length) continue;
    const group = el("div", { class: "group" }, el("h3", {}, title)); group.style.setProperty("--tint", tint);
    for (const name of names) group.append(axisRow(name, state.axes[name]));
    box.append(group);
  }
}

function axisRow(name, axis) {
  const [low, high] = axis.limits, step = axis.unit === "deg" ? 0.1 : 0.1;
  const slider = el("input", { type: "range", min: low, max: high, step, value: axis.target, "aria-label": `${name} slider` });
  const number = el("input", { type: "number", min: low, max: high, step: "any", "aria-label": `${name} value` });
  const now = el("span", { class: "now" });
  const row = { name, slider, number, now, editing: false, low, high };
  slider.addEventListener("input", () => { row.editing = true; number.value = fixed(Number(slider.value), 3); });
  slider.addEventListener("change", () => { row.editing = false; row.hold = performance.now() + 400; move(name, Number(slider.value)); });
  number.addEventListener("focus", () => { row.editing = true; });
  number.addEventListener("blur", () => { row.editing = false; });
  number.addEventListener("keydown", (e) => { if (e.key === "Enter") { move(name, Number(number.value)); number.blur(); } if (e.key === "Escape") number.blur(); e.stopPropagation(); });
  row.box = el("div", { class: "axis" },
    el("div", { class: "top" }, el("span", {}, el("span", { class: "name" }, name), el("span", { class: "what" }, WHAT[name] ?? "")), el("span", {}, number, el("span", { class: "unit" }, axis.unit === "deg" ? "°" : "mm"))),
    el("div", { class: "line" }, jogButton(name, -1, "−"), el("div", { class: "track" }, slider, now), jogButton(name, +1, "+")));
  row.box.dataset.axis = name;
  rows.set(name, row);
  return row.box;
}

function refresh(state) {
  if (!rows.size || Object.keys(state.axes).some((n) => !rows.has(n))) build(state);
  for (const row of rows.values()) {
    const axis = state.axes[row.name];
    if (!axis) continue;
    if (!row.editing && performance.now() > (row.hold ?? 0)) {
      row.slider.value = axis.moving ? axis.target : axis.position;
      const text = fixed(axis.position, 3);
      if (row.number.value !== text) row.number.value = text;
    }
    const at = (axis.position - row.low) / (row.high - row.low);
    row.now.style.left = `calc(8px + (100% - 16px) * ${Math.min(1, Math.max(0, at)).toFixed(4)})`;
    row.box.classList.toggle("moving", axis.moving);
    row.box.classList.toggle("limit", !axis.moving && (axis.position - row.low < 0.5 || row.high - axis.position < 0.5));
  }
}

$("#handles").addEventListener("change", (e) => command("viewer.layers", { gizmos: e.target.checked }));
on("layers", () => { $("#handles").checked = Boolean(store.layers.gizmos); });
on("state", refresh);
on("connection", () => { if (!store.viewer || !store.twin) for (const [token, hold] of held) { clearInterval(hold.timer); held.delete(token); } });
