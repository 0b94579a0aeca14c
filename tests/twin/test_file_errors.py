"""What an `except OSError` anywhere gets of flexdt's own errors of files, and of libraries'."""

from __future__ import annotations

import errno
import importlib
import re
from pathlib import Path

import pytest

import flexdt as fx
from flexdt.message_words import reason_of
from flexdt.twin.dataset.dataset_errors import DatasetMissingError
from flexdt.twin.errors import FileError, MissingFileError

ROOT = Path(__file__).parents[2]
OWN = {"flexdt/message_words.py", "twin/errors.py"}
"""The two modules that know of the system's words."""
FOLDERS = ("twin", "protocol", "runtime", "server", "clients", "flexdt", "phantoms",
           "extensions/flexdt_extensions")  # fmt: skip


def kinds(of: type[FileError]) -> list[type[FileError]]:
    return [of, *(kind for sub in of.__subclasses__() for kind in kinds(sub))]


def test_every_error_of_a_file_has_words_and_a_missing_one_its_number() -> None:
    importlib.import_module("flexdt.twin.dataset.dataset_errors")
    assert DatasetMissingError in kinds(FileError)
    for kind in kinds(FileError):
        error = kind("no scan.json", {"asked": "scan.json"})
        assert reason_of(error) == error.strerror == str(error) == "no scan.json"
        assert (error.errno == errno.ENOENT) == isinstance(error, FileNotFoundError)


def test_the_systems_words_stay() -> None:
    error = FileError.of(PermissionError(13, "Permission denied", "a.tif"))
    assert (error.errno, error.strerror) == (13, "Permission denied")
    assert reason_of(error) == "Permission denied"
    assert isinstance(
        FileError.of(FileNotFoundError(2, "No such file", "a")), MissingFileError
    )
    assert "None" not in str(FileError.of(OSError("bad signature")))


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(28, "No space left on device", "a.tif"), "No space left on device"),
        (OSError("Unable to open\nmore"), "Unable to open"),
        (OSError(), "OSError"),
        (TimeoutError(), "TimeoutError"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "no"), "not UTF-8"),
    ],
)
def test_a_reason_is_never_none(error: Exception, said: str) -> None:
    assert reason_of(error, "not UTF-8" if isinstance(error, ValueError) else "") == said


def test_nobody_reads_the_systems_words_past_the_helper() -> None:
    """They are None of errors that a library or flexdt raises: 23 messages ended in "None"."""
    direct = re.compile(r"(?<!\bos)\.strerror\b|[\"']strerror[\"']")
    found = [
        str(path.relative_to(ROOT))
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*.py")
        if direct.search(path.read_text(encoding="utf-8"))
    ]
    assert set(found) == OWN


def test_a_missing_data_set_is_an_oserror_with_words(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="scan") as caught:
        fx.open(tmp_path / "scan")
    assert caught.value.strerror
