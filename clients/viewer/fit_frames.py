"""Radiographs of a fitted data set, one frame at a time, with the bead spots before and after.

Images are read from the data set as it was written; spots are the fit's own (`flexdt calibrate
--tracks`). Paths outside the data directory are an error.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.clients.viewer.feed import Radiograph, window_of
from flexdt.protocol import Code, RpcError
from flexdt.twin.dataset import parse_document, plain_name
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.dataset.normalise import LineIntegrals
from flexdt.twin.geometry.conventions import Float32Array


def summary(tracks: Mapping[str, Any]) -> list[dict[str, object]]:
    """What a page needs to offer the comparison: data sets, frames, residuals."""
    return [
        {
            "dataset": scan["dataset"],
            "before": scan["before"],
            "frames": len(scan["frames"]),
            "rms_before_px": scan["rms_before_px"],
            "rms_after_px": scan["rms_after_px"],
        }
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
        home = folder / plain_name(Path(scans[dataset]["folder"]).name, "data set")
        counts = _read(home / plain_name(entry["file"]))
        image = _normalisation(home)(counts)
    except (DatasetError, OSError, ValueError) as error:
        raise RpcError(Code.INVALID_PARAMS, f"{entry['file']} cannot be shown: {error}") from None
    low, high = window_of(Radiograph(image, "line_integral", (), 0.0, 0))
    grey = np.clip((image - low) * (255.0 / (high - low)), 0.0, 255.0).astype(np.uint8)
    return {
        **entry,
        "shape": list(image.shape),
        "pixels": base64.b64encode(grey.tobytes()).decode("ascii"),
    }


def _normalisation(home: Path) -> LineIntegrals:
    document = parse_document((home / "flexdt.json").read_text(encoding="utf-8"), str(home))
    dark, flat = (
        _mean([home / name for name in document.files(kind)]) for kind in ("dark", "flat")
    )
    if flat is None:
        raise ValueError("the data set has no flat image")
    return LineIntegrals.of(np.zeros_like(flat) if dark is None else dark, flat)


def _mean(files: Sequence[Path]) -> Float32Array | None:
    there = [_read(f).astype(np.float32) for f in files if f.is_file()]
    if not there:
        return None
    mean: Float32Array = np.mean(there, axis=0)
    return mean


def _read(path: Path) -> npt.NDArray[np.generic]:
    import tifffile

    if path.is_symlink():
        raise ValueError("it is a link")
    return np.asarray(tifffile.imread(path))
