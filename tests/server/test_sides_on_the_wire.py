"""Whether beads have told a correction's sides stays with it: on the wire, in files and scans."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from in_process import Lab, run, script

import flexdt as fx

NAME = "found"
APPLY: dict[str, Any] = {"parameters": {"tau_x": 0.02}, "name": NAME}


@pytest.mark.parametrize("asked", [{}, {"sides_known": False}, {"sides_known": True}])
def test_a_correction_knows_its_sides_wherever_it_comes_from(
    tmp_path: Path, asked: dict[str, bool]
) -> None:
    known = asked.get("sides_known", False)
    scenes: list[Any] = []

    async def before(lab: Lab) -> None:
        client = lab.client()
        applied = await client.call("calibration.apply", **APPLY, **asked)
        assert applied["correction"]["sides_known"] is known
        assert (await client.call("state.get"))["correction"]["sides_known"] is known
        scenes.append((await client.call("scene.save"))["document"])
        answer = await client.call("script.submit", text=script(frames=3), name="scan")
        assert (await lab.ended(client, answer["job"]))["state"] == "done"

    async def after(lab: Lab) -> None:
        client = lab.client()
        in_force = await client.call("calibration.get")
        assert in_force["correction"]["name"] == NAME
        assert in_force["correction"]["sides_known"] is known
        [listed] = (await client.call("calibration.list"))["corrections"]
        assert listed["sides_known"] is known

    async def elsewhere(lab: Lab) -> None:
        client = lab.client()
        await client.call("scene.load", document=scenes[0])
        loaded = (await client.call("calibration.get"))["correction"]
        assert loaded["sides_known"] is known

    run(tmp_path / "first", before)
    run(tmp_path / "first", after)
    run(tmp_path / "second", elsewhere)
    data = fx.open(tmp_path / "first" / "scan")
    assert data.correction is not None
    assert data.correction.sides_known is known
    data.save(tmp_path / "copy")
    copied = fx.open(tmp_path / "copy").correction
    assert copied is not None
    assert copied.sides_known is known


def test_a_document_without_the_field_knows_no_sides(tmp_path: Path) -> None:
    """As servers before it wrote them."""

    async def body(lab: Lab) -> None:
        client = lab.client()
        await client.call("calibration.apply", **APPLY, sides_known=True)
        document = (await client.call("scene.save"))["document"]
        del document["correction"]["sides_known"]
        document["correction"]["name"] = "older"
        await client.call("scene.load", document=document)
        assert not (await client.call("calibration.get"))["correction"]["sides_known"]

    run(tmp_path, body)
