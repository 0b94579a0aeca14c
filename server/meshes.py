"""Uploaded meshes are read in a process of their own (`worker`), never in the server.

A parser that runs away, needs all memory or dies takes nothing with it, and the event loop never
waits for its interpreter lock. Each mesh has a fresh process, which may write no file, and what
comes back is trusted no more than any other document.
"""

from __future__ import annotations

import json

from flexdt.phantoms import Phantom, PhantomError, mesh_phantom
from flexdt.protocol.errors import RpcError
from flexdt.server.worker import limit
from flexdt.server.workers import Worker
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
    worker = Worker(MEMORY_BYTES)
    try:
        [answer] = worker.ask("mesh", [json.dumps(how).encode(), raw], timeout_s)
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


def work(parts: list[bytes]) -> list[bytes]:
    """In the worker: how to read, then the mesh; answers with the phantom or what is wrong."""
    limit("RLIMIT_FSIZE", 0)
    how = json.loads(parts[0])
    try:
        document: dict[str, object] = mesh_phantom(parts[1], **how).to_dict()
    except TwinError as error:
        document = {"error": type(error).__name__, "message": error.message, "data": error.data}
    return [json.dumps(document, default=repr).encode()]
