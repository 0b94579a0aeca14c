"""Meshes on their way from a page to the twin: gathered, converted where need be, sent in chunks.

The twin reads STL and OBJ; GLB, PLY and OFF become STL here. It refuses files
that hold no triangles, and anything too large.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import io
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

import trimesh

from flexdt.protocol import Code, RpcError
from flexdt.protocol.errors import too_large

CHUNK: Final = 4 << 20
MOST: Final = 256 << 20
PASSED: Final = ("stl", "obj")
CONVERTED: Final = ("glb", "ply", "off")

Ask = Callable[[str, Mapping[str, Any]], Awaitable[object]]


class Gathering:
    """A page's upload, chunk by chunk."""

    def __init__(self) -> None:
        self._key: object = None
        self._bytes = bytearray()

    def take(self, params: Mapping[str, Any]) -> bytes | None:
        """Add a chunk; the whole file once it is complete.

        Raises:
            RpcError: a gap, a size that does not fit, no base64, or a format nobody reads.
        """
        form, total, start = params.get("format"), params.get("total"), params.get("start", 0)
        if form not in PASSED + CONVERTED:
            raise RpcError(
                Code.INVALID_PARAMS, f"no meshes of format {form!r}", [*PASSED, *CONVERTED]
            )
        if not isinstance(total, int) or not isinstance(start, int) or total <= 0:
            raise RpcError(Code.INVALID_PARAMS, "an upload says total and start in bytes")
        if total > MOST:
            raise too_large("an upload", total, MOST)
        key = (params.get("name"), form, total)
        if start == 0:
            self._key, self._bytes = key, bytearray()
        if key != self._key or start != len(self._bytes):
            raise RpcError(Code.INVALID_PARAMS, "chunks of an upload come in order, from 0")
        try:
            self._bytes += base64.b64decode(str(params.get("data", "")), validate=True)
        except binascii.Error:
            raise RpcError(Code.INVALID_PARAMS, "data is not base64") from None
        if len(self._bytes) < total:
            return None
        whole, self._key, self._bytes = bytes(self._bytes), None, bytearray()
        return whole


def as_stl(content: bytes, form: str) -> bytes:
    """A mesh file as binary STL, in the file's own unit.

    Raises:
        RpcError: it cannot be read or holds no triangles.
    """
    try:
        loaded = trimesh.load(io.BytesIO(content), file_type=form, process=False)
        mesh: Any = loaded.to_mesh() if isinstance(loaded, trimesh.Scene) else loaded
        count = len(mesh.faces)
        export: Any = mesh.export
        stl: bytes = export(file_type="stl")
    except Exception as error:
        # Readers of foreign formats fail in many ways; each means the same to a person.
        raise RpcError(Code.INVALID_PARAMS, f"this {form} file cannot be read: {error}") from None
    if count == 0:
        raise RpcError(Code.INVALID_PARAMS, f"this {form} file holds no triangles")
    return stl


async def send(ask: Ask, params: Mapping[str, Any], content: bytes) -> object:
    """Give a whole file to the twin; its last answer.

    Raises:
        RpcError: it cannot be read, or the twin refuses it.
    """
    form = str(params["format"])
    if form in CONVERTED:
        content, form = await asyncio.to_thread(as_stl, content, form), "stl"
    head: dict[str, Any] = {
        "name": params.get("name"), "kind": "mesh", "format": form, "total": len(content),
        "unit": params.get("unit", "mm"), "material": params.get("material"),
    }  # fmt: skip
    answer: object = None
    for start in range(0, len(content), CHUNK):
        answer = await ask("sample.upload", {**head, "start": start,
                                             "data": content[start : start + CHUNK]})  # fmt: skip
    return answer
