// A volume in three dimensions: rays through a 3D texture (WebGL 2), as a shaded surface or as
// the greatest value on each ray, with a part cut away at the slices' cross. Projection is
// orthographic, so that the scale bar holds everywhere. Stands alone, as slices.ts does.
import { bar, codeOf, drawBar, extent } from "./slices.js";
/** @import { Block, Pair, Vector } from "../web/viewer.d.ts" */

const BRICK = 8;
const SLOW_MS = 90;
export const ROOM = 1.75; // rays see so many times the box's longest side
const VERTEX =
  "#version 300 es\nin vec2 a; out vec2 at; void main() { at = a; gl_Position = vec4(a, 0., 1.); }";
// Bricks whose greatest value is too low are left out: those are most of the rays' way. `near`
// is where a ray enters the box, on a cut face as grey values. Steps are of a voxel; a surface
// is found between two of them.
const FRAGMENT = `#version 300 es
precision highp float; precision highp sampler3D;
uniform sampler3D whole, bricks, other, otherBricks;
uniform float split, level;
uniform vec3 side, count, grid, low, high, right, up, ahead;
uniform vec2 room, grey;
uniform int cut, most;
in vec2 at;
out vec4 color;
bool beside() { return at.x > split; }
float value(vec3 p) { return beside() ? texture(other, p).r : texture(whole, p).r; }
float most_of(vec3 p) {
  ivec3 q = min(ivec3(p * grid), textureSize(bricks, 0) - 1);
  return beside() ? texelFetch(otherBricks, q, 0).r : texelFetch(bricks, q, 0).r;
}
float between(vec3 p, vec3 h) { return value(p + h) - value(p - h); }
void main() {
  vec3 from = (right * at.x * room.x + up * at.y * room.y - 2. * ahead) / side + .5;
  vec3 way = ahead / side;
  vec3 one = 1. / (way + vec3(equal(way, vec3(0.))) * 1e-9);
  vec3 a = (low - from) * one, b = (high - from) * one;
  vec3 first = min(a, b), last = max(a, b), each = count * abs(way);
  float near = max(max(first.x, first.y), first.z);
  float far = min(min(last.x, last.y), last.z);
  float step = .8 / max(max(each.x, each.y), each.z);
  float d = near + 1e-5, found = 0., before = 0.;
  color = vec4(0.);
  if (near >= far) return;
  bool face = cut >= 0 && first[cut] >= near - 1e-6;
  if (face) {
    float v = value(from + way * d);
    if (v >= level && most == 0) {
      float shade = clamp((v - grey.x) * grey.y, .06, 1.);
      color = vec4(shade * vec3(1., .96, .9), 1.);
      return;
    }
  }
  for (int i = 0; i < 1500 && d < far; i++) {
    vec3 p = from + way * d;
    if (most_of(p) < (most == 1 ? max(found, 1e-3) : level)) {
      vec3 e = ((floor(p * grid) + vec3(greaterThan(way, vec3(0.)))) / grid - p) * one;
      d += max(min(min(e.x, e.y), e.z), 0.) + step * .2;
      before = 0.;
      continue;
    }
    float v = value(p);
    if (most == 1) found = max(found, v);
    else if (v >= level) {
      if (before > 0. && v > before) p -= way * step * (v - level) / (v - before);
      vec3 h = 1.2 / count, x = vec3(h.x, 0., 0.), y = vec3(0., h.y, 0.), z = vec3(0., 0., h.z);
      vec3 n = vec3(between(p, x), between(p, y), between(p, z));
      n = -n / (length(n) + 1e-6);
      float light = max(dot(n, normalize(-ahead + .5 * up - .3 * right)), 0.);
      vec3 paint = beside() ? vec3(.9, .86, .78) : vec3(.27, .75, 1.); // the scan as in the scene
      color = vec4(paint * (.22 + .78 * light) + .25 * pow(light, 24.), 1.);
      return;
    }
    before = v;
    d += step;
  }
  if (most == 1) color = vec4(vec3(clamp((found - grey.x) * grey.y, 0., 1.)), 1.);
}`;

/**
 * @typedef {object} Ray
 * @property {number} yaw
 * @property {number} pitch
 * @property {number} zoom
 * @property {number} level
 * @property {boolean} most
 * @property {number} cut
 * @property {number} ms
 * @property {boolean} software
 * @property {number} split Another volume of the same shape, right of a part of the width;
 *   none: the first alone.
 * @property {(block: Block | null) => void} beside
 * @property {(block: Block | null) => void} show
 * @property {(window: Pair) => void} window
 * @property {(place: Vector) => void} cross
 * @property {() => void} draw
 */

const NO_WEBGL =
  "This browser has no WebGL 2, so the volume is not drawn in three dimensions. Slices, " +
  "histogram, profile and sharing work as usual.";
const NO_PROGRAM =
  "This browser's graphics refused to draw the volume in three dimensions, twice. Slices, " +
  "histogram, profile and sharing work as usual; reloading the page tries again.";
const LOST = [
  "The browser's graphics stopped;",
  "the volume comes back with them.",
  "Slices work as usual.",
];
const REFUSED = [
  "The browser's graphics refuse",
  "to draw the volume; reload the page.",
  "Slices work as usual.",
];
/** @type {WebGLContextAttributes} */
const GLASS = {
  antialias: false,
  alpha: true,
  premultipliedAlpha: false,
  preserveDrawingBuffer: true,
};
const TRIES = 2;

/**
 * @typedef {object} Glass
 * @property {HTMLCanvasElement} glass
 * @property {WebGL2RenderingContext} gl
 * @property {WebGLProgram | null} program
 */

/**
 * The program in use, with the triangle that it draws; null where the graphics refuse it.
 * @param {WebGL2RenderingContext} gl
 * @returns {WebGLProgram | null}
 */
function programmed(gl) {
  const program = gl.createProgram();
  for (const [kind, source] of /** @type {const} */ ([
    [gl.VERTEX_SHADER, VERTEX],
    [gl.FRAGMENT_SHADER, FRAGMENT],
  ])) {
    const shader = gl.createShader(kind);
    if (!shader) return null;
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return null;
  gl.useProgram(program);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 3, -1, -1, 3]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.bindAttribLocation(program, 0, "a");
  gl.vertexAttribPointer(gl.getAttribLocation(program, "a"), 2, gl.FLOAT, false, 0, 0);
  ["whole", "bricks", "other", "otherBricks"].forEach((name, unit) => {
    gl.uniform1i(gl.getUniformLocation(program, name), unit);
  });
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  return program;
}

/**
 * A canvas of its own that draws, or a sentence of why there is none. What refuses the program
 * once is tried again on a fresh canvas; a lost context comes back by itself.
 * @returns {Glass | string}
 */
function glassThatDraws() {
  for (let left = TRIES; left > 0; left--) {
    const glass = document.createElement("canvas");
    const gl = glass.getContext("webgl2", GLASS);
    if (!gl) return NO_WEBGL;
    const program = programmed(gl);
    if (program || gl.isContextLost()) return { glass, gl, program };
  }
  return NO_PROGRAM;
}

/**
 * Means over cubes of f codes a side, as bytes: 1 to 255 from `low` to `high`, 0 without data.
 * @param {Uint16Array} codes
 * @param {Vector} size
 * @param {Vector} n
 * @param {number} f
 * @param {number} low
 * @param {number} high
 * @returns {Uint8Array}
 */
function means(codes, size, n, f, low, high) {
  const data = new Uint8Array(n[0] * n[1] * n[2]);
  const scale = 254 / (high - low);
  for (let z = 0, o = 0; z < n[2]; z++)
    for (let y = 0; y < n[1]; y++)
      for (let x = 0; x < n[0]; x++, o++) {
        let sum = 0;
        let known = 0;
        for (let c = 0; c < f; c++)
          for (let r = 0; r < f; r++) {
            const from = ((z * f + c) * size[1] + y * f + r) * size[0] + x * f;
            for (let at = from; at < from + f; at++) {
              sum += codes[at];
              if (codes[at]) known++;
            }
          }
        if (known) data[o] = 1 + Math.min(254, Math.max(0, scale * (sum / known - low)));
      }
  return data;
}

/**
 * The greatest byte of each brick; what lies at its edge is seen from the next one, too.
 * @param {Uint8Array} data
 * @param {Vector} n
 * @param {Vector} grid
 * @returns {Uint8Array}
 */
function greatest(data, n, grid) {
  const bricks = new Uint8Array(grid[0] * grid[1] * grid[2]);
  const [x, y, z] = n.map((count, axis) => bricksOf(count, grid[axis]));
  for (let k = 0, o = 0; k < n[2]; k++)
    for (let j = 0; j < n[1]; j++)
      for (let i = 0; i < n[0]; i++, o++) {
        const v = data[o];
        if (!v) continue;
        for (let c = z.first[k]; c <= z.last[k]; c++)
          for (let b = y.first[j]; b <= y.last[j]; b++)
            for (let a = x.first[i]; a <= x.last[i]; a++) {
              const at = (c * grid[1] + b) * grid[0] + a;
              if (v > bricks[at]) bricks[at] = v;
            }
      }
  return bricks;
}

/**
 * The bricks from which each voxel of an axis is seen.
 * @param {number} voxels
 * @param {number} bricks
 * @returns {{ first: Uint8Array; last: Uint8Array }}
 */
function bricksOf(voxels, bricks) {
  const first = new Uint8Array(voxels);
  const last = new Uint8Array(voxels);
  for (let at = 0; at < voxels; at++) {
    first[at] = Math.max(0, Math.floor((at - 1) / BRICK));
    last[at] = Math.min(bricks - 1, Math.floor((at + 1) / BRICK));
  }
  return { first, last };
}

/**
 * @param {HTMLCanvasElement} canvas
 * @returns {Ray | string}
 */
export function raycast(canvas, side = 0) {
  const found = glassThatDraws();
  if (typeof found === "string") return found;
  const { glass, gl } = found;
  let { program } = found;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const software = /swiftshader|llvmpipe|software/i.test(
    String(info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : ""),
  );
  const largest = side || (software ? 128 : 256);
  /** @param {string} name */
  const place = (name) => (program ? gl.getUniformLocation(program, name) : null);

  /**
   * @param {number} unit
   * @param {Vector} shape
   * @param {Uint8Array} data
   * @param {number} filter
   */
  function texture(unit, [nx, ny, nz], data, filter) {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.deleteTexture(held[unit]);
    gl.bindTexture(gl.TEXTURE_3D, (held[unit] = gl.createTexture()));
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R])
      gl.texParameteri(gl.TEXTURE_3D, name, gl.CLAMP_TO_EDGE);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_3D, name, filter);
    gl.texImage3D(gl.TEXTURE_3D, 0, gl.R8, nx, ny, nz, 0, gl.RED, gl.UNSIGNED_BYTE, data);
  }
  const one = new Uint8Array(4);
  /** @type {Array<WebGLTexture | null>} */
  const held = [null, null, null, null];
  /** @type {Block | null} */
  let block = null;
  /** @type {Block | null} */
  let twin = null;
  let due = false;
  /** @type {Pair} */
  let seen = [0, 1];
  /** @type {Vector} */
  let spot = [0, 0, 0];
  let scale = 1;
  /** @type {number | undefined} */
  let resting;
  let held_down = false;
  /** @type {Ray} */
  const me = {
    yaw: 0.5,
    pitch: 0.4,
    zoom: 1,
    level: 0.5,
    most: false,
    cut: -1,
    ms: 0,
    software,
    split: 1,
    /**
     * 8 bits between the ends of the block's window, and half as much again beyond; the rest of
     * the work is the shader's.
     */
    show(b) {
      block = b;
      if (!b) return;
      fill(b, ends(b), 0);
      me.draw();
    },
    beside(b) {
      twin = b;
      if (b && block) fill(b, ends(block), 2);
      me.draw();
    },
    window(window) {
      seen = window;
      me.draw();
    },
    cross(at) {
      spot = at;
      if (me.cut >= 0) me.draw();
    },
    draw() {
      if (!due) {
        due = true;
        requestAnimationFrame(() => {
          due = false;
          paint();
        });
      }
    },
  };

  /**
   * @param {Block} b
   * @param {Pair} range
   * @param {number} unit
   */
  function fill(b, range, unit) {
    if (!program || gl.isContextLost()) return;
    const size = extent(b);
    const f = Math.max(1, Math.ceil(Math.max(...size) / largest));
    const n = /** @type {Vector} */ (size.map((v) => Math.max(1, Math.floor(v / f))));
    const grid = /** @type {Vector} */ (n.map((v) => Math.ceil(v / BRICK)));
    const data = means(b.codes, size, n, f, codeOf(b, range[0]), codeOf(b, range[1]));
    const bricks = greatest(data, n, grid);
    texture(unit, n, data, gl.LINEAR);
    texture(unit + 1, grid, bricks, gl.NEAREST);
    gl.uniform3fv(place("count"), n);
    gl.uniform3fv(
      place("grid"),
      n.map((v) => v / BRICK),
    );
  }

  /**
   * @param {Block} b
   * @returns {Pair}
   */
  const ends = (b) => [b.window[0], b.window[1] + 0.5 * (b.window[1] - b.window[0])];
  /** @returns {[Vector, Vector, Vector]} */
  const axes = () => {
    const [c, s, p, q] = [
      Math.cos(me.yaw),
      Math.sin(me.yaw),
      Math.cos(me.pitch),
      Math.sin(me.pitch),
    ];
    return [
      [c, s, 0],
      [-s * q, c * q, p],
      [-s * p, c * p, -q],
    ]; // right, up, ahead
  };

  /**
   * @param {CanvasRenderingContext2D} x
   * @param {number} w
   * @param {number} h
   * @param {number} unit
   */
  function lost(x, w, h, unit) {
    x.fillStyle = "#0b0e13";
    x.fillRect(0, 0, w, h);
    x.fillStyle = "#8fc8ff";
    x.font = `${13 * unit}px system-ui, sans-serif`;
    x.textAlign = "center";
    const says = gl.isContextLost() ? LOST : REFUSED;
    says.forEach((line, k) => {
      x.fillText(line, w / 2, h / 2 + 20 * unit * (k - 1), 0.95 * w);
    });
    canvas.title = says.join(" ");
  }
  function restored() {
    program = programmed(gl) ?? programmed(gl);
    held.fill(null);
    canvas.title = "";
    me.beside(twin);
    me.show(block);
  }
  glass.addEventListener("webglcontextlost", (e) => {
    e.preventDefault();
    me.draw();
  });
  glass.addEventListener("webglcontextrestored", restored);
  function paint() {
    const b = block;
    const x = canvas.getContext("2d");
    if (!b || !x || !canvas.clientWidth) return;
    const unit = Math.min(devicePixelRatio, 2);
    const w = Math.round(canvas.clientWidth * unit);
    const h = Math.round(canvas.clientHeight * unit);
    if (canvas.width !== w || canvas.height !== h) {
      canvas.width = w;
      canvas.height = h;
    }
    if (!program || gl.isContextLost()) {
      lost(x, w, h, unit);
      return;
    }
    const begun = performance.now();
    const size = extent(b);
    const most = Math.max(...size);
    const box = /** @type {Vector} */ (size.map((v) => v / most));
    const [right, up, ahead] = axes();
    glass.width = Math.max(1, Math.round(w * scale));
    glass.height = Math.max(1, Math.round(h * scale));
    gl.viewport(0, 0, glass.width, glass.height);
    const reach = ROOM / 2 / me.zoom;
    /** @type {Pair} */
    const room = w > h ? [(reach * w) / h, reach] : [reach, (reach * h) / w];
    const span = 254 / 255;
    const [lo, hi] = ends(b);
    const low = [0, 0, 0];
    const high = [1, 1, 1];
    /** @param {number} v */
    const tone = (v) => 1 / 255 + (span * (v - lo)) / (hi - lo);
    if (me.cut >= 0)
      (ahead[me.cut] > 0 ? low : high)[me.cut] = (spot[me.cut] + 0.5) / size[me.cut];
    for (const [name, v] of Object.entries({ side: box, low, high, right, up, ahead }))
      gl.uniform3fv(place(name), v);
    gl.uniform2fv(place("room"), room);
    gl.uniform2f(
      place("grey"),
      tone(seen[0]),
      1 / Math.max(1e-6, tone(seen[1]) - tone(seen[0])),
    );
    gl.uniform1f(place("split"), twin ? 2 * me.split - 1 : 2);
    gl.uniform1i(place("other"), twin ? 2 : 0);
    gl.uniform1i(place("otherBricks"), twin ? 3 : 1);
    gl.uniform1f(place("level"), Math.max(tone(me.level), 2 / 255));
    gl.uniform1i(place("cut"), me.cut);
    gl.uniform1i(place("most"), me.most ? 1 : 0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    // waits, so that what it takes is known
    if (software) gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, one);
    x.fillStyle = "#0b0e13";
    x.fillRect(0, 0, w, h);
    x.imageSmoothingEnabled = true;
    x.drawImage(glass, 0, 0, w, h);
    if (twin) {
      x.fillStyle = "#36e28f";
      x.fillRect(me.split * w - unit / 2, 0, unit, h);
    }
    // The box, its axes' names, the scale.
    /**
     * @param {Vector} v
     * @returns {Pair}
     */
    const at = (v) => {
      const p = v.map((q, k) => (q - 0.5) * box[k]);
      /** @param {Vector} a */
      const dot = (a) => p[0] * a[0] + p[1] * a[1] + p[2] * a[2];
      return [(w / 2) * (1 + dot(right) / room[0]), (h / 2) * (1 - dot(up) / room[1])];
    };
    x.lineWidth = unit;
    x.font = `${12 * unit}px system-ui, sans-serif`;
    x.textAlign = "center";
    x.textBaseline = "middle";
    for (const k of [0, 1, 2])
      for (const corner of [0, 1, 2, 3]) {
        /** @type {Vector} */
        const from = [0, 0, 0];
        /** @type {Vector} */
        const to = [0, 0, 0];
        const [i, j] = [(k + 1) % 3, (k + 2) % 3];
        from[i] = to[i] = corner & 1;
        from[j] = to[j] = corner >> 1;
        to[k] = 1;
        const [p, q] = [at(from), at(to)];
        x.strokeStyle = corner ? "#5ab0ff40" : "#5ab0ff";
        x.beginPath();
        x.moveTo(...p);
        x.lineTo(...q);
        x.stroke();
        if (!corner) {
          x.fillStyle = "#8fc8ff";
          x.fillText(
            "xyz"[k],
            q[0] + 8 * unit * Math.sign(q[0] - p[0] || 1),
            q[1] + 8 * unit * Math.sign(q[1] - p[1]),
          );
        }
      }
    const px = w / (2 * room[0] * most * b.voxel_mm);
    const mm = bar(w / px);
    drawBar(x, mm, mm * px, unit);
    me.ms = performance.now() - begun;
    // Coarser while it is turned on a slow machine, whole again at rest.
    if (held_down && me.ms > SLOW_MS && scale > 0.3) scale *= 0.7;
    clearTimeout(resting);
    if (scale < 1)
      resting = window.setTimeout(() => {
        if (!held_down) {
          scale = 1;
          me.draw();
        }
      }, 250);
  }

  /**
   * @param {number} yaw
   * @param {number} pitch
   */
  const turn = (yaw, pitch) => {
    me.yaw += yaw;
    me.pitch = Math.min(1.55, Math.max(-1.55, me.pitch + pitch));
    me.draw();
  };
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    held_down = true;
  });
  canvas.addEventListener("pointermove", (e) => {
    if (canvas.hasPointerCapture(e.pointerId)) turn(-e.movementX / 120, e.movementY / 120);
  });
  for (const end of ["pointerup", "pointercancel"])
    canvas.addEventListener(end, () => {
      held_down = false;
      me.draw();
    });
  canvas.addEventListener(
    "wheel",
    (e) => {
      if (e.ctrlKey) return;
      e.preventDefault();
      me.zoom = Math.min(8, Math.max(0.5, me.zoom * Math.exp(-e.deltaY / 500)));
      me.draw();
    },
    { passive: false },
  );
  /** @type {Record<string, Pair | undefined>} */
  const STEPS = {
    ArrowLeft: [0.1, 0],
    ArrowRight: [-0.1, 0],
    ArrowUp: [0, 0.1],
    ArrowDown: [0, -0.1],
  };
  canvas.addEventListener("keydown", (e) => {
    const step = STEPS[e.key];
    const times = { "+": 1.25, "=": 1.25, "-": 0.8 }[e.key];
    if (e.ctrlKey || e.altKey || (!step && !times)) return;
    e.preventDefault();
    e.stopPropagation();
    if (step) turn(...step);
    else {
      me.zoom *= times ?? 1;
      me.draw();
    }
  });
  new ResizeObserver(() => me.draw()).observe(canvas);
  return me;
}
