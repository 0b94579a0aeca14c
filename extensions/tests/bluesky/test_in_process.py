"""Bluesky's plans on a twin in process: no server, and the machine's limits and times."""

from __future__ import annotations

import re
import threading
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import bluesky.plan_stubs as bps
import bluesky.plans as bp
import pytest
from bluesky import RunEngine
from bluesky.utils import FailedStatus
from event_model import DocumentNames, schema_validators
from ophyd_async.core import StaticPathProvider, UUIDFilenameProvider, init_devices

from flexdt.testing import InProcessTwin
from flexdt.testing.fixtures import flexdt_twin
from flexdt.twin.machine.camera import Roi
from flexdt.twin.script import ScanRequest
from flexdt_extensions.bluesky import FlyScan, LimitsExceeded, TwinLab
from flexdt_extensions.bluesky.flyer import fly_scan

__all__ = ["flexdt_twin"]

PAGE = Path(__file__).parents[3] / "docs" / "extensions" / "bluesky.md"
MAX = pytest.mark.parametrize(
    "flexdt_twin", [{"speed_up": "max", "sample": "normal-5"}], indirect=True
)
TRUE = pytest.mark.parametrize(
    "flexdt_twin", [{"speed_up": 1.0}, {"speed_up": "max"}], indirect=True
)


@pytest.fixture
def engine(flexdt_twin: InProcessTwin) -> RunEngine:
    return RunEngine({}, loop=flexdt_twin.loop)


@pytest.fixture
def lab(engine: RunEngine, flexdt_twin: InProcessTwin, tmp_path: Path) -> TwinLab:
    where = StaticPathProvider(UUIDFilenameProvider(), tmp_path / "camera")
    with init_devices():
        lab = TwinLab(where, transport=flexdt_twin.transport())
    return lab  # noqa: RET504 - init_devices names it after the variable


def threads() -> int:
    """Count threads but the one that shows progress, which a process keeps once it has one."""
    return sum(thread.name != "flexdt-long-work" for thread in threading.enumerate())


def test_the_pages_plan_runs_and_leaves_no_thread() -> None:
    blocks = re.findall(
        r"```\{code-block\} python\n(.*?)```", PAGE.read_text("utf-8"), re.S
    )
    (text,) = (b for b in blocks if "RunEngine" in b)
    before = threads()
    exec(compile(text, "bluesky.md", "exec"), {})
    assert threads() == before


@MAX
def test_step_and_fly_scans_make_valid_documents_and_files(
    engine: RunEngine, lab: TwinLab, flexdt_twin: InProcessTwin
) -> None:
    documents: list[tuple[str, dict[str, Any]]] = []
    engine.subscribe(lambda name, document: documents.append((name, document)))

    def step() -> Iterator[Any]:
        yield from bps.mv(lab.tube.on, True, lab.camera.roi, "800 620 1199 939")
        yield from bps.mv(lab.axis("mag_obj"), 600.0)
        yield from bp.scan([lab.camera, lab.tube], lab.axis("rot_obj"), 0.0, 90.0, 3)

    engine(step())
    wish = ScanRequest(
        frames=9, exposure_ms=50.0, averages=10, roi=Roi(800, 620, 1199, 939)
    )
    engine(fly_scan(lab.scan, FlyScan(wish, seed=1)))
    for name, document in documents:
        schema_validators[DocumentNames[name]].validate(document)
    stops = [document for name, document in documents if name == "stop"]
    assert [stop["exit_status"] for stop in stops] == ["success", "success"]
    events = [document["data"] for name, document in documents if name == "event"]
    assert [e["lab-rot_obj"] for e in events] == [0.0, 45.0, 90.0]
    assert len({e["lab-camera-mean"] for e in events}) == 3
    (scan,) = flexdt_twin.data.glob("*/flexdt.json")
    assert len(list(scan.parent.glob("scan_*.tif"))) == 9


@TRUE
def test_moves_take_the_machines_time_whatever_the_plan_does(
    engine: RunEngine, lab: TwinLab, flexdt_twin: InProcessTwin
) -> None:
    """90 deg at 45 deg/s after 2 s at 22.5 deg/s^2; then 360: 2 s up, 2 s down, 270 deg
    between."""

    def plan() -> Generator[Any, Any, None]:
        for target, takes in ((90.0, 4.0), (450.0, 10.0)):
            begun = yield from clock()
            yield from bps.mv(lab.axis("rot_obj"), target)
            passed = (yield from clock()) - begun
            assert takes - 1e-6 <= passed <= takes + 1.1  # and until it is seen

    def clock() -> Generator[Any, Any, float]:
        yield from bps.null()
        return flexdt_twin.server.clock.now()

    engine(plan())
    with pytest.raises(FailedStatus) as failed:
        engine(bps.abs_set(lab.axis("rot_obj"), 1e6, wait=True))
    assert isinstance(failed.value.__cause__, LimitsExceeded)


def test_an_engine_with_another_loop_is_told_which(
    flexdt_twin: InProcessTwin, tmp_path: Path
) -> None:
    RunEngine({})
    where = StaticPathProvider(UUIDFilenameProvider(), tmp_path)
    with (
        pytest.raises(Exception, match=r"RunEngine\(\{\}, loop=twin.loop\)"),
        init_devices(),
    ):
        lab = TwinLab(where, transport=flexdt_twin.transport())  # noqa: F841
