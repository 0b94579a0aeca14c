"""Bluesky's RunEngine and ophyd-async against a real twin: documents, files, limits, stops."""

from __future__ import annotations

import asyncio
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import bluesky.plan_stubs as bps
import bluesky.plans as bp
import numpy as np
import pytest
import tifffile
from bluesky import RunEngine
from bluesky import protocols as proto
from bluesky.run_engine import call_in_bluesky_event_loop as drive
from bluesky.simulators import check_limits, summarize_plan
from bluesky.utils import FailedStatus, RunEngineInterrupted
from event_model import DocumentNames, schema_validators
from ophyd_async.core import (
    NotConnectedError,
    StaticPathProvider,
    TriggerInfo,
    UUIDFilenameProvider,
    init_devices,
)

from flexdt.clients import TwinClient
from flexdt.clients.launch.processes import Servers
from flexdt.library.reading.folders import load_dataset
from flexdt.protocol import RpcError
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.camera import Roi
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.scan_request import ScanRequest
from flexdt_extensions.bluesky import FlyScan, LimitsExceeded, TwinLab
from flexdt_extensions.bluesky.flyer import fly_scan

pytestmark = pytest.mark.timeout(300)

ROOT = Path(__file__).resolve().parents[3]
SMALL = Roi(800, 620, 1199, 939)
TURN = ScanRequest(
    kind="fly", frames=9, exposure_ms=50.0, averages=10, roi=SMALL, darks=1, flats=1
)
START = {"tra_obj": 0.0, "mag_obj": 600.0, "rot_obj": 0.0, "mag_det": 1000.0}


@pytest.fixture(scope="module")
def engine() -> RunEngine:
    return RunEngine({})


@pytest.fixture
def twin(servers: Servers) -> Iterator[TwinClient]:
    with TwinClient(*servers.address) as client:
        client.set_clock("max")
        client.set_sample("normal-5")
        client.move(START, wait=True)
        client.set_camera(mode="HW2SW1High", roi=(800, 620, 1199, 939), exposure_ms=50.0)
        client.control("release")  # from here on the laboratory drives; this client looks
        yield client


@pytest.fixture
def lab(
    engine: RunEngine, twin: TwinClient, servers: Servers, tmp_path: Path
) -> Iterator[TwinLab]:
    where = StaticPathProvider(UUIDFilenameProvider(), tmp_path / "camera")
    with init_devices():
        lab = TwinLab(where, *servers.address)
    yield lab
    drive(lab.close())


class Documents:
    """Everything a run emitted; each document is checked against event_model's schema."""

    def __init__(self) -> None:
        self.all: list[tuple[str, dict[str, Any]]] = []

    def __call__(self, name: str, document: dict[str, Any]) -> None:
        self.all.append((name, document))

    def validate(self) -> None:
        for name, document in self.all:
            schema_validators[DocumentNames[name]].validate(document)

    def named(self, name: str) -> list[dict[str, Any]]:
        return [document for kind, document in self.all if kind == name]

    def files(self, data_key: str) -> list[Path]:
        """As a consumer reads the documents: template, URI, indices."""
        resources = {d["uid"]: d for d in self.named("stream_resource")}
        found: list[Path] = []
        for datum in self.named("stream_datum"):
            resource = resources[datum["stream_resource"]]
            if resource["data_key"] != data_key:
                continue
            assert resource["mimetype"] == "multipart/related;type=image/tiff"
            assert resource["uri"].startswith("file://localhost/")
            folder = Path(unquote(urlsplit(resource["uri"]).path))
            span = range(datum["indices"]["start"], datum["indices"]["stop"])
            found += [folder / resource["parameters"]["template"].format(i) for i in span]
        return found


def run(engine: RunEngine, plan: Any) -> Documents:
    documents = Documents()
    engine(plan, documents)
    documents.validate()
    return documents


# -- step scan -----------------------------------------------------------------------------------


def test_a_step_scan_makes_valid_documents_and_the_tiffs_they_name(
    engine: RunEngine, lab: TwinLab, twin: TwinClient
) -> None:
    turn = lab.axis("rot_obj")

    def plan() -> Iterator[Any]:
        yield from bps.mv(lab.tube.kV, 90.0, lab.tube.power_W, 20.0, lab.tube.on, True)
        yield from bp.scan([lab.camera, lab.tube], turn, 0.0, 90.0, 3)

    made = run(engine, plan())
    events = made.named("event")
    assert [e["data"]["lab-rot_obj"] for e in events] == [0.0, 45.0, 90.0]
    files = made.files("lab-camera")
    assert len(files) == 3
    images = [tifffile.imread(f) for f in files]
    assert {(i.shape, i.dtype) for i in images} == {((160, 200), np.dtype(np.uint16))}
    assert not np.array_equal(images[0], images[2])  # the cuboid has turned
    means = [e["data"]["lab-camera-mean"] for e in events]
    assert means == [float(i.mean(dtype=np.float64)) for i in images]
    (descriptor,) = made.named("descriptor")
    assert descriptor["data_keys"]["lab-camera"]["shape"] == [1, 160, 200]
    assert descriptor["data_keys"]["lab-rot_obj"]["units"] == "deg"
    limits = descriptor["data_keys"]["lab-rot_obj"]["limits"]["control"]
    assert limits == {"low": -7200.0, "high": 7200.0}
    settings = descriptor["configuration"]["lab-camera"]["data"]
    assert settings["lab-camera-exposure_ms"] == 50.0
    assert settings["lab-camera-roi"] == "800 620 1199 939"
    assert descriptor["configuration"]["lab-tube"]["data"]["lab-tube-kV"] == 90.0
    assert descriptor["hints"]["lab-camera"]["fields"] == ["lab-camera-mean"]
    assert twin.state().tube.on
    assert twin.state().axes["rot_obj"].position == 90.0


def test_two_axes_at_once_and_readings_of_the_moment(
    engine: RunEngine, lab: TwinLab, twin: TwinClient
) -> None:
    near, turn = lab.axis("mag_obj"), lab.axis("rot_obj")
    made = run(engine, bp.grid_scan([near], near, 550.0, 600.0, 2, turn, 0.0, 20.0, 2))
    seen = [
        (e["data"]["lab-mag_obj"], e["data"]["lab-rot_obj"]) for e in made.named("event")
    ]
    assert seen == [(550.0, 0.0), (550.0, 20.0), (600.0, 0.0), (600.0, 20.0)]
    engine(bps.mv(near.speed, 12.5))
    assert twin.state().axes["mag_obj"].speed == 12.5


def test_the_camera_counts_and_flies_as_any_detector(
    engine: RunEngine, lab: TwinLab, twin: TwinClient
) -> None:
    counted = run(engine, bp.count([lab.camera], num=2))
    assert len(counted.files("lab-camera")) == 2

    def burst() -> Iterator[Any]:
        yield from bps.stage(lab.camera)
        yield from bps.open_run()
        yield from bps.prepare(
            lab.camera, TriggerInfo(number_of_events=4, livetime=0.02), wait=True
        )
        yield from bps.declare_stream(lab.camera, name="primary", collect=True)
        yield from bps.kickoff(lab.camera, wait=True)
        yield from bps.collect_while_completing(
            [lab.camera], [lab.camera], flush_period=0.05, stream_name="primary"
        )
        yield from bps.close_run()
        yield from bps.unstage(lab.camera)

    made = run(engine, burst())
    files = made.files("lab-camera")
    assert len(files) == 4
    assert all(f.is_file() for f in files)
    assert twin.state().camera.exposure_ms == pytest.approx(20.0)


def test_five_plans_of_different_kinds_run_in_one_engine(
    engine: RunEngine, lab: TwinLab, twin: TwinClient
) -> None:
    """Each run has image streams of its own, though plans stage the root of what they are
    given."""
    turn = lab.axis("rot_obj")
    runs = [
        run(engine, bp.count([lab.camera], num=2)),
        run(engine, bp.scan([lab.camera, lab.tube], turn, 0.0, 20.0, 2)),
        run(engine, fly_scan(lab.scan, FlyScan(TURN, seed=1), flush_s=0.05)),
        run(engine, bp.grid_scan([lab.camera], turn, 0.0, 10.0, 2, lab.axis("mag_obj"), 590.0,
                                 600.0, 2)),
        run(engine, bp.list_scan([lab.camera], turn, [3.0, 1.0, 2.0])),
        run(engine, bp.count([lab.camera], num=1)),
    ]  # fmt: skip
    keys = [
        "lab-camera",
        "lab-camera",
        "lab-scan",
        "lab-camera",
        "lab-camera",
        "lab-camera",
    ]
    files = [made.files(key) for made, key in zip(runs, keys, strict=True)]
    assert [len(f) for f in files] == [2, 2, 9, 4, 3, 1]
    assert (
        len({f for several in files for f in several}) == 21
    )  # no run overwrites another's
    assert all(f.is_file() for several in files for f in several)
    assert all(made.named("stop")[0]["exit_status"] == "success" for made in runs)


def test_data_keys_are_named_as_the_documentation_says(
    engine: RunEngine, lab: TwinLab
) -> None:
    text = (Path(__file__).parents[3] / "docs/extensions/bluesky.md").read_text(
        encoding="utf-8"
    )
    told = set(re.findall(r"`(lab-[\w-]+)`", text))
    step = run(engine, bp.scan([lab.camera, lab.tube], lab.axis("rot_obj"), 0.0, 10.0, 2))
    fly = run(engine, fly_scan(lab.scan, FlyScan(TURN, seed=1), flush_s=0.05))
    made: set[str] = set()
    for descriptor in step.named("descriptor") + fly.named("descriptor"):
        made |= set(descriptor["data_keys"])
        for settings in descriptor["configuration"].values():
            made |= set(settings["data"])
    assert (
        {"lab-camera", "lab-camera-mean", "lab-scan", "lab-scan-angle_deg"}
        <= told
        <= made
    )


def test_tiled_reads_the_images_of_both_kinds_of_scan(
    engine: RunEngine, lab: TwinLab
) -> None:
    tiff = pytest.importorskip(
        "tiled.adapters.tiff", reason="tiled, which is not a test's extra"
    )
    from bluesky.consolidators import consolidator_factory

    step = run(engine, bp.scan([lab.camera], lab.axis("rot_obj"), 0.0, 10.0, 2))
    fly = run(engine, fly_scan(lab.scan, FlyScan(TURN, seed=1), flush_s=0.05))
    for made, key in ((step, "lab-camera"), (fly, "lab-scan")):
        (resource,) = made.named("stream_resource")
        descriptor = next(d for d in made.named("descriptor") if key in d["data_keys"])
        reader = consolidator_factory(resource, descriptor)
        for datum in made.named("stream_datum"):
            reader.consume_stream_datum(datum)
        assert reader.structure().shape == (len(made.files(key)), 160, 200)
        adapter = tiff.TiffSequenceAdapter.from_uris(*(a.data_uri for a in reader.assets))
        images = np.asarray(adapter.read()).reshape(-1, 160, 200)
        np.testing.assert_array_equal(
            images, [tifffile.imread(f) for f in made.files(key)]
        )


# -- fly scan ------------------------------------------------------------------------------------


def test_a_fly_scan_announces_the_data_sets_own_tiffs(
    engine: RunEngine, lab: TwinLab, servers: Servers
) -> None:
    made = run(
        engine, fly_scan(lab.scan, FlyScan(TURN, name="turn", seed=7), flush_s=0.05)
    )
    assert made.named("stop")[0]["exit_status"] == "success"
    files = made.files("lab-scan")
    assert [f.name for f in files] == [f"scan_{i:06d}.tif" for i in range(9)]
    data = load_dataset(files[0].parent)
    assert len(data.frames) == 9
    assert [f.path for f in data.frames] == files
    assert {tifffile.imread(f).shape for f in files} == {(160, 200)}
    (pages,) = made.named("event_page")
    np.testing.assert_allclose(
        pages["data"]["lab-scan-angle_deg"], data.angles_deg, atol=1e-9
    )
    assert pages["seq_num"] == list(range(1, 10))
    assert np.all(np.diff(pages["data"]["lab-scan-time_s"]) > 0)
    descriptor = next(d for d in made.named("descriptor") if d["name"] == "primary")
    assert descriptor["data_keys"]["lab-scan"]["shape"] == [1, 160, 200]
    settings = descriptor["configuration"]["lab-scan"]["data"]
    assert settings["lab-scan-frames"] == 9
    np.testing.assert_allclose(
        settings["lab-scan-angles_deg"], [45.0 * i for i in range(9)], atol=1e-9
    )
    # The same scan with the same seed, by the other client, has the same bytes.
    text = (files[0].parent / "script.txt").read_bytes()
    with TwinClient(*servers.address) as client:
        client.control("force")
        again = client.submit_script(text, "turn-again", seed=7)
        assert client.wait_job(again.job).state == "done"
        other = Path(client.job_status(again.job).dataset or "")
    for file in files:
        assert (other / file.name).read_bytes() == file.read_bytes()


def test_a_scan_that_would_not_work_is_refused_before_anything_moves(
    engine: RunEngine, lab: TwinLab, twin: TwinClient
) -> None:
    before = twin.state().axes["mag_obj"].position
    bad = "tube\tset kV\t900\t\tACK\t\t\r\nmag_obj\tmove sideways\t1\t\tACK\t\t\r\n"
    with pytest.raises(FailedStatus) as caught:
        engine(fly_scan(lab.scan, FlyScan(bad)))
    refused = caught.value.__cause__
    assert isinstance(refused, LimitsExceeded)
    assert "line 2" in str(refused)
    assert twin.state().axes["mag_obj"].position == before


def test_a_series_that_is_not_one_is_refused(engine: RunEngine, lab: TwinLab) -> None:
    text = compose_script(
        TURN, builtin_machine("flexray"), builtin_profile("cwi-2023-08-21")
    )
    late = re.sub(r"(take and save image sequence\t\S+\t)0", r"\g<1>5", text)
    assert late != text
    with pytest.raises(FailedStatus) as caught:
        engine(fly_scan(lab.scan, FlyScan(late)))
    assert isinstance(caught.value.__cause__, TwinError)
    assert "numbered from 0" in str(caught.value.__cause__)


def test_a_flyer_pauses_resumes_and_aborts(lab: TwinLab, twin: TwinClient) -> None:
    """Driven as the RunEngine drives it, in its loop."""
    flyer = lab.scan

    async def main() -> tuple[list[int], str, str]:
        await flyer.stage()
        await flyer.prepare(FlyScan(TURN, speed_up=20.0))
        await flyer.kickoff()
        seen: list[int] = []
        completing = flyer.complete()
        completing.watch(lambda **update: seen.append(update["current"]))
        await until(lambda: flyer.job is not None and flyer.job.state == "running")
        await flyer.pause()
        await until(lambda: flyer.job is not None and flyer.job.state == "paused")
        await flyer.resume()
        await completing
        assert flyer.job is not None
        first = flyer.job.state
        await flyer.prepare(FlyScan(TURN, speed_up=1.0))
        # Before the twin has answered the submission: the pause is for the job that it makes.
        submission = flyer.kickoff()
        await asyncio.sleep(0)
        assert flyer.job is None
        await flyer.pause()
        await submission
        completing = flyer.complete()
        await until(lambda: flyer.job is not None and flyer.job.state == "paused")
        await flyer.unstage()
        with pytest.raises(RuntimeError, match=r"lab-scan: the scan .* ended aborted"):
            await completing
        return seen, first, flyer.job.state

    seen, first, second = drive(main())
    assert seen[-1] == 9
    assert seen == sorted(seen)
    assert (first, second) == ("done", "aborted")


def test_the_runengine_pauses_and_resumes_a_fly_scan(
    engine: RunEngine, lab: TwinLab, twin: TwinClient
) -> None:
    """RE.request_pause holds the twin's job; RE.resume lets the same job go on."""
    made = Documents()

    def pause_when_it_runs() -> None:
        while not (
            (job := twin.state().job) and job.name == "held" and job.state == "running"
        ):
            time.sleep(0.01)
        engine.request_pause()

    thread = threading.Thread(target=pause_when_it_runs)
    thread.start()
    # Slow enough that it has not ended when a busy machine comes to pause it.
    scan = FlyScan(TURN, name="held", speed_up=2.0)
    with pytest.raises(RunEngineInterrupted):
        engine(fly_scan(lab.scan, scan, flush_s=0.05), made)
    thread.join()
    assert engine.state == "paused"
    deadline = time.monotonic() + 60
    while twin.job_status().state != "paused":
        assert time.monotonic() < deadline
        time.sleep(0.01)
    engine.resume()
    assert engine.state == "idle"
    made.validate()
    assert made.named("stop")[0]["exit_status"] == "success"
    assert [f.name for f in made.files("lab-scan")] == [
        f"scan_{i:06d}.tif" for i in range(9)
    ]
    assert sum(j.name == "held" for j in twin.jobs().jobs) == 1


async def until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    async with asyncio.timeout(seconds):
        while not condition():
            await asyncio.sleep(0.01)


# -- limits --------------------------------------------------------------------------------------


def test_check_limits_finds_limits_before_anything_moves(
    lab: TwinLab, twin: TwinClient, capsys: pytest.CaptureFixture[str]
) -> None:
    near = lab.axis("mag_obj")
    before = twin.state()
    check_limits(bp.scan([], near, 580.0, 620.0, 3))
    with pytest.raises(
        LimitsExceeded, match=r"mag_obj target 1000 mm is outside \[70, 996\]"
    ) as e:
        check_limits(bp.scan([], near, 500.0, 2000.0, 4))
    assert e.value.data == {"axis": "mag_obj", "asked": 1000.0, "allowed": [70.0, 996.0]}
    assert twin.state().axes == before.axes
    summarize_plan(bp.scan([], near, 580.0, 620.0, 3))
    assert "lab-mag_obj -> 580" in capsys.readouterr().out


def test_check_limits_finds_a_collision_that_the_twin_would_refuse(
    engine: RunEngine, lab: TwinLab, twin: TwinClient
) -> None:
    near, target = lab.axis("mag_det"), 640.0
    with pytest.raises(LimitsExceeded, match="would touch on the way") as caught:
        check_limits(bps.mv(near, target))
    assert isinstance(caught.value.data["pair"], list)
    with pytest.raises(FailedStatus):
        engine(bps.mv(near, target))
    assert twin.state().axes["mag_det"].position == START["mag_det"]
    # The twin's own word, without which this test says nothing; it goes as far as it is free.
    with pytest.raises(RpcError) as refused:
        drive(lab.link.client.move({"mag_det": target}, wait=True))
    assert refused.value.code == -32002


# -- stopping ------------------------------------------------------------------------------------


def moving(lab: TwinLab, end: Callable[[], Any]) -> tuple[Any, list[float]]:
    """Start a long motion, call `end` while it goes on; the status's error and what was
    seen."""
    turn = lab.axis("rot_obj")
    drive(lab.link.client.set_clock(1.0))
    seen: list[float] = []

    async def main() -> Any:
        status = turn.set(180.0)
        status.watch(lambda **update: seen.append(update["current"]))
        await until(lambda: len({*seen}) >= 3)
        done = end()
        if asyncio.iscoroutine(done):
            await done
        try:
            await status
        except Exception as error:
            return error
        return None

    try:
        return drive(main()), seen
    finally:
        drive(lab.link.client.set_clock("max"))


def test_stop_brakes_one_axis_and_fails_its_status(
    lab: TwinLab, twin: TwinClient
) -> None:
    error, seen = moving(lab, lambda: lab.axis("rot_obj").stop(success=False))
    assert isinstance(error, RuntimeError)
    assert "stopped" in str(error)
    assert seen == sorted(seen)  # progress on the way there
    assert 0 < twin.state().axes["rot_obj"].position < 180.0


def test_stop_as_planned_succeeds(lab: TwinLab, twin: TwinClient) -> None:
    error, _ = moving(lab, lambda: lab.axis("rot_obj").stop(success=True))
    assert error is None
    assert 0 < twin.state().axes["rot_obj"].position < 180.0


def test_somebody_elses_emergency_stop_fails_the_motion(
    lab: TwinLab, twin: TwinClient
) -> None:
    def hit() -> None:
        threading.Thread(target=twin.estop).start()

    error, _ = moving(lab, hit)
    assert isinstance(error, RuntimeError)
    assert "emergency stop" in str(error)
    drive(lab.link.client.reset())


# -- the rest ------------------------------------------------------------------------------------


def test_devices_follow_blueskys_protocols(lab: TwinLab) -> None:
    axis = lab.axis("mag_obj")
    movable = (proto.Readable, proto.Movable, proto.Stoppable, proto.Checkable, proto.Locatable,
               proto.Configurable, proto.Stageable, proto.Subscribable)  # fmt: skip
    assert [p.__name__ for p in movable if not isinstance(axis, p)] == []
    camera = (proto.Triggerable, proto.Readable, proto.Stageable, proto.Preparable,
              proto.Flyable, proto.WritesStreamAssets)  # fmt: skip
    assert [p.__name__ for p in camera if not isinstance(lab.camera, p)] == []
    flyer = (proto.Flyable, proto.Preparable, proto.Collectable, proto.WritesStreamAssets,
             proto.Pausable, proto.Stoppable, proto.Stageable, proto.Configurable)  # fmt: skip
    assert [p.__name__ for p in flyer if not isinstance(lab.scan, p)] == []
    with pytest.raises(KeyError, match="rot_obj"):
        lab.axis("warp")


def test_nobody_there_is_said_device_by_device(engine: RunEngine, tmp_path: Path) -> None:
    where = StaticPathProvider(UUIDFilenameProvider(), tmp_path)
    nowhere = TwinLab(where, port=1, name="nowhere")
    with pytest.raises(
        NotConnectedError, match=r"no server at 127\.0\.0\.1:1 \(Connection ref"
    ):
        drive(nowhere.connect())


def test_the_example_runs(servers: Servers, twin: TwinClient, tmp_path: Path) -> None:
    host, port = servers.address
    done = subprocess.run(
        [sys.executable, str(ROOT / "extensions" / "examples" / "bluesky_scans.py"), host,
         str(port), "--images", str(tmp_path)],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    refused, step, fly = done.stdout.splitlines()
    assert refused.startswith("refused: mag_obj target 1000 mm is outside")
    assert step.startswith("step scan: 4 images, ")
    assert fly.startswith("fly scan: 13 images in ")
    assert len(list(tmp_path.glob("*.tif"))) == 4
    assert (
        len(list(Path(fly.removeprefix("fly scan: 13 images in ")).glob("scan_*.tif")))
        == 13
    )


def test_without_the_extra_one_line_says_what_to_install() -> None:
    code = (
        "import sys; sys.modules['ophyd_async'] = sys.modules['ophyd_async.core'] = None\n"
        "from flexdt.twin.errors import TwinError\n"
        "import flexdt_extensions.bluesky as lab\n"
        "try:\n    lab.TwinLab\nexcept TwinError as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    assert "pip install 'flexdt-extensions[lab]'" in done.stdout


def test_the_pages_programme_runs(
    servers: Servers, twin: TwinClient, tmp_path: Path
) -> None:
    page = (ROOT / "docs" / "extensions" / "bluesky.md").read_text("utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    host, port = servers.address
    for written, meant in (
        ('"/data/camera")', f'"{tmp_path}"), {host!r}, {port}'),
        ("90.0, 10))", "90.0, 2))"),
        ("frames=361, averages=5", "frames=9, averages=10, darks=1, flats=1, roi=SMALL"),
    ):
        assert written in block
        block = block.replace(written, meant)
    names: dict[str, Any] = {"SMALL": SMALL}
    exec(block, names)
    drive(names["lab"].close())
    assert len(list(tmp_path.glob("*.tif"))) == 2


LEAVING = """
import sys
from bluesky import RunEngine
import bluesky.plan_stubs as bps
from ophyd_async.core import StaticPathProvider, UUIDFilenameProvider, init_devices
from flexdt_extensions.bluesky import TwinLab

engine = RunEngine({})
where = StaticPathProvider(UUIDFilenameProvider(), "camera")
with init_devices():
    lab = TwinLab(where, sys.argv[1], int(sys.argv[2]))
engine(bps.rd(lab.rot_obj))
print("done")
"""


def test_a_process_that_leaves_without_closing_says_nothing(
    servers: Servers, twin: TwinClient, tmp_path: Path
) -> None:
    del twin  # it waits until the servers answer
    words = [sys.executable, "-c", LEAVING, servers.address[0], str(servers.address[1])]
    done = subprocess.run(
        words, capture_output=True, text=True, timeout=120, cwd=tmp_path, check=False
    )
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, "done", "")
