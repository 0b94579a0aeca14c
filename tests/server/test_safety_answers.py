"""Stop, E-stop, reset and the state are answered at any state of the twin, whatever cannot be
computed there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from in_process import Client, Lab, run, script

from flexdt.twin.scanner.state import NamedCorrection

BEHIND = {"tra_tube": 419.0, "tra_obj": -234.0, "mag_obj": 70.0}
"""A pose whose axis is behind the source with `YAW`."""
YAW = NamedCorrection.from_edge("yaw", "2026-01-01T00:00:00Z", {"det_yaw": 8.0}, "")


def put_behind(lab: Lab) -> None:
    """Put the scanner where no request brings it: a pose without a geometry."""
    twin = lab.twin
    twin.scanner.correction = YAW
    twin.scanner.guard = None
    twin.scanner.place(BEHIND, twin.clock.now())


async def safety_answers(c: Client) -> dict[str, dict[str, Any]]:
    """The answers that must always come, by method; one that is refused raises."""
    answers = {
        name: await c.call(name)
        for name in ("axes.stop", "safety.estop", "safety.reset", "state.get")
    }
    await c.call("state.unsubscribe", topics=["state"])
    await c.call("state.subscribe", topics=["state"])
    return answers


def test_a_pose_behind_the_source_silences_nothing(tmp_path: Path) -> None:
    """Issue 80: five accepted requests made stop, E-stop, reset and state answer -32602."""

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("session.hello", protocol="1.0", client="test")
        await c.call("state.subscribe", topics=["state"])
        put_behind(lab)
        answers = await safety_answers(c)
        assert answers["axes.stop"]["safety"]["state"] == "ok"
        assert answers["safety.estop"]["safety"]["estop"]
        assert not answers["safety.reset"]["safety"]["estop"]
        for state in answers.values():
            assert state["geometry"] is None
            assert "not in front of the source" in state["missing"]["geometry"]
            assert state["axes"]["mag_obj"]["position"] == 70.0
        await lab.until(
            lambda: bool(c.of("state")) and c.of("state")[-1]["data"]["geometry"] is None
        )
        assert len((await c.call("geometry.get"))["cone_vec"]) == 12

    run(tmp_path, body)


@pytest.mark.parametrize("broken", ["geometry", "clearance", "sample", "job", "image"])
def test_what_cannot_be_computed_is_null_with_its_reason(
    tmp_path: Path, broken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever a derived part meets, the rest is told, and the reason is there."""

    def fail(*_: object, **__: object) -> Any:
        raise ZeroDivisionError

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("session.hello", protocol="1.0", client="test")
        twin = lab.twin
        match broken:
            case "geometry":
                monkeypatch.setattr("flexdt.server.twin.state_views.geometry_view", fail)
            case "clearance":
                monkeypatch.setattr(type(twin.scanner.guard), "touching", fail)
                monkeypatch.setattr("flexdt.server.twin.core.clearance", fail)
            case "sample":
                monkeypatch.setattr(twin.stage, "phantom", fail)
            case "job":
                await c.call("script.submit", text=script(), name="one")
                await lab.until(lambda: twin.jobs.running, "the job runs")
                monkeypatch.setattr(twin.jobs, "status", fail)
            case _:
                monkeypatch.setattr(type(twin.live), "seen", property(fail))
        for answer in (await safety_answers(c)).values():
            assert "ZeroDivisionError" in answer["missing"][broken]
            assert answer["sample"]["name"] == "chiral"
            assert answer["safety"]["clearance_mm"] is None or broken != "clearance"

    run(tmp_path, body)


def test_a_twin_starts_on_a_directory_whose_pose_has_no_geometry(tmp_path: Path) -> None:
    """A correction of an older version is dropped, and the twin starts where it stood."""

    async def leave(lab: Lab) -> None:
        c = lab.client()
        await c.call("session.hello", protocol="1.0", client="test")
        await c.call("calibration.apply", parameters={"det_yaw": 1.0}, name="yaw")
        await c.call("axes.move", targets=BEHIND, wait=True)

    run(tmp_path, leave)
    changed = 0
    for file in (tmp_path / "corrections").glob("*.json"):
        text = file.read_text("utf-8")
        changed += '"det_yaw": 1.0' in text
        file.write_text(text.replace('"det_yaw": 1.0', '"det_yaw": 8.0'), "utf-8")
    assert changed == 1

    async def again(lab: Lab) -> None:
        c = lab.client()
        await c.call("session.hello", protocol="1.0", client="test")
        state = await c.call("state.get")
        assert state["correction"] is None
        assert state["missing"] == {}

    run(tmp_path, again)
