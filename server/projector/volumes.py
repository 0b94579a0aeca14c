"""Named volumes and scenes within a memory limit, and uploads that are not complete yet.

Memory is counted as what a volume takes once it is projected: its voxels and the projector's own
z-contiguous copy. Nothing is evicted: above the limit a put is an error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexdt.protocol.projector import Grid, VolumeInfo
from flexdt.protocol.rpc_errors import RpcError, invalid_params, too_large
from flexdt.twin.projection import Volume
from flexdt.twin.projection.analytic_solids import Scene

LAYOUT_COPIES = 2
"""A volume's voxels are kept twice: as they came and z-contiguous."""

SOLID_BYTES = 1024
"""Counted for each solid of a scene."""


@dataclass
class _Upload:
    """Voxels that are still coming."""

    owner: object
    grid: Grid
    data: np.ndarray[tuple[int, ...], np.dtype[np.float32]]
    received: int = 0


class VolumeStore:
    """The server's volumes, by name.

    Args:
        limit: bytes that all volumes together may take.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._held: dict[str, Volume | Scene] = {}
        self._uploads: dict[tuple[object, str], _Upload] = {}

    def __len__(self) -> int:
        return len(self._held)

    def __contains__(self, name: object) -> bool:
        return name in self._held

    @property
    def used(self) -> int:
        """Bytes taken by volumes and uploads."""
        held = sum(memory_of(v) for v in self._held.values())
        return held + sum(_needed(u.grid) for u in self._uploads.values())

    def get(self, name: str) -> Volume | Scene:
        """The volume called `name`.

        Raises:
            RpcError: -32602, listing the names.
        """
        if name not in self._held:
            raise invalid_params(
                f"no volume {name!r}; there are: {', '.join(sorted(self._held)) or 'none'}",
                [{"path": "volume", "message": "unknown volume", "asked": name}],
                sorted(self._held),
            )
        return self._held[name]

    def put(self, name: str, value: Volume | Scene) -> None:
        """Store a whole volume or scene under `name`, in place of its namesake.

        Raises:
            RpcError: -32008, above the memory limit.
        """
        self._check_room(f"volume {name!r}", memory_of(value), name)
        self._held[name] = value

    def chunk(
        self, owner: object, name: str, grid: Grid, start: int, data: memoryview
    ) -> tuple[int, Volume | None]:
        """Take a chunk of voxels; returns bytes received so far and the volume once complete.

        Chunks come in order. The complete volume is not stored: `put` does that.

        Raises:
            RpcError: -32008 above the memory limit; -32602, chunks that do not fit together.
        """
        total = 4 * math.prod(grid.shape)
        key = (owner, name)
        if start == 0:
            self._uploads.pop(key, None)
            # The namesake stays in use until the new volume is whole, so both are counted.
            self._check_room(f"volume {name!r}", _needed(grid), None)
            self._uploads[key] = _Upload(owner, grid, np.empty(grid.shape, np.float32))
        upload = self._uploads.get(key)
        if upload is None or upload.grid != grid or upload.received != start:
            expected = 0 if upload is None else upload.received
            raise _bad_chunk(name, start, expected)
        end = start + data.nbytes
        if end > total or (data.nbytes == 0 and total > 0):
            raise _bad_chunk(name, end, total)
        upload.data.reshape(-1).view(np.uint8)[start:end] = np.frombuffer(data, np.uint8)
        upload.received = end
        if end < total:
            return end, None
        del self._uploads[key]
        return end, Volume(upload.data, grid.voxel_mm, grid.center_mm)

    def reserve(self, what: str, needed: int) -> None:
        """Raise -32008 unless there is room for `needed` bytes more."""
        self._check_room(what, needed, None)

    def remove(self, name: str) -> bool:
        """Forget a volume; whether there was one."""
        return self._held.pop(name, None) is not None

    def forget(self, owner: object) -> None:
        """Drop the unfinished uploads of a client that has gone."""
        for key in [k for k in self._uploads if k[0] is owner]:
            del self._uploads[key]

    def describe(self) -> list[VolumeInfo]:
        """All volumes, by name."""
        return [_info(name, self._held[name]) for name in sorted(self._held)]

    def _check_room(self, what: str, needed: int, replaced: str | None) -> None:
        old = self._held.get(replaced) if replaced is not None else None
        used = self.used - (0 if old is None else memory_of(old))
        if used + needed > self.limit:
            error = too_large(what, needed, max(0, self.limit - used))
            assert isinstance(error.data, dict)
            error.data.update(memory_used=used, memory_limit=self.limit)
            raise error


def memory_of(value: Volume | Scene) -> int:
    """Bytes counted for a volume or scene."""
    if isinstance(value, Volume):
        return LAYOUT_COPIES * 4 * math.prod(value.shape)
    return SOLID_BYTES * max(1, len(value.solids))


def _needed(grid: Grid) -> int:
    return LAYOUT_COPIES * 4 * math.prod(grid.shape)


def _bad_chunk(name: str, asked: int, allowed: int) -> RpcError:
    return invalid_params(
        f"volume {name!r}: a chunk at or up to byte {asked} does not fit; expected {allowed}",
        [{"path": "start", "message": "chunks must come in order", "asked": asked}],
        allowed,
    )


def _info(name: str, value: Volume | Scene) -> VolumeInfo:
    if isinstance(value, Volume):
        return VolumeInfo(
            name=name,
            kind="voxels",
            bytes=memory_of(value),
            shape=list(value.shape),
            voxel_mm=value.voxel_xyz,
            center_mm=value.center_mm,
        )
    return VolumeInfo(name=name, kind="scene", bytes=memory_of(value), solids=len(value.solids))
