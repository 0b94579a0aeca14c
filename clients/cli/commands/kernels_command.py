"""`flexdt kernels`: compiled kernels, made and kept ahead of their use."""

from __future__ import annotations

from pathlib import Path

from flexdt.clients.cli.console import note
from flexdt.clients.cli.options import Answer


def compile() -> Answer:
    """Compile what is missing, and say where compiled kernels are kept.

    Yields:
        As `_described`.
    """
    from flexdt.runtime import compile_ahead, kernel_files
    from flexdt.twin.errors import TwinError

    compile_ahead.compile_ahead(list(compile_ahead.GROUPS), note)
    folder = kernel_files.kept_in()
    if folder is None:
        raise TwinError(
            "compiled kernels cannot be kept: no folder can be written; set FLEXDT_CACHE to one"
        )
    yield from _described(folder)


def share() -> Answer:
    """Compile what is missing, and keep it in this installation, for all its users.

    Yields:
        As `_described`.
    """
    from flexdt.runtime import compile_ahead, kernel_files

    compile_ahead.compile_ahead(list(compile_ahead.GROUPS), note)
    yield from _described(kernel_files.publish())


def delete() -> Answer:
    """Delete all compiled kernels that this user may delete.

    Yields:
        The document of --json and a line with the folders.
    """
    from flexdt.runtime import kernel_files

    deleted = kernel_files.clear(kernel_files.places())
    yield {"deleted": [str(folder) for folder in deleted]}
    if deleted:
        yield f"Deleted the kernels in {', '.join(map(str, deleted))}."
    else:
        yield "No compiled kernels are kept."


def _described(folder: Path) -> Answer:
    """Yield the document of --json, and a line with folder, number and size of its kernels."""
    from flexdt.runtime import kernel_files

    kept = kernel_files.items(folder)
    size_bytes = sum(path.stat().st_size for path in kept)
    yield {"folder": str(folder), "kernels": len(kept), "bytes": size_bytes}
    yield f"{len(kept)} compiled kernels ({size_bytes / 1e6:.1f} MB) in {folder}"
