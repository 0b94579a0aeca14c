"""Volumes, meshes and scenes of the projector by name.

The counted memory is that of a projected volume: its voxels and the projector's own
z-contiguous copy. Where it is needed, volumes that were put as evictable are forgotten,
the least recently used first; the others stay until they are removed. A volume that does
not fit then is an error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flexdt.protocol import projector as wire
from flexdt.protocol.rpc_errors import RpcError, invalid_params, problem, too_large
from flexdt.twin.projection import Body, TriangleMesh, Volume

LAYOUT_COPIES = 2
"""Number of copies of a volume's voxels: as they came, and z-contiguous."""

SOLID_BYTES = 1024
"""Memory counted for each solid of a scene [bytes]."""


@dataclass
class _Upload:
    """Voxels or a mesh whose bytes are still arriving."""

    owner: object
    what: wire.VoxelGrid | wire.MeshSize
    data: np.ndarray[tuple[int], np.dtype[np.uint8]]
    received: int = 0

    def whole(self) -> Volume | TriangleMesh:
        """Make the volume or mesh of the complete bytes.

        Voxels and vertices are views of the bytes, not copies; faces become int64.

        Raises:
            GeometryError: a mesh that does not close.
        """
        if isinstance(self.what, wire.VoxelGrid):
            voxels = self.data.view("<f4").reshape(self.what.shape)
            return Volume(voxels, self.what.voxel_mm, self.what.center_mm)
        corners = 24 * self.what.vertices
        return TriangleMesh(
            self.data[:corners].view("<f8").reshape(-1, 3),
            self.data[corners:].view("<i4").reshape(-1, 3).astype(np.int64),
        )


class VolumeStore:
    """The server's volumes, by name.

    Args:
        limit: bytes that all volumes together may take.
    """

    def __init__(self, limit: int) -> None:
        """Make an empty store that may hold `limit` bytes."""
        self.limit = limit
        self._held: dict[str, Body] = {}
        """Name -> volume, the least recently used first."""
        self._evictable: set[str] = set()
        self._bytes = self._evictable_bytes = 0
        self._uploads: dict[tuple[object, str], _Upload] = {}

    def __len__(self) -> int:
        return len(self._held)

    def __contains__(self, name: object) -> bool:
        return name in self._held

    @property
    def used(self) -> int:
        """Bytes taken by volumes and uploads."""
        return self._bytes + sum(_needed(u.what) for u in self._uploads.values())

    @property
    def evictable(self) -> int:
        """Bytes of evictable volumes."""
        return self._evictable_bytes

    def get(self, name: str) -> Body:
        """Look up the volume `name`, which becomes the most recently used.

        Raises RpcError: -32602, there is none.
        """
        if name not in self._held:
            raise wire.unknown_volume(name, list(self._held))
        value = self._held[name] = self._held.pop(name)
        return value

    def put(self, name: str, value: Body, *, evictable: bool = False) -> None:
        """Store a complete volume, mesh or scene under `name`, in place of its namesake.

        It becomes the most recently used. Evictable ones are removed where memory is
        needed. Raises RpcError: -32008, too large.
        """
        self.reserve(f"volume {name!r}", memory_of(value), name)
        self.remove(name)
        self._held[name] = value
        self._bytes += memory_of(value)
        if evictable:
            self._evictable.add(name)
            self._evictable_bytes += memory_of(value)

    def chunk(
        self,
        owner: object,
        name: str,
        what: wire.VoxelGrid | wire.MeshSize,
        start: int,
        data: memoryview,
    ) -> tuple[int, Callable[[], Volume | TriangleMesh] | None]:
        """Receive a chunk of voxels or of a mesh; the complete volume is not stored, `put` does
        that.

        Chunks come in order. A chunk at 0 begins anew and reserves room for the whole, beside a
        namesake. An empty chunk is refused unless the whole is empty.

        Args:
            owner: client that sends it; each has uploads of its own.
            name: of the volume.
            what: size of the complete volume or mesh, equal in all chunks.
            start: place of the chunk [bytes].
            data: the chunk.

        Returns bytes received so far, and None, or once all have come the function that makes
        the volume or mesh.
        Raises RpcError: -32008, above the memory limit; -32602, chunks that do not fit together.
        """
        total = what.nbytes
        key = (owner, name)
        if start == 0:
            self._uploads.pop(key, None)
            # The namesake stays in use until the new volume is complete, so both are counted.
            self.reserve(f"volume {name!r}", _needed(what))
            self._uploads[key] = _Upload(owner, what, np.empty(total, np.uint8))
        upload = self._uploads.get(key)
        if upload is None or upload.what != what or upload.received != start:
            expected = 0 if upload is None else upload.received
            raise _bad_chunk(name, start, expected)
        end = start + data.nbytes
        if end > total or (data.nbytes == 0 and total > 0):
            raise _bad_chunk(name, end, total)
        upload.data[start:end] = np.frombuffer(data, np.uint8)
        upload.received = end
        if end < total:
            return end, None
        del self._uploads[key]
        return end, upload.whole

    def remove(self, name: str) -> bool:
        """Remove a volume, evictable or not, and its share of the memory count; an upload
        of that name goes on.

        Returns:
            Whether there was one.
        """
        value = self._held.pop(name, None)
        if value is None:
            return False
        self._bytes -= memory_of(value)
        if name in self._evictable:
            self._evictable.discard(name)
            self._evictable_bytes -= memory_of(value)
        return True

    def forget(self, owner: object) -> None:
        """Drop the unfinished uploads of a client that has gone."""
        for key in [k for k in self._uploads if k[0] is owner]:
            del self._uploads[key]

    def describe(self) -> list[wire.VolumeInfo]:
        """Describe all volumes, by name."""
        return [_info(name, self._held[name]) for name in sorted(self._held)]

    def reserve(self, what: str, needed: int, replaced: str | None = None) -> None:
        """Make room for a volume by removing evictable ones, the least recently used
        first, until it fits.

        Uploads count as used memory. The volume that is replaced counts as free, but is
        not removed here.

        Args:
            what: the volume, for the message.
            needed: its memory [bytes].
            replaced: name of the volume whose place it takes; None for none.

        Raises:
            RpcError: -32008, it would not fit even then; nothing is removed.
        """
        old = None
        if replaced is not None:
            old = self._held.get(replaced)
        used = self.used - (0 if old is None else memory_of(old))
        kept = 0
        if old is not None and replaced in self._evictable:
            kept = memory_of(old)
        if used - (self._evictable_bytes - kept) + needed > self.limit:
            free = self.limit - used + self._evictable_bytes - kept
            error = too_large(what, needed, max(0, free))
            assert isinstance(error.data, dict)
            error.data.update(memory_used=used, memory_limit=self.limit)
            raise error
        names = iter([n for n in self._held if n in self._evictable and n != replaced])
        while used + needed > self.limit:
            name = next(names)
            used -= memory_of(self._held[name])
            self.remove(name)


def memory_of(value: Body) -> int:
    """Estimate the memory that a volume, mesh or scene is counted with [bytes].

    A volume counts `LAYOUT_COPIES` times its float32 voxels, a mesh its vertices and
    faces, a scene `SOLID_BYTES` a solid (at least one).
    """
    if isinstance(value, Volume):
        return LAYOUT_COPIES * 4 * math.prod(value.shape)
    if isinstance(value, TriangleMesh):
        return value.vertices.nbytes + value.faces.nbytes
    return SOLID_BYTES * max(1, len(value.solids))


def _needed(what: wire.VoxelGrid | wire.MeshSize) -> int:
    """Compute the memory that an upload will be counted with [bytes], its chunks included
    for a mesh.
    """
    if isinstance(what, wire.VoxelGrid):
        return LAYOUT_COPIES * what.nbytes
    return 24 * (what.vertices + what.triangles) + what.nbytes


def _bad_chunk(name: str, asked: int, allowed: int) -> RpcError:
    """Make, not raise, the error -32602 for a chunk at or up to byte `asked` where byte
    `allowed` is expected.
    """
    return invalid_params(
        f"volume {name!r}: a chunk at or up to byte {asked} does not fit; expected {allowed}",
        [problem("start", "chunks must come in order", asked)],
        allowed,
    )


def _info(name: str, value: Body) -> wire.VolumeInfo:
    """Describe a volume, mesh or scene.

    All have name, kind and bytes; a mesh its triangles, a volume shape, voxel and center
    [mm], a scene its number of solids.

    Args:
        name: of the body.
        value: the body.
    """
    if isinstance(value, TriangleMesh):
        triangles = len(value.faces)
        return wire.VolumeInfo(
            name=name, kind="mesh", bytes=memory_of(value), triangles=triangles
        )
    if isinstance(value, Volume):
        return wire.VolumeInfo(
            name=name,
            kind="voxels",
            bytes=memory_of(value),
            shape=list(value.shape),
            voxel_mm=value.voxel_xyz,
            center_mm=value.center_mm,
        )
    return wire.VolumeInfo(
        name=name, kind="scene", bytes=memory_of(value), solids=len(value.solids)
    )
