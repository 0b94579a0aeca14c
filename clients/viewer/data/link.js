// The page's connection to its viewer: requests with answers, newest states and images, how old
// they are, reconnection.
import { keep, words } from "./dom.js";
import { ofData, ofImage, ofNow } from "./fingerprint.js";
import { aging, belongs, clockNow, nameOf, NOW, OLD_S } from "./moment.js";
/**
 * @import { Fingerprint, Quantities, Quantity } from "./fingerprint.js"
 * @import { Moment } from "./moment.js"
 * @import { Answers, Events, Framing, HelloResult, ImageHead, JobStatus, Messages, Near, Pair,
 *   Requests, Shown, State } from "../web/viewer.d.ts"
 */

export const pageId = (window.pageId = [...crypto.getRandomValues(new Uint8Array(12))]
  .map((b) => b.toString(16).padStart(2, "0"))
  .join(""));
export const store = {
  /** @type {State | null} */ state: null,
  /** @type {Framing | null} */ framing: null,
  /** @type {number | null} */ across_mm: null,
  /** @type {Near | null} */ near: null,
  /** @type {HelloResult | null} */ hello: null,
  /** @type {string | null} */ session: null,
  twin: false,
  viewer: false,
  /** @type {Record<string, boolean>} */ layers: {},
  opacity: 1,
  /** @type {Shown | null} */ image: null,
  /** @type {Moment} */ moment: NOW,
  /** The data set that is open. */
  get recorded() {
    return this.moment.kind === "image" ? this.moment.dataset : null;
  },
  received: { state: 0, image: 0 },
  age: 0,
  /** @type {Quantities | null} */ now: null,
  imageAge: 0,
  /** @type {Quantity[]} */ imageDiffers: [],
  /** @type {JobStatus | null} */ job: null,
  /** @type {string | null} */ refused: null,
  /** @type {string | null} */ problem: null,
  /** @type {number[] | null} */ coneVec: null,
  drawn: false,
};
// After SILENT_S nobody waits for answers any more.
const SILENT_S = Number(new URLSearchParams(location.search).get("patience") ?? 5);
const LOOK_MS = 200;
const REST_MS = 500;
const RETRY_MS = 500;
const TRY_AGAIN = 1013;
/** @typedef {{ [E in keyof Events]?: Array<(...args: Events[E]) => unknown> }} Listeners */

/** @type {Listeners} */
const listeners = {};

/**
 * A request that has no answer yet.
 * @typedef {object} Waiting
 * @property {string} text as it is sent
 * @property {(result: never) => void} resolve
 * @property {(why: Failure) => void} reject
 * @property {number} since
 * @property {string | null} urgent what a person pressed
 * @property {boolean} sent over the present connection
 */

/** @type {Map<number, Waiting>} */
const waiting = new Map();
/** @type {Record<string, string>} */
const URGENT = { "safety.estop": "E-STOP", "axes.stop": "Stop", "job.abort": "Abort" };
/** Code of an answer that says that no connection has brought the request to the twin. */
const LINK_DOWN = -32011;

/**
 * What a person pressed with a request that makes the machine quiet: it is kept until the twin has
 * answered it.
 * @param {string} method
 * @param {{ on?: unknown }} params
 * @returns {string | null}
 */
function urgent(method, params) {
  if (method === "tube.set" && params.on === false) return "X-rays off";
  return URGENT[method] ?? null;
}

/**
 * The oldest urgent request that has not been answered, and its age in seconds.
 * @returns {{ what: string, age: number } | null}
 */
export function unanswered() {
  const now = performance.now();
  let oldest = null;
  for (const w of waiting.values())
    if (w.urgent && (!oldest || w.since < oldest.since)) oldest = w;
  return oldest && { what: oldest.urgent ?? "", age: (now - oldest.since) / 1000 };
}

/** Send what is urgent and has not been sent over this connection, with its age as a note. */
function sendUrgent() {
  for (const [id, w] of waiting) {
    if (!w.urgent || w.sent) continue;
    const age = (performance.now() - w.since) / 1000;
    if (age > OLD_S)
      emit("note", "warn", `${w.urgent}, pressed ${age.toFixed(0)} s ago, is sent now`, "");
    send(id, w);
  }
}

/**
 * @param {number} id
 * @param {Waiting} w
 */
function send(id, w) {
  waiting.set(id, w);
  w.sent = socket?.readyState === WebSocket.OPEN;
  if (w.sent) socket?.send(w.text);
}

/** Why a request was refused; code 0: nobody answered it. */
export class Failure extends Error {
  /** @readonly @type {number} */
  code;
  /** @readonly @type {unknown} */
  data;

  /**
   * @param {number} code
   * @param {string} message
   * @param {unknown} [data]
   */
  constructor(code, message, data) {
    super(message);
    this.code = code;
    this.data = data;
  }
}

/** @type {WebSocket | null} */
let socket = null;
let nextId = 1;
let pause = 200;

/**
 * @template {keyof Events} E
 * @param {E} what
 * @param {(...args: Events[E]) => unknown} f
 */
export function on(what, f) {
  (listeners[what] ??= /** @type {NonNullable<Listeners[E]>} */ ([])).push(f);
}

/**
 * @template {keyof Events} E
 * @param {E} what
 * @param {Events[E]} args
 */
export function emit(what, ...args) {
  for (const f of listeners[what] ?? []) f(...args);
}

/** @typedef {keyof Requests & keyof Answers} Method */

/**
 * @template {Method} M
 * @param {M} method
 * @param {Partial<Requests[M]>} [params]
 * @returns {Promise<Answers[M]>}
 */
export function call(method, params = {}) {
  return new Promise((resolve, reject) => {
    const pressed = urgent(method, params);
    if (!pressed && socket?.readyState !== WebSocket.OPEN) {
      reject(new Failure(0, "no connection to the viewer"));
      return;
    }
    const id = nextId++;
    const text = JSON.stringify({ id, method, params });
    const since = performance.now();
    send(id, { text, resolve, reject, since, urgent: pressed, sent: false });
  });
}

/**
 * What a request is about: a motor, else the request itself. One that ends a motion says nothing of
 * what was asked before.
 * @param {string} method
 * @param {{ targets?: Record<string, number>; axis?: string; velocity?: number }} params
 * @returns {string}
 */
function subject(method, { targets, axis, velocity }) {
  const motor = targets ? Object.keys(targets)[0] : axis;
  return motor === undefined || velocity === 0 ? method : motor;
}

/**
 * A command of a person: what goes wrong becomes a note, whose title, or title and words, may
 * depend on the error. It goes once the same is done.
 * @template {Method} M
 * @param {M} method
 * @param {Partial<Requests[M]>} [params]
 * @param {string | ((error: unknown) => string | [title: string, words: string])} [title]
 * @returns {Promise<Answers[M] | null>}
 */
export async function command(method, params = {}, title = "Refused") {
  const about = subject(method, params);
  try {
    const answer = await call(method, params);
    emit("settled", about);
    return answer;
  } catch (error) {
    const told = typeof title === "function" ? title(error) : title;
    const [head, body] = typeof told === "string" ? [told, words(error)] : told;
    emit("note", "error", head, body, isOfControl(error) ? "control" : about);
    return null;
  }
}

/**
 * Whether a request was refused because another controls.
 * @param {unknown} error
 */
const isOfControl = (error) =>
  error instanceof Failure &&
  Boolean(/** @type {{ controller?: string } | null} */ (error.data)?.controller);

/** How many jobs or samples are asked for at once. */
const PART = 200;

/**
 * All jobs, oldest first, in parts that the twin answers in a turn.
 * @returns {Promise<JobStatus[]>}
 */
export async function allJobs() {
  /** @type {JobStatus[]} */
  const jobs = [];
  for (;;) {
    const part = await call("job.list", { start: jobs.length, count: PART });
    jobs.push(...part.jobs);
    if (!part.jobs.length || jobs.length >= (part.total ?? 0)) return jobs;
  }
}

/**
 * All samples that may be set, likewise, and the materials of meshes.
 * @returns {Promise<Answers["sample.list"]>}
 */
export async function allSamples() {
  const found = await call("sample.list", { count: PART });
  while (found.samples.length < (found.total ?? 0)) {
    const part = await call("sample.list", { start: found.samples.length, count: PART });
    if (!part.samples.length) break;
    found.samples.push(...part.samples);
  }
  return found;
}

// Who is there: kept in this browser, and told to the twin with each connection.
const PERSON = "flexdt-person";
/** @returns {string} */
export const person = () => localStorage.getItem(PERSON) ?? "";
/** @param {string} name */
export function rename(name) {
  keep(PERSON, name.trim());
  // Without a connection the next one brings it.
  void call("viewer.person", { name: name.trim() }).catch(() => null);
}
/** @param {string | null | undefined} name */
const numberOf = (name) => /#\d+$/.exec(name ?? "")?.[0];
/**
 * Whether a name is or was this page's in its session with the twin: what was told under a former
 * name is still of the same person, and so is a state that comes before the news of a new one.
 * @param {string | null | undefined} name
 * @returns {boolean}
 */
export const isMe = (name) =>
  name != null &&
  (names.has(name) || (!!numberOf(name) && numberOf(name) === numberOf(store.session)));
/** @type {Set<string>} */
const names = new Set();

// A session ends with a reload, what was done in it stays this tab's.
const FORMER = "flexdt-sessions";
const FORMER_KEPT = 50;
/** @returns {string[]} */
const former = () =>
  /** @type {string[]} */ (JSON.parse(sessionStorage.getItem(FORMER) ?? "[]"));

/**
 * Who did something: "you" for this tab, reloads and twins before this one included, else the
 * name; the number of a session that may be over tells nobody apart.
 * @param {string} name
 * @returns {string}
 */
export const doer = (name) =>
  isMe(name) || former().includes(name) ? "you" : name.replace(/ #\d+$/, "");

/** @param {string} name */
function remember(name) {
  if (!person()) return; // a new twin counts from 1: without a name it may be another's
  const all = [name, ...former().filter((one) => one !== name)].slice(0, FORMER_KEPT);
  sessionStorage.setItem(FORMER, JSON.stringify(all));
}
export function connect() {
  // Below the page's own address: a proxy may have put it anywhere.
  const address = new URL(`ws/${pageId}`, document.baseURI);
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  address.searchParams.set("person", person());
  socket = new WebSocket(address);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    store.viewer = true;
    parts = [];
    heard = least = told = null;
    quickest = Infinity;
    emit("connection");
    emit("open");
  };
  socket.onmessage = (/** @type {MessageEvent<string | ArrayBuffer>} */ event) => {
    if (typeof event.data === "string") text(event.data);
    else part(event.data);
  };
  socket.onclose = (event) => {
    const was = store.viewer || event.code === TRY_AGAIN;
    store.refused = event.code === TRY_AGAIN ? event.reason : null;
    store.viewer = false;
    store.twin = false;
    store.session = null;
    names.clear();
    for (const [id, w] of waiting) {
      w.sent = false;
      if (w.urgent) continue;
      waiting.delete(id);
      w.reject(new Failure(0, "the viewer has gone"));
    }
    if (was) emit("connection");
    setTimeout(connect, pause);
    pause = Math.min(2 * pause, 2000);
  };
}

/**
 * The page is about another moment: what does not belong to it is gone.
 * @param {Moment} moment
 */
export function enter(moment) {
  const before = store.recorded;
  store.moment = moment;
  if (store.image && !belongs(made, moment)) {
    store.image = null;
    emit("image");
  }
  if (store.recorded !== before) emit("recorded", store.recorded);
  emit("moment", moment);
}

/** @type {{ [T in keyof Messages]: (m: Messages[T]) => void }} */
const handlers = {
  answer(m) {
    const w = waiting.get(m.id);
    if (w?.sent) quickest = Math.min(quickest, (performance.now() - w.since) / 1000);
    if (w?.urgent && m.error?.code === LINK_DOWN) {
      w.sent = false; // the next session with the twin takes it along, or this one
      setTimeout(() => store.session && sendUrgent(), RETRY_MS);
      return;
    }
    waiting.delete(m.id);
    if (m.error) w?.reject(new Failure(m.error.code, m.error.message, m.error.data));
    else w?.resolve(/** @type {never} */ (m.result));
  },
  state(m) {
    took("state");
    Object.assign(store, {
      state: m.state,
      framing: m.framing,
      across_mm: m.across_mm,
      near: m.near,
      coneVec: m.cone_vec,
    });
    store.received.state++;
    store.now = ofNow(m.state, m.cone_vec, store.hello);
    told = { at: performance.now(), late: late(m.at) };
    look();
    if (!store.twin) {
      store.twin = true;
      emit("connection");
    }
    emit("state", m.state);
  },
  link(m) {
    pause = 200;
    Object.assign(store, {
      refused: null,
      twin: m.connected,
      problem: m.problem,
      drawn: m.drawn,
    });
    store.hello = m.hello ?? store.hello;
    if (store.state) store.now = ofNow(store.state, store.coneVec, store.hello);
    emit("connection");
  },
  session(m) {
    store.session = m.session;
    if (m.session === null) names.clear();
    else {
      names.add(m.session);
      remember(m.session);
    }
    emit("connection");
    if (!m.connected) return;
    sendUrgent();
    emit("session");
  },
  volume(m) {
    took("volume");
    emit("volume", m);
  },
  layers(m) {
    store.layers = m.shown;
    store.opacity = m.opacity;
    emit("layers");
  },
  job(m) {
    emit("job", m.data);
  },
  note(m) {
    emit("note", m.level, m.title, m.body);
  },
  log(m) {
    emit("log", m.data);
  },
  drag(m) {
    emit("drag", m);
  },
  subject(m) {
    emit("subject", m.view, m.boxes);
  },
  part(m) {
    emit("part", m.part, m.motor);
  },
  beat(m) {
    heard = { at: performance.now(), late: late(m.at), silent: m.silent_s };
    look();
  },
};

/** @param {string} content */
function text(content) {
  const m = /** @type {{ type: keyof Messages }} */ (JSON.parse(content));
  if (m.type in handlers) handlers[m.type](/** @type {never} */ (m));
}

// How old what is shown is: since the last heartbeat of the viewer, what that one took, and how
// long the twin has told the viewer nothing. Of the two clocks' difference the least one seen
// stands for no delay; it may grow by the error of clocks.
const DRIFT = 1e-4;
/** @type {{ at: number; late: number; silent: number } | null} */
let heard = null;
/** @type {{ lag: number; at: number } | null} */
let least = null;
/** @param {number} sent */
function late(sent) {
  const now = performance.now() / 1000;
  least =
    least === null
      ? { lag: now - sent, at: now }
      : { lag: Math.min(now - sent, least.lag + DRIFT * (now - least.at)), at: now };
  return now - sent - least.lag;
}

// When the newest state came, how late, and the quickest answer so far: half of that, and at most
// all, is what any news takes.
/** @type {{ at: number; late: number } | null} */
let told = null;
let quickest = Infinity;
/** Of the image that is shown. @type {Fingerprint} */
let made = {};
const age = aging();

/**
 * What an image that the page has was made of.
 * @param {Pick<Shown, "recorded" | "origin" | "cone_vec" | "twin">} image
 * @returns {Fingerprint}
 */
export function imageMade(image) {
  const { recorded } = image;
  if (recorded) return ofData(recorded.name, recorded.index, nameOf(recorded.file));
  return ofImage(image.origin, image.cone_vec, image.twin);
}

/** How many seconds ago the newest state was told, if news takes so long; 0 without any. */
const toldAgo = (/** @type {number} */ now, /** @type {number} */ trip) =>
  told === null ? 0 : (now - told.at) / 1000 + told.late + trip;
function look() {
  const now = performance.now();
  const silent = heard === null ? 0 : (now - heard.at) / 1000 + heard.late + heard.silent;
  const trip = Number.isFinite(quickest) ? quickest : 0;
  // A state may wait behind other things where a heartbeat does not; at rest one comes every .5 s.
  const behind = toldAgo(now, trip / 2);
  // Nobody is blamed for the time that the page itself stood still ...
  store.age = Math.max(0, Math.max(silent, behind) - delay(now) / 1000);
  const image = store.image;
  store.imageAge = 0;
  store.imageDiffers = [];
  if (image && !image.recorded && store.now && store.state) {
    const { clock, time } = store.state;
    // ... but the image is as old as it is.
    const time_s = clockNow(clock, toldAgo(now, trip));
    const present = { made: store.now, told_s: time, time_s, since_s: behind };
    const { age_s, differ } = age({ made, time_s: image.time }, present);
    // As old as when the page looks next: until then it is not marked.
    const next_s = clockNow(clock, LOOK_MS / 1000) - clock.time_s;
    store.imageAge = differ.length ? age_s + next_s : age_s;
    store.imageDiffers = differ;
  }
  emit("age");
}
// A page that itself stood still (much to draw, a laptop asleep) first reads what has come
// meanwhile: the longest delay of its own within REST_MS is no silence of the viewer.
let looked = performance.now();
let longest = { ms: 0, at: -Infinity };

/**
 * @param {number} now
 * @returns {number}
 */
function delay(now) {
  const due = now - looked - LOOK_MS;
  return Math.max(0, due, now - longest.at < REST_MS ? longest.ms : 0);
}
setInterval(() => {
  const now = performance.now();
  const due = now - looked - LOOK_MS;
  if (due >= delay(now)) longest = { ms: due, at: now };
  looked = now;
  look();
  if (store.age <= SILENT_S) return;
  for (const [id, w] of waiting)
    if (!w.urgent && now - w.since > 1000 * SILENT_S) {
      waiting.delete(id);
      w.reject(new Failure(0, `no answer for ${SILENT_S} s; it may still take effect`));
    }
}, LOOK_MS);

/**
 * What is acknowledged makes room for the next: so nothing old waits in sockets.
 * @param {string} slot
 */
function took(slot) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(`{"took":"${slot}"}`);
}

/** @type {Uint8Array[]} */
let parts = [];
/** @param {ArrayBuffer} buffer */
function part(buffer) {
  took("image");
  const bytes = new Uint8Array(buffer);
  parts.push(bytes.subarray(1));
  if (bytes[0] === 0) return;
  const whole = new Uint8Array(parts.reduce((n, p) => n + p.length, 0));
  parts.reduce((n, p) => {
    whole.set(p, n);
    return n + p.length;
  }, 0);
  parts = [];
  void image(whole);
}

/** @typedef {Uint8Array<ArrayBuffer>} Body */

/** @type {Record<ImageHead["code"], (body: Body, shape: Pair) => Promise<Uint16Array>>} */
const decoders = {
  async jpeg(body, [rows, cols]) {
    const picture = await createImageBitmap(new Blob([body], { type: "image/jpeg" }));
    const canvas = new OffscreenCanvas(cols, rows);
    const context = canvas.getContext("2d", { willReadFrequently: true });
    if (!context) throw new Error("this browser draws nothing");
    context.drawImage(picture, 0, 0);
    const { data } = context.getImageData(0, 0, cols, rows);
    const pixels = new Uint16Array(rows * cols);
    for (let k = 0; k < pixels.length; k++) pixels[k] = 257 * data[4 * k];
    return pixels;
  },
  /** Differences from column to column, low bytes before high ones. */
  async deflate(body, [, cols]) {
    const planes = new Uint8Array(
      await new Response(
        new Blob([body]).stream().pipeThrough(new DecompressionStream("deflate")),
      ).arrayBuffer(),
    );
    const pixels = new Uint16Array(planes.length / 2);
    for (let k = 0; k < pixels.length; k++) {
      const step = planes[k] | (planes[pixels.length + k] << 8);
      pixels[k] = k % cols ? pixels[k - 1] + step : step;
    }
    return pixels;
  },
};
let unpacked = 0;
let arrived = 0;
/** @param {Body} whole */
async function image(whole) {
  const number = ++arrived;
  const size = new DataView(whole.buffer).getUint32(4, true);
  const head = /** @type {ImageHead} */ (
    JSON.parse(new TextDecoder().decode(whole.subarray(8, 8 + size)))
  );
  const at_ms = performance.now();
  const all = await decoders[head.code](whole.subarray(8 + size), head.shape);
  const n = all.length / 2;
  /** @type {Shown} */
  const got = head.pair
    ? { ...head, at_ms, pixels: all.subarray(0, n), virtual: all.subarray(n) }
    : { ...head, at_ms, pixels: all };
  if (number < unpacked) return; // a newer one was quicker
  unpacked = number;
  const of = imageMade(got);
  if (!belongs(of, store.moment)) return;
  made = of;
  store.image = got;
  store.received.image++;
  look();
  emit("image", got);
}
