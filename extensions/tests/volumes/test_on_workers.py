"""`flexdt reconstruct --scheduler`: equal bytes, taken up after any end, a volume nobody
holds."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.library.reading.folders import load_dataset
from flexdt.library.reconstruction.reconstruct import VolumeRequest as Request
from flexdt.library.reconstruction.reconstruct import reconstruct_dataset
from flexdt.twin.errors import LimitError, TwinError
from flexdt_extensions.fdk_on_workers import as_made, levels, slabs

STUDIES = Path(__file__).parents[3] / "tests" / "studies"

SOD, SDD, VIEWS, ROWS, COLS, PIXEL = 600.0, 1059.0, 24, 96, 120, 1.19
SHAPE, VOXEL = (150, 70, 61), 0.5
REQUEST = Request(shape=SHAPE, voxel_mm=VOXEL)


class Here(Executor):
    """Runs what it is given in this thread; counts it, and fails from the `fails`-th on."""

    def __init__(self, fails: int = 1000) -> None:
        self.count, self.fails = 0, fails

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.count += 1
        if self.count >= self.fails:
            future.set_exception(TwinError("the worker is gone"))
            return future
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Counts of a random blob, seen by a panel that is wider."""
    rng = np.random.default_rng(20)
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, 24)] * 3, indexing="ij")
    values = 0.02 * (x * x + y * y + z * z < 0.8) * (1 + rng.random((24, 24, 24)))
    geometry = fx.ConeVec.circular(
        sod=SOD, sdd=SDD, angles=VIEWS, shape=(ROWS, COLS), pixel=PIXEL
    )
    folder = tmp_path_factory.mktemp("scans") / "blob"
    fx.simulate(fx.Volume(values.astype(np.float32), 2.0), geometry, noise=5).save(folder)
    return folder


def files(path: Path) -> dict[str, bytes]:
    """Bytes of a file, or of all in a folder."""
    if path.is_file():
        return {"": path.read_bytes()}
    return {
        str(f.relative_to(path)): f.read_bytes() for f in path.rglob("*") if f.is_file()
    }


def test_who_is_interrupted_between_two_results_leaves_no_task_behind() -> None:
    made, waits = Future[int](), Future[int]()
    made.set_result(7)

    def interrupted() -> None:
        with closing(as_made([made, waits])) as results:
            for result in results:
                raise KeyboardInterrupt(result)

    with pytest.raises(KeyboardInterrupt, match="7") as kept:
        interrupted()
    assert kept.tb is not None  # with the frames, which would keep the tasks alive
    assert waits.cancelled()


def test_workers_make_what_the_local_command_makes(scan: Path, tmp_path: Path) -> None:
    """The same values in all formats, and the local command's but for the last digit of a
    few."""
    data = load_dataset(scan)
    reconstruct_dataset(data, tmp_path / "here.zarr", REQUEST)
    here = fx.Volume.load(tmp_path / "here.zarr")
    made = []
    for name in ("v.zarr", "v.tif", "v.mha"):
        told: list[tuple[float, float]] = []
        reconstruct_dataset(
            data, tmp_path / name, REQUEST, workers=nullcontext(Here()),
            progress=lambda done, total, told=told: told.append((done, total)),  # type: ignore[misc]
        )  # fmt: skip
        assert told == [(k, 3) for k in range(4)]
        made.append(fx.Volume.load(tmp_path / name))
        np.testing.assert_array_equal(made[-1].data, made[0].data)
        assert made[-1].center_mm == pytest.approx(here.center_mm)
    most = float(np.nanmax(here.data))  # layers that no view sees are NaN
    np.testing.assert_allclose(made[0].data, here.data, rtol=0, atol=1e-6 * most)
    both = ~np.isnan(here.data)
    assert (made[0].data != here.data)[both].mean() < 1e-3
    assert not list(tmp_path.glob(".*"))
    assert files(tmp_path / "v.zarr").keys() == files(tmp_path / "here.zarr").keys()
    assert {f for f in files(tmp_path / "v.zarr") if f.startswith("0/c")} == {
        f"0/c/{k}/0/0" for k in range(3)
    }


def test_a_voxel_by_the_formula(scan: Path, tmp_path: Path) -> None:
    """Feldkamp's sum for voxels drawn at random, with the ramp filter as a sum over a row."""
    data = load_dataset(scan)
    reconstruct_dataset(data, tmp_path / "v.zarr", REQUEST, workers=nullcontext(Here()))
    made = zarr.open_group(tmp_path / "v.zarr", mode="r")["0"]
    assert made.shape == SHAPE
    images = data.line_integrals()
    pitch = PIXEL * SOD / SDD  # on the axis
    c = np.arange(COLS) - (COLS - 1) / 2
    r = np.arange(ROWS) - (ROWS - 1) / 2
    cosine = SOD / np.sqrt(SOD**2 + (c * pitch) ** 2 + (r[:, None] * pitch) ** 2)
    n = np.arange(-COLS + 1, COLS)
    ramp = np.zeros(len(n))
    ramp[n % 2 == 1] = -1.0 / (np.pi * n[n % 2 == 1] * pitch) ** 2
    ramp[n == 0] = 0.25 / pitch**2
    rng = np.random.default_rng(3)
    for _ in range(5):
        iz, iy, ix = (
            75 + rng.integers(-30, 30),
            35 + rng.integers(-15, 15),
            rng.integers(15, 45),
        )
        x, y, z = (
            (i - (n - 1) / 2) * VOXEL
            for i, n in zip((ix, iy, iz), SHAPE[::-1], strict=True)
        )
        total = 0.0
        for image, row in zip(images, data.geometry.rows, strict=True):
            inward = -row[:2] / np.hypot(*row[:2])
            u = row[6:8] / np.hypot(*row[6:8])
            depth = 1.0 + (x * inward[0] + y * inward[1]) / SOD
            at_c = (x * u[0] + y * u[1]) / depth / pitch + (COLS - 1) / 2
            at_r = -z / depth / pitch + (ROWS - 1) / 2
            c0, r0 = int(np.floor(at_c)), int(np.floor(at_r))
            q = [
                [
                    (image[k] * cosine[k] * ramp[COLS - 1 + j - np.arange(COLS)]).sum()
                    * pitch
                    for j in (c0, c0 + 1)
                ]
                for k in (r0, r0 + 1)
            ]
            fc, fr = at_c - c0, at_r - r0
            total += (
                np.array([1 - fr, fr]) @ np.array(q) @ np.array([1 - fc, fc]) / depth**2
            )
        expected = 0.5 * (2 * np.pi / VIEWS) * total
        assert made[iz, iy, ix] == pytest.approx(expected, abs=2e-4 * 0.03)


def test_a_broken_one_is_taken_up(scan: Path, tmp_path: Path) -> None:
    data = load_dataset(scan)
    reconstruct_dataset(
        data, tmp_path / "whole.zarr", REQUEST, workers=nullcontext(Here())
    )
    out = tmp_path / "v.zarr"
    with pytest.raises(TwinError, match="worker is gone"):
        reconstruct_dataset(data, out, REQUEST, workers=nullcontext(Here(fails=2)))
    assert not out.exists()
    other = Here()
    wanted = Request(shape=SHAPE, voxel_mm=0.4)
    reconstruct_dataset(data, tmp_path / "v.zarr", wanted, workers=nullcontext(other))
    assert other.count == 3, "another request takes nothing of it"
    again = Here()
    reconstruct_dataset(data, out, REQUEST, workers=nullcontext(again))
    assert again.count == 2
    assert files(out) == files(tmp_path / "whole.zarr")
    assert not list(tmp_path.glob(".*"))


def test_coarser_resolutions_are_means(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    values = rng.random((131, 260, 67), dtype=np.float32)
    volume = fx.Volume(values, 0.5, (1.0, 2.0, 3.0))
    volume.save(tmp_path / "v.zarr")
    group = zarr.open_group(tmp_path / "v.zarr", mode="r")
    (scales,) = group.attrs["ome"]["multiscales"]
    assert [d["path"] for d in scales["datasets"]] == ["0", "1", "2"]
    np.testing.assert_array_equal(group["0"][:], values)
    for k, described in enumerate(scales["datasets"]):
        size, place = (
            list(t.values())[1] for t in described["coordinateTransformations"]
        )
        made, edge = group[str(k)], 2**k
        assert size == [0.5 * edge] * 3
        mean = values[edge : 2 * edge, :edge, 2 * edge : 3 * edge].astype(float).mean()
        assert made[1, 0, 2] == pytest.approx(mean, rel=1e-6)
        centre = (
            np.array([1.5, 0.5, 2.5]) * edge - 0.5
        )  # of that voxel, in the finest ones
        finest = np.array(
            scales["datasets"][0]["coordinateTransformations"][1]["translation"]
        )
        np.testing.assert_allclose(
            np.array(place) + np.array([1, 0, 2]) * size, finest + centre * 0.5
        )
    assert fx.Volume.load(tmp_path / "v.zarr").center_mm == pytest.approx((1.0, 2.0, 3.0))


def test_slabs_of_large_volumes_stay_small() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        nz, ny, nx = (int(n) for n in np.exp(rng.uniform(0, np.log(6000), 3)))
        grid = fx.Grid((nz, ny, nx), 0.1)
        made = slabs(grid)
        assert [a for a, _ in made] == [0, *(b for _, b in made[:-1])]
        assert made[-1][1] == nz
        each = made[0][1]
        assert 4 * each * ny * nx <= max(128 << 20, 4 * nz * ny * nx // 256) or each == 1
        for level, shape in enumerate(levels(grid)):
            assert shape == tuple(-(-n // 2**level) for n in (nz, ny, nx))


def test_what_workers_do_not_do(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    data = load_dataset(scan)
    with pytest.raises(LimitError, match=r"by fdk; not .* by sirt"):
        reconstruct_dataset(
            data, tmp_path / "v.zarr", Request("sirt"), workers=nullcontext(Here())
        )
    monkeypatch.setattr(
        "flexdt_extensions.fdk_on_workers.version", lambda name: next(old)
    )
    old = iter(["0.3", "0.2", "0.2", "0.2"])
    with pytest.raises(TwinError, match=r"a worker has flexdt 0\.2, this is 0\.3"):
        reconstruct_dataset(
            data, tmp_path / "v.zarr", REQUEST, workers=nullcontext(Here())
        )
    pytest.importorskip("distributed", reason="the extra `batch`")
    monkeypatch.setattr("flexdt_extensions.executors.SCHEDULER_S", 0.5)
    words = [
        "reconstruct",
        str(scan),
        "--out",
        str(tmp_path / "v.zarr"),
        "--json",
        "--scheduler",
    ]
    for more, code, said in (
        (["tcp://127.0.0.1:1"], 4, "no dask scheduler at tcp://127.0.0.1:1"),
        (["nonsense"], 1, "'nonsense' is no address"),
        (["abc://x:1"], 1, "'abc://x:1' is no address"),
        (
            ["127.0.0.1:1", "--algorithm", "sirt"],
            2,
            "--scheduler: sirt has none",
        ),
        (["127.0.0.1:1", "--preview"], 2, "--preview chooses for itself"),
    ):
        assert run([*words, *more]) == code, more
        told = capsys.readouterr()
        assert told.out == ""
        assert sum(said in line for line in told.err.splitlines()) == 1
        assert "Traceback" not in told.err


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_dask_workers_write_the_same_bytes_however_many(
    scan: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra `batch`")
    monkeypatch.chdir(scan.parent)  # the workers' folder is another one
    words = ["reconstruct", scan.name, "--shape", "200,70,61", "--voxel", "0.5", "--out"]
    wanted = Request(shape=(200, 70, 61), voxel_mm=0.5)
    here = tmp_path / "here.zarr"
    reconstruct_dataset(load_dataset(scan), here, wanted, workers=nullcontext(Here()))
    for count in (3,):
        with distributed.LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, dashboard_address=":0",
            local_directory=str(tmp_path),
        ) as cluster:  # fmt: skip
            out = tmp_path / f"by-{count}.zarr"
            asked = [*words, str(out), "--json", "--scheduler", cluster.scheduler_address]
            assert run(asked) == 0
            told = capsys.readouterr()
            assert json.loads(told.out)["shape"] == [200, 70, 61]
        assert files(out) == files(here)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.campaign
def test_kill_9_at_random_moments() -> None:
    pytest.importorskip("distributed", reason="the extra `batch`")
    words = ["kills", "--kills", "2", "--seed", "3", "--views", "24", "--panel", "60,80",
             "--side", "130"]  # fmt: skip
    done = subprocess.run(
        [sys.executable, str(STUDIES / "slabs.py"), *words],
        capture_output=True, text=True, timeout=580, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    assert "0 things wrong" in done.stdout
