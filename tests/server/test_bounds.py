"""Well-formed messages with absurd values, starts of jobs that fail, uploads that never end."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from in_process import Lab, run

from flexdt.protocol import METHODS, RpcError, parse_params
from flexdt.protocol.field_checks import MAX_STEM
from flexdt.runtime.files.directory import open_data
from flexdt.server.storage.sample_uploads import MAX_UPLOADS, Incoming, UploadHead
from flexdt.twin.errors import LimitError

SCRIPT = "camera\tset exposure\t100\t\tACK\t\t"
VOXELS = {"name": "v", "kind": "voxels", "format": "raw", "total": 4, "data": "AACAPw==",
          "shape": [1, 1, 1]}  # fmt: skip
MESH = {"name": "m", "format": "stl", "total": 4, "data": "AAAA"}


@pytest.mark.parametrize(
    ("method", "params", "path"),
    [
        ("script.submit", {"text": SCRIPT, "speed_up": 2e6}, "speed_up"),
        ("clock.set", {"speed_up": 2e6}, "speed_up"),
        ("sample.upload", {**VOXELS, "voxel_mm": [1e160, 1.0, 1.0]}, "voxel_mm.0"),
        ("sample.upload", {**VOXELS, "voxel_mm": [1.0, 1.0, 1e30]}, "voxel_mm.2"),
        ("sample.upload", {**MESH, "material": "a\0b"}, "material"),
        ("sample.upload", {**MESH, "name": "x" * (MAX_STEM + 1)}, "name"),
        ("sample.upload", {**MESH, "name": "é" * 20}, "name"),
        ("sample.set", {"name": "lego", "offset": {"x": 1e16}}, "offset.x"),
        ("calibration.apply", {"parameters": {"alpha": 1e300}}, "parameters.alpha"),
        ("axes.jog", {"axis": "mag_obj", "velocity": 1e308}, "velocity"),
        ("camera.set", {"exposure_ms": 1e308}, "exposure_ms"),
        ("camera.set", {"roi": [0, 0, 2**70, 1]}, "roi.2"),
        ("sample.mesh", {"start": 2**70}, "start"),
        ("projection.get", {"binning": 2**70}, "binning"),
        ("exposure.predict", {"kV": 1e308}, "kV"),
        ("exposure.predict", {"frames": 2**70}, "frames"),
        ("exposure.predict", {"filter": "x" * 101}, "filter"),
        ("dataset.list", {"count": 201}, "count"),
        ("dataset.list", {"search": "x" * 201}, "search"),
        ("dataset.list", {"thumbnail": 257}, "thumbnail"),
        ("dataset.get", {"name": ""}, "name"),
        ("dataset.get", {"name": "a", "points": 2001}, "points"),
        ("dataset.frame", {"name": "a", "index": 2**70}, "index"),
        ("dataset.frame", {"name": "a", "index": 0, "binning": 65}, "binning"),
        ("trajectory.submit", {"poses": [{"rot_obj": 1e300}]}, "poses.0.rot_obj"),
        ("trajectory.submit", {"poses": [{"rot_obj": 1.0}], "motion_samples": 2**70},
         "motion_samples"),
        ("session.hello", {"protocol": "1.0", "client": "a\x1b[2J"}, "client"),
        ("job.status", {"job": "a\ud800"}, "job"),
    ],
)  # fmt: skip
def test_an_absurd_value_is_refused_by_its_field(
    method: str, params: dict[str, Any], path: str
) -> None:
    with pytest.raises(RpcError) as caught:
        parse_params(METHODS[method], params)
    assert caught.value.code == -32602
    problem = caught.value.data["problems"][0]  # type: ignore[index]
    assert problem["path"].startswith(path), problem
    assert problem["message"]
    json.dumps(caught.value.data, ensure_ascii=False).encode()  # it can travel


def test_what_the_schema_allows_is_kept_as_a_file() -> None:
    name = "ö" * (MAX_STEM // 6)
    assert parse_params(METHODS["sample.upload"], {**MESH, "name": name})


def test_many_wrong_members_cost_little() -> None:
    crowd = {f"k{i}": "x" for i in range(1_000_000)}
    asked: list[tuple[str, dict[str, Any]]] = [
        ("axes.move", crowd),
        ("axes.move", {"targets": crowd}),
        ("sample.set", {"name": "lego", "offset": crowd}),
        ("trajectory.check", {"poses": ["x"] * 200_000}),
        ("axes.move", {"targets": [[["x"] * 1000] * 1000] * 1000}),
    ]
    for method, params in asked:
        with pytest.raises(RpcError) as caught:
            parse_params(METHODS[method], params)
        assert len(json.dumps(caught.value.data)) < 20_000


def test_a_job_whose_start_raises_anything_ends_as_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        jobs, clock = lab.twin.jobs, lab.twin.clock
        honest = clock.set_speed_up

        def broken(speed_up: object) -> None:
            raise ZeroDivisionError("planted")

        monkeypatch.setattr(clock, "set_speed_up", broken)
        first = (await c.call("script.submit", text=SCRIPT))["job"]
        await lab.until(lambda: jobs.get(first).phase == "failed", "the first fails")
        monkeypatch.setattr(clock, "set_speed_up", honest)
        monkeypatch.setattr("flexdt.server.scans.jobs.ScanRunner", broken)
        second = (await c.call("script.submit", text=SCRIPT))["job"]
        await lab.until(lambda: jobs.get(second).phase == "failed", "the second fails")
        monkeypatch.undo()
        third = (await c.call("script.submit", text=SCRIPT))["job"]
        await lab.until(lambda: jobs.get(third).phase == "done", "the third is done")
        assert jobs.get(second).error["code"] == -32603
        assert not lab.twin.failed.is_set()

    run(tmp_path, body)


def test_a_service_goes_on_after_what_it_met_and_ends_the_process_if_it_cannot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("state.subscribe", topics=["state"])
        honest, left = lab.twin.scanner.rest_time, 2

        def broken(now: float) -> float:
            nonlocal left
            left -= 1
            if left >= 0:
                raise ZeroDivisionError("planted")
            return honest(now)

        def met() -> bool:
            """Whether it has been met twice by a feed that is woken again and again."""
            lab.twin.feed.changed()
            return left < 0

        monkeypatch.setattr(lab.twin.scanner, "rest_time", broken)
        await lab.until(met, "it was met")
        await asyncio.sleep(0.3)
        before = len(c.of("state"))
        lab.twin.feed.changed()
        await lab.until(lambda: len(c.of("state")) > before, "states go on")
        assert not lab.twin.failed.is_set()
        left = 10**9

        async def kick() -> None:
            while True:
                lab.twin.feed.changed()
                await asyncio.sleep(0.01)

        task = asyncio.create_task(kick())
        await lab.until(lab.twin.failed.is_set, "it gives up")
        task.cancel()

    run(tmp_path, body)


def head(name: str, total: int) -> UploadHead:
    return UploadHead(name=name, kind="mesh", format="stl", total=total)


def test_unfinished_uploads_are_bounded_and_their_senders_are_told(
    tmp_path: Path,
) -> None:
    incoming: Incoming = Incoming(open_data(tmp_path), limit=1000)
    for i in range(MAX_UPLOADS + 1):
        assert incoming.receive(head(f"n{i}", 900), 0, b"x" * 10)[0] == 10
    with pytest.raises(LimitError, match=r"4 uploads and 1000 bytes are kept"):
        incoming.receive(head("n0", 900), 10, b"y")
    assert incoming.receive(head("n4", 900), 10, b"y" * 800)[0] == 810
    assert (
        incoming.receive(head("n3", 900), 10, b"z" * 800)[0] == 810
    )  # those before it are dropped
    with pytest.raises(LimitError, match="dropped"):
        incoming.receive(head("n4", 900), 810, b"y")
    received, last = incoming.receive(head("n3", 900), 800, b"z" * 100)
    assert received == 900  # some came before
    assert incoming.take(last) == (head("n3", 900), b"x" * 10 + b"z" * 890)
    with pytest.raises(LimitError, match="come in order"):
        incoming.take(last)
    assert list(tmp_path.iterdir()) == []  # nothing has a name
