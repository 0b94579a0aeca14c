"""`flexdt backup` and `flexdt restore`: what a running twin writes comes back, and nothing else."""

from __future__ import annotations

import hashlib
import io
import json
import os
import tarfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from lab import Wire, digests, fly_script, projector, twin

from flexdt.clients.backup import back_up, restore
from flexdt.clients.cli.entry import run
from flexdt.clients.failure import CommandError
from flexdt.server.files.directory_lock import FILE


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A directory with documents, images and things that do not belong into a backup."""
    root = tmp_path / "data"
    files = {"state.json": b"{}", "corrections/a b%2F.json": b"[1]", "scan/flexdt.json": b"{ }",
             "scan/scan_000000.tif": b"\x01" * 5000, "scan/deep/er/x.bin": b""}  # fmt: skip
    for name, content in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    (root / ".lock").write_text("1")
    (root / "scan" / ".part-1").write_text("half")
    (tmp_path / "secret").write_text("of somebody else")
    (root / "scan" / "link.tif").symlink_to(tmp_path / "secret")
    (root / "folder").symlink_to(tmp_path)
    os.mkfifo(root / "pipe")
    return root


def contents(folder: Path) -> dict[str, bytes]:
    found = (f for f in folder.rglob("*") if f.is_file() and not f.is_symlink())
    return {str(f.relative_to(folder)): f.read_bytes() for f in found if f.name[0] != "."}


def test_there_and_back(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    archive, back = tmp_path / "b.tar", tmp_path / "back"
    assert run(["backup", str(data), str(archive), "--json"]) == 0
    told = capsys.readouterr()
    document = json.loads(told.out)
    assert (document["files"], document["bytes"]) == (5, 2 + 3 + 3 + 5000)
    assert sorted(document["left_out"]) == ["folder", "pipe", "scan/link.tif"]
    assert told.err.count("left out") == 3
    assert b"of somebody else" not in archive.read_bytes()
    with tarfile.open(archive) as tar:  # any tar program can read it
        names = tar.getnames()
        manifest = json.loads(tar.extractfile("manifest.json").read())["files"]  # type: ignore[union-attr]
    assert names[0] == "data/state.json"
    assert names.index("data/scan/flexdt.json") < names.index("data/scan/scan_000000.tif")
    for name, content in contents(data).items():
        assert manifest[name]["sha256"] == hashlib.sha256(content).hexdigest()
    assert run(["restore", str(archive), str(back)]) == 0
    assert contents(back) == contents(data)
    file = "scan/scan_000000.tif"
    assert (back / file).stat().st_mtime == pytest.approx((data / file).stat().st_mtime, abs=1e-3)
    empty = tmp_path / "mounted"
    empty.mkdir()
    restore(archive, empty)
    assert contents(empty) == contents(data)
    assert {f.name for f in tmp_path.iterdir()} == {"data", "secret", "b.tar", "back", "mounted"}


def test_what_is_refused_changes_nothing(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = tmp_path / "b.tar"
    back_up(data, archive)
    before = contents(tmp_path)
    target = tmp_path / "link"
    target.symlink_to(tmp_path)
    for words, said in (
        (["backup", data, archive], "exists"), (["backup", data, data / "in.tar"], "lies inside"),
        (["backup", tmp_path / "none", tmp_path / "x.tar"], "is no directory"),
        (["backup", data, tmp_path / "none" / "x.tar"], "folder does not"),
        (["restore", archive, data], "not an empty folder"),
        (["restore", archive, archive], "not an empty folder"),
        (["restore", archive, target], "not an empty folder"),
        (["restore", tmp_path / "none.tar", tmp_path / "new"], "none.tar"),
        (["restore", data / "state.json", tmp_path / "new"], "damaged or no backup"),
    ):  # fmt: skip
        assert run([str(word) for word in words]) == 1, words
        told = capsys.readouterr()
        assert said in told.err
        assert "Traceback" not in told.err
    assert contents(tmp_path) == before
    assert not (tmp_path / "new").exists()
    assert not [f for f in tmp_path.iterdir() if f.name.startswith(".")]


def test_every_damage_is_noticed(data: Path, tmp_path: Path) -> None:
    archive = tmp_path / "b.tar"
    back_up(data, archive)
    whole = archive.read_bytes()
    places = {whole.index(b"\x01" * 5000) + 77, whole.index(b"{ }"), 5, len(whole) // 2}
    places |= {whole.index(b'"sha256": "') + 12}
    kept = tmp_path / "mounted"
    kept.mkdir()
    for place in places:
        archive.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        if place == len(whole) // 2 and archive.read_bytes()[place] == 1:
            continue  # padding of a member, which holds nothing
        with pytest.raises(CommandError, match="damaged"):
            restore(archive, kept)
        assert not list(kept.iterdir())
    for end in (0, 511, 1024, len(whole) // 2, whole.index(b'"version"') + 3):
        archive.write_bytes(whole[:end])
        with pytest.raises(CommandError, match="damaged"):
            restore(archive, tmp_path / "new")
        assert not (tmp_path / "new").exists()


@contextmanager
def forged(path: Path) -> Iterator[Callable[..., None]]:
    """An archive of any members, with a manifest that agrees with them."""
    files: dict[str, object] = {}
    with tarfile.open(path, "w") as tar:

        def add(
            name: str, content: bytes = b"evil", kind: bytes = tarfile.REGTYPE, to: str = ""
        ) -> None:
            info = tarfile.TarInfo(name)
            info.type, info.linkname = kind, to
            info.size = len(content) if kind == tarfile.REGTYPE else 0
            tar.addfile(info, io.BytesIO(content))
            sum_ = hashlib.sha256(content).hexdigest()
            files[name.removeprefix("data/")] = {"bytes": len(content), "sha256": sum_}

        yield add
        text = json.dumps({"version": 1, "files": files}).encode()
        info = tarfile.TarInfo("manifest.json")
        info.size = len(text)
        tar.addfile(info, io.BytesIO(text))


@pytest.mark.parametrize(
    "members",
    [
        [("data/../evil",)], [("data/a/../../../evil",)], [("/evil",)], [("data//evil",)],
        [("evil",)], [("data/a\\..\\evil",)], [("data/c:evil",)], [("data/.lock",)],
        [("data/scan", b"", tarfile.SYMTYPE, ".."), ("data/scan/evil",)],
        [("data/x", b"", tarfile.LNKTYPE, "data/../../secret")],
        [("data/x", b"", tarfile.SYMTYPE, "/etc/passwd")],
        [("data/x", b"", tarfile.FIFOTYPE)], [("data/x", b"", tarfile.CHRTYPE)],
        [("data/x",), ("data/x",)], [("data/x",), ("data/x/y",)],
    ],
)  # fmt: skip
def test_nothing_is_written_elsewhere(tmp_path: Path, members: list[tuple[object, ...]]) -> None:
    with forged(tmp_path / "b.tar") as add:
        for member in members:
            add(*member)
    target = tmp_path / "in" / "target"
    target.parent.mkdir()
    with pytest.raises((CommandError, OSError)):
        restore(tmp_path / "b.tar", target)
    assert sorted(f.name for f in tmp_path.rglob("*")) == ["b.tar", "in"]


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_backup_made_during_a_scan_is_a_twin_that_goes_on_to_the_same_bytes(
    tmp_path: Path,
) -> None:
    rays = projector()
    process = twin(rays.port, tmp_path / "data", "--speed-up", "max")
    try:
        wire = Wire(process.port)
        wire.call("calibration.apply", parameters={"dD_x": 0.5}, name="mine")
        wire.call("sample.set", name="normal", offset={"x": 2.0, "rz": 30.0})
        job = wire.call("script.submit", text=fly_script(121), name="scan", seed=4)["job"]
        while (status := wire.call("job.status", job=job))["frames_done"] < 10:
            time.sleep(0.002)
        back_up(tmp_path / "data", tmp_path / "b.tar")
        assert wire.call("job.status", job=job)["frames_done"] >= status["frames_done"]
        wire.wait(job, "done")
        whole = digests(next((tmp_path / "data").glob("*scan*")))
        process.end()
        restored = restore(tmp_path / "b.tar", tmp_path / "back")
        had = [name for name in restored.files if name.endswith(".tif")]
        assert 10 <= len(had) < len(whole)
        process = twin(rays.port, tmp_path / "back", "--speed-up", "max")
        wire = Wire(process.port)
        assert wire.call("state.get")["correction"]["name"] == "mine"
        assert wire.call("state.get")["sample"]["offset"]["rz"] == 30.0
        (listed,) = [j for j in wire.call("job.list")["jobs"] if j["name"] == "scan"]
        wire.call("job.resume", job=listed["job"])
        wire.wait(listed["job"], "done")
        assert digests(next((tmp_path / "back").glob("*scan*"))) == whole
        assert not process.logged("error")
        assert (tmp_path / "back" / FILE).exists()
    finally:
        process.end()
        rays.end()
