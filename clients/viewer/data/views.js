// The views: one frame of viser each; the beam's eye is cropped to exactly the detector's image.
import { $, $$, el } from "./dom.js";
import { call, emit, on, pageId, store } from "./link.js";
import { remember } from "./address.js";
import { meet } from "./said.js";
/** @import { Four, View } from "../web/viewer.d.ts" */

/** @type {Record<View, string>} */
const NAMES = {
  iso: "Isometric",
  beam: "Beam’s eye",
  side: "Side",
  free: "Free",
};

/** @typedef {View | "four" | "none"} Layout */

/**
 * @typedef {object} Frame
 * @property {HTMLElement} box
 * @property {HTMLIFrameElement} iframe
 * @property {HTMLElement} [crop]
 * @property {HTMLElement} tag
 * @property {string} src
 * @property {HTMLImageElement} [sample]
 */

/** @type {Map<View, Frame>} */
const open = new Map();
$("#view-switch").append(
  ...Object.entries({ four: "Four views", ...NAMES }).map(([name, words]) =>
    el("button", { "data-layout": name, onclick: () => layout(name, true) }, words),
  ),
);
/** @type {Layout | null} */
export let current = null;

// Without a graphics processor every picture costs processor time that the radiograph needs more.
const query = new URLSearchParams(location.search);
export let webgl = true;
export const software = (() => {
  const gl = document.createElement("canvas").getContext("webgl");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = gl && info ? String(gl.getParameter(info.UNMASKED_RENDERER_WEBGL)) : "";
  webgl = Boolean(gl);
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return !gl || /swiftshader|llvmpipe|software|basic render/i.test(name);
})();
// With one the scenes have shadows and an environment that shines in metal; `?light=fine` or
// `plain` says otherwise.
export const fine = query.has("light") ? query.get("light") === "fine" : !software;
const GAP_MS = Number(query.get("gap") ?? (software ? 400 : 0));
const DPR = query.get("dpr") ?? (devicePixelRatio > 1.5 && !software ? "" : "1");

/**
 * The preset from the start, so that nothing jumps when the viewer sets it again. The beam's
 * eye has none: it moves with the machine.
 * @param {View} view
 * @param {HTMLElement} box
 * @returns {Promise<string>}
 */
async function preset(view, box) {
  if (view === "beam") return "";
  const aspect = Math.min(20, Math.max(0.05, box.clientWidth / Math.max(1, box.clientHeight)));
  const camera = await call("viewer.preset", { view, aspect }).catch(() => null);
  if (!camera?.position || !camera.look_at || !camera.fov) return "";
  const { position, look_at, fov } = camera;
  const from = `initialCameraPosition=${position.join()}`;
  return `${from}&initialCameraLookAt=${look_at.join()}&initialCameraFov=${fov}&`;
}

/**
 * @param {Frame} frame
 * @param {View} view
 */
async function start({ box, iframe, src }, view) {
  const found = await preset(view, box);
  if (open.get(view)?.iframe === iframe && !iframe.src)
    iframe.src = src.replace("?", `?${found}`);
}

/**
 * @param {View} view
 * @returns {Frame}
 */
function frame(view) {
  const src = `scene/${pageId}/${view}?${DPR ? `fixedDpr=${DPR}&` : ""}gap=${GAP_MS}`;
  const iframe = el("iframe", { title: NAMES[view] });
  iframe.addEventListener("load", () => {
    if (iframe.contentWindow) emit("frame", iframe.contentWindow);
  }); // keys.js listens in it, too
  const tag = el("span", { class: "tag" }, NAMES[view]);
  const box = el("div", { class: "view", "data-view": view });
  if (view === "beam") {
    const crop = el("div", { class: "crop" }, iframe, el("div", { class: "shield" }));
    box.append(crop, tag);
    return { box, iframe, crop, tag, src };
  }
  const home = el(
    "button",
    {
      class: "home",
      title: "Back to this view's preset",
      onclick: () => {
        box.classList.remove("near");
        tellCovered();
        return call("viewer.camera", { view });
      },
    },
    "⌂",
  );
  const near = { title: "Look at the sample (Alt+0)", onclick: () => closer(view) };
  box.append(iframe, tag, home, el("button", { class: "look", ...near }, "◎"));
  const sample = el("img", { alt: "" });
  sample.addEventListener("error", () => {
    sample.hidden = true;
    posed = ""; // a busy viewer has none: it is asked again
  });
  const inset = el("button", { class: "inset", "aria-label": "Look at the sample", ...near });
  sample.addEventListener("load", () => {
    if (sample.hidden) tellCovered();
    sample.hidden = false;
    inset.dataset.sample = sample.dataset.of; // its name, of what the picture shows
  });
  inset.append(sample);
  box.append(inset);
  return { box, iframe, tag, src, sample };
}

/**
 * Where the camera is near the sample, its own picture is not needed.
 * @param {View} view
 */
function closer(view) {
  open.get(view)?.box.classList.add("near");
  tellCovered();
  return call("viewer.camera", { view, sample: true }).catch(() => {});
}

/** What lies over each view's picture, for its viewer: no name is put there. */
function tellCovered() {
  requestAnimationFrame(() => {
    for (const [view, { box }] of open) {
      const at = box.getBoundingClientRect();
      const own = box.querySelectorAll(":scope > .tag, :scope > button");
      const over = [...own, ...$$("#said :is(.warning, .note)")]
        .filter((node) => getComputedStyle(node).visibility === "visible")
        .map((node) => node.getBoundingClientRect())
        .filter((o) => meet([o.left, o.top, o.right, o.bottom], at));
      /** @type {Four[]} */
      const boxes = over.map((o) => [
        o.left - at.left,
        o.top - at.top,
        o.right - at.left,
        o.bottom - at.top,
      ]);
      const told = JSON.stringify(boxes);
      if (box.isConnected && box.dataset.covered !== told) {
        box.dataset.covered = told;
        call("viewer.covered", { view, boxes }).catch(() => delete box.dataset.covered);
      }
    }
  });
}
on("said", tellCovered);
const resized = new ResizeObserver(tellCovered);
on("open", () => {
  for (const { box } of open.values()) delete box.dataset.covered; // a viewer that is new
  tellCovered();
});
export function nearSample() {
  for (const view of open.keys()) if (view !== "beam") void closer(view);
}

// What the viewer computes: the view until its frame has drawn the machine, and the sample,
// large, beside it.
/** @type {HTMLImageElement} */
const still = $("#still");
const CLOSE_UP_MS = 1000;
const STILL_AGAIN_MS = 1000;
let live = false;
/** A busy server answers late with no picture: ask again until a frame has drawn the scene. */
function missing() {
  still.hidden = true;
  setTimeout(() => {
    if (!live) window.still(still, window.firstView, $("#views"));
  }, STILL_AGAIN_MS);
}
still.addEventListener("error", missing);
still.addEventListener("load", () => {
  still.hidden = live;
});
if (still.complete && !still.naturalWidth) missing();
window.addEventListener("message", (e) => {
  for (const { box, iframe } of open.values()) {
    if (e.source !== iframe.contentWindow || e.data !== "drawn") continue;
    box.classList.add("live");
    live = true;
    still.hidden = true;
  }
});
// The close cameras have gone home: there is nothing to look at.
on("state", (s) => {
  if (!s.sample.name) for (const { box } of open.values()) box.classList.remove("near");
});
let posed = "";
let seenAt = -Infinity;
on("state", (s) => {
  const now = JSON.stringify([
    s.sample,
    s.correction,
    store.layers,
    store.opacity,
    Object.values(s.axes).map((a) => a.position.toFixed(1)),
    document.documentElement.dataset.theme,
  ]);
  if (now === posed || performance.now() < seenAt + CLOSE_UP_MS) return;
  // The viewer computes each picture: one that is on its way is waited for.
  for (const { sample } of open.values()) if (sample && !sample.complete) return;
  posed = now;
  seenAt = performance.now();
  closeUps();
});

/** The sample in each pane, close up: what holds source and detector shows it small. */
function closeUps() {
  for (const { sample } of open.values()) {
    if (!sample?.parentElement) continue;
    sample.dataset.of = store.state?.sample.name ?? "";
    window.still(sample, "sample", sample.parentElement);
  }
}

/** Without WebGL there are no scenes; all the rest works. */
function bare() {
  document.body.dataset.webgl = "none";
  live = true;
  still.hidden = true;
  $("#views").replaceChildren(
    el(
      "p",
      { class: "bare muted" },
      "This browser draws no 3-D pictures (WebGL is off). Radiograph, axes and scans work without.",
    ),
  );
  for (const button of /** @type {HTMLButtonElement[]} */ ($$("#view-switch button")))
    button.disabled = true;
}

/** @param {string} asked */
export function layout(asked, step = false) {
  const which = /** @type {Layout} */ (asked);
  if (which === current) return;
  remember({ view: which }, step);
  current = which;
  if (!webgl) {
    bare();
    return;
  }
  /** @type {View[]} */
  const wanted =
    which === "none" ? [] : which === "four" ? ["iso", "beam", "side", "free"] : [which];
  const views = $("#views");
  if (
    views.childElementCount &&
    wanted.length === 1 &&
    which !== "beam" &&
    !open.has(wanted[0])
  ) {
    still.hidden = false;
    window.still(still, which, views);
  } else if (wanted.length !== 1 || which === "beam") still.hidden = true;
  views.dataset.layout = which;
  for (const [view, parts] of open)
    if (!wanted.includes(view)) {
      parts.box.remove();
      open.delete(view);
    }
  for (const view of wanted) {
    const parts = open.get(view) ?? frame(view);
    open.set(view, parts);
    if (!parts.box.isConnected) views.append(parts.box);
    resized.observe(parts.box);
  }
  for (const [view, parts] of open) if (!parts.iframe.src) void start(parts, view);
  for (const button of $$("#view-switch button"))
    button.setAttribute("aria-pressed", String(button.dataset.layout === which));
  localStorage.setItem("flexdt-layout", which);
  closeUps();
  fit(true);
}

let last = "";

/**
 * Size and place the beam's frame so that the detector's image fills the crop, whatever the
 * piercing point.
 */
export function fit(force = false) {
  const parts = open.get("beam");
  const f = store.framing;
  if (!parts?.crop || !f) return;
  const { clientWidth: w, clientHeight: h } = parts.box;
  const key = JSON.stringify([f, w, h]);
  if (!force && key === last) return;
  last = key;
  const width = Math.max(40, Math.min(w - 24, (h - 24) / f.aspect));

  /**
   * @param {HTMLElement} node
   * @param {Record<string, number>} values
   */
  const set = (node, values) => {
    for (const [k, v] of Object.entries(values)) node.style.setProperty(k, `${v}px`);
  };
  set(parts.crop, {
    width,
    height: width * f.aspect,
    left: (w - width) / 2,
    top: (h - width * f.aspect) / 2,
  });
  set(parts.iframe, {
    width: f.width * width,
    height: f.height * width,
    left: -f.left * width,
    top: -f.top * width,
  });
  parts.tag.textContent = f.exact ? "Beam’s eye" : "Beam’s eye (oblique)";
}

on("state", () => fit());
new ResizeObserver(() => {
  fit();
  posed = "";
}).observe($("#views"));
