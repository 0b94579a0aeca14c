"""A volume that grows while its scan comes into being, beside a body whose values are known."""

from __future__ import annotations

import asyncio
import base64
import json
import shutil
import threading
import time
from collections.abc import AsyncIterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import tifffile

from flexdt.clients.cli import main
from flexdt.clients.viewer.live_volume import (
    MOST_POINTS,
    LiveReconstruction,
    grow,
    points_of,
    reconstruct,
    surface,
)
from flexdt.runtime.files.directory import open_data
from flexdt.server.storage.dataset_writer import DatasetWriter
from flexdt.twin.dataset.flexdt_json import parse_document
from flexdt.twin.dataset.record import NoiseRecord, SampleRecord, ScanRecord
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.script import parse_script, plan_script
from flexdt.twin.script.compose import ScanRequest, compose_script

VIEWS, SIDE, MU, RADIUS = 61, 48, 0.03, 9.0
MACHINE = builtin_machine()
PROFILE = builtin_profile(MACHINE.default_profile)
Array = npt.NDArray[np.float64]
Place = tuple[float, float, float]


def through(radius: float, source: Array, pixels: Array) -> Array:
    """Lengths [mm] within a ball of `radius` about the origin of rays to `pixels` (..., 3)."""
    along = pixels - source
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    off = np.linalg.norm(np.cross(np.broadcast_to(source, pixels.shape), along), axis=-1)
    return np.asarray(2.0 * np.sqrt(np.maximum(radius**2 - off**2, 0.0)))


def begun(root: Path, kind: str, frames: int) -> Path:
    """The folder of a scan that has begun: its geometry is written, and no image yet."""
    wish = ScanRequest(kind, frames=frames, mode="HW4SW1High")  # type: ignore[arg-type]
    script = compose_script(wish, MACHINE, PROFILE).encode()
    plan = plan_script(parse_script(script), MACHINE, PROFILE)
    record = ScanRecord.from_plan(
        plan, name="ball", started=datetime(2026, 1, 2), sample=SampleRecord(name="ball"),
        noise=NoiseRecord(3, {}), correction=None,
    )  # fmt: skip
    DatasetWriter(open_data(root), record, script=script, sync=False).close()
    return root / "ball"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball about the origin on a circle, as `scan_of` leaves it."""
    root = tmp_path_factory.mktemp("made")
    scan_of(root, (0.0, 0.0, 0.0), RADIUS)
    return root


@pytest.fixture
def scan(made: Path, tmp_path: Path) -> tuple[Path, list[Path]]:
    """A copy of it: its folder, and the projections, which lie elsewhere."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path / "ball", sorted(tmp_path.glob("*.tif"))


def scan_of(tmp_path: Path, at: Place, radius: float) -> tuple[Path, list[Path]]:
    home = begun(tmp_path, "fly", VIEWS)
    document = parse_document((home / "flexdt.json").read_text())
    waiting: list[Path] = []
    for frame in document.frames:
        rows, cols = document.shape_of(frame)
        row = np.array(frame.cone_vec)
        c, r = np.arange(cols) - (cols - 1) / 2, np.arange(rows) - (rows - 1) / 2
        places = row[3:6] + c[None, :, None] * row[6:9] + r[:, None, None] * row[9:12]
        beam = {"dark": 0.0, "flat": 1.0}.get(frame.kind)
        if beam is None:
            beam = np.exp(-MU * through(radius, row[:3] - at, places - at))
        counts = np.rint(np.broadcast_to(100.0 + 12_000.0 * beam, (rows, cols))).astype(np.uint16)
        file = (home if frame.kind != "projection" else tmp_path) / frame.file
        tifffile.imwrite(file, counts)
        if frame.kind == "projection":
            waiting.append(file)
    return home, waiting


def grey_of(document: dict[str, Any], name: str) -> npt.NDArray[np.uint8]:
    part = document["slices"][name]
    return np.frombuffer(base64.b64decode(part["data"]), np.uint8).reshape(part["shape"])


def middle(document: dict[str, Any], name: str) -> float:
    """The value in the middle of a slice [1/mm]."""
    grey = grey_of(document, name)
    rows, cols = grey.shape
    span = document["high"] - document["low"]
    around = grey[rows // 2 - 1 : rows // 2 + 2, cols // 2 - 1 : cols // 2 + 2].mean()
    return float(document["low"] + around / 255.0 * span)


def test_it_grows_with_every_image_to_the_true_values(
    scan: tuple[Path, list[Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    home, waiting = scan
    monkeypatch.setattr("flexdt.clients.viewer.live_volume.TELL_S", 0.0)
    told: list[dict[str, Any]] = []
    work = threading.Thread(target=grow, args=(home, SIDE, told.append))
    work.start()
    deadline = time.monotonic() + 120.0
    for come in (1, 16, 31, 46, VIEWS):
        for file in waiting[:come]:
            if file.exists():
                file.rename(home / file.name)
        while not told or told[-1]["views"] < come:
            assert work.is_alive()
            assert time.monotonic() < deadline
            time.sleep(0.01)
        last = told[-1]
        assert (last["views"], last["of"], last["name"]) == (come, VIEWS, "ball")
        # Each view has its part of the whole; in the middle of a ball all give the same. The first
        # and the last are of one direction, and share its part.
        share = 0.0 if come == 1 else (come - 0.5) / (VIEWS - 1) if come < VIEWS else 1.0
        for name in ("top", "front", "side"):
            assert middle(last, name) == pytest.approx(MU * share, rel=0.05, abs=0.01 * MU)
    work.join(60.0)
    assert not work.is_alive()
    assert [d["views"] for d in told] == list(range(1, VIEWS + 1))
    rows, cols = told[-1]["slices"]["top"]["shape"]
    assert rows == cols
    assert abs(cols - SIDE) <= 1


@pytest.mark.daily(1)
@pytest.mark.parametrize("seed", range(3))
def test_no_slice_is_a_mirror_image(tmp_path: Path, seed: int) -> None:
    """A ball off all three planes lies in each picture where one who looks that way has it."""
    rng = np.random.default_rng(seed)
    x, y, z = (float(v) for v in rng.choice([-1.0, 1.0], 3) * rng.uniform(2.5, 4.0, 3))
    home, files = scan_of(tmp_path, (x, y, z), 5.5)
    for file in files:
        file.rename(home / file.name)
    told: list[dict[str, Any]] = []
    grow(home, SIDE, told.append)
    for name, (right, up) in {"top": (x, y), "front": (x, z), "side": (y, z)}.items():
        grey = grey_of(told[-1], name)
        rows, cols = np.nonzero(grey > 160)
        from_middle = cols.mean() - (grey.shape[1] - 1) / 2, (grey.shape[0] - 1) / 2 - rows.mean()
        at_mm = np.array(from_middle) * told[-1]["voxel_mm"]
        np.testing.assert_allclose(at_mm, (right, up), atol=0.7 * told[-1]["voxel_mm"])
    # Points of the surface, on the stage: all about the ball, and everywhere on it.
    points, size = points_of(told[-1]["surface"]), told[-1]["surface"]["size_mm"]
    from_ball = points - [x, y, z]
    apart = np.linalg.norm(from_ball, axis=1)
    assert np.abs(apart - 5.5).max() < 1.5 * size
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert (directions @ (from_ball / apart[:, None]).T).max(axis=1).min() > 0.9


def test_a_surface_has_few_points_whatever_the_volume() -> None:
    """A box in a large volume of voxels that are no cubes: its faces, a cell off at most, although
    streaks of 0.6 of its value, as few views leave them, are all over the volume."""
    grown = np.random.default_rng(1).normal(0.0, 0.01, (200, 150, 260)).astype(np.float32)
    grown[40:160, 30:90, 50:200] += 1.0  # (y, x, z)
    streaks = np.add.outer(np.arange(200) // 5, np.arange(150) // 5) % 2
    grown += (1.2 * streaks - 0.6).astype(np.float32)[:, :, None]
    told = surface(grown, (0.5, 0.4, 0.3), (10.0, -20.0, 5.0))
    points, size = points_of(told), told["size_mm"]
    assert size == 5 * 0.5
    assert 500 < len(points) <= MOST_POINTS
    low = np.array([10 + (30 - 75) * 0.5, -20 + (40 - 100) * 0.4, 5 + (50 - 130) * 0.3])
    high = np.array([10 + (90 - 75) * 0.5, -20 + (160 - 100) * 0.4, 5 + (200 - 130) * 0.3])
    np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [low, high], atol=size)
    to_face = np.minimum(np.abs(points - low), np.abs(points - high)).min(axis=1)
    assert to_face.max() < size


def test_nobody_waits_for_a_scan_that_nobody_looks_at(scan: tuple[Path, list[Path]]) -> None:
    with pytest.raises(SystemExit):
        grow(scan[0], SIDE, lambda document: None, alive=lambda: False)


def test_the_volume_of_a_past_scan_is_that_of_the_command(
    scan: tuple[Path, list[Path]], tmp_path: Path
) -> None:
    """Every slice, within half a grey step, of what `flexdt reconstruct --binning` writes."""
    home, files = scan
    for file in files:
        file.rename(home / file.name)
    told: list[dict[str, Any]] = []
    cut = reconstruct(home, 120, told.append)
    last = told[-1]
    assert [d["done"] for d in told] == sorted(d["done"] for d in told)
    assert (last["done"], last["views"], last["of"]) == (1.0, VIEWS, VIEWS)
    out = tmp_path / "volume.tif"
    words = ["reconstruct", str(home), "--out", str(out), "--binning", str(last["binning"])]
    with pytest.raises(SystemExit, match="0"):
        main(words)
    whole = tifffile.imread(out)  # (z, y, x)
    assert last["size"] == dict(zip(("top", "front", "side"), whole.shape, strict=True))
    step = (last["high"] - last["low"]) / 255.0
    for name, seen in (
        ("top", lambda k: whole[k, ::-1]),
        ("front", lambda k: whole[::-1, k]),
        ("side", lambda k: whole[::-1, :, k]),
    ):
        for k in (0, last["size"][name] // 3, last["size"][name] - 1, 10**6):
            part = cut(name, k)
            grey = np.frombuffer(base64.b64decode(part["data"]), np.uint8).reshape(part["shape"])
            true = np.clip(seen(min(k, last["size"][name] - 1)), last["low"], last["high"])
            assert np.abs(last["low"] + step * grey - true).max() < 1.01 * step


def test_slices_come_from_the_process_until_it_is_stopped(scan: tuple[Path, list[Path]]) -> None:
    home, files = scan
    for file in files:
        file.rename(home / file.name)

    async def body() -> None:
        told: list[str] = []
        one = LiveReconstruction(told.append)
        assert await one.slice("top", 0) is None
        one.grow(home, 120, past=True)
        while '"slices"' not in one.newest:
            assert "problem" not in one.newest
            await asyncio.sleep(0.02)
        middle = json.loads(one.newest.partition("\t")[2])["size"]["top"] // 2
        low, high = await asyncio.gather(one.slice("top", 0), one.slice("top", middle))
        assert low is not None
        assert high is not None
        assert low["shape"] == high["shape"]
        assert low["data"] != high["data"]
        one.stop()
        assert await one.slice("top", 0) is None

    asyncio.run(body())


class Ended:
    """A process that has said a line and ended; the loop has not heard of its end yet."""

    returncode: int | None = None
    killed, stdin = False, None

    async def _lines(self) -> AsyncIterator[bytes]:
        yield b"{}\n"

    stdout = property(_lines)

    def kill(self) -> None:
        self.killed = True

    async def wait(self) -> None:
        self.returncode = 0


def test_a_process_that_has_ended_is_not_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python would take its exit code from the loop, which then logs an unknown child."""
    process, told = Ended(), []

    async def start(*words: str, **options: object) -> Ended:
        return process

    async def body() -> None:
        monkeypatch.setattr("asyncio.create_subprocess_exec", start)
        LiveReconstruction(told.append).grow(Path("none"), 128)
        while process.returncode is None:
            await asyncio.sleep(0)

    asyncio.run(body())
    assert told == ["{}\n"]
    assert not process.killed


def test_what_is_no_circle_is_told(tmp_path: Path) -> None:
    home = begun(tmp_path, "tiled", 45)
    with pytest.raises(TwinError):
        grow(home, SIDE, lambda document: None)
