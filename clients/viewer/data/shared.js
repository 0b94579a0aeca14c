// The view of a volume as one HTML file that opens without a server: the same slices and
// camera, axes and scale, the radiograph and the values.
import { $, base64, bytes, downloadBlob, fixed } from "./dom.js";
import { emit } from "./link.js";
import { extent, index } from "./slices.js";
import { picture } from "./film.js";
/**
 * @import { Block, VolumeMessage } from "../web/viewer.d.ts"
 * @import { Slices } from "./slices.js"
 * @import { Ray } from "./raycast.js"
 */

const MOST_VOXELS = 1_650_000; // two bytes each, four thirds of that as text: 4.4 MB at most
/** @param {string} text */
const safe = (text) => text.replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);

/**
 * Means over cubes, with no more voxels than a file has room for.
 * @param {Block} b
 * @returns {Block}
 */
export function coarser(b, most = MOST_VOXELS) {
  const size = extent(b);
  let f = 1;
  while (size.reduce((n, v) => n * Math.floor(v / f), 1) > most) f++;
  const [nx, ny, nz] = size.map((v) => Math.floor(v / f));
  const codes = new Uint16Array(nx * ny * nz);
  for (let z = 0, o = 0; z < nz; z++)
    for (let y = 0; y < ny; y++)
      for (let x = 0; x < nx; x++, o++) {
        let sum = 0;
        let known = 0;
        for (let c = 0; c < f; c++)
          for (let r = 0; r < f; r++)
            for (let k = 0; k < f; k++) {
              const v = b.codes[index(b, [x * f + k, y * f + r, z * f + c])];
              if (v) {
                sum += v;
                known++;
              }
            }
        codes[o] = known ? Math.round(sum / known) : 0;
      }
  return { ...b, shape: [nz, ny, nx], codes, factor: b.factor * f, voxel_mm: b.voxel_mm * f };
}
const STYLE = `
body { font: 14px/1.5 system-ui, sans-serif; margin: 20px auto; max-width: 1100px; }
body { padding: 0 16px; color: #17202c; background: #fff; }
.grid { display: grid; grid-template-columns: repeat(auto-fit, minmax(280px, 1fr)); gap: 12px; }
figure { margin: 0; }
canvas, img { width: 100%; display: block; background: #0b0e13; border-radius: 4px; }
#ray { aspect-ratio: 1; }
figcaption { color: #5f6b79; font-size: 12px; }
table { border-collapse: collapse; }
:is(td, th) { padding: 1px 12px 1px 0; text-align: left; font-weight: 400; }
`;
const START = `
const get = (id) => document.getElementById(id);
const told = JSON.parse(get("told").textContent);
const raw = Uint8Array.from(atob(told.codes), (c) => c.charCodeAt(0));
const block = { ...told.block, codes: new Uint16Array(raw.buffer) };
const value = (code) =>
  code ? valueOf(block, code).toFixed(5) + " per mm" : "no data cover this voxel";
const point = (at) => {
  get("at").textContent = at ? value(block.codes[index(block, at)]) : "point at a slice";
};
const sides = { top: get("top"), front: get("front"), side: get("side") };
const three = slices(sides, point, () => { if (solid) solid.cross(three.cross); });
const made = raycast(get("ray"));
const solid = typeof made === "string" ? null : made;
three.show(block, told.window);
three.go(told.cross);
if (solid) {
  Object.assign(solid, told.camera);
  solid.show(block);
  solid.window(told.window);
  solid.cross(three.cross);
} else get("ray").replaceWith(made);
`;
const HEAD = `<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width">`;
// Id of a canvas -> what it shows.
const CAPTIONS = {
  ray: "all of it: drag turns, wheel zooms; axes x, y and z of the object, bar in mm",
  top: "from above (x to the right, y up)",
  front: "from the source (x to the right, z up)",
  side: "from the side (y to the right, z up)",
};
const FILM = "radiograph, as windowed when this was shared";

/**
 * @param {Slices} three
 * @param {Ray | null} solid
 * @param {VolumeMessage} m
 */
export async function shared(three, solid, m) {
  if (!three.block) return;
  const block = coarser(three.block);
  const { codes, ...head } = block;
  const scale = (block.voxel_mm || 1) / three.block.voxel_mm;
  const when = m.started || new Date().toISOString().slice(0, 16).replace("T", " ");
  const title = `${m.sample || m.name} · ${when} · flexdt`;
  const camera = solid && {
    yaw: solid.yaw,
    pitch: solid.pitch,
    zoom: solid.zoom,
    level: solid.level,
    most: solid.most,
    cut: solid.cut,
  };
  const told = {
    block: head,
    codes: base64(codes.buffer),
    window: three.window,
    cross: three.cross.map((v) => Math.floor(v / scale)),
    camera,
  };
  const programs = await Promise.all(
    ["slices.js", "raycast.js"].map((file) => fetch(file).then((r) => r.text())),
  );
  const program = programs
    .join("\n")
    .replace(/^import .*$/gm, "")
    .replace(/^export /gm, "");
  const film = picture();

  /**
   * @param {number[]} count
   * @param {number} mm
   */
  const voxels = (count, mm) => `${count.join(" × ")} voxels of ${fixed(1000 * mm, 1)} µm`;
  const binning = m.binning ? `; flexdt reconstruct --binning ${m.binning}` : "";
  /** @type {Array<[string, string]>} */
  const rows = [
    ["data set", m.name],
    ["sample", m.sample || "not known"],
    ["scanned", when],
    ["views", `${m.views ?? "–"} of ${m.of ?? "–"}`],
    ["voltage", m.kV ? `${fixed(m.kV, 0)} kV` : "not known"],
    ["geometry", m.geometry ?? "as scanned"],
    ["volume", `${voxels(m.size ?? [], m.voxel_mm ?? 0)} along x, y, z${binning}`],
    ["here", voxels(extent(block), block.voxel_mm)],
    ["window", `${fixed(three.window[0], 5)} to ${fixed(three.window[1], 5)} per mm`],
    ["without data", `${fixed(100 * (m.uncovered ?? 0), 2)} % of the voxels, grey`],
  ];
  const figures = Object.entries(CAPTIONS).map(
    ([id, words]) =>
      `<figure><figcaption>${words}</figcaption>` +
      `<canvas id="${id}" tabindex="0" role="img" aria-label="${words}"></canvas></figure>`,
  );
  const radiograph = film
    ? `<figure><figcaption>${FILM}</figcaption><img alt="radiograph" src="${film}"></figure>`
    : "";
  const lines = rows.map(([name, text]) => `<tr><th>${name}</th><td>${safe(text)}</td></tr>`);
  const html = `${HEAD}<title>${safe(title)}</title><style>${STYLE}</style></head><body>
<h1>${safe(title)}</h1>
<div class="grid">${figures.join("")}
${radiograph}</div><p id="at">point at a slice</p>
<table>${lines.join("")}</table>${$("#volume-compared").innerHTML}
<script type="application/json" id="told">${JSON.stringify(told)}</script>
<script type="module">${program}\n${START}</script></body></html>`;
  const blob = new Blob([html], { type: "text/html" });

  /**
   * @param {string} text
   * @param {RegExp} apart
   */
  const bare = (text, apart) => text.replace(apart, "-");
  const made = `${bare(m.sample || m.name, /[^\w-]+/g)}-${bare(when, /\D+/g)}`;
  const name = `flexdt-${made}.html`;
  downloadBlob(blob, name);
  emit("note", "good", name, bytes(blob.size));
}
