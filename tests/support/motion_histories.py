"""Long histories of one small request, and a search for the worst one, on machines drawn anew.

Each step of a history may keep its contract while the sequence does not. What is watched here
is the gap that a pair had when it came near, and what all steps together took from it. The
judge is `motion_oracle`: its own reading of the machine file, kinematics and distances.
`dense_moves` compares what the scanner accepts with a dense sweep of profiles worked out here.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from motion_oracle import Array, MachineModel, Placed, Prism, Stage

from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.convex_solids import hull
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.errors import CollisionError, TwinError
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import (
    Machine,
    Profile,
    builtin_profile,
    parse_machine,
)
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import NamedCorrection, Sample, StagePlacement

Rng = np.random.Generator
LOSS_MM = 0.01
"""What a history may take from a gap, and how far below the margin it may end [mm]."""
CLEAR_MM = 0.03
"""A dense sweep calls a move safe or unsafe only where it is by so much."""


# Machines ---------------------------------------------------------------------------------------


def drawn_machine(rng: Rng) -> str:
    """Draw the text of a machine file.

    Its two to five motors go along, across or at a slant; some are shared by two parts,
    some have micrometres of gearing. It has a turntable, a tube, a table and a panel, and
    a margin of its own.
    """
    margin = round(float(10.0 ** rng.uniform(-1.0, 0.5)), 4)
    quantities = ["source_x", "source_z", "object_x", "object_y", "object_z", "detector_x",
                  "detector_y", "detector_z"]  # fmt: skip
    shares: dict[str, dict[str, float]] = {q: {} for q in quantities}
    motors = [f"m{i}" for i in range(int(rng.integers(2, 6)))]
    travel = {}
    shares["object_y"]["m0"] = 1.0
    shares["detector_y"]["m1"] = float(rng.choice([1.0, -1.0]))
    for motor in motors:
        gear = 1.0
        if motor not in ("m0", "m1"):
            gear = float(rng.choice([1.0, 1e-3]))
            for quantity in rng.choice(
                quantities, int(rng.integers(1, 4)), replace=False
            ).tolist():
                shares[quantity][motor] = gear * float(rng.choice([-1.0, -0.5, 0.3, 1.0]))
        elif rng.random() < 0.4:  # at a slant
            shares[str(rng.choice(["object_x", "detector_z"]))][motor] = 0.2
        travel[motor] = float(rng.uniform(40.0, 150.0)) / gear
    text = (
        f'schema = 1\nname = "drawn"\nscanner_name = "drawn"\nscanner_type = "drawn"\n'
        f'serial = "none"\ndescription = "Drawn."\non_limit = "reject"\n'
        f"max_blocked_attempts = {int(rng.integers(2, 5))}\nsafety_margin_mm = {margin}\n"
        'sample_height_mm = 0.0\ndefault_profile = "thesis"\nallowed_contacts = []\n'
        '[detector]\nmodel = "Dexela 1512NDT"\ncolumns = 1944\nrows = 1536\npitch_mm = 0.0748\n'
        'bits = 14\nmode = "HW2SW1High"\nroi = [32, 8, 1943, 1527]\nexposure_ms = 100.0\n'
        "[tube]\nmax_kV = 90.0\nmax_W = 90.0\nkV = 60.0\npower_W = 20.0\n"
        '[timing]\nsource = "drawn"\n'
    )
    for motor in [*motors, "turn"]:
        wide = travel.get(motor, 720.0)
        speed = round(wide / float(rng.uniform(4.0, 20.0)), 4)
        hard = round(speed * float(rng.uniform(0.5, 4.0)), 4)
        text += (
            f'[axes.{motor}]\nkind = "{"rotation" if motor == "turn" else "linear"}"\n'
            f"lower = {-wide}\nupper = {wide}\nhome = 0.0\n"
            f"speed = {speed}\nmax_speed = {speed}\n"
            f"acceleration = {hard}\nmax_acceleration = {hard}\n"
        )
    text += "[geometry]\nangle = { turn = 1.0 }\n"
    for quantity, of in shares.items():
        text += f"{quantity} = {{ {', '.join(f'{m} = {f}' for m, f in of.items())} }}\n"
    text += f"[fixed]\nobject_y = 500.0\ndetector_y = {700.0 + 2.0 * margin}\n"
    for anchor, part, role in (("source", "tube", "tube"), ("object", "table", "sample_holder"),
                               ("detector", "panel", "panel")):  # fmt: skip
        parent = ""
        carried_by = sorted(
            {m for q in quantities if q.startswith(anchor) for m in shares[q]}
        )
        for motor in [*carried_by, *(["turn"] if anchor == "object" else [])]:
            text += (
                f'[[components]]\nname = "{anchor}_{motor}"\nparent = "{parent}"\n'
                f'axis = "{motor}"\nanchor = "{anchor}"\nsize_mm = [1.0, 1.0, 1.0]\n'
                "center_mm = [0.0, 0.0, -900.0]\n"
            )
            parent = f"{anchor}_{motor}"
        size, centre, shape = {
            "tube": ([150.0, 100.0, 150.0], [0.0, -50.0, 0.0], "box"),
            "table": (
                [80.0, 80.0, 40.0],
                [0.0, 0.0, -60.0],
                str(rng.choice(["box", "cylinder"])),
            ),
            "panel": ([200.0, 40.0, 240.0], [0.0, 20.0, 0.0], "box"),
        }[part]
        text += (
            f'[[components]]\nname = "{part}"\nparent = "{parent}"\nanchor = "{anchor}"\n'
            f'shape = "{shape}"\nrole = "{role}"\nsize_mm = {size}\ncenter_mm = {centre}\n'
        )
    # The dots that carry the motors of one part may meet those of another: they are far below.
    names = [
        line.split('"')[1] for line in text.splitlines() if line.startswith('name = "')
    ][1:]
    dots = [n for n in names if n not in ("tube", "table", "panel")]
    contacts = [[a, b] for i, a in enumerate(dots) for b in dots[i + 1 :]]
    return text.replace("allowed_contacts = []", f"allowed_contacts = {contacts}")


def drawn_model(rng: Rng) -> tuple[Machine, Profile, MachineModel]:
    """A drawn machine, as the product and as the oracle read it."""
    text = drawn_machine(rng)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "drawn.toml"
        file.write_text(text, encoding="utf-8")
        model = MachineModel(file)
    machine = parse_machine(text, "drawn.toml")
    return machine, builtin_profile(machine.default_profile), model


# One scanner and its judge ----------------------------------------------------------------------


@dataclass
class Judge:
    """What a history did to the gaps of one scanner.

    Attributes:
        margin: the machine's [mm].
        loss: the most that any pair lost of the largest gap it had since it came within the
            margin.
        least: the least gap of pairs that were free, above the margin [mm].
        found: violations, in words.
    """

    margin: float
    peaks: dict[tuple[str, str], float] = field(default_factory=dict)
    """Of pairs within the margin."""
    loss: float = 0.0
    least: float = math.inf
    found: list[str] = field(default_factory=list)

    def look(
        self, stage: Stage, pose: Array, state: str, what: str, *, forget: bool = False
    ) -> None:
        """Judge one pose at rest: what pairs within the margin lost, and whether the
        state tells of them.

        What is wrong is appended to `found`.

        Args:
            stage: what stands there.
            pose: positions of the motors.
            state: of the safety system.
            what: happened before, for the report.
            forget: motors or parts were put there by no request; earlier gaps do not
                count.
        """
        peaks = {}
        for p, gap in zip(stage.pairs, stage.clearances(pose).tolist(), strict=True):
            pair = p.names
            if not forget and pair not in self.peaks:
                self.least = min(self.least, gap - self.margin)
            if gap >= self.margin:
                continue
            # What came below the margin by itself should have kept the margin.
            held = gap if forget else self.peaks.get(pair, self.margin)
            peaks[pair] = max(held, gap)
            self.loss = max(self.loss, held - gap)
            said = f"{what}: {' and '.join(pair)} {gap:.5f} mm apart"
            if held - gap > LOSS_MM:
                self.found.append(f"{said}, {held - gap:.5f} mm lost")
            if state == "ready" and gap < self.margin - 0.1 * LOSS_MM:
                self.found.append(f"{said}, and the state is {state}")
        self.peaks = peaks


class Subject:
    """A scanner on a drawn machine, with a sample and its judge."""

    def __init__(self, rng: Rng) -> None:
        """Draw a machine and two samples, and begin with none on the stage and all motors
        home.
        """
        self.rng, self.now = rng, 0.0
        self.machine, self.profile, self.model = drawn_model(rng)
        self.samples: list[tuple[Prism | None, dict[str, float]]] = [(None, {})]
        for _ in range(2):
            size = rng.uniform([5.0, 5.0, 10.0], [140.0, 120.0, 150.0]).tolist()
            offset = {"z": round(float(rng.uniform(-5.0, 40.0)), 3)}
            if rng.random() < 0.7:
                offset |= {"rz": round(float(rng.uniform(-90.0, 90.0)), 3)}
            self.samples.append((Prism.box(size), offset))
        self.which, self.correction = 0, dict[str, float]()
        self.scanner = self._fresh({})
        self.judge = Judge(self.model.margin)
        self.stages: dict[object, Stage] = {}
        self.requests = 0
        self._look("start", forget=True)

    def _value(self, which: int) -> tuple[Sample, tuple[object, ...]]:
        """A sample as the scanner takes it, and its hulls in the stage's axes; 0 is no
        sample.
        """
        shape, offset = self.samples[which]
        if shape is None:
            return Sample(), ()
        put = StagePlacement(**offset)
        return Sample(f"s{which}", put), (
            hull(shape.corners() @ put.rotation.T + [put.x, put.y, put.z]),
        )

    def _guard(self, which: int, correction: Mapping[str, float]) -> SceneGuard:
        parts = self._value(which)[1]
        offsets = Offsets.from_edge(dict(correction))
        return SceneGuard(build_scene(self.machine, self.profile, parts, offsets))  # type: ignore[arg-type]

    def _fresh(self, positions: Mapping[str, float]) -> ScannerTwin:
        """A new scanner with motors at `positions`, the present sample and correction in
        force.
        """
        s = ScannerTwin(self.machine, self.profile, self.now)
        s.place(positions, self.now)
        put = _correction(self.correction)
        s.initialise_stage(
            self._value(self.which)[0],
            put,
            self._guard(self.which, self.correction),
            self.now,
        )
        return s

    @property
    def stage(self) -> Stage:
        """The oracle's stage of the present sample and correction; up to 21 are kept."""
        key = self.which, tuple(sorted(self.correction.items()))
        if key not in self.stages:
            if len(self.stages) > 20:
                self.stages.clear()
            self.stages[key] = Stage(
                self.model, Placed(*self.samples[self.which]), self.correction
            )
        return self.stages[key]

    def least(self) -> float:
        """Least clearance of the pose, by the oracle [mm]."""
        return self.stage.least(self.scanner.positions(self.now))[0]

    def _look(self, what: str, *, forget: bool = False) -> None:
        pose = self.model.vector(self.scanner.positions(self.now))
        state = self.scanner.state(self.now).safety.state
        self.judge.look(self.stage, pose, state, what, forget=forget)

    def do(
        self, what: str, ask: Callable[[ScannerTwin], object], *, rest: bool = True
    ) -> bool:
        """Make one request; then let all come to rest and judge it, unless `rest` is
        false.

        Args:
            what: the request's name in reports.
            ask: makes it; a TwinError means that it was refused.
            rest: whether to wait.

        Returns:
            Whether it was accepted.
        """
        accepted = True
        try:
            ask(self.scanner)
        except TwinError:
            accepted = False
        self.requests += 1
        if rest:
            self.now = math.nextafter(self.scanner.rest_time(self.now), math.inf)
            self._look(what)
        return accepted

    def change(self, which: int, correction: dict[str, float]) -> bool:
        """Certify another sample or correction and put it in force; motion is not waited
        for.

        Gaps of the sample are forgotten when it is another one.

        Returns:
            Whether it was accepted; if not, nothing has changed.
        """

        def ask(s: ScannerTwin) -> None:
            guard = self._guard(which, correction)
            value, put = self._value(which)[0], _correction(correction)
            s.take_stage(
                s.stage_change(value, put, guard, self.now).certified(), self.now
            )

        accepted = self.do("change", ask, rest=False)
        if accepted:
            if which != self.which:  # another body has no history
                self.judge.peaks = {
                    p: g for p, g in self.judge.peaks.items() if "sample" not in p
                }
            self.which, self.correction = which, correction
            self._look("change")
        return accepted

    def restart(self) -> None:
        """Started anew where it stands."""
        self.scanner = self._fresh(self.scanner.positions(self.now))
        self.requests += 1
        self._look("restart")

    def draw_pose(self) -> dict[str, float]:
        """Draw a position of every motor: anywhere on its travel, a turntable within half
        a turn.
        """
        m = self.model
        return {
            motor: float(self.rng.uniform(max(m.lower[i], -180.0), min(m.upper[i], 180.0)))
            if m.turns(motor) else float(self.rng.uniform(m.lower[i], m.upper[i]))
            for i, motor in enumerate(m.motors)
        }  # fmt: skip

    def approach(self) -> None:
        """Bring parts near: up to 20 random moves, until one is halted or refused near
        the margin.

        The sample may be changed first. An alarm is reset after each move.
        """
        if self.rng.random() < 0.7:
            self.change(int(self.rng.integers(3)), {})
        for _ in range(20):
            pose = self.draw_pose()
            if (
                self.rng.random() < 0.6
            ):  # the two that lead along the beam, towards each other
                some = [str(self.rng.choice(self.model.motors[:2]))]
            else:
                some = self.rng.choice(list(pose), 2, replace=False).tolist()
            targets = {m: pose[m] for m in some}
            accepted = self.do("approach", lambda s, t=targets: s.move(t, self.now))
            if self.scanner.safety.state != "ready":
                self.scanner.reset(self.now)
            if not accepted and self.least() < self.model.margin + 0.1:
                return

    def enter(self) -> None:
        """Put motors within the margin at a start, as after coasting or with another
        machine file.

        After 300 drawn poses without one within the margin nothing is changed.
        """
        here = self.scanner.positions(self.now)
        for _ in range(300):
            pose = dict(here)
            motor = str(self.rng.choice(self.model.motors[:2]))
            i = self.model.motors.index(motor)
            pose[motor] = float(
                self.rng.uniform(self.model.lower[i], self.model.upper[i])
            )
            if 0.0 < self.stage.least(pose)[0] < self.model.margin:
                self.scanner = self._fresh(pose)
                self._look("enter", forget=True)
                return

    # Arms of the search ---------------------------------------------------------------------

    def arms(self) -> list[tuple[str, Callable[[], bool]]]:
        """Draw small requests, each of which may be repeated.

        They are moves, jogs, moves with a stop or E-stop in between, corrections, a
        change of sample and back, and a restart.

        Returns:
            (name, what makes the request and returns whether it was accepted).
        """
        rng, m, out = self.rng, self.model, list[tuple[str, Callable[[], bool]]]()

        def move(axis: str, step: float) -> Callable[[], bool]:
            """A request that moves an axis by a step."""
            return lambda: self.do(
                f"move {axis} {step:.3g}",
                lambda s: s.move({axis: step}, self.now, relative=True),
            )

        def jog(axis: str, speed: float, lease: float) -> Callable[[], bool]:
            return lambda: self.do(
                f"jog {axis} {speed:.3g}", lambda s: s.jog(axis, speed, lease, self.now)
            )

        def halted(axis: str, step: float, part: float, verb: str) -> Callable[[], bool]:
            """A request that moves an axis, and stops it by `verb` after a part of the
            way's time.
            """

            def ask() -> bool:
                """Move and stop; whether the move was accepted. An E-stop is reset."""
                name = f"{verb} in move {axis} {step:.3g}"
                accepted = self.do(
                    name,
                    lambda s: s.move({axis: step}, self.now, relative=True),
                    rest=False,
                )
                end = self.scanner.rest_time(self.now)
                self.now += part * max(end - self.now, 0.0)
                self.do(name, lambda s: getattr(s, verb)(self.now))
                if verb == "estop":
                    self.scanner.reset(self.now)
                return accepted

            return ask

        def correct(name: str, size: float) -> Callable[[], bool]:
            """A request that adds `size` to one value of the correction."""

            def ask() -> bool:
                """Change the correction; whether it was accepted."""
                now = {**self.correction, name: self.correction.get(name, 0.0) + size}
                return self.change(self.which, now)

            return ask

        def to_and_fro(other: int) -> Callable[[], bool]:
            """A request that puts another sample on the stage and takes it back."""

            def ask() -> bool:
                """Change the sample and back; false as soon as one change is refused."""
                back, old = self.which, dict(self.correction)
                return self.change(other, old) and self.change(back, old)

            return ask

        def restart() -> bool:
            self.restart()
            return True

        for i, axis in enumerate(m.motors):
            per = max(float(np.abs(m._quantity(q)[i])) for q in m.data["geometry"])
            for sign in (-1.0, 1.0):
                step = sign * float(10.0 ** rng.uniform(-6.0, -1.0)) / min(per, 1.0)
                out.append((f"move {axis} {step:.2g}", move(axis, step)))
                speed = (
                    sign * float(m.fastest[i]) * float(10.0 ** rng.uniform(-5.0, -1.0))
                )
                out.append(
                    (
                        f"jog {axis} {speed:.2g}",
                        jog(axis, speed, float(rng.uniform(0.01, 0.2))),
                    )
                )
            verb = str(rng.choice(["stop", "estop"]))
            step = float(rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-3.0, 0.0)) / min(
                per, 1.0
            )
            out.append(
                (f"{verb} {axis}", halted(axis, step, float(rng.uniform(0.1, 0.9)), verb))
            )
        for name in rng.choice(["dO_x", "dO_y", "dO_z", "dD_x", "dD_z", "alpha", "tau_x"], 2,
                               replace=False).tolist():  # fmt: skip
            size = float(rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-5.0, -1.5))
            out.append((f"correct {name} {size:.2g}", correct(name, size)))
        out += [("to and fro", to_and_fro(int(rng.integers(3)))), ("restart", restart)]
        return out


def _correction(values: Mapping[str, float]) -> NamedCorrection | None:
    """A correction of these values under the name "drawn"; None where there are none."""
    return (
        NamedCorrection("drawn", "2026-01-01", Offsets.from_edge(dict(values)))
        if values
        else None
    )


@dataclass
class Outcome:
    """What a run came to."""

    requests: int
    long_runs: int
    accepted: int
    loss: float
    least: float
    found: list[str]


def run_histories(rng: Rng, runs: int, repeats: int) -> Outcome:
    """Long runs on one drawn machine, each of the arm that took most from the gap when tried.

    A bandit: every arm is tried three times where parts have just come near; the one with the
    greatest reward (gap taken) is repeated, with the next two in between. Where nothing is
    gained any more, three others are drawn. Blocked states are reset as a person would.

    Args:
        rng: draws all.
        runs: how many.
        repeats: requests of each run.

    Returns:
        What it came to; the runs end with the first thing found.
    """
    subject = Subject(rng)
    accepted = made = 0
    for _ in range(runs):
        if rng.random() < 0.25:
            subject.enter()
        else:
            subject.approach()
        arms = subject.arms()
        rewards = np.zeros(len(arms))
        for k in rng.permutation(len(arms)).tolist():
            before = subject.least()
            for _ in range(3):
                arms[k][1]()
                _release(subject)
            rewards[k] = before - subject.least()
            if subject.judge.found:
                return _outcome(subject, made, accepted)
        best = np.argsort(-rewards)[:3].tolist()
        before = subject.least()
        for i in range(repeats):
            k = best[0] if rng.random() < 0.9 else int(rng.choice(best))
            accepted += arms[k][1]()
            if i % 3 == 2:
                _release(subject)
            if i % 200 == 199:  # where nothing is gained any more another arm may
                if before - subject.least() < 1e-9:
                    best = rng.permutation(len(arms))[:3].tolist()
                before = subject.least()
            if subject.judge.found:
                return _outcome(subject, made, accepted)
        made += 1
        subject.scanner.reset(subject.now)
    return _outcome(subject, made, accepted)


def _release(subject: Subject) -> None:
    if subject.scanner.safety.state != "ready":
        subject.scanner.reset(subject.now)


def _outcome(subject: Subject, made: int, accepted: int) -> Outcome:
    """What a history came to, with the first thing found only."""
    judge = subject.judge
    return Outcome(
        subject.requests, made, accepted, judge.loss, judge.least, judge.found[:1]
    )


# What is safe must be allowed --------------------------------------------------------------------


def profile(
    start: float, end: float, speed: float, acceleration: float
) -> Callable[[Array], Array]:
    """Position over time of a motor from rest to rest: a trapezium or a triangle of
    speed.

    Args:
        start, end: positions.
        speed: the most.
        acceleration: of both ramps.

    Returns:
        Gives positions at times from the begin [s], also before and after the motion; its
        attribute `whole` is the duration [s].
    """
    way = abs(end - start)
    sign = math.copysign(1.0, end - start)
    top = min(speed, math.sqrt(way * acceleration))
    rising = top / acceleration if top > 0.0 else 0.0
    whole = 2.0 * rising + ((way - top * rising) / top if top > 0.0 else 0.0)

    def at(t: Array) -> Array:
        """Positions at times from the begin [s]."""
        t = np.clip(t, 0.0, whole)
        late = whole - t
        middle = 0.5 * top * rising + top * (t - rising)
        gone = np.where(
            t < rising, 0.5 * acceleration * t * t,
            np.where(late < rising, way - 0.5 * acceleration * late * late, middle),
        )  # fmt: skip
        return np.asarray(start + sign * gone)

    at.whole = whole  # type: ignore[attr-defined]
    return at


def densest(stage: Stage, model: MachineModel, here: Mapping[str, float],
            targets: Mapping[str, float]) -> tuple[float, float]:  # fmt: skip
    """Sample a move from rest at 400 times and measure every pair there.

    A pair that is near at the start, and only opens until it is apart, does not count.

    Args:
        stage, model: what stands there, and its machine.
        here: positions of all motors.
        targets: of those that move.

    Returns:
        (least clearance, what may be missed between two times) [mm]; inf if no pair
        counts.
    """
    ways = {}
    for m, x in here.items():
        axis = model.data["axes"][m]
        ways[m] = profile(x, targets.get(m, x), axis["speed"], axis["acceleration"])
    whole = max(w.whole for w in ways.values())  # type: ignore[attr-defined]
    times = np.linspace(0.0, whole, 400)
    poses = np.column_stack([ways[m](times) for m in model.motors])
    least, doubt = math.inf, 0.0
    for pair in stage.pairs:
        step = np.diff(poses, axis=0)
        far = (
            np.linalg.norm(step @ (pair.a.slides - pair.b.slides), axis=1)
            + np.abs(step) @ pair.swing
        )
        hidden = float(far.max()) / 2.0
        gaps = pair.distances(poses)
        near = gaps < model.margin + CLEAR_MM + hidden
        away = int(np.argmin(near)) if not near.all() else len(gaps) - 1
        if (
            near[0]
            and not near[away:-1].any()
            and bool(np.all(np.diff(gaps[: away + 1]) >= 0.0))
        ):
            continue
        k = int(np.argmin(gaps))
        if gaps[k] < least:
            least, doubt = float(gaps[k]), hidden
    return least, doubt


@dataclass
class Verdicts:
    """Moves that a dense sweep calls safe or unsafe, and what the scanner said."""

    safe: int = 0
    near: int = 0
    """Of the safe ones, those that began with parts within 0.1 mm of the margin."""
    refused: list[str] = field(default_factory=list)
    unsafe: int = 0
    allowed: list[str] = field(default_factory=list)


def dense_moves(rng: Rng, moves: int) -> Verdicts:
    """Make drawn moves from rest on one drawn machine, and compare answers with dense
    sampling.

    They begin at free poses and where a history of small steps ended. Moves within
    CLEAR_MM of the margin, or in doubt, are not judged.

    Args:
        rng: draws all.
        moves: how many.

    Returns:
        How many were safe and unsafe, and texts of those judged wrongly.
    """
    subject, out = Subject(rng), Verdicts()
    for number in range(moves):
        if number % 3 == 0:
            subject.approach()
            for _ in range(int(rng.integers(20))):  # worn: small steps, some nearer
                axis, step = (
                    str(rng.choice(subject.model.motors)),
                    float(rng.normal(0.0, 2e-3)),
                )
                subject.do(
                    "wear",
                    lambda s, a=axis, x=step: s.move({a: x}, subject.now, relative=True),
                )
        s = subject.scanner
        if s.safety.state != "ready":
            s.reset(subject.now)
        here = s.positions(subject.now)
        pose = subject.draw_pose()
        names = rng.choice(
            list(pose), int(rng.integers(1, len(pose) + 1)), replace=False
        ).tolist()
        part = float(rng.choice([1.0, rng.uniform(0.0, 0.3)]))
        targets = {m: here[m] + part * (pose[m] - here[m]) for m in names}
        least, doubt = densest(subject.stage, subject.model, here, targets)
        error = ""
        try:
            s.move(targets, subject.now)
        except CollisionError as refusal:
            error = str(refusal)
        subject.now = math.nextafter(s.rest_time(subject.now), math.inf)
        said = f"{targets} from {here}: {least:.4f} mm (doubt {doubt:.4f}): {error or 'accepted'}"
        if least - doubt > subject.model.margin + CLEAR_MM:
            out.safe += 1
            out.near += subject.stage.least(here)[0] < subject.model.margin + 0.1
            out.refused += [said] if error else []
        elif least < subject.model.margin - CLEAR_MM:
            out.unsafe += 1
            out.allowed += [] if error else [said]
    return out
