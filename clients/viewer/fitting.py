"""Calibrations for the page: `flexdt calibrate --json` as a process of its own, on named data sets.

One fit runs at a time. Data sets are those of the data directory; a phantom is one that ships with
the package, or a TOML or JSON file that lies in that directory itself; every other path is an
error. The user applies the result in a separate request.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Final

from flexdt.phantoms import phantom_names
from flexdt.protocol import Code, RpcError
from flexdt.protocol.rpc_errors import busy
from flexdt.twin.dataset import plain_name
from flexdt.twin.dataset.dataset_errors import DatasetError

LIMIT_S: Final = 900.0
MOST: Final = 100
BEADS: Final = re.compile(r"([a-z]+)-[1-9][0-9]{0,3}")
FILES: Final = (".toml", ".json")


def datasets(folder: Path) -> list[dict[str, object]]:
    """Folders of `folder` that hold projections, newest first."""
    found = []
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.is_dir() and not path.is_symlink():
            frames = sum(1 for f in path.glob("scan_*.tif"))
            if frames:
                found.append((path.stat().st_mtime, path.name, frames))
    return [{"name": n, "frames": k} for _, n, k in sorted(found, reverse=True)[:MOST]]


class Fitter:
    """Runs the command, for one page at a time: a fit takes all the cores there are."""

    def __init__(self) -> None:
        self.busy = False

    async def calibrate(
        self, folder: Path, names: list[str], phantom: str
    ) -> tuple[dict[str, object], dict[str, object]]:
        """Run the command; its document, and the beads of every frame.

        Raises:
            RpcError: unknown names, another fit is under way, or the command's own complaint.
        """
        known = {str(d["name"]) for d in await asyncio.to_thread(datasets, folder)}
        if not names or not set(names) <= known:
            raise RpcError(Code.INVALID_PARAMS, "choose data sets of the list", sorted(known))
        word = phantom_word(folder, phantom)
        if self.busy:
            raise busy("another calibration is under way; try again when it is done")
        self.busy = True
        try:
            with tempfile.TemporaryDirectory(prefix="flexdt-fit-") as scratch:
                tracks = Path(scratch) / "tracks.json"
                words = [*(str((folder / n).absolute()) for n in names), "--phantom", word]
                document = await _run(scratch, *words, "--json", "--tracks", str(tracks))
                beads = json.loads(tracks.read_text(encoding="utf-8")) if tracks.exists() else {}
            return document, beads
        finally:
            self.busy = False


def phantom_word(folder: Path, phantom: str) -> str:
    """The command's `--phantom`: a shipped name, or the path of a file in `folder`.

    Raises:
        RpcError: it is neither.
    """
    shipped = phantom_names()
    if phantom in shipped or ((match := BEADS.fullmatch(phantom)) and match[1] in shipped):
        return phantom
    with contextlib.suppress(DatasetError):
        path = folder / plain_name(phantom, "phantom")
        if path.suffix in FILES and path.is_file() and not path.is_symlink():
            return str(path.absolute())
    raise RpcError(
        Code.INVALID_PARAMS,
        f"no phantom {phantom!r}: there are {', '.join(shipped)}, cuboids with K beads such as "
        "normal-3, and TOML or JSON files in the data directory",
        list(shipped),
    )


async def _run(where: str, *words: str) -> dict[str, object]:
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "flexdt.clients.cli", "calibrate", *words,
        cwd=where,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        async with asyncio.timeout(LIMIT_S):
            out, err = await process.communicate()
    except TimeoutError:
        raise RpcError(Code.INTERNAL, f"no result within {LIMIT_S:.0f} s") from None
    finally:
        if process.returncode is None:  # also when the page that asked has gone
            process.kill()
            await process.wait()
    try:
        document = json.loads(out)
    except ValueError:
        text = err.decode(errors="replace").strip() or f"exit code {process.returncode}"
        raise RpcError(Code.NOT_IDENTIFIABLE, text) from None
    return dict(document)
