// The views: one frame of viser each; the beam's eye is cropped to exactly the detector's image.
import { $, $$, el } from "./dom.js";
import { call, on, pageId, store } from "./link.js";
import { listen } from "./keys.js";

const NAMES = { iso: "Isometric", beam: "Beam’s eye", side: "Side", free: "Free" };
const START = { iso: "2.05,-1.35,1.3", beam: "0,0,0.02", side: "3.7,0.5,0.12", free: "-0.95,0.1,0.52" };
const AIM = { iso: "0,0.45,0.04", beam: "0,1,0.02", side: "0,0.5,0.12", free: "0,0.72,0" };
const open = new Map();
export let current = null;

function frame(view) {
  const src = `/scene/${pageId}/${view}?initialCameraPosition=${START[view]}&initialCameraLookAt=${AIM[view]}${devicePixelRatio > 1.5 ? "" : "&fixedDpr=1"}`;
  const iframe = el("iframe", { src, title: NAMES[view] });
  iframe.addEventListener("load", () => listen(iframe.contentWindow));
  const tag = el("span", { class: "tag" }, NAMES[view]);
  const box = el("div", { class: "view" });
  box.dataset.view = view;
  if (view === "beam") {
    const crop = el("div", { class: "crop" }, iframe, el("div", { class: "shield" }));
    box.append(crop, tag);
    return { box, iframe, crop, tag };
  }
  const home = el("button", { class: "home", title: "Back to this view's preset", onclick: () => call("viewer.camera", { view }) }, "⌂");
  box.append(iframe, tag, home);
  return { box, iframe, tag };
}

export function layout(which) {
  if (which === current) return;
  current = which;
  const wanted = which === "none" ? [] : which === "four" ? ["iso", "beam", "side", "free"] : [which];
  const views = $("#views");
  views.dataset.layout = which;
  for (const [view, parts] of open) if (!wanted.includes(view)) { parts.box.remove(); open.delete(view); }
  for (const view of wanted) if (!open.has(view)) open.set(view, frame(view));
  for (const view of wanted) if (!open.get(view).box.isConnected) views.append(open.get(view).box);
  for (const button of $$("#view-switch button")) button.setAttribute("aria-pressed", String(button.dataset.layout === which));
  localStorage.setItem("flexdt-layout", which);
  fit(true);
}

let last = "";
// Size and place the beam's frame so that the detector's image fills the crop, whatever the piercing point.
export function fit(force = false) {
  const parts = open.get("beam"), f = store.framing;
  if (!parts || !f) return;
  const { clientWidth: w, clientHeight: h } = parts.box;
  const key = JSON.stringify([f, w, h]);
  if (!force && key === last) return;
  last = key;
  const width = Math.max(40, Math.min(w - 24, (h - 24) / f.aspect));
  const set = (node, values) => { for (const [k, v] of Object.entries(values)) node.style[k] = `${v}px`; };
  set(parts.crop, { width, height: width * f.aspect, left: (w - width) / 2, top: (h - width * f.aspect) / 2 });
  set(parts.iframe, { width: f.width * width, height: f.height * width, left: -f.left * width, top: -f.top * width });
  parts.tag.textContent = f.exact ? "Beam’s eye" : "Beam’s eye (oblique)";
}

on("state", () => fit());
new ResizeObserver(() => fit()).observe(document.getElementById("views"));
for (const button of $$("#view-switch button")) button.addEventListener("click", () => layout(button.dataset.layout));
