"""Signals of ophyd-async whose values are members of the twin's state.

A backend reads by asking the twin, receives changes from the connection's subscription, and puts
through a coroutine. Values are not cached.
"""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Generic, TypeVar, cast

import numpy as np
from bluesky.protocols import Reading
from event_model import DataKey, Dtype, Limits
from ophyd_async.core import NotConnectedError, SignalBackend, SignalR, SignalRW

from flexdt.clients.client.transport import ConnectionLost
from flexdt.clients.lab.lab_connection import LabConnection
from flexdt.protocol import RpcError
from flexdt.protocol.state_model import State

Value = bool | int | float | str
_T = TypeVar("_T", bound=Value)

Get = Callable[[State], _T]
Put = Callable[[_T], Awaitable[object]]

DTYPES: Mapping[type[Value], Dtype] = {
    bool: "boolean",
    int: "integer",
    float: "number",
    str: "string",
}
TEXT_DTYPE = "|S64"
NUMPY_DTYPES: Mapping[type[Value], str] = {
    kind: np.dtype(kind).str for kind in (bool, int, float)
} | {str: TEXT_DTYPE}


class TwinBackend(SignalBackend[_T], Generic[_T]):
    """A member of the state.

    Args:
        link: to the twin.
        path: the value's place in the state, for sources and errors: `axes.rot_obj.position`.
        datatype: of the value.
        get: the value, from a state.
        setpoint: the last requested value, from a state; `get` if left out.
        put: request another value.
        units: of the value.
        limits: lowest and highest value, from a state.
    """

    def __init__(
        self,
        link: LabConnection,
        path: str,
        datatype: type[_T],
        get: Get[_T],
        *,
        setpoint: Get[_T] | None = None,
        put: Put[_T] | None = None,
        units: str | None = None,
        limits: Callable[[State], tuple[float, float]] | None = None,
    ) -> None:
        super().__init__(datatype)
        self._link, self._path, self._get = link, path, get
        self._setpoint = get if setpoint is None else setpoint
        self._put, self._units, self._limits = put, units, limits
        self._end: Callable[[], None] | None = None

    def source(self, name: str, read: bool) -> str:
        """Where the value comes from."""
        return f"flexdt://{self._link.address}/{self._path}"

    async def connect(self, timeout: float) -> None:
        """Connect the laboratory, if it is not yet.

        Raises:
            NotConnectedError: no answer, or the server denies access.
        """
        try:
            await self._link.connect()
        except (ConnectionLost, RpcError) as error:
            raise NotConnectedError(f"{self.source('', True)}: {error}") from error

    async def put(self, value: _T | None) -> None:
        """Ask the twin for another value.

        Raises:
            RpcError: the twin rejects the value.
        """
        if self._put is None or value is None:
            raise RuntimeError(f"{self._path} cannot be set to {value!r}")
        await self._put(cast(type[Any], self.datatype)(value))
        await self._link.fresh()

    async def get_datakey(self, source: str) -> DataKey:
        """Type, unit and limits."""
        kind = cast(type[Value], self.datatype)
        key = DataKey(dtype=DTYPES[kind], shape=[], source=source, dtype_numpy=NUMPY_DTYPES[kind])
        if self._units is not None:
            key["units"] = self._units
        if self._limits is not None:
            low, high = self._limits(await self._link.fresh())
            key["limits"] = Limits(control={"low": low, "high": high})
        return key

    async def get_reading(self) -> Reading[_T]:
        """The value now."""
        return _reading(self._get(await self._link.fresh()))

    async def get_value(self) -> _T:
        """The value now."""
        return self._get(await self._link.fresh())

    async def get_setpoint(self) -> _T:
        """The value that was last requested."""
        return self._setpoint(await self._link.fresh())

    def set_callback(self, callback: Callable[[Reading[_T]], None] | None) -> None:
        """Subscribe a callback to changes."""
        if self._end is not None:
            self._end()
            self._end = None
        if callback is not None:
            self._end = self._link.watch(_changes(self._get, callback))


def _changes(get: Get[_T], callback: Callable[[Reading[_T]], None]) -> Callable[[State], None]:
    last: list[_T] = []

    def notify(state: State) -> None:
        value = get(state)
        if not last or last[0] != value:
            last[:] = [value]
            callback(_reading(value))

    return notify


def _reading(value: _T) -> Reading[_T]:
    return Reading(value=value, timestamp=time.time(), alarm_severity=0)


def readable(backend: TwinBackend[_T]) -> SignalR[_T]:
    """A signal to read."""
    return SignalR(backend)


def settable(backend: TwinBackend[_T]) -> SignalRW[_T]:
    """A signal to read and set."""
    return SignalRW(backend)
