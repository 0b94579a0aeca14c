// What a reload brings back: tab, view, data set and frame in the address, the script after its
// #.
import { base64 } from "./dom.js";

const MOST = 6000;
const DUE_MS = 300;
const KEY = "flexdt-script"; // a longer script stays in this browser's tab

/**
 * @param {string} name
 * @returns {string | null}
 */
export const asked = (name) => new URLSearchParams(location.search).get(name);

/**
 * Values of null are taken out; with `step` the browser's Back comes back to what was before.
 * @param {Record<string, string | number | null>} values
 */
export function remember(values, step = false) {
  const url = new URL(location.href);
  for (const [name, value] of Object.entries(values)) {
    if (value === null) url.searchParams.delete(name);
    else url.searchParams.set(name, String(value));
  }
  if (url.href !== location.href) history[step ? "pushState" : "replaceState"](null, "", url);
}

/**
 * @param {BlobPart} data
 * @param {ReadableWritablePair<Uint8Array<ArrayBuffer>, Uint8Array<ArrayBuffer>>} stream
 */
const piped = (data, stream) =>
  new Response(new Blob([data]).stream().pipeThrough(stream)).arrayBuffer();
/** @type {number | undefined} */
let due;
/** @param {string} text */
export function rememberScript(text) {
  clearTimeout(due);
  due = window.setTimeout(async () => {
    const packed = base64(await piped(text, new CompressionStream("deflate-raw")))
      .replace(/\+/g, "-")
      .replace(/\//g, "_")
      .replace(/=+$/, "");
    const url = new URL(location.href);
    url.hash = text && packed.length <= MOST ? `script=${packed}` : "";
    history.replaceState(null, "", url.hash ? url : url.href.replace(/#$/, ""));
    try {
      if (packed.length > MOST) sessionStorage.setItem(KEY, text);
      else sessionStorage.removeItem(KEY);
    } catch {
      /* it has no room */
    }
  }, DUE_MS);
}

/** @returns {Promise<string>} */
export async function rememberedScript() {
  const packed = location.hash.match(/^#script=([\w-]+)$/)?.[1];
  if (!packed || packed.length > MOST) return sessionStorage.getItem(KEY) ?? "";
  try {
    const bytes = Uint8Array.from(atob(packed.replace(/-/g, "+").replace(/_/g, "/")), (c) =>
      c.charCodeAt(0),
    );
    return new TextDecoder().decode(await piped(bytes, new DecompressionStream("deflate-raw")));
  } catch {
    return "";
  } // an address that somebody cut
}
