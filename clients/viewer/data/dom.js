// Small helpers for building the page.
export const $ = (selector, root = document) => root.querySelector(selector);
export const $$ = (selector, root = document) => [...root.querySelectorAll(selector)];
export function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "class") node.className = value;
    else if (name in node && name !== "list") node[name] = value;
    else node.setAttribute(name, value);
  }
  node.append(...children.filter((c) => c !== null && c !== undefined));
  return node;
}
// Attributes of what is pressed like a button and looks like none.
export function pressed(f) {
  return { role: "button", tabIndex: 0, onclick: f, onkeydown: (e) => { if (e.key === "Enter" && !e.repeat) f(e); } };
}
export function fixed(value, digits = 2) {
  if (!Number.isFinite(value)) return "–";
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text;
}
// The number a person typed: a decimal comma is a point, and what is no number is none (never 0).
export function parsed(text) {
  const plain = text.trim().replace("−", "-").replace(",", ".");
  return /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(plain) ? Number(plain) : NaN;
}
// A field for a number (as text: browsers drop what they cannot read from number fields without a word).
// What is typed is marked until Enter applies it or Escape takes it back.
export function field(attributes, apply, back) {
  const input = el("input", { type: "text", inputMode: "decimal", autocomplete: "off", ...attributes });
  input.classList.add("num");
  input.addEventListener("input", () => input.classList.add("typed"));
  input.addEventListener("keydown", (e) => {
    const step = { ArrowUp: 1, ArrowDown: -1 }[e.key], value = parsed(input.value);
    if (e.key === "Enter" && !e.repeat) apply();
    if (e.key === "Escape") back();
    if (step && Number.isFinite(value)) { e.preventDefault(); input.value = String(Number((value + step).toFixed(4))); input.classList.add("typed"); }
  });
  return input;
}
export function seconds(s) {
  if (!Number.isFinite(s)) return "–";
  s = Math.round(s);
  const h = Math.floor(s / 3600), m = Math.floor((s % 3600) / 60);
  return h ? `${h} h ${String(m).padStart(2, "0")} min` : m ? `${m} min ${String(s % 60).padStart(2, "0")} s` : `${s} s`;
}
export function bytes(n) {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let i = 0;
  while (n >= 1000 && i < 4) { n /= 1000; i++; }
  return `${n.toFixed(i ? 1 : 0)} ${units[i]}`;
}
export function setText(node, text) { if (node.textContent !== text) node.textContent = text; }
export function download(url, name) { const a = el("a", { href: url, download: name }); document.body.append(a); a.click(); a.remove(); }
export function base64(buffer) {
  const b = new Uint8Array(buffer);
  let out = "";
  for (let i = 0; i < b.length; i += 0x8000) out += String.fromCharCode(...b.subarray(i, i + 0x8000));
  return btoa(out);
}
