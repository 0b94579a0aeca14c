"""Damage that ends a process inside the HDF5 library ends in one sentence here."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import flexdt as fx
from flexdt.library.optional import hdf5_files
from flexdt.twin.dataset.dataset_errors import DatasetFormatError

h5py = pytest.importorskip("h5py")
SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=3, shape=(12, 17), pixel=1.0)


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    counts = np.full((3, 12, 17), 500, np.uint16)
    path = tmp_path / "scan.nxs"
    fx.DataSet.from_arrays(counts, SCAN, dark=0, flat=60_000).to_nxtomo(path)
    return path


@pytest.fixture(params=["fork", "program"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "fork" and not hdf5_files.FORKS:
        pytest.skip("no safe fork")
    monkeypatch.setattr(hdf5_files, "FORKS", request.param == "fork")
    monkeypatch.setattr(hdf5_files, "_sound", hdf5_files._sound.__class__())
    return str(request.param)


def harmed(
    monkeypatch: pytest.MonkeyPatch, way: str, what: Callable[..., None], code: str
) -> None:
    """The child's walk is replaced by a harm; of a program its code is."""
    if way == "fork":
        monkeypatch.setattr(hdf5_files, "walk", what)
        return
    run = subprocess.run

    def other(command: list[str], **options: object) -> object:
        return run([*command[:2], code], **options)  # type: ignore[call-overload]

    monkeypatch.setattr(hdf5_files.subprocess, "run", other)


DOORS = {
    "open": fx.open,
    "volume": fx.Volume.load,
    "images": lambda path: fx.read_tiffs(f"{path}:/entry/instrument/detector/data", SCAN),
}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("name", ["SIGSEGV", "SIGABRT", "SIGFPE"])
def test_a_file_that_ends_the_process_is_refused(
    scan: Path, way: str, name: str, door: str, monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    number = int(getattr(signal, name))
    harmed(
        monkeypatch, way,
        lambda *_: os.kill(os.getpid(), number),
        f"import os; os.kill(os.getpid(), {number})",
    )  # fmt: skip
    path = scan.rename(scan.with_suffix(".h5")) if door == "volume" else scan
    with pytest.raises(fx.TwinError, match="damaged"):
        DOORS[door](path)
    assert capfd.readouterr() == ("", "")


def test_a_file_that_never_ends_is_refused(
    scan: Path, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hdf5_files, "PATIENCE_CPU_S", 1)
    harmed(monkeypatch, way, lambda *_: sum(iter(int, 1)), "while 1: pass")
    with pytest.raises(DatasetFormatError, match="damaged"):
        fx.open(scan)


def test_a_right_file_is_walked_through_once(
    scan: Path, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(fx.open(scan)) == 3
    harmed(
        monkeypatch, way, lambda *_: os.kill(os.getpid(), 9), "import sys; sys.exit(9)"
    )
    assert len(fx.open(scan)) == 3
    os.utime(scan, (1, 1))  # another file, as far as anybody knows
    with pytest.raises(DatasetFormatError, match="damaged"):
        fx.open(scan)


def test_an_ordinary_error_of_the_walk_is_left_to_the_reader(
    tmp_path: Path, way: str
) -> None:
    path = tmp_path / "scan.nxs"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(200))
    with pytest.raises(DatasetFormatError, match=r"is no HDF5 file, or a damaged one$"):
        fx.open(path)


def test_the_walk_prints_nothing_and_leaves_no_child(scan: Path) -> None:
    code = (
        "import sys, flexdt as fx; fx.open(sys.argv[1]); import os\n"
        "try: os.waitpid(-1, os.WNOHANG); print('a child')\n"
        "except ChildProcessError: pass"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code, str(scan)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("", "")
