// The page's connection to its viewer: requests with answers, newest states and images, reconnection.

export const pageId = [...crypto.getRandomValues(new Uint8Array(12))].map((b) => b.toString(16).padStart(2, "0")).join("");
export const store = {
  state: null, framing: null, near: null, hello: null, session: null, twin: false, viewer: false,
  layers: {}, opacity: 1, image: null, received: { state: 0, image: 0 },
};
const REST_MS = 2000, TRY_AGAIN = 1013;
const listeners = new Map();
const waiting = new Map();
let socket = null, nextId = 1, pause = 200;

export function on(what, f) { (listeners.get(what) ?? listeners.set(what, []).get(what)).push(f); }
export function emit(what, ...args) { for (const f of listeners.get(what) ?? []) f(...args); }

export function call(method, params = {}) {
  return new Promise((resolve, reject) => {
    if (!socket || socket.readyState !== WebSocket.OPEN) { reject({ code: 0, message: "no connection to the viewer" }); return; }
    const id = nextId++;
    waiting.set(id, { resolve, reject });
    socket.send(JSON.stringify({ id, method, params }));
  });
}

// A command of a person: what goes wrong becomes a note.
export async function command(method, params = {}, title = "Refused") {
  try { return await call(method, params); }
  catch (error) { emit("note", "error", title, error.message ?? String(error)); return null; }
}

export function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws/${pageId}`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { store.viewer = true; emit("connection"); emit("open"); };
  socket.onmessage = (event) => (typeof event.data === "string" ? text(JSON.parse(event.data)) : image(event.data));
  socket.onclose = (event) => {
    const was = store.viewer || event.code === TRY_AGAIN;
    store.refused = event.code === TRY_AGAIN ? event.reason : null;
    store.viewer = false; store.twin = false; store.session = null;
    for (const { reject } of waiting.values()) reject({ code: 0, message: "the viewer has gone" });
    waiting.clear();
    if (was) emit("connection");
    setTimeout(connect, pause); pause = Math.min(2 * pause, 2000);
  };
}

const handlers = {
  answer(m) {
    const w = waiting.get(m.id); waiting.delete(m.id);
    if (w) m.error ? w.reject(m.error) : w.resolve(m.result);
  },
  state(m) {
    Object.assign(store, { state: m.state, framing: m.framing, near: m.near, stateAt: m.at });
    store.received.state++; heard = performance.now();
    if (!store.twin) { store.twin = true; emit("connection"); }
    emit("state", m.state);
  },
  link(m) {
    pause = 200;
    Object.assign(store, { refused: null, twin: m.connected, problem: m.problem, cameras: m.cameras, twinAt: m.twin });
    store.hello = m.hello ?? store.hello;
    emit("connection");
  },
  session(m) { store.session = m.session; emit("connection"); if (m.connected) emit("session"); },
  layers(m) { store.layers = m.shown; store.opacity = m.opacity; emit("layers"); },
  job(m) { emit("job", m.data); },
  note(m) { emit("note", m.level, m.title, m.body); },
  log(m) { emit("log", m.data); },
};
// At rest the twin tells nothing: asked now and then, so that its clock and its pace stay true.
let heard = 0;
setInterval(async () => {
  if (!store.twin || !store.state || performance.now() - heard < REST_MS) return;
  heard = performance.now();
  const state = await call("state.get").catch(() => null);
  if (state && state.time >= store.state.time) { store.state = state; emit("state", state); }
}, 500);
function text(m) { handlers[m.type]?.(m); }

function image(buffer) {
  const view = new DataView(buffer), size = view.getUint32(4, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, size)));
  head.pixels = new Uint16Array(buffer, 8 + size);
  store.image = head; store.received.image++;
  emit("image", head);
}
