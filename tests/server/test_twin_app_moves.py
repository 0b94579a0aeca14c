"""Motions of the twin server: collisions, stops, planned ways, lost control."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from in_process import Lab, M, run


def test_a_colliding_move_halts_is_counted_and_at_last_needs_a_reset(
    tmp_path: Path,
) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        e = await c.error("axes.move", targets={"mag_det": 100.0})
        assert e.code == -32002
        assert len(e.data["pair"]) == 2
        halt = e.data["halts_at"]["mag_det"]
        await lab.twin.motion_ended(M.axes)
        state = await c.call("state.get")
        assert state["axes"]["mag_det"]["position"] == halt
        assert 100.0 < halt < 1059.0
        assert state["safety"]["blocked_attempts"] == 1
        assert 0.0 < state["safety"]["clearance_mm"] < 3.0
        assert set(state["safety"]["pair"]) == set(e.data["pair"])
        for _ in range(2):
            assert (await c.error("axes.move", targets={"mag_det": 100.0})).code == -32002
        assert (await c.call("state.get"))["safety"]["state"] == "aborted"
        assert (await c.error("axes.move", targets={"mag_det": 900.0})).code == -32003
        await c.call("safety.reset")
        await c.call("axes.move", targets={"mag_det": 900.0}, wait=True)
        # A script that would collide is refused with its line before anything moves.
        bad = "\r\nmag_det\tmove absolute\t150.0\t\tACK\t\t\r\n"
        e = await c.error("script.submit", text=bad)
        assert e.code == -32002
        assert e.data["collisions"][0]["line"] == 2
        assert (await c.call("state.get"))["axes"]["mag_det"]["position"] == 900.0

    run(tmp_path, body)


def test_a_target_within_the_arrival_tolerance_arrives_at_the_limit_and_is_told(
    tmp_path: Path,
) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("axes.move", targets={"mag_det": 1058.0}, wait=True)
        for plan in (False, True):
            done = await c.call(
                "axes.move", targets={"mag_det": 1060.0}, wait=True, plan=plan
            )
            assert done["arrived"] is True
            assert done["warnings"] == [
                "mag_det target 1060 mm is outside [100, 1059] mm; set to the limit"
            ]
            assert (await c.call("state.get"))["axes"]["mag_det"]["position"] == 1059.0
        assert (await c.error("axes.move", targets={"mag_det": 1060.1})).code == -32001

    run(tmp_path, body)


@pytest.mark.parametrize("command", ["axes.stop", "safety.estop"])
@pytest.mark.parametrize("plan", [False, True])
def test_a_waiting_move_is_answered_when_a_stop_has_brought_the_axes_to_rest(
    tmp_path: Path, command: str, plan: bool
) -> None:
    """Not after the minutes that the motion would have taken, and without claiming arrival."""

    async def body(lab: Lab) -> None:
        a, b = lab.client(), lab.client()
        assert (await a.call("axes.move", targets={"mag_obj": 500.0}))["arrived"] is None
        done = await a.call("axes.move", targets={"mag_obj": 600.0}, wait=True, plan=plan)
        assert (done["arrived"], done["warnings"]) == (True, [])
        await a.call("axes.set", axis="mag_obj", speed=1.0)
        await a.call("clock.set", speed_up=1.0)
        asked = a.call("axes.move", targets={"mag_obj": 900.0}, wait=True, plan=plan)
        moving = asyncio.create_task(asked)
        await lab.until(
            lambda: lab.twin.scanner.moving(lab.twin.clock.now()), "the motion"
        )
        await b.call(command)
        done = await moving
        assert done["duration_s"] > 250.0
        assert done["arrived"] is False
        assert "mag_obj rests at 6" in done["warnings"][-1]
        assert not lab.twin.scanner.moving(lab.twin.clock.now())

    run(tmp_path, body)


def test_a_planned_move_says_its_legs(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        direct = await c.call(
            "axes.move", targets={"mag_obj": 650.0}, plan=True, wait=True
        )
        assert direct["moves"] == [{"mag_obj": 650.0}]
        assert direct["warnings"] == []
        assert (await c.call("state.get"))["axes"]["mag_obj"]["position"] == 650.0
        # The sample must leave before the detector may come: two legs, in that order.
        targets = {"mag_det": 400.0, "mag_obj": 200.0}
        assert lab.twin.scanner.guard is not None
        lab.twin.scanner.set_axis("mag_obj", speed=2.0)
        around = await c.call("axes.move", targets=targets, plan=True, wait=True)
        assert around["moves"] == [{"mag_obj": 200.0}, {"mag_det": 400.0}]
        assert "would collide on the direct way" in around["warnings"][0]
        state = await c.call("state.get")
        assert {n: state["axes"][n]["position"] for n in targets} == targets
        e = await c.error(
            "axes.move", targets={"mag_det": 100.0, "mag_obj": 600.0}, plan=True
        )
        assert e.code == -32002
        assert not lab.twin.scanner.moving(lab.twin.clock.now())
        e = await c.error("axes.move", targets={"mag_obj": 5.0}, plan=True)
        assert e.code == -32001

    run(tmp_path, body)


@pytest.mark.parametrize(
    ("method", "params", "ends"),
    [
        ("axes.move", {"targets": {"mag_obj": 5000.0}}, False),
        ("axes.move", {"targets": {"nothing": 5.0}}, False),
        ("axes.jog", {"axis": "mag_obj", "velocity": 1e4, "lease_s": 1.0}, False),
        ("axes.move", {"targets": {"ver_tube": 50.0}}, True),
        ("axes.jog", {"axis": "ver_tube", "velocity": 5.0, "lease_s": 1.0}, True),
    ],
)
def test_a_refused_request_lets_a_planned_move_go_on(
    tmp_path: Path, method: str, params: dict[str, Any], ends: bool
) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("axes.set", axis="mag_obj", speed=2.0)
        await c.call("clock.set", speed_up=20.0)
        targets = {"mag_det": 400.0, "mag_obj": 200.0}
        moved = asyncio.create_task(
            c.call("axes.move", targets=targets, plan=True, wait=True)
        )
        await lab.until(
            lambda: lab.twin.scanner.moving(lab.twin.clock.now()), "the first leg"
        )
        if ends:
            await c.call(method, **params)
        else:
            assert (await c.error(method, **params)).code in (-32001, -32602)
        await c.call("clock.set", speed_up="max")
        assert (await moved)["arrived"] is not ends

    run(tmp_path, body)


def test_nothing_moves_for_who_lost_control_while_it_was_planned(tmp_path: Path) -> None:
    """Planning takes a while: a stop, or another controller, must end what is being planned."""
    text = "mag_obj\tmove absolute\t300.0\t\tACK\t\t\n"
    asked: list[tuple[str, dict[str, Any]]] = [
        ("axes.move", {"targets": {"mag_det": 400.0, "mag_obj": 200.0}, "plan": True}),
        ("script.submit", {"text": text}),
        ("sample.set", {"name": "normal-3"}),
    ]

    async def body(lab: Lab) -> None:
        a, b = lab.client(), lab.client()
        before = (await a.call("state.get"))["axes"]
        for method, params in asked:
            await a.call("session.control", action="force")
            waiting = asyncio.create_task(a.error(method, **params))
            await asyncio.sleep(0)  # asked, and being planned
            assert not waiting.done()
            await b.call("session.control", action="force")
            assert (await waiting).code == -32003
        await a.call("session.control", action="force")
        waiting = asyncio.create_task(a.error(asked[0][0], **asked[0][1]))
        await asyncio.sleep(0)
        await b.call("axes.stop")
        assert "another command came" in (await waiting).message
        after = await a.call("state.get")
        assert {n: v["target"] for n, v in after["axes"].items()} == {
            n: v["target"] for n, v in before.items()
        }
        assert after["sample"]["name"] != "normal-3"
        assert (await a.call("job.list"))["jobs"] == []

    run(tmp_path, body)
