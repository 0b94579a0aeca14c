"""Python clients of the twin server, with the types of its answers and its errors.

Names are looked up on first use, so that `import flexdt.clients` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flexdt.clients.client.client import AsyncTwinClient as AsyncTwinClient
    from flexdt.clients.client.client import TwinClient as TwinClient
    from flexdt.clients.client.events import Projection as Projection
    from flexdt.clients.client.transport import ConnectionLost as ConnectionLost
    from flexdt.clients.client.transport import Transport as Transport
    from flexdt.clients.client.twin_methods import FINAL_STATES as FINAL_STATES
    from flexdt.protocol.methods.job_messages import CheckResult as CheckResult
    from flexdt.protocol.rpc_errors import RpcError as RpcError
    from flexdt.protocol.state_model import AxisState as AxisState
    from flexdt.protocol.state_model import JobStatus as JobStatus
    from flexdt.protocol.state_model import State as State

_HOMES = {
    "AsyncTwinClient": "flexdt.clients.client.client",
    "Projection": "flexdt.clients.client.events",
    "TwinClient": "flexdt.clients.client.client",
    "ConnectionLost": "flexdt.clients.client.transport",
    "Transport": "flexdt.clients.client.transport",
    "FINAL_STATES": "flexdt.clients.client.twin_methods",
    "CheckResult": "flexdt.protocol.methods.job_messages",
    "RpcError": "flexdt.protocol.rpc_errors",
    "AxisState": "flexdt.protocol.state_model",
    "JobStatus": "flexdt.protocol.state_model",
    "State": "flexdt.protocol.state_model",
}

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
