// Small helpers for building the page.
import { parsed } from "./figures.js";
import { plain } from "./names.js";

export { bytes, fixed, isNumber, parsed, seconds } from "./figures.js";

/**
 * @template {Element} [E=HTMLElement]
 * @param {string} selector
 * @param {ParentNode} [root]
 * @returns {E}
 */
export const $ = (selector, root = document) => {
  /** @type {E | null} */
  const found = root.querySelector(selector);
  if (!found) throw new Error(`the page has no ${selector}`);
  return found;
};

/**
 * @template {Element} [E=HTMLElement]
 * @param {string} selector
 * @param {ParentNode} [root]
 * @returns {E[]}
 */
export const $$ = (selector, root = document) => [
  .../** @type {NodeListOf<E>} */ (root.querySelectorAll(selector)),
];
/** @param {string} selector */
export const $input = (selector) => /** @type {HTMLInputElement} */ ($(selector));
/** @param {string} selector */
export const $select = (selector) => /** @type {HTMLSelectElement} */ ($(selector));
/** @param {string} selector */
export const $button = (selector) => /** @type {HTMLButtonElement} */ ($(selector));
/** @param {string} selector */
export const $canvas = (selector) => /** @type {HTMLCanvasElement} */ ($(selector));
/** @param {string} selector */
export const $dialog = (selector) => /** @type {HTMLDialogElement} */ ($(selector));

/**
 * @typedef {{
 *   [E in "click" | "keydown" | "input" | "change" | "toggle" as `on${E}`]?: (
 *     e: HTMLElementEventMap[E],
 *   ) => unknown
 * }} Handlers
 */

/**
 * @typedef {Handlers & {
 *   readonly [name: string]:
 *     string | number | boolean | null | undefined | Handlers[keyof Handlers];
 * }} Attributes
 */

/**
 * @template {keyof HTMLElementTagNameMap} T
 * @param {T} tag
 * @param {Attributes} [attributes]
 * @param {...(Node | string | null | undefined)} children
 * @returns {HTMLElementTagNameMap[T]}
 */
export function el(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function")
      node.addEventListener(name.slice(2), /** @type {EventListener} */ (value));
    else if (name === "class") node.className = String(value);
    else if (name === "title") node.title = plain(String(value));
    else if (name in node && name !== "list")
      /** @type {Record<string, unknown>} */ (/** @type {unknown} */ (node))[name] = value;
    else node.setAttribute(name, String(value));
  }
  const given = children.filter((c) => c !== null && c !== undefined);
  node.append(...given.map((c) => (typeof c === "string" ? plain(c) : c)));
  return node;
}

/**
 * Id of a button -> what it does.
 * @param {Record<string, () => unknown>} acts
 */
export function clicks(acts) {
  for (const [id, act] of Object.entries(acts))
    $(`#${id}`).addEventListener("click", () => void act());
}

/**
 * Attributes of what is pressed like a button and looks like none.
 * @param {() => unknown} f
 */
export function pressed(f) {
  return {
    role: "button",
    tabIndex: 0,
    onclick: f,
    /** @param {KeyboardEvent} e */
    onkeydown: (e) => {
      if (e.key === "Enter" && !e.repeat) f();
    },
  };
}

/**
 * A field for a number (as text: browsers drop what they cannot read from number fields without
 * a word). What is typed is marked until Enter applies it or Escape takes it back.
 * @param {Attributes} attributes
 * @param {() => unknown} apply
 * @param {() => unknown} back
 * @returns {HTMLInputElement}
 */
export function field(attributes, apply, back) {
  return numeric(
    el("input", {
      type: "text",
      inputMode: "decimal",
      autocomplete: "off",
      class: "num",
      ...attributes,
    }),
    apply,
    back,
  );
}

/**
 * @param {HTMLInputElement} input
 * @param {() => unknown} apply
 * @param {() => unknown} back
 * @returns {HTMLInputElement}
 */
export function numeric(input, apply, back) {
  input.addEventListener("input", () => input.classList.add("typed"));
  input.addEventListener("keydown", (e) => {
    const step = e.key === "ArrowUp" ? 1 : e.key === "ArrowDown" ? -1 : 0;
    const value = parsed(input.value);
    if (e.key === "Enter" && !e.repeat) apply();
    if (e.key === "Escape") back();
    if (step && Number.isFinite(value)) {
      e.preventDefault();
      input.value = String(Number((value + step).toFixed(4)));
      input.classList.add("typed");
    }
  });
  return input;
}

/**
 * @param {Element} node
 * @param {string} text
 */
export function setText(node, text) {
  const shown = plain(text);
  if (node.textContent !== shown) node.textContent = shown;
}

/**
 * @param {string} url
 * @param {string} name
 */
export function download(url, name) {
  const a = el("a", { href: url, download: name });
  document.body.append(a);
  a.click();
  a.remove();
}

/**
 * @param {Blob} blob
 * @param {string} name
 */
export function downloadBlob(blob, name) {
  const url = URL.createObjectURL(blob);
  download(url, name);
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

/**
 * @param {ArrayBuffer} buffer
 * @returns {string}
 */
export function base64(buffer) {
  const b = new Uint8Array(buffer);
  let out = "";
  for (let i = 0; i < b.length; i += 0x8000)
    out += String.fromCharCode(...b.subarray(i, i + 0x8000));
  return btoa(out);
}

/**
 * A canvas's pixels in two dimensions, and one that was not refused.
 * @param {HTMLCanvasElement} canvas
 * @returns {CanvasRenderingContext2D}
 */
export function context2d(canvas) {
  // Images are made, and read back, by the processor.
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (!context) throw new Error("this browser draws nothing");
  return context;
}

/**
 * Grey values (0 to 255, row by row) as a picture.
 * @param {HTMLCanvasElement} canvas
 * @param {readonly number[]} shape
 * @param {(k: number) => number} grey
 */
function putGrey(canvas, [rows, cols], grey) {
  canvas.width = cols;
  canvas.height = rows;
  const x = context2d(canvas);
  const out = x.createImageData(cols, rows);
  const d = new Uint32Array(out.data.buffer);
  for (let k = 0; k < d.length; k++) d[k] = 0xff000000 | (grey(k) * 0x010101);
  x.putImageData(out, 0, 0);
}

/**
 * One that the wire brought, with 8 bits a pixel.
 * @param {HTMLCanvasElement} canvas
 * @param {{ shape: readonly number[]; data: string }} image
 * @returns {HTMLCanvasElement}
 */
export function putImage(canvas, { shape, data }) {
  const raw = atob(data);
  putGrey(canvas, shape, (k) => raw.charCodeAt(k));
  return canvas;
}

/**
 * Pressed or dragged: which part of its width the pointer is at.
 * @param {HTMLElement} canvas
 * @param {(part: number) => unknown} to
 */
export function slid(canvas, to) {
  /** @param {PointerEvent} e */
  const tell = (e) => {
    const b = canvas.getBoundingClientRect();
    to(Math.min(1, Math.max(0, (e.clientX - b.left) / b.width)));
  };
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    tell(e);
  });
  canvas.addEventListener("pointermove", (e) => {
    if (canvas.hasPointerCapture(e.pointerId)) tell(e);
  });
}

/**
 * A file that somebody chooses is taken once, and may be chosen again.
 * @param {HTMLInputElement} input
 * @param {(file: File) => unknown} take
 */
export function chosen(input, take) {
  input.addEventListener("change", () => {
    const file = input.files?.[0];
    if (file) void take(file);
    input.value = "";
  });
}

/**
 * A term that explains itself where it stands: under the pointer, when tapped, and when the
 * keyboard comes to it.
 * @param {string} words
 * @param {string} tip
 * @returns {HTMLElement}
 */
export const term = (words, tip) =>
  el(
    "button",
    { type: "button", class: "term", "aria-description": tip, "data-tip": tip },
    words,
  );

/**
 * What went wrong, in words.
 * @param {unknown} error
 * @returns {string}
 */
export const words = (error) => (error instanceof Error ? error.message : String(error));

/**
 * The element of a kind that an event happened within; elements of other frames are of other
 * classes.
 * @param {EventTarget | null} target
 * @param {string} selector
 * @returns {Element | null}
 */
export const within = (target, selector) =>
  /** @type {Partial<Element> | null} */ (target)?.closest?.(selector) ?? null;

/**
 * Keeps a choice in this browser, if it has room.
 * @param {string} key
 * @param {string} value
 */
export function keep(key, value) {
  try {
    localStorage.setItem(key, value);
  } catch {
    /* it has no room */
  }
}
