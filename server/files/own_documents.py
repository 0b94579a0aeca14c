"""Documents of ours: written whole and safe from a power cut, read with nothing taken on trust.

Any name becomes one plain path component. A document that is damaged (not JSON, numbers that are
not finite, absurd values: whatever its reader does not accept) is set aside, as `x.unreadable.json`
for `x.json`, with one line in the log, and whoever reads it does without.
"""

from __future__ import annotations

import json
import logging
import math
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from flexdt.protocol.fields import MAX_STEM, encoded
from flexdt.server.files.atomic import TEMPORARY, AtomicFolder, writing
from flexdt.server.runtime.log import log
from flexdt.twin.dataset.dataset_errors import DatasetWriteError
from flexdt.twin.errors import LimitError

T = TypeVar("T")
ASIDE = ".unreadable"
"""Goes before the suffix of a file that is set aside; no name of ours has two dots."""
BEFORE = ".before-"
"""Begins the name under which what a change replaces is kept until the change has been made."""


def file_stem(name: str) -> str:
    """`name`, percent-encoded, as the stem of a file; different names give different stems.

    Raises:
        LimitError: it is too long for a file system.
    """
    stem = encoded(name)
    if len(stem) > MAX_STEM:
        raise LimitError(
            f"the name {name[:40]!r}... is too long: {len(stem)} bytes encoded, {MAX_STEM} allowed",
            {"asked": len(stem), "allowed": MAX_STEM},
        )
    return stem


def used_bytes(root: Path) -> int:
    """Bytes of all files in a directory and its folders; links are not followed."""
    total, left = 0, [root]
    while left:
        with suppress(OSError), os.scandir(left.pop()) as entries:  # a job may rename meanwhile
            for e in entries:
                if e.is_dir(follow_symlinks=False):
                    left.append(Path(e.path))
                else:
                    total += e.stat(follow_symlinks=False).st_size
    return total


def make(folder: Path) -> None:
    """Make a folder of ours if it is missing, safe when this returns.

    Raises:
        DatasetWriteError: the system refuses.
    """
    if folder.is_dir():
        return
    with writing(folder, f"cannot make {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
    with AtomicFolder(folder.parent) as parent:
        parent.sync()


def put_file(folder: Path, name: str, data: bytes) -> None:
    """Write `folder`/`name`, whole or not at all; the folder is made if missing.

    It is safe when this returns: a power cut does not lose it.

    Raises:
        DatasetWriteError: the system refuses.
    """
    make(folder)
    with AtomicFolder(folder) as files:
        files.put(name, data)
        files.sync()


class Changes:
    """Files written one after the other, which can all be as they were before.

    What a file replaces stays beside it under another name until `done` or `undo`, so that undoing
    takes no room: a full disk is what it is most often needed for. `with Changes() as changes:`
    undoes them where the block raises.
    """

    def __init__(self) -> None:
        self._made: list[tuple[Path, Path | None, bytes]] = []

    def put(self, folder: Path, name: str, data: bytes) -> None:
        """Write a file, as `put_file`."""
        file = folder / name
        before = folder / f"{BEFORE}{os.getpid()}-{threading.get_native_id()}-{len(self._made)}"
        self._made.append((file, before if _second_name(file, before) else None, data))
        put_file(folder, name, data)

    def put_json(self, folder: Path, name: str, document: object) -> None:
        """Write a JSON document, as `put_file`."""
        data = json.dumps(document, indent=1, allow_nan=False).encode("utf-8")
        self.put(folder, name, data)

    def __enter__(self) -> Changes:
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        if error is None:
            self.done()
        else:
            self.undo()

    def done(self) -> None:
        """Keep what was written."""
        for _, before, _ in self._made:
            if before is not None:
                with suppress(OSError):
                    before.unlink()
        self._made.clear()

    def undo(self) -> None:
        """Everything as it was, but for what others have written since; trouble is logged."""
        for file, before, data in reversed(self._made):
            try:
                if file.read_bytes() != data:
                    continue
                if before is None:
                    file.unlink()
                else:
                    os.replace(before, file)
                with AtomicFolder(file.parent) as folder:
                    folder.sync()
            except FileNotFoundError:
                continue
            except (OSError, DatasetWriteError) as error:
                log("a change that was not made is still on the disk", logging.ERROR,
                    file=str(file), reason=str(error))  # fmt: skip
        self.done()


def _second_name(file: Path, name: Path) -> bool:
    """Give a file a second name; False where there is no file.

    Raises:
        DatasetWriteError: the system refuses.
    """
    with writing(file, f"cannot write {file}"):
        with suppress(FileNotFoundError):
            os.unlink(name)  # of a killed writer with the same numbers, as in a container
        try:
            os.link(file, name)
        except OSError:
            if not file.exists():
                return False
            put_file(name.parent, name.name, file.read_bytes())  # a file system without links
    return True


def read_json(data: bytes) -> object:
    """What a JSON document says, if all its numbers are finite and all its texts are text.

    Raises:
        ValueError: it is no such document.
    """
    document = json.loads(data.decode("utf-8"), parse_float=_finite, parse_constant=_finite)
    json.dumps(document, ensure_ascii=False).encode("utf-8")  # an escaped lone surrogate is no text
    return document


def read_or_set_aside(file: Path, read: Callable[[bytes], T], without: str) -> T | None:
    """What `read` makes of one of our files; None where there is none.

    Args:
        file: where it is.
        read: takes its bytes; whatever it raises means damage.
        without: what the twin does without it, for the log.
    """
    try:
        return read(file.read_bytes())
    except FileNotFoundError:
        return None
    except Exception as error:  # a flipped bit may trip over anything
        set_aside(file, error, without)
        return None


def set_aside(file: Path, error: object, without: str) -> None:
    """Keep a damaged file under another name, and say so in one line."""
    aside = file.with_name(f"{file.stem}{ASIDE}{file.suffix}")
    try:
        file.replace(aside)
        kept = aside.name
    except OSError as refused:
        kept = f"not set aside: {refused.strerror}"
    log(without, logging.ERROR, file=str(file), kept=kept, reason=str(error)[:500])


def ours(folder: Path) -> list[Path]:
    """The JSON documents in a folder, but for what was set aside."""
    return [f for f in sorted(folder.glob("*.json")) if not f.stem.endswith(ASIDE)]


def sweep(folder: Path, left: Sequence[str] = (TEMPORARY, BEFORE)) -> None:
    """Delete what killed writers left behind in a folder of ours: names that begin with `left`."""
    for beginning in left:
        for file in folder.glob(f"{beginning}*"):
            with suppress(OSError):
                file.unlink()


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no finite number")
    return value
