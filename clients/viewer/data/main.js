// The page: puts its parts together.
import { $, $button } from "./dom.js";
import { call, connect, on, store } from "./link.js";
import { known, tab } from "./tabs.js";
import "./number_fields.js";
import "./status.js";
import "./warnings.js";
import "./axes.js";
import { picture, shown as film, value } from "./film.js";
import "./drag_told.js";
import "./setup.js";
import "./presets.js";
import "./uploads.js";
import * as scan from "./scan.js";
import "./scan_bar.js";
import "./notice.js";
import "./scan_frames.js";
import * as data from "./data.js";
import "./queue.js";
import "./calibrate.js";
import "./share.js";
import "./layout.js";
import "./said.js";
import { look as volume } from "./volume.js";
import "./scan_it.js";
import "./by_hand.js";
import "./story.js";
import { asked } from "./address.js";
import { listen, toggleHelp } from "./keys.js";
import { fine, layout } from "./views.js";

/** @param {boolean} dark */
function theme(dark, tell = true) {
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  localStorage.setItem("flexdt-theme", dark ? "dark" : "light");
  if (tell) call("viewer.theme", { dark, fine }).catch(() => {});
}
const dark = () => document.documentElement.dataset.theme === "dark";
$button("#theme").addEventListener("click", () => theme(!dark()));
for (const id of ["#help", "#about"]) $button(id).addEventListener("click", toggleHelp);
on("open", () => theme(dark()));

window.addEventListener("popstate", () => {
  tab(known(asked("tab")));
  const view = asked("view");
  if (view) layout(view);
  data.restore();
});

tab(known(asked("tab")));
listen(window);
connect();
// The scenes' frames say which page they belong to, so the page has been registered before.
on("connection", () => {
  if (store.drawn && !$("#views").childElementCount) layout(window.firstView);
});
window.flexdt = { store, call, scan, data, film, picture, value, volume };
