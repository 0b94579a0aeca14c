"""The samples there are: shipped phantoms by name, and meshes and voxels that were uploaded.

Uploads come in chunks, in order, are bounded in size, and appear only when whole and readable; they
are kept under DATA/samples, so that a restart knows them. Names become file names by percent
encoding, so no name can leave that folder. It refuses to project: see `imaging`.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from flexdt.phantoms import (
    Phantom,
    PhantomError,
    is_shipped,
    load_phantom,
    phantom_names,
    voxel_phantom,
)
from flexdt.protocol.errors import too_large
from flexdt.server.files import file_stem, put_file, put_json
from flexdt.server.incoming import Incoming
from flexdt.server.meshes import mesh_apart
from flexdt.twin.errors import LimitError, UnknownNameError

MAX_UPLOAD_BYTES = 512 << 20
KEPT = 8
"""Parsed samples kept; meshes may be large."""
DEFAULT_MATERIAL = "abs"
EMPTY = "empty"
"""The name that clears the stage."""

Kind = Literal["mesh", "voxels"]


@dataclass(frozen=True)
class UploadHead:
    """What an upload is; every chunk repeats it.

    Attributes:
        name: it gets.
        kind: mesh or voxels.
        format: of the bytes; "raw" is float32 little-endian [z, y, x] of attenuation [1/mm].
        total: size of the whole [bytes].
        unit: of mesh coordinates.
        material: a mesh is made of; None for the default.
        shape: (z, y, x) of voxels.
        voxel_mm: (x, y, z) of voxels.
    """

    name: str
    kind: Kind
    format: str
    total: int
    unit: str = "mm"
    material: str | None = None
    shape: tuple[int, int, int] | None = None
    voxel_mm: tuple[float, float, float] | None = None


class SampleStore:
    """All samples of one data directory.

    Args:
        folder: where uploads are kept.
        limit: largest upload [bytes].
    """

    def __init__(self, folder: Path, limit: int = MAX_UPLOAD_BYTES) -> None:
        self._folder, self._limit = folder, limit
        self._incoming: Incoming[UploadHead] = Incoming(folder, 2 * limit)
        self._heads: dict[str, UploadHead] = {}
        for file in sorted(folder.glob("*.json")):
            head = _read_head(file)
            if head is not None and head.name != EMPTY and not is_shipped(head.name):
                self._heads[head.name] = head
        self._revisions: dict[str, str] = {}
        self._loaded: dict[tuple[str, str | None], Phantom] = {}
        self._lock = threading.Lock()
        """Around what is known: samples are loaded by worker threads and by the event loop."""
        self.turn = asyncio.Lock()
        """Held while an upload is read, so that uploads never take all worker threads."""

    @property
    def names(self) -> tuple[str, ...]:
        """Shipped phantoms, then uploads."""
        return (*phantom_names(), *self._heads)

    @property
    def uploads(self) -> tuple[str, ...]:
        """Names of the uploads that are whole."""
        return tuple(self._heads)

    def head(self, name: str) -> UploadHead | None:
        """What was uploaded under `name`, or None for a shipped phantom."""
        return self._heads.get(name)

    def revision(self, name: str) -> str | None:
        """Names the content of an upload that has been read; None for a shipped phantom."""
        return self._revisions.get(name)

    def load(self, name: str, material: str | None = None) -> Phantom:
        """The phantom called `name`; parsed once and kept.

        Args:
            name: a shipped phantom's or an upload's.
            material: instead of the one a mesh was uploaded with.

        Raises:
            UnknownNameError: no such sample or material.
            LimitError: a material for a sample that has its own.
            PhantomError: an upload that cannot be read any more.
        """
        key = (name, material)
        with self._lock:
            head, phantom = self._heads.get(name), self._loaded.pop(key, None)
            if phantom is not None:
                self._loaded[key] = phantom  # the newest again: what is used stays
                return phantom
        phantom, revision = self._load(head, name, material)
        with self._lock:
            if self._heads.get(name) is head:  # else another file has come under this name
                self._keep(key, phantom, revision)
        return phantom

    def _keep(self, key: tuple[str, str | None], phantom: Phantom, revision: str | None) -> None:
        self._loaded[key] = phantom
        if revision is not None:
            self._revisions[key[0]] = revision
        while len(self._loaded) > KEPT:
            del self._loaded[next(iter(self._loaded))]

    def receive(self, head: UploadHead, start: int, data: bytes) -> int:
        """Take a chunk, see `Incoming.receive`; returns the bytes received so far.

        Raises:
            RpcError: -32008, larger than allowed.
            LimitError: a gap before this chunk, or a name that stands for something else.
            DatasetWriteError: the disk does not take it.
        """
        if head.total > self._limit:
            raise too_large("an upload", head.total, self._limit)
        if head.name == EMPTY or is_shipped(head.name):
            what = "the empty stage" if head.name == EMPTY else "a shipped phantom"
            raise LimitError(
                f"{head.name!r} is {what}'s name; choose another",
                {"asked": head.name, "taken": [EMPTY, *phantom_names()]},
            )
        file_stem(head.name)
        return self._incoming.receive(head, start, data)

    def complete(self, name: str) -> Phantom:
        """Parse and keep an upload of which all bytes have come (it may take seconds).

        Raises:
            PhantomError, UnknownNameError: its content does not hold; nothing is kept.
            DatasetWriteError: it cannot be stored.
        """
        head, raw = self._incoming.take(name)
        phantom = _parse(head, raw, head.material)
        put_file(self._folder, f"{file_stem(name)}.bin", raw)
        put_json(self._folder, f"{file_stem(name)}.json", {"schema": 1, **head.__dict__})
        with self._lock:
            self._heads[name] = head
            for key in [k for k in self._loaded if k[0] == name]:
                del self._loaded[key]
            self._keep((name, None), phantom, _revision(head, raw))
        return phantom

    def _load(
        self, head: UploadHead | None, name: str, material: str | None
    ) -> tuple[Phantom, str | None]:
        """A phantom from where it is kept, and the revision of an upload."""
        if head is None:
            if material is not None:
                raise LimitError(
                    f"{name!r} has its own materials; a material is for uploaded meshes",
                    {"asked": material, "allowed": None},
                )
            try:
                return load_phantom(name), None
            except UnknownNameError:
                raise UnknownNameError(
                    f"no sample called {name!r}; there are: {', '.join(self.names)}",
                    {"asked": name, "allowed": list(self.names)},
                ) from None
        try:
            raw = (self._folder / f"{file_stem(name)}.bin").read_bytes()
        except OSError as error:
            raise PhantomError(f"the upload {name!r} cannot be read: {error.strerror}") from None
        phantom = _parse(head, raw, head.material if material is None else material)
        return phantom, _revision(head, raw)


def _revision(head: UploadHead, raw: bytes) -> str:
    """A name of a content: bytes and how they are read."""
    how = f"{head.kind} {head.format} {head.unit} {head.shape} {head.voxel_mm}".encode()
    return hashlib.sha256(how + b"\0" + raw).hexdigest()[:16]


def _parse(head: UploadHead, raw: bytes, material: str | None) -> Phantom:
    if head.kind == "mesh":
        return mesh_apart(
            raw,
            unit=head.unit,
            material=DEFAULT_MATERIAL if material is None else material,
            file_type=head.format,
            name=head.name,
        )
    assert head.shape is not None
    assert head.voxel_mm is not None
    if 4 * int(np.prod(head.shape, dtype=np.int64)) != len(raw):
        raise PhantomError(
            f"{head.name}: voxels of shape {list(head.shape)} are "
            f"{4 * int(np.prod(head.shape, dtype=np.int64))} bytes, not {len(raw)}",
            {"asked": len(raw), "allowed": 4 * int(np.prod(head.shape, dtype=np.int64))},
        )
    data = np.frombuffer(raw, dtype="<f4").reshape(head.shape)
    if not np.isfinite(data).all():
        raise PhantomError(f"{head.name}: voxels must be finite numbers")
    return voxel_phantom(data.astype(np.float32), head.voxel_mm, name=head.name)


def _read_head(file: Path) -> UploadHead | None:
    """What lies beside an upload, or None for a file that is not ours."""
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        fields = {k: v for k, v in document.items() if k in UploadHead.__annotations__}
        head = UploadHead(**fields)
    except (OSError, ValueError, TypeError, AttributeError):
        return None
    shape, voxel = _tuple(document.get("shape")), _tuple(document.get("voxel_mm"))
    return replace(head, shape=shape, voxel_mm=voxel)  # type: ignore[arg-type]


def _tuple(value: object) -> tuple[object, ...] | None:
    return tuple(value) if isinstance(value, list) else None


def sample_material(head: UploadHead | None, material: str | None) -> str | None:
    """Material that a mesh is filled with; None for a sample that has its own."""
    if head is None or head.kind == "voxels":
        return None
    chosen = head.material if material is None else material
    return DEFAULT_MATERIAL if chosen is None else chosen
