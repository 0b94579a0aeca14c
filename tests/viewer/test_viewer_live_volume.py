"""A volume that grows while its scan comes into being, beside a body whose values are known."""

from __future__ import annotations

import asyncio
import io
import json
import re
import shutil
import threading
import time
from collections.abc import AsyncIterator, Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import tifffile
import trimesh

from flexdt.clients.cli import main
from flexdt.clients.viewer.volumes.grown_surface import mesh_of, net, otsu, surface
from flexdt.clients.viewer.volumes.live_volume import (
    TOP,
    Held,
    block,
    compare,
    exact,
    grow,
    reconstruct,
)
from flexdt.clients.viewer.volumes.reconstruction_process import LiveReconstruction, wish
from flexdt.clients.viewer.volumes.volume_truth import figures, main_level, truth_of
from flexdt.library.reading.folders import load_dataset
from flexdt.phantoms import load_phantom
from flexdt.runtime.files.directory import open_data
from flexdt.server.storage.dataset_writer import DatasetWriter
from flexdt.twin.dataset.flexdt_json import (
    NoiseRecord,
    SampleRecord,
    ScanRecord,
    parse_document,
)
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.projection import Volume
from flexdt.twin.script import parse_script, plan_script
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.scan_request import ScanRequest

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
        counts = np.rint(np.broadcast_to(100.0 + 12_000.0 * beam, (rows, cols))).astype(
            np.uint16
        )
        file = (home if frame.kind != "projection" else tmp_path) / frame.file
        tifffile.imwrite(file, counts)
        if frame.kind == "projection":
            waiting.append(file)
    return home, waiting


def held(tell: Callable[[dict[str, Any]], None], past: bool = False) -> Held:
    """Nothing yet."""
    return Held(tell, {"name": "ball", "side": SIDE, "past": past})


def middle(volume: npt.NDArray[np.float32]) -> float:
    """The value in the middle of a volume [1/mm]."""
    around = tuple(slice(n // 2 - 1, n // 2 + 2) for n in volume.shape)
    return float(volume[around].mean())


@pytest.mark.slow
def test_it_grows_with_every_image_to_the_true_values(
    scan: tuple[Path, list[Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    home, waiting = scan
    monkeypatch.setattr("flexdt.clients.viewer.volumes.live_volume.TELL_S", 0.0)
    told: list[tuple[int, float]] = []
    grown = held(lambda m: told.append((m["views"], middle(grown.volumes["volume"]))))
    work = threading.Thread(target=grow, args=(grown, home, SIDE))
    work.start()
    deadline = time.monotonic() + 120.0
    for come in (1, 16, 31, 46, VIEWS):
        for file in waiting[:come]:
            if file.exists():
                file.rename(home / file.name)
        while not told or told[-1][0] < come:
            assert work.is_alive()
            assert time.monotonic() < deadline
            time.sleep(0.01)
        # Each view has its part of the whole; in the middle of a ball all give the same. The
        # first and the last are of one direction, and share its part.
        share = 0.0 if come == 1 else (come - 0.5) / (VIEWS - 1) if come < VIEWS else 1.0
        value = next(value for views, value in told if views == come)
        assert value == pytest.approx(MU * share, rel=0.05, abs=0.01 * MU)
    work.join(60.0)
    assert not work.is_alive()
    assert [views for views, _ in told] == [*range(1, VIEWS + 1), VIEWS]
    assert grown.about["done"] == 1.0
    x, y, z = grown.about["size"]
    assert x == y
    assert abs(x - SIDE) <= 1
    assert grown.volumes["volume"].shape == (z, y, x)


@pytest.mark.daily(1)
@pytest.mark.parametrize("seed", range(3))
def test_the_volume_is_no_mirror_image(tmp_path: Path, seed: int) -> None:
    """A ball off all three planes lies where it is, and so do the points of its surface."""
    rng = np.random.default_rng(seed)
    x, y, z = (float(v) for v in rng.choice([-1.0, 1.0], 3) * rng.uniform(2.5, 4.0, 3))
    home, files = scan_of(tmp_path, (x, y, z), 5.5)
    for file in files:
        file.rename(home / file.name)
    told: list[dict[str, Any]] = []
    grown = held(told.append)
    grow(grown, home, SIDE)
    volume, voxel_mm = grown.volumes["volume"], grown.about["voxel_mm"]
    dense = np.argwhere(volume > 0.6 * MU).mean(axis=0) - (np.array(volume.shape) - 1) / 2
    assert grown.grid is not None
    found = dense[::-1] * voxel_mm + grown.grid.center_mm
    np.testing.assert_allclose(found, (x, y, z), atol=0.7 * voxel_mm)
    # The surface, on the stage: all about the ball, and everywhere on it.
    surfaces = [document["surface"] for document in told if "surface" in document]
    points, _ = mesh_of(surfaces[-1])
    from_ball = points - [x, y, z]
    apart = np.linalg.norm(from_ball, axis=1)
    assert np.abs(apart - 5.5).max() < 1.5 * voxel_mm
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert (directions @ (from_ball / apart[:, None]).T).max(axis=1).min() > 0.9


def test_the_surface_of_a_box_is_closed_and_has_its_volume() -> None:
    """In a large volume of voxels that are no cubes, with streaks and noise beside the box."""
    rng = np.random.default_rng(1)
    grown = rng.normal(0.0, 0.01, (200, 150, 260)).astype(np.float32)
    grown[40:160, 30:90, 50:200] += 1.0  # (y, x, z)
    streaks = np.add.outer(np.arange(200) // 5, np.arange(150) // 5) % 2
    grown += (0.2 * streaks - 0.1).astype(np.float32)[:, :, None]
    vertices, faces = mesh_of(surface(grown, (0.5, 0.4, 0.3), (10.0, -20.0, 5.0)))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    sides = np.array([60 * 0.5, 120 * 0.4, 150 * 0.3])
    assert mesh.volume == pytest.approx(sides.prod(), rel=0.06)
    low = np.array([10 + (30 - 75) * 0.5, -20 + (40 - 100) * 0.4, 5 + (50 - 130) * 0.3])
    cell_mm = 5 * 0.5
    np.testing.assert_allclose(mesh.bounds, [low, low + sides], atol=0.5 * cell_mm)


def test_dense_beads_do_not_hide_the_brick_that_they_stand_on() -> None:
    """A brick of plastic with five beads of steel: its surface is the brick's."""
    rng = np.random.default_rng(2)
    grown = rng.normal(0.0, 0.002, (120, 120, 60)).astype(np.float32)
    grown[30:90, 40:80, 10:50] += 0.02
    for k in range(5):
        grown[35 + 10 * k : 39 + 10 * k, 45:49, 20:24] = 0.5
    vertices, faces = mesh_of(surface(grown, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), 60))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.volume == pytest.approx(60 * 40 * 40, rel=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_the_net_of_drawn_balls_is_closed_and_outward(seed: int) -> None:
    """Two balls that may touch: their volume is that of the formula, where they are apart."""
    rng = np.random.default_rng(seed)
    at = np.stack(np.mgrid[:40, :44, :48], axis=-1).astype(float)
    centers, radii = rng.uniform(13.0, 26.0, (2, 3)), rng.uniform(4.0, 9.0, 2)
    depth = [
        r - np.linalg.norm(at - c, axis=-1) for c, r in zip(centers, radii, strict=True)
    ]
    vertices, faces = net(np.max(depth, axis=0), 0.0)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices()
    assert mesh.volume > 0.0
    away = [
        np.linalg.norm(vertices - c, axis=1) - r
        for c, r in zip(centers, radii, strict=True)
    ]
    gaps = np.abs(away).min(axis=0)
    assert gaps.max() < 1.0, "within a cell, in the crease between balls that touch, too"
    if np.linalg.norm(centers[0] - centers[1]) > radii.sum() + 2.0:
        assert mesh.volume == pytest.approx(
            4.0 / 3.0 * np.pi * (radii**3).sum(), rel=0.04
        )


def test_otsus_threshold_parts_what_no_other_threshold_parts_better() -> None:
    """Against the criterion itself, computed at every threshold."""
    rng = np.random.default_rng(3)
    for _ in range(5):
        share, apart = rng.uniform(0.02, 0.5), rng.uniform(1.5, 6.0)
        values = np.where(rng.random(20_000) < share, apart, 0.0) + rng.normal(
            0, 0.4, 20_000
        )

        def within(level: float, values: Any = values) -> float:
            parts = values[values > level], values[values <= level]
            return float(sum(part.var() * len(part) for part in parts if len(part)))

        least = min(within(v) for v in np.linspace(values.min(), values.max(), 400))
        assert within(otsu(values)) <= least * 1.002


@pytest.mark.slow
def test_nobody_waits_for_a_scan_that_nobody_looks_at(
    scan: tuple[Path, list[Path]],
) -> None:
    with pytest.raises(SystemExit):
        grow(held(lambda document: None), scan[0], SIDE, alive=lambda: False)


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_the_volume_of_a_past_scan_is_that_of_the_command(
    scan: tuple[Path, list[Path]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every voxel within 1e-6 of the greatest that `flexdt reconstruct` writes, and the codes
    that a page gets within half a step; what it may be off by, in the same words."""
    home, files = scan
    for file in files:
        file.rename(home / file.name)
    told: list[dict[str, Any]] = []
    made = held(told.append, past=True)
    reconstruct(made, home, 120)
    done = [d["done"] for d in told]
    assert done == sorted(done)
    stages = [d.get("phase") for d in told]
    begun = dict(zip(stages[::-1], done[::-1], strict=True))  # where each of them begins
    assert list(begun)[::-1] == [
        "looking at the pixels",
        "reading and reconstructing",
        "comparing the images",
        "finding the accuracy",
        "finding the noise",
        None,
    ]
    assert np.diff([*begun.values()]).max() < 0
    assert begun["looking at the pixels"] == 0
    last = told[-1]
    assert (last["done"], last["views"], last["of"]) == (1.0, VIEWS, VIEWS)
    out = tmp_path / "volume.tif"
    words = [
        "reconstruct",
        str(home),
        "--out",
        str(out),
        "--binning",
        str(last["binning"]),
    ]
    with pytest.raises(SystemExit, match="0"):
        main(words)
    accuracy = next(one for one in last["doubts"] if one.startswith("accuracy"))
    assert last["details"].startswith(accuracy.split(",")[0])
    printed = "".join(capsys.readouterr())  # as a warning, or with the file
    assert re.findall(r"accuracy: within .*", printed) == [accuracy]
    whole = tifffile.imread(out)  # (z, y, x)
    assert last["size"] == list(whole.shape[::-1])
    ours = np.array(
        [
            [x, y, z, exact(made.volumes["volume"], (x, y, z))]
            for x, y, z in np.random.default_rng(4)
            .integers(0, last["size"], (500, 3))
            .tolist()
        ]
    )
    x, y, z = ours[:, :3].astype(int).T
    most = np.abs(whole).max()
    np.testing.assert_allclose(ours[:, 3], whole[z, y, x], atol=1e-6 * most, rtol=0)
    head, codes = block(made.volumes["volume"])
    step = (head["high"] - head["low"]) / TOP
    values = (
        head["low"] + (np.frombuffer(codes, "<u2").reshape(head["shape"]) - 1.0) * step
    )
    assert np.abs(values - whole).max() < 0.51 * step + 1e-6 * most


def test_a_folder_of_the_real_scanner_has_its_volume(
    scan: tuple[Path, list[Path]],
) -> None:
    """Without flexdt.json, from the scanner's two texts: the same to what they are rounded
    to."""
    home, files = scan
    for file in files:
        file.rename(home / file.name)
    volumes = []
    for _ in range(2):
        made = held(lambda document: None, past=True)
        reconstruct(made, home, 60)
        volumes.append(made.volumes["volume"])
        (home / "flexdt.json").unlink(missing_ok=True)
    assert made.about["sample"] == ""
    assert middle(volumes[1]) == pytest.approx(MU, rel=0.05)
    assert volumes[1].shape == volumes[0].shape
    assert np.sqrt(np.mean(np.square(volumes[1] - volumes[0]))) < 0.01 * MU


def test_a_block_says_where_no_data_are_and_has_room_for_most_voxels() -> None:
    data = np.random.default_rng(5).normal(1.0, 0.1, (21, 30, 40)).astype(np.float32)
    data[3, 4, 5] = np.nan
    head, codes = block(data)
    assert (head["factor"], head["shape"]) == (1, [21, 30, 40])
    zero = np.argwhere(np.frombuffer(codes, "<u2").reshape(data.shape) == 0)
    np.testing.assert_array_equal(zero, [[3, 4, 5]])
    assert exact(data, (5, 4, 3)) is None
    assert exact(data, (40, 0, 0)) is None
    assert exact(data, (39, 29, 20)) == data[20, 29, 39]
    head, codes = block(data, most=4000)
    assert (head["factor"], head["shape"]) == (2, [10, 15, 20])
    values = head["low"] + (np.frombuffer(codes, "<u2").reshape(head["shape"]) - 1.0) * (
        (head["high"] - head["low"]) / TOP
    )
    assert values[9, 14, 19] == pytest.approx(data[18:20, 28:30, 38:40].mean(), abs=1e-4)


def test_figures_of_a_body_whose_size_is_known() -> None:
    """A hollow box of 0.02 /mm, seen with noise, 5 % less attenuation and a shift of a
    voxel."""
    truth = np.zeros((40, 50, 60), np.float32)
    truth[10:30, 10:40, 10:50] = 0.02
    truth[10:30, 20:30, 20:40] = 0.0
    rng = np.random.default_rng(6)
    seen = 0.95 * np.roll(truth, 1, axis=2) + rng.normal(0.0, 0.002, truth.shape)
    seen[0] = np.nan
    told = figures(seen.astype(np.float32), truth, 0.5)
    assert told["attenuation"] == pytest.approx((0.019, 0.02), rel=0.01)
    assert told["void"] == pytest.approx((1 / 6 + 1 / 40, 1 / 6), abs=0.01)
    for name, true in (("x_mm", 20.0), ("y_mm", 15.0), ("z_mm", 10.0)):
        assert told[name] == pytest.approx((true, true), abs=0.1), name
    moved = np.square(seen - truth)[1:][9 - 3 : 29 + 3, 7:43, 7:53]
    assert told["rms"] == pytest.approx(float(np.sqrt(moved.mean())), rel=0.01)


@pytest.mark.parametrize("turn", [0.0, 90.0])
def test_the_truth_stands_where_the_sample_stood(
    scan: tuple[Path, list[Path]], turn: float
) -> None:
    """A cuboid of PMMA, moved and turned on the stage as the data set's document says."""
    home, _ = scan
    document = json.loads((home / "flexdt.json").read_text())
    offset = {"x": 2.0, "y": -1.0, "z": 3.0, "rx": 0.0, "ry": 0.0, "rz": turn}
    document["sample"] |= {"name": "normal", "offset": offset}
    (home / "flexdt.json").write_text(json.dumps(document))
    like = Volume(np.zeros((200, 191, 192), np.float32), 0.4, (0.0, 0.0, 1.0))
    truth = truth_of(load_dataset(home), like)
    phantom = load_phantom("normal")
    mu = main_level(truth)
    assert mu == pytest.approx(
        max(solid.mu_per_mm for solid in phantom.scene.solids[:1]), rel=1e-4
    )
    assert truth.min() == 0.0
    sizes = phantom.size_mm if turn == 0.0 else np.array(phantom.size_mm)[[1, 0, 2]]
    for axis, (size, place) in enumerate(zip(sizes, (2.0, -1.0, 3.0 - 1.0), strict=True)):
        profile = (truth > mu / 2).any(axis=tuple(k for k in range(3) if k != 2 - axis))
        first, last = np.flatnonzero(profile)[[0, -1]]
        assert (last - first + 1) * 0.4 == pytest.approx(size, abs=0.8)
        middle_mm = ((first + last) / 2 - (len(profile) - 1) / 2) * 0.4
        assert middle_mm == pytest.approx(place, abs=0.41)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (6.0, -4.0, 3.0), (500.0, 0.0, 0.0)])
def test_the_truth_of_a_small_part_is_that_of_the_whole(
    scan: tuple[Path, list[Path]], place: tuple[float, float, float]
) -> None:
    """Of a grid of small voxels, which sees a little of the sample, or nothing: by the solids
    themselves. All of the sample at half such a voxel would have a thousand million."""
    home, _ = scan
    document = json.loads((home / "flexdt.json").read_text())
    offset = {"x": 0.3, "y": -0.2, "z": 0.1, "rx": 0.0, "ry": 0.0, "rz": 30.0}
    document["sample"] |= {"name": "gear", "offset": offset}
    (home / "flexdt.json").write_text(json.dumps(document))
    like = Volume(np.zeros((32, 33, 33), np.float32), 0.072, place)
    truth = truth_of(load_dataset(home), like)
    counts = np.array(like.shape[::-1])
    rng = np.random.default_rng(7)
    whole = load_phantom("gear").volume(0.25)
    for _ in range(300):
        at = rng.integers(counts)
        on_stage = (at - (counts - 1) / 2) * 0.072 + place - np.array([0.3, -0.2, 0.1])
        c, s = np.cos(np.deg2rad(30.0)), np.sin(np.deg2rad(30.0))
        x, y, z = (
            c * on_stage[0] + s * on_stage[1],
            c * on_stage[1] - s * on_stage[0],
            on_stage[2],
        )
        cell = np.round(
            np.array([x, y, z]) / 0.25 + (np.array(whole.shape[::-1]) - 1) / 2
        )
        k = cell.astype(int)[::-1]
        if (k < 1).any() or (k >= np.array(whole.shape) - 1).any():
            assert truth[tuple(at[::-1])] == 0.0 or place[0] < 100
            continue
        near = whole.data[tuple(slice(n - 1, n + 2) for n in k)]
        if near.min() == near.max():  # within one material, away from edges
            assert truth[tuple(at[::-1])] == pytest.approx(near.max(), rel=1e-3, abs=1e-6)


def test_a_scan_of_what_nobody_knows_is_not_compared(
    scan: tuple[Path, list[Path]],
) -> None:
    home, files = scan
    made = held(lambda document: None, past=True)
    with pytest.raises(TwinError, match="only the finished volume"):
        compare(made, None)
    for file in files:
        file.rename(home / file.name)
    reconstruct(made, home, 60)
    with pytest.raises(TwinError, match="'ball' is made of is not known"):
        compare(made, None)


@pytest.mark.slow
def test_answers_come_from_the_process_until_it_is_stopped(
    scan: tuple[Path, list[Path]],
) -> None:
    home, files = scan
    for file in files:
        file.rename(home / file.name)

    async def body() -> None:
        told: list[str] = []
        one, mine = LiveReconstruction(told.append), wish(home, 120, True)
        assert await one.ask(mine, "block", "volume") is None
        one.warm()
        one.grow(home, 120, past=True)
        while '"views"' not in one.newest:
            assert "problem" not in one.newest
            await asyncio.sleep(0.02)
        whole, voxel, none, unknown = await asyncio.gather(
            one.ask(mine, "block", "volume"), one.ask(mine, "voxel", "3", "2", "1"),
            one.ask(mine, "block", "truth"), one.ask(mine, "compare", "null"),
        )  # fmt: skip
        assert whole is not None
        assert len(whole[1]) == 2 * np.prod(whole[0]["shape"])
        assert voxel is not None
        _, ny, nx = whole[0]["shape"]
        code = np.frombuffer(whole[1], "<u2")[(1 * ny + 2) * nx + 3]
        value = whole[0]["low"] + (code - 1) * (whole[0]["high"] - whole[0]["low"]) / TOP
        assert voxel[0]["volume"] == pytest.approx(value, abs=1e-4)
        assert none == unknown == ({}, b"")
        assert await one.ask(wish(home, 60, True), "voxel", "3", "2", "1") is None
        while "not_compared" not in one.newest:
            await asyncio.sleep(0.02)
        one.stop()
        assert await one.ask(mine, "block", "volume") is None
        await one.close()

    asyncio.run(body())


class Ended:
    """A process that has said a line and ended; the loop has not heard of its end yet."""

    returncode: int | None = None
    killed, stdin = False, io.BytesIO()

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
        grow(held(lambda document: None), home, SIDE)
