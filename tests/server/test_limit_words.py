"""Positions beyond the travel in a scene and in a request for an image: the rule of a
request by itself, and never without a word (tests/twin/test_limit_doors.py has the others)."""

from __future__ import annotations

from pathlib import Path

import in_process
import pytest
from in_process import Lab, run

from flexdt.clients.gateway import actions
from flexdt.twin.machine.description import builtin_machine
from flexdt.twin.script import commands as c
from tests.twin.test_limit_doors import through_gateway

AXIS = "mag_det"
TOLERANCE = 0.5


@pytest.mark.parametrize(
    ("by", "fate"),
    [
        (-1.0, "arrives"),
        (5e-10, "arrives"),
        (0.4, "told"),
        (0.6, "refused"),
        (900.0, "refused"),
    ],
)
def test_scenes_and_images_have_the_rule_of_a_request(
    by: float, fate: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    axes = {
        name: axis.model_copy(update={"arrival_tolerance": TOLERANCE})
        for name, axis in in_process.M.axes.items()
    }
    machine = in_process.M.model_copy(update={"axes": axes})
    monkeypatch.setattr(in_process, "M", machine)
    upper = machine.axes[AXIS].upper

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("axes.move", targets={AXIS: upper - 2.0}, wait=True)
        scene = (await c.call("scene.save"))["document"]
        scene["positions"][AXIS] = upper + by
        if fate == "refused":
            for method, params in (
                ("axes.move", {"targets": {AXIS: upper + by}}),
                ("scene.load", {"document": scene}),
                ("projection.get", {"positions": {AXIS: upper + by}}),
            ):
                error = await c.error(method, **params)
                assert (error.code, AXIS in error.message) == (-32001, True)
            assert (await c.call("state.get"))["axes"][AXIS]["target"] == upper - 2.0
            return
        image = await c.call("projection.get", positions={AXIS: upper + by})
        there = await c.call("projection.get", positions={AXIS: min(upper, upper + by)})
        assert image["cone_vec"] == there["cone_vec"]
        loaded = await c.call("scene.load", document=scene)
        assert loaded["axes"][AXIS]["target"] == min(upper, upper + by)
        for warnings in (image["warnings"] or [], loaded["warnings"]):
            told = [w for w in warnings if AXIS in w and w.endswith("set to the limit")]
            assert (len(told), len(warnings)) == ((1, 1) if fate == "told" else (0, 0))

    run(tmp_path, body)


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (c.MoveAbsolute(component=AXIS, target=2000.0), True),
        (c.MoveAbsolute(component=AXIS, target=500.0), False),
        (c.SetSpeed(component=AXIS, speed=1e5), True),
        (c.SetSpeed(component=AXIS, speed=1.0), False),
    ],
)
def test_the_gateway_logs_what_it_sets_to_a_limit(
    command: c.Command, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = list[str]()
    monkeypatch.setattr(
        actions, "log", lambda event, level, message: lines.append(message)
    )
    machine = builtin_machine("flexray").model_copy(update={"on_limit": "clamp"})
    through_gateway(machine, command)
    assert len(lines) == told
    assert all(AXIS in line and line.endswith("set to the limit") for line in lines)
