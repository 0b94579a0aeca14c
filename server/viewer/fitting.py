"""Calibrations for the page: `flexdt calibrate --json` as a process of its own, on named data sets.

Names never leave the data directory. It refuses to fit anything itself and to apply a result.
"""

from __future__ import annotations

import asyncio
import json
import sys
import tempfile
from pathlib import Path
from typing import Final

from flexdt.protocol import Code, RpcError

LIMIT_S: Final = 900.0
MOST: Final = 100


def datasets(folder: Path) -> list[dict[str, object]]:
    """Folders of `folder` that hold projections, newest first."""
    found = []
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.is_dir() and not path.is_symlink():
            frames = sum(1 for f in path.glob("scan_*.tif"))
            if frames:
                found.append((path.stat().st_mtime, path.name, frames))
    return [{"name": n, "frames": k} for _, n, k in sorted(found, reverse=True)[:MOST]]


async def calibrate(
    folder: Path, names: list[str], phantom: str
) -> tuple[dict[str, object], dict[str, object]]:
    """Run the command; its document, and the beads of every frame.

    Raises:
        RpcError: unknown names, or the command's own complaint.
    """
    known = {str(d["name"]) for d in datasets(folder)}
    if not names or not set(names) <= known:
        raise RpcError(Code.INVALID_PARAMS, "choose data sets of the list", sorted(known))
    if not phantom or phantom.startswith("-"):
        raise RpcError(Code.INVALID_PARAMS, f"{phantom!r} is no phantom")
    with tempfile.TemporaryDirectory(prefix="flexdt-fit-") as scratch:
        tracks = Path(scratch) / "tracks.json"
        words = [*(str((folder / n).absolute()) for n in names), "--phantom", phantom]
        document = await _run(*words, "--json", "--tracks", str(tracks))
        beads = json.loads(tracks.read_text(encoding="utf-8")) if tracks.exists() else {}
    return document, beads


async def _run(*words: str) -> dict[str, object]:
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "flexdt.clients.cli", "calibrate", *words,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        async with asyncio.timeout(LIMIT_S):
            out, err = await process.communicate()
    except (TimeoutError, asyncio.CancelledError):
        process.kill()
        await process.wait()
        raise RpcError(Code.INTERNAL, f"no result within {LIMIT_S:.0f} s") from None
    try:
        document = json.loads(out)
    except ValueError:
        text = err.decode(errors="replace").strip() or f"exit code {process.returncode}"
        raise RpcError(Code.NOT_IDENTIFIABLE, text) from None
    return dict(document)
