"""Samples on a stage of the turntable: what such a stage can sweep is not what overlaps."""

from __future__ import annotations

import random

import numpy as np
import pytest

from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.convex_solids import UprightCylinder
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.errors import CollisionError
from flexdt.twin.machine.description import parse_machine, profile_of
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import Sample

EDGE, BELOW = 135.0, 30.0
"""Where the hood ends before the axis, which stands at y = 150, and its underside [mm]."""
MACHINE = parse_machine("""
base = "micro_ct"
name = "hooded"
[[components]]
name = "hood"
center_mm = [0.0, 85.0, 40.0]
size_mm = [200.0, 100.0, 20.0]
""")
BOTTOM = -31.0


def cylinder(radius: float, top: float) -> UprightCylinder:
    middle = 0.5 * (top + BOTTOM)
    return UprightCylinder((0.0, 0.0, middle), radius, top - BOTTOM)


def really_overlaps(radius: float, top: float, y: float) -> float:
    """How deep a cylinder on the axis is in the hood, by hand [mm]."""
    return max(0.0, min(EDGE - (150.0 + y - radius), top - BELOW))


def stage(radius: float, top: float) -> SceneGuard:
    return SceneGuard(build_scene(MACHINE, profile_of(MACHINE), (cylinder(radius, top),)))


@pytest.mark.parametrize("seed", range(60))
def test_the_reach_of_one_sample_excuses_no_overlap_of_another(seed: int) -> None:
    """A sample that may come near, within its mount's reach, is replaced by drawn ones: one
    that overlaps really, and deeper than the first did, is refused."""
    rng = random.Random(seed)
    at = {"CX": 0.0, "CY": rng.uniform(-4.0, 4.0)}
    first = rng.uniform(8.0, 20.0), rng.uniform(31.0, 40.0)
    second = rng.uniform(8.0, 20.0), rng.uniform(29.0, 40.0)
    scanner = ScannerTwin(MACHINE, profile_of(MACHINE))
    scanner.place(at, 0.0)
    scanner.initialise_stage(Sample(), None, stage(*first), 0.0)
    change = scanner.stage_change(Sample(), None, stage(*second), 0.0)
    try:
        change.certified()
        allowed = True
    except CollisionError:
        allowed = False
    before, after = really_overlaps(*first, at["CY"]), really_overlaps(*second, at["CY"])
    if after > before + 0.2 and after > 0.0:  # a floor is a rung of 0.1 mm
        assert not allowed, (first, second, at, before, after)


def test_a_sample_that_overlaps_is_refused_behind_one_that_only_may_reach() -> None:
    """And that one may be put there again, and a smaller one."""
    scanner = ScannerTwin(MACHINE, profile_of(MACHINE))
    scanner.initialise_stage(Sample(), None, stage(12.0, 35.0), 0.0)
    assert scanner.state(0.0).safety.state == "blocked"
    assert really_overlaps(12.0, 35.0, 0.0) == 0.0
    assert really_overlaps(16.0, 31.5, 0.0) == 1.0
    with pytest.raises(CollisionError, match="hood"):
        scanner.stage_change(Sample(), None, stage(16.0, 31.5), 0.0).certified()
    for radius, top in ((12.0, 35.0), (11.0, 35.0), (3.0, 20.0)):
        scanner.stage_change(Sample(), None, stage(radius, top), 0.0).certified()


def test_the_scene_of_a_pose_is_that_of_its_parts_where_they_stand() -> None:
    guard = stage(12.0, 35.0)
    for y in np.linspace(-4.5, 4.5, 10):
        at = {"CY": float(y)}
        there = guard.standing(at).touching(at, deep=True)
        gap = 3.0 + y  # from the cylinder to the hood's edge, level
        found = there.get(("hood", "sample"), there.get(("sample", "hood")))
        if gap > MACHINE.safety_margin_mm + 0.1:
            assert found is None
        else:
            assert found == pytest.approx(gap, abs=0.15)
    assert guard.touching({}, deep=True)  # but it may be brought there
