// The page: puts its parts together.
import { $, $$, $button } from "./dom.js";
import { call, connect, emit, on, store } from "./link.js";
import "./status.js";
import "./axes.js";
import { picture, shown as film, value } from "./film.js";
import "./setup.js";
import * as scan from "./scan.js";
import * as data from "./data.js";
import "./calibrate.js";
import "./share.js";
import "./layout.js";
import "./volume.js";
import { asked, remember } from "./address.js";
import { listen, toggleHelp } from "./keys.js";
import { layout } from "./views.js";
function theme(dark, tell = true) {
    document.documentElement.dataset.theme = dark ? "dark" : "light";
    localStorage.setItem("flexdt-theme", dark ? "dark" : "light");
    if (tell)
        call("viewer.theme", { dark }).catch(() => { });
}
const dark = () => document.documentElement.dataset.theme === "dark";
const wanted = asked("theme") ?? localStorage.getItem("flexdt-theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
theme(wanted === "dark", false);
$button("#theme").addEventListener("click", () => theme(!dark()));
$button("#help").addEventListener("click", toggleHelp);
on("open", () => theme(dark()));
function tab(name, step = false) {
    remember({ tab: name }, step);
    for (const b of $$("#tabs button")) {
        b.setAttribute("aria-selected", String(b.dataset.tab === name));
        b.tabIndex = b.dataset.tab === name ? 0 : -1;
    }
    for (const s of $$(".tab"))
        s.hidden = s.id !== `tab-${name}`;
    emit("tab", name);
}
for (const b of $$("#tabs button"))
    b.addEventListener("click", () => tab(b.dataset.tab ?? "", true));
$("#tabs").addEventListener("keydown", (e) => {
    const all = $$("#tabs button"), i = all.indexOf(e.target), step = e.key === "ArrowRight" ? 1 : e.key === "ArrowLeft" ? -1 : 0;
    const next = step ? all.at((i + step) % all.length) : e.key === "Home" ? all[0] : e.key === "End" ? all.at(-1) : undefined;
    if (next) {
        e.preventDefault();
        tab(next.dataset.tab ?? "", true);
        next.focus();
    }
});
const known = (name) => $$("#tabs button").find((b) => b.dataset.tab === name)?.dataset.tab ?? "move";
tab(known(asked("tab")));
on("show-tab", (name) => tab(name, true));
window.addEventListener("popstate", () => { tab(known(asked("tab"))); const view = asked("view"); if (view)
    layout(view); data.restore(); });
listen(window);
connect();
// The scenes' frames say which page they belong to, so the page has been registered before.
on("connection", () => { if (store.cameras && !$("#views").childElementCount)
    layout(asked("view") ?? localStorage.getItem("flexdt-layout") ?? "iso"); });
window.flexdt = { store, call, scan, data, film, picture, value };
