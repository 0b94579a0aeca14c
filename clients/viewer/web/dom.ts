// Small helpers for building the page.
import { parsed } from "./figures.js";
import { plain } from "./names.js";

export { bytes, fixed, isNumber, parsed, seconds } from "./figures.js";

export const $ = <E extends Element = HTMLElement>(
  selector: string,
  root: ParentNode = document,
): E => {
  const found = root.querySelector<E>(selector);
  if (!found) throw new Error(`the page has no ${selector}`);
  return found;
};
export const $$ = <E extends Element = HTMLElement>(
  selector: string,
  root: ParentNode = document,
): E[] => [...root.querySelectorAll<E>(selector)];
export const $input = (selector: string) => $<HTMLInputElement>(selector);
export const $select = (selector: string) => $<HTMLSelectElement>(selector);
export const $button = (selector: string) => $<HTMLButtonElement>(selector);
export const $canvas = (selector: string) => $<HTMLCanvasElement>(selector);
export const $dialog = (selector: string) => $<HTMLDialogElement>(selector);

type Handlers = {
  [E in "click" | "keydown" | "input" | "change" | "toggle" as `on${E}`]?: (
    e: HTMLElementEventMap[E],
  ) => unknown;
};
export type Attributes = Handlers & {
  readonly [name: string]:
    string | number | boolean | null | undefined | Handlers[keyof Handlers];
};
export function el<T extends keyof HTMLElementTagNameMap>(
  tag: T,
  attributes: Attributes = {},
  ...children: Array<Node | string | null | undefined>
): HTMLElementTagNameMap[T] {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function")
      node.addEventListener(name.slice(2), value as EventListener);
    else if (name === "class") node.className = String(value);
    else if (name === "title") node.title = plain(String(value));
    else if (name in node && name !== "list")
      (node as unknown as Record<string, unknown>)[name] = value;
    else node.setAttribute(name, String(value));
  }
  const given = children.filter((c) => c !== null && c !== undefined);
  node.append(...given.map((c) => (typeof c === "string" ? plain(c) : c)));
  return node;
}
// Id of a button -> what it does.
export function clicks(acts: Record<string, () => unknown>): void {
  for (const [id, act] of Object.entries(acts))
    $(`#${id}`).addEventListener("click", () => void act());
}
// Attributes of what is pressed like a button and looks like none.
export function pressed(f: () => unknown) {
  return {
    role: "button",
    tabIndex: 0,
    onclick: f,
    onkeydown: (e: KeyboardEvent) => {
      if (e.key === "Enter" && !e.repeat) f();
    },
  };
}
// A field for a number (as text: browsers drop what they cannot read from number fields without a
// word). What is typed is marked until Enter applies it or Escape takes it back.
export function field(
  attributes: Attributes,
  apply: () => unknown,
  back: () => unknown,
): HTMLInputElement {
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
export function numeric(
  input: HTMLInputElement,
  apply: () => unknown,
  back: () => unknown,
): HTMLInputElement {
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
export function setText(node: Element, text: string): void {
  const shown = plain(text);
  if (node.textContent !== shown) node.textContent = shown;
}
export function download(url: string, name: string): void {
  const a = el("a", { href: url, download: name });
  document.body.append(a);
  a.click();
  a.remove();
}
export function downloadBlob(blob: Blob, name: string): void {
  const url = URL.createObjectURL(blob);
  download(url, name);
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}
export function base64(buffer: ArrayBuffer): string {
  const b = new Uint8Array(buffer);
  let out = "";
  for (let i = 0; i < b.length; i += 0x8000)
    out += String.fromCharCode(...b.subarray(i, i + 0x8000));
  return btoa(out);
}
// A canvas's pixels in two dimensions, and one that was not refused.
export function context2d(canvas: HTMLCanvasElement): CanvasRenderingContext2D {
  // Images are made, and read back, by the processor.
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (!context) throw new Error("this browser draws nothing");
  return context;
}
// Grey values (0 to 255, row by row) as a picture.
export function putGrey(
  canvas: HTMLCanvasElement,
  [rows, cols]: readonly number[],
  grey: (k: number) => number,
): void {
  canvas.width = cols;
  canvas.height = rows;
  const x = context2d(canvas);
  const out = x.createImageData(cols, rows);
  const d = new Uint32Array(out.data.buffer);
  for (let k = 0; k < d.length; k++) d[k] = 0xff000000 | (grey(k) * 0x010101);
  x.putImageData(out, 0, 0);
}
// One that the wire brought, with 8 bits a pixel.
export function putImage(
  canvas: HTMLCanvasElement,
  { shape, data }: { shape: readonly number[]; data: string },
): HTMLCanvasElement {
  const raw = atob(data);
  putGrey(canvas, shape, (k) => raw.charCodeAt(k));
  return canvas;
}
// Pressed or dragged: which part of its width the pointer is at.
export function slid(canvas: HTMLElement, to: (part: number) => unknown): void {
  const tell = (e: PointerEvent) => {
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
// A file that somebody chooses is taken once, and may be chosen again.
export function chosen(input: HTMLInputElement, take: (file: File) => unknown): void {
  input.addEventListener("change", () => {
    const file = input.files?.[0];
    if (file) void take(file);
    input.value = "";
  });
}
// A term that explains itself where it stands: under the pointer, when tapped, and when the
// keyboard comes to it.
export const term = (words: string, tip: string): HTMLElement =>
  el(
    "button",
    { type: "button", class: "term", "aria-description": tip, "data-tip": tip },
    words,
  );
// What went wrong, in words.
export const words = (error: unknown): string =>
  error instanceof Error ? error.message : String(error);
// The element of a kind that an event happened within; elements of other frames are of other
// classes.
export const within = (target: EventTarget | null, selector: string): Element | null =>
  (target as Partial<Element> | null)?.closest?.(selector) ?? null;
// Keeps a choice in this browser, if it has room.
export function keep(key: string, value: string): void {
  try {
    localStorage.setItem(key, value);
  } catch {
    /* it has no room */
  }
}
