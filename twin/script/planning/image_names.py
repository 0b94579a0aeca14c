"""The file of an image: the bare name at the end of a script's path, made safe.

Paths in scripts name files inside the data set's folder and nothing else: drives, folders and
characters that some file system does not allow are dropped.
"""

from __future__ import annotations

import re

from flexdt.twin.script.planning.plan import ImageKind

_UNSAFE = re.compile(r"[\x00-\x1f\x7f<>:\"|?*\ud800-\udfff]")
_DEVICE = re.compile(r"(?:con|prn|aux|nul|com\d|lpt\d)(?:\..*)?", re.IGNORECASE)
_SUFFIX = re.compile(r".*\.tiff?", re.IGNORECASE | re.DOTALL)
_DARK = re.compile(r"di[_-]?\d*(?:\.tiff?)?", re.IGNORECASE)
_FLAT = re.compile(r"io[_-]?\d*(?:\.tiff?)?", re.IGNORECASE)
MAX_NAME = 120


def bare_name(path: str) -> str:
    r"""The last part of `path` (after \ or /) with unsafe characters as `_`; may be empty."""
    name = re.split(r"[\\/]", path)[-1]
    name = _UNSAFE.sub("_", name).strip(" .")[:MAX_NAME]
    return f"_{name}" if _DEVICE.fullmatch(name) else name


def image_name(path: str) -> str | None:
    """File name of one image, with `.tif`; None if the path does not end with a name."""
    name = bare_name(path)
    if not name or name.lower() in ("tif", "tiff"):
        return None
    return name if _SUFFIX.fullmatch(name) else f"{name}.tif"


def sequence_names(prefix: str, first: int, count: int) -> tuple[str, ...]:
    """File names of a sequence: prefix, six digits, `.tif`."""
    name = bare_name(prefix) if not prefix.endswith(("\\", "/")) else ""
    return tuple([f"{name}{i:06d}.tif" for i in range(first, first + count)])


def kind_of(name: str) -> ImageKind:
    """What an image is for, by its name: di* dark, io* flat, everything else a projection."""
    if _DARK.fullmatch(name):
        return "dark"
    return "flat" if _FLAT.fullmatch(name) else "projection"
