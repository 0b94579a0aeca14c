"""Trajectories as data sets: the plan is that of a script with the same steps, the flat is
empty.

The script is written here line by line; where the sample's shadow falls is computed here, from
the motors and the machine file's figures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.machine.camera import Roi
from flexdt.twin.machine.description import (
    Machine,
    Profile,
    builtin_machine,
    parse_machine,
    profile_of,
)
from flexdt.twin.script import ScanPlan, StartState, plan_poses, plan_script
from flexdt.twin.script.motor_targets import BESIDE_BEAM_MM
from flexdt.twin.script.planning.plan_values import Exposure, SampleSize

SEEDS = range(12)


def drawn(
    rng: np.random.Generator, machine: Machine
) -> tuple[list[dict[str, float]], StartState]:
    """Poses of some motors, and a start with another camera."""
    around = {
        n: (float(rng.uniform(a.lower, a.upper)), (a.upper - a.lower) * 0.01)
        for n, a in machine.axes.items()
        if rng.random() < 0.5 or a.kind == "rotation"
    }
    poses = [
        {
            n: round(float(at + rng.uniform(0, width)), 3)
            for n, (at, width) in around.items()
        }
        for _ in range(int(rng.integers(1, 5)))
    ]
    for n in around:
        a = machine.axes[n]
        for pose in poses:
            pose[n] = min(max(pose[n], a.lower), a.upper)
    start = StartState.of(machine)
    camera = replace(start.camera, averages=int(rng.integers(1, 4)), exposure_ms=70.0)
    return poses, replace(start, camera=camera, xrays_on=bool(rng.random() < 0.5))


def written(
    poses: Sequence[Mapping[str, float]],
    start: StartState,
    away: Mapping[str, float] | None,
) -> str:
    """The script that somebody would write who wants these images; `away` is where the flat
    is."""
    camera = start.camera
    lines = [
        f"camera\tset mode\t{camera.mode}\t\tACK",
        f"camera\tset ROI\t{camera.roi}\t\tACK",
        f"camera\tset exposure\t{camera.exposure_ms}\t\tACK",
        "camera\tset number of frames\t1\t\tACK",
        f"tube\tset kV\t{start.kV}\t\tACK",
        f"tube\tset power\t{start.power_W}\t\tACK",
    ]
    here = dict(start.positions)

    def go(pose: Mapping[str, float], *, all_of_them: bool) -> None:
        moved = {n: x for n, x in pose.items() if all_of_them or x != here[n]}
        if len(moved) > 1:
            lines.extend(
                f"{n}\tmove absolute\t{x!r}\t\tno wait" for n, x in moved.items()
            )
        lines.extend(f"{n}\tmove absolute\t{x!r}\t\tACK" for n, x in moved.items())
        here.update(moved)

    def image(name: str) -> None:
        lines.extend(
            ["camera\ttake image\t\t\tACK", f"camera\tsave image\tE:\\a\\{name}\t\tACK"]
        )

    if away is not None:
        go(away, all_of_them=False)
    lines += ["tube\txrayoff\t\t\tACK", "camera\tset number of averages\t10\t\tACK"]
    image("di000000.tif")
    lines += [
        "tube\txrayon\t\t\tACK",
        "tube\tREPEAT UNTIL TRUE status_XReady_get\t\t\tACK",
    ]
    if away is not None:
        image("io000000.tif")
    lines.append(f"camera\tset number of averages\t{camera.averages}\t\tACK")
    for i, pose in enumerate(poses):
        if i == 0 and away is not None:
            go({**start.positions, **pose}, all_of_them=False)
        go(pose, all_of_them=True)
        if i == 0:
            lines.append("scanner\twrite settings file\t\t\tACK")
        image(f"scan_{i:06d}.tif")
    lines.append("tube\txrayoff\t\t\tACK")
    return "\r\n".join(lines)


def bare(plan: ScanPlan) -> list[Exposure]:
    return [replace(e, line=0) for e in plan.exposures]


@pytest.mark.parametrize("seed", SEEDS)
def test_the_plan_is_that_of_a_script_with_the_same_steps(seed: int) -> None:
    rng = np.random.default_rng(4000 + seed)
    machine = builtin_machine(["flexray", "xyzr_cabinet", "micro_ct"][seed % 3])
    profile = profile_of(machine)
    poses, start = drawn(rng, machine)
    for flat in (True, False):
        plan = plan_poses(poses, machine, profile, start=start, flat=flat)
        away = next((e.positions for e in plan.exposures if e.kind == "flat"), None)
        assert (away is not None) == flat
        assert {e.line for e in plan.exposures if e.kind != "projection"} == {0}
        pictures = [e.line for e in plan.exposures if e.kind == "projection"]
        assert pictures == [*range(1, len(poses) + 1)]
        script = plan_script(written(poses, start, away), machine, profile, start=start)
        assert bare(plan) == bare(script)
        assert plan.duration_s == script.duration_s
        assert plan.settings == script.settings
        assert plan.trajectories == script.trajectories
        expected = {(p.code, p.message) for p in script.problems}
        assert {
            (p.code, p.message) for p in plan.problems if p.code != "no_flat"
        } == expected
        assert any(p.code == "no_flat" for p in plan.warnings) != flat


@pytest.mark.parametrize("seed", SEEDS)
def test_the_sample_casts_no_shadow_into_the_flat(seed: int) -> None:
    """On the FleX-ray: every ray through the cylinder that holds the sample misses the
    image."""
    rng = np.random.default_rng(5000 + seed)
    machine = builtin_machine("flexray")
    profile = profile_of(machine)
    start = StartState.of(machine)
    left, top = int(rng.integers(0, 400)), int(rng.integers(0, 300))
    roi = Roi(left, top, left + int(rng.integers(100, 1500)), top + 1000)
    start = replace(start, camera=replace(start.camera, roi=roi))
    size = SampleSize(float(rng.uniform(5, 70)), 40.0)
    first = {
        "mag_obj": float(rng.uniform(150, 700)),
        "tra_obj": float(rng.uniform(-20, 20)),
        "tra_det": 25.3 + float(rng.uniform(-10, 10)),
    }
    plan = plan_poses(
        [first, {"rot_obj": 5.0}], machine, profile, start=start, sample=size
    )
    [flat] = [e for e in plan.exposures if e.kind == "flat"]
    at = flat.positions
    assert {n: x for n, x in at.items() if n != "tra_obj"} == {
        n: first.get(n, x) for n, x in start.positions.items() if n != "tra_obj"
    }
    # x of the axis and of the image's edges as seen from the source at x = tra_tube.
    axis_x = at["tra_obj"] + profile.axs_tan - at["tra_tube"]
    axis_y = at["mag_obj"] + profile.c_obj
    middle = -at["tra_det"] + profile.det_tan - at["tra_tube"]
    edges = [middle + (x - 0.5 - 971.5) * 0.0748 for x in (roi.left, roi.right + 1)]
    distance = at["mag_det"] + profile.c_det
    around = np.linspace(0.0, 2 * math.pi, 720)
    x = axis_x + size.diameter_mm / 2 * np.cos(around)
    y = axis_y + size.diameter_mm / 2 * np.sin(around)
    shadow = x / y * distance
    assert shadow.min() > edges[1] or shadow.max() < edges[0]
    # Beside the field of view where the sample stands, unless the travel ends before.
    gaps = [abs(axis_x - edge * axis_y / distance) for edge in edges]
    travel = machine.axes["tra_obj"]
    if travel.lower < at["tra_obj"] < travel.upper:
        assert min(gaps) - size.diameter_mm / 2 == pytest.approx(BESIDE_BEAM_MM, abs=1e-5)
    assert not any(p.code == "sample_in_flat" for p in plan.problems)


def test_a_flat_where_it_was_asked_for(flexray: Machine, profile: Profile) -> None:
    poses, flat = (
        [{"rot_obj": 10.0}, {"rot_obj": 20.0}],
        {"tra_obj": 150.0, "mag_obj": 500.0},
    )
    start = StartState.of(flexray)
    plan = plan_poses(poses, flexray, profile, start=start, flat=flat)
    dark, taken, *images = plan.exposures
    assert dark.positions == taken.positions == {**start.positions, **flat}
    assert [e.positions for e in images] == [
        {**start.positions, **pose} for pose in poses
    ]
    assert [e.kind for e in plan.exposures] == [
        "dark",
        "flat",
        "projection",
        "projection",
    ]
    assert [e.xrays_on for e in plan.exposures] == [False, True, True, True]

    clamped = plan_poses(poses, flexray, profile, flat={"tra_obj": 900.0})
    assert [(p.line, p.code) for p in clamped.problems] == [(0, "limit_clamped")]
    with pytest.raises(UnknownNameError, match="rot_obj"):
        plan_poses(poses, flexray, profile, flat={"rotation": 1.0})


def test_the_path_to_the_flat_is_the_one_that_is_free(
    flexray: Machine, profile: Profile
) -> None:
    """The first side that `route` reaches; its moves one after the other, there and back."""
    asked: list[dict[str, float]] = []

    def route(
        start: Mapping[str, float], goal: Mapping[str, float]
    ) -> list[dict[str, float]] | None:
        asked.append(dict(goal))
        if goal.get("tra_obj", 0.0) < 0.0:
            return None
        return [{n: x} for n, x in goal.items()]

    poses = [{"mag_obj": 400.0}]
    plan = plan_poses(poses, flexray, profile, route=route)
    flat = next(e for e in plan.exposures if e.kind == "flat").positions
    assert flat["tra_obj"] > 0.0
    assert asked == [
        {"tra_obj": asked[0]["tra_obj"], "mag_obj": 400.0},
        {"tra_obj": flat["tra_obj"], "mag_obj": 400.0},
        {"tra_obj": 0.0},
    ]
    first, second = (plan.trajectories[n][0] for n in ("tra_obj", "mag_obj"))
    assert first[1].end <= second[0] or second[1].end <= first[0]

    blocked = plan_poses(poses, flexray, profile, route=lambda _start, _goal: None)
    assert [(p.line, p.code) for p in blocked.problems] == [(0, "flat_path")]
    assert "give `flat` a pose" in blocked.problems[0].message


def test_a_machine_that_cannot_move_its_sample_aside_says_so() -> None:
    machine = parse_machine('base = "micro_ct"\n')
    kept = {
        q: f for q, f in machine.geometry.items() if q not in ("object_x", "object_z")
    }
    still = machine.model_copy(update={"geometry": kept})
    with pytest.raises(
        LimitError, match="no motor that takes the sample out of the beam"
    ):
        plan_poses([{"R": 1.0}], still, profile_of(still))
    assert plan_poses([{"R": 1.0}], still, profile_of(still), flat=False).frames == 1
