// Names that people and other programs give: shown without what would turn the text about them
// around, and of files in letters that names may hold.

// Marks that change the direction of text: U+202E mirrors whatever follows it.
const DIRECTION_MARKS = /[\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]/g;
const SHOWN_INSTEAD = "\ufffd";
const FORBIDDEN = /[\u0000-\u001f\u007f/\\:*?"<>|]+/g;
const NAME_LENGTH = 100;

/**
 * @param {string} text
 * @returns {string}
 */
export const plain = (text) => text.replace(DIRECTION_MARKS, SHOWN_INSTEAD);

/**
 * A message of the twin with the reader's own session as "you".
 * @param {string} message
 * @param {string | null} session
 * @returns {string}
 */
export function toYou(message, session) {
  if (!session) return message;
  const literal = session.replace(/[.*+?^${}()|[\]\\]/g, "\\$&");
  return message.replace(new RegExp(`(?<![\\w#])${literal}(?![\\w#])`, "g"), "you");
}

/**
 * The file's name without what names may not hold; neutral where nothing is left of it. A name
 * that had to be changed is never one that is taken, so nothing is overwritten by accident.
 * @param {string} file
 * @param {string[]} taken
 * @returns {string}
 */
export function sampleName(file, taken) {
  const bare = file.replace(/\.[^.]*$/, "").normalize("NFC");
  const allowed = bare.replace(DIRECTION_MARKS, "").replace(FORBIDDEN, "-");
  const name = allowed.replace(/^[\s.-]+|[\s.-]+$/g, "").slice(0, NAME_LENGTH);
  const stem = name || "mesh";
  if (name === bare || (name && !taken.includes(name))) return name;
  let n = 1;
  while (taken.includes(`${stem}-${n}`)) n++;
  return `${stem}-${n}`;
}
