"""The writer under trouble: full disks, kills, hostile names, threads, resumed scans."""

from __future__ import annotations

import errno
import json
import os
import signal
import string
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from flexdt.runtime.files.dataset_folder import free_name
from flexdt.runtime.files.directory import Directory, open_data
from flexdt.server.storage.dataset_writer import DatasetWriter
from flexdt.twin.dataset.dataset_errors import (
    DatasetExistsError,
    DatasetMissingError,
    DatasetNameError,
    DatasetWriteError,
    DiskFullError,
)
from flexdt.twin.dataset.file_names import plain_name
from flexdt.twin.dataset.flexdt_json import NoiseRecord, ScanRecord, parse_document

Image = npt.NDArray[np.uint16]
Make = Callable[..., ScanRecord]
Images = Callable[[ScanRecord], dict[str, Image]]


def read_document(folder: Path) -> dict[str, object]:
    document: dict[str, object] = json.loads((folder / "flexdt.json").read_text())
    return document


def test_a_finished_data_set_holds_what_the_interface_names(
    tmp_path: Path, record: Make, images: Images
) -> None:
    r = record()
    writer = DatasetWriter(open_data(tmp_path), r, script=b"tube\txrayon\r\n\x00\xff")
    assert read_document(writer.folder)["complete"] is False
    for name, image in images(r).items():
        writer.put(name, image)
    writer.finish(duration_s=150.0)
    assert sorted(os.listdir(writer.folder)) == sorted(
        [
            *r.files,
            "scan settings.txt",
            "data settings XRE.txt",
            "script.txt",
            "flexdt.json",
        ]
    )
    assert (writer.folder / "script.txt").read_bytes() == b"tube\txrayon\r\n\x00\xff"
    document = read_document(writer.folder)
    assert document["complete"] is True
    assert document["duration_s"] == 150.0
    assert b"SCRIPT CANCELLED" not in (writer.folder / "scan settings.txt").read_bytes()
    for name, image in images(r).items():
        assert np.array_equal(tifffile.imread(writer.folder / name), image)
    with tifffile.TiffFile(writer.folder / "scan_000000.tif") as tiff:
        assert tiff.pages[0].compression == 1
        assert tiff.byteorder == "<"


def test_the_document_states_only_nominal_geometry(
    tmp_path: Path, record: Make, images: Images
) -> None:
    """cone_vec is the uncorrected one; the correction stands beside it."""
    r = record()
    document = parse_document(
        (DatasetWriter(open_data(tmp_path), r).folder / "flexdt.json").read_text(
            encoding="utf-8"
        )
    )
    assert document.correction is not None
    assert document.correction.parameters["dO_x"] == 0.5
    by_hand = [  # object frame at 0 deg: source minus axis, detector minus axis, u, v
        1.25 - (2.5 - 0.5405), -514.9192, 26.5 - 6.2917 - 20.0,
        -24.0 + 24.1215 - (2.5 - 0.5405), 1040.0008 - 514.9192, 21.0 - 20.0,
        0.1496, 0.0, 0.0, 0.0, 0.0, -0.1496,
    ]  # fmt: skip
    assert document.frames[2].cone_vec == pytest.approx(by_hand, abs=1e-9)
    assert document.frames[0].positions["tra_obj"] == -100.0
    assert document.frames[3].time_s == pytest.approx(0.16)
    assert document.noise.seed == 7
    assert "truth" not in document.model_dump_json()


class FullDisk:
    """Writes so many bytes, the last call only in part, then fails as a full disk does."""

    def __init__(self, room: int, code: int = errno.ENOSPC) -> None:
        self.room, self.code = room, code

    def __call__(self, fd: int, data: memoryview) -> int:
        if self.room <= 0:
            raise OSError(self.code, os.strerror(self.code))
        part = data[: min(self.room, 700)]
        self.room -= len(part)
        return os.write(fd, part)


@pytest.mark.parametrize("room", [0, 1, 699, 1500])
def test_a_full_disk_leaves_no_part_of_a_file(tmp_path: Path, room: int) -> None:
    with Directory(tmp_path, write=FullDisk(room)) as folder:
        with pytest.raises(
            DiskFullError, match=r"no room for .*a.tif: 2000 bytes asked"
        ) as caught:
            folder.put("a.tif", bytes(2000))
        assert os.listdir(tmp_path) == []
    assert caught.value.data["errno"] == errno.ENOSPC
    json.dumps(caught.value.data)


def test_short_writes_are_continued(tmp_path: Path) -> None:
    with Directory(tmp_path, write=FullDisk(10_000)) as folder:
        folder.put("a.bin", bytes(range(250)) * 20)
    assert (tmp_path / "a.bin").read_bytes() == bytes(range(250)) * 20


def test_a_full_disk_keeps_the_file_that_was_there(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("old")
    with Directory(tmp_path, write=FullDisk(1)) as folder, pytest.raises(DiskFullError):
        folder.put("a.txt", b"new and longer")
    assert (tmp_path / "a.txt").read_text() == "old"


def test_a_closed_folder_refuses_and_waits_for_files_in_the_making(
    tmp_path: Path,
) -> None:
    started, go = threading.Event(), threading.Event()

    def slow(fd: int, data: memoryview) -> int:
        started.set()
        assert go.wait(10)
        return os.write(fd, data)

    folder = Directory(tmp_path, write=slow)
    with ThreadPoolExecutor(2) as pool:
        writing = pool.submit(folder.put, "a.txt", b"x")
        assert started.wait(10)
        closing = pool.submit(folder.close)
        go.set()
        writing.result(10)
        closing.result(10)
    assert (tmp_path / "a.txt").read_bytes() == b"x"
    with pytest.raises(DatasetWriteError, match="has been closed"):
        folder.put("b.txt", b"x")


def test_other_refusals_are_write_errors(tmp_path: Path) -> None:
    with Directory(tmp_path, write=FullDisk(0, errno.EIO)) as folder:
        with pytest.raises(DatasetWriteError, match=r"cannot write .*a.txt") as caught:
            folder.put("a.txt", b"x")
        assert not isinstance(caught.value, DiskFullError)
    with pytest.raises(DatasetWriteError, match="cannot use folder"):
        Directory(tmp_path / "missing")


def test_a_scan_survives_a_disk_that_fills_up_and_is_emptied(
    tmp_path: Path, record: Make, images: Images
) -> None:
    r = record()
    disk = FullDisk(10**9)
    writer = DatasetWriter(open_data(tmp_path), r, write=disk)
    writer.put("di000000.tif", images(r)["di000000.tif"])
    disk.room = 1000
    with pytest.raises(DiskFullError):
        writer.put("io000000.tif", images(r)["io000000.tif"])
    assert writer.missing == r.files[1:]
    with pytest.raises(DiskFullError):
        writer.mark_incomplete("disk full")
    assert read_document(writer.folder)["complete"] is False
    for name in writer.present:
        assert np.array_equal(tifffile.imread(writer.folder / name), images(r)[name])
    with pytest.raises(DatasetMissingError, match="7 of 8 images are missing: io000000"):
        writer.finish()
    disk.room = 10**9
    for name in writer.missing:
        writer.put(name, images(r)[name])
    writer.finish()
    assert read_document(writer.folder)["complete"] is True


def test_room_is_checked_before_the_scan(
    tmp_path: Path, record: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "flexdt.server.storage.dataset_writer.free_bytes", lambda path: 1000
    )
    with pytest.raises(
        DiskFullError, match=r"8 images need .* bytes, 1000 bytes are free"
    ):
        DatasetWriter(open_data(tmp_path), record())


CHILD = """
import importlib.util, sys, pathlib
import numpy as np
spec = importlib.util.spec_from_file_location("made", sys.argv[1])
made = importlib.util.module_from_spec(spec)
spec.loader.exec_module(made)
from flexdt.runtime.files.directory import open_data
from flexdt.server.storage.dataset_writer import DatasetWriter
record = made.make_record(frames=2000)
images = made.make_images(record)
writer = DatasetWriter(open_data(pathlib.Path(sys.argv[2])), record, resume=True, sync=False)
print("ready", flush=True)
while True:
    for name in record.files:
        writer.put(name, images[name])
"""


@pytest.mark.slow
def test_a_killed_writer_leaves_whole_files_and_can_be_resumed(
    tmp_path: Path, record: Make, images: Images
) -> None:
    conftest = Path(__file__).with_name("conftest.py")
    for delay in (0.02, 0.11):
        command = [sys.executable, "-c", CHILD, str(conftest), str(tmp_path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            assert child.stdout.readline() == "ready\n"
            time.sleep(delay)
            child.send_signal(signal.SIGKILL)
    folder = tmp_path / "scan"
    r = record(frames=2000)
    expected = images(r)
    found = list(folder.glob("*.tif"))
    assert found
    for path in found:
        assert np.array_equal(tifffile.imread(path), expected[path.name])
    assert parse_document((folder / "flexdt.json").read_text()).complete is False
    assert "SCRIPT CANCELLED!" in (folder / "scan settings.txt").read_text()
    (folder / ".part-1-1").write_bytes(b"left by an earlier kill")
    writer = DatasetWriter(open_data(tmp_path), r, resume=True, sync=False)
    assert writer.present == {p.name for p in found}
    assert not list(folder.glob(".part*"))
    for name in writer.missing:
        writer.put(name, expected[name])
    writer.finish()
    assert read_document(folder)["complete"] is True


def test_two_threads_put_the_same_file_each_through_its_own_folder(
    tmp_path: Path,
) -> None:
    """As when a server ends while its last document is still being written."""
    both = threading.Barrier(2, timeout=30)

    def write(fd: int, data: memoryview) -> int:
        both.wait()  # each has its temporary file open
        return os.write(fd, data)

    def put(text: bytes) -> None:
        with Directory(tmp_path, write=write) as files:
            files.put("state.json", text)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(put, [b"one", b"two"]))
    assert (tmp_path / "state.json").read_bytes() in (b"one", b"two")
    assert [f.name for f in tmp_path.iterdir()] == ["state.json"]


def test_resuming_does_not_trust_a_damaged_image(
    tmp_path: Path, record: Make, images: Images
) -> None:
    r = record()
    writer = DatasetWriter(open_data(tmp_path), r)
    for name, image in images(r).items():
        writer.put(name, image)
    writer.mark_incomplete("killed")
    cut = writer.folder / "scan_000001.tif"
    cut.write_bytes(cut.read_bytes()[:-10])
    (writer.folder / "scan_000002.tif").write_bytes(b"not a TIFF")
    tifffile.imwrite(writer.folder / "scan_000003.tif", np.zeros((3, 4), np.uint16))
    again = DatasetWriter(open_data(tmp_path), r, resume=True)
    assert again.missing == ("scan_000001.tif", "scan_000002.tif", "scan_000003.tif")


def test_only_the_same_scan_is_resumed(tmp_path: Path, record: Make) -> None:
    DatasetWriter(open_data(tmp_path), record())
    with pytest.raises(DatasetExistsError, match="another name, or resume"):
        DatasetWriter(open_data(tmp_path), record())
    with pytest.raises(DatasetExistsError, match=r"another scan .its frames differ"):
        DatasetWriter(open_data(tmp_path), record(frames=6), resume=True)
    with pytest.raises(DatasetExistsError, match="its noise differ"):
        DatasetWriter(open_data(tmp_path), record(noise=NoiseRecord(8)), resume=True)
    (tmp_path / "scan" / "flexdt.json").write_text("{")
    with pytest.raises(DatasetExistsError, match="cannot be read"):
        DatasetWriter(open_data(tmp_path), record(), resume=True)
    assert free_name(open_data(tmp_path), "scan") == "scan-2"


def test_a_resumed_scan_keeps_the_date_and_correction_it_began_with(
    tmp_path: Path, record: Make
) -> None:
    began = DatasetWriter(open_data(tmp_path), record()).record
    later = record(started=datetime(2026, 4, 1), correction=None)
    resumed = DatasetWriter(open_data(tmp_path), later, resume=True)
    assert resumed.record.started == began.started
    assert resumed.record.correction == began.correction
    assert (
        "date: 3/14/2026; time: 12:05:09 AM"
        in (resumed.folder / "scan settings.txt").read_text()
    )


def test_many_threads_write_one_data_set(
    tmp_path: Path, record: Make, images: Images
) -> None:
    r = record(frames=60)
    writer = DatasetWriter(open_data(tmp_path), r, sync=False)
    work = list(images(r).items()) * 2
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda item: writer.put(*item), work))
    writer.finish()
    assert writer.missing == ()
    for name, image in images(r).items():
        assert np.array_equal(tifffile.imread(writer.folder / name), image)


HOSTILE = ["", ".", "..", "../x.tif", "/etc/passwd", "a/b.tif", "a\\b.tif", "C:\\x.tif", "C:x.tif",
           "\\\\host\\share\\x.tif", "//host/share", "x\0.tif", "x\n.tif", "NUL", "con.tif",
           "LPT1", ".part-1", ".hidden", "x.tif ", "x.tif.", " x", "x" * 129, "a:b", "a|b", "a*",
           "\ud800.tif", "é" * 128 + ".tif"]  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names_are_refused_everywhere(
    tmp_path: Path, record: Make, name: str
) -> None:
    root = tmp_path / "data"
    image = np.zeros((24, 30), np.uint16)
    with pytest.raises(DatasetNameError, match="allowed: a plain name"):
        plain_name(name)
    with pytest.raises(DatasetNameError):
        DatasetWriter(open_data(root), record(name))
    writer = DatasetWriter(open_data(root), record())
    with pytest.raises(DatasetNameError):
        writer.put(name, image)
    r = record("other")
    block = replace(r.blocks[0], files=(name,))
    with pytest.raises(DatasetNameError):
        DatasetWriter(open_data(root), replace(r, blocks=(block, *r.blocks[1:])))
    assert [p.name for p in tmp_path.iterdir()] == ["data"]
    assert sorted(p.name for p in root.iterdir()) == ["scan"]


@given(st.text(alphabet=string.printable + "\0é\ud800", max_size=20))
def test_a_plain_name_stays_in_its_folder(name: str) -> None:
    try:
        plain_name(name)
    except DatasetNameError:
        return
    root = Path("/data/set")
    assert (root / name).parent == root
    assert os.path.normpath(root / name) == str(root / name)
    assert "\\" not in name
    assert ":" not in name


def test_links_are_never_followed(tmp_path: Path, record: Make, images: Images) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "victim.txt").write_text("precious")
    root = tmp_path / "data"
    root.mkdir()
    (root / "scan").symlink_to(outside)
    with pytest.raises(DatasetNameError, match="nothing is written through it"):
        DatasetWriter(open_data(root), record())
    r = record("second")
    writer = DatasetWriter(open_data(root), r)
    (writer.folder / "scan_000000.tif").symlink_to(outside / "victim.txt")
    writer.put("scan_000000.tif", images(r)["scan_000000.tif"])
    assert not (writer.folder / "scan_000000.tif").is_symlink()
    # The folder itself swapped for a link while the scan runs: the writer keeps to its own.
    writer.folder.rename(root / "moved")
    (root / "second").symlink_to(outside)
    writer.put("scan_000001.tif", images(r)["scan_000001.tif"])
    assert sorted(os.listdir(outside)) == ["victim.txt"]
    assert (outside / "victim.txt").read_text() == "precious"
    assert (root / "moved" / "scan_000001.tif").exists()


def test_images_of_another_scan_are_refused(tmp_path: Path, record: Make) -> None:
    writer = DatasetWriter(open_data(tmp_path), record())
    good = np.zeros((24, 30), np.uint16)
    with pytest.raises(DatasetWriteError, match="no image of scan"):
        writer.put("scan_999999.tif", good)
    with pytest.raises(DatasetWriteError, match=r"uint16 of shape \(24, 30\)"):
        writer.put("scan_000000.tif", good.T.copy())
    with pytest.raises(DatasetWriteError, match="float32"):
        writer.put("scan_000000.tif", good.astype(np.float32))  # type: ignore[arg-type]
