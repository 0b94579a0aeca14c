"""Parsing of uploaded meshes and scenes in a process of their own (`worker`).

A parser that loops, exhausts its memory or crashes does not affect the server, and the event loop
never waits for the parser's interpreter lock. Each upload has a fresh process that may write no
file, and its result is validated like any other document.
"""

from __future__ import annotations

import json
from collections.abc import Callable

from flexdt.phantoms import Phantom, PhantomError, mesh_phantom
from flexdt.phantoms.files.phantom_files import sent_scene
from flexdt.protocol.rpc_errors import RpcError
from flexdt.server.runtime.worker import limit
from flexdt.server.runtime.workers import Worker
from flexdt.twin.errors import TwinError, UnknownNameError

TIMEOUT_S = 180.0
MEMORY_BYTES = 3 << 30


def mesh_apart(
    raw: bytes, *, unit: str, material: str, file_type: str, name: str, timeout_s: float = TIMEOUT_S
) -> Phantom:
    """`flexdt.phantoms.mesh_phantom` of a stranger's bytes; blocks, so call it from a thread.

    Raises:
        PhantomError: as there, or reading it takes too much time or memory.
        UnknownNameError: unknown material.
    """
    how = {"unit": unit, "material": material, "file_type": file_type, "name": name}
    return _apart(mesh_phantom, how, raw, timeout_s)


def scene_apart(raw: bytes, *, name: str, timeout_s: float = TIMEOUT_S) -> Phantom:
    """The phantom of a stranger's phantom or scene file (TOML or JSON), as `mesh_apart`.

    Raises:
        PhantomError: its content does not hold, it is larger than is allowed, names files or an
            unknown material, or reading it takes too much time or memory.
    """
    return _apart(sent_scene, {"name": name}, raw, timeout_s)


def _apart(
    read: Callable[..., Phantom], how: dict[str, str], raw: bytes, timeout_s: float
) -> Phantom:
    name = how["name"]
    worker = Worker(MEMORY_BYTES)
    try:
        [answer] = worker.ask(_answered, (read, how), [raw], timeout_s)
    except RpcError as error:
        data = error.data if isinstance(error.data, dict) else None
        raise PhantomError(f"{name!r} cannot be read: {error.message}", data) from None
    finally:
        worker.kill()
    document = json.loads(answer)
    if "error" in document:
        kind = UnknownNameError if document["error"] == "UnknownNameError" else PhantomError
        raise kind(str(document["message"]), document.get("data"))
    return Phantom.from_dict(document)


def _answered(read: Callable[..., Phantom], how: dict[str, str], raw: bytes) -> list[bytes]:
    limit("RLIMIT_FSIZE", 0)
    try:
        document: dict[str, object] = read(raw, **how).to_dict()
    except TwinError as error:
        document = {"error": type(error).__name__, "message": error.message, "data": error.data}
    return [json.dumps(document, default=repr).encode()]
