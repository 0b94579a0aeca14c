"""Meshes and scenes read in a process apart, with limits."""

from __future__ import annotations

import json
from collections.abc import Callable

from flexdt import phantoms
from flexdt.phantoms import Phantom, PhantomError
from flexdt.phantoms.files.phantom_files import sent_scene
from flexdt.protocol.rpc_errors import Code, RpcError
from flexdt.runtime.worker import document
from flexdt.runtime.workers import Worker

# Parsing of uploaded meshes and scenes in a process of their own (`worker`).
#
# A parser that loops, exhausts its memory or crashes does not affect the server, and the
# event loop never waits for the parser's interpreter lock. Each upload has a fresh
# process that may write no file, and its result is validated like any other document.

TIMEOUT_S = 180.0
MEMORY_BYTES = 3 << 30


def mesh_apart(
    raw: bytes, *, unit: str, material: str, file_type: str, name: str, place: str
) -> Phantom:
    """Read a mesh from untrusted bytes, as `mesh_phantom`; blocks.

    Raises PhantomError: as there, unknown material, or too much time or memory.
    """
    how = {
        "unit": unit,
        "material": material,
        "file_type": file_type,
        "name": name,
        "place": place,
    }
    return _apart(phantoms.mesh_phantom, how, raw)


def scene_apart(raw: bytes, *, name: str) -> Phantom:
    """Read an untrusted phantom or scene file (TOML or JSON), as `mesh_apart`.

    Raises:
        PhantomError: its content does not hold, it is larger than is allowed, names files
            or an unknown material, or reading it takes too much time or memory.
    """
    return _apart(sent_scene, {"name": name}, raw)


def _apart(read: Callable[..., Phantom], how: dict[str, str], raw: bytes) -> Phantom:
    """Read a mesh or scene from bytes in a worker process of its own, with limits; blocks.

    The limits are `TIMEOUT_S` and `MEMORY_BYTES`; the process is ended in any case.

    Args:
        read: function of the worker.
        how: its keyword arguments; "name" is that of the sample.
        raw: bytes of the file.

    Returns the phantom.
    Raises PhantomError: they cannot be read, or take too much time or memory.
    """
    worker = Worker(MEMORY_BYTES)
    try:
        [text] = worker.ask(document, (read, how), [raw], TIMEOUT_S)
    except RpcError as error:
        prefix = ""
        if error.code == Code.TOO_LARGE:
            prefix = f"{how['name']!r} cannot be read: "
        data = None
        if isinstance(error.data, dict):
            data = error.data
        raise PhantomError(prefix + error.message, data) from None
    finally:
        worker.kill()
    return Phantom.from_dict(json.loads(text))
