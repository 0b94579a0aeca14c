"""Compiled kernels are kept where this user may write, and taken from whom this user trusts."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from flexdt.runtime.kernels import kernel_files
from flexdt.runtime.kernels.kernel_files import KernelFiles, Owner, Place
from flexdt.twin.projection.kernels import compiling

posix = pytest.mark.skipif(not hasattr(os, "getuid"), reason="needs POSIX's owners")
SQUARE = """
import sys
import flexdt
from flexdt.twin.projection.kernels.compiling import serial
sys.path.insert(0, {folder!r})
import squares
print(squares.square(3), sum(squares.square._cache_hits.values()))
"""


def place(folder: Path, owner: Owner = Owner.TRUSTED, *, written: bool = True) -> Place:
    return Place(folder, "a test", owner, written)


def files(*places: Place) -> KernelFiles:
    return KernelFiles(places)


def test_what_is_saved_is_loaded_whole_or_not_at_all(tmp_path: Path) -> None:
    store = files(place(tmp_path / "here"))
    assert store.load("k-1") is None
    store.save("k-1", b"code")
    assert store.load("k-1") == b"code"
    assert (store.holds("k-"), store.holds("l-")) == (True, False)
    (item,) = kernel_files.items(tmp_path / "here")
    whole = item.read_bytes()
    for spoilt in (whole[:-1], whole[:-1] + b"x", b"", whole[:20]):
        item.write_bytes(spoilt)
        assert store.load("k-1") is None, spoilt
    assert [path.name for path in (tmp_path / "here").iterdir()] == [item.name]


def test_the_first_place_that_can_be_written_takes_it(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    asked = place(tmp_path / "file" / "below")
    shared = place(tmp_path / "shared", written=False)
    own, later = place(tmp_path / "own"), place(tmp_path / "later")
    store = files(asked, shared, own, later)
    assert store.writable() == own
    store.save("k", b"1")
    assert [len(kernel_files.items(each.folder)) for each in store.places] == [0, 0, 1, 0]
    kernel_files.put(shared.folder, "k", b"of everyone")
    assert store.load("k") == b"of everyone"
    assert str(tmp_path / "file" / "below") in store.told()


def test_nowhere_to_keep_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    store = files(place(tmp_path / "file" / "below"))
    for name in "ab":
        store.save(name, b"code")
    assert store.load("a") is None
    (told,) = [record.getMessage() for record in caplog.records]
    assert "FLEXDT_CACHE" in told
    assert str(tmp_path / "file" / "below") in told


@posix
@pytest.mark.parametrize(
    ("owner", "mode", "used"),
    [
        (Owner.TRUSTED, 0o755, True),
        (Owner.TRUSTED, 0o775, True),
        (Owner.TRUSTED, 0o777, False),
        (Owner.TRUSTED, 0o1777, False),
        (Owner.ANYBODY, 0o777, False),
        (Owner.USER, 0o700, True),
        (Owner.USER, 0o750, False),
        (Owner.USER, 0o701, False),
    ],
)
def test_a_folder_that_others_may_write_is_left_alone(
    tmp_path: Path, owner: Owner, mode: int, used: bool
) -> None:
    kernel_files.put(tmp_path / "kept", "k", b"code")
    (tmp_path / "kept").chmod(mode)
    store = files(place(tmp_path / "kept", owner), place(tmp_path / "next"))
    assert (store.load("k") is not None) == used
    store.save("other", b"1")
    assert (tmp_path / "next").exists() != used


@posix
@pytest.mark.skipif(os.getuid() != 0, reason="needs root, to give files away")
@pytest.mark.parametrize(
    ("owner", "used"),
    [(Owner.ANYBODY, True), (Owner.TRUSTED, False), (Owner.USER, False)],
)
def test_code_of_another_user_runs_only_where_somebody_said_so(
    tmp_path: Path, owner: Owner, used: bool
) -> None:
    kernel_files.put(tmp_path / "kept", "k", b"code", private=True)
    os.chown(tmp_path / "kept", 54321, 54321)
    assert (files(place(tmp_path / "kept", owner)).load("k") is not None) == used


@posix
def test_a_private_folder_is_no_link(tmp_path: Path) -> None:
    kernel_files.put(tmp_path / "real", "k", b"code", private=True)
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert files(place(tmp_path / "link", Owner.USER)).load("k") is None


def test_places_in_their_order(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    told = {"FLEXDT_CACHE": str(tmp_path / "a"), "NUMBA_CACHE_DIR": str(tmp_path / "b")}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "c"))
    found = [each.folder for each in kernel_files.places(told)]
    assert found[:3] == [tmp_path / "a", tmp_path / "b", kernel_files.shared_folder()]
    assert [each.folder for each in kernel_files.places({})] == found[2:]


def test_old_kernels_go_when_a_new_one_comes(tmp_path: Path) -> None:
    for name in ("old", "new"):
        kernel_files.put(tmp_path, name, b"code")
    old = tmp_path / f"old{kernel_files.ENDING}"
    os.utime(old, (0, 0))
    files(place(tmp_path)).save("newest", b"code")
    assert {path.stem for path in kernel_files.items(tmp_path)} == {"new", "newest"}


def test_kernels_are_published_and_cleared(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "prefix"))
    monkeypatch.setenv("FLEXDT_CACHE", str(tmp_path / "own"))
    for name in ("NUMBA_CACHE_DIR", "HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "prefix").mkdir()
    kernel_files.put(tmp_path / "own", "k", b"code")
    shared = kernel_files.publish()
    assert files(place(shared)).load("k") == b"code"
    if hasattr(os, "getuid"):
        assert kernel_files.items(shared)[0].stat().st_mode & 0o444 == 0o444
    assert set(kernel_files.clear(kernel_files.places())) == {tmp_path / "own", shared}
    assert (tmp_path / "own").exists() is shared.exists() is False


@pytest.mark.parametrize(
    ("first", "second", "kept"),
    [
        ("x * x", "x * x", 1),
        ("x * x", "x * x + 0", 0),
        ("x * x", "x * x  # as before, in other words", 0),
    ],
)
def test_code_is_kept_for_other_processes_under_its_source(
    tmp_path: Path, first: str, second: str, kept: int
) -> None:
    """Loaded from wherever the module lies, and never after its text has changed."""
    hits = []
    for number, expression in enumerate((first, second)):
        folder = tmp_path / f"module{number}"
        folder.mkdir()
        (folder / "squares.py").write_text(
            "from flexdt.twin.projection.kernels.compiling import serial\n\n"
            f"@serial\ndef square(x):\n    return {expression}\n"
        )
        done = subprocess.run(
            [sys.executable, "-c", SQUARE.format(folder=str(folder))],
            env=os.environ | {"FLEXDT_CACHE": str(tmp_path / "cache")},
            capture_output=True,
            text=True,
            check=True,
        )
        result, hit = done.stdout.split()
        assert result == "9"
        hits.append(int(hit))
    assert hits == [0, kept]


def test_options_are_part_of_the_name() -> None:
    def half(x: float) -> float:
        return x / 2.0

    names = {
        compiling.serial(half, **options)._cache.beginning
        for options in ({}, {"error_model": "numpy"}, {"fastmath": {"nsz", "contract"}})
    }
    assert len(names) == 3


def test_a_kernel_without_a_source_file_is_compiled_and_not_kept() -> None:
    """As in a notebook's cell, whose file is not there."""
    scope: dict[str, Any] = {}
    exec(compile("def third(x):\n    return x / 3.0", "<cell 7>", "exec"), scope)
    third = compiling.serial(scope["third"])
    assert third(6.0) == 2.0
    assert not third._cache.is_kept()
