"""Samples to be uploaded: mesh, voxels or scene as a header and bytes, divided into chunks; and the
shape of the one on the stage, which comes in chunks, too.

The content of a mesh is read by the server only. A scene file is read here, because the meshes
that it names lie beside it; what is sent stands for itself.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.clients.client.flows import Flow, ask
from flexdt.protocol.methods import sample_messages as stage

if TYPE_CHECKING:
    from flexdt.phantoms import Phantom

CHUNK: Final = 4 * 2**20
"""Bytes in one message of an upload: below a frame, also as base64."""

SCENE_FORMATS: Final = ("toml", "json")
MESH_FORMATS: Final = ("stl", "obj", "ply", "glb", "off")


@dataclass(frozen=True)
class Upload:
    """An upload: `head` is sent with every chunk of `data`."""

    head: Mapping[str, object]
    data: bytes

    def __post_init__(self) -> None:
        if not self.data:
            raise ValueError(f"nothing to upload as {self.head['name']!r}: the data are empty")

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
    """A mesh from a file or from bytes; name and format default to the file's.

    Raises:
        ValueError: no name, no format, or an empty mesh.
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
    return Upload(head, data)


def scene(source: str | Path | Phantom, name: str | None) -> Upload:
    """A phantom, or the file of a phantom or scene; the name defaults to the phantom's or file's.

    Raises:
        PhantomError: the file does not hold.
    """
    from flexdt.phantoms import Phantom
    from flexdt.phantoms.files.phantom_files import read_phantom_file

    if isinstance(source, Phantom):
        phantom, name = source, source.name if name is None else name
    else:
        path = Path(source)
        phantom, name = read_phantom_file(path), path.stem if name is None else name
    head = {"name": name, "kind": "scene", "format": "json"}
    return Upload(head, json.dumps(phantom.to_dict()).encode())


def voxels(
    data: npt.NDArray[np.floating[Any]],
    voxel_mm: float | tuple[float, float, float],
    name: str,
    material: str | None,
) -> Upload:
    """Voxels [z, y, x] of attenuation [1/mm].

    Raises:
        ValueError: `data` is empty.
    """
    size = (voxel_mm,) * 3 if isinstance(voxel_mm, (int, float)) else voxel_mm
    raw = np.ascontiguousarray(data, dtype="<f4")
    head: dict[str, object] = {
        "name": name, "kind": "voxels", "format": "raw", "material": material,
        "shape": list(raw.shape), "voxel_mm": [float(v) for v in size],
    }  # fmt: skip
    return Upload(head, raw.tobytes())


def sample_shape() -> Flow[stage.SampleMeshResult]:
    """The mesh of the sample on the stage, with the name and the revision that it is of."""
    while True:
        content, first = b"", None
        while first is None or len(content) < first.total:
            part = yield from ask(stage.SAMPLE_MESH, start=len(content))
            first = part if first is None else first
            if (part.name, part.revision, part.total) != (first.name, first.revision, first.total):
                break  # another sample is on the stage by now: start again
            content += part.data
        else:
            return first.model_copy(update={"data": content})
