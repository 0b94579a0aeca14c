// The Calibrate tab: corrections there are, the one in force, applying and undoing, running a fit.
import { nextStep } from "./calibrate_next.js";
import { $, $$, $button, $input, chosen, clicks, el, fixed, words } from "./dom.js";
import { call, command, emit, on } from "./link.js";
import { MEANS, unit } from "./belief.js";
import { know } from "./compare.js";
import { open } from "./data.js";
/**
 * @import { CalibrationAlignResult, Correction, Estimated, FitReport, Requests }
 *   from "../web/viewer.d.ts"
 */

clicks({ revert, fit });
$input("#fit-phantom").addEventListener("input", named);

/** @typedef {Record<string, number | null>} Parameters */

/**
 * @param {object} parameters
 * @returns {Record<string, unknown>}
 */
const values = (parameters) =>
  Object.fromEntries(
    Object.entries(parameters).map((/** @type {[string, unknown]} */ [k, v]) => [
      k,
      typeof v === "number" ? v : /** @type {{ value?: unknown } | null} */ (v)?.value,
    ]),
  );

/**
 * The parameters of a report, or of a plain list of them: all of them numbers, or none is
 * taken.
 * @param {unknown} report
 * @returns {Record<string, number>}
 */
export function parametersOf(report) {
  /**
   * @param {unknown} o
   * @returns {o is Record<string, unknown>}
   */
  const object = (o) => o !== null && typeof o === "object" && !Array.isArray(o);
  const given = object(report) && "parameters" in report ? report.parameters : report;
  if (!object(report) || !object(given) || !Object.keys(given).length)
    throw new Error("there are no parameters in it");
  if (report.identifiable === false)
    throw new Error("it says that its numbers are not identifiable");
  const found = values(given);
  const bad = Object.keys(found).filter((k) => !Number.isFinite(found[k]));
  if (bad.length) throw new Error(`no number: ${bad.slice(0, 5).join(", ")}`);
  return /** @type {Record<string, number>} */ (found);
}

/**
 * Whether a report is of a phantom whose beads are known.
 * @param {unknown} report
 */
const ofBeads = (report) => {
  const { phantom } = /** @type {{ phantom?: unknown }} */ (report);
  return typeof phantom === "string" && phantom !== "unknown";
};

// Decimals of mm and degrees without a sigma: a tenth of a micrometre.
const FINEST = 4;
// Outliers that a report names.
const LISTED = 3;
/**
 * Decimals that leave `digits` significant ones.
 * @param {number} v
 * @param {number} digits
 */
const decimals = (v, digits) =>
  Math.min(9, Math.max(0, digits - 1 - Math.floor(Math.log10(Math.abs(v) || 1))));

/**
 * @param {Parameters} parameters
 * @param {Record<string, number | null>} [sigmas]
 * @param {Record<string, string>} [units]
 */
function table(parameters, sigmas = {}, units = {}) {
  const shown = Object.entries(parameters).filter(([k, v]) =>
    k === "angle_scale" ? v !== 1 : Math.abs(v ?? 0) >= 0.5 * 10 ** -FINEST || k in sigmas,
  );
  return el(
    "table",
    { class: "plain mono" },
    ...shown.map(([k, v]) => {
      const sigma = sigmas[k] ?? 0;
      const d =
        sigma > 0
          ? decimals(sigma, 2)
          : k === "angle_scale"
            ? decimals((v ?? 0) - 1, 3)
            : Math.min(FINEST, decimals(v ?? 0, 3));
      return el(
        "tr",
        {},
        el(
          "td",
          {},
          MEANS[k] ?? k,
          MEANS[k] ? el("span", { class: "muted small-text" }, ` ${k}`) : null,
        ),
        el("td", { class: "n" }, fixed(v, d)),
        el("td", { class: "n muted" }, sigma > 0 ? `± ${fixed(sigma, d)}` : ""),
        el("td", { class: "muted" }, (units[k] ?? unit(k)).replace(/^1$/, "")),
      );
    }),
  );
}

/**
 * Says whether the correction is in force.
 * @param {Record<string, number>} parameters
 * @param {string | null} source
 * @returns {Promise<boolean>}
 */
export async function apply(
  parameters,
  source,
  comment = "",
  sides_known = false, // found from beads of known places
) {
  const answer = await command(
    "calibration.apply",
    { parameters, source, comment, sides_known },
    "Not applied",
  );
  if (!answer) return false;
  // warnings come by the log
  emit("note", "good", "Correction", `${answer.correction?.name ?? "correction"} is in force`);
  void refresh();
  return true;
}

/** @param {string} name */
async function remove(name) {
  if (!(await command("calibration.delete", { name }, `${name} stays`))) return;
  emit("note", "good", "Correction", `${name} is deleted`);
  void refresh();
}
async function revert() {
  const answer = await command("calibration.revert", {}, "Not undone");
  if (!answer) return;
  const now = answer.correction
    ? `${answer.correction.name} is in force again`
    : "nominal geometry";
  emit("note", "good", "Correction", `undone: ${now}`);
  void refresh();
}

export async function refresh() {
  const answer = await call("calibration.list").catch(() => null);
  if (!answer) return;
  const box = $("#corrections");
  box.textContent = "";
  if (!answer.corrections.length) box.append(el("div", { class: "muted" }, "none yet"));
  for (const c of [...answer.corrections].reverse()) {
    const again = () => void apply(c.parameters, c.source, `again: ${c.name}`, c.sides_known);
    box.append(
      el(
        "div",
        {},
        el("span", { title: c.comment }, c.name),
        el("span", { class: "muted small-text" }, dated(c)),
        ...(c.name === answer.current
          ? [el("b", {}, "in force")]
          : [
              el("button", { class: "small", onclick: again }, "apply"),
              el("button", { class: "small", onclick: () => remove(c.name) }, "delete"),
            ]),
      ),
    );
  }
}

/** @param {Correction} correction */
const dated = (correction) => correction.date.slice(0, 16).replace("T", " ");
chosen($input("#correction-file"), async (file) => {
  try {
    /** @type {unknown} */
    const report = JSON.parse(await file.text());
    await apply(parametersOf(report), file.name, "", ofBeads(report));
  } catch (error) {
    emit("note", "error", "Not applied", `${file.name}: ${words(error)}`);
  }
});

async function datasets() {
  const answer = await call("viewer.datasets").catch(() => null);
  if (!answer) return;
  const box = $("#datasets");
  const chosen = new Set(ticked());
  box.textContent = "";
  const none = !answer.datasets.some((each) => each.present);
  $button("#fit").disabled = none;
  if (none) box.append(el("div", { class: "muted" }, "no data sets yet: run a scan"));
  withoutBeads.clear();
  for (const { name, beads } of answer.datasets) if (beads === false) withoutBeads.add(name);
  for (const d of answer.datasets.filter((each) => each.present)) {
    const own = () => {
      if (tick.checked && d.sample) $input("#fit-phantom").value = d.sample;
      named();
      weigh();
    };
    const told = { type: "checkbox", value: d.name, checked: chosen.has(d.name) };
    const tick = el("input", { ...told, onchange: own });
    box.append(
      el(
        "div",
        {},
        el("label", {}, tick, d.name),
        el("span", { class: "muted small-text" }, `${d.sample ?? "?"} · ${d.present} frames`),
      ),
    );
  }
  weigh();
}
/** Whether calibrating is the thing to do: not where the ticked samples are known without beads. */
function weigh() {
  const names = ticked();
  const beadless = names.filter((name) => withoutBeads.has(name));
  $("#fit").classList.toggle("primary", names.length > 0 && !beadless.length);
  const words = "has no beads to calibrate by: Align, in the Data tab, finds its axis without";
  if ($button("#fit").disabled) return;
  $("#fit-note").textContent = beadless.length ? `${beadless.join(", ")} ${words}` : "";
}
/** @type {Set<string>} */
const withoutBeads = new Set();
function named() {
  $("#fit-scale").hidden = $("#fit-scale-label").hidden =
    $input("#fit-phantom").value !== "unknown";
}
const wanted = () => ({
  phantom: $input("#fit-phantom").value,
  tracks: true,
  scale: $("#fit-scale").hidden ? null : $input("#fit-scale").value || null,
});
const ticked = () =>
  /** @type {HTMLInputElement[]} */ ($$("#datasets input:checked")).map((i) => i.value);
function fit() {
  const names = ticked();
  if (!names.length) {
    emit("note", "warning-note", "Calibrate", "choose a data set");
    return;
  }
  void estimate("calibration.fit", { datasets: names, ...wanted() }, names, "No calibration");
}

/**
 * @template {"calibration.fit" | "calibration.align"} M
 * @param {M} method
 * @param {Requests[M]} params
 * @param {string[]} names
 * @param {string} title
 */
async function estimate(method, params, names, title) {
  const beads = "phantom" in params && params.phantom !== "unknown";
  $button("#fit").disabled = true;
  $("#fit-note").textContent = `${names.join(", ")}: running…`;
  $("#fit-report").textContent = "";
  /** @type {Partial<FitReport & CalibrationAlignResult> | null} */
  const r = await command(method, params, title);
  $button("#fit").disabled = false;
  weigh();
  if (!r) return;
  const scan = know(r.tracks?.datasets ?? []);
  const { correction, parameters = {} } = r;

  /**
   * @template {"value" | "sigma" | "unit"} W
   * @param {Record<string, Pick<Estimated, W>>} some
   * @param {W} what
   */
  const of = (some, what) =>
    Object.fromEntries(Object.entries(some).map(([k, v]) => [k, v[what]]));
  /** @param {Record<string, Pick<Estimated, "value" | "sigma" | "unit">>} some */
  const shown = (some) => table(of(some, "value"), of(some, "sigma"), of(some, "unit"));
  const reduced = r.cost_reduction_pct ?? 0;
  const side = reduced < 0 ? "above" : "below";
  const squares = `sum of squares ${fixed(Math.abs(reduced), 1)} % ${side} that before`;
  const figures = r.tracks
    ? `  rms ${fixed(r.rms_px, 3)} px · ${r.frames} frames · ${squares}`
    : `  ${names[0]}, without a phantom`;
  const applied = {
    id: "fit-apply",
    class: "small primary",
    disabled: !r.identifiable || !correction,
    onclick: () => {
      if (correction) void apply(correction, names.join(", "), "", beads);
    },
  };
  const compared = {
    id: "fit-compare",
    class: "small",
    disabled: !scan,
    title: "Where the beads were predicted before and after, over the radiographs",
    onclick: () => open(scan, null, true),
  };
  const actions = {
    compare: scan ? () => open(scan, null, true) : null,
    /** @param {string[]} free */
    again: (free) =>
      estimate(
        "calibration.fit",
        { datasets: names, ...wanted(), free },
        names,
        "No calibration",
      ),
  };
  const [use, ...why] = (
    r.verdict ?? (r.identifiable ? "Identifiable" : "Not identifiable")
  ).split(": ");
  const left = (r.outliers ?? []).map(
    (o) => `bead ${o.marker} of frame ${o.frame} (${fixed(o.px ?? 0, 2)} px)`,
  );
  const more = left.length > LISTED ? ` and ${left.length - LISTED} more` : "";
  $("#fit-report").append(
    el(
      "div",
      {},
      el("span", { class: `verdict ${r.identifiable ? "ok" : "bad"}` }, use),
      why.length ? `: ${why.join(": ")}` : "",
    ),
    ...(r.next ?? []).map((line) => nextStep(line, actions)),
    ...(r.image_space ?? []).map(shown),
    el(
      "div",
      { class: "muted" },
      figures,
      left.length ? ` · left out: ${left.slice(0, LISTED).join(", ")}${more}` : "",
    ),
    shown(parameters),
    ...(r.weak ?? []).map((w) => el("div", { class: "error" }, w)),
    ...Object.entries(r.refused ?? {}).map(([name, why]) =>
      el("div", { class: "muted" }, `${name}: ${why}`),
    ),
    ...(r.warnings ?? []).map((w) => el("div", { class: "error" }, w)),
    el(
      "div",
      { class: "row", style: "margin-top:7px" },
      el("button", applied, "Apply"),
      r.tracks ? el("button", compared, "Compare over a radiograph") : null,
    ),
  );
}
on("calibrate", async (dataset, sample, markers) => {
  emit("show-tab", "calibrate");
  await datasets();
  for (const tick of /** @type {HTMLInputElement[]} */ ($$("#datasets input")))
    tick.checked = tick.value === dataset;
  if (sample && !(markers && wanted().phantom === "unknown")) {
    $input("#fit-phantom").value = sample;
    named();
  }
  void estimate(
    "calibration.fit",
    { datasets: [dataset], ...wanted(), markers: markers ?? null },
    [dataset],
    "No calibration",
  );
});
on("align", (dataset) => {
  emit("show-tab", "calibrate");
  void estimate("calibration.align", { name: dataset }, [dataset], "Not aligned");
});

/** @type {string | null | undefined} */
let name;
on("state", (state) => {
  const c = state.correction;
  $button("#revert").disabled = !c;
  if (name === (c?.name ?? null)) return;
  name = c?.name ?? null;
  $("#in-force").replaceChildren(
    ...(c
      ? [
          el("div", {}, el("b", {}, c.name), el("span", { class: "muted" }, `  ${dated(c)}`)),
          table(c.parameters),
        ]
      : [el("span", { class: "muted" }, "none: nominal geometry")]),
  );
  void refresh();
});
on("session", () => {
  void refresh();
  void datasets();
});
on("job", (job) => {
  if (["done", "incomplete"].includes(job.state)) void datasets();
});
on("tab", (tab) => {
  if (tab === "calibrate") {
    void refresh();
    void datasets();
  }
});
