// The scan designer: bars for voxel, tube, exposure and images; what a scan with them will look like. A change of a bar
// rewrites the script, unless somebody else's stands there.
import {
  $input,
  $select,
  bars,
  bytes,
  cleared,
  el,
  fixed,
  seconds,
  setText,
  words,
} from "./dom.js";
import type { Compose, ExposurePrediction, TransmissionShares } from "./viewer.js";
import { call, emit, on, store } from "./link.js";

const SETTLE_MS = 400,
  LATEST = 1.02;
// Bars are logarithmic where values are; [name, words, unit, digits].
type Bar = "voxel_um" | "kV" | "power_W" | "exposure_ms" | "frames";
const BARS: Array<[name: Bar, words: string, unit: string, digits: number]> = [
  ["voxel_um", "voxel", "µm", 1],
  ["kV", "voltage", "kV", 0],
  ["power_W", "power", "W", 0],
  ["exposure_ms", "exposure", "ms", 0],
  ["frames", "images", "", 0],
];
type Scale = [low: number, high: number, log: boolean];
const scales: Partial<Record<Bar, Scale>> = {},
  inputs = {} as Record<Bar, HTMLInputElement>;
const row = ([name, words, unit, digits]: (typeof BARS)[number]) => {
  const out = el("output", { id: `design-${name}-is`, class: "mono" });
  const say = () => setText(out, `${fixed(value(name), digits)} ${unit}`);
  inputs[name] = el("input", {
    type: "range",
    id: `design-${name}`,
    min: 0,
    max: 1000,
    step: "any",
    oninput: say,
    onchange: changed,
  });
  return [
    el("label", { class: "muted", htmlFor: `design-${name}` }, words),
    el("span", { class: "row" }, inputs[name], out),
  ];
};
const word = (id: string, label: string, start: string, title: string) => [
  el("label", { class: "muted", htmlFor: id, title }, label),
  el("input", { type: "text", id, value: start, title, onchange: changed }),
];
const facts = el("div", { id: "design-facts", class: "small-text", "aria-live": "polite" });
const chart = el("canvas", {
  id: "design-chart",
  role: "img",
  "aria-label": "Predicted histogram of transmission",
});
const card = el(
  "details",
  {
    id: "designer",
    ontoggle: () => {
      if (card.open) void begin();
    },
  },
  el("summary", {}, "Design a scan"),
  el(
    "div",
    { class: "form" },
    ...BARS.flatMap(row),
    ...word(
      "design-filter",
      "filter",
      "",
      "MATERIAL:MM beside the machine’s own, put there by hand: aluminium:1",
    ),
    ...word(
      "design-detail",
      "detail",
      "void:0.5",
      "What is to be seen on the darkest ray: MATERIAL:MM or void:MM",
    ),
    ...word(
      "design-cnr",
      "CNR wanted",
      "5",
      "Contrast to noise of the detail that is wished for",
    ),
  ),
  chart,
  facts,
);
export const place = (node: HTMLElement): void => node.append(card);

export function value(name: Bar): number {
  const [low, high, log] = scales[name] ?? [0, 1, false],
    t = Number(inputs[name].value) / 1000;
  const v = log ? low * (high / low) ** t : low + t * (high - low);
  return name === "voxel_um" ? v : Math.round(v);
}
function put(name: Bar, v: number) {
  const [low, high, log] = scales[name] ?? [0, 1, false],
    t = log ? Math.log(v / low) / Math.log(high / low) : (v - low) / (high - low);
  inputs[name].value = String(1000 * Math.min(1, Math.max(0, t)));
  inputs[name].dispatchEvent(new Event("input"));
}
// What a script is to have; nothing while the designer is closed.
const wished = () =>
  Object.fromEntries(BARS.map(([name]) => [name, value(name)])) as Record<Bar, number>;
export const wish = (): Partial<Record<Bar, number>> =>
  card.open && scales.kV ? wished() : {};

async function begin() {
  if (scales.kV || !store.state) return;
  const { tube, camera } = store.state;
  const limits = await call("viewer.spectrum", { kV: tube.kV }).then(
    (s) => s.limits,
    () => null,
  );
  if (!limits) return;
  Object.assign(scales, {
    kV: [...limits.kV, false],
    power_W: [1, limits.power_W[1], false],
    exposure_ms: [...limits.exposure_ms, true],
    frames: [2, 3600, true],
  } satisfies Partial<Record<Bar, Scale>>);
  const start: Partial<Record<Bar, number>> = {
    kV: tube.kV,
    power_W: tube.power_W,
    exposure_ms: camera.exposure_ms,
    frames: $input("#wish-frames").valueAsNumber || 361,
  };
  for (const [name, v] of Object.entries(start)) put(name as Bar, v);
  scaleVoxels();
  void predict();
}
// Voxels are pixels of the mode that is set, at the distances that stand.
let pixel = 0;
function scaleVoxels() {
  if (!store.state) return;
  const { camera, geometry: g } = store.state;
  pixel = 1000 * camera.pixel_mm;
  scales.voxel_um = [pixel / 20, pixel, true];
  put("voxel_um", (pixel * g.SOD_mm) / g.SDD_mm);
}
let due: number | undefined,
  number = 0;
function changed() {
  $input("#wish-frames").value = String(value("frames"));
  $input("#wish-exposure").value = String(value("exposure_ms"));
  clearTimeout(due);
  due = window.setTimeout(() => {
    emit("design");
    void predict();
  }, SETTLE_MS);
}
async function predict() {
  if (!store.state) return;
  const mine = ++number,
    { geometry: g, camera, sample } = store.state,
    w = wished();
  setText(facts, `predicting a scan of ${sample.name || "nothing"} …`);
  const asked = {
    kV: w.kV,
    power_W: w.power_W,
    exposure_ms: w.exposure_ms,
    frames: w.frames,
    kind: $select("#wish-kind").value as Compose["kind"],
    averages: 1,
    filter: $input("#design-filter").value.trim(),
    detail: $input("#design-detail").value.trim(),
    sdd_mm: Number(g.SDD_mm.toFixed(4)),
    sod_mm: Number(((w.voxel_um / 1000 / camera.pixel_mm) * g.SDD_mm).toFixed(4)),
  };
  let p: ExposurePrediction;
  try {
    p = await call("exposure.predict", asked);
  } catch (error) {
    if (mine === number) {
      setText(facts, words(error));
      chart.hidden = true;
    }
    return;
  }
  if (mine !== number) return;
  const cnr = p.asked.cnr ?? 0,
    goal = Number($input("#design-cnr").value),
    ms = w.exposure_ms * (goal / cnr) ** 2,
    best = p.best.at(0),
    enough = cnr * LATEST >= goal;
  const part = (v: number) => `${fixed(100 * v, v && v < 0.1 ? 1 : 0)} %`,
    line = (id: string, ...nodes: Array<Node | string | null>) =>
      el("div", { id: `design-${id}` }, ...nodes);
  // Noise of photons goes with the root of the time, what the panel adds falls faster.
  const other = best && (best.kV !== w.kV || best.filter !== p.asked.filter);
  const reach = {
    class: "small",
    id: "design-reach",
    onclick: () => {
      put("exposure_ms", ms);
      changed();
    },
  };
  facts.replaceChildren(
    line(
      "time",
      `${seconds(p.seconds)} · ${bytes(p.bytes)} · ${fixed(p.asked.kerma_mGy, 2)} mGy on the axis`,
    ),
    line(
      "least",
      `least transmission ${part(p.transmission.least)} · saturated ${part(p.saturated)} · starved ${part(p.starved)}`,
    ),
    line(
      "quality",
      `contrast to noise of ${p.detail}: `,
      el(
        "b",
        { class: `verdict ${enough ? "ok" : "bad"}` },
        p.asked.cnr === null ? "saturated" : fixed(cnr, 2),
      ),
      " ",
      enough || !(goal > 0) || p.asked.cnr === null
        ? null
        : ms <= (scales.exposure_ms?.[1] ?? 0)
          ? el("button", reach, `${fixed(goal, 1)} takes ${fixed(Math.ceil(ms), 0)} ms at most`)
          : `no exposure reaches ${fixed(goal, 1)}`,
    ),
    line(
      "best",
      other
        ? `best at ${fixed(best.kV, 0)} kV${best.filter ? `, ${best.filter}` : ""}: ${fixed(best.cnr ?? 0, 2)}`
        : "",
      ...p.assumed.map((a) => ` · ${a}`),
    ),
  );
  draw(p.transmission);
}
function draw({ edges, shares }: TransmissionShares) {
  chart.hidden = false;
  const room = cleared(chart),
    style = getComputedStyle(chart);
  bars(
    room,
    shares.map((share) => 1000 * share),
    (k) => {
      room[0].fillStyle = style.getPropertyValue(edges[k] < 0.02 ? "--warn" : "--accent");
    },
  );
}
on("state", (s) => {
  if (!scales.kV) return;
  const now = JSON.stringify([s.sample.name, s.sample.revision, s.geometry.SDD_mm.toFixed(1)]),
    seen = JSON.stringify([s.camera.mode, s.camera.roi]);
  if (pixel !== 1000 * s.camera.pixel_mm) scaleVoxels();
  if (card.open && panel && seen !== panel) changed();
  else if (card.open && now !== stood) void predict();
  stood = now;
  panel = seen;
});
let stood = "",
  panel = "";
$input("#wish-kind").addEventListener("change", () => {
  if (card.open && scales.kV) changed();
});
