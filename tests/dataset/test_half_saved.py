"""A folder whose saving was interrupted says what it is; files that do not fit say so alike."""

from __future__ import annotations

import errno
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.runtime.files import whole_files
from flexdt.runtime.files.whole_files import room_named
from flexdt.twin.dataset.dataset_errors import DatasetError

VIEWS, SHAPE = 6, (20, 30)
SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=VIEWS, pixel=0.2)


def data_set(seed: int = 1) -> fx.DataSet:
    counts = (
        np.random.default_rng(seed).integers(100, 900, (VIEWS, *SHAPE)).astype(np.uint16)
    )
    return fx.DataSet.from_arrays(counts, SCAN, flat=np.full(SHAPE, 1000), name="bolt")


class Interrupted(fx.DataSet):
    """A data set during whose saving somebody presses Ctrl-C."""

    def counts(self, index: int | None = None) -> Any:
        if index == 4:
            raise KeyboardInterrupt
        return super().counts(index)


@pytest.fixture
def half(tmp_path: Path) -> Path:
    """A folder in which saving was interrupted before projection 4."""
    whole = data_set()
    cut = Interrupted(
        **{name: getattr(whole, name) for name in whole.__dataclass_fields__}
    )
    with pytest.raises(KeyboardInterrupt):
        cut.save(tmp_path / "half")
    return tmp_path / "half"


def content(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_a_half_saved_folder_says_what_it_is(half: Path) -> None:
    said = r"half is half-saved: 4 of 6 projections of 'bolt'"
    with pytest.raises(
        DatasetError, match=f"{said}; save it once more with resume=True, or"
    ):
        fx.open(half)
    with pytest.raises(
        DatasetError, match=f"{said}; allowed: resume=True, or an empty folder"
    ):
        data_set().save(half)
    with pytest.raises(
        DatasetError, match=f"{said}, which is another data set than 'bolt'"
    ):
        data_set(seed=2).save(half, resume=True)
    assert len(list(half.glob("scan*"))) == 4
    (half / "scan settings.txt").write_text("no projection")
    (half / "unfinished.json").write_text("{broken")
    with pytest.raises(DatasetError, match=r"half-saved: 4 of \? projections"):
        fx.open(half)


def test_saving_goes_on_where_it_was_interrupted(half: Path, tmp_path: Path) -> None:
    before = {f.name: f.stat().st_mtime_ns for f in half.glob("scan*")}
    data_set().save(half, resume=True)
    data_set().save(tmp_path / "whole")
    assert content(half) == content(tmp_path / "whole")
    assert {name: (half / name).stat().st_mtime_ns for name in before} == before
    np.testing.assert_array_equal(fx.open(half).counts(), data_set().counts())
    with pytest.raises(
        DatasetError, match="is not empty; allowed: a new or an empty folder"
    ):
        data_set().save(half, resume=True)


@pytest.fixture
def small_files() -> Iterator[None]:
    """Let the system refuse files above 16 kB, as it does where a disk is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16 << 10, hard))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("ending", [".tif", ".nrrd", ".mha", ".nii.gz"])
def test_a_volume_that_does_not_fit_names_its_file(
    tmp_path: Path, ending: str, small_files: None
) -> None:
    values = np.random.default_rng(1).normal(size=(20, 40, 40)).astype(np.float32)
    path = tmp_path / f"volume{ending}"
    with pytest.raises(OSError, match="bytes are free") as told:
        fx.Volume(values, 0.5).save(path)
    assert (told.value.filename, told.value.errno in (errno.EFBIG, errno.ENOSPC)) == (
        str(path), True
    )  # fmt: skip
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["volume.h5", "volume.tif", "scan.nxs"])
def test_what_is_larger_than_the_free_room_is_not_begun(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """HDF5 ends the process where a disk fills while it writes."""
    if name[-2:] in ("h5", "xs"):
        pytest.importorskip("h5py", reason="the extra `io`")
    monkeypatch.setattr(whole_files, "free_bytes", lambda path: 3000)
    volume = fx.Volume(np.zeros((20, 40, 40), np.float32), 0.5)
    write = data_set().to_nxtomo if name == "scan.nxs" else volume.save
    with pytest.raises(OSError, match=r"it takes \d+ bytes; 3000 bytes are free") as told:
        write(tmp_path / name)
    assert (told.value.filename, told.value.errno) == (str(tmp_path / name), errno.ENOSPC)
    assert list(tmp_path.iterdir()) == []


def test_hdf5_s_words_for_a_full_disk_are_known(tmp_path: Path) -> None:
    said = "Can't write data (file write failed: file descriptor = 12, errno = 28, error message"
    with (
        pytest.raises(OSError, match="bytes are free") as told,
        room_named(tmp_path / "a.h5"),
    ):
        raise OSError(said)
    assert (told.value.filename, told.value.errno) == (
        str(tmp_path / "a.h5"),
        errno.ENOSPC,
    )
    with pytest.raises(OSError, match=r"^other$"), room_named(tmp_path / "a.h5"):
        raise OSError("other")
    with pytest.raises(FileNotFoundError) as read, room_named(tmp_path / "a.h5"):
        (tmp_path / "frame.tif").read_bytes()
    assert read.value.filename == str(tmp_path / "frame.tif")
