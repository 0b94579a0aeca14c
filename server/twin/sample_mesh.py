"""Shapes of samples for clients that draw them: binary STL in mm, the sample's own frame.

Made once for the sample on the stage and kept until another stands there; sizes are limited.
Handlers send them in chunks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from flexdt.phantoms import Phantom
from flexdt.protocol.rpc_errors import too_large

MAX_BYTES: Final = 64 << 20
HEADER, FACE = 84, 50
"""Bytes of binary STL: before the faces, and of each."""


@dataclass(frozen=True)
class Shape:
    """The mesh of a sample as binary STL, and the revision of the upload that it was made of."""

    name: str
    revision: str | None
    stl: bytes


class Shapes:
    """The last shape asked for."""

    def __init__(self, limit: int = MAX_BYTES) -> None:
        self._limit = limit
        self._kept: Shape | None = None

    def known(self, name: str, revision: str | None) -> Shape | None:
        """A shape that was made already."""
        kept = self._kept
        return kept if kept is not None and (kept.name, kept.revision) == (name, revision) else None

    def make(self, name: str, revision: str | None, phantom: Phantom) -> Shape:
        """The shape of `phantom`; it may take a second.

        Raises:
            RpcError: -32008, more triangles than are sent.
        """
        mesh: Any = phantom.mesh()
        size = HEADER + FACE * len(mesh.faces)
        if size > self._limit:
            raise too_large("the sample's mesh", size, self._limit)
        self._kept = Shape(name, revision, mesh.export(file_type="stl"))
        return self._kept
