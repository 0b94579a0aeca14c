"""Random use of the pure scanner under the eye of the motion oracle, and the shortest history.

An `Episode` is one scanner from its start on: requests are plain values, so that a history can
be printed, replayed and shortened. `draw` makes requests that aim at trouble. The oracle sees
only what the scanner publishes (positions and velocities at any time) and the machine file.
"""

from __future__ import annotations

import json
import math
import signal
import threading
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from motion_oracle import (
    MachineModel,
    Placed,
    Prism,
    Stage,
    Violation,
    Watch,
    machine_file,
)

from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.convex_solids import Polytope, hull
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.errors import CollisionError, TwinError
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import builtin_profile, parse_machine
from flexdt.twin.motion import profiles as motion
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import NamedCorrection, Sample, StagePlacement

MACHINES = ("flexray", "rig", "mini")
VERBS = ("move", "jog", "lease end", "stop", "programme", "pause", "resume", "abort", "sample",
         "correction", "take", "set", "estop", "reset", "restart")  # fmt: skip
AHEAD = (0.0, 0.07, 0.3, 0.9, 2.1, 4.7, 9.3, 17.0, 40.0)
"""Moments after a refused request at which nothing may be different [s]."""

PATIENCE_S = 5.0
"""A request that takes longer than this hangs; of the processor's time."""

Rng = np.random.Generator
Json = dict[str, Any]


@dataclass(frozen=True)
class Request:
    """What is asked, `wait` seconds after the last request."""

    wait: float
    verb: str
    args: Json = field(default_factory=dict)

    def __str__(self) -> str:
        said = ", ".join(f"{k}={json.dumps(v)}" for k, v in self.args.items())
        return f"+{self.wait!r} s {self.verb}({said})"


@dataclass(frozen=True)
class Start:
    """A scanner at rest: machine, positions, what stands there."""

    machine: str
    positions: Mapping[str, float]
    sample: Json | None = None
    correction: Json | None = None
    time: float = 0.0


@lru_cache
def model(machine: str) -> MachineModel:
    return MachineModel(machine_file(machine))


@lru_cache
def product(machine: str) -> tuple[Any, Any]:
    m = parse_machine(model(machine).text, f"{machine}.toml")
    return m, builtin_profile(m.default_profile)


def shape(sample: Json | None) -> Prism | None:
    """A sample of the tests: a box, or an upright prism of 32 sides that stands for a
    cylinder."""
    if sample is None:
        return None
    if sample["kind"] == "box":
        return Prism.box(sample["size"])
    diameter, height = sample["size"][0], sample["size"][2]
    angles = 2.0 * np.pi * np.arange(32) / 32
    ring = 0.5 * diameter * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return Prism(-0.5 * height, 0.5 * height, ring)


def placed(sample: Json | None) -> Placed:
    return Placed(shape(sample), {} if sample is None else sample["offset"])


def pieces(sample: Json | None) -> tuple[Polytope, ...]:
    """The same for the scanner's guard."""
    solid = shape(sample)
    if sample is None or solid is None:
        return ()
    o = StagePlacement(**sample["offset"])
    return (hull(solid.corners() @ o.rotation.T + [o.x, o.y, o.z]),)


@contextmanager
def _patience() -> Iterator[None]:
    """Within it, raise TimeoutError after PATIENCE_S of the processor's time.

    A busy machine makes no hangs so. Outside the main thread, where there are no signals,
    nothing is limited.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def late(*_: object) -> None:
        raise TimeoutError

    old = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, PATIENCE_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, old)


class Episode:
    """One scanner, its oracle, and what was found."""

    def __init__(self, start: Start) -> None:
        """Make the scanner of a start and the oracle that watches it."""
        self.start = start
        self.machine, self.profile = product(start.machine)
        self.model = model(start.machine)
        self.now = start.time
        self.sample, self.correction = start.sample, start.correction
        self.scanner = self._fresh(start.positions)
        self.watch = Watch(self.stage(), self.scanner.positions(self.now))
        self.budget = dict.fromkeys(self.model.motors, 0.0)
        self.found: list[Violation] = []
        self.counts: Counter[tuple[str, str]] = Counter()
        self.stops: list[tuple[float, float, float, float]] = []
        """Seconds and millimetres of stops along the path, and of independent braking."""
        self.slowest = 0.0, ""
        """Seconds of the machine's own time that the slowest request took."""
        self._jog: tuple[float, str] | None = None
        self._pending: Any = None
        self._legs: list[Mapping[str, float]] = []
        self._accelerations: dict[str, float] = {}
        self._running = self._changed = False
        self._programme_until = -math.inf
        self._coupled: dict[str, dict[str, float]] = {}
        """Virtual axis -> where its motors were when it began to move them in step."""

    # The scanner --------------------------------------------------------------------------------

    def _fresh(self, positions: Mapping[str, float]) -> ScannerTwin:
        """A new scanner with motors at `positions`, the present sample and correction in
        force.
        """
        scanner = ScannerTwin(self.machine, self.profile, self.now)
        scanner.place(positions, self.now)
        guard = self._guard(self.sample, self.correction)
        scanner.initialise_stage(
            _sample(self.sample), _correction(self.correction), guard, self.now
        )
        return scanner

    def _guard(self, sample: Json | None, correction: Json | None) -> Any:
        """The scanner's own guard of a sample and a correction; None stands for none."""
        parameters = Offsets.from_edge(correction or {})
        return SceneGuard(
            build_scene(self.machine, self.profile, pieces(sample), parameters)
        )

    def stage(self) -> Stage:
        return Stage(self.model, placed(self.sample), self.correction)

    # Requests -----------------------------------------------------------------------------------

    def do(self, request: Request) -> str:
        """Let time pass under the oracle's eye, then make a request and judge what it
        did.

        What is wrong is appended to `found`; `counts` and `slowest` are kept.

        Args:
            request: what to ask, and how long to wait before.

        Returns:
            accepted, halted, refused, certified, nothing, hang or raised.
        """
        self._pass(self.now + request.wait)
        before = self._ahead()
        moving = self._moving()
        outcome = "accepted"
        begun = time.perf_counter()
        try:
            with _patience():
                answer = self._ask(request, moving)
        except TimeoutError:
            what = f"{request.verb} was not answered within {PATIENCE_S} s"
            self.found.append(Violation("hang", self.now, what, PATIENCE_S))
            return "hang"
        except CollisionError as error:
            halts = error.data.get("halts_at") or {}
            outcome = "halted" if halts else "refused"
            self._said(
                request.verb,
                halts,
                self.scanner.positions(self.scanner.rest_time(self.now)),
            )
        except TwinError:
            outcome = "refused"
        except Exception as error:
            at = traceback.extract_tb(error.__traceback__)[-1]
            what = (
                f"{request.verb} raised {error!r} in {Path(at.filename).name}:{at.lineno}"
            )
            self.found.append(Violation("raised", self.now, what, 0.0))
            return "raised"
        else:
            if answer is not None:
                outcome = answer
        seconds = time.perf_counter() - begun
        if seconds > self.slowest[0]:
            self.slowest = seconds, str(request)
        self._after(request, outcome, moving, before)
        self.counts[request.verb, outcome] += 1
        return outcome

    def _ask(self, request: Request, moving: set[str]) -> str | None:
        """Make a request.

        Args:
            request: what to ask.
            moving: motors that move; they don't matter here.

        Returns:
            What came of it; None for accepted.

        Raises:
            TwinError: it is refused (CollisionError with `halts_at` where it is carried
                out in part).
        """
        s, now, a = self.scanner, self.now, request.args
        match request.verb:
            case "move":
                s.move(a["targets"], now, relative=a.get("relative", False),
                       shortest=a.get("shortest", False))  # fmt: skip
            case "jog":
                jog = s.jog(a["axis"], a["velocity"], a["lease_s"], now)
                return "accepted" if jog.cut_short is None else "halted"
            case "stop" | "pause" | "abort":
                self._stop()
            case "estop":
                s.estop(now)
            case "reset":
                s.reset(now)
            case "set":
                s.set_axis(
                    a["axis"], speed=a.get("speed"), acceleration=a.get("acceleration")
                )
            case "sample":
                return self._change(a["sample"], self.correction, a.get("late", False))
            case "correction":
                return self._change(self.sample, a["correction"], a.get("late", False))
            case "take":
                return self._take_late()
            case "programme":
                return self._programme(a["legs"], a.get("late", False))
            case "resume":
                return self._resume()
            case "restart":
                self._restart(a)
        return None

    # The stage is certified, then changed: at once, or (late) when `take` comes.

    def _change(self, sample: Json | None, correction: Json | None, late: bool) -> str:
        """Certify another sample and correction; put them in force, or keep them if
        `late`.

        Returns:
            certified, halted or accepted.

        Raises:
            TwinError: it is refused.
        """
        change = self.scanner.stage_change(
            _sample(sample),
            _correction(correction),
            self._guard(sample, correction),
            self.now,
        )
        change.certified()
        if late:
            self._pending = "stage", change, sample, correction
            return "certified"
        return self._put(change, sample, correction)

    def _put(self, change: Any, sample: Json | None, correction: Json | None) -> str:
        """Put a certified change in force: halted if the scanner warns, else accepted."""
        warnings = self.scanner.take_stage(change, self.now)
        self.sample, self.correction = sample, correction
        self._changed = True
        return "halted" if warnings else "accepted"

    def _programme(self, legs: Sequence[Mapping[str, float]], late: bool) -> str:
        """Certify a programme of legs from where motion ends; follow it, or keep it if
        `late`.

        Each leg begins 0.25 s after the one before has ended, with the speeds now set.

        Returns:
            certified or accepted.

        Raises:
            TwinError: it is refused.
        """
        s, now = self.scanner, self.now
        at, x = 0.0, s.positions(s.rest_time(now))
        ways: dict[str, list[Any]] = {}
        accelerations = {}
        for leg in legs:
            ends = [at]
            for m, target in leg.items():
                speed, acceleration = s.settings(m)
                way = motion.move(x[m], 0.0, target, speed, acceleration, at)
                ways.setdefault(m, []).append(way)
                x[m], accelerations[m] = target, acceleration
                ends.append(way.end)
            at = max(ends) + 0.25
        certificate = s.prepared(ways, now).certified()
        if late:
            self._pending = "programme", certificate, legs, accelerations
            return "certified"
        return self._follow(certificate, legs, accelerations)

    def _follow(
        self,
        certificate: Any,
        legs: Sequence[Mapping[str, float]],
        accelerations: Mapping[str, float],
    ) -> str:
        """Follow a certified programme, and remember its legs for `resume`."""
        self.scanner.follow(certificate, self.now)
        self._legs, self._accelerations = list(legs), dict(accelerations)
        self._running = True
        self._programme_until = self.scanner.rest_time(self.now)
        return "accepted"

    def _resume(self) -> str:
        """What is left of a paused programme: the legs whose targets have not been reached."""
        if self._running or not self._legs:
            return "nothing"
        x = self.scanner.positions(self.now)
        left = self._legs
        for i, leg in enumerate(self._legs):
            if all(x[m] == target for m, target in leg.items()):
                left = self._legs[i + 1 :] or self._legs
        return self._programme(left, False)

    def _take_late(self) -> str:
        """Put in force what was certified earlier; "nothing" if nothing was, or it has
        been taken.
        """
        pending, self._pending = self._pending, None
        match pending:
            case ("stage", change, sample, correction):
                return self._put(change, sample, correction)
            case ("programme", certificate, legs, accelerations):
                return self._follow(certificate, legs, accelerations)
            case _:
                return "nothing"

    def _restart(self, args: Json) -> None:
        """Killed and started again: motors stand where they were, perhaps with another
        sample."""
        if "sample" in args:
            self.sample, self._changed = args["sample"], True
        self.scanner = self._fresh(self.scanner.positions(self.now))
        self.watch.rest()
        self.budget = dict.fromkeys(self.budget, 0.0)
        self._pending, self._legs, self._running = None, [], False

    def _stop(self) -> None:
        """Stop all motors, and compare what the answer says with what they do.

        Where motors moved, how long and how far they went is added to `stops`, beside
        independent braking.
        """
        s, now = self.scanner, self.now
        speeds, here = s.velocities(now), s.positions(now)
        alone = [
            (abs(v) / self.budget[m], 0.5 * v * v / self.budget[m])
            for m, v in speeds.items()
            if v != 0.0
        ]
        said = s.stop(now)
        end = s.rest_time(now)
        there = s.positions(end)
        self._said("stop", {m: here[m] + d for m, d in said.distances.items()},
                   {m: here[m] + abs(there[m] - here[m]) for m in said.distances})  # fmt: skip
        self._said("stop", {"rest": now + said.duration_s}, {"rest": end})
        if not alone:
            return
        way = max(abs(there[m] - here[m]) for m in here)
        self.stops.append(
            (end - now, way, max(a[0] for a in alone), max(a[1] for a in alone))
        )

    # The oracle ---------------------------------------------------------------------------------

    def _said(
        self, what: str, said: Mapping[str, float], is_: Mapping[str, float]
    ) -> None:
        """Report each value that an answer says and that is off by more than 1e-6.

        Args:
            what: the request's name.
            said: values by name.
            is_: the true ones; it has all names of `said`.
        """
        for m, x in said.items():
            if abs(x - is_[m]) > 1e-6:
                text = f"{what} says {m} {x}, it is {is_[m]}"
                self.found.append(Violation("answer", self.now, text, abs(x - is_[m])))

    def _moving(self) -> set[str]:
        """Motors that have somewhere to go yet, if only later.

        Looks are taken up to the end of motion; all motors of a programme count while it
        lasts.
        """
        s, now = self.scanner, self.now
        end = s.rest_time(now)
        if not end > now:
            return set()
        here = s.positions(now)
        out = {m for m, v in s.velocities(now).items() if v != 0.0}
        for t in (*np.linspace(now, end, 24).tolist(), *(now + dt for dt in AHEAD[1:4])):
            out |= {m for m, x in s.positions(t).items() if x != here[m]}
        if now < self._programme_until:  # a leg out and back may lie between two looks
            out |= set(self._accelerations)
        return out

    def _ahead(self) -> list[tuple[float, dict[str, float]]]:
        return [(self.now + dt, self.scanner.positions(self.now + dt)) for dt in AHEAD]

    def _pass(self, until: float) -> None:
        """Let time pass until `until`, look at the motion meanwhile, and note what has
        ended.
        """
        s = self.scanner
        if self._jog is not None and until >= self._jog[0]:
            self.counts["lease end", self._jog[1]] += 1
            self._jog = None
        self.found += self.watch.look(
            s.positions, s.velocities, self.now, until, self.budget
        )
        for t in (0.5 * (self.now + until), until):
            self._in_step(s.positions(t), t)
        self.now = until
        self._running = self._running and s.rest_time(until) > until
        self._state()

    def _in_step(self, reading: Mapping[str, float], time: float) -> None:
        """Report motors of one virtual axis that are out of step by more than 1e-6,
        however stopped.
        """
        for axis, begun in self._coupled.items():
            gone = {
                m: (reading[m] - begun[m]) / f for m, f in self.model.moves(axis).items()
            }
            spread = max(gone.values()) - min(gone.values())
            if spread > 1e-6:
                what = f"{axis}: " + ", ".join(
                    f"{m} went {x:.6f}" for m, x in gone.items()
                )
                self.found.append(Violation("coupling", time, what, spread))

    def _couple(self, request: Request, outcome: str, moving: set[str]) -> None:
        """Note which virtual axes move their motors in step after a request.

        A refused request changes nothing; a programme ends all coupling; another axis
        that shares a motor ends its coupling. A virtual axis counts if none of its motors
        moved before.
        """
        if outcome == "refused" or request.verb not in (
            "move",
            "jog",
            "programme",
            "resume",
            "take",
        ):
            return
        if request.verb not in ("move", "jog"):
            self._coupled = {}
            return
        axes = request.args.get("targets", {request.args.get("axis"): 0.0})
        for axis in axes:
            motors = set(self.model.moves(axis))
            for other in list(self._coupled):
                if other != axis and motors & set(self.model.moves(other)):
                    del self._coupled[other]
            if (
                axis in self.model.virtual
                and axis not in self._coupled
                and not motors & moving
            ):
                here = self.scanner.positions(self.now)
                self._coupled[axis] = {m: here[m] for m in motors}

    def _state(self) -> None:
        """Report a state "ready" with parts within the margin."""
        near = self.watch.too_near(self.scanner.positions(self.now))
        if near and self.scanner.state(self.now).safety.state == "ready":
            what = f"ready, although {' and '.join(near[0])} are within the margin"
            self.found.append(Violation("state", self.now, what, 0.0))

    def _after(
        self,
        request: Request,
        outcome: str,
        moving: set[str],
        before: list[tuple[float, dict[str, float]]],
    ) -> None:
        """Judge what a request did, and set what the oracle allows from now on.

        A refused request must leave the motion as it was. An accepted one sets the
        acceleration that each motor may use, and a new sample or correction the pairs and
        their floors; parts that it lets in too near are reported.

        Args:
            request, outcome: what was asked, and what came of it.
            moving: motors that moved before.
            before: readings at times ahead, as they were to be.
        """
        s, now = self.scanner, self.now
        if outcome == "refused":
            for t, reading in before:
                there = s.positions(t)
                for m, x in reading.items():
                    if there[m] != x:
                        what = f"{request.verb} was refused, yet {m} goes to {there[m]}, not {x}"
                        self.found.append(
                            Violation("changed", t, what, abs(there[m] - x))
                        )
                        break
                else:
                    continue
                break
            return
        self._couple(request, outcome, moving)
        for m in self.budget:
            if m not in moving:
                self.budget[m] = 0.0
        verb = request.verb
        programme = verb in ("programme", "resume", "take") and self._running
        if outcome == "halted" or verb == "estop":
            self.budget = dict.fromkeys(self.budget, math.inf)
        elif verb in ("move", "jog"):
            axes = request.args.get("targets", {request.args.get("axis"): 0.0})
            for axis in axes:
                for m in self.model.moves(axis):
                    self.budget[m] = max(self.budget[m], s.settings(m)[1])
        elif programme and outcome == "accepted":
            for m, acceleration in self._accelerations.items():
                self.budget[m] = max(self.budget[m], acceleration)
        if verb == "jog":
            self._jog = now + request.args["lease_s"], outcome
        elif verb in ("move", "stop", "estop", "restart"):
            self._jog = None
        if verb in ("move", "jog"):
            self._running = False
        if verb == "abort":
            self._legs, self._running = [], False
        if self._changed:
            self._changed = False
            stage = self.stage()
            clear = stage.clearances(self.model.vector(s.positions(now)))
            before = dict(zip((p.names for p in self.watch.stage.pairs),
                              self.watch.stage.clearances(self.model.vector(s.positions(now))).tolist(),
                              strict=True))  # fmt: skip
            for pair, d in zip(stage.pairs, clear.tolist(), strict=True):
                # What stands too near from now on has been let in.
                was = before.get(pair.names, math.inf)
                if verb == "restart" or (was <= 0.0 and d <= 0.0):
                    continue  # the past cannot be helped; how deep they overlap cannot be told
                if d < self.model.margin - 0.02 and d < was - 0.02:
                    kind = "contact" if d <= 0.0 else "margin"
                    what = f"{verb} was accepted with {' and '.join(pair.names)} {d:.4f} mm apart"
                    self.found.append(Violation(kind, now, what, self.model.margin - d))
            self.watch.put(stage, s.positions(now), anew=verb != "correction")
        else:
            self.watch.begun(s.positions(now))
        self._state()

    def finish(self) -> None:
        """Wait until all comes to rest, and report what never does or does not stay at
        rest.
        """
        end = self.scanner.rest_time(self.now)
        if not math.isfinite(end):
            self.found.append(
                Violation("unrest", self.now, "a motion without an end", 0.0)
            )
            return
        self._pass(end)
        self._pass(end + 1.0)
        rest = self.scanner.positions(end)
        for dt in (0.1, 5.0, 1e3):
            later = self.scanner.positions(end + dt)
            for m, x in rest.items():
                if (
                    abs(later[m] - x) > 1e-9
                    or self.scanner.velocities(end + dt)[m] != 0.0
                ):
                    self.found.append(
                        Violation("unrest", end + dt, f"{m} does not rest", 0.0)
                    )


def _sample(sample: Json | None) -> Sample:
    """The sample as the scanner takes it; the empty one for None."""
    return (
        Sample()
        if sample is None
        else Sample(sample["kind"], StagePlacement(**sample["offset"]))
    )


def _correction(values: Json | None) -> NamedCorrection | None:
    if values is None:
        return None
    return NamedCorrection("drawn", "2026-01-01", Offsets.from_edge(values))


# Drawing ----------------------------------------------------------------------------------------


def draw_start(rng: Rng, machine: str) -> Start:
    """Draw a start at a free pose, with a liking for narrow places.

    Four in five have a sample, some a correction, some a late time.

    Args:
        rng: draws all.
        machine: the name of one of MACHINES.
    """
    m = model(machine)
    while True:
        sample = draw_sample(rng) if rng.random() < 0.8 else None
        correction = draw_correction(rng) if rng.random() < 0.15 else None
        stage = Stage(m, placed(sample), correction)
        for _ in range(20):
            positions = draw_pose(rng, m)
            if stage.least(positions)[0] > m.margin + 0.05:
                late = (
                    float(10.0 ** rng.uniform(3.0, 7.5)) if rng.random() < 0.15 else 0.0
                )
                return Start(machine, positions, sample, correction, late)


def draw_pose(rng: Rng, m: MachineModel) -> dict[str, float]:
    """Draw a position of every motor; often the object's and the detector's along the
    beam are near.
    """
    pose = {a: draw_place(rng, m, a) for a in m.motors}
    near, far = m.along("object"), m.along("detector")
    if rng.random() < 0.7 and near is not None and far is not None:
        gap = rng.uniform(20.0, 350.0)
        pose[far] = float(np.clip(pose[near] + gap, *_travel(m, far)))
    return pose


def _travel(m: MachineModel, motor: str) -> tuple[float, float]:
    i = m.motors.index(motor)
    return float(m.lower[i]), float(m.upper[i])


def draw_place(rng: Rng, m: MachineModel, motor: str) -> float:
    """Draw a position of a motor: anywhere, at an end, or about its home.

    Motors that turn are put at any angle or a multiple of 90 deg. It is within the
    travel.
    """
    low, high = _travel(m, motor)
    if m.turns(motor):
        angle = float(
            rng.choice([rng.uniform(-400.0, 400.0), 90.0 * rng.integers(-4, 5)])
        )
        return float(np.clip(angle, low, high))
    kind = rng.random()
    if kind < 0.05:
        return float(rng.choice([low, high]))
    if kind < 0.6:
        home = float(m.data["axes"][motor]["home"])
        wide = 0.2 * (high - low)
        return float(np.clip(home + rng.normal(0.0, wide), low, high))
    return float(rng.uniform(low, high))


def draw_sample(rng: Rng) -> Json:
    """Draw a box or a cylinder with its size and its place on the stage, sometimes tilted
    or far aside.
    """
    kind = str(rng.choice(["box", "cylinder"]))
    wide = float(rng.choice([rng.uniform(5.0, 60.0), rng.uniform(60.0, 320.0)]))
    deep = float(rng.choice([rng.uniform(5.0, 40.0), rng.uniform(20.0, 200.0)]))
    tall = float(rng.choice([rng.uniform(5.0, 60.0), rng.uniform(40.0, 250.0)]))
    offset = {k: round(float(rng.normal(0.0, 8.0)), 3) for k in ("x", "y", "z")}
    offset["rz"] = round(float(rng.uniform(-180.0, 180.0)), 3)
    if rng.random() < 0.1:
        offset |= {k: round(float(rng.uniform(-40.0, 40.0)), 3) for k in ("rx", "ry")}
    if rng.random() < 0.15:
        offset["x"] = round(float(rng.uniform(-80.0, 80.0)), 3)
    return {
        "kind": kind,
        "size": [round(k, 3) for k in (wide, deep, tall)],
        "offset": offset,
    }


def draw_correction(rng: Rng) -> Json:
    """Draw one to four values of a correction, sometimes with a scale of the angle or
    tilts.
    """
    sizes = {"dO_x": 5, "dO_y": 3, "dO_z": 12, "alpha": 90, "tau_x": 2, "tau_z": 2,
             "dD_x": 5, "dD_y": 8, "dD_z": 12, "dS_x": 3, "dS_y": 3}  # fmt: skip
    names = rng.choice(list(sizes), int(rng.integers(1, 5)), replace=False).tolist()
    out = {n: round(float(rng.normal(0.0, sizes[n])), 3) for n in names}
    if rng.random() < 0.2:
        out["angle_scale"] = round(float(rng.uniform(0.95, 1.05)), 4)
    if rng.random() < 0.1:
        tilts = ["det_roll", "det_pitch", "det_yaw", "axis_tilt_x", "axis_tilt_z"]
        for n in rng.choice(tilts, 2, replace=False).tolist():
            out[n] = round(float(rng.normal(0.0, 2.0)), 3)
    return out


def draw_wait(rng: Rng, episode: Episode) -> float:
    """Draw how long to wait [s]: not at all, a moment, some seconds, or about until
    motion ends.

    It is at most 720 s by the end of motion; else exponential.
    """
    kind = rng.random()
    if kind < 0.15:
        return 0.0
    if kind < 0.45:
        return round(float(rng.uniform(0.0, 0.5)), 6)
    if kind < 0.9:
        return round(float(rng.exponential(2.5)), 6)
    left = episode.scanner.rest_time(episode.now) - episode.now
    return round(min(left, 600.0) * float(rng.choice([1.0, rng.uniform(0.5, 1.2)])), 6)


def draw(rng: Rng, episode: Episode) -> Request:
    """Draw the next request, aimed at trouble: what interrupts something that runs is
    likely.

    Nothing is asked; the episode is only read.
    """
    m = episode.model
    wait = draw_wait(rng, episode)
    state = episode.scanner.safety.state
    if state != "ready" and rng.random() < 0.6:
        return Request(wait, "reset")
    if episode._pending is not None and rng.random() < 0.4:
        return Request(wait, "take")
    if episode._running and rng.random() < 0.55:
        return Request(wait, str(rng.choice(["pause", "abort"], p=[0.7, 0.3])))
    if episode._legs and not episode._running and rng.random() < 0.5:
        return Request(_rest(rng, episode, wait), "resume")
    verbs = {"move": 0.30, "jog": 0.22, "stop": 0.08, "set": 0.08, "sample": 0.09,
             "correction": 0.07, "programme": 0.10, "estop": 0.02, "reset": 0.02,
             "restart": 0.02}  # fmt: skip
    verb = str(
        rng.choice(list(verbs), p=np.array(list(verbs.values())) / sum(verbs.values()))
    )
    axes = [*m.motors, *m.virtual]
    late = {"late": True} if rng.random() < 0.15 else {}
    match verb:
        case "move":
            return Request(wait, "move", draw_move(rng, episode))
        case "jog":
            axis = str(rng.choice(axes))
            share = m.moves(axis)
            top = min(m.fastest[m.motors.index(k)] / abs(f) for k, f in share.items())
            velocity = float(
                rng.choice([-1.0, 1.0]) * top * rng.choice([1.0, rng.uniform(0, 1)])
            )
            lease = float(rng.choice([rng.uniform(0.05, 1.0), rng.uniform(0.5, 6.0)]))
            return Request(wait, "jog", {"axis": axis, "velocity": round(velocity, 4),
                                         "lease_s": round(lease, 4)})  # fmt: skip
        case "set":
            axis = str(rng.choice(axes))
            share = m.moves(axis)
            what = str(rng.choice(["speed", "acceleration"], p=[0.3, 0.7]))
            most = m.fastest if what == "speed" else m.hardest
            top = min(most[m.motors.index(k)] / abs(f) for k, f in share.items())
            part = float(rng.choice(
                [1.0, 10.0 ** rng.uniform(-1.8, 0.0), 10.0 ** rng.uniform(-6.0, -1.8)],
                p=[0.4, 0.55, 0.05],
            ))  # fmt: skip
            return Request(wait, "set", {"axis": axis, what: float(top * part)})
        case "sample":
            sample = draw_sample(rng) if rng.random() < 0.75 else None
            if sample is not None and rng.random() < 0.5:
                sample = _fitting(rng, episode, sample, wait)
            return Request(wait, "sample", {"sample": sample, **late})
        case "correction":
            values = draw_correction(rng) if rng.random() < 0.7 else None
            if values is not None and rng.random() < 0.4:
                values |= {"dD_z": round(float(rng.uniform(-60.0, 0.0)), 3)}
            return Request(wait, "correction", {"correction": values, **late})
        case "programme":
            return Request(_rest(rng, episode, wait), "programme",
                           {"legs": draw_legs(rng, episode), **late})  # fmt: skip
        case "restart" if rng.random() < 0.3:
            return Request(wait, verb, {"sample": draw_sample(rng)})
        case _:
            return Request(wait, verb)


def _fitting(rng: Rng, episode: Episode, sample: Json, wait: float) -> Json:
    """A sample about as deep as there is room before the panel, now or where motion ends.

    It stays as it is on machines without motors along the beam.
    """
    m, s = episode.model, episode.scanner
    near, far = m.along("object"), m.along("detector")
    if near is None or far is None:
        return sample
    now = episode.now + wait
    room = []
    for t in (now, s.rest_time(now)):
        reading = s.positions(t)
        room.append(reading[far] - reading[near] + float(rng.uniform(-20.0, 40.0)))
    deep = 2.0 * float(rng.uniform(min(room), max(room)))
    size = [sample["size"][0], float(np.clip(deep, 5.0, 600.0)), sample["size"][2]]
    if sample["kind"] != "box":
        size[0] = size[1]
    offset = {**sample["offset"], "rz": 0.0} if rng.random() < 0.5 else sample["offset"]
    return {**sample, "size": [round(k, 3) for k in size], "offset": offset}


def _rest(rng: Rng, episode: Episode, wait: float) -> float:
    """Mostly until all rests: where a programme may begin."""
    if rng.random() < 0.1:
        return wait
    left = episode.scanner.rest_time(episode.now) - episode.now
    return math.ceil(1e6 * left) / 1e6 + float(rng.choice([0.0, wait]))


def draw_legs(rng: Rng, episode: Episode) -> list[dict[str, float]]:
    """Draw one to five legs of one to four motors, one after the other, as scripts have
    them.

    They begin where motion ends.

    Returns:
        Targets by motor, leg by leg.
    """
    m, s = episode.model, episode.scanner
    here = dict(s.positions(s.rest_time(episode.now)))
    chosen = rng.choice(
        m.motors, int(rng.integers(1, min(4, len(m.motors)) + 1)), replace=False
    )
    legs = []
    for _ in range(int(rng.integers(1, 6))):
        some = [k for k in chosen.tolist() if rng.random() < 0.7] or chosen[:1].tolist()
        leg = {k: draw_target(rng, episode, k, here) for k in some}
        here |= leg
        legs.append(leg)
    return legs


def draw_move(rng: Rng, episode: Episode) -> Json:
    """Draw a move of one to four axes, virtual ones included, none of which share a
    motor.

    Returns:
        Parameters of `axes.move`; some moves are relative, some take the shortest way.
    """
    m, s = episode.model, episode.scanner
    count = int(rng.choice([1, 2, 3, 4], p=[0.35, 0.35, 0.2, 0.1]))
    here = (
        s.positions(s.rest_time(episode.now))
        if rng.random() < 0.5
        else s.positions(episode.now)
    )
    axes = rng.permutation([*m.motors, *m.virtual]).tolist()
    targets: dict[str, float] = {}
    taken: set[str] = set()
    for axis in axes:
        if len(targets) == count:
            break
        if taken & set(m.moves(axis)):
            continue
        taken |= set(m.moves(axis))
        if axis in m.virtual:
            v = m.virtual[axis]
            reading = v["constant"] + v["factor"] * here[v["of"]]
            targets[axis] = round(float(reading + rng.normal(0.0, 60.0)), 4)
        else:
            targets[axis] = draw_target(rng, episode, axis, here)
    kind = rng.random()
    if kind < 0.12:
        steps = {}
        for axis, x in targets.items():
            v = m.virtual.get(axis)
            at = here[axis] if v is None else v["constant"] + v["factor"] * here[v["of"]]
            steps[axis] = round(x - at, 4)
        return {"targets": steps, "relative": True}
    if kind < 0.2:
        return {"targets": targets, "shortest": True}
    return {"targets": targets}


def draw_target(
    rng: Rng, episode: Episode, motor: str, here: Mapping[str, float]
) -> float:
    """Draw where a motor goes: anywhere, to the margin, near the other part on the beam,
    or a way off.

    It is within the travel.

    Args:
        rng: draws it.
        episode: whose scanner it is.
        motor: its name.
        here: positions of all motors.
    """
    m = episode.model
    low, high = _travel(m, motor)
    kind = rng.random()
    if kind < 0.25:
        return round(draw_place(rng, m, motor), 4)
    if kind < 0.35:
        met = _meeting(rng, episode, motor, here)
        if met is not None:
            return float(
                np.clip(
                    round(met + rng.choice([0.0, rng.normal(0.0, 2.0)]), 4), low, high
                )
            )
    near, far = m.along("object"), m.along("detector")
    if kind < 0.6 and near is not None and far is not None and motor in (near, far):
        gap = float(rng.uniform(10.0, 300.0))
        meet = here[near] + gap if motor == far else here[far] - gap
        return float(np.clip(round(meet, 4), low, high))
    wide = 90.0 if m.turns(motor) else float(rng.choice([20.0, 100.0, 300.0]))
    return float(np.clip(round(here[motor] + rng.normal(0.0, wide), 4), low, high))


def _meeting(
    rng: Rng, episode: Episode, motor: str, here: Mapping[str, float]
) -> float | None:
    """Where a motor, going one way alone, would first bring something to the margin.

    Returns:
        The position, within 0.02 mm of the margin or where 30 steps lead; None if nothing
        is in the way.
    """
    m, stage = episode.model, episode.watch.stage
    low, high = _travel(m, motor)
    x = here[motor]
    end = low if rng.random() < 0.5 else high
    if m.turns(motor):
        end = x + float(rng.choice([-180.0, 180.0]))
    scale = 2.0 if m.turns(motor) else 1.0
    for _ in range(30):
        clear = stage.least({**here, motor: x})[0] - m.margin
        if clear < 0.02:
            return x
        step = clear / scale
        if abs(end - x) < step:
            return None
        x += math.copysign(step, end - x)
    return x


# Running ----------------------------------------------------------------------------------------


def run_episode(rng: Rng, machine: str, length: int) -> tuple[Episode, list[Request]]:
    """Make random requests until something is found, or `length` of them and a rest.

    Returns:
        The episode, whose `found` tells, and the requests made.
    """
    episode = Episode(draw_start(rng, machine))
    history = []
    for _ in range(length):
        history.append(draw(rng, episode))
        episode.do(history[-1])
        if episode.found:
            return episode, history
    episode.finish()
    return episode, history


def replay(start: Start, history: Sequence[Request]) -> Episode:
    """Make the requests of a history until something is found, or all of them and a rest."""
    episode = Episode(start)
    for request in history:
        episode.do(request)
        if episode.found:
            return episode
    episode.finish()
    return episode


def shortest(
    start: Start, history: Sequence[Request], kind: str, tries: int = 400
) -> tuple[Start, list[Request]]:
    """Shorten a history that ends in a violation, as long as it still ends in one of that
    kind.

    Requests are left out in halves, quarters and so on, then simplified; last the start.

    Args:
        start, history: what to shorten; neither is changed.
        kind: of the violation.
        tries: replays at most; then what is found so far is returned.

    Returns:
        The start and the requests; as given if nothing could be left out.
    """
    history = list(history)

    def fails(begin: Start, candidate: Sequence[Request]) -> bool:
        """Whether a candidate ends in such a violation; false once all tries are used."""
        nonlocal tries
        tries -= 1
        if tries < 0:
            return False
        try:
            found = replay(begin, candidate).found
        except Exception:
            return False
        return any(v.kind == kind for v in found)

    size = max(1, len(history) // 2)
    while size:
        i = 0
        while i < len(history):
            gone = sum(r.wait for r in history[i : i + size])
            rest = history[i + size :]
            kept = (
                [Request(rest[0].wait + gone, rest[0].verb, rest[0].args), *rest[1:]]
                if rest
                else []
            )
            for tail in (rest, kept):
                if fails(start, history[:i] + tail):
                    history = history[:i] + tail
                    break
            else:
                i += size
        size //= 2
    for i, request in enumerate(history):
        for changed in _simpler(request):
            if fails(start, [*history[:i], changed, *history[i + 1 :]]):
                history[i] = changed
    for change in ({"sample": None}, {"correction": None}, {"time": 0.0}):
        begin = replace(start, **change)
        if fails(begin, history):
            start = begin
    return start, history


def _simpler(request: Request) -> list[Request]:
    """Simpler requests to try in place of one: fewer targets, a rounded wait; perhaps
    none.
    """
    out = []
    if request.verb == "move" and len(request.args["targets"]) > 1:
        for axis in request.args["targets"]:
            left = {k: v for k, v in request.args["targets"].items() if k != axis}
            out.append(Request(request.wait, "move", {**request.args, "targets": left}))
    for digits in (0, 1, 2):
        if round(request.wait, digits) != request.wait:
            out.append(Request(round(request.wait, digits), request.verb, request.args))
    return out


def script_of(start: Start, history: Sequence[Request]) -> str:
    """A history as a few lines of Python that show it again."""
    lines = [
        "from motion_rules import Request, Start, replay",
        f"start = Start({start.machine!r}, {dict(start.positions)!r},",
        f"              {start.sample!r}, {start.correction!r}, {start.time!r})",
        "history = [",
        *(f"    Request({r.wait!r}, {r.verb!r}, {r.args!r})," for r in history),
        "]",
        "print(*replay(start, history).found, sep='\\n')",
    ]
    return "\n".join(lines)
