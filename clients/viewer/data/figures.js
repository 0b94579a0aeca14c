// Numbers in words, and words as numbers.

/**
 * @param {unknown} value
 * @returns {value is number}
 */
export const isNumber = (value) => Number.isFinite(value);

/**
 * @param {number | null | undefined} value
 * @returns {string}
 */
export function fixed(value, digits = 2) {
  if (!isNumber(value)) return "–";
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text;
}

/**
 * What is to be seen, MATERIAL:MM, as people read it.
 * @param {string} detail
 * @returns {string}
 */
export const detailWords = (detail) => detail.replace(/^(.+):(.+)$/, "$2 mm of $1");

/**
 * A part of the machine, as people read its name.
 * @param {string} name
 * @returns {string}
 */
export const partWords = (name) => name.replaceAll("_", " ").replace(/^xray/, "X-ray");

/**
 * @param {number | null | undefined} s
 * @returns {string}
 */
export function seconds(s) {
  if (!isNumber(s)) return "–";
  s = Math.round(s);
  const h = Math.floor(s / 3600);
  const m = Math.floor((s % 3600) / 60);
  return h
    ? `${h} h ${String(m).padStart(2, "0")} min`
    : m
      ? `${m} min ${String(s % 60).padStart(2, "0")} s`
      : `${s} s`;
}

/**
 * @param {number} n
 * @returns {string}
 */
export function bytes(n) {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let i = 0;
  while (n >= 1000 && i < 4) {
    n /= 1000;
    i++;
  }
  return `${n.toFixed(i ? 1 : 0)} ${units[i]}`;
}

/**
 * The number a person typed: a decimal comma is a point, and what is no number is none (never
 * 0).
 * @param {string} text
 * @returns {number}
 */
export function parsed(text) {
  const bare = text.trim().replace("−", "-").replace(",", ".");
  return /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(bare) ? Number(bare) : NaN;
}
