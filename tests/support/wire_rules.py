"""Several clients of one twin server, in any order, under the eye of the motion oracle.

The server is the real one, simulated (`simulation`): virtual time, one seed. The oracle looks
at what the server's scanner publishes, at any time, from one change of its motion to the next.
"""

from __future__ import annotations

import base64
import functools
import math
import shutil
import struct
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from in_process import Client, script
from motion_oracle import Placed, Prism, Stage, Violation, Watch
from motion_rules import (
    AHEAD,
    Json,
    Rng,
    draw_correction,
    draw_move,
    draw_pose,
    draw_target,
    model,
    product,
)
from simulation import Simulation

from flexdt.phantoms import Phantom, mesh_phantom
from flexdt.protocol import RpcError
from flexdt.server.storage import stored_samples as store
from flexdt.twin.errors import TwinError

SPEED_UPS = (1.0, 7.3, 60.0, 1000.0, "max")
BOXES = (
    (20, 30, 40),
    (180, 20, 30),
    (300, 20, 20),
    (90, 90, 90),
    (120, 260, 60),
    (40, 60, 220),
)
DRUMS = ((30, 40), (140, 60), (260, 30), (60, 200))
WATCHED = (
    "move",
    "jog",
    "stop",
    "estop",
    "reset",
    "place",
    "follow",
    "take_stage",
    "initialise_stage",
)
"""What changes the scanner's motion or its stage."""


def shapes() -> dict[str, Prism]:
    """The samples that are uploaded, by name."""
    out = {f"box{i}": Prism.box(size) for i, size in enumerate(BOXES)}
    angles = 2.0 * np.pi * np.arange(32) / 32
    ring = 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for i, (diameter, height) in enumerate(DRUMS):
        out[f"drum{i}"] = Prism(-0.5 * height, 0.5 * height, diameter * ring)
    return out


SHAPES = shapes()
OTHERS = dict(zip(SHAPES, [*SHAPES.values()][3:] + [*SHAPES.values()][:3], strict=True))
"""Name -> what may be uploaded under it later, instead."""


def stl(shape: Prism) -> bytes:
    """A prism on an outline as a binary STL; discs are refused with AssertionError."""
    assert shape.outline is not None
    ring = [tuple(p) for p in shape.outline.tolist()]
    n, faces = len(ring), []
    for i in range(n):
        (a, b), (c, d) = ring[i], ring[(i + 1) % n]
        low, high = shape.low, shape.high
        faces.append(((a, b, low), (c, d, low), (c, d, high)))
        faces.append(((a, b, low), (c, d, high), (a, b, high)))
        if 0 < i < n - 1:
            faces.append(((*ring[0], low), (c, d, low), (a, b, low)))
            faces.append(((*ring[0], high), (a, b, high), (c, d, high)))
    body = b"".join(
        struct.pack("<12fH", 0, 0, 0, *(x for p in f for x in p), 0) for f in faces
    )
    return b"\0" * 80 + struct.pack("<I", len(faces)) + body


@functools.lru_cache
def _read(raw: bytes, unit: str, material: str, file_type: str, name: str) -> Phantom:
    return mesh_phantom(raw, unit=unit, material=material, file_type=file_type, name=name)


def read_here(raw: bytes, **how: Any) -> Phantom:
    """In place of `mesh_apart`: no process of its own for what the tests themselves have
    made."""
    return _read(raw, **{k: how[k] for k in ("unit", "material", "file_type", "name")})


def data_with_samples(root: Path) -> Path:
    """Make a data directory with all samples of SHAPES uploaded; `root` is to be empty.

    Returns:
        Its folder of samples.
    """
    with Simulation(root) as sim:
        sim.start()
        client = sim.client()
        for name, shape in SHAPES.items():
            raw = stl(shape)
            sim.call(client, "sample.upload", name=name, format="stl", total=len(raw),
                     data=base64.b64encode(raw).decode(), unit="mm")  # fmt: skip
        sim.stop()
    return root / "data" / "samples"


@dataclass(frozen=True)
class Ask:
    """`method` by client `who` after `wait` s of the twin's time; "" for waiting alone."""

    wait: float
    who: int
    verb: str
    method: str = ""
    params: Json = field(default_factory=dict)
    begun: bool = False
    """Not waited for: others are served meanwhile."""


@dataclass(frozen=True)
class WireStart:
    """A server, at rest: machine, its clock, positions, sample."""

    machine: str
    seed: int
    speed_up: float | str
    positions: Json
    sample: Json | None


class WireEpisode:
    """One server, its clients and the oracle.

    Args:
        start: machine, seed, clock, pose.
        root: an empty folder.
        samples: see `data_with_samples`.
    """

    def __init__(self, start: WireStart, root: Path, samples: Path) -> None:
        """Make the simulation with its samples copied in; no server runs before it is
        entered.
        """
        self.start, self.root = start, root
        self.model = model(start.machine)
        machine, profile = product(start.machine)
        self.sim = Simulation(
            root, start.seed, machine=machine, profile=profile, speed_up=start.speed_up
        )
        shutil.copytree(samples, self.sim.data / "samples")
        self.found: list[Violation] = []
        self.counts: Counter[tuple[str, str]] = Counter()
        self.slowest = 0.0, ""
        self.tasks: list[tuple[Ask | None, Any]] = []
        self.jobs: list[str] = []
        self.correction_names: list[str] = []
        self.scenes: list[Json] = []
        self.shapes = dict(SHAPES)
        self._reading_here = patch.object(store, "mesh_apart", read_here)
        self._incoming: str | None = None
        """A name under which another file comes just now."""
        self._watch: Watch | None = None
        self._last = 0.0
        self._leases: list[tuple[float, str]] = []

    def __enter__(self) -> WireEpisode:
        """Start the server, watch its scanner, and put motors and sample where the start
        says.
        """
        self.sim.__enter__()
        self._reading_here.start()
        self._begin()
        scanner = self.sim.twin.scanner
        scanner.place(self.start.positions, self.sim.twin.clock.now())
        if self.start.sample is not None:
            with suppress(RpcError):
                self.sim.call(self.clients[0], "sample.set", **self.start.sample)
        return self

    def __exit__(self, *_: object) -> None:
        self._reading_here.stop()
        self.sim.__exit__(None, None, None)
        shutil.rmtree(self.root, ignore_errors=True)

    # The oracle ---------------------------------------------------------------------------------

    def _begin(self) -> None:
        """A server has been started: from here on its scanner is watched."""
        self.sim.start()
        self.clients: list[Client] = [self.sim.client() for _ in range(3)]
        scanner, clock = self.sim.twin.scanner, self.sim.twin.clock
        self._last = clock.now()
        self._watch = Watch(self._stage(), scanner.positions(self._last))
        for name in WATCHED:
            setattr(scanner, name, self._seen(name, getattr(scanner, name)))
        self.tasks = []

    def _stage(self) -> Stage:
        """The oracle's stage of the sample and correction that the server has in force."""
        scanner = self.sim.twin.scanner
        s, c = scanner.sample, scanner.correction
        offset = {k: getattr(s.offset, k) for k in ("x", "y", "z", "rx", "ry", "rz")}
        values = {} if c is None else c.parameters.to_edge()
        return Stage(self.model, Placed(self.shapes.get(s.name), offset), values)

    def _seen(self, name: str, ask: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a method of the scanner: what was published until it was called is looked
        at first.

        What the method puts on the stage is judged afterwards.

        Args:
            name: of the method.
            ask: the method; its errors go on.
        """
        scanner = self.sim.twin.scanner

        @functools.wraps(ask)
        def seen(*args: Any, **kwargs: Any) -> Any:
            """Look, call the method, and judge or note what it has put on the stage."""
            self.look()
            now, stage = self._last, (scanner.sample, scanner.correction)
            try:
                answer = ask(*args, **kwargs)
            except TwinError:
                self._watch_on(now)
                raise
            else:
                assert self._watch is not None
                if name == "place":
                    self._watch.rest()
                if name == "take_stage" and self._incoming == scanner.sample.name:
                    self._arrived()
                    stage = ()
                if (scanner.sample, scanner.correction) != stage:
                    self._put(name, now)
                else:
                    self._watch_on(now)
                return answer

        return seen

    def _watch_on(self, now: float) -> None:
        assert self._watch is not None
        self._watch.begun(self.sim.twin.scanner.positions(now))

    def _arrived(self) -> None:
        """The other file is there: from now on it is what the name means."""
        assert self._incoming is not None
        self.shapes[self._incoming] = OTHERS[self._incoming]
        self._incoming = None

    def _put(self, name: str, now: float) -> None:
        """Judge a new stage: pairs let in nearer than before and the margin are reported;
        then watch it.

        What stood too near at the start is not judged.
        """
        assert self._watch is not None
        old, new, scanner = self._watch.stage, self._stage(), self.sim.twin.scanner
        pose = self.model.vector(scanner.positions(now))
        before = dict(
            zip((p.names for p in old.pairs), old.clearances(pose).tolist(), strict=True)
        )
        for pair, d in zip(new.pairs, new.clearances(pose).tolist(), strict=True):
            free = self.model.margin - 0.02
            was = before.get(pair.names, math.inf)
            if name == "initialise_stage" or (was <= 0.0 and d <= 0.0):
                continue  # the past cannot be helped; how deep they overlap cannot be told
            if d < free and d < was - 0.02:
                kind = "contact" if d <= 0.0 else "margin"
                what = f"{name} was accepted with {' and '.join(pair.names)} {d:.4f} mm apart"
                self.found.append(Violation(kind, now, what, free - d))
        self._watch.put(new, scanner.positions(now))

    def look(self) -> None:
        """Look at all motion published since the last look, and at the state now; report
        what is wrong.
        """
        twin = self.sim.twin
        assert self._watch is not None
        now = twin.clock.now()
        s = twin.scanner
        self.found += self._watch.look(s.positions, s.velocities, self._last, now)
        self._last = max(self._last, now)
        near = self._watch.too_near(s.positions(now))
        if near and s.state(now).safety.state == "ready":
            what = f"ready, although {' and '.join(near[0])} are within the margin"
            self.found.append(Violation("state", now, what, 0.0))
        for end, outcome in [x for x in self._leases if x[0] <= now]:
            self.counts["lease end", outcome] += 1
            self._leases.remove((end, outcome))

    # Requests -----------------------------------------------------------------------------------

    @property
    def busy(self) -> bool:
        """Whether a job may move the motors by itself; one that waits begins when it likes."""
        jobs = self.sim.twin.jobs
        waits = any(job.phase == "queued" for job in jobs.all())
        legs = (
            self.sim.twin.detours._task
        )  # of a planned move: the next begins when it is due
        return bool(
            jobs.busy or jobs.running or waits or (legs is not None and not legs.done())
        )

    def do(self, ask: Ask) -> str:
        """Let time pass, make a request and judge what it did.

        What is wrong is appended to `found`, errors that the server logs included.

        Args:
            ask: what, by which client, and how long to wait before.

        Returns:
            accepted, halted, refused, begun, hang, waited, or what came of a restart.
        """
        self._wait(ask.wait)
        if ask.verb == "restart":
            return self._restart()
        if not ask.method:
            return "waited"
        client = self.clients[ask.who % len(self.clients)]
        scanner, clock = self.sim.twin.scanner, self.sim.twin.clock
        quiet = not self.busy and not self.tasks
        before = [(clock.now() + dt, scanner.positions(clock.now() + dt)) for dt in AHEAD]
        if ask.method == "sample.upload":
            self._incoming = ask.params["name"]
        asked = time.perf_counter()
        outcome, answer = "accepted", None
        try:
            if ask.begun:
                self.tasks.append((ask, self.sim.begin(client, ask.method, **ask.params)))
                self.sim.advance(0.0)
                outcome = "begun"
            else:
                answer = self.sim.call(client, ask.method, **ask.params)
        except RpcError as error:
            outcome = self._refused(ask, error)
        except TimeoutError as error:
            outcome = "hang"
            self.found.append(
                Violation("hang", clock.now(), f"{ask.method}: {error!r}", 0.0)
            )
        seconds = time.perf_counter() - asked
        self.slowest = max(
            self.slowest, (seconds, f"{ask.method} {str(ask.params)[:200]}")
        )
        if answer is not None:
            outcome = self._answered(ask, answer)
            if ask.method == "sample.upload" and self._incoming is not None:
                self._arrived()
        self._incoming = None
        self.look()
        if outcome == "refused" and quiet and not self.busy:
            now = clock.now()
            for t, reading in before:
                there = scanner.positions(t)
                if t >= now and there != reading:
                    what = f"{ask.method} was refused, yet motion is another at {t}"
                    self.found.append(Violation("changed", now, what, 0.0))
                    break
        if outcome != "begun":
            self.counts[ask.verb, outcome] += 1
        for record in self.sim.log:
            if record.exc_info:
                self._raised(ask, f"{record.getMessage()}: {record.exc_info[1]!r}")
        self.sim.log.clear()
        return outcome

    def _raised(self, ask: Ask, what: str) -> None:
        now = self.sim.twin.clock.now()
        self.found.append(Violation("raised", now, f"{ask.method}: {what[:500]}", 0.0))

    def _refused(self, ask: Ask, error: RpcError) -> str:
        """What an error means: halted if motion was carried out in part, else refused.

        An internal error is reported as well.
        """
        if error.code == -32603:
            self._raised(ask, repr(error))
        data = error.data if isinstance(error.data, dict) else {}
        return "halted" if error.code == -32002 and data.get("halts_at") else "refused"

    def _answered(self, ask: Ask, answer: Json) -> str:
        """Keep jobs and scenes of an answer, and return halted if its warnings say so,
        else accepted.
        """
        if "job" in answer and isinstance(answer["job"], str):
            self.jobs.append(answer["job"])
        if ask.method == "scene.save":
            self.scenes.append(answer["document"])
        halted = any(
            "halt" in w or "ends before" in w for w in answer.get("warnings") or []
        )
        if ask.method == "axes.jog":
            end = self.sim.twin.clock.now() + ask.params["lease_s"]
            self._leases.append((end, "halted" if halted else "accepted"))
        return "halted" if halted else "accepted"

    def _wait(self, seconds: float) -> None:
        """Let twin seconds pass, look, and count what has been answered meanwhile.

        Where the clock stands still until somebody waits, a task waits for it.
        """
        clock = self.sim.twin.clock
        if clock.speed_up != "max":
            seconds = seconds / float(clock.speed_up)
        elif seconds:
            loop = self.sim._loop
            assert loop is not None
            task = loop.create_task(clock.sleep_until(clock.now() + seconds))
            self.tasks.append((None, task))
        self.sim.advance(seconds)
        self.look()
        for ask, task in [t for t in self.tasks if t[1].done()]:
            self.tasks.remove((ask, task))
            if ask is None or task.cancelled():
                continue
            error = task.exception()
            if error is None:
                outcome = self._answered(ask, task.result())
            elif isinstance(error, RpcError):
                outcome = self._refused(ask, error)
            else:
                outcome = "raised"
                self._raised(ask, repr(error))
            self.counts[ask.verb, outcome] += 1

    def _restart(self) -> str:
        """kill -9 and a new server: what moved stands where it was when last written down."""
        self.look()
        self.sim.kill()
        self._leases.clear()
        self._begin()
        self.counts["restart", "accepted"] += 1
        return "accepted"

    def finish(self) -> None:
        """Abort what runs, and wait until all rests; report it if it never does."""
        twin = self.sim.twin
        with suppress(RpcError):
            self.sim.call(self.clients[0], "clock.set", speed_up=1000.0)
        for job in self.jobs:
            with suppress(RpcError):
                self.sim.call(self.clients[0], "job.abort", job=job)
        for _ in range(20):
            end = twin.scanner.rest_time(twin.clock.now())
            if not math.isfinite(end):
                self.found.append(
                    Violation("unrest", twin.clock.now(), "a motion without end", 0.0)
                )
                return
            self._wait(end - twin.clock.now() + 1.0)
            if (
                twin.scanner.rest_time(twin.clock.now()) <= twin.clock.now()
                and not self.busy
            ):
                break
        else:
            self.found.append(
                Violation("unrest", twin.clock.now(), "it does not rest", 0.0)
            )


# Drawing ----------------------------------------------------------------------------------------


class _View:
    """What `motion_rules` asks of an episode to draw from."""

    def __init__(self, episode: WireEpisode) -> None:
        self.model, self.scanner = episode.model, episode.sim.twin.scanner
        self.now = episode.sim.twin.clock.now()
        self.watch = episode._watch


def draw_wire_start(rng: Rng, machine: str) -> WireStart:
    """Draw a start: a free pose, the clock's speed and perhaps a sample."""
    m = model(machine)
    empty = Stage(m)
    while True:
        positions = draw_pose(rng, m)
        if empty.least(positions)[0] > m.margin + 0.05:
            break
    speed_up = SPEED_UPS[int(rng.integers(len(SPEED_UPS)))]
    sample = draw_sample_set(rng) if rng.random() < 0.8 else None
    return WireStart(machine, int(rng.integers(1 << 31)), speed_up, positions, sample)


def draw_sample_set(rng: Rng) -> Json:
    """Draw parameters of `sample.set`: one of SHAPES somewhere on the stage, or the empty
    stage.
    """
    if rng.random() < 0.2:
        return {"name": "empty"}
    offset = {k: round(float(rng.normal(0.0, 8.0)), 3) for k in ("x", "y", "z")}
    offset["rz"] = round(float(rng.uniform(-180.0, 180.0)), 3)
    if rng.random() < 0.1:
        offset["rx"] = round(float(rng.uniform(-40.0, 40.0)), 3)
    return {"file": str(rng.choice(list(SHAPES))), "offset": offset}


def draw_ask(rng: Rng, episode: WireEpisode) -> Ask:
    """Draw the next thing that some client does, mostly the one in control.

    What interrupts a running job is likely. Nothing is asked; the episode is only read.
    """
    e = episode
    view: Any = _View(e)
    m = e.model
    wait = float(rng.choice([0.0, rng.uniform(0.0, 0.5), rng.exponential(2.0),
                             min(120.0, view.scanner.rest_time(view.now) - view.now + 0.1)],
                            p=[0.2, 0.3, 0.4, 0.1]))  # fmt: skip
    wait = round(wait, 6)
    holder = e.sim.twin.control.holder
    names = [c.name for c in e.clients]
    who = (
        names.index(holder)
        if holder in names and rng.random() < 0.9
        else int(rng.integers(3))
    )
    if view.scanner.safety.state != "ready" and rng.random() < 0.6:
        return Ask(wait, who, "reset", "safety.reset")
    status = e.sim.twin.jobs.current
    state = None if status is None else status.phase
    if state in ("running", "paused"):
        wait = round(
            float(rng.choice([0.0, rng.uniform(0.0, 3.0), rng.uniform(0.0, 20.0)])), 6
        )
    if state == "running" and rng.random() < 0.7:
        method = str(
            rng.choice(["job.pause", "job.abort", "axes.stop"], p=[0.6, 0.25, 0.15])
        )
        return Ask(wait, who, method.rsplit(".", 1)[-1], method)
    if state == "paused" and rng.random() < 0.6:
        method = str(
            rng.choice(["job.resume", "job.step", "job.abort"], p=[0.65, 0.15, 0.2])
        )
        return Ask(wait, who, method.rsplit(".", 1)[-1], method)
    verbs = {"move": 24, "jog": 18, "stop": 7, "set": 6, "sample": 10, "correction": 8, "script": 5,
             "trajectory": 5, "estop": 1, "reset": 1, "control": 4, "clock": 3, "scene": 3,
             "restart": 1, "resume": 2, "pause": 2, "abort": 1}  # fmt: skip
    verb = str(
        rng.choice(list(verbs), p=np.array(list(verbs.values())) / sum(verbs.values()))
    )
    axes = [*m.motors, *m.virtual]
    match verb:
        case "move":
            params = draw_move(rng, view)
            if rng.random() < 0.08:
                params = {**params, "plan": True}
            waits = rng.random() < 0.2
            return Ask(
                wait, who, verb, "axes.move", {**params, "wait": bool(waits)}, bool(waits)
            )
        case "jog":
            axis = str(rng.choice(axes))
            share = m.moves(axis).items()
            top = min(m.fastest[m.motors.index(k)] / abs(f) for k, f in share)
            velocity = float(
                rng.choice([-1.0, 1.0]) * top * rng.choice([1.0, rng.uniform(0, 1)])
            )
            params = {"axis": axis, "velocity": round(velocity, 4),
                      "lease_s": round(float(rng.uniform(0.1, 5.0)), 4)}  # fmt: skip
            return Ask(wait, who, verb, "axes.jog", params)
        case "set":
            axis = str(rng.choice(axes))
            share = m.moves(axis).items()
            what = str(rng.choice(["speed", "acceleration"]))
            most = m.fastest if what == "speed" else m.hardest
            top = min(most[m.motors.index(k)] / abs(f) for k, f in share)
            value = float(top * 10.0 ** rng.uniform(-1.5, 0.0))
            return Ask(wait, who, verb, "axes.set", {"axis": axis, what: value})
        case "sample" if rng.random() < 0.15:
            name = str(rng.choice(list(SHAPES)))
            if view.scanner.sample.name and rng.random() < 0.8:
                name = view.scanner.sample.name
            raw = stl(OTHERS[name])
            params = {"name": name, "format": "stl", "total": len(raw), "unit": "mm",
                      "data": base64.b64encode(raw).decode()}  # fmt: skip
            return Ask(wait, who, verb, "sample.upload", params)
        case "sample":
            return Ask(
                wait, who, verb, "sample.set", draw_sample_set(rng), rng.random() < 0.15
            )
        case "correction":
            if rng.random() < 0.3:
                return Ask(wait, who, verb, "calibration.revert")
            values = draw_correction(rng)
            if rng.random() < 0.3:
                values["dD_z"] = round(float(rng.uniform(-60.0, 0.0)), 3)
            return Ask(wait, who, verb, "calibration.apply", {"parameters": values})
        case "script" if "rot_obj" in m.motors:
            return Ask(wait, who, verb, "script.submit", draw_script(rng, view))
        case "script" | "trajectory":
            return Ask(wait, who, verb, "trajectory.submit", draw_poses(rng, view))
        case "control":
            action = str(rng.choice(["acquire", "release", "force"]))
            return Ask(
                wait, int(rng.integers(3)), verb, "session.control", {"action": action}
            )
        case "clock":
            speed_up = SPEED_UPS[int(rng.integers(len(SPEED_UPS)))]
            return Ask(wait, who, verb, "clock.set", {"speed_up": speed_up})
        case "scene":
            if e.scenes and rng.random() < 0.6:
                scene = e.scenes[int(rng.integers(len(e.scenes)))]
                return Ask(
                    wait, who, verb, "scene.load", {"document": scene}, rng.random() < 0.3
                )
            return Ask(wait, who, verb, "scene.save")
        case "restart":
            return Ask(wait, who, verb)
        case "pause" | "resume" | "abort":
            return Ask(wait, who, verb, f"job.{verb}")
        case "estop" | "reset":
            return Ask(wait, who, verb, f"safety.{verb}")
        case _:
            return Ask(wait, who, "stop", "axes.stop")


def draw_poses(rng: Rng, view: Any) -> Json:
    """Draw parameters of `trajectory.submit`: two to eight poses of one to three motors
    each.
    """
    m, here = view.model, dict(view.scanner.final_positions())
    poses = []
    for _ in range(int(rng.integers(2, 9))):
        chosen = rng.choice(m.motors, int(rng.integers(1, 4)), replace=False).tolist()
        pose = {k: draw_target(rng, view, k, here) for k in chosen}
        here |= pose
        poses.append(pose)
    speed = {"speed_up": "max"} if rng.random() < 0.3 else {}
    return {"poses": poses, "exposure_ms": 200.0, **speed}


def draw_script(rng: Rng, view: Any) -> Json:
    """Draw parameters of `script.submit`: a fly scan of a few frames, after moves to
    where it shall be.
    """
    here = dict(view.scanner.final_positions())
    near, far = view.model.along("object"), view.model.along("detector")
    text = script(int(rng.integers(2, 10)), float(rng.choice([22.5, 40.0])), 1000.0)
    lines = []
    for motor in (near, far):
        if motor is not None and rng.random() < 0.6:
            target = draw_target(rng, view, motor, here)
            here[motor] = target
            lines.append(f"{motor}\tmove absolute\t{target}\t\tACK\t\t")
    speed = {"speed_up": "max"} if rng.random() < 0.3 else {}
    return {"text": "\r\n".join([*lines, text]), **speed}


def run_wire_episode(
    rng: Rng, machine: str, length: int, root: Path, samples: Path
) -> tuple[WireEpisode, list[Ask]]:
    """Make random requests until something is found, or `length` of them and a rest.

    Args:
        rng: draws all.
        machine: its name.
        length: most requests.
        root: an empty folder.
        samples: see `data_with_samples`.

    Returns:
        The episode, whose `found` tells, and the requests made.
    """
    history: list[Ask] = []
    with WireEpisode(draw_wire_start(rng, machine), root, samples) as episode:
        for _ in range(length):
            history.append(draw_ask(rng, episode))
            episode.do(history[-1])
            if episode.found:
                return episode, history
        episode.finish()
    return episode, history


def replay_wire(
    start: WireStart, history: Sequence[Ask], root: Path, samples: Path
) -> list[Violation]:
    """Make the requests of a history until something is found, or all and a rest; what is
    found.
    """
    with WireEpisode(start, root, samples) as episode:
        for ask in history:
            episode.do(ask)
            if episode.found:
                return episode.found
        episode.finish()
    return episode.found


def shortest_wire(
    start: WireStart,
    history: Sequence[Ask],
    kind: str,
    root: Path,
    samples: Path,
    tries: int = 60,
) -> list[Ask]:
    """Shorten a history that ends in a violation, as long as it still ends in one of that
    kind.

    Args:
        start, history: what to shorten; the list itself is not changed.
        kind: of the violation.
        root: a folder, which each try makes and removes.
        samples: see `data_with_samples`.
        tries: replays at most; then what is found so far is returned.

    Returns:
        The requests; all of them if none could be left out.
    """
    history = list(history)

    def fails(candidate: Sequence[Ask]) -> bool:
        """Whether a candidate ends in such a violation; false once all tries are used."""
        nonlocal tries
        tries -= 1
        if tries < 0:
            return False
        with suppress(Exception):
            return any(
                v.kind == kind for v in replay_wire(start, candidate, root, samples)
            )
        return False

    size = max(1, len(history) // 2)
    while size:
        i = 0
        while i < len(history):
            rest = history[i + size :]
            gone = Ask(sum(a.wait for a in history[i : i + size]), 0, "wait")
            for tail in (rest, [gone, *rest] if size > 1 else rest):
                if fails([*history[:i], *tail]):
                    history = [*history[:i], *tail]
                    break
            else:
                i += size
        size //= 2
    return history
