// The tabs of the left side, and the panel of each; what is in a panel is its own module's.
import { $, $$, el } from "./dom.js";
import { emit, on } from "./link.js";
import { remember } from "./address.js";

for (const name of ["move", "setup", "scan", "data", "calibrate", "share"]) {
  const words = name.charAt(0).toUpperCase() + name.slice(1);
  $("#tabs").append(
    el(
      "button",
      {
        role: "tab",
        id: `tab-of-${name}`,
        "aria-controls": `tab-${name}`,
        "data-tab": name,
        onclick: () => tab(name, true),
      },
      words,
    ),
  );
  const panel =
    document.getElementById(`tab-${name}`) ??
    el("section", { class: "tab", id: `tab-${name}`, hidden: true });
  panel.setAttribute("role", "tabpanel");
  panel.setAttribute("aria-labelledby", `tab-of-${name}`);
  $("#facts").before(panel);
}

/** @param {string} name */
export function tab(name, step = false) {
  remember({ tab: name }, step);
  for (const b of $$("#tabs button")) {
    b.setAttribute("aria-selected", String(b.dataset.tab === name));
    b.tabIndex = b.dataset.tab === name ? 0 : -1;
  }
  for (const s of $$(".tab")) s.hidden = s.id !== `tab-${name}`;
  emit("tab", name);
}
$("#tabs").addEventListener("keydown", (e) => {
  const all = $$("#tabs button");
  const i = all.indexOf(/** @type {HTMLElement} */ (e.target));
  const step = e.key === "ArrowRight" ? 1 : e.key === "ArrowLeft" ? -1 : 0;
  const next = step
    ? all.at((i + step) % all.length)
    : e.key === "Home"
      ? all[0]
      : e.key === "End"
        ? all.at(-1)
        : undefined;
  if (next) {
    e.preventDefault();
    tab(next.dataset.tab ?? "", true);
    next.focus();
  }
});

/**
 * @param {string | null} name
 * @returns {string}
 */
export const known = (name) =>
  $$("#tabs button").find((b) => b.dataset.tab === name)?.dataset.tab ?? "move";
on("show-tab", (name) => tab(name, true));
