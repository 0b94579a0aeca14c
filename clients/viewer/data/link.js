// The page's connection to its viewer: requests with answers, newest states and images, how old
// they are, reconnection.
import { keep, words } from "./dom.js";
import { differences, ofData, ofImage, ofNow, } from "./fingerprint.js";
export const pageId = (window.pageId = [...crypto.getRandomValues(new Uint8Array(12))]
    .map((b) => b.toString(16).padStart(2, "0"))
    .join(""));
export const store = {
    state: null,
    framing: null,
    across_mm: null,
    near: null,
    hello: null,
    session: null,
    twin: false,
    viewer: false,
    layers: {},
    opacity: 1,
    image: null,
    recorded: null,
    hidden: false,
    received: { state: 0, image: 0 },
    age: 0,
    fresh: null,
    now: null,
    imageAge: 0,
    imageDiffers: [],
    job: null,
    refused: null,
    problem: null,
    coneVec: null,
    drawn: false,
};
// Older than OLD_S, what is shown is said to be old; after SILENT_S nobody waits for answers any
// more.
export const OLD_S = 1;
const SILENT_S = Number(new URLSearchParams(location.search).get("patience") ?? 5);
const LOOK_MS = 200;
const REST_MS = 500;
const TRY_AGAIN = 1013;
const listeners = {};
const waiting = new Map();
// Why a request was refused; code 0: nobody answered it.
export class Failure extends Error {
    code;
    data;
    constructor(code, message, data) {
        super(message);
        this.code = code;
        this.data = data;
    }
}
let socket = null;
let nextId = 1;
let pause = 200;
export function on(what, f) {
    (listeners[what] ??= []).push(f);
}
export function emit(what, ...args) {
    for (const f of listeners[what] ?? [])
        f(...args);
}
export function call(method, params = {}) {
    return new Promise((resolve, reject) => {
        if (!socket || socket.readyState !== WebSocket.OPEN) {
            reject(new Failure(0, "no connection to the viewer"));
            return;
        }
        const id = nextId++;
        waiting.set(id, { resolve, reject, since: performance.now() });
        socket.send(JSON.stringify({ id, method, params }));
    });
}
// A command of a person: what goes wrong becomes a note, whose title may depend on the error.
export async function command(method, params = {}, title = "Refused") {
    try {
        return await call(method, params);
    }
    catch (error) {
        emit("note", "error", typeof title === "function" ? title(error) : title, words(error));
        return null;
    }
}
// Who is there: kept in this browser, and told to the twin with each connection.
const PERSON = "flexdt-person";
export const person = () => localStorage.getItem(PERSON) ?? "";
export function rename(name) {
    keep(PERSON, name.trim());
    socket?.close();
}
export function connect() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    socket = new WebSocket(`${scheme}://${location.host}/ws/${pageId}?person=${encodeURIComponent(person())}`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
        store.viewer = true;
        parts = [];
        heard = least = null;
        emit("connection");
        emit("open");
    };
    socket.onmessage = (event) => {
        if (typeof event.data === "string")
            text(event.data);
        else
            part(event.data);
    };
    socket.onclose = (event) => {
        const was = store.viewer || event.code === TRY_AGAIN;
        store.refused = event.code === TRY_AGAIN ? event.reason : null;
        store.viewer = false;
        store.twin = false;
        store.session = null;
        for (const { reject } of waiting.values())
            reject(new Failure(0, "the viewer has gone"));
        waiting.clear();
        if (was)
            emit("connection");
        setTimeout(connect, pause);
        pause = Math.min(2 * pause, 2000);
    };
}
const handlers = {
    answer(m) {
        const w = waiting.get(m.id);
        waiting.delete(m.id);
        if (m.error)
            w?.reject(new Failure(m.error.code, m.error.message, m.error.data));
        else
            w?.resolve(m.result);
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
        if (store.state)
            store.now = ofNow(store.state, store.coneVec, store.hello);
        emit("connection");
    },
    session(m) {
        store.session = m.session;
        emit("connection");
        if (m.connected)
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
    beat(m) {
        heard = { at: performance.now(), late: late(m.at), silent: m.silent_s };
        look();
    },
};
function text(content) {
    const m = JSON.parse(content);
    if (m.type in handlers)
        handlers[m.type](m);
}
// How old what is shown is: since the last heartbeat of the viewer, what that one took, and how
// long the twin has told the viewer nothing. Of the two clocks' difference the least one seen
// stands for no delay; it may grow by the error of clocks.
const DRIFT = 1e-4;
let heard = null;
let least = null;
function late(sent) {
    const now = performance.now() / 1000;
    least =
        least === null
            ? { lag: now - sent, at: now }
            : { lag: Math.min(now - sent, least.lag + DRIFT * (now - least.at)), at: now };
    return now - sent - least.lag;
}
let differs = null;
// What an image that the page has was made of.
export function imageMade(image) {
    const { recorded } = image;
    if (recorded)
        return ofData(recorded.name, recorded.index);
    return ofImage(image.origin, image.cone_vec, image.twin);
}
function look() {
    const now = performance.now();
    const own = delay(now) / 1000;
    const age = heard === null ? 0 : (now - heard.at) / 1000 + heard.late + heard.silent;
    store.age = Math.max(0, age - own);
    store.fresh = store.age > OLD_S ? null : (store.fresh ?? now);
    // An image of other things than the state's is old, once none has come for a while.
    const image = store.image;
    store.imageDiffers = image && store.now ? differences(imageMade(image), store.now) : [];
    const apart = image && store.imageDiffers.length && !image.recorded ? image : null;
    differs = apart ? (differs ?? now) : null;
    const waited = apart && differs !== null ? (now - Math.max(differs, apart.at_ms)) / 1000 : 0;
    store.imageAge = Math.max(0, waited - own);
    emit("age");
}
// A page that itself stood still (much to draw, a laptop asleep) first reads what has come
// meanwhile: the longest delay of its own within REST_MS is no silence of the viewer.
let looked = performance.now();
let longest = { ms: 0, at: -Infinity };
function delay(now) {
    const due = now - looked - LOOK_MS;
    return Math.max(0, due, now - longest.at < REST_MS ? longest.ms : 0);
}
setInterval(() => {
    const now = performance.now();
    const due = now - looked - LOOK_MS;
    if (due >= delay(now))
        longest = { ms: due, at: now };
    looked = now;
    look();
    if (store.age <= SILENT_S)
        return;
    for (const [id, w] of waiting)
        if (now - w.since > 1000 * SILENT_S) {
            waiting.delete(id);
            w.reject(new Failure(0, `no answer for ${SILENT_S} s; it may still take effect`));
        }
}, LOOK_MS);
// What is acknowledged makes room for the next: so nothing old waits in sockets.
function took(slot) {
    if (socket?.readyState === WebSocket.OPEN)
        socket.send(`{"took":"${slot}"}`);
}
let parts = [];
function part(buffer) {
    took("image");
    const bytes = new Uint8Array(buffer);
    parts.push(bytes.subarray(1));
    if (bytes[0] === 0)
        return;
    const whole = new Uint8Array(parts.reduce((n, p) => n + p.length, 0));
    parts.reduce((n, p) => {
        whole.set(p, n);
        return n + p.length;
    }, 0);
    parts = [];
    void image(whole);
}
const decoders = {
    async jpeg(body, [rows, cols]) {
        const picture = await createImageBitmap(new Blob([body], { type: "image/jpeg" }));
        const canvas = new OffscreenCanvas(cols, rows);
        const context = canvas.getContext("2d", { willReadFrequently: true });
        if (!context)
            throw new Error("this browser draws nothing");
        context.drawImage(picture, 0, 0);
        const { data } = context.getImageData(0, 0, cols, rows);
        const pixels = new Uint16Array(rows * cols);
        for (let k = 0; k < pixels.length; k++)
            pixels[k] = 257 * data[4 * k];
        return pixels;
    },
    // Differences from column to column, low bytes before high ones.
    async deflate(body, [, cols]) {
        const planes = new Uint8Array(await new Response(new Blob([body]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
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
async function image(whole) {
    const number = ++arrived;
    const size = new DataView(whole.buffer).getUint32(4, true);
    const head = JSON.parse(new TextDecoder().decode(whole.subarray(8, 8 + size)));
    const at_ms = performance.now();
    const all = await decoders[head.code](whole.subarray(8 + size), head.shape);
    const n = all.length / 2;
    const got = head.pair
        ? { ...head, at_ms, pixels: all.subarray(0, n), virtual: all.subarray(n) }
        : { ...head, at_ms, pixels: all };
    if (number < unpacked)
        return; // a newer one was quicker
    unpacked = number;
    // Neither a live image while a data set is open, nor the other way round.
    if ((head.recorded?.name ?? null) !== store.recorded || store.hidden)
        return;
    store.image = got;
    store.received.image++;
    emit("image", got);
}
