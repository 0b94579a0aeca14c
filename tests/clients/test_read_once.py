"""A reconstruction reads each image once, in any number of slabs, and leaves no file behind."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import warnings
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.library.reconstruction import kept_images, memory_plan, reconstruct, slab_fdk
from flexdt.library.reconstruction.memory_plan import plan_memory
from flexdt.library.reconstruction.reconstruct import (
    VolumeRequest,
    reconstruct_dataset,
    reconstruct_volume,
)
from flexdt.library.reconstruction.volume_files import read_volume
from flexdt.runtime.files import directory
from flexdt.twin.errors import LimitError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.geometry.panel import Panel
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import coarse_scan
from flexdt.twin.scanner.state import NamedCorrection

VIEWS, ROWS, COLS, PIXEL = 66, 30, 36, 1.2
SOD, SDD = 300.0, 500.0
GRID = Grid((21, 22, 22), 0.9)
OPEN = 50_000.0


def rolled(roll: float) -> ConeVec:
    """A circle about z whose panel is rolled by an angle [rad], written out by hand."""
    turn = np.linspace(0.0, 2.0 * np.pi, VIEWS, endpoint=False)
    c, s, o = np.cos(turn), np.sin(turn), np.zeros(VIEWS)
    across, away, up = (
        np.stack([c, s, o], 1),
        np.stack([-s, c, o], 1),
        np.array([0.0, 0.0, 1.0]),
    )
    u = np.cos(roll) * across - np.sin(roll) * up
    v = -np.sin(roll) * across - np.cos(roll) * up
    return ConeVec.from_vectors(-SOD * away, (SDD - SOD) * away, PIXEL * u, PIXEL * v)


def counts_of(radius: float, scan: ConeVec, rng: np.random.Generator) -> np.ndarray:
    """Counts of a cylinder beside the axis, denser above than below; noise, so that rows
    differ."""
    column = (np.arange(COLS) - (COLS - 1) / 2)[:, None]
    row = (np.arange(ROWS) - (ROWS - 1) / 2)[:, None, None]
    source = scan.source[:, None, None] - (2.0, 0.0, 0.0)
    u, v = scan.u[:, None, None], scan.v[:, None, None]
    along = (
        scan.detector[:, None, None] + column * u + row * v - scan.source[:, None, None]
    )
    squared = (along[..., :2] ** 2).sum(axis=-1)
    middle = -(source[..., :2] * along[..., :2]).sum(axis=-1) / squared
    inside = middle**2 - ((source[..., :2] ** 2).sum(axis=-1) - radius**2) / squared
    chord = 2.0 * np.sqrt(np.maximum(inside, 0.0)) * np.linalg.norm(along, axis=-1)
    mu = 0.02 * (1.0 + 0.01 * middle * along[..., 2])
    light = OPEN * np.exp(-mu * chord) + rng.normal(0.0, 30.0, chord.shape)
    return np.round(light).astype(np.uint16)


def written(
    folder: Path, *, radius: float = 7.0, roll: float = 0.0, seed: int = 5
) -> Path:
    flat, scan = np.full((ROWS, COLS), OPEN, np.uint16), rolled(roll)
    images = counts_of(radius, scan, np.random.default_rng(seed))
    fx.DataSet.from_arrays(images, scan, flat=flat, dark=0 * flat).save(folder)
    return folder


@pytest.fixture(autouse=True)
def _quietly() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@pytest.fixture(autouse=True)
def _no_work_beside_a_slab(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a memory is a number of slabs."""
    monkeypatch.setattr(memory_plan, "WORKING_IMAGES", 0)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each projection's file is read, counted where files are opened."""
    count: Counter[str] = Counter()
    read = fx.library.datasets.image_set.read_image

    def counting(path: Path, shape: tuple[int, int] | None = None) -> np.ndarray:
        count[path.name] += 1
        return read(path, shape)

    monkeypatch.setattr("flexdt.library.datasets.image_set.read_image", counting)
    return count


def memory_for(slabs: int, grid: Grid = GRID) -> int:
    """Memory in which a volume is made in so many slabs, images on disk."""
    memory = grid.bytes // slabs + grid.bytes // grid.shape[0] // 2
    assert len(plan_memory(grid, VIEWS, 1, ROWS * COLS, memory).slabs) == slabs
    return memory


def with_lag(data: fx.DataSet) -> fx.DataSet:
    """The same data set with a panel that shows some of the image before."""
    panel = Panel(Panel.flat(data.shape).model, Panel.flat(data.shape).coefficients, 0.02)
    return data.with_correction(NamedCorrection("lag", "", NOMINAL, panel=panel))


AS_IT_IS: Callable[[fx.DataSet], fx.DataSet] = lambda data: data  # noqa: E731
CASES: dict[
    str, tuple[dict[str, float], dict[str, Any], Callable[[fx.DataSet], fx.DataSet]]
] = {
    "whole": ({}, {}, AS_IT_IS),
    "cut off": ({"radius": 24.0}, {}, AS_IT_IS),
    "rings": ({}, {"rings": True}, AS_IT_IS),
    "leaning": ({"roll": 0.02}, {}, AS_IT_IS),
    "leaning, cut off": ({"roll": -0.03, "radius": 24.0}, {"rings": True}, AS_IT_IS),
    "on its side": ({"roll": 0.5 * np.pi}, {}, AS_IT_IS),
    "lag": ({}, {}, with_lag),
    "some": ({}, {"every": 3}, AS_IT_IS),
}


LONGER = ("leaning, cut off", "some", "rings")
"""Cases in whose parts others are, too."""


@pytest.mark.parametrize(
    "case",
    [pytest.param(name, marks=[pytest.mark.slow] * (name in LONGER)) for name in CASES],
)
def test_each_image_is_read_once_whatever_the_slabs(
    case: str, tmp_path: Path, reads: Counter[str]
) -> None:
    made, asked, changed = CASES[case]
    data = changed(fx.open(written(tmp_path / "scan", **made)))
    request = VolumeRequest(shape=GRID.shape, voxel_mm=GRID.voxel_mm, **asked)
    volumes = []
    for slabs in (1, 3, 7):
        reads.clear()
        out = tmp_path / f"{slabs}.mha"
        told: list[float] = []
        reconstruct_dataset(
            data, out, request, memory=memory_for(slabs),
            progress=lambda done, whole, told=told: told.append(done / whole),
        )  # fmt: skip
        frames = {f.file for f in data.frames[:: asked.get("every", 1)]}
        looked_at = set(reads) - frames  # for the exposure, of frames that are left out
        assert set(reads.values()) == {1}
        assert frames <= set(reads)
        assert not looked_at or asked.get("every", 1) > 1
        assert told[-1] == 1.0
        assert np.all(np.diff(told) > 0)
        volumes.append(np.array(read_volume(out).data))
    # Of plain arrays, in one piece.
    integrals = np.stack(
        [data.line_integrals(i) for i in data.present[:: asked.get("every", 1)]]
    )
    if not asked.get("rings"):
        scan = data.geometry[:: asked.get("every", 1)]
        volumes.append(fx.fdk(integrals, scan, GRID, errors=False).data)
    for volume in volumes[1:]:
        np.testing.assert_allclose(
            volume, volumes[0], atol=3e-6 * np.nanmax(volumes[0]), rtol=0.0
        )
    assert np.nanmax(volumes[0]) > 0.015


def test_images_that_only_slabs_need_are_read_once(
    tmp_path: Path, reads: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As most of a scan of many views are: truncation and bias take some of them."""
    monkeypatch.setattr(coarse_scan, "VIEWS", 11)
    data = fx.open(written(tmp_path / "scan"))
    before: list[int] = []
    make = slab_fdk.fdk_parts

    def counting(*args: Any, **more: Any) -> Any:
        before.append(len(reads))
        return make(*args, **more)

    monkeypatch.setattr(slab_fdk, "fdk_parts", counting)
    request = VolumeRequest(shape=GRID.shape, voxel_mm=GRID.voxel_mm)
    reads.clear()
    reconstruct_dataset(data, tmp_path / "v.mha", request, memory=memory_for(3))
    assert before[0] < VIEWS
    assert before[1:] == [VIEWS, VIEWS]
    assert dict(reads) == {frame.file: 1 for frame in data.frames}


@pytest.mark.parametrize("errors", [False, True])
def test_a_volume_in_memory_reads_each_image_once(
    errors: bool, tmp_path: Path, reads: Counter[str]
) -> None:
    data = fx.open(written(tmp_path / "scan"))
    reads.clear()
    volume = data.reconstruct(shape=GRID.shape, voxel=GRID.voxel_mm, errors=errors)
    assert dict(reads) == {frame.file: 1 for frame in data.frames}
    plain = fx.fdk(data.line_integrals(), data.geometry, GRID, errors=errors)
    np.testing.assert_allclose(volume.data, plain.data, atol=1e-7)
    for told, expected in (
        (volume.sigma, plain.sigma),
        (volume.bias_bound, plain.bias_bound),
    ):
        assert (told is None) == (expected is None) == (not errors)
        if errors:
            np.testing.assert_allclose(told, expected, rtol=1e-3)
    assert volume.accuracy == plain.accuracy or errors


def test_a_volume_larger_than_the_memory_lies_in_a_file_without_a_name(
    tmp_path: Path, reads: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    data = fx.open(written(tmp_path / "scan"))
    here = data.reconstruct(shape=GRID.shape, voxel=GRID.voxel_mm)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(reconstruct, "gettempdir", lambda: str(temporary))
    monkeypatch.setattr(reconstruct, "memory_bytes", lambda: 2 * GRID.bytes)
    monkeypatch.setattr(reconstruct, "free_memory_bytes", lambda: GRID.bytes // 2)
    reads.clear()
    volume = reconstruct_volume(
        data, VolumeRequest(shape=GRID.shape, voxel_mm=GRID.voxel_mm)
    )
    assert set(reads.values()) == {1}
    assert not list(temporary.iterdir())
    np.testing.assert_allclose(volume.data, here.data, atol=3e-6 * np.nanmax(here.data))
    assert len(open_files(temporary)) == 1  # the volume's own
    del volume
    assert open_files(temporary) == []
    monkeypatch.setattr(reconstruct, "free_bytes", lambda folder: GRID.bytes - 1)
    with pytest.raises(LimitError, match=f"GiB free in {temporary}"):
        reconstruct_volume(data, VolumeRequest(shape=GRID.shape, voxel_mm=GRID.voxel_mm))


@pytest.mark.parametrize("in_memory", [False, True])
def test_one_slab_is_held_at_a_time(
    in_memory: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = fx.open(written(tmp_path / "scan"))
    request = VolumeRequest(shape=GRID.shape, voxel_mm=GRID.voxel_mm)
    earlier: list[weakref.ref[np.ndarray]] = []
    alive: list[int] = []
    make = slab_fdk.fdk_parts

    def watched(*args: Any, **more: Any) -> Any:
        alive.append(sum(one() is not None for one in earlier))
        made = make(*args, **more)
        earlier.append(weakref.ref(made.data))
        return made

    monkeypatch.setattr(slab_fdk, "fdk_parts", watched)
    if in_memory:
        monkeypatch.setattr(reconstruct, "memory_bytes", lambda: 2 * GRID.bytes)
        monkeypatch.setattr(reconstruct, "free_memory_bytes", lambda: GRID.bytes // 2)
        reconstruct_volume(data, request)
    else:
        reconstruct_dataset(data, tmp_path / "v.tif", request, memory=memory_for(7))
    assert len(alive) > 3
    assert set(alive) == {0}


@pytest.mark.slow
@pytest.mark.parametrize("slabs", [3, 1])
@pytest.mark.campaign(1)
def test_scatter_correction_reads_each_image_once(
    slabs: int, tmp_path: Path, reads: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flexdt.twin.physics.scatter.MAX_HISTORIES", 16)
    data = fx.open(written(tmp_path / "scan"))
    reads.clear()
    request = VolumeRequest(
        shape=GRID.shape,
        voxel_mm=GRID.voxel_mm,
        rings=True,
        scatter_correction=("abs",),
        kV=60.0,
    )
    reconstruct_dataset(data, tmp_path / "v.mha", request, memory=memory_for(slabs))
    assert dict(reads) == {frame.file: 1 for frame in data.frames}


def open_files(folder: Path) -> list[str]:
    """Files below a folder that this process holds open, those without a name too."""
    held = []
    for entry in Path("/proc/self/fd").iterdir():
        try:
            held.append(os.readlink(entry))
        except OSError:  # that of the listing itself
            continue
    return [name for name in held if name.startswith(f"{folder}/")]


class Stop(Exception):
    """What no code expects."""


@pytest.mark.skipif(
    not Path("/proc/self/fd").is_dir(), reason="lists open files by /proc"
)
@pytest.mark.parametrize(
    "seed",
    [pytest.param(seed, marks=[pytest.mark.slow] * (seed > 1)) for seed in range(8)],
)
@pytest.mark.campaign(4)
def test_no_file_stays_behind_whatever_fails_and_when(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(900 + seed)
    data = fx.open(written(tmp_path / "scan"))
    folder = tmp_path / "out"
    folder.mkdir()
    seen: set[str] = set()
    held: list[str] = []
    left = 0

    def failing(step: Callable[..., Any], error: BaseException) -> Callable[..., Any]:
        def instead(*args: Any, **more: Any) -> Any:
            nonlocal left
            seen.update(p.name for p in folder.iterdir())
            held.extend(open_files(folder))
            left -= 1
            if left < 0:
                raise error
            return step(*args, **more)

        return instead

    disk = kept_images.ImagesOnDisk
    stages = {
        "read": ("flexdt.library.datasets.image_set.read_image", None, VIEWS),
        "keep": (disk, "put", VIEWS),
        "take": (disk, "get", 2 * VIEWS),
        "prepare": (reconstruct.ScanFrames, "view", VIEWS),
        "slab": ("flexdt.library.reconstruction.slab_fdk.fdk_parts", None, 3),
        "write": ("flexdt.library.reconstruction.volume_formats._blocks", None, 3),
    }
    request = VolumeRequest(
        shape=GRID.shape, voxel_mm=GRID.voxel_mm, rings=bool(seed % 2)
    )
    for stage, (owner, name, most) in stages.items():
        error = (Stop("now"), KeyboardInterrupt(), OSError(errno.EIO, "bad disk"))[
            int(rng.integers(3))
        ]
        left = int(rng.integers(most))
        with monkeypatch.context() as patch:
            if name is None:
                module, _, called = str(owner).rpartition(".")
                patch.setattr(owner, failing(getattr(sys.modules[module], called), error))
            else:
                patch.setattr(owner, name, failing(getattr(owner, name), error))
            with pytest.raises((type(error), TwinError)):
                reconstruct_dataset(data, folder / "v.mha", request, memory=memory_for(3))
        assert not list(folder.iterdir()), stage
        assert open_files(folder) == [], stage
    assert seen <= {".v.mha.part.mha"}
    assert any("deleted" in name for name in held)


KILLED = """
import os, signal, sys
import flexdt as fx
from flexdt.library.reconstruction import kept_images, memory_plan, reconstruct, slab_fdk
memory_plan.WORKING_IMAGES = 0
put, left = kept_images.ImagesOnDisk.put, [int(sys.argv[3])]
def dying(self, number, image):
    put(self, number, image)
    left[0] -= 1
    if left[0] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
kept_images.ImagesOnDisk.put = dying
asked = reconstruct.VolumeRequest(shape=(21, 22, 22), voxel_mm=0.9, rings=True)
reconstruct.reconstruct_dataset(fx.open(sys.argv[1]), sys.argv[2] + "/v.mha", asked, memory=20000)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_kept_images_do_not_outlive_a_killed_process(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    scan = written(tmp_path / "scan")
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(scan), str(folder), "17"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == -9, done.stderr
    assert {p.name for p in folder.iterdir()} <= {".v.mha.part.mha"}


def test_room_for_kept_images_is_checked_before_the_work(
    tmp_path: Path, reads: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    data = fx.open(written(tmp_path / "scan"))
    images = 4 * VIEWS * ROWS * COLS
    monkeypatch.setattr(reconstruct, "free_bytes", lambda folder: GRID.bytes + images - 1)
    request = VolumeRequest(shape=GRID.shape, voxel_mm=GRID.voxel_mm)
    reads.clear()
    with pytest.raises(LimitError) as told:
        reconstruct_dataset(data, tmp_path / "v.mha", request, memory=memory_for(3))
    text = str(told.value)
    for part in (f"{VIEWS} images", f"free in {tmp_path}", f"{images / 2**30:.3g} GiB"):
        assert part in text
    assert told.value.data == {
        "asked": GRID.bytes + images,
        "allowed": GRID.bytes + images - 1,
    }
    assert sum(reads.values()) <= 32  # looked at for their exposure
    assert not (tmp_path / "v.mha").exists()
    monkeypatch.setattr(reconstruct, "free_bytes", lambda folder: GRID.bytes + images)
    reconstruct_dataset(data, tmp_path / "v.mha", request, memory=memory_for(3))


def test_a_disk_that_fills_up_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = kept_images.ImagesOnDisk(tmp_path, 12)

    class Full:
        def seek(self, place: int) -> None: ...

        def write(self, values: memoryview) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(store, "_file", Full())
    with pytest.raises(OSError, match="No space left") as told:
        store.put(0, np.zeros((3, 4), np.float32))
    assert str(tmp_path) in str(told.value)


def test_images_on_disk_come_back_by_rows(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    images = {int(n): rng.normal(size=(7, int(w))).astype(np.float32)
              for n, w in zip(rng.permutation(9), rng.integers(1, 12, 9), strict=True)}  # fmt: skip
    store = kept_images.ImagesOnDisk(tmp_path, 7 * 12)
    for number, image in images.items():
        store.put(number, image)
    for number, image in images.items():
        first, last = sorted(rng.integers(0, 8, 2).tolist())
        np.testing.assert_array_equal(
            store.get(number, slice(first, last)), image[first:last]
        )
    store.close()


def test_a_plan_fits_the_memory_and_says_what_is_too_little(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(memory_plan, "WORKING_IMAGES", 100)
    rng = np.random.default_rng(12)
    for _ in range(300):
        nz, ny, nx = (int(n) for n in rng.integers(1, 400, 3))
        images, pixels = int(rng.integers(20, 2000)), int(rng.integers(100, 300_000))
        grid, again = Grid((nz, ny, nx), 0.1), int(rng.integers(0, images))
        work, layer = 4 * pixels * 100, 4 * ny * nx
        memory = int((work + layer) * rng.uniform(0.5, 6.0))
        if memory < work + layer:
            with pytest.raises(LimitError, match="takes") as told:
                plan_memory(grid, images, again, pixels, memory)
            assert told.value.data["allowed"] == work + layer
            assert (
                len(plan_memory(grid, images, again, pixels, memory, least=True).slabs)
                == nz
            )
            continue
        plan = plan_memory(grid, images, again, pixels, memory)
        tallest = max(last - first for first, last in plan.slabs)
        kept = 0 if plan.on_disk else 4 * plan.kept * pixels
        assert tallest == 1 or tallest * layer + kept + work <= memory
        assert plan.kept == (images if len(plan.slabs) > 1 else again)
        assert plan.slabs[0][0] == 0
        assert plan.slabs[-1][1] == nz


def test_free_memory_is_what_the_system_and_the_container_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = {name: tmp_path / name for name in ("info", "limit", "used", "statistics")}
    monkeypatch.setattr(directory, "MEMORY_INFORMATION", told["info"])
    monkeypatch.setattr(directory, "CGROUP_LIMIT", told["limit"])
    monkeypatch.setattr(directory, "CGROUP_USED", told["used"])
    monkeypatch.setattr(directory, "CGROUP_STATISTICS", told["statistics"])
    assert directory.free_memory_bytes() == directory.memory_bytes() // 2
    told["info"].write_text("MemTotal: 900 kB\nMemAvailable:   700 kB\n")
    assert directory.free_memory_bytes() == 700 * 1024
    told["limit"].write_text("500000\n")
    told["used"].write_text("450000\n")
    told["statistics"].write_text("anon 100\ninactive_file 20000\n")
    assert directory.free_memory_bytes() == 70_000
    told["limit"].write_text("max\n")
    assert directory.free_memory_bytes() == 700 * 1024
