"""What attacks are made of: servers under attack, names of attacks, and how a refusal is read."""

from __future__ import annotations

import base64
import contextlib
import json
import socket
import struct
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from lab import Plain, Refused, Wire, projector, twin

Attack = Callable[["Ground"], str]
PATIENCE_S = 60.0
"""For what happens a moment later, on a machine that may be busy."""


class Ground:
    """The servers under attack."""

    def __init__(self, folder: Path) -> None:
        self.root = folder
        self.data = folder / "data"
        self.data.mkdir(parents=True)
        self.outside = folder / "outside"
        self.outside.mkdir()
        self.projector = projector(log=folder / "projector.log")
        self.twin = twin(
            self.projector.port, self.data, "--speed-up", "max", log=folder / "twin.log"
        )

    def wire(self) -> Wire:
        return Wire(self.twin.port)

    def raw(self, data: bytes, *, port: int | None = None, wait_s: float = 20.0) -> bytes:
        """Send bytes, then read until a line, an end or a timeout."""
        with socket.create_connection(("127.0.0.1", port or self.twin.port), timeout=wait_s) as s:
            with contextlib.suppress(ConnectionError):
                s.sendall(data)
            got = b""
            with contextlib.suppress(TimeoutError, ConnectionError):
                while not got.endswith(b"\n"):
                    part = s.recv(65536)
                    if not part:
                        break
                    got += part
            return got

    def free(self) -> None:
        """Nobody holds control, whatever the last attack's connections still did."""
        wire = self.wire()
        wire.call("session.control", action="force")
        wire.call("session.control", action="release")
        wire.close()

    def close(self) -> None:
        self.twin.end()
        self.projector.end()


def attack(name: str) -> Callable[[Attack], Attack]:
    """Mark a function as an attack, called so in the table."""

    def note(run: Attack) -> Attack:
        run.__dict__["attack"] = name
        return run

    return note


def attacks_of(module: ModuleType) -> list[tuple[str, Attack]]:
    """Names and attacks of a module, as they stand in it."""
    return [(f.__dict__["attack"], f) for f in vars(module).values() if "attack" in dir(f)]


def eventually(holds: Callable[[], bool], what: str) -> None:
    """Wait until `holds`, or fail saying `what`."""
    until = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < until, what
        time.sleep(0.02)


def code_of(answer: bytes | dict[str, Any]) -> int:
    document = json.loads(answer) if isinstance(answer, bytes) else answer
    return int(document["error"]["code"])


def refused(wire: Wire, method: str, **params: object) -> Refused:
    try:
        result = wire.call(method, **params)
    except Refused as error:
        return error
    raise AssertionError(f"{method} was answered: {str(result)[:200]}")


def upload(wire: Wire, name: str, raw: bytes, **more: Plain) -> dict[str, Any]:
    answer: dict[str, Any] = {}
    for start in range(0, max(1, len(raw)), 6 << 20):
        part = raw[start : start + (6 << 20)]
        answer = wire.ask(
            "sample.upload", name=name, total=len(raw), start=start,
            data=base64.b64encode(part).decode(), **more,
        )  # fmt: skip
        if "error" in answer:
            break
    return answer


def stl(faces: int, claimed: int | None = None) -> bytes:
    """A binary STL with `faces` triangles of rubbish (12: a cube)."""
    head = b"\0" * 80 + struct.pack("<I", faces if claimed is None else claimed)
    if faces == 12:
        corner = [(x, y, z) for x in (0, 9) for y in (0, 9) for z in (0, 9)]
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        tris = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
        body = b"".join(
            struct.pack("<12fH", 0, 0, 0, *corner[a], *corner[b], *corner[c], 0) for a, b, c in tris
        )
        return head + body
    return head + np.random.default_rng(0).bytes(50 * faces)
