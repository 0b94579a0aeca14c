"""Python client, data set reader and command line.

`TwinClient` is imported on first use, so that the command line's help costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from flexdt.clients.client import TwinClient as TwinClient

__all__ = ["TwinClient"]


def __getattr__(name: str) -> object:
    if name == "TwinClient":
        from flexdt.clients.client import TwinClient

        return TwinClient
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
