// What the page's pure modules compute, as browsers get them; run by tests/viewer/test_page_units.py.
import assert from "node:assert/strict";
import { test } from "node:test";
import { beliefWords } from "../../data/belief.js";
import { decades } from "../../data/decades.js";
import { estimates } from "../../data/estimate.js";
import { beamWords, rating } from "../../data/image_words.js";
import * as figures from "../../data/figures.js";
import * as fp from "../../data/fingerprint.js";
import * as job from "../../data/job_words.js";
import * as meshes from "../../data/mesh_extent.js";
import * as moments from "../../data/moment.js";
import * as names from "../../data/names.js";
import { reached } from "../../data/reached.js";
import { across, outline } from "../../data/sample_outline.js";
import * as signals from "../../data/signals.js";
import { BY_HAND, STEP, stepOf } from "../../data/story_steps.js";

let seed = 20261127;
const random = () => {
  seed = (seed * 48271) % 2147483647;
  return seed / 2147483647;
};
const pick = (some) => some[Math.floor(random() * some.length)];

// A state, and what the twin says of an image of it: written down here, not by the page.
function drawn() {
  const lit = random() < 0.5;
  const offset = { x: 1.5, y: 0, z: 0, rx: 0, ry: 0, rz: 0 };
  const state = {
    sample: { name: "lego", revision: null, material: "abs", offset },
    tube: { on: lit, ready: true, kV: 90, power_W: 20 },
    camera: { mode: "HW2SW1High", roi: [32, 8, 1943, 1527], exposure_ms: 100, averages: 1 },
    correction: null,
    geometry: { SOD_mm: 500, SDD_mm: 900 },
    axes: {
      rot_obj: { position: 10, virtual: false },
      mag: { position: 1, virtual: true },
    },
  };
  const origin = {
    sample: "lego", revision: null, material: "abs", offset: { ...offset }, lit, kV: 90,
    power_W: 20, mode: "HW2SW1High", exposure_ms: 100, averages: 1, roi: [32, 8, 1943, 1527],
    correction: null,
  };
  return { state, origin, cone: [0, -500, 0, 0, 400, 0, 0.1, 0, 0, 0, 0, 0.1] };
}
const HELLO = { instance: "a", machine: "flexray", profile: "cwi" };
const CHANGES = {
  sample: (s) => { s.sample.name = "square"; },
  "sample's content": (s) => { s.sample.revision = "2"; },
  placement: (s) => { s.sample.offset.rz = 3; },
  lit: (s) => { s.tube.on = !s.tube.on; },
  tube: (s) => { s.tube.kV = 91; },
  camera: (s) => { s.camera.roi = [0, 8, 1943, 1527]; },
  exposure: (s) => { s.camera.exposure_ms = 100.5; },
  correction: (s) => { s.correction = { name: "c" }; },
  pose: (s, cone) => { cone[4] += 0.01; },
};
const QUANTITY = { "sample's content": "sample", exposure: "camera" };

test("an image is of now until something that it was made of is another", () => {
  for (let k = 0; k < 300; k++) {
    const { state, origin, cone } = drawn();
    const image = fp.ofImage(origin, [...cone], "a");
    const changed = Object.keys(CHANGES).filter(() => random() < 0.25);
    for (const name of changed) CHANGES[name](state, cone);
    const twin = pick(["a", "b"]);
    const wanted = new Set(changed.map((name) => QUANTITY[name] ?? name));
    if (twin === "b") wanted.add("twin");
    const now = fp.ofNow(state, cone, { ...HELLO, instance: twin });
    assert.deepEqual(new Set(fp.differences(image, now)), wanted);
    assert.equal(fp.about(image, now).kind, wanted.size ? "old" : "now");
  }
});

test("a thing is compared in what it was made of alone", () => {
  const { state, cone } = drawn();
  const now = fp.ofNow(state, cone, HELLO);
  const report = fp.only(now, "sample", "motors");
  state.tube.kV = 40;
  assert.deepEqual(fp.differences(report, fp.ofNow(state, cone, HELLO)), []);
  state.axes.rot_obj.position = 10.004;
  assert.deepEqual(fp.differences(report, fp.ofNow(state, cone, HELLO)), []);
  state.axes.rot_obj.position = 10.02;
  assert.deepEqual(fp.differences(report, fp.ofNow(state, cone, HELLO)), ["motors"]);
});

test("what is of a data set is never of now", () => {
  const { state, cone } = drawn();
  const now = fp.ofNow(state, cone, HELLO);
  const about = fp.about(fp.ofData("scan-3", 4, "scan_000002"), now);
  assert.equal(fp.heading("Geometry", about), "Geometry of scan-3, scan_000002");
  assert.equal(fp.heading("Geometry", fp.about(fp.ofData("scan-3"), now)), "Geometry of scan-3");
  assert.equal(fp.heading("Geometry", fp.about({}, now)), "Geometry now");
  assert.deepEqual(fp.differences(fp.ofData("scan-3", 4), now), ["dataset"]);
});

test("a twin that has not introduced itself is not another one", () => {
  const { state, origin, cone } = drawn();
  const image = fp.ofImage(origin, cone, "a");
  assert.deepEqual(fp.differences(image, fp.ofNow(state, cone, null)), []);
});

test("quantities are listed in words", () => {
  assert.equal(fp.listed([]), "");
  assert.equal(fp.listed(["pose"]), "pose");
  assert.equal(fp.listed(["sample", "tube", "pose"]), "sample, tube setting and pose");
});

test("a signal runs what has read it, once a batch, and what has not read it never", () => {
  const a = signals.signal(1);
  const b = signals.signal(10);
  const seen = [];
  const sum = signals.computed(() => a.get() + b.get());
  const end = signals.effect(() => seen.push(sum.get()));
  signals.batch(() => {
    a.set(2);
    b.set(20);
  });
  a.set(2);
  assert.deepEqual(seen, [11, 22]);
  end();
  a.set(3);
  assert.deepEqual(seen, [11, 22]);
  assert.equal(sum.get(), 23);
  let runs = 0;
  const chosen = signals.signal(true);
  signals.effect(() => {
    runs++;
    if (chosen.get()) a.get();
  });
  chosen.set(false);
  a.set(4);
  assert.equal(runs, 2);
});

// A sample outside, cut or inside, by rays to the corners of its box at many angles.
function byRays({ size_mm: [sx, sy, sz], offset }, g, c) {
  const columns = [];
  const rows = [];
  for (let k = 0; k < 180; k++) {
    const turn = (k * Math.PI) / 90;
    for (const x of [-sx / 2, sx / 2]) for (const y of [-sy / 2, sy / 2]) for (const z of [-sz / 2, sz / 2]) {
      const [px, py] = [x + offset.x, y + offset.y];
      const across = px * Math.cos(turn) - py * Math.sin(turn);
      const depth = g.SOD_mm + px * Math.sin(turn) + py * Math.cos(turn);
      columns.push(g.axis_column_px + (across * g.SDD_mm) / depth / c.pixel_mm);
      rows.push(g.piercing_point_px[1] - ((z + offset.z) * g.SDD_mm) / depth / c.pixel_mm);
    }
  }
  const ends = (all) => [Math.min(...all), Math.max(...all)];
  return { columns: ends(columns), rows: ends(rows) };
}

test("a sample is inside, cut or outside as the rays to its corners say", () => {
  const seen = { inside: 0, cut: 0, outside: 0 };
  for (let k = 0; k < 160; k++) {
    const side = 5 + 30 * random();
    const sample = {
      size_mm: [side, side, 5 + 40 * random()],
      offset: { x: 4 * random(), y: 4 * random(), z: 20 * (random() - 0.5), rx: 0, ry: 0, rz: 0 },
    };
    const c = { shape: [760, 956], pixel_mm: 0.1496 };
    const g = {
      SOD_mm: 400, SDD_mm: 800, magnification: 2,
      axis_column_px: 478 + 2400 * (random() - 0.5) * random(),
      piercing_point_px: [478, 380 + 900 * (random() - 0.5) * random()],
    };
    const said = outline(sample, g, c, 0).join();
    const { columns, rows } = byRays(sample, g, c);
    const margin = 12; // the cylinder that holds the box is a little larger
    const apart = columns[1] < -margin || columns[0] > 956 + margin || rows[1] < -margin || rows[0] > 760 + margin;
    const inside = columns[0] > margin && columns[1] < 956 - margin && rows[0] > margin && rows[1] < 760 - margin;
    const crosses = columns[0] < -margin || columns[1] > 956 + margin || rows[0] < -margin || rows[1] > 760 + margin;
    if (apart) { assert.equal(said, "Sample is outside the image"); seen.outside++; }
    else if (inside) { assert.equal(said, ""); seen.inside++; }
    else if (crosses && columns[1] > margin && columns[0] < 956 - margin && rows[1] > margin && rows[0] < 760 - margin) {
      assert.match(said, /^Sample cut off/); seen.cut++;
    }
  }
  for (const count of Object.values(seen)) assert.ok(count > 4, JSON.stringify(seen));
});

test("a sample's shape, where it is known, decides how wide it turns, and never widens it", () => {
  const offset = { x: 0, y: 0, z: 0, rx: 0, ry: 0, rz: 0 };
  for (let k = 0; k < 100; k++) {
    const size_mm = [1, 2, 3].map(() => 1 + 50 * random());
    const box = Math.hypot(size_mm[0], size_mm[1]);
    const shape = box * 1.5 * random();
    const sample = { size_mm, offset };
    assert.equal(across(sample, null), box);
    assert.equal(across(sample, shape), Math.min(box, shape));
    const tilted = { size_mm, offset: { ...offset, rx: 5 } };
    assert.equal(across(tilted, shape), Math.hypot(...size_mm));
  }
  // A wheel whose box's corners turn outside the image, and its rim within it.
  const size_mm = [40, 40, 30];
  const g = {
    SOD_mm: 380, SDD_mm: 1000, magnification: 2.63, axis_column_px: 477.5,
    piercing_point_px: [477.5, 379.5],
  };
  const camera = { pixel_mm: 0.1496, shape: [760, 956] };
  assert.match(outline({ size_mm, offset }, g, camera, 0).join(), /at the sides/);
  assert.deepEqual(outline({ size_mm, offset }, g, camera, 0, 40), []);
});

test("a scan's end names who asked and what stands elsewhere", () => {
  const axes = {
    rot_obj: { position: 123.456, moving: false, unit: "deg" },
    mag_obj: { position: 600, moving: false, unit: "mm" },
  };
  const ended = {
    job: "job-1", state: "aborted", ended_by: "Anna #3", start: { rot_obj: 0, mag_obj: 600 },
    error: null, frames_done: 4, frames_total: 8, elapsed_s: 61, speed_up: 1, line: null, what: "",
  };
  const state = { axes, tube: { on: false }, projector: null };
  assert.equal(job.stateWords(ended, (name) => name.slice(0, 4)), "aborted by Anna");
  assert.equal(job.stateWords(ended, () => "you"), "aborted by you");
  assert.equal(job.whatWords(ended, state), "X-rays are off · rot_obj at 123.46°, began at 0.00°");
  assert.deepEqual(job.moved(ended, axes), [{ motor: "rot_obj", now: 123.456, start: 0 }]);
  assert.equal(job.timeLeft(ended, null), "1 min 01 s");
  const runs = { ...ended, state: "running", ended_by: null, remaining_s: 30, real_time_factor: 10 };
  assert.equal(job.timeLeft(runs, 3), "3 s left");
  assert.equal(job.timeLeft(runs, null), "");
  assert.equal(job.whatWords(runs, { ...state, projector: "no projector" }), "waits: no projector");
  assert.equal(job.isUnfinished({ state: "done" }), false);
  for (const end of ["failed", "aborted", "incomplete"]) assert.ok(job.isUnfinished({ ...ended, state: end }));
});

// A queue that runs, loses and ends jobs, kept here as events; a job begins with its first event
// of running, and what is said of each must be what has happened to it.
test("what is said of a job is what has happened to it", () => {
  const seen = { begins: 0, waits: 0, off: 0 };
  for (let history = 0; history < 200; history++) {
    const jobs = [];
    const happened = new Map();
    for (let k = 0; k < 12; k++) {
      const what = pick(["submit", "submit", "next", "take", "end"]);
      const runs = jobs.find((one) => one.state === "running");
      const waiting = jobs.filter((one) => one.state === "queued");
      if (what === "submit") {
        jobs.push({ job: `job-${jobs.length + 1}`, name: `scan-${jobs.length + 1}`, state: "queued",
          start: null, frames_done: 0, frames_total: 9, elapsed_s: 0, ended_by: null, error: null });
        const mine = jobs.at(-1);
        happened.set(mine, "waits");
        const ahead = waiting.length + (runs ? 1 : 0);
        const told = job.submittedWords(mine.job, jobs);
        assert.equal(told, ahead ? `${mine.name} waits: ${ahead} before it` : `${mine.name} begins`);
        seen[ahead ? "waits" : "begins"] += 1;
      } else if (what === "next" && !runs && waiting.length) {
        Object.assign(waiting[0], { state: "running", start: { rot_obj: 0 } });
        happened.set(waiting[0], "began");
      } else if (what === "take" && waiting.length) {
        const one = pick(waiting);
        Object.assign(one, { state: "aborted", ended_by: "Anna #1" });
        happened.set(one, "taken off");
      } else if (what === "end" && runs) {
        Object.assign(runs, { state: pick(["done", "aborted"]), ended_by: "Anna #1" });
      }
    }
    const state = { axes: { rot_obj: { position: 405, unit: "deg" } }, tube: { on: false } };
    for (const one of jobs.filter((each) => ["done", "aborted"].includes(each.state))) {
      const never = happened.get(one) === "taken off";
      seen.off += never;
      assert.equal(job.neverBegan(one), never);
      assert.equal(job.isUnfinished(one), !never && one.state === "aborted");
      assert.equal(/taken off/.test(job.stateWords(one, String)), never);
      assert.ok(!/stands where it began/.test(job.whatWords(one, state)));
      assert.equal(job.whatWords(one, state).includes("began at 0.00"), !never && one.state === "aborted");
    }
  }
  for (const count of Object.values(seen)) assert.ok(count > 50, JSON.stringify(seen));
});

test("names cannot turn the text about them around", () => {
  for (const mark of ["\u202e", "\u202d", "\u2066", "\u200f", "\u061c"]) {
    assert.equal(names.plain(`a${mark}b`), "a\ufffdb");
    assert.equal(names.sampleName(`cube${mark}lts.exe.stl`, []), "cubelts.exe");
  }
  assert.equal(names.plain("äöü 試料 שלום"), "äöü 試料 שלום");
  assert.equal(names.sampleName("a/b.stl", ["a-b"]), "a-b-1");
});

test("numbers are read as people write them", () => {
  const said = { "1,5": 1.5, "−2": -2, " 3.25 ": 3.25, "1e3": 1000 };
  for (const [text, value] of Object.entries(said)) assert.equal(figures.parsed(text), value);
  for (const text of ["", "abc", "1 2", "0x10", "--1"]) assert.ok(Number.isNaN(figures.parsed(text)));
  assert.equal(figures.fixed(-0.001), "0.00");
  assert.equal(figures.seconds(3661), "1 h 01 min");
  assert.equal(figures.bytes(65_000_000), "65.0 MB");
});

// A box as a file of a format, written here.
function boxFile(format, [x, y, z], [ox, oy, oz]) {
  const corners = [];
  for (const i of [0, 1]) for (const j of [0, 1]) for (const k of [0, 1]) {
    corners.push([ox + i * x, oy + j * y, oz + k * z]);
  }
  if (format === "obj") return new TextEncoder().encode(corners.map((c) => `v ${c.join(" ")}`).join("\n"));
  if (format === "off") {
    const lines = ["OFF", "# a box", "8 0 0", ...corners.map((c) => c.join(" "))];
    return new TextEncoder().encode(lines.join("\n"));
  }
  if (format === "ascii stl") {
    const vertices = corners.map((c) => `      vertex ${c.map((v) => v.toExponential(6)).join(" ")}`);
    return new TextEncoder().encode(`solid box\n${vertices.join("\n")}\nendsolid\n`);
  }
  const data = new ArrayBuffer(84 + 50 * 8);
  const view = new DataView(data);
  view.setUint32(80, 8, true);
  corners.forEach((c, n) => {
    for (let corner = 0; corner < 3; corner++) {
      c.forEach((v, k) => view.setFloat32(84 + 50 * n + 12 + 12 * corner + 4 * k, v, true));
    }
  });
  return new Uint8Array(data);
}

test("the size of a mesh is read from its file", () => {
  for (let k = 0; k < 40; k++) {
    const size = [1, 2, 3].map(() => 0.1 + 50 * random());
    const place = [1, 2, 3].map(() => 100 * (random() - 0.5));
    for (const format of ["obj", "off", "ascii stl", "stl"]) {
      const file = boxFile(format, size, place);
      const ending = format.split(" ").pop();
      const buffer = file.buffer.slice(file.byteOffset, file.byteOffset + file.byteLength);
      const found = meshes.meshExtent(buffer, ending);
      found.forEach((v, i) => assert.ok(Math.abs(v - size[i]) < 1e-4, `${format} ${found} ${size}`));
    }
  }
  const noise = Uint8Array.from({ length: 500 }, () => 256 * random()).buffer;
  for (const format of ["stl", "obj", "off", "glb", "ply"]) {
    assert.equal(meshes.meshExtent(noise, format), null);
    assert.equal(meshes.meshExtent(new ArrayBuffer(0), format), null);
  }
});

test("an absurd size is called that, and a usual one is not", () => {
  assert.match(meshes.absurd([0.001, 0.001, 0.001], 0.04, 500), /1 µm, 0.025 voxels/);
  assert.match(meshes.absurd([3000, 2000, 4000], 0.04, 500), /2 m, beyond the source/);
  for (const mm of [1, 10, 60, 200]) assert.equal(meshes.absurd([mm, mm, mm], 0.04, 500), "");
});

test("a histogram over decades has each share where its values lie", () => {
  for (let k = 0; k < 100; k++) {
    const values = Array.from({ length: 200 }, () => 10 ** (-5 * random() ** 2) * 1.3);
    const edges = [0, ...Array.from({ length: 41 }, (_, i) => 10 ** (-3.95 + 0.1 * i))];
    const ends = [...edges.slice(1), Infinity];
    const shares = edges.map(
      (low, i) => values.filter((v) => v >= low && v < ends[i]).length / values.length,
    );
    const { counts, range: [low, high] } = decades({ edges, shares });
    const step = (high - low) / counts.length;
    counts.forEach((share, i) => {
      const from = i === 0 ? 0 : 10 ** (low + i * step) * (1 + 1e-9);
      const to = i === counts.length - 1 ? Infinity : 10 ** (low + (i + 1) * step) * (1 - 1e-9);
      const inside = values.filter((v) => v > from && v < to).length / values.length;
      assert.ok(Math.abs(share - inside) < 1e-9, `${i}: ${share}, not ${inside}`);
    });
  }
});

test("a belief that the beads contradict is called wrong, and one that they do not is not", () => {
  for (let k = 0; k < 300; k++) {
    const value = 4 * random() - 2;
    const sigma = 0.01 + random();
    const off = 8 * random() - 4;
    if (Math.abs(Math.abs(off) - 3) < 0.06) continue;
    const words = beliefWords("axis aside", "mm", value + off * sigma, { value, sigma });
    assert.equal(words.includes("the slider was wrong"), Math.abs(off) > 3, words);
    assert.equal(words.includes("the slider agrees"), Math.abs(off) < 3, words);
    const sigmas = Number(/([\d.]+) sigmas/.exec(words)[1]);
    assert.ok(Math.abs(sigmas - Math.abs(off)) < 0.051, words);
  }
  const none = beliefWords("panel tilted", "°", 1, undefined);
  assert.match(none, /the slider said 1\.00 °; the beads do not tell it/);
});

// The story beside what others do to the corrections: a stack of those in force, as the twin has
// it. Each step is offered only while its geometry is in force.
test("a step of the story is one of the correction in force", () => {
  const seen = new Set();
  for (let history = 0; history < 300; history++) {
    const inForce = [];
    let known = { believed: {}, found: null, rms: [] };
    for (let k = 0; k < 25; k++) {
      const now = inForce.at(-1) ?? null;
      const at = stepOf(known, now);
      const what = pick(["go on", "go on", "go on", "undo", "another"]);
      if (what === "undo") inForce.pop();
      else if (what === "another") {
        const parameters = { dO_x: pick([0.5, 0.25]) };
        inForce.push({ comment: pick([BY_HAND, "of the bench"]), parameters });
      } else if (at === STEP.misalign || at === STEP.end) {
        known = { believed: { dO_x: 0.5 + random(), det_roll: 0 }, found: null, rms: [] };
        inForce.push({ comment: BY_HAND, parameters: { dO_x: known.believed.dO_x } });
        assert.equal(stepOf(known, inForce.at(-1)), STEP.scan);
      } else if (at === STEP.scan) {
        known = { believed: { ...now.parameters }, found: null, rms: [0.01] };
        assert.equal(stepOf(known, now), STEP.calibrate);
      } else if (at === STEP.calibrate) {
        known.found = { correction: { dO_x: 0.001 * random() } };
        assert.equal(stepOf(known, now), STEP.apply);
      } else if (at === STEP.apply) {
        inForce.push({ comment: "after a story", parameters: { ...known.found.correction } });
        const next = known.rms.length > 1 ? STEP.end : STEP.again;
        assert.equal(stepOf(known, inForce.at(-1)), next);
      } else {
        known.rms.push(0.002);
        assert.equal(stepOf(known, now), STEP.end);
      }
      const stands = inForce.at(-1) ?? null;
      const told = stepOf(known, stands);
      seen.add(told);
      const wrong = [STEP.scan, STEP.calibrate, STEP.apply].includes(told);
      assert.equal(wrong, stands?.comment === BY_HAND);
      if (told === STEP.again || told === STEP.end)
        assert.deepEqual(stands.parameters, known.found.correction);
      if (!stands) assert.equal(told, STEP.misalign);
    }
  }
  assert.deepEqual([...seen].sort(), [0, 1, 2, 3, 4, 5]);
});

test("the reader's own session is called you, and nobody else's", () => {
  const told = names.toYou("E-stop by a visitor #8", "a visitor #8");
  assert.equal(told, "E-stop by you");
  assert.equal(names.toYou("E-stop by a visitor #81", "a visitor #8"), "E-stop by a visitor #81");
  assert.equal(names.toYou("E-stop by A+B. #3", "A+B. #3"), "E-stop by you");
  assert.equal(names.toYou("E-stop by Anna #2", null), "E-stop by Anna #2");
});

// A machine that turns, stands and is changed, whose images come late: an image is called old if
// and only if it has not been true for longer than a second of the twin's clock, by a record of
// the drawn history that the page does not see.
test("an image's age is how long it has not been true, by the twin's clock", () => {
  for (let history = 0; history < 300; history++) {
    const told = [];
    let pose = 0;
    let time = 10 * random();
    const age = moments.aging();
    let image = null;
    let waiting = [];
    for (let k = 0; k < 60; k++) {
      time += 2 * random();
      if (random() < 0.5) pose += 1;
      told.push({ time, pose });
      waiting.push({ time_s: time, made: { pose: [pose] }, due: k + Math.floor(4 * random()) });
      for (const one of waiting.filter((each) => each.due <= k)) {
        if (!image || one.time_s > image.time_s) image = one;
      }
      waiting = waiting.filter((each) => each.due > k);
      if (!image) continue;
      const now = time + random();
      const since_s = 2 * random();
      const present = { made: { pose: [pose] }, told_s: time, time_s: now, since_s };
      const { age_s, differ } = age(image, present);
      const true_s = Math.max(
        image.time_s,
        ...told.filter((t) => t.pose === image.made.pose[0]).map((t) => t.time),
      );
      const fits = image.made.pose[0] === pose;
      assert.equal(differ.length, fits ? 0 : 1);
      // Seen only while it was shown: never younger than it is, and old only where it is.
      // A state speaks for a second of ours.
      const spoken = since_s > moments.OLD_S ? since_s : 0;
      assert.ok(fits ? age_s === spoken : age_s >= now - true_s - 1e-9);
      assert.ok(fits || age_s <= now - image.time_s + 1e-9);
    }
  }
});

test("another run of the twin has no age, and what belongs nowhere is not shown", () => {
  const present = { made: { twin: "b" }, told_s: 1, time_s: 1, since_s: 0 };
  assert.equal(moments.aging()({ made: { twin: "a" }, time_s: 900 }, present).age_s, Infinity);
  const live = { dataset: null };
  const five = { dataset: "x", frame: 5 };
  const open = { kind: "image", dataset: "x", index: 5, missing: false };
  const cases = [
    [live, moments.NOW, true], [live, { kind: "plan", time_s: 3 }, true], [live, open, false],
    [five, moments.NOW, false], [five, open, true], [five, { ...open, dataset: "y" }, false],
    [five, { ...open, index: 6 }, true], [five, { ...open, index: 6, missing: true }, false],
  ];
  for (const [made, moment, wanted] of cases) assert.equal(moments.belongs(made, moment), wanted);
  assert.equal(moments.clockNow({ time_s: 5, speed_up: 8, real_time_factor: null }, 0.5), 9);
  assert.equal(moments.clockNow({ time_s: 5, speed_up: "max", real_time_factor: 20 }, 0.5), 15);
});

test("an image is found by the name of its file, also between those that were told", () => {
  const all = [
    ...Array.from({ length: 3 }, (_, k) => `di00000${k}.tif`),
    ...Array.from({ length: 90 }, (_, k) => `scan_${String(k).padStart(6, "0")}.tif`),
    ...Array.from({ length: 3 }, (_, k) => `io00000${k}.tif`),
  ];
  for (const every of [1, 4, 13]) {
    const indices = all.map((_, k) => k).filter((k) => k % every === 0 || k === all.length - 1);
    const told = { files: indices.map((k) => all[k]), indices, images: all.length };
    all.forEach((file, k) => {
      const found = moments.indexOf(moments.nameOf(file), told);
      const known = indices.some((i) => i <= k && all[i].slice(0, 4) === file.slice(0, 4));
      assert.equal(found, known ? k : null);
    });
    if (every === 1) assert.equal(moments.indexOf("scan_000090", told), null);
    assert.equal(moments.indexOf("20", told), null);
  }
});

// Scans whose images take as long as drawn here: evenly, with slow parts, with a pause.
test("how long a scan takes is said only where it is nearly right", () => {
  const even = { said: 0, off: 0 };
  const uneven = { said: 0, off: 0 };
  const always = { said: 0, off: 0 }; // of uneven ones, by the mean so far
  for (let scan = 0; scan < 300; scan++) {
    const left = estimates();
    const total = 40 + Math.floor(200 * random());
    const slow = random() < 0.5 ? 1 + 9 * random() : 1;
    const from = random();
    const kind = slow > 1 ? uneven : even;
    const times = Array.from({ length: total }, (_, k) => {
      const share = k / total;
      return (0.8 + 0.4 * random()) * (share > from && share < from + 0.3 ? slow : 1);
    });
    const ends = times.reduce((all, t) => [...all, (all.at(-1) ?? 0) + t], []);
    ends.forEach((now, k) => {
      const status = { job: "a", state: "running", frames_done: k + 1, frames_total: total,
        elapsed_s: 0, remaining_s: 1, speed_up: "max" };
      const true_s = ends.at(-1) - now;
      const wrong = (told) => Math.abs(told - true_s) > 2 + 0.5 * true_s;
      if (slow > 1) {
        always.said += 1;
        always.off += wrong((now / (k + 1)) * (total - k - 1));
      }
      const told = left(status, now);
      if (told === null) return;
      kind.said += 1;
      kind.off += wrong(told);
    });
  }
  const share = ({ said, off }) => off / said;
  assert.ok(even.said > 150 * 60 && share(even) === 0, JSON.stringify(even));
  const told = JSON.stringify([uneven, always]);
  assert.ok(uneven.said > 150 * 20 && uneven.off < 0.6 * always.off, told);
});

// Scans at a pace of the twin's clock, whose status stands still within each step: a way to the
// flat image, darks, images; a twin that keeps its pace, and one that falls behind from some step.
test("how long a scan at a pace takes is said from the first second, while the twin keeps it", () => {
  const kept = { said: 0, asked: 0, off: 0 };
  const late = { said: 0, off: 0, plan: 0 };
  for (let scan = 0; scan < 300; scan++) {
    const left = estimates();
    const speed_up = pick([1, 8, 60]);
    const steps = [10, 3, 12, ...Array.from({ length: 30 + Math.floor(60 * random()) }, () => 0.4)]
      .map((s) => s * (0.5 + random()) * speed_up);
    const whole = steps.reduce((all, s) => all + s, 0);
    const slow = scan % 2 ? 1 : 2 + 3 * random();
    const from = Math.floor(0.7 * steps.length * random());
    const took = steps.map((s, k) => (s / speed_up) * (k < from ? 1 : slow));
    const end_s = took.reduce((all, s) => all + s, 0);
    let elapsed_s = 0;
    let now = 0;
    steps.forEach((step, k) => {
      const until = now + took[k];
      for (; now < until; now = Math.min(until, now + 0.5)) {
        const status = { job: "a", state: "running", frames_done: Math.max(0, k - 3),
          frames_total: steps.length - 3, elapsed_s, remaining_s: whole - elapsed_s, speed_up };
        const told = left(status, now);
        const true_s = end_s - now;
        const wrong = (words) => Math.abs(words - true_s) > 2 + 0.5 * true_s;
        if (slow === 1) {
          kept.asked += 1;
          kept.said += told !== null;
          kept.off += told !== null && wrong(told);
        } else {
          late.said += told !== null;
          late.off += told !== null && wrong(told);
          late.plan += wrong((whole - elapsed_s) / speed_up);
        }
      }
      elapsed_s += step;
    });
  }
  const told = JSON.stringify([kept, late]);
  assert.ok(kept.said > 0.98 * kept.asked && kept.off === 0, told);
  assert.ok(late.off < 0.6 * late.plan, told);
});

test("what is said of the beam is of the image, and of the tube only what the image lacks", () => {
  const tubes = [{ on: false, ready: false }, { on: true, ready: false }, { on: true, ready: true }];
  for (const lit of [true, false]) for (const counts of [true, false]) for (const tube of tubes) {
    const said = beamWords({ lit, counts }, tube, 0);
    assert.equal(said === "", lit);
    assert.equal(said.includes("X-rays off"), !lit && !tube.on); // as the bar says
    assert.equal(said.includes("warming up"), !lit && tube.on && !tube.ready);
  }
  assert.match(beamWords({ lit: true, counts: false }, tubes[2], 0.0123), /^1\.2 % saturated/);
  assert.equal(beamWords({ lit: true, counts: true }, tubes[2], 0.5), "");
});

test("images are counted when they come, not when they are drawn, and not while they are old", () => {
  const rate = rating();
  const image = {};
  for (let ms = 0; ms < 4000; ms += 50) assert.equal(rate(image, ms, 0), "");
  let said = "";
  for (let ms = 4000; ms < 8000; ms += 100) {
    const fresh = ms % 200 === 0 ? {} : null;
    said = fresh ? rate(fresh, ms, 0) : said;
  }
  assert.equal(said, "5 images/s");
  const last = {};
  assert.equal(rate(last, 8000, 3), "");
  assert.equal(rate(last, 8100, 0), "5 images/s");
  assert.equal(rate(last, 10200, 0), "");
});

test("where motors halt is told in the quantity that was typed", () => {
  for (let k = 0; k < 300; k++) {
    const sod = 100 + 500 * random();
    const sdd = sod + 100 + 500 * random();
    const by = 90 * (random() - 0.5);
    const pitch = 0.1496;
    const voxel = (1000 * pitch * sod) / sdd;
    const cases = [
      [sod, (v) => v - sod, sod + by],
      [sdd, (v) => v - sdd, sdd + by],
      [sdd / sod, (v) => sdd / v - sod, sdd / (sod + by)],
      [voxel, (v) => sod * (v / voxel - 1), (1000 * pitch * (sod + by)) / sdd],
      [12, (v) => 12 - v, 12 - by],
    ];
    for (const [now, shift, wanted] of cases)
      assert.ok(Math.abs(reached(now, by, shift) - wanted) < 1e-6 * Math.abs(wanted) + 1e-9);
  }
  assert.ok(Number.isNaN(reached(2, 5, () => 1)));
});
