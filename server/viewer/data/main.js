// The page: puts its parts together.
import { $, $$ } from "./dom.js";
import { call, connect, emit, on, store } from "./link.js";
import "./status.js";
import "./axes.js";
import { shown as film } from "./film.js";
import "./setup.js";
import * as scan from "./scan.js";
import "./calibrate.js";
import "./share.js";
import { listen, toggleHelp } from "./keys.js";
import { layout } from "./views.js";

const query = new URLSearchParams(location.search);
function theme(dark, tell = true) {
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  localStorage.setItem("flexdt-theme", dark ? "dark" : "light");
  if (tell) call("viewer.theme", { dark }).catch(() => {});
}
const dark = () => document.documentElement.dataset.theme === "dark";
const wanted = query.get("theme") ?? localStorage.getItem("flexdt-theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
theme(wanted === "dark", false);
$("#theme").addEventListener("click", () => theme(!dark()));
$("#help").addEventListener("click", toggleHelp);
on("open", () => theme(dark()));

function tab(name) {
  for (const b of $$("#tabs button")) b.setAttribute("aria-selected", String(b.dataset.tab === name));
  for (const s of $$(".tab")) s.hidden = s.id !== `tab-${name}`;
  emit("tab", name);
}
for (const b of $$("#tabs button")) b.addEventListener("click", () => tab(b.dataset.tab));
if (query.get("tab")) tab(query.get("tab"));

listen(window);
connect();
// The scenes' frames say which page they belong to, so the page has been registered before.
on("connection", () => { if (store.cameras && !$("#views").childElementCount) layout(query.get("view") ?? localStorage.getItem("flexdt-layout") ?? "iso"); });
window.flexdt = { store, call, scan, film };
