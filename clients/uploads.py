"""Samples to be uploaded: a mesh or voxels as a header and bytes, and the chunks they go in.

It refuses to send anything (see `client`) and to read what a mesh holds: the server does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

CHUNK: Final = 4 * 2**20
"""Bytes a message of an upload: below a frame, also as base64."""

MESH_FORMATS: Final = ("stl", "obj", "ply", "glb", "off")


@dataclass(frozen=True)
class Upload:
    """What to send: `head` goes with every chunk of `data`."""

    head: Mapping[str, object]
    data: bytes

    def chunks(self) -> Iterator[dict[str, object]]:
        """Parameters of `sample.upload`, chunk by chunk."""
        for start in range(0, len(self.data), CHUNK):
            part = self.data[start : start + CHUNK]
            yield {**self.head, "total": len(self.data), "start": start, "data": part}


def mesh(
    source: str | Path | bytes,
    name: str | None,
    format: str | None,
    unit: str | None,
    material: str | None,
) -> Upload:
    """A mesh from a file or from bytes; a file gives name and format where they are left out.

    Raises:
        ValueError: no name, no format, or nothing in it.
        OSError: the file cannot be read.
    """
    if isinstance(source, bytes):
        data = source
    else:
        path = Path(source)
        data = path.read_bytes()
        name = path.stem if name is None else name
        format = path.suffix.lower().lstrip(".") if format is None else format
    if name is None or format not in MESH_FORMATS:
        raise ValueError(
            f"a mesh needs a name and a format of {', '.join(MESH_FORMATS)}; "
            f"got name {name!r}, format {format!r}"
        )
    head = {"name": name, "kind": "mesh", "format": format, "unit": unit, "material": material}
    return _filled(Upload(head, data))


def voxels(
    data: npt.NDArray[np.floating[Any]],
    voxel_mm: float | tuple[float, float, float],
    name: str,
    material: str | None,
) -> Upload:
    """Voxels [z, y, x] of attenuation [1/mm].

    Raises:
        ValueError: nothing in it.
    """
    size = (voxel_mm,) * 3 if isinstance(voxel_mm, (int, float)) else voxel_mm
    raw = np.ascontiguousarray(data, dtype="<f4")
    head: dict[str, object] = {
        "name": name, "kind": "voxels", "format": "raw", "material": material,
        "shape": list(raw.shape), "voxel_mm": [float(v) for v in size],
    }  # fmt: skip
    return _filled(Upload(head, raw.tobytes()))


def _filled(upload: Upload) -> Upload:
    if not upload.data:
        raise ValueError(f"nothing to upload as {upload.head['name']!r}: the data are empty")
    return upload
