"""`flexdt backup`, `flexdt restore`: a data directory into an archive, and back."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexdt.clients.cli.console import note, size
from flexdt.clients.cli.options import Answer

Archive = Annotated[Path, typer.Argument(metavar="ARCHIVE.tar")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="A data directory.")]


def backup(directory: Folder, archive: Archive) -> Answer:
    """Copy a data directory into a tar file with checksums; a twin may run meanwhile."""
    from flexdt.clients.backup import back_up

    copied = back_up(directory, archive)
    for path in copied.left_out:
        note(f"{directory / path}: warning: no plain file, left out")
    yield {"archive": str(archive), "files": len(copied.files), "bytes": copied.bytes,
           "left_out": copied.left_out}  # fmt: skip
    yield f"{archive}: {len(copied.files)} files, {size(copied.bytes)}"


def restore(archive: Archive, directory: Folder) -> Answer:
    """Unpack a backup into a folder that is empty or does not exist; all of it or nothing."""
    from flexdt.clients.backup import restore

    copied = restore(archive, directory)
    yield {"directory": str(directory), "files": len(copied.files), "bytes": copied.bytes}
    yield f"{directory}: {len(copied.files)} files, {size(copied.bytes)}, checksums right"
