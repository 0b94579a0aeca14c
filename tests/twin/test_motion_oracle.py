"""The motion oracle itself: what is planted is found, and a near miss is none.

Where parts meet is worked out here by hand from the machine file, and from nothing of the
oracle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import pytest
from motion_oracle import (
    MachineModel,
    PairModel,
    Placed,
    Prism,
    Stage,
    Violation,
    Watch,
    hull_distance,
    machine_file,
)

M = MachineModel(machine_file("flexray"))
HOME = {name: float(axis["home"]) for name, axis in M.data["axes"].items()}
C_OBJ, C_DET, AXS_TAN = 14.9192, 40.0008, -0.5405
PANEL_FRONT, PLATFORM_FRONT, BASE, HOLDER = 0.0, 20.0, 100.0, 75.0
SOURCE_FRONT = 0.0
DEPTH = 0.1

Motion = Callable[[float], tuple[float, float]]
"""Position and velocity of a motor at a time."""


def still(x: float) -> Motion:
    return lambda t: (x, 0.0)


def run(
    start: float, to: float, speed: float, begin: float = 0.0, a: float = 50.0
) -> Motion:
    """The textbook's trapezoid, written here again."""
    way, sign = abs(to - start), math.copysign(1.0, to - start)
    peak = min(speed, math.sqrt(a * way))
    ramp, cruise = peak / a, way / peak - peak / a

    def at(t: float) -> tuple[float, float]:
        s = min(max(t - begin, 0.0), 2 * ramp + cruise)
        if s < ramp:
            return start + sign * 0.5 * a * s * s, sign * a * s
        if s < ramp + cruise:
            return start + sign * peak * (s - 0.5 * ramp), sign * peak
        left = 2 * ramp + cruise - s
        return to - sign * 0.5 * a * left * left, sign * a * left

    return at


def bounce(nearest: float, away: float, middle: float, a: float = 50.0) -> Motion:
    """Comes in, is nearest for a moment at `middle`, and goes away again (towards `away`)."""
    sign = math.copysign(1.0, away - nearest)

    def at(t: float) -> tuple[float, float]:
        s = t - middle
        return nearest + sign * 0.5 * a * s * s, sign * a * s

    return at


def look(
    motors: Mapping[str, Motion],
    seconds: float,
    sample: Placed | None = None,
    correction: Mapping[str, float] | None = None,
    accelerations: Mapping[str, float] | None = None,
    begin: float = 0.0,
) -> list[Violation]:
    ways = {**{name: still(x) for name, x in HOME.items()}, **motors}
    watch = Watch(Stage(M, sample, correction), {n: w(begin)[0] for n, w in ways.items()})
    return watch.look(
        lambda t: {n: w(t)[0] for n, w in ways.items()},
        lambda t: {n: w(t)[1] for n, w in ways.items()},
        begin,
        begin + seconds,
        accelerations,
    )


def met(found: list[Violation], first: str, second: str) -> list[Violation]:
    return [
        v
        for v in found
        if v.kind in ("contact", "margin") and {first, second} <= {*v.what.split()}
    ]


def box(*size: float, **offset: float) -> Placed:
    return Placed(Prism.box(size), offset)


def drum(diameter: float, height: float) -> Placed:
    angles = 2.0 * np.pi * np.arange(32) / 32
    ring = 0.5 * diameter * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return Placed(Prism(-0.5 * height, 0.5 * height, ring))


S30, C30 = math.sin(math.radians(30.0)), math.cos(math.radians(30.0))
CASES: dict[str, tuple[tuple[str, str], float, Placed | None, dict[str, float]]] = {
    # pair, mag_obj at which it just touches while mag_det is at 700, sample, correction
    "box and box": (
        ("sample_base", "detector_platform"),
        700 + C_DET + PLATFORM_FRONT - C_OBJ - BASE, None, {}),
    "cylinder and box": (
        ("sample_holder", "detector_platform"),
        700 + C_DET + PLATFORM_FRONT - C_OBJ - HOLDER, None, {}),
    "sample and panel": (
        ("sample", "detector"), 700 + C_DET - C_OBJ - 30.0, box(40, 60, 20), {}),
    "turned sample and panel": (
        ("sample", "detector"),
        700 + C_DET - C_OBJ - 0.5 * (80 * S30 + 60 * C30), box(80, 60, 20, rz=30.0), {}),
    "round sample and panel": (
        ("sample", "detector"), 700 + C_DET - C_OBJ - 45.0, drum(90.0, 30.0), {}),
    "tilted sample and panel": (
        ("sample", "detector"),
        700 + C_DET - C_OBJ - 0.5 * (60 * C30 + 20 * S30), box(40, 60, 20, rx=30.0), {}),
    "sample and tilted panel": (
        ("sample", "detector"),
        700 + C_DET - 57.0 * S30 - C_OBJ - 30.0, box(40, 60, 200), {"det_pitch": 30.0}),
    "correction": (
        ("sample", "detector"),
        700 + C_DET - 4.0 - C_OBJ - 3.0 - 30.0, box(40, 60, 20), {"dD_z": -4.0, "dO_z": 3.0}),
    "turned by the correction": (
        ("sample", "detector"),
        700 + C_DET - C_OBJ - 0.5 * (80 * S30 + 60 * C30), box(80, 60, 20), {"alpha": 30.0}),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("kind", ["rest", "moment"])
def test_a_planted_contact_is_found_and_a_near_miss_is_not(case: str, kind: str) -> None:
    pair, touch, sample, correction = CASES[case]

    def found(nearest: float) -> list[Violation]:
        way = (
            run(nearest - 300.0, nearest, 50.0)
            if kind == "rest"
            else bounce(nearest, nearest - 1.0, 0.937)
        )
        motors = {"mag_obj": way, "mag_det": still(700.0)}
        return met(
            look(motors, 1.9 if kind == "moment" else 9.0, sample, correction), *pair
        )

    planted = found(touch + DEPTH)
    assert [v.kind for v in planted] == ["contact"]
    assert found(touch - M.margin - DEPTH) == []
    within = found(touch - M.margin + DEPTH)
    assert [v.kind for v in within] == ["margin"]
    assert within[0].amount == pytest.approx(DEPTH - 0.02, abs=0.02)


@pytest.mark.parametrize("speed", [2.0, 45.0])
@pytest.mark.parametrize("over", [DEPTH, -M.margin - DEPTH])
def test_the_corner_of_a_turning_bar_is_seen_as_it_passes(
    speed: float, over: float
) -> None:
    """It is nearest to the panel for a moment, between two moments at which it is far."""
    half = 0.5 * math.hypot(300.0, 20.0)
    found = look(
        {
            "mag_det": still(700.0),
            "mag_obj": still(700.0 + C_DET - C_OBJ - half + over),
            "tra_det": still(24.1215 - AXS_TAN),  # its middle before the axis
            "rot_obj": run(0.0, 177.0, speed, a=22.5),
        },
        177.0 / speed + speed / 22.5 + 0.1,
        box(300.0, 20.0, 20.0),
    )
    kinds = [v.kind for v in met(found, "sample", "detector")]
    assert kinds == (["contact"] if over > 0.0 else [])


def test_two_that_move_together_are_free_and_one_of_them_alone_is_not() -> None:
    """What was seen first: a refused move stopped one of two motors."""
    both = {"mag_obj": run(950.0, 450.0, 50.0), "mag_det": run(1059.0, 559.0, 50.0)}
    assert look(both, 11.0) == []
    one = {**both, "mag_obj": run(950.0, 715.0, 50.0)}
    assert met(look(one, 11.0), "sample_base", "detector_platform")[0].kind == "contact"


@pytest.mark.parametrize(
    ("motor", "way", "kind"),
    [
        ("tra_obj", run(0.0, 90.0, 50.01), "speed"),
        ("rot_obj", run(0.0, 200.0, 90.01, a=90.0), "speed"),
        ("tra_obj", run(0.0, 90.0, 20.0, a=125.1), "acceleration"),
        ("tra_obj", run(100.0, 194.001, 50.0), "limit"),
        ("tra_obj", bounce(-234.001, 0.0, 0.51), "limit"),
        ("tra_obj", lambda t: (0.0 if t < 0.7123 else 0.01, 0.0), "jump"),
        ("tra_obj", lambda t: (10.0 * t, 10.0 if t < 0.7123 else 9.5), "acceleration"),
    ],
)
def test_planted_violations_of_limits_are_found(
    motor: str, way: Motion, kind: str
) -> None:
    assert kind in {
        v.kind
        for v in look({motor: way}, 1.0 if kind in ("jump", "acceleration") else 5.0)
    }


def test_motion_within_its_limits_is_not_reported() -> None:
    ways = {
        "tra_obj": run(-234.0, 194.0, 50.0, 0.31, 125.0),
        "rot_obj": run(-7200.0, -7000.0, 90.0, 0.77, 90.0),
        "ver_tube": run(40.0, 379.0, 33.3, 0.123, 7.7),
        "tra_tube": bounce(-359.0, 0.0, 0.3333),
    }
    assert look(ways, 1.0) == []
    assert look({n: ways[n] for n in ("tra_obj", "rot_obj", "ver_tube")}, 30.0) == []


def test_less_acceleration_may_be_demanded_of_a_motor() -> None:
    ways = {"tra_obj": run(0.0, 50.0, 50.0, a=20.0)}
    assert look(ways, 6.0, accelerations={"tra_obj": 20.0}) == []
    found = look(ways, 6.0, accelerations={"tra_obj": 19.99})
    assert {v.kind for v in found} == {"acceleration"}
    assert {v.kind for v in look(ways, 6.0, accelerations={"tra_obj": 0.0})} == {
        "acceleration"
    }


def test_a_command_that_makes_a_motor_jump_is_found() -> None:
    watch = Watch(Stage(M), HOME)
    there = {**HOME, "tra_obj": HOME["tra_obj"] + 1e-3}
    rest = dict.fromkeys(HOME, 0.0)
    assert watch.look(lambda t: HOME, lambda t: rest, 0.0, 1.0) == []
    assert [v.kind for v in watch.look(lambda t: there, lambda t: rest, 1.0, 2.0)] == [
        "jump"
    ]


def test_what_begins_too_near_may_stay_and_part_but_not_come_nearer() -> None:
    touch = 700 + C_DET + PLATFORM_FRONT - C_OBJ - BASE
    begin = touch - 0.5  # half a millimetre apart, the margin is one
    det = {"mag_det": still(700.0)}
    away = {**det, "mag_obj": run(begin, begin - 50.0, 50.0)}
    nearer = {**det, "mag_obj": run(begin, begin + 0.1, 50.0)}
    assert look({**det, "mag_obj": still(begin)}, 1.0) == []
    assert look(away, 3.0) == []
    assert [v.kind for v in look(nearer, 1.0)] == ["margin"]
    back = {**det, "mag_obj": run(begin - 50.0, begin, 50.0)}
    assert [v.kind for v in look(back, 3.0)] == ["margin"]


@pytest.mark.slow
def test_closed_forms_and_fcl_and_the_second_opinion_agree() -> None:
    """Random upright bodies: the three ways to a distance know nothing of each other."""
    rng = np.random.default_rng(4)
    rest = np.zeros((1, len(M.motors)))
    for _ in range(150):
        solids = []
        for _ in range(2):
            size = rng.uniform(5.0, 80.0, 3)
            if rng.random() < 0.3:
                solid = Prism.cylinder(size[0], size[2], (0, 0, 0))
            else:
                solid = Prism.box(size).turned(rng.uniform(0.0, 360.0))
            solids.append(solid.moved(*rng.uniform(-60.0, 60.0, 3)))
        stage = Stage(M, Placed(solids[0]))
        body = next(p.b for p in stage.pairs if p.b.name == "sample")
        at_rest = {"origin": np.zeros(3), "slides": np.zeros((len(M.motors), 3)),
                   "turns": np.zeros(len(M.motors))}  # fmt: skip
        a, b = (
            type(body)(**{**vars(body), **at_rest, "shape": solid, "name": str(i)})
            for i, solid in enumerate(solids)
        )
        pair = PairModel(a, b)
        closed = float(pair.distances(rest)[0])
        other = pair._tilted(rest[0])
        third = pair.second_opinion(rest[0])
        assert max(closed, 0.0) == pytest.approx(max(other, 0.0), abs=2e-3)
        assert max(closed, 0.0) == pytest.approx(third, abs=5e-3)


def test_the_second_opinion_on_cubes_by_hand() -> None:
    cube = Prism.box((2.0, 2.0, 2.0)).corners()
    assert hull_distance(cube, cube + [5.0, 0.0, 0.0]) == pytest.approx(3.0, abs=1e-6)
    assert hull_distance(cube, cube + [3.0, 3.0, 3.0]) == pytest.approx(
        math.sqrt(3.0), abs=1e-6
    )
    assert hull_distance(cube, cube + [1.9, 0.0, 0.3]) == 0.0
