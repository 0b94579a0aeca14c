"""Meshes of uploaded samples, fetched from the twin (`sample.mesh`) so that scenes can draw them.

Waiting time and size are bounded.
"""

from __future__ import annotations

import base64
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

from flexdt.protocol import RpcError
from flexdt.protocol.state_model import SampleState

CHUNK: Final = 4 << 20
MOST: Final = 64 << 20

Ask = Callable[[str, Mapping[str, Any]], Awaitable[object]]


async def fetch(ask: Ask, sample: SampleState) -> bytes | None:
    """The STL of the sample on the stage; None if the sample has changed or is too large.

    Raises:
        ConnectionLost: the twin has gone.
    """
    content = bytearray()
    while True:
        try:
            answer = await ask("sample.mesh", {"start": len(content), "count": CHUNK})
        except RpcError:  # nothing on the stage any more, too large, or an older twin
            return None
        if (
            not isinstance(answer, Mapping)
            or (answer.get("name"), answer.get("revision")) != (sample.name, sample.revision)
            or answer.get("start") != len(content)
            or not 0 < int(answer["total"]) <= MOST
        ):
            return None
        data = answer["data"]
        chunk = base64.b64decode(data) if isinstance(data, str) else bytes(data)
        content += chunk
        if len(content) >= int(answer["total"]):
            return bytes(content)
        if not chunk:
            return None
