// Three linked slices of a volume that is here as a whole: no slice is asked for. Stands alone,
// so that a shared file has it, too.
/** @import { Block, Pair, Vector } from "../web/viewer.d.ts" */

export const SIDES = /** @type {const} */ (["top", "front", "side"]);
/** @typedef {(typeof SIDES)[number]} Side */

// Of each picture, which of x, y and z goes right, which up, and which is gone through.
/** @type {Record<Side, Vector>} */
const AXES = { top: [0, 1, 2], front: [0, 2, 1], side: [1, 2, 0] };
const NAMES = "xyz";
const TOP = 65534;
const UNKNOWN = 0xff6e5a50;
const BAR = "#ffd54a";
const BEHIND = "#05070ab0";
const CROSS = "#5ab0ffb0";
const LINE = "#36e28f";
const BINS = 160;
const SAMPLES = 300_000;

/**
 * @param {Block} block
 * @returns {Vector}
 */
export const extent = ({ shape }) => [shape[2], shape[1], shape[0]];

/**
 * @param {Block} block
 * @param {Vector} voxel
 * @returns {number}
 */
export const index = ({ shape: [, ny, nx] }, [x, y, z]) => (z * ny + y) * nx + x;

/**
 * @param {Block} block
 * @param {number} code
 * @returns {number}
 */
export const valueOf = ({ low, high }, code) =>
  code ? low + ((code - 1) * (high - low)) / TOP : NaN;

/**
 * @param {Block} block
 * @param {number} value
 * @returns {number}
 */
export const codeOf = ({ low, high }, value) => 1 + ((value - low) * TOP) / (high - low);

/**
 * A round length [mm] of about a quarter of so much.
 * @param {number} mm
 * @returns {number}
 */
export function bar(mm) {
  const e = 10 ** Math.floor(Math.log10(mm / 4));
  const m = mm / 4 / e;
  return e * (m < 2 ? 1 : m < 5 ? 2 : 5);
}

/**
 * @param {CanvasRenderingContext2D} x
 * @param {number} mm
 * @param {number} px
 * @param {number} unit
 */
export function drawBar(x, mm, px, unit) {
  const h = x.canvas.height - 7 * unit;
  x.fillStyle = BAR;
  x.fillRect(8 * unit, h, px, 2.5 * unit);
  x.font = `${11 * unit}px system-ui, sans-serif`;
  x.textBaseline = "bottom";
  x.textAlign = "left";
  const words = `${mm} mm`;
  x.fillStyle = BEHIND; // lines of a volume's box pass there
  x.fillRect(6 * unit, h - 15 * unit, x.measureText(words).width + 4 * unit, 14 * unit);
  x.fillStyle = BAR;
  outlined(x, words, 8 * unit, h - 2 * unit, unit);
}

/**
 * Words that are read on dark and on bright matter.
 * @param {CanvasRenderingContext2D} x
 * @param {string} words
 * @param {number} left
 * @param {number} bottom
 * @param {number} unit
 */
function outlined(x, words, left, bottom, unit) {
  x.strokeStyle = "#000c";
  x.lineWidth = 3 * unit;
  x.lineJoin = "round";
  x.strokeText(words, left, bottom);
  x.fillText(words, left, bottom);
}

/**
 * Less than the truth is blue, more is orange.
 * @param {number} g
 */
export function signed(g) {
  const d = (2 * Math.abs(g - 127.5)) | 0;
  return g < 127.5
    ? 0xff000000 | (d << 16) | ((d >> 1) << 8)
    : 0xff000000 | ((d >> 1) << 8) | d;
}

/**
 * @typedef {object} Slices
 * @property {Block | null} block
 * @property {Pair} window
 * @property {Vector} cross
 * @property {boolean} profiling
 * @property {Block | null} beside Another volume of the same shape, which pictures show to the
 *   right of a part of their width.
 * @property {number} split
 * @property {(block: Block | null, window?: Pair) => void} show
 * @property {(window: Pair) => void} look
 * @property {(cross: Vector) => void} go
 * @property {() => void} draw
 * @property {(range: Pair) => Float64Array} histogram
 * @property {() => { values: number[]; mm: number } | null} profile
 */

/**
 * `pointed` hears of the voxel under the pointer, `moved` of a cross or a profile that was
 * moved.
 * @param {Record<Side, HTMLCanvasElement>} canvases
 * @param {(place: Vector | null) => void} pointed
 * @param {() => void} moved
 * @returns {Slices}
 */
export function slices(canvases, pointed, moved) {
  const table = new Uint32Array(TOP + 2);
  const other = new Uint32Array(TOP + 2);
  const buffers = /** @type {Record<Side, HTMLCanvasElement>} */ ({});
  let due = false;
  /** @type {{ side: Side; from: Pair; to: Pair } | null} */
  let line = null;
  /** @type {Slices} */
  const me = {
    block: null,
    window: [0, 1],
    cross: [0, 0, 0],
    profiling: false,
    beside: null,
    split: 1,
    show(block, window) {
      const before = me.block;
      const size = block && extent(block);
      if (size && before?.shape.join() !== block.shape.join()) {
        me.cross = /** @type {Vector} */ (size.map((n) => n >> 1));
        line = null;
      }
      me.block = block;
      me.look(window ?? block?.window ?? me.window);
    },
    look(window) {
      const b = me.block;
      me.window = window;
      if (b) fill(table, b, window);
      if (me.beside) fill(other, me.beside, window);
      me.draw();
    },
    go(cross) {
      if (!me.block) return;
      const size = extent(me.block);
      me.cross = /** @type {Vector} */ (
        cross.map((v, k) => Math.min(size[k] - 1, Math.max(0, Math.round(v))))
      );
      me.draw();
      moved();
    },
    draw() {
      if (!due) {
        due = true;
        requestAnimationFrame(() => {
          due = false;
          for (const side of SIDES) paint(side);
        });
      }
    },
    /** Of every n-th voxel. */
    histogram([low, high]) {
      const counts = new Float64Array(BINS);
      const b = me.block;
      const codes = b?.codes ?? new Uint16Array();
      const step = Math.max(1, Math.floor(codes.length / SAMPLES)) | 1;
      const from = b ? codeOf(b, low) : 0;
      const per = BINS / (b ? codeOf(b, high) - from : 1);
      for (let k = 0; k < codes.length; k += step) {
        const bin = Math.floor((codes[k] - from) * per);
        if (codes[k] && bin >= 0 && bin < BINS) counts[bin]++;
      }
      return counts;
    },
    profile() {
      const b = me.block;
      const l = line;
      if (!b || !l) return null;
      const [dx, dy] = [l.to[0] - l.from[0], l.to[1] - l.from[1]];
      const length = Math.hypot(dx, dy);
      const n = Math.max(2, Math.ceil(2 * length));
      const values = Array.from({ length: n }, (_, k) =>
        valueOf(
          b,
          b.codes[
            index(
              b,
              place(l.side, [l.from[0] + (dx * k) / (n - 1), l.from[1] + (dy * k) / (n - 1)]),
            )
          ],
        ),
      );
      return { values, mm: length * b.voxel_mm };
    },
  };

  /**
   * Colours of a block's codes.
   * @param {Uint32Array} colors
   * @param {Block} b
   * @param {Pair} window
   */
  function fill(colors, b, window) {
    const from = codeOf(b, window[0]);
    const step = 255 / Math.max(1e-9, codeOf(b, window[1]) - from);
    for (let k = 1; k < colors.length; k++) {
      const g = Math.min(255, Math.max(0, (k - from) * step)) | 0;
      colors[k] = b.signed ? signed(g) : 0xff000000 | (g * 0x010101);
    }
    colors[0] = UNKNOWN;
  }

  /**
   * The voxel of a place in a picture (voxels to the right, and up).
   * @param {Side} side
   * @param {Pair} shares
   * @returns {Vector}
   */
  function place(side, [right, up]) {
    const [i, j] = AXES[side];
    /** @type {Vector} */
    const at = [...me.cross];
    const size = me.block ? extent(me.block) : [1, 1, 1];
    at[i] = Math.min(size[i] - 1, Math.max(0, Math.round(right)));
    at[j] = Math.min(size[j] - 1, Math.max(0, Math.round(up)));
    return at;
  }
  /** @param {Side} side */
  function paint(side) {
    const canvas = canvases[side];
    const b = me.block;
    const x = canvas.getContext("2d");
    if (!b || !x || !canvas.clientWidth) return;
    const [i, j, k] = AXES[side];
    const size = extent(b);
    const [w, h] = [size[i], size[j]];
    const buffer = (buffers[side] ??= document.createElement("canvas"));
    if (buffer.width !== w || buffer.height !== h) {
      buffer.width = w;
      buffer.height = h;
      canvas.style.aspectRatio = `${w} / ${h}`;
    }
    const inside = buffer.getContext("2d");
    const strides = [1, size[0], size[0] * size[1]];
    const out = inside?.createImageData(w, h);
    if (!inside || !out) return;
    const data = new Uint32Array(out.data.buffer);
    const start = me.cross[k] * strides[k];
    const far = !b.own && me.beside?.shape.join() === b.shape.join() ? me.beside : null;
    const cut = far ? Math.round(me.split * w) : w;
    for (let r = 0, o = 0; r < h; r++) {
      let at = start + (h - 1 - r) * strides[j];
      for (let c = 0; c < w; c++, o++, at += strides[i]) {
        data[o] = far && c >= cut ? other[far.codes[at]] : table[b.codes[at]];
      }
    }
    inside.putImageData(out, 0, 0);
    const unit = Math.min(devicePixelRatio, 2);
    const wide = Math.round(canvas.clientWidth * unit);
    const high = Math.round((wide * h) / w);
    const s = wide / w;
    if (canvas.width !== wide || canvas.height !== high) {
      canvas.width = wide;
      canvas.height = high;
    }
    x.imageSmoothingEnabled = s < 2;
    x.drawImage(buffer, 0, 0, wide, high);
    const [cx, cy] = [(me.cross[i] + 0.5) * s, high - (me.cross[j] + 0.5) * s];
    x.strokeStyle = CROSS;
    x.lineWidth = unit;
    x.beginPath();
    x.moveTo(cx, 0);
    x.lineTo(cx, high);
    x.moveTo(0, cy);
    x.lineTo(wide, cy);
    x.stroke();
    if (far) {
      x.fillStyle = LINE;
      x.fillRect(cut * s - unit / 2, 0, unit, high);
    }
    if (line?.side === side) {
      x.strokeStyle = LINE;
      x.lineWidth = 1.5 * unit;
      x.beginPath();
      for (const [r, u] of [line.from, line.to]) x.lineTo((r + 0.5) * s, high - (u + 0.5) * s);
      x.stroke();
    }
    const mm = bar(w * b.voxel_mm);
    drawBar(x, mm, (mm / b.voxel_mm) * s, unit);
    x.textAlign = "right";
    const depth_mm = (me.cross[k] + 0.5 - size[k] / 2) * b.voxel_mm;
    const place = `${NAMES[i]} →  ${NAMES[j]} ↑  ${NAMES[k]} ${depth_mm.toFixed(2)} mm`;
    outlined(x, place, wide - 6 * unit, high - 4 * unit, unit);
    canvas.dataset.index = String(me.cross[k]);
  }

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {Side} side
   * @param {PointerEvent} e
   * @returns {Pair}
   */
  const under = (canvas, side, e) => {
    const box = canvas.getBoundingClientRect();
    const size = me.block ? extent(me.block) : [1, 1, 1];
    const [i, j] = AXES[side];
    return [
      ((e.clientX - box.left) / box.width) * size[i] - 0.5,
      (1 - (e.clientY - box.top) / box.height) * size[j] - 0.5,
    ];
  };
  /** @type {Record<string, number | undefined>} */
  const STEPS = {
    ArrowUp: 1,
    ArrowRight: 1,
    ArrowDown: -1,
    ArrowLeft: -1,
    PageUp: 10,
    PageDown: -10,
    Home: -1e6,
    End: 1e6,
  };
  for (const side of SIDES) {
    const canvas = canvases[side];
    const k = AXES[side][2];
    /** @param {number} step */
    const through = (step) => {
      /** @type {Vector} */
      const to = [...me.cross];
      to[k] += step;
      me.go(to);
    };
    canvas.addEventListener(
      "wheel",
      (e) => {
        if (!me.block || e.ctrlKey) return;
        e.preventDefault();
        through(-Math.sign(e.deltaY));
      },
      { passive: false },
    );
    canvas.addEventListener("keydown", (e) => {
      const step = STEPS[e.key];
      if (me.block && step && !e.ctrlKey && !e.altKey) {
        e.preventDefault();
        e.stopPropagation();
        through(step);
      }
    });
    canvas.addEventListener("pointerdown", (e) => {
      if (!me.block) return;
      canvas.setPointerCapture(e.pointerId);
      if (me.profiling)
        line = { side, from: under(canvas, side, e), to: under(canvas, side, e) };
      else me.go(place(side, under(canvas, side, e)));
    });
    canvas.addEventListener("pointermove", (e) => {
      const at = under(canvas, side, e);
      pointed(me.block ? place(side, at) : null);
      if (!me.block || !canvas.hasPointerCapture(e.pointerId)) return;
      if (me.profiling && line) {
        line.to = at;
        me.draw();
        moved();
      } else if (!me.profiling) me.go(place(side, at));
    });
    canvas.addEventListener("pointerleave", (e) => {
      if (e.pointerType !== "touch") pointed(null); // what a finger read stays
    });
    new ResizeObserver(() => me.draw()).observe(canvas);
  }
  return me;
}
