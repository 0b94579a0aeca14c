"""Any name as one plain path component, and documents that appear whole.

It refuses to choose folders.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path

from flexdt.protocol.fields import MAX_STEM, encoded
from flexdt.server.atomic import AtomicFolder
from flexdt.twin.errors import LimitError


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


def put_file(folder: Path, name: str, data: bytes) -> None:
    """Write `folder`/`name`, whole or not at all; the folder is made if missing.

    Raises:
        DatasetWriteError: the system refuses.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with AtomicFolder(folder) as files:
        files.put(name, data)


def put_json(folder: Path, name: str, document: object) -> None:
    """Write a JSON document, as `put_file`."""
    put_file(folder, name, json.dumps(document, indent=1).encode("utf-8"))
