"""Peers without the token, drawn from a seed: what they send, and whether they stay."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
from dataclasses import dataclass

KEPT_S = 30.0
"""How long one that stays does so, unless the server ends it [s]."""


def hello(token: str | None) -> bytes:
    """A line that introduces a client."""
    said = {"protocol": "1.0", "client": "flood"} | (
        {} if token is None else {"token": token}
    )
    return request("session.hello", said)


def request(method: str, params: object = None) -> bytes:
    """A line."""
    body = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params or {}}
    return json.dumps(body).encode() + b"\n"


@dataclass(frozen=True)
class Stranger:
    """One peer.

    Attributes:
        kind: what it does, for people.
        sends: in so many pieces.
        stays: keeps its connection open, and reads if it has something to read.
    """

    kind: str
    sends: tuple[bytes, ...]
    stays: bool


def draw(rng: random.Random) -> Stranger:
    """The next peer."""
    wrong = hello(rng.choice(["x" * 16, "0" * 64, "", "é" * 9]))
    kinds: dict[str, tuple[bytes, ...]] = {
        "nothing": (),
        "garbage": (rng.randbytes(rng.choice([1, 40, 5_000])),),
        "lines": (b"\n" * rng.choice([1, 1_000]),),
        "half a hello": (wrong[: rng.randrange(1, len(wrong))],),
        "a hello in two": (wrong[:20], wrong[20:]),
        "a wrong token": (wrong,),
        "wrong tokens": (wrong * 5,),
        "no token": (hello(None),),
        "an E-stop": (request("safety.estop"),),
        "a batch": (b"[" + b",".join([request("safety.estop").strip()] * 100) + b"]\n",),
        "a long line": (b'{"x":"' + b"x" * 60_000,),
        "a frame": (b"\0\0\x10\0" + rng.randbytes(100),),
        "a browser": (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",),
    }
    kind = rng.choice(sorted(kinds))
    return Stranger(kind, kinds[kind], rng.random() < 0.7)


async def play(stranger: Stranger, host: str, port: int, source: str) -> bytes:
    """Be that peer; returns what the server said. Ends when the server ends it, or in the
    end."""
    said = b""
    with contextlib.suppress(OSError, TimeoutError):
        reader, writer = await asyncio.open_connection(host, port, local_addr=(source, 0))
        try:
            for piece in stranger.sends:
                writer.write(piece)
                await asyncio.sleep(0.01)
            if stranger.stays:
                async with asyncio.timeout(KEPT_S):
                    while got := await reader.read(1 << 16):
                        said += got
        finally:
            writer.transport.abort()
    return said
