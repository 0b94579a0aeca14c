"""`flexdt export` and `import` on a data set: files, options, errors, and what takes the result."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexdt.clients.cli.command_tree import run
from flexdt.library.datasets.exchange import (
    ExchangeError,
    Given,
    export_dataset,
    geometry_of,
    load_geometry,
    save_geometry,
    with_geometry,
)
from flexdt.library.datasets.exchange_formats import FORMATS
from flexdt.library.reading.folders import load_dataset
from flexdt.twin.dataset.flexdt_json import FrameBlock, ScanRecord
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.projection import Volume

THERE_AND_BACK = [
    form for form in FORMATS.values() if form.read and (form.write or form.export)
]
ENDINGS = {form.name: form.endings[0].strip(".") for form in THERE_AND_BACK}
TILTED = Offsets.from_edge({"dO_x": 0.4, "det_roll": 1.0, "det_pitch": -2.0, "axis_tilt_x": 0.3,
                               "tau_x": 0.5, "dS_y": -0.2})  # fmt: skip


@pytest.fixture
def folder(record: Callable[..., ScanRecord], written: Callable[..., Path]) -> Path:
    made = record(frames=9)
    assert made.correction is not None
    return written(replace(made, correction=replace(made.correction, parameters=TILTED)))


@pytest.fixture
def flexdt(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def call(*words: object) -> tuple[int, str, str]:
        code = run([str(word) for word in words])
        out = capsys.readouterr()
        assert "Traceback" not in out.err
        return code, out.out, out.err

    return call


Run = Callable[..., tuple[int, str, str]]


@pytest.mark.parametrize(("format", "ending"), [*ENDINGS.items(), ("astra", "txt")])
@pytest.mark.parametrize("nominal", [False, True])
@pytest.mark.daily(5)
def test_there_and_back(
    format: str, ending: str, nominal: bool, folder: Path, tmp_path: Path, flexdt: Run
) -> None:
    file, back = tmp_path / f"g.{ending}", tmp_path / "back.json"
    which = ("--nominal",) if nominal else ()
    code, out, err = flexdt(
        "export", folder, "--format", format, "--out", file, *which, "--json"
    )
    assert code == 0, err
    assert json.loads(out)["views"] == 9
    code, _, err = flexdt(
        "import", file, "--format", format, "--like", folder, "--out", back
    )
    assert code == 0, err
    data = load_dataset(folder)
    expected = data.corrected(NOMINAL if nominal else TILTED)
    found = load_geometry(back)
    assert np.abs(found.cone_vec.rows - expected.rows).max() < 1e-9
    assert found.shape == data.shape
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(
    "format", ["rtk", "astra", "csv", "tomosipo", "cil", "tigre", "leap"]
)
def test_images_upside_down(
    format: str, folder: Path, tmp_path: Path, flexdt: Run
) -> None:
    up, back = tmp_path / f"up.{ENDINGS[format]}", tmp_path / "back.npy"
    words = ("--format", format, "--rows", "up")
    assert flexdt("export", folder, *words, "--out", up)[0] == 0
    assert flexdt("import", up, *words, "--like", folder, "--out", back)[0] == 0
    assert np.abs(np.load(back) - load_dataset(folder).corrected().rows).max() < 1e-9
    wrong = tmp_path / "wrong.npy"
    code, _, _ = flexdt(
        "import", up, "--format", format, "--like", folder, "--out", wrong
    )
    assert code == 0
    assert np.abs(np.load(wrong) - np.load(back)).max() > 0.2


def test_what_is_so_and_what_is_known(folder: Path, tmp_path: Path, flexdt: Run) -> None:
    truth = tmp_path / "truth.toml"
    truth.write_text("dO_x = 0.9\ndet_roll = -1.5\n")
    file = tmp_path / "scan.json"
    code, _, err = flexdt(
        "export", folder, "--format", "ctsimu", "--out", file, "--unknown", truth
    )  # fmt: skip
    assert code == 0, err
    real = Offsets.from_edge({"dO_x": 0.9, "det_roll": -1.5})
    data = load_dataset(folder)
    for option, parameters in (("--known", TILTED), ("--real", real)):
        out = tmp_path / f"{option[2:]}.json"
        code, _, err = flexdt("import", file, "--format", "ctsimu", "--out", out, option)
        assert code == 0
        assert ("unknown to reconstruction" in err) is (option == "--known")
        rows = load_geometry(out).cone_vec.rows
        assert np.abs(rows - data.corrected(parameters).rows).max() < 1e-9


def test_a_calibrations_report_instead(folder: Path, tmp_path: Path, flexdt: Run) -> None:
    report = tmp_path / "report.json"
    report.write_text(json.dumps({"correction": {"dO_z": 3.0}}))
    file = tmp_path / "g.npy"
    words = ("export", folder, "--format", "astra", "--out", file)
    assert flexdt(*words, "--correction", report)[0] == 0
    expected = load_dataset(folder).corrected(Offsets.from_edge({"dO_z": 3.0}))
    assert np.array_equal(np.load(file), expected.rows)
    assert flexdt(*words, "--correction", report, "--nominal")[0] == 2


def test_a_data_set_takes_an_imported_geometry(folder: Path, tmp_path: Path) -> None:
    data = load_dataset(folder)
    file = tmp_path / "g.json"
    save_geometry(geometry_of(data), file)
    other = with_geometry(data, load_geometry(file))
    # Nothing is added to it: the correction in force is in it already.
    assert np.abs(other.corrected().rows - data.corrected().rows).max() < 1e-9
    assert np.abs(other.cone_vec.rows - data.corrected().rows).max() < 1e-9
    with pytest.raises(ExchangeError, match="9 projections, the geometry 4 views"):
        with_geometry(
            data, replace(load_geometry(file), cone_vec=data.cone_vec[:4], files=())
        )
    with pytest.raises(ExchangeError, match="images of"):
        with_geometry(data, replace(load_geometry(file), shape=(5, 5)))


def test_reconstruct_takes_an_imported_geometry(
    folder: Path, tmp_path: Path, flexdt: Run
) -> None:  # fmt: skip
    file, geometry = tmp_path / "g.xml", tmp_path / "g.json"
    assert flexdt("export", folder, "--format", "rtk", "--out", file)[0] == 0
    assert (
        flexdt("import", file, "--format", "rtk", "--like", folder, "--out", geometry)[0]
        == 0
    )
    words = ("--algorithm", "sirt", "--iterations", 2, "--voxel", 0.3, "--shape", "4,8,8")
    volumes = []
    for name, more in (("a.mha", ()), ("b.mha", ("--geometry", geometry))):
        code, _, err = flexdt(
            "reconstruct", folder, "--out", tmp_path / name, *words, *more
        )
        assert code == 0, err
        volumes.append(Volume.load(tmp_path / name).data)
    assert np.abs(volumes[0] - volumes[1]).max() < 1e-5 * np.abs(volumes[0]).max()
    code, _, err = flexdt(
        "reconstruct", folder, "--out", tmp_path / "c.mha", "--geometry", tmp_path / "no.json"
    )  # fmt: skip
    assert code == 1
    assert "no.json" in err


def _two_shapes(made: ScanRecord) -> ScanRecord:
    first, *rest = made.blocks
    projections = next(b for b in rest if b.kind == "projection")
    smaller = replace(projections.camera, roi=replace(projections.camera.roi, right=991))
    half = FrameBlock("projection", ("scan_000099.tif",), projections.times_s[:1], smaller,
                      {n: v[:1] for n, v in projections.positions.items()})  # fmt: skip
    return replace(made, blocks=(first, *rest, half), correction=None)


def test_a_geometry_has_one_shape(
    record: Callable[..., ScanRecord], tmp_path: Path
) -> None:  # fmt: skip
    from flexdt.runtime.files.directory import open_data
    from flexdt.server.storage.dataset_writer import DatasetWriter

    made = _two_shapes(record())
    writer = DatasetWriter(open_data(tmp_path), made)
    for block in made.blocks:
        for name in block.files:
            writer.put(name, np.full(block.camera.shape, 500, dtype=np.uint16))
    writer.finish()
    writer.close()
    with pytest.raises(ExchangeError, match="2 shapes"):
        export_dataset(load_dataset(writer.folder), tmp_path / "g.csv", "csv")


@pytest.mark.parametrize("nominal", [False, True])
def test_nxtomo_holds_images_and_the_geometry_asked_for(
    nominal: bool, folder: Path, tmp_path: Path, flexdt: Run
) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra `io`")
    file = tmp_path / "scan.nxs"
    which = ("--nominal",) if nominal else ()
    code, out, err = flexdt(
        "export", folder, "--format", "nxtomo", "--out", file, *which, "--json"
    )
    assert code == 0, err
    assert json.loads(out)["views"] == 9
    data = load_dataset(folder)
    expected = data.corrected(NOMINAL if nominal else TILTED)
    with h5py.File(file) as nexus:
        keys = nexus["entry/instrument/detector/image_key"][:]
        images = nexus["entry/instrument/detector/data"][:][keys == 0]
        rows = nexus["entry/flexdt/cone_vec"][:]
    assert np.array_equal(images, np.stack([data.counts(i) for i in range(9)]))
    assert np.abs(rows - expected.rows).max() < 1e-9


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (("export", "DATA", "--format", "nxtomo", "--out", "g.tif"), 1, "ends with .nxs"),
        (
            ("export", "DATA", "--format", "nxtomo", "--out", "g.nxs", "--rows", "up"),
            1,
            "rows",
        ),
        (("import", "good.csv", "--format", "nxtomo", "--out", "g.json"), 2, "nxtomo"),
        (
            ("export", "DATA", "--format", "rtk", "--out", "g.txt"),
            1,
            "ends with .xml or .rtk",
        ),
        (("export", "nowhere", "--format", "rtk", "--out", "g.xml"), 1, "nowhere"),
        (("export", "DATA", "--format", "flexray", "--out", "g.xml"), 2, "flexray"),
        (
            ("export", "DATA", "--format", "ctsimu", "--out", "g.json", "--rows", "up"),
            1,
            "rows",
        ),
        (
            (
                "export",
                "DATA",
                "--format",
                "csv",
                "--out",
                "g.csv",
                "--unknown",
                "t.toml",
            ),
            1,
            "csv",
        ),
        (("import", "none.xml", "--format", "rtk", "--out", "g.json"), 1, "none.xml"),
        (("import", "good.xml", "--format", "rtk", "--out", "g.json"), 1, "pixel size"),
        (("import", "bad.txt", "--format", "rtk", "--out", "g.json"), 1, "not valid XML"),
        (("import", "bad.txt", "--format", "astra", "--out", "g.json"), 1, "bad.txt:1"),
        (
            ("import", "bad.txt", "--format", "ctsimu", "--out", "g.json"),
            1,
            "not valid JSON",
        ),
        (
            ("import", "bad.npz", "--format", "tomosipo", "--out", "g.json"),
            1,
            "no NumPy file",
        ),
        (("import", "bad.npy", "--format", "astra", "--out", "g.json"), 1, "n x 12"),
        (("import", "good.csv", "--format", "csv", "--out", "g.txt"), 1, ".json or .npy"),
        (
            ("import", "good.csv", "--format", "csv", "--out", "g.json", "--shape", "9"),
            2,
            "shape",
        ),
        (
            (
                "import",
                "good.csv",
                "--format",
                "csv",
                "--out",
                "g.json",
                "--shape",
                "9,9",
            ),
            1,
            "not (9, 9)",
        ),
        (
            ("import", "good.csv", "--format", "csv", "--out", "g.json", "--views", "4"),
            1,
            "not 4",
        ),
        (
            (
                "import",
                "good.csv",
                "--format",
                "csv",
                "--out",
                "g.json",
                "--pixel",
                "0.3",
            ),
            1,
            "not 0.3 x 0.3",
        ),
    ],
)
@pytest.mark.daily(10)
def test_errors(
    words: tuple[str, ...], code: int, says: str, folder: Path, tmp_path: Path, flexdt: Run,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("t.toml").write_text("dO_x = 1\n")
    Path("bad.txt").write_text("no numbers at all\n")
    Path("bad.npz").write_bytes(b"PK\x03\x04 no archive")
    np.save("bad.npy", np.zeros((3, 4)))
    for name, format in (("good.csv", "csv"), ("good.xml", "rtk")):
        export_dataset(load_dataset(folder), name, format)
    got, out, err = flexdt(*(folder if word == "DATA" else word for word in words))
    assert got == code, err
    assert says in err
    assert out == ""
    assert not Path(words[words.index("--out") + 1]).exists()


def test_pickles_are_never_opened(tmp_path: Path, flexdt: Run) -> None:
    file = tmp_path / "evil.npy"
    evil: Any = np.array([{"a": 1}], dtype=object)
    np.save(file, evil, allow_pickle=True)
    words = ("import", file, "--format", "astra", "--out", tmp_path / "g.json")
    code, _, err = flexdt(*words)
    assert code == 1
    assert "no NumPy file" in err


def test_the_example_shows_that_nothing_is_lost(folder: Path, tmp_path: Path) -> None:
    script = Path(__file__).parents[2] / "examples" / "exchange.py"
    done = subprocess.run(
        [sys.executable, "-W", "error", str(script), str(folder), str(tmp_path / "out")],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()[1:]
    readable = [name for name, format in FORMATS.items() if format.read is not None]
    assert (
        len(lines) == len(readable) + 1
    )  # ASTRA has a line for each of two kinds of file
    losses = [float(re.search(r"([\d.e+-]+) mm", line)[1]) for line in lines]  # type: ignore[index]
    assert max(losses) < 1e-9


def test_calibrate_takes_imported_geometries(folder: Path, tmp_path: Path) -> None:
    from typer import BadParameter

    from flexdt.clients.cli.commands.calibrate_commands import _load_data_sets

    file = tmp_path / "g.json"
    data = load_dataset(folder)
    save_geometry(geometry_of(data, NOMINAL), file)
    (own,), (imported,) = (
        _load_data_sets([folder], [], Given()),
        _load_data_sets([folder], [file], Given()),
    )
    assert np.abs(own.cone_vec.rows - imported.cone_vec.rows).max() < 1e-9
    # A correction means the same on top of either, but for alpha: a panel that the profile rolls
    # tells the stage's angle from its rows.
    moved = Offsets.from_edge(
        {"dO_x": 0.3, "det_pitch": 1.0, "tau_z": 0.2, "axis_tilt_x": 0.1}
    )
    difference = own.corrected(moved).rows - imported.corrected(moved).rows
    assert np.abs(difference).max() < 1e-9
    with pytest.raises(BadParameter, match="1 geometries for 2"):
        _load_data_sets([folder, folder], [file], Given())
