"""Long histories of small requests: none takes a pair's gap, and none hides that it is too
small.

The long form is `tests/studies/history_campaign.py`.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from history_campaign import one_machine
from hypothesis import given
from hypothesis import strategies as st
from motion_histories import LOSS_MM, Judge
from motion_oracle import Placed, Stage
from motion_rules import model

from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.errors import CollisionError, TwinError
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.scanner.safety import floor
from flexdt.twin.scanner.scanner import ScannerTwin


def test_a_thousand_micrometres_towards_the_panel_take_no_more_than_one() -> None:
    """Each of 1 073 moves of 0.95 um once kept its contract; together they took the margin."""
    machine = builtin_machine()
    profile = builtin_profile(machine.default_profile)
    scanner = ScannerTwin(
        machine, profile, guard=SceneGuard(build_scene(machine, profile))
    )
    flexray, now = model("flexray"), 0.0
    stage, judge = Stage(flexray, Placed()), Judge(machine.safety_margin_mm)

    def move(
        targets: dict[str, float], *, relative: bool = False
    ) -> type[TwinError] | None:
        nonlocal now
        refused = None
        try:
            scanner.move(targets, now, relative=relative)
        except TwinError as refusal:
            refused = type(refusal)
        now = math.nextafter(scanner.rest_time(now), math.inf)
        pose = flexray.vector(scanner.positions(now))
        judge.look(stage, pose, scanner.state(now).safety.state, f"{targets}")
        return refused

    assert [move({"mag_obj": 200.0}), move({"mag_det": 1059.0}), move({"mag_obj": 996.0})] == [
        None, None, None,
    ]  # fmt: skip
    assert move({"mag_det": 600.0}) is CollisionError
    scanner.reset(now)
    answers = [move({"mag_det": -0.00095}, relative=True) for _ in range(1073)]
    assert None in answers
    assert judge.found == []
    assert judge.least > 0.0
    assert scanner.state(now).safety.state == "blocked"
    scanner.reset(now)
    assert move({"mag_det": 1.0}, relative=True) is None


@pytest.mark.parametrize("number", range(3))
def test_drawn_histories_take_no_more_than_a_rung_and_safe_moves_are_allowed(
    number: int,
) -> None:
    _, histories, verdicts = one_machine(3, number, runs=1, repeats=200, moves=6)
    assert (histories.found, verdicts.refused, verdicts.allowed) == ([], [], [])
    assert histories.long_runs == 1
    assert histories.loss < LOSS_MM
    assert verdicts.safe > 0


@given(
    margin=st.floats(1e-3, 100.0),
    near=st.floats(-2.0, 1.5),
    kept=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=50),
)
def test_a_floor_that_is_kept_never_sinks(
    margin: float, near: float, kept: list[float]
) -> None:
    """However a history goes: the next gap is drawn between the floor and the gap that there
    is."""
    first = gap = margin + near * min(margin, 0.1)
    lowest = floor(gap, margin)
    assert gap - 0.006 <= lowest <= gap or gap > margin
    for part in kept:
        gap = floor(gap, margin) + part * (gap - floor(gap, margin))
        assert floor(gap, margin) >= lowest - 1e-9
    assert gap >= min(first, margin) - LOSS_MM


def test_the_judge_sees_a_gap_that_wears_and_a_state_that_hides_it() -> None:
    """The witness itself: parts that are stepped nearer by nobody's leave."""
    flexray = model("flexray")
    stage = Stage(flexray, Placed())
    pose = {name: axis["home"] for name, axis in flexray.data["axes"].items()}
    pose |= {"mag_obj": 996.0}
    far, near = 600.0, 1059.0
    for _ in range(60):  # where panel and holder are at the margin
        middle = 0.5 * (far + near)
        far, near = (middle, near) if stage.least({**pose, "mag_det": middle})[0] < 1.0 else (
            far, middle)  # fmt: skip
    for state, words in (("ready", "the state is ready"), ("blocked", "lost")):
        judge = Judge(1.0)
        for step in np.arange(0.0, 0.02, 0.001).tolist():
            at = flexray.vector({**pose, "mag_det": near - step})
            judge.look(stage, at, state, "stepped")
        assert words in judge.found[0]
