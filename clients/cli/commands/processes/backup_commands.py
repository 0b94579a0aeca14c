"""`flexdt backup`, `flexdt restore`: a data directory into an archive, and back."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexdt.clients.cli import options
from flexdt.clients.cli.console import emit, note, say, size

Archive = Annotated[Path, typer.Argument(metavar="ARCHIVE.tar")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="A data directory.")]


def backup(directory: Folder, archive: Archive, json: options.Json = False) -> None:
    """Copy a data directory into a tar file with checksums; a twin may run meanwhile."""
    from flexdt.clients.backup import back_up

    copied = back_up(directory, archive)
    for path in copied.left_out:
        note(f"{directory / path}: warning: no plain file, left out")
    if json:
        emit({"archive": str(archive), "files": len(copied.files), "bytes": copied.bytes,
              "left_out": copied.left_out})  # fmt: skip
    else:
        say(f"{archive}: {len(copied.files)} files, {size(copied.bytes)}")


def restore(archive: Archive, directory: Folder, json: options.Json = False) -> None:
    """Unpack a backup into a folder that is empty or does not exist; all of it or nothing."""
    from flexdt.clients.backup import restore

    copied = restore(archive, directory)
    if json:
        emit({"directory": str(directory), "files": len(copied.files), "bytes": copied.bytes})
    else:
        say(f"{directory}: {len(copied.files)} files, {size(copied.bytes)}, checksums right")
