"""Uploaded meshes are read in a process of their own (`mesh_worker`), never in the server.

A parser that runs away, needs all memory or dies takes nothing with it, and the event loop never
waits for its interpreter lock. It refuses to trust what comes back more than any other document.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

from flexdt.phantoms import Phantom, PhantomError
from flexdt.twin.errors import UnknownNameError

TIMEOUT_S = 180.0


def mesh_apart(
    raw: bytes, *, unit: str, material: str, file_type: str, name: str, timeout_s: float = TIMEOUT_S
) -> Phantom:
    """`flexdt.phantoms.mesh_phantom` of a stranger's bytes; blocks, so call it from a thread.

    Raises:
        PhantomError: as there, or reading it takes too much time or memory.
        UnknownNameError: unknown material.
    """
    command = [sys.executable, "-m", "flexdt.server.mesh_worker", file_type, unit, material, name]
    try:
        done = subprocess.run(
            command,
            input=raw,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=timeout_s,
            check=False,
            env={k: v for k, v in os.environ.items() if k != "FLEXDT_TOKEN"},
        )
    except subprocess.TimeoutExpired:
        raise PhantomError(
            f"reading {name!r} takes more than {timeout_s:g} s", {"allowed": timeout_s}
        ) from None
    try:
        document = json.loads(done.stdout)
    except ValueError:
        raise PhantomError(
            f"{name!r} cannot be read: its reader ended with code {done.returncode}",
            {"code": done.returncode},
        ) from None
    if isinstance(document, dict) and "error" in document:
        kind = UnknownNameError if document["error"] == "UnknownNameError" else PhantomError
        raise kind(str(document["message"]), document.get("data"))
    return Phantom.from_dict(document)
