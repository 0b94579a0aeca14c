"""From a written scan to a volume file: geometry in force, texts alone, formats, preview."""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
import json
import math
import re
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from flexdt.clients.cli import main
from flexdt.library.data_set import DataSet
from flexdt.library.reading.folders import load_dataset
from flexdt.library.reconstruction import volume_formats
from flexdt.library.reconstruction.reconstruct import VolumeRequest as Request
from flexdt.library.reconstruction.reconstruct import (
    preview,
    reconstruct_dataset,
)
from flexdt.library.reconstruction.volume_files import MiddleSlices, read_volume
from flexdt.phantoms import lego_phantom
from flexdt.runtime.files.directory import open_data
from flexdt.server.imaging.projections import Imaging, TrueGeometry
from flexdt.server.imaging.radiography import Radiography
from flexdt.server.scans.acquisition import Acquisition
from flexdt.server.storage.dataset_writer import DatasetWriter
from flexdt.server.storage.stored_samples import SampleStore
from flexdt.testing.in_process import DirectProjector
from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.dataset.flexdt_json import NoiseRecord, SampleRecord, ScanRecord
from flexdt.twin.errors import GeometryError, LimitError, TwinError, UnknownNameError
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.physics.tube import Filter, TubeModel
from flexdt.twin.projection import Volume
from flexdt.twin.scanner.state import NamedCorrection, Sample
from flexdt.twin.script import parse_script, plan_script
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.scan_request import ScanRequest

M = builtin_machine()
P = builtin_profile(M.default_profile)
TRUTH = Offsets.from_edge({"dO_x": 0.9, "det_roll": 0.8, "dD_x": -0.7, "alpha": 6.0})
BEADS = lego_phantom().beads
VOXEL = 0.4
SHAPE = (132, 68, 68)


def scan(root: Path, name: str, truth: Offsets, *, corrected: bool, physics: str) -> Path:
    """A turn of 41 coarse images (the last repeats the first) of the LEGO phantom."""
    script = compose_script(
        ScanRequest("fly", frames=41, mode="HW4SW1High"), M, P
    ).encode()
    plan = plan_script(parse_script(script), M, P)
    assert not plan.errors
    imaging = Imaging(
        DirectProjector(),
        TrueGeometry(truth),
        SampleStore(open_data(root / "s")),
        M.detector.pixels,
    )
    correction = NamedCorrection("found", "2026-01-02", truth) if corrected else None
    record = ScanRecord.from_plan(
        plan, name=name, started=datetime(2026, 1, 2), sample=SampleRecord(name="lego"),
        noise=NoiseRecord(3, {}), correction=correction,
    )  # fmt: skip
    writer = DatasetWriter(open_data(root), record, script=script, sync=False)
    way = Radiography.of(imaging, M, physics)  # type: ignore[arg-type]
    acquisition = Acquisition(plan, way, Sample("lego"), 3, writer.put)
    for exposure in plan.exposures:
        asyncio.run(acquisition.produce([exposure]))
    writer.finish()
    return root / name


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("scans")
    return {
        "plain": scan(root, "plain", NOMINAL, corrected=False, physics="poly"),
        "corrected": scan(root, "corrected", TRUTH, corrected=True, physics="ideal"),
    }


def bead_errors(volume: Volume) -> np.ndarray:
    """Distance [voxels] from each bead to the centroid of what is bright around it."""
    size = float(volume.voxel_xyz[0])
    low = np.array(volume.center_mm) - (np.array(volume.shape[::-1]) - 1) / 2 * size
    errors = []
    for bead in BEADS:
        at = np.rint((bead - low) / size).astype(int)
        x, y, z = (slice(a - 4, a + 5) for a in at)
        part = np.asarray(volume.data[z, y, x], dtype=float)
        weight = np.clip(part - 0.4 * part.max(), 0, None)
        grid = np.meshgrid(*(np.arange(-4, 5) for _ in range(3)), indexing="ij")
        mean = np.array([(g * weight).sum() / weight.sum() for g in grid])[::-1]
        errors.append(np.linalg.norm(at + mean - (bead - low) / size))
    return np.array(errors)


@pytest.mark.slow
def test_beads_are_where_the_phantom_has_them(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    told: list[float] = []
    made = reconstruct_dataset(
        load_dataset(folders["plain"]),
        tmp_path / "v.tif",
        Request(voxel_mm=VOXEL, shape=SHAPE),
        progress=lambda done, total: told.append(done / total),
    )
    assert made["shape"] == list(SHAPE)
    assert made["frames"] == 41
    assert told[-1] == 1.0
    assert np.all(np.diff(told) > 0)
    assert bead_errors(read_volume(tmp_path / "v.tif")).max() < 0.15


@pytest.mark.slow
def test_the_correction_in_force_is_used(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    data = load_dataset(folders["corrected"])
    request = Request(voxel_mm=VOXEL, shape=SHAPE)
    made = reconstruct_dataset(data, tmp_path / "c.tif", request)
    assert isinstance(made["correction"], dict)
    assert made["correction"]["dO_x"] == pytest.approx(0.9)
    good = bead_errors(read_volume(tmp_path / "c.tif"))
    reconstruct_dataset(data, tmp_path / "n.tif", request, parameters=NOMINAL)
    bad = bead_errors(read_volume(tmp_path / "n.tif"))
    assert good.max() < 0.2
    assert bad.max() > 1.0


@pytest.mark.slow
def test_the_texts_alone_are_as_good(folders: dict[str, Path], tmp_path: Path) -> None:
    request = Request(voxel_mm=VOXEL, shape=SHAPE)
    for name, texts in (("json.mha", False), ("texts.mha", True)):
        data = load_dataset(folders["plain"], ignore_document=texts)
        reconstruct_dataset(data, tmp_path / name, request)
    one, other = (read_volume(tmp_path / n).data for n in ("json.mha", "texts.mha"))
    steepest = [float(np.abs(np.diff(v, axis=1)).max()) for v in (one, other)]
    assert steepest[1] == pytest.approx(steepest[0], rel=0.01)
    assert np.abs(one - other).max() < 0.02 * float(one.max())


@pytest.mark.parametrize("name", ["v.tif", "v.nrrd", "v.h5"])
def test_formats_hold_the_same_values(
    folders: dict[str, Path], tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = Request(
        voxel_mm=0.8, shape=(20, 24, 28), center_mm=(1.0, -2.0, 3.0), every=5, png=True
    )
    data = load_dataset(folders["plain"])
    made = reconstruct_dataset(data, tmp_path / "whole.mha", request)
    monkeypatch.setattr("flexdt.library.reconstruction.memory_plan.WORKING_IMAGES", 0)
    # Slabs of 7 layers, in blocks of 3.
    monkeypatch.setattr(volume_formats, "BLOCK_BYTES", 3 * 24 * 28 * 4)
    reconstruct_dataset(data, tmp_path / name, request, memory=7 * 24 * 28 * 4)
    values = read_volume(tmp_path / name).data
    assert values.shape == (20, 24, 28)
    np.testing.assert_allclose(
        values, read_volume(tmp_path / "whole.mha").data, atol=1e-5
    )
    assert (
        len(list(tmp_path.glob("*.png"))) == 6
    )  # those of one file do not replace the other's
    assert sorted(Path(str(f)).name for f in _list(made["slices"])) == [
        "whole_xy.png", "whole_xz.png", "whole_yz.png"]  # fmt: skip
    assert not list(tmp_path.glob(".*"))
    volume = read_volume(tmp_path / name)
    assert volume.voxel_xyz == (0.8, 0.8, 0.8)
    assert volume.center_mm == pytest.approx((1.0, -2.0, 3.0))


def _list(value: object) -> list[object]:
    assert isinstance(value, list)
    return value


@pytest.mark.slow
def test_iterative_corrections_and_what_is_refused(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    data = load_dataset(folders["plain"])
    request = Request(
        "cgls", voxel_mm=1.2, shape=(48, 24, 24), binning=2, every=3, iterations=6
    )
    reconstruct_dataset(data, tmp_path / "cgls.mha", request)
    few = dataclasses.replace(request, algorithm="tv", iterations=4, weight=0.02)
    smooth = reconstruct_dataset(data, tmp_path / "tv.mha", few)
    assert smooth["algorithm"] == "tv"
    assert (read_volume(tmp_path / "tv.mha").data >= 0).all()
    heavy = dataclasses.replace(few, weight=2.0)
    reconstruct_dataset(data, tmp_path / "heavy.mha", heavy)
    spread = [
        float(np.std(read_volume(tmp_path / f"{n}.mha").data)) for n in ("tv", "heavy")
    ]
    assert spread[1] < 0.5 * spread[0]
    values = read_volume(tmp_path / "cgls.mha").data
    # the iterative one sees the same object as FDK, rings and beam hardening corrected
    other = Request(
        voxel_mm=1.2, shape=(48, 24, 24), binning=2, rings=True, material="abs"
    )
    reconstruct_dataset(data, tmp_path / "fdk.mha", other)
    assert (
        np.corrcoef(values.ravel(), read_volume(tmp_path / "fdk.mha").data.ravel())[0, 1]
        > 0.6
    )
    with pytest.raises(UnknownNameError, match="cgls"):
        reconstruct_dataset(data, tmp_path / "x.mha", Request("art"))
    with pytest.raises(LimitError, match="ending"):
        reconstruct_dataset(data, tmp_path / "x.jpg", request)
    with pytest.raises(LimitError, match="GiB"):
        reconstruct_dataset(
            data, tmp_path / "x.mha", Request("sirt", shape=(9000, 9000, 900))
        )
    with pytest.raises(LimitError, match="folder"):
        reconstruct_dataset(data, tmp_path / "nowhere" / "x.mha")
    for voxel in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(GeometryError, match="voxels of"):
            reconstruct_dataset(data, tmp_path / "x.mha", Request(voxel_mm=voxel))
    for huge in (Request(voxel_mm=1e-9), Request(voxel_mm=2.0, shape=(99999, 99999, 99999)),
                 Request(voxel_mm=1e-4, shape=(1, 10**6, 10**6))):  # fmt: skip
        with pytest.raises(LimitError, match="GiB"):
            reconstruct_dataset(data, tmp_path / "x.mha", huge)
    own = folders["plain"] / "scan_000000.tif"
    before = own.read_bytes()
    with pytest.raises(LimitError, match="image of the data set"):
        reconstruct_dataset(data, own)
    assert own.read_bytes() == before
    assert not (tmp_path / "x.mha").exists()


def made_by(dataset: DataSet, **figures: float) -> DataSet:
    """The same images, said to be made so."""
    assert dataset.document is not None
    noise = dataclasses.replace(dataset.document.noise, model=figures)
    document = dataset.document.model_copy(update={"noise": noise})
    return dataclasses.replace(dataset, document=document)


def test_hardening_is_corrected_where_there_is_some(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    data = load_dataset(folders["plain"])
    request = Request(
        voxel_mm=1.2, shape=(48, 24, 24), binning=4, every=3, material="abs"
    )
    for straight in ({"physics_mono": 1.0}, {"i0_counts": 12_000.0}):
        with pytest.raises(TwinError, match="straight"):
            reconstruct_dataset(made_by(data, **straight), tmp_path / "x.mha", request)
    assert not (tmp_path / "x.mha").exists()
    copper = TubeModel(
        (*TubeModel().filters, Filter(Substance.parse("Cu@8.96"), 0.5))
    ).figures()
    values = []
    for figures in ({}, TubeModel().figures(), copper):
        reconstruct_dataset(
            made_by(data, physics_poly=1.0, **figures), tmp_path / "y.mha", request
        )
        values.append(np.array(read_volume(tmp_path / "y.mha").data))
    np.testing.assert_array_equal(values[0], values[1])
    # A harder beam is weakened less, so the same line integrals stand for more plastic.
    assert values[2].max() > 1.02 * values[0].max()


COARSE = [
    "--voxel",
    "1.2",
    "--shape",
    "8,24,24",
    "--binning",
    "8",
    "--every",
    "6",
    "--texts",
]


@pytest.mark.slow
def test_scatter_is_subtracted_from_what_a_scanner_wrote(
    folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Less signal is more attenuation, everywhere in the plastic; texts alone are a
    scanner's."""
    monkeypatch.setattr("flexdt.twin.physics.scatter.MAX_HISTORIES", 16)
    words = ["reconstruct", str(folders["plain"]), *COARSE, "--out"]
    ways = {"raw": [], "less": ["--scatter-correction", "abs,steel"]}
    for name, more in ways.items():
        assert run([*words, str(tmp_path / f"{name}.mha"), *more]) == 0
    raw, less = (read_volume(tmp_path / f"{name}.mha").data for name in ways)
    inside = raw > 0.5 * np.percentile(raw, 90)
    assert np.mean((less - raw)[inside] > 0) > 0.9
    assert 1.001 < float(less[inside].mean() / raw[inside].mean()) < 1.1


def test_a_scatter_correction_that_cannot_be(
    folders: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Images that the twin made hold no scatter."""
    made = load_dataset(folders["plain"])
    request = Request(scatter_correction=("abs",))
    with pytest.raises(TwinError, match="without scatter"):
        reconstruct_dataset(made_by(made, physics_poly=1.0), tmp_path / "x.mha", request)
    words = [
        "reconstruct",
        str(folders["plain"]),
        *COARSE,
        "--out",
        str(tmp_path / "x.mha"),
    ]
    for names, code, why in (
        ("cheese", 1, "unknown material 'cheese'"),
        (" , ", 3, "no material"),
        ("abs,C15H17N@1.04", 3, "attenuate alike"),
    ):
        assert run([*words, "--scatter-correction", names]) == code
        assert why in capsys.readouterr().err
    assert not (tmp_path / "x.mha").exists()


def test_preview_shows_the_beads(folders: dict[str, Path], tmp_path: Path) -> None:
    made = preview(load_dataset(folders["plain"]), tmp_path / "p.tif")
    assert max(_ints(made["shape"])) <= 170
    assert len(_list(made["slices"])) == 3
    volume = read_volume(tmp_path / "p.tif")
    assert bead_errors(volume).max() < 1.0


def _ints(value: object) -> list[int]:
    return [int(str(v)) for v in _list(value)]


def test_slices_have_up_at_the_top() -> None:
    volume = np.zeros((3, 5, 7), np.float32)
    volume[2, 2, 3] = 1.0
    taken = MiddleSlices(volume.shape)
    taken.take(volume)
    slices = taken.images
    assert slices["xz"][0, 3] == 1.0
    assert slices["yz"][0, 2] == 1.0
    assert slices["xy"].shape == (5, 7)


def test_slices_of_slabs_are_those_of_the_volume() -> None:
    rng = np.random.default_rng(31)
    for _ in range(40):
        nz, ny, nx = (int(n) for n in rng.integers(1, 12, 3))
        volume = rng.normal(size=(nz, ny, nx)).astype(np.float32)
        taken = MiddleSlices(volume.shape)
        limits = sorted({0, nz, *rng.integers(0, nz + 1, 3).tolist()})
        for first, last in itertools.pairwise(limits):
            taken.take(volume[first:last])
        np.testing.assert_array_equal(taken.images["xy"], np.flip(volume[nz // 2], 0))
        np.testing.assert_array_equal(taken.images["xz"], np.flip(volume[:, ny // 2], 0))
        np.testing.assert_array_equal(
            taken.images["yz"], np.flip(volume[:, :, nx // 2], 0)
        )


def run(words: list[str]) -> int:
    with pytest.raises(SystemExit) as left:
        main(words)
    return int(str(left.value.code or 0))


@pytest.mark.slow
def test_the_command(
    folders: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "c.nrrd"
    words = ["reconstruct", str(folders["plain"]), "--out", str(out), "--voxel", "1.0", "--shape",
             "40,20,24", "--center", "0,0,-4.5", "--texts", "--png", "--json"]  # fmt: skip
    assert run(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["shape"] == [40, 20, 24]
    assert document["center_mm"] == [0.0, 0.0, -4.5]
    assert len(document["slices"]) == 3
    assert read_volume(out).shape == (40, 20, 24)
    for name in ("c.gif", "c.npy", "c.gz", "c"):
        assert (
            run(["reconstruct", str(folders["plain"]), "--out", str(tmp_path / name)])
            == 2
        )
        assert "ending" in capsys.readouterr().err
    assert (
        run(
            [
                "reconstruct",
                str(folders["plain"]),
                "--out",
                str(tmp_path / "no" / "c.tif"),
            ]
        )
        == 1
    )
    assert "folder" in capsys.readouterr().err
    base = ["reconstruct", str(folders["plain"]), "--out", str(tmp_path / "d.mha")]
    of_motors = tmp_path / "of-motors.json"
    of_motors.write_text('{"correction": {"dO_x": 0.1}}')
    for extra, about in (
        (["--kv", "60"], "--kv"),
        (["--iterations", "5"], "--iterations"),
        (["--algorithm", "sirt", "--weight", "0.01"], "--weight"),
        (["--correction", "none", "--geometry", str(out)], "--correction"),
        (["--correction", str(of_motors), "--geometry", str(out)], "own geometry"),
    ):
        assert run([*base, *extra]) == 2
        assert about in capsys.readouterr().err
    there = tmp_path / "d.mha"
    there.write_bytes(b"earlier work")
    for words in ("--algorithm sirt", "--iterations 3", "--voxel 0.3", "--rings", "--binning 1",
                  "--shape 9,9,9", "--material abs", "--every 2",
                  "--center 0,0,0", "--scatter-correction abs"):  # fmt: skip
        assert run([*base, "--preview", *words.split()]) == 2
        shown = capsys.readouterr().err
        assert words.split()[0] in shown
        assert "--preview" in shown
    assert there.read_bytes() == b"earlier work"
    assert run([*base, "--preview", "--algorithm", "fdk"]) == 0
    voxel = re.search(r"voxels of (\S+) mm", capsys.readouterr().out)
    assert voxel is not None
    assert len(voxel[1]) <= 8
    assert run(["reconstruct", str(tmp_path), "--out", str(out)]) == 1
