"""Does a sweep ever miss a contact, and how long does it take? Random aimed sweeps, measured.

Two convex bodies are sent at each other on random motors: translations, rotations, both,
several motors of both bodies at once, with walls of 0.1 mm and samples of up to 400 mm. Every
sweep is compared with dense sampling along the same trajectories (a step of at most 0.25 mm;
distances by fcl without any of the sweep's code, and for boxes the separating axis test written
here). Then random motions of the whole FleX-ray and checks of whole scripts are timed.

    python tests/studies/collision_study.py --sweeps 10000 --moves 2000 --json study.json
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, product
from pathlib import Path

import fcl
import numpy as np
from scipy.spatial.transform import Rotation

from flexdt.phantoms import load_phantom
from flexdt.twin.collision.collision_scene import CollisionScene, build_scene, scene_of
from flexdt.twin.collision.convex_pieces import convex_pieces
from flexdt.twin.collision.convex_solids import (
    ConvexSolid,
    Polytope,
    UprightCylinder,
    box,
    hull,
)
from flexdt.twin.collision.first_contact import PathSearch, SweepResult
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.collision.plan_report import collision_check
from flexdt.twin.collision.relative import Limits
from flexdt.twin.collision.stages import Body
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.dry_run import check_script
from flexdt.twin.script.scan_request import ScanRequest

AXES = ("ax", "ay", "az", "a_turn", "bx", "by", "bz", "b_turn")
KINDS = ("translation", "rotation", "both", "several axes")
MARGIN, TOLERANCE = 1.0, 0.01
STEP_MM = 0.25
SCRIPTS = Path(__file__).parents[2] / "examples" / "scripts"
NOISE = 1e-3
"""Error allowed to the reference's own distances [mm]: fcl's cylinders reach it."""


@dataclass(frozen=True)
class Case:
    """Two bodies and their motors."""

    kind: str
    shapes: tuple[str, str]
    scene: CollisionScene
    trajectories: Mapping[str, Trajectory]
    end: float


@dataclass(frozen=True)
class Outcome:
    """One sweep beside its reference; clearances in mm."""

    kind: str
    shapes: tuple[str, str]
    seconds: float
    looks: int
    stopped: bool
    stop_clearance: float
    least_before: float
    least: float
    reported: float
    touches: bool
    samples: int


def random_solid(rng: np.random.Generator) -> tuple[str, ConvexSolid]:
    """Draw a convex solid of a random kind, size and orientation, in half of the cases
    off its frame's origin by up to 60 mm.

    Returns:
        Name of the kind, and the solid.
    """
    name = rng.choice(["box", "hull", "wall", "long", "cylinder"])
    center = rng.uniform(-60, 60, 3) * rng.integers(0, 2)
    turn = Rotation.random(random_state=rng).as_matrix()
    if name == "cylinder":
        return name, UprightCylinder(
            (0.0, 0.0, float(center[2])), rng.uniform(2, 80), rng.uniform(2, 60)
        )
    if name == "hull":
        points = rng.normal(size=(rng.integers(5, 60), 3)) * rng.uniform(2, 40, 3)
        return name, hull(points @ turn.T + center)
    sizes = {
        "box": rng.uniform(5, 150, 3),
        "wall": np.array([0.1, *rng.uniform(50, 300, 2)]),
        "long": np.array([*rng.uniform(2, 10, 2), rng.uniform(150, 400)]),
    }
    solid = box(sizes[str(name)])
    return str(name), Polytope(solid.vertices @ turn.T + center, solid.faces)


def random_trajectory(rng: np.random.Generator, span: float) -> Trajectory:
    """Draw a motor's trajectory over about `span` [mm or deg], begun up to 2 s late, in
    three of ten cases retargeted on the way.
    """
    start = rng.uniform(0, 2) * rng.integers(0, 2)
    speed, acceleration = rng.uniform(0.05, 0.5) * span, rng.uniform(0.02, 1.0) * span
    first = motion.move(0.0, 0.0, span, speed, acceleration, start)
    if rng.random() < 0.7:
        return first
    at = start + rng.uniform(0.1, 0.9) * first.duration
    target = rng.uniform(-0.3, 1.3) * span
    new = motion.move(
        first.position(at), first.velocity(at), target, speed, acceleration, at
    )
    before = tuple(p for p in first.pieces if p.start < at)
    return Trajectory(before + new.pieces, new.end, new.target)


def random_case(rng: np.random.Generator, kind: str) -> Case:
    """Draw two bodies that move towards each other: at a random time they overlap by up
    to 30 mm, graze, or pass within 30 mm.

    Args:
        rng: of all draws.
        kind: of KINDS; chooses which motors move.
    """
    (name_a, a), (name_b, b) = random_solid(rng), random_solid(rng)
    moving = {
        "translation": ["ax"],
        "rotation": ["a_turn"],
        "both": ["ax", "a_turn"],
        "several axes": [n for n in AXES if rng.random() < 0.7] or ["ax"],
    }[kind]
    trajectories = {
        n: random_trajectory(
            rng, rng.uniform(20, 720) if "turn" in n else rng.uniform(50, 600)
        )
        for n in moving
    }
    end = max(t.end for t in trajectories.values())
    slides = np.zeros((2, len(AXES), 3))
    turns = np.zeros((2, len(AXES)))
    for i in range(2):
        slides[i, 4 * i : 4 * i + 3] = Rotation.random(random_state=rng).as_matrix()
        turns[i, 4 * i + 3] = math.radians(1.0)
    spins = [
        np.array([0.0, 0.0, -1.0])
        if isinstance(s, UprightCylinder) or rng.random() < 0.3
        else _unit(rng)
        for s in (a, b)
    ]
    bodies = [
        Body(n, s, np.zeros(3), slides[i], turns[i], n, "world", spins[i])
        for i, (n, s) in enumerate((("a", a), ("b", b)))
    ]
    at = rng.uniform(0.1, 1.0) * end
    q = np.array(
        [trajectories[n].position(at) if n in trajectories else 0.0 for n in AXES]
    )
    # At that time a plane across `normal` leaves this much room between them (less than none:
    # hit).
    normal = _unit(rng)
    room = rng.choice([rng.uniform(-30, 0), rng.uniform(0, 3), rng.uniform(0, 30)])
    (turn_a, origin_a), (turn_b, origin_b) = (pose_at(body, q) for body in bodies)
    tip_a = origin_a + turn_a @ _tip(a, normal @ turn_a)
    tip_b = origin_b + turn_b @ _tip(b, -normal @ turn_b)
    origin = tip_a + room * normal - tip_b
    bodies[1] = Body("b", b, origin, slides[1], turns[1], "b", "world", spins[1])
    scene = scene_of(
        AXES,
        bodies,
        (),
        reach=np.tile([-1e4, 1e4], (len(AXES), 1)),
        home=np.zeros(len(AXES)),
        limits=Limits(MARGIN, TOLERANCE, (0.1, 0.02)),
    )
    return Case(kind, (name_a, name_b), scene, trajectories, end)


def pose_at(body: Body, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orientation and origin of a body, by scipy."""
    turn = Rotation.from_rotvec(float(q @ body.turns) * body.spin_axis).as_matrix()
    return turn, body.origin + q @ body.slides


def _unit(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def _tip(solid: ConvexSolid, direction: np.ndarray) -> np.ndarray:
    """Return the solid's farthest point along `direction`."""
    if isinstance(solid, Polytope):
        return solid.vertices[np.argmax(solid.vertices @ direction)]
    assert isinstance(solid, UprightCylinder)
    across = direction[:2] / max(np.linalg.norm(direction[:2]), 1e-12) * solid.radius
    return np.array(solid.center) + [
        *across,
        math.copysign(0.5 * solid.height, direction[2]),
    ]


def reference(case: Case, times: np.ndarray) -> np.ndarray:
    """Compute the clearances [mm] at `times` [s] by fcl, straight from the trajectories;
    0 where the bodies overlap.

    Two boxes overlap, too, where no separating axis is found.
    """
    columns = [
        case.trajectories[n].positions(times) if n in case.trajectories else 0.0 * times
        for n in AXES
    ]
    q = np.stack(columns, axis=1)
    objects, poses = [], []
    for body in case.scene.bodies:
        turns = Rotation.from_rotvec(
            (q @ body.turns)[:, None] * body.spin_axis
        ).as_matrix()
        origins = body.origin + q @ body.slides
        solid = body.solid
        if isinstance(solid, UprightCylinder):
            shape = fcl.Cylinder(solid.radius, solid.height)
            origins = origins + turns @ np.array(solid.center)
        else:
            assert isinstance(solid, Polytope)
            faces = np.concatenate(
                [np.full((len(solid.faces), 1), 3), solid.faces], axis=1
            )
            shape = fcl.Convex(np.array(solid.vertices), len(solid.faces), faces.ravel())
        objects.append(fcl.CollisionObject(shape))
        poses.append((turns, origins))
    out = np.empty(len(times))
    for i in range(len(times)):
        for thing, (turns, origins) in zip(objects, poses, strict=True):
            thing.setTransform(fcl.Transform(turns[i], origins[i]))
        out[i] = max(0.0, fcl.distance(objects[0], objects[1]))
    if all(name in ("box", "wall", "long") for name in case.shapes):
        # A second opinion on touching: without a separating axis, two boxes overlap.
        vertices = [b.solid.vertices for b in case.scene.bodies]
        out[~separated(vertices, poses)] = 0.0
    return out


def separated(
    vertices: Sequence[np.ndarray], poses: Sequence[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Test at n poses whether a separating axis of two boxes exists, (n,).

    Args:
        vertices: (8, 3) corners of each box.
        poses: of each box, turns (n, 3, 3) and origins (n, 3).
    """
    corners = [
        v @ np.swapaxes(r, 1, 2) + o[:, None]
        for v, (r, o) in zip(vertices, poses, strict=True)
    ]
    edges = [c[:, [1, 2, 4]] - c[:, [0]] for c in corners]
    edges = [e / np.linalg.norm(e, axis=2, keepdims=True) for e in edges]
    axes = [edges[0][:, i] for i in range(3)] + [edges[1][:, i] for i in range(3)]
    axes += [
        np.cross(edges[0][:, i], edges[1][:, j]) for i, j in product(range(3), range(3))
    ]
    apart = np.zeros(len(corners[0]), dtype=bool)
    for axis in axes:
        usable = np.linalg.norm(axis, axis=1) > 1e-6
        a, b = (np.einsum("nki,ni->nk", c, axis) for c in corners)
        gap = np.maximum(a.min(axis=1) - b.max(axis=1), b.min(axis=1) - a.max(axis=1))
        apart |= usable & (gap > 0.0)
    return apart


def sample_times(case: Case) -> np.ndarray:
    """Choose times from 0 to the end at most `STEP_MM` of the bodies' way apart, but
    between 2001 and 12001 of them.
    """
    fine = np.linspace(0.0, case.end, 2001)
    way = np.zeros(2000)
    for n, t in case.trajectories.items():
        per_unit = 1.0
        if "turn" in n:
            body = case.scene.bodies[0 if n[0] == "a" else 1]
            per_unit = math.radians(1.0) * body.reach
        way += np.abs(np.diff(t.positions(fine))) * per_unit
    total = np.concatenate([[0.0], np.cumsum(way)])
    count = int(np.clip(total[-1] / STEP_MM, 2001, 12001))
    return np.union1d(
        np.interp(np.linspace(0, total[-1], count), total, fine), [0.0, case.end]
    )


def swept(
    scene: CollisionScene, trajectories: Mapping[str, Trajectory], end: float
) -> SweepResult:
    """Find the first contact from 0 s to `end` [s], or without one the least clearance, as
    `check` does."""
    search = PathSearch(scene, scene.path(trajectories, 0.0, end))
    found = search.first_contact()
    return search.refined(found) if found.contact is None else found


def judge(case: Case) -> Outcome | None:
    """Sweep a case once, then three times by the clock, and compare the last sweep with
    the reference.

    Returns:
        The outcome, with the least of the three times; None where the bodies begin nearer
        to each other than the margin and 0.1 mm.
    """
    if reference(case, np.zeros(1))[0] < MARGIN + 0.1:
        return None
    swept(
        case.scene, case.trajectories, case.end
    )  # a scene is made once, swept many times
    seconds = math.inf
    for _ in range(3):  # the least of three: others use this machine too
        begin = time.perf_counter()
        result = swept(case.scene, case.trajectories, case.end)
        seconds = min(seconds, time.perf_counter() - begin)
    times = sample_times(case)
    clearances = reference(case, times)
    contact = result.contact
    stop = math.inf if contact is None else contact.time
    return Outcome(
        case.kind,
        case.shapes,
        seconds,
        result.looks,
        contact is not None,
        math.nan if contact is None else float(reference(case, np.array([stop]))[0]),
        float(clearances[times <= stop].min()),
        float(clearances.min()),
        result.min_clearance_mm,
        bool((clearances <= 0.0).any()),
        len(times),
    )


def study_pairs(sweeps: int, seed: int, progress: Callable[[int], None]) -> list[Outcome]:
    """Draw cases until `sweeps` of them could be judged, the kinds in turn.

    Args:
        sweeps: number of outcomes.
        seed: of the draws.
        progress: called with the number of outcomes so far.
    """
    out: list[Outcome] = []
    draw = 0
    while len(out) < sweeps:
        rng = np.random.default_rng([seed, draw])
        outcome = judge(random_case(rng, KINDS[len(out) % len(KINDS)]))
        draw += 1
        if outcome is not None:
            out.append(outcome)
            progress(len(out))
    return out


def summary(outcomes: Sequence[Outcome]) -> dict[str, object]:
    """Sum up counts, clearances [mm] and times [ms] of sweeps by name; `missed` are
    sweeps that let the clearance fall below the margin.

    Values of no outcome are None; there must be one outcome at least.
    """
    ms = np.array([o.seconds for o in outcomes]) * 1e3
    stops = [o for o in outcomes if o.stopped]
    free = [o for o in outcomes if not o.stopped]
    over = [o.reported - o.least for o in free if math.isfinite(o.reported)]
    return {
        "sweeps": len(outcomes),
        "reference_touches": sum(o.touches for o in outcomes),
        "reference_within_margin": sum(o.least < MARGIN for o in outcomes),
        "stops": len(stops),
        "missed": sum(o.least_before < MARGIN - NOISE for o in outcomes),
        "missed_touches": sum(o.touches and not o.stopped for o in outcomes),
        "false_stops": sum(o.stop_clearance > MARGIN + TOLERANCE + NOISE for o in stops),
        "stops_short_of_touching": sum(not o.touches for o in stops),
        "stops_where_reference_keeps_margin": sum(o.least >= MARGIN for o in stops),
        "least_clearance_at_stops_mm": min(
            (o.stop_clearance for o in stops), default=None
        ),
        "greatest_clearance_at_stops_mm": max(
            (o.stop_clearance for o in stops), default=None
        ),
        "least_clearance_error_mm": [min(over), max(over)] if over else None,
        "least_clearance_beyond_accuracy": sum(
            o.reported > o.least + max(0.1, 0.02 * o.reported) + NOISE
            for o in free
            if math.isfinite(o.reported)
        ),
        "median_ms": float(np.median(ms)),
        "p95_ms": float(np.percentile(ms, 95)),
        "worst_ms": float(ms.max()),
        "median_looks": float(np.median([o.looks for o in outcomes])),
        "worst_looks": max(o.looks for o in outcomes),
        "reference_samples": sum(o.samples for o in outcomes),
    }


def study_machine(moves: int, seed: int) -> dict[str, object]:
    """Time sweeps of the complete FleX-ray with a LEGO-sized sample, 1 to 8 motors moving
    at once to random targets.

    Returns:
        Counts of moves, bodies, pairs and stops, and median, 95 % and worst times [ms] of
        the sweep and of the guard.
    """
    machine = builtin_machine()
    scene = build_scene(
        machine, builtin_profile(machine.default_profile), [box((24, 16, 49.8))]
    )
    guard = SceneGuard(scene)
    rng = np.random.default_rng([seed, 1])
    full, only_contacts, stops = [], [], 0
    for _ in range(moves):
        count = rng.integers(1, 1 + len(machine.axes))
        chosen = rng.choice(list(machine.axes), count, replace=False)
        trajectories = {}
        for name, a in machine.axes.items():
            low, high = (-720.0, 720.0) if a.kind == "rotation" else (a.lower, a.upper)
            target = rng.uniform(low, high) if name in chosen else a.home
            trajectories[name] = motion.move(
                a.home, 0.0, target, a.speed, a.acceleration, 0.0
            )
        end = max(t.end for t in trajectories.values())
        begin = time.perf_counter()
        result = swept(scene, trajectories, end)
        between = time.perf_counter()
        guard(trajectories, 0.0)
        only_contacts.append((time.perf_counter() - between) * 1e3)
        full.append((between - begin) * 1e3)
        stops += result.contact is not None
    return {
        "moves": moves,
        "bodies": len(scene.bodies),
        "pairs": len(scene.pairs),
        "stops": stops,
        "median_ms": float(np.median(full)),
        "p95_ms": float(np.percentile(full, 95)),
        "worst_ms": float(np.max(full)),
        "guard_median_ms": float(np.median(only_contacts)),
        "guard_worst_ms": float(np.max(only_contacts)),
    }


def study_scripts() -> dict[str, object]:
    """Time complete checks (parse, plan, optics, collisions) of four sets of scripts,
    best of five.

    Returns:
        Name of the set -> time [ms], and frames, collisions and least clearance [mm] of
        its last script.
    """
    machine = builtin_machine()
    profile = builtin_profile(machine.default_profile)
    lego = convex_pieces(load_phantom("lego").mesh())
    close = [
        box((300, 20, 40))
    ]  # a bar that sweeps past the panel with a few mm to spare
    fly = compose_script(ScanRequest("fly", frames=1440), machine, profile)
    step = compose_script(ScanRequest("step", frames=1440), machine, profile)
    near = compose_script(
        ScanRequest("step", frames=1440, sdd_mm=757.0), machine, profile
    )
    shipped = [f.read_bytes() for f in SCRIPTS.glob("*.txt")]
    hundred = [text for _, text in zip(range(100), cycle(shipped), strict=False)]
    cases = {
        "fly_1440": ([fly], lego),
        "step_1440": ([step], lego),
        "step_1440_long_sample_near_panel": ([near], close),
        "100_example_scripts": (hundred, lego),
    }
    out: dict[str, object] = {}
    for name, (texts, sample) in cases.items():
        best, report = math.inf, None
        for _ in range(5):
            begin = time.perf_counter()
            for text in texts:
                report = check_script(
                    text, machine, profile, collision=collision_check(sample)
                )
            best = min(best, time.perf_counter() - begin)
        assert report is not None
        assert report.clearance is not None
        out[name] = {
            "ms": best * 1e3,
            "frames": report.plan.frames,
            "collisions": len(report.clearance.collisions),
            "min_clearance_mm": report.clearance.min_clearance_mm,
        }
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study, print its figures as JSON, and write them to a file if one is named.

    Returns:
        1 if a contact was missed, a stop false or a clearance wrong; else 0.
    """
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--sweeps", type=int, default=2000)
    parser.add_argument("--moves", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)

    def progress(done: int) -> None:
        """Show the number of sweeps done in a terminal, every hundred."""
        if sys.stderr.isatty() and done % 100 == 0:
            print(f"\r{done}/{options.sweeps}", end="", file=sys.stderr)

    outcomes = study_pairs(options.sweeps, options.seed, progress)
    document = {
        "margin_mm": MARGIN,
        "tolerance_mm": TOLERANCE,
        "pairs": {
            "all": summary(outcomes),
            **{k: summary([o for o in outcomes if o.kind == k]) for k in KINDS},
            "thin wall": summary([o for o in outcomes if "wall" in o.shapes]),
            "long sample": summary([o for o in outcomes if "long" in o.shapes]),
        },
        "flexray": study_machine(options.moves, options.seed),
        "scripts": study_scripts(),
    }
    print(json.dumps(document, indent=1))
    if options.json:
        options.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    total = document["pairs"]["all"]
    wrong = ("missed", "missed_touches", "false_stops", "least_clearance_beyond_accuracy")
    return int(any(total[name] for name in wrong))


if __name__ == "__main__":
    sys.exit(main())
