"""`flexdt demo`: the whole main job through the command line, with a truth of the test's
own."""

from __future__ import annotations

import itertools
import json
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from flexdt.clients.cli.command_tree import run
from flexdt.library.datasets.labelled_pictures import FOOT_ROWS, HEAD_ROWS
from flexdt.library.reading.folders import load_dataset
from flexdt.library.reconstruction.volume_files import read_volume
from flexdt.twin.geometry.offsets import NAMES, Offsets

# Twelve digits: a good calibration shares the first five or six with the truth by merit.
TRUTH = {"dO_x": -0.731234918273, "dO_y": 0.412345564738, "dO_z": 1.223456019283,
         "alpha": 2.556789465738, "tau_x": 0.213579192837, "tau_z": -0.324681637485}  # fmt: skip


def demo(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "flexdt.clients.cli", "demo", "--no-viewer", *words],
        capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip


@pytest.fixture(scope="module")
def done(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[subprocess.CompletedProcess[str], Path]:
    out = tmp_path_factory.mktemp("demo")
    truth = out.parent / "truth.toml"
    truth.write_text("\n".join(f"{k} = {v}" for k, v in TRUTH.items()))
    return demo("--out", str(out), "--truth", str(truth), "--json"), out


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_it_ends_well_and_says_what_it_did(
    done: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    process, out = done
    assert process.returncode == 0, process.stderr
    document = json.loads(process.stdout)
    assert document == json.loads((out / "demo.json").read_text())
    assert document["frames"] == 180
    assert 0 < document["scan_s"] < 180
    assert document["truth"] == TRUTH
    verdict = document["calibration"]["verdict"]
    assert f"verdict: {verdict}" in process.stderr
    picture = np.asarray(Image.open(out / "demo.png"))
    assert picture.shape[0] == HEAD_ROWS + 380 + FOOT_ROWS
    for strip in (picture[:HEAD_ROWS], picture[-FOOT_ROWS:]):
        for half in np.array_split(strip, 2, axis=1):
            assert half.min() < 100, "letters"
    head = next(line for line in process.stderr.splitlines() if "calibrated  " in line)
    assert head.split()[-1] == "meaning"
    assert re.search(
        r"^dO_x .* sample with axis, to the right$", process.stderr, re.MULTILINE
    )
    assert document["picture"] == str(out / "demo.png")
    assert not re.search(r"still .*\(0 s", process.stderr)


@pytest.mark.slow
def test_its_next_commands_make_a_volume_with_the_beads_in_it(
    done: tuple[subprocess.CompletedProcess[str], Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    process, out = done
    lines = process.stderr.split("next:\n")[1].splitlines()[:2]
    first, second = (shlex.split(line, comments=True)[1:] for line in lines)
    assert (second[:2], Path(second[2])) == (["up", "--data"], out / "data")
    assert run(first) == 0, capsys.readouterr().err
    volume = read_volume(out / "volume.nrrd")
    # Five steel beads of 2 mm in a 24 x 16 x 49.8 mm object: their lateral places from the
    # stack alone, as the centroid of what is far brighter than plastic.
    bright = np.argwhere(volume.data > 0.5 * np.nanmax(volume.data))
    z, y, x = (
        axis[at] for axis, at in zip(volume.centers()[::-1], bright.T, strict=True)
    )
    levels = np.sort(np.unique(np.round((z - z.min()) / 9.6)))
    assert levels.tolist() == [0, 1, 2, 3, 4]
    assert np.abs(x).max() < 12.5
    assert np.abs(y).max() < 8.5


@pytest.mark.slow
def test_the_calibration_finds_the_truth(
    done: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    document = json.loads(done[0].stdout)
    assert document["calibration"]["identifiable"] is True
    assert document["calibration"]["frames"] == 180
    assert document["calibration_s"] > 0
    assert isinstance(document["inside_95"], bool)
    found = document["calibration"]["parameters"]
    assert {name for name, p in found.items() if p["asked"]} == set(TRUTH)
    for name, true in TRUTH.items():
        error = abs(found[name]["value"] - true)
        assert error < 4 * found[name]["sigma"], name
        # The phantom's scale, known to 0.1 %, is part of what images tell of the distance.
        assert found[name]["images"] < (0.25 if name == "dO_z" else 0.1), name
    # A prior of the panel's place shares a shift with dO; as a whole the geometry is the true
    # one.
    dataset = load_dataset(document["dataset"])
    poses = dataset.poses
    # The others are told lengths: ways, the pitch, the phantom's scale.
    values = {name: p["value"] for name, p in found.items() if name in NAMES}
    place = np.array(list(itertools.product((-15.0, 15.0), (-15.0, 15.0), (-25.0, 25.0))))
    seen = [
        poses.cone_vec(Offsets.from_edge(each)).project_points(place, dataset.shape)
        for each in (values, TRUTH)
    ]
    assert np.abs(seen[0] - seen[1]).max() < 0.05


@pytest.mark.slow
def test_the_data_set_is_the_scanners(
    done: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    process, out = done
    folder = Path(json.loads(process.stdout)["dataset"])
    assert folder.is_relative_to(out)
    names = {p.name for p in folder.iterdir()}
    assert {"di000000.tif", "io000000.tif", "scan settings.txt", "data settings XRE.txt",
            "script.txt", "flexdt.json"} <= names  # fmt: skip
    frames = [n for n in names if n.startswith("scan_")]
    assert len(frames) == 180
    for name in ("di000000.tif", "io000000.tif", "scan_000000.tif", "scan_000179.tif"):
        image = tifffile.imread(folder / name)
        assert (image.shape, str(image.dtype)) == ((760, 956), "uint16")


@pytest.mark.slow
def test_the_truth_is_nowhere_in_what_the_servers_wrote(
    done: tuple[subprocess.CompletedProcess[str], Path],
) -> None:
    _, out = done
    texts = [p for p in out.rglob("*") if p.is_file() and p.suffix != ".tif"]
    written = {p: p.read_bytes() for p in texts if p.name != "demo.json"}
    assert len(written) >= 5
    for path, content in written.items():
        for value in TRUTH.values():
            assert str(abs(value)).encode() not in content, path


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("warp = 1", "unknown parameter 'warp'"),
        ("dO_x = 'far'", "dO_x = 'far' is not a number"),
        ("dO_x", "not valid TOML"),
        (None, "No such file"),
    ],
)
@pytest.mark.daily(1)
def test_a_bad_truth_file_is_refused(
    content: str | None, says: str, tmp_path: Path
) -> None:
    truth = tmp_path / "truth.toml"
    if content is not None:
        truth.write_text(content)
    process = demo("--out", str(tmp_path / "out"), "--truth", str(truth))
    assert process.returncode == 1
    assert says in process.stderr
    assert "Traceback" not in process.stderr


@pytest.mark.slow
def test_a_truth_inside_the_data_directory_is_refused(tmp_path: Path) -> None:
    truth = tmp_path / "data" / "truth.toml"
    truth.parent.mkdir()
    truth.write_text("dO_x = 1.0")
    process = demo("--out", str(tmp_path), "--truth", str(truth))
    assert process.returncode == 1
    assert "inside the data directory" in process.stderr


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_ctrl_c_ends_the_demo_and_its_servers(tmp_path: Path) -> None:
    words = ["demo", "--no-viewer", "--out", str(tmp_path)]
    with subprocess.Popen(
        [sys.executable, "-m", "flexdt.clients.cli", *words],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        for line in process.stdout:
            if "scanning" in line:
                break
        started = children(
            process.pid
        )  # the supervisor, and what compiles kernels meanwhile
        servers = [pid for parent in started for pid in children(parent)]
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert err.rstrip().endswith("flexdt: interrupted")
    assert "Traceback" not in err
    end = time.monotonic() + 60.0  # the system may be slow to clear away what has ended
    while left := [p for p in (*started, *servers) if Path(f"/proc/{p}").exists()]:
        assert time.monotonic() < end, left
        time.sleep(0.05)
    assert not (tmp_path / "demo.json").exists()


def children(pid: int) -> list[int]:
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
