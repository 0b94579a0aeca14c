"""Python client, data set reader and command line.

Names are looked up on first use, so that `import flexdt.clients` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flexdt.clients.client.async_client import AsyncTwinClient
    from flexdt.clients.client.client import TwinClient
    from flexdt.clients.client.events import Projection
    from flexdt.clients.client.transport import ConnectionLost

_HOMES = {
    "AsyncTwinClient": "flexdt.clients.client.async_client",
    "Projection": "flexdt.clients.client.events",
    "TwinClient": "flexdt.clients.client.client",
    "ConnectionLost": "flexdt.clients.client.transport",
}

__all__ = ["AsyncTwinClient", "ConnectionLost", "Projection", "TwinClient"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
