"""Who ended a scan and what stands then; what a live image says that it was made of."""

from __future__ import annotations

import asyncio
import base64
import json
import random
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import trimesh
from in_process import Client, Lab, M, P, PointProjector, run, script

from flexdt.runtime.files.directory import open_data
from flexdt.server.storage.dataset_writer import DatasetWriter
from flexdt.server.twin.core import TwinServer


def cube(side: float) -> bytes:
    return bytes(trimesh.creation.box((side, side, side)).export(file_type="stl"))


async def upload(client: Client, name: str, content: bytes) -> None:
    await client.call(
        "sample.upload", name=name, format="stl", total=len(content), start=0,
        data=base64.b64encode(content).decode(),
    )  # fmt: skip


def said_of(state: dict[str, Any]) -> dict[str, Any]:
    """What an image of this state was made of."""
    sample, tube, camera = (state[key] for key in ("sample", "tube", "camera"))
    correction = state["correction"]
    return {
        "sample": sample["name"],
        "revision": sample["revision"],
        "material": sample["material"],
        "offset": sample["offset"],
        "lit": tube["on"] and tube["ready"],
        **{key: tube[key] for key in ("kV", "power_W")},
        **{key: camera[key] for key in ("mode", "exposure_ms", "averages", "roi")},
        "correction": None if correction is None else correction["name"],
        **dict.fromkeys(("dataset", "index", "file")),  # it is of no scan
    }


def newest_is_of(client: Client, wanted: dict[str, Any]) -> bool:
    """Whether the newest image was made of this; tuples are lists on the wire."""
    newest: dict[str, Any] = client.of("projection")[-1]["data"]["origin"]
    return bool(newest == json.loads(json.dumps(wanted)))


def test_an_image_says_what_it_was_made_of(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        client = lab.client()
        await client.call("state.subscribe", topics=["projection"])
        await lab.until(lambda: len(client.of("projection")) > 0, "a first image")
        changes: list[tuple[str, dict[str, Any]]] = [
            ("sample.set", {"name": "lego"}),
            ("sample.set", {"name": "lego", "offset": {"x": 1.5}}),
            ("tube.set", {"kV": 55.0, "on": True}),
            ("camera.set", {"mode": "HW4SW1High", "exposure_ms": 150.0}),
            ("calibration.apply", {"parameters": {"dD_x": 0.2}, "name": "moved"}),
            ("sample.set", {"name": "empty"}),
        ]
        for method, params in changes:
            await client.call(method, **params)
            wanted = said_of(await client.call("state.get"))
            await lab.until(partial(newest_is_of, client, wanted), method)

    run(tmp_path, body)


def test_an_upload_that_is_replaced_on_the_stage_has_a_new_image(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        client = lab.client()
        await client.call("state.subscribe", topics=["projection"])
        await upload(client, "block", cube(10.0))
        await client.call("sample.set", name="block")
        first = (await client.call("state.get"))["sample"]["revision"]
        origin = lambda: client.of("projection")[-1]["data"]["origin"]  # noqa: E731
        await lab.until(lambda: origin()["revision"] == first, "the first cube's image")
        await upload(client, "block", cube(12.0))
        await client.call("sample.set", name="block")
        second = (await client.call("state.get"))["sample"]["revision"]
        assert second != first
        await lab.until(lambda: origin()["revision"] == second, "the second cube's image")

    run(tmp_path, body)


@pytest.mark.parametrize("paused", [False, True])
def test_an_abort_says_who_and_switches_x_rays_off(tmp_path: Path, paused: bool) -> None:
    async def body(lab: Lab) -> None:
        lab.projector.limit = 3
        owner, other = lab.client(), lab.client()
        other.session._client.program = "Anna"
        stood = lab.twin.scanner.final_positions()
        job = (await owner.call("script.submit", text=script(frames=60)))["job"]
        await lab.until(lambda: lab.projector.views >= 3, "frames are under way")
        if paused:
            await owner.call("job.pause", job=job)
        await other.call("job.abort", job=job)
        status = await lab.ended(owner, job)
        state = await owner.call("state.get")
        assert status["state"] == "aborted"
        assert status["ended_by"] == other.session._client.name
        assert status["ended_by"].startswith("Anna ")
        assert status["start"] == pytest.approx(stood)
        assert not state["tube"]["on"]
        assert lab.twin.scanner.final_positions()["rot_obj"] != pytest.approx(
            stood["rot_obj"]
        )
        again = await owner.call("job.resume", job=job)
        assert again["ended_by"] is None
        lab.projector.limit = None
        assert (await lab.ended(owner, job))["state"] == "done"

    run(tmp_path, body)


@pytest.mark.parametrize("seed", range(3))
def test_an_aborted_scan_counts_the_images_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """A slow disk is in the midst of a batch when the scan is aborted; counted by file
    names."""
    rng = random.Random(seed)
    after, pause_s = rng.randint(2, 14), rng.uniform(0.002, 0.008)
    put = DatasetWriter.put

    def slow(writer: DatasetWriter, *image: Any) -> None:
        time.sleep(pause_s)
        put(writer, *image)

    monkeypatch.setattr(DatasetWriter, "put", slow)

    async def body(lab: Lab) -> None:
        client = lab.client()
        submitted = await client.call("script.submit", text=script(frames=60))
        stored = lambda: len(list(tmp_path.rglob("scan_*.tif")))  # noqa: E731
        await lab.until(lambda: stored() >= after, "images are under way")
        await client.call("job.abort", job=submitted["job"])
        status = await lab.ended(client, submitted["job"])
        assert 0 < status["frames_done"] < 60
        assert status["frames_done"] == stored()
        await asyncio.sleep(10 * pause_s)
        assert status["frames_done"] == stored()

    run(tmp_path, body)


def test_who_aborted_is_known_to_the_next_server(tmp_path: Path) -> None:
    known: dict[str, Any] = {}

    async def before(lab: Lab) -> None:
        lab.projector.limit = 3
        client = lab.client()
        known["job"] = (await client.call("script.submit", text=script(frames=60)))["job"]
        await lab.until(lambda: lab.projector.views >= 3, "frames are under way")
        await client.call("job.abort", job=known["job"])
        known["status"] = await lab.ended(client, known["job"])

    async def after() -> None:
        twin = TwinServer(M, P, PointProjector(), open_data(tmp_path))
        twin.recall()
        status = twin.jobs.status(twin.jobs.get(known["job"])).model_dump()
        for key in ("state", "ended_by", "start"):
            assert status[key] == known["status"][key]

    run(tmp_path, before)
    asyncio.run(after())


def test_x_rays_stay_where_a_waiting_scan_is_aborted(tmp_path: Path) -> None:
    """It never began: the last scan is the one that ran, for who asks and who subscribes."""

    async def body(lab: Lab) -> None:
        lab.projector.limit = 3
        client = lab.client()
        first = (await client.call("script.submit", text=script(frames=60)))["job"]
        second = (await client.call("script.submit", text=script(frames=60)))["job"]
        await lab.until(lambda: lab.projector.views >= 3, "frames are under way")
        await client.call("job.abort", job=second)
        status = await client.call("job.status", job=second)
        assert (status["state"], status["start"]) == ("aborted", None)
        assert (await client.call("state.get"))["tube"]["on"]
        await client.call("job.abort", job=first)
        await lab.ended(client, first)
        assert (await client.call("job.status"))["job"] == first

    run(tmp_path, body)


def test_the_report_names_the_pair_of_its_clearance(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        report = await lab.client().call("script.check", text=script())
        assert report["min_clearance_mm"] > 0
        assert len(report["min_clearance_pair"]) == 2

    run(tmp_path, body)
