"""Scan files: in TOML, what `read_tiffs` is told in words, so that commands may be told it too."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

from flexdt.library.datasets.exchange import load_stated
from flexdt.library.datasets.image_sources import hdf5_place, named_paths
from flexdt.library.datasets.scan_options import ScanOptions
from flexdt.runtime.files.dataset_folder import read_text
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.errors import nearest_name
from flexdt.twin.exchange.geometry import ScanGeometry
from flexdt.twin.input_limits import LIMITS, parse_toml

ENDING: Final = ".toml"
OWN: Final = ("images", "geometry", "frames", "pixel", "shape")
"""Keys beside those of `ScanOptions`."""
KEYS: Final = (*OWN, *ScanOptions.__annotations__)
PATHS: Final = ("dark", "flat", "open_beam", "angles")
"""Options whose texts may be paths."""


@dataclass(frozen=True)
class ScanFile:
    """What a scan file says.

    Attributes:
        images: folder or file of the images, or FILE.h5:/PATH.
        geometry: of the views.
        frames: pattern of the projections' names; None for all.
        options: the others.
    """

    images: str
    geometry: ScanGeometry
    frames: str | None
    options: ScanOptions


def is_scan_file(path: Path) -> bool:
    """Return whether a file is a TOML that names images."""
    if path.suffix.lower() != ENDING or not path.is_file():
        return False
    try:
        return "images" in parse_toml(read_text(path, LIMITS["toml"].file_bytes), "")
    except ValueError:
        return True  # its error names line and column


def scan_file(path: Path) -> ScanFile:
    """Read a scan file; its paths are counted from its own folder.

    Raises:
        DatasetFormatError: it is no TOML, lacks `images` or `geometry`, or has another key.
        TwinError: the geometry cannot be read.
    """
    try:
        said = parse_toml(read_text(path, LIMITS["toml"].file_bytes), str(path))
    except ValueError as error:  # its words name line and column
        raise DatasetFormatError(f"{path} is not valid TOML: {error}") from None
    for key in said:
        if key not in KEYS:
            near = nearest_name(key, list(KEYS))
            hint = "" if near is None else f", did you mean {near}?"
            raise DatasetFormatError.instead(
                f"{path}: {key} is not known{hint}", key, ", ".join(KEYS)
            )
    for key in ("images", "geometry"):
        if not isinstance(said.get(key), str):
            raise DatasetFormatError(
                f'{path}: {key} is missing; allowed: {key} = "PATH"', {"missing": [key]}
            )
    at = path.parent
    geometry = load_stated(
        at / said["geometry"],
        shape=_pair(said.get("shape"), path, "shape"),
        pixel=said.get("pixel"),
    )
    options = {
        key: _placed(said[key], at) if key in PATHS else said[key]
        for key in ScanOptions.__annotations__
        if key in said
    }
    return ScanFile(
        str(at / said["images"]), geometry, said.get("frames"), cast(ScanOptions, options)
    )


def _pair(value: Any, path: Path, key: str) -> tuple[int, int] | None:
    """Return two whole numbers of a list, or None."""
    if value is None:
        return None
    if not isinstance(value, list) or [type(n) for n in value] != [int, int]:
        raise DatasetFormatError.instead(
            f"{path}: {key} is {value!r}", str(value), "[ROWS, COLUMNS]"
        )
    return value[0], value[1]


def _placed(value: Any, at: Path) -> Any:
    """Return a text that names files beside the scan file as their path; others as they are,
    such as patterns of names among the images."""
    if isinstance(value, list):
        return [_placed(one, at) for one in value]
    if isinstance(value, str) and value:
        beside = str(at / value)
        if hdf5_place(beside) is not None or named_paths(beside, None):
            return beside
    return value
