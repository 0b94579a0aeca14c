"""Counts behind the sample, as checks, submissions and data sets have them of one projector.

The projector shows a wall that stops everything, in front of a drawn part of the panel: that
part of the pixels is starved, whatever the code computes.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_process import Client, Lab, run, script

from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.scanner.state import Sample

OPAQUE = 30.0
"""Line integral of the wall."""
SHARE_TOLERANCE = 0.04
"""A few rays see it, of a grid coarser than the panel."""


def walled(lab: Lab, share: float, before: Callable[[], Any]) -> None:
    """Let the lab's projector show the wall to predictions, after `before`."""
    images = lab.projector.project

    async def project(name: str, cone: ConeVec, shape: tuple[int, int]) -> Float32Array:
        if cone.detector_shape is None:
            return await images(name, cone, shape)
        await before()
        out = np.zeros((len(cone), *shape), dtype=np.float32)
        out[:, :, : round(share * shape[1])] = OPAQUE
        return out

    lab.projector.project = project  # type: ignore[method-assign]


def starved(told: list[str]) -> list[float]:
    """Shares of starved pixels that are told, in parts of 1."""
    return [
        float(one.split("about ")[1].split(" %")[0]) / 100.0
        for one in told
        if "will be starved" in one
    ]


async def submitted(lab: Lab, client: Client, name: str) -> tuple[list[str], Any]:
    """Warnings of a submission, and what its data set keeps of the prediction."""
    made = await client.call("script.submit", text=script(3), name=name, speed_up="max")
    assert (await lab.ended(client, made["job"]))["state"] == "done"
    document = json.loads((lab.root / name / "flexdt.json").read_text())
    [kept] = document["predicted"]
    return made["warnings"], kept


@pytest.mark.parametrize("seed", range(3))
def test_a_busy_projector_is_waited_for(tmp_path: Path, seed: int) -> None:
    """However long it computes, check, submission and data set have the sample's shares."""
    rng = np.random.default_rng(6240 + seed)
    share, busy_s = float(rng.uniform(0.1, 0.9)), float(rng.uniform(1.5, 9.0))

    async def body(lab: Lab) -> None:
        walled(lab, share, lambda: asyncio.sleep(busy_s))
        client = lab.client()
        checked = await client.call("script.check", text=script(3))
        told = [p["message"] for p in checked["problems"]]
        warnings, kept = await submitted(lab, client, "scan")
        for one in (starved(told), starved(warnings), [kept["starved"]]):
            assert one == pytest.approx([share], abs=SHARE_TOLERANCE)
        assert kept["unpredicted"] == ""
        assert checked["ok"]

    run(tmp_path, body, virtual=True)


def test_a_missing_prediction_says_its_reason(tmp_path: Path) -> None:
    async def gone() -> None:
        raise ProjectorUnavailable("the projector at lab:1 went away during project")

    async def body(lab: Lab) -> None:
        walled(lab, 0.5, gone)
        client = lab.client()
        checked = await client.call("script.check", text=script(3))
        told = [p["message"] for p in checked["problems"]]
        warnings, kept = await submitted(lab, client, "scan")
        for some in (told, warnings):
            [one] = [text for text in some if "not predicted" in text]
            assert one.endswith("the projector at lab:1 went away during project")
        assert (kept["saturated"], kept["starved"]) == (None, None)
        assert kept["unpredicted"].endswith("went away during project")

    run(tmp_path, body, virtual=True)


def test_an_empty_stage_and_a_script_with_errors_ask_no_projector(tmp_path: Path) -> None:
    async def unasked() -> None:
        raise AssertionError("the projector was asked")

    async def body(lab: Lab) -> None:
        walled(lab, 0.5, unasked)
        client = lab.client()
        wrong = await client.call(
            "script.check", text="tube\tset kV\tmany\t\tACK\t\t\r\n"
        )
        assert not wrong["ok"]
        bare = Lab(tmp_path / "bare")
        bare.projector = lab.projector
        async with bare:
            bare.twin.scanner.sample = Sample("")
            empty = await bare.client().call("script.check", text=script(3))
        assert empty["ok"]
        assert not any("pixels" in p["code"] for p in empty["problems"])

    run(tmp_path, body, virtual=True)


def test_a_long_script_is_checked_as_a_short_one(tmp_path: Path) -> None:
    """Checks of long scripts run in other processes, and say the same of the sample."""

    async def body(lab: Lab) -> None:
        walled(lab, 0.3, lambda: asyncio.sleep(0.0))
        client = lab.client()
        long = script(3) + "camera\tset exposure\t2000.0\t\tACK\t\t\r\n" * 3000
        for text in (script(3), long):
            checked = await client.call("script.check", text=text)
            told = [p["message"] for p in checked["problems"]]
            assert starved(told) == pytest.approx([0.3], abs=SHARE_TOLERANCE)

    run(tmp_path, body)
