// Histograms and curves with axes, units and ticks, drawn by uPlot.
import uPlot from "./uplot.js";
/** @import { Pair } from "../web/viewer.d.ts" */

const FONT = "10px system-ui, sans-serif";
const X_AXIS_PX = 17;
const Y_AXIS_PX = 34;
const LABEL_PX = 13;
const GAP_PX = 2;
const TICK_PX = 3;
const X_TICKS_APART_PX = 46;
const Y_TICKS_APART_PX = 18;
// Above the plot and right of it: room for half a tick's number.
const MARGIN_PX = 10;
const HANDLE_PX = 6;
const CURVE_PX = 1.5;
const PALE = "55";
const FILL = "33";
// Shares below this part of a percent are drawn nearly linearly, those above by their logarithm:
// what is rare shows beside much air.
const LINEAR_PERCENT = 0.01;
const PERCENTS = [0.1, 1, 10, 100];

/**
 * A vertical line over a histogram; `handle` marks its ends as something that is pulled.
 * @typedef {object} Mark
 * @property {number} at
 * @property {string} colour
 * @property {boolean} handle
 */

/**
 * Places along a histogram: values as they are, or base-10 logarithms of values.
 * @typedef {"even" | "decades"} Places
 */

/**
 * How often values occur between two ends; those outside the window are pale.
 * @typedef {object} Counted
 * @property {ArrayLike<number>} counts
 * @property {Pair} range
 * @property {string} unit
 * @property {Pair} window
 * @property {Mark[]} marks
 */

/**
 * @typedef {object} Histogram
 * @property {HTMLElement} area The plot without its axes: its width is the range.
 * @property {(counted: Counted) => void} draw
 */

/**
 * Values over places; `NaN` leaves a gap.
 * @typedef {object} Line
 * @property {number[]} places
 * @property {number[]} values
 * @property {string} unit
 * @property {string} of
 */

/**
 * @typedef {object} Curve
 * @property {(line: Line) => void} draw
 */

const COMPACT = new Intl.NumberFormat("en", {
  notation: "compact",
  maximumSignificantDigits: 3,
});

/**
 * A tick's number; none for one that uPlot leaves out where they stand close.
 * @param {number | null} value
 */
const written = (value) => (value === null ? "" : COMPACT.format(value).replace("-", "−"));

/**
 * @param {Element} host
 * @param {string} name
 */
const colour = (host, name) => getComputedStyle(host).getPropertyValue(name);

/**
 * @param {Element} host
 * @param {uPlot.Axis} more
 * @returns {uPlot.Axis}
 */
function axis(host, more) {
  const grid = { stroke: () => colour(host, "--line"), width: 1 };
  return {
    stroke: () => colour(host, "--muted"),
    font: FONT,
    labelFont: FONT,
    labelSize: LABEL_PX,
    labelGap: 0,
    gap: GAP_PX,
    grid,
    ticks: { ...grid, size: TICK_PX },
    values: (_, splits) => splits.map(written),
    ...more,
  };
}

/**
 * An empty plot in its host; `units` are asked for whenever it is drawn.
 * @param {HTMLElement} host
 * @param {uPlot.Series[]} series
 * @param {{ x: () => string; y: () => string }} units
 * @param {{ x: () => Pair; y: () => Pair }} ranges
 * @param {{ scale?: uPlot.Scale; axis?: uPlot.Axis }} y
 * @param {(chart: uPlot) => void} [over]
 * @param {uPlot.Axis} [ticks]
 * @returns {uPlot}
 */
function plot(host, series, units, ranges, y, over = () => {}, ticks = {}) {
  const across = { label: units.x, size: X_AXIS_PX, space: X_TICKS_APART_PX, ...ticks };
  const upright = { label: units.y, size: Y_AXIS_PX, space: Y_TICKS_APART_PX };
  return new uPlot(
    {
      width: 1,
      height: 1,
      padding: [MARGIN_PX, MARGIN_PX, 0, 0],
      legend: { show: false },
      cursor: { show: false },
      scales: {
        x: { time: false, range: () => ranges.x() },
        y: { range: () => ranges.y(), ...y.scale },
      },
      axes: [axis(host, across), axis(host, { ...upright, ...y.axis })],
      series: [{}, ...series],
      hooks: { draw: [over] },
    },
    [[], ...series.map(() => [])],
    host,
  );
}

/**
 * As large as the host is now; false while it is hidden.
 * @param {uPlot} chart
 * @param {HTMLElement} host
 * @returns {boolean}
 */
function fits(chart, host) {
  const [width, height] = [host.clientWidth, host.clientHeight];
  if (!width || !height) return false;
  if (chart.width !== width || chart.height !== height) chart.setSize({ width, height });
  return true;
}

/**
 * Draws again what was drawn last, where the host has another size than then.
 * @template T
 * @param {HTMLElement} host
 * @param {(drawn: T) => void} draw
 * @returns {(drawn: T) => void}
 */
function kept(host, draw) {
  /** @type {T | null} */
  let last = null;
  new ResizeObserver(() => {
    if (last !== null) draw(last);
  }).observe(host);
  return (drawn) => {
    last = drawn;
    draw(drawn);
  };
}

/**
 * @param {Pair} ends
 * @returns {Pair}
 */
const apart = ([low, high]) => (high > low ? [low, high] : [low, low + 1e-9]);

/**
 * Whole powers of ten between two logarithms.
 * @param {number} low
 * @param {number} high
 * @returns {number[]}
 */
function powers(low, high) {
  const first = Math.ceil(low);
  const count = Math.floor(high) - first + 1;
  return Array.from({ length: Math.max(0, count) }, (_, k) => first + k);
}

/**
 * @param {HTMLElement} host
 * @param {Places} [places]
 * @returns {Histogram}
 */
export function histogram(host, places = "even") {
  /** @type {Counted | null} */
  let shown = null;
  let most = 1;
  /** @type {uPlot.Axis} */
  const ticks = {
    splits: (_chart, _axis, low, high) => powers(low, high),
    values: (_, splits) => splits.map((power) => written(power === null ? null : 10 ** power)),
  };

  /**
   * @param {string} tint
   * @returns {uPlot.Series}
   */
  const bar = (tint) => ({
    paths: uPlot.paths.bars?.({ size: [1], gap: 1 }),
    fill: () => colour(host, "--accent") + tint,
    width: 0,
    points: { show: false },
  });
  /** @type {uPlot.Scale} */
  const scale = {
    // eslint-disable-next-line @typescript-eslint/no-unsafe-enum-assignment -- types alone have it
    distr: 100, // by `fwd` and `bwd`
    fwd: (percent) => Math.log1p(percent / LINEAR_PERCENT),
    bwd: (drawn) => LINEAR_PERCENT * Math.expm1(drawn),
  };
  const percents = { splits: () => PERCENTS.filter((percent) => percent <= most) };
  const chart = plot(
    host,
    [bar(""), bar(PALE)],
    { x: () => shown?.unit ?? "", y: () => "share [%]" },
    { x: () => apart(shown?.range ?? [0, 1]), y: () => [0, most] },
    { scale, axis: percents },
    (drawn) => mark(drawn, shown?.marks ?? []),
    places === "decades" ? ticks : {},
  );
  return {
    area: chart.over,
    draw: kept(host, (counted) => {
      shown = counted;
      if (!fits(chart, host)) return;
      const counts = Array.from(counted.counts);
      const [low, high] = apart(counted.range);
      const step = (high - low) / counts.length;
      const sum = counts.reduce((a, n) => a + n, 0) || 1;
      const middles = counts.map((_, k) => low + (k + 0.5) * step);
      const shares = counts.map((n) => (100 * n) / sum);
      const pale = middles.map((v) => v < counted.window[0] || v > counted.window[1]);
      most = Math.max(...shares, LINEAR_PERCENT);
      const bright = shares.map((share, k) => (pale[k] ? null : share));
      const outside = shares.map((share, k) => (pale[k] ? share : null));
      chart.setData([middles, bright, outside]);
    }),
  };
}

/**
 * @param {uPlot} chart
 * @param {Mark[]} marks
 */
function mark(chart, marks) {
  const { ctx, bbox } = chart;
  const side = HANDLE_PX * devicePixelRatio;
  ctx.save();
  for (const { at, colour, handle } of marks) {
    const x = Math.min(
      bbox.left + bbox.width,
      Math.max(bbox.left, chart.valToPos(at, "x", true)),
    );
    ctx.fillStyle = colour;
    ctx.fillRect(x - devicePixelRatio, bbox.top, 2 * devicePixelRatio, bbox.height);
    if (!handle) continue;
    ctx.fillRect(x - side / 2, bbox.top, side, side);
    ctx.fillRect(x - side / 2, bbox.top + bbox.height - side, side, side);
  }
  ctx.restore();
}

/**
 * A curve; `filled` from zero, as spectra are.
 * @param {HTMLElement} host
 * @returns {Curve}
 */
export function curve(host, filled = false) {
  /** @type {Line | null} */
  let shown = null;
  /** @type {Pair} */
  let ends = [0, 1];
  const stroke = () => colour(host, "--accent");
  const fill = () => stroke() + FILL;
  const chart = plot(
    host,
    [{ stroke, width: CURVE_PX, points: { show: false }, ...(filled ? { fill } : {}) }],
    { x: () => shown?.unit ?? "", y: () => shown?.of ?? "" },
    {
      x: () => apart([shown?.places[0] ?? 0, shown?.places.at(-1) ?? 1]),
      y: () => apart(ends),
    },
    {},
  );
  return {
    draw: kept(host, (line) => {
      shown = line;
      if (!fits(chart, host)) return;
      const known = line.values.filter(Number.isFinite);
      ends = [filled ? 0 : Math.min(...known), Math.max(...known)];
      const values = line.values.map((v) => (Number.isFinite(v) ? v : null));
      chart.setData([line.places, values]);
    }),
  };
}

/**
 * Places equally far apart, from 0 to a length.
 * @param {number} length
 * @param {number} count
 * @returns {number[]}
 */
export const along = (length, count) =>
  Array.from({ length: count }, (_, k) => (length * k) / Math.max(1, count - 1));
