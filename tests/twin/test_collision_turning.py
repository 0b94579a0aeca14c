"""Turntables: what two of them carry turns round while neither does; long spins cost no more.

The witness is a bar as a row of points, turned by the sum of both angles, and the tube as a
box.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.convex_solids import box, hull
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.collision.relative import RelativeMotion
from flexdt.twin.errors import CollisionError
from flexdt.twin.machine.description import Machine, parse_machine, profile_of
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import Sample

HALF, WIDE = 150.0, 10.0
BAR = np.array([(x, y) for x in np.linspace(-HALF, HALF, 151) for y in (-WIDE, WIDE)])


def machine(rng: np.random.Generator) -> Machine:
    """A small turntable upon the shipped one, each with a speed and an acceleration of its
    own."""
    quick, slow = rng.uniform(15, 39), rng.uniform(2, 10)
    if rng.random() < 0.5:
        quick, slow = slow, quick
    return parse_machine(f"""
base = "xyzr_cabinet"
name = "two"
allowed_contacts = [["z_carriage", "floor"], ["x_carriage", "z_carriage"], ["lift", "x_carriage"],
                    ["turntable", "lift"], ["mount", "turntable"]]
[axes.F]
kind = "rotation"
lower = -3600.0
upper = 3600.0
home = 0.0
speed = {quick}
max_speed = 60.0
acceleration = {rng.uniform(3, 80)}
max_acceleration = 80.0
[axes.R]
speed = {slow}
acceleration = {rng.uniform(3, 80)}
[geometry]
angle = {{ R = 1.0, F = 1.0 }}
[[components]]
name = "turntable"
role = ""
[[components]]
name = "mount"
axis = "F"
role = "sample_holder"
""")


def distance(positions: dict[str, float]) -> float:
    """From the bar, Z in front of the focal spot, to the tube: a box behind it, 200 mm wide."""
    turn = -math.radians(positions["R"] + positions["F"])
    c, s = math.cos(turn), math.sin(turn)
    x = BAR[:, 0] * c - BAR[:, 1] * s + positions["X"]
    y = BAR[:, 0] * s + BAR[:, 1] * c + positions["Z"]
    return float(np.hypot(np.maximum(np.abs(x) - 100.0, 0.0), np.maximum(y, 0.0)).min())


@pytest.mark.daily(1)
@pytest.mark.parametrize("seed", range(8))
def test_what_turns_round_between_two_turntables_is_seen(seed: int) -> None:
    rng = np.random.default_rng(seed)
    nearest, stopped = math.inf, 0
    for _ in range(25):
        made = machine(rng)
        profile = profile_of(made)
        bar = (box((2 * HALF, 2 * WIDE, 20.0)),)
        guard = SceneGuard(build_scene(made, profile, bar))
        twin = ScannerTwin(made, profile)
        twin.initialise_stage(Sample(), None, guard, 0.0)
        twin.move({"Z": rng.uniform(90.0, 130.0)}, 0.0)
        for _ in range(2):
            start = twin.rest_time(0.0)
            try:
                twin.move(
                    {"R": rng.uniform(-120, 120), "F": rng.uniform(-400, 400)}, start
                )
            except CollisionError:
                stopped += 1
            end = twin.rest_time(start)
            for time in np.linspace(start, end, 300):
                nearest = min(nearest, distance(twin.positions(float(time))))
            if twin.safety.contact is not None:
                break
    assert nearest >= made.safety_margin_mm - 1e-6
    assert stopped >= 4


def test_turns_after_the_first_are_not_looked_at_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A long spin costs what a short one does, and ends or is refused as it would be."""
    looks = 0
    look = RelativeMotion.look

    def counted(self: RelativeMotion, *args: object) -> object:
        nonlocal looks
        looks += 1
        return look(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(RelativeMotion, "look", counted)
    rng = np.random.default_rng(5)
    made = parse_machine('base = "xyzr_cabinet"\nname = "one"\n')
    profile = profile_of(made)
    angles = 2.0 * np.pi * np.arange(36) / 36
    ring = 80.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    disc = hull(np.concatenate([np.c_[ring, np.full(36, z)] for z in (-20.0, 20.0)]))
    bar = box((2 * HALF, 2 * WIDE, 20.0))
    results, most = [], 0
    for trial in range(30):
        if (
            trial % 2
        ):  # a disc that passes the tube's corner, 100 mm aside, within some mm
            sample, aside = disc, 160.0
            place = math.sqrt(rng.uniform(82.1, 84.0) ** 2 - 60.0**2)
            free = True
        else:  # a bar whose corner does, or does not
            sample, aside, place = bar, 0.0, rng.uniform(140.0, 165.0)
            free = place > math.hypot(HALF, WIDE) + made.safety_margin_mm
        costs, ends = [], []
        for turns in (3, 90):
            twin = ScannerTwin(made, profile)
            twin.initialise_stage(
                Sample(), None, SceneGuard(build_scene(made, profile, (sample,))), 0.0
            )
            twin.move({"R": 45.0, "X": aside}, 0.0)
            twin.move({"Z": place}, start := twin.rest_time(0.0))
            start = twin.rest_time(start)
            looks = 0
            try:
                twin.move({"R": 45.0 + 360.0 * turns}, start)
                ends.append("free")
            except CollisionError as error:
                ends.append(str(error.data.get("halts_at")))
            costs.append(looks)
        assert ends[0] == ends[1]
        assert (ends[0] == "free") == free
        assert costs[1] <= 2 * costs[0]
        results.append(free)
        most = max(most, *costs)
    assert 5 < sum(results) < 28
    assert most > 100
