"""Calibrations for the page: `flexdt calibrate --json` as a process of its own, on named data sets.

One fit runs at a time. Data sets are those of the data directory; a phantom is one that ships with
the package, or a TOML or JSON file that lies in that directory itself; every other path is an
error. The user applies the result in a separate request.

Then the page leafs through the radiographs with the bead spots before and after: images are those
of the data set, spots the fit's own (`flexdt calibrate --tracks`). Paths outside the data directory
are an error.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from flexdt.clients.datasets.dataset import load_dataset
from flexdt.clients.viewer.feed import ShownImage, base64_grey, window_of
from flexdt.phantoms import is_shipped, phantom_names
from flexdt.protocol import Code, RpcError
from flexdt.protocol.rpc_errors import busy
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.dataset.file_names import plain_name

LIMIT_S: Final = 900.0
FILES: Final = (".toml", ".json")


def datasets(folder: Path) -> set[str]:
    """Names of the folders of `folder` that hold projections."""
    return {
        path.name
        for path in (folder.iterdir() if folder.is_dir() else ())
        if path.is_dir() and not path.is_symlink() and any(path.glob("scan_*.tif"))
    }


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
        known = await asyncio.to_thread(datasets, folder)
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
    if is_shipped(phantom):
        return phantom
    shipped = phantom_names()
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


def summary(tracks: Mapping[str, Any]) -> list[dict[str, object]]:
    """What a page needs to offer the comparison: data sets, frames, residuals."""
    facts = ("dataset", "before", "rms_before_px", "rms_after_px")
    return [
        {name: scan[name] for name in facts} | {"frames": len(scan["frames"])}
        for scan in tracks.get("datasets", ())
    ]


def view(folder: Path, tracks: Mapping[str, Any], dataset: int, frame: int) -> dict[str, object]:
    """One radiograph as 8-bit grey, and where its beads are and were put.

    Args:
        folder: the twin's data directory.
        tracks: the fit's tracks.
        dataset, frame: which of them.

    Raises:
        RpcError: there is no such frame, or its file cannot be read.
    """
    scans: Sequence[Any] = tracks.get("datasets", ())
    if not 0 <= dataset < len(scans) or not 0 <= frame < len(scans[dataset]["frames"]):
        allowed = [len(scan["frames"]) for scan in scans]
        raise RpcError(Code.INVALID_PARAMS, f"no frame {frame} of data set {dataset}", allowed)
    entry = scans[dataset]["frames"][frame]
    try:
        data = load_dataset(folder / plain_name(Path(scans[dataset]["folder"]).name, "data set"))
        if any(
            p is not None and p.is_symlink()
            for p in (data.frames[frame].path, *data.darks, *data.flats)
        ):
            raise ValueError("there is a link among the images")
        image = data.line_integrals(frame)
    except (DatasetError, OSError, ValueError) as error:
        raise RpcError(Code.INVALID_PARAMS, f"{entry['file']} cannot be shown: {error}") from None
    window = window_of(ShownImage(image, "line_integral", (), 0.0, 0))
    return {**entry, "shape": list(image.shape), "pixels": base64_grey(image, window)}
