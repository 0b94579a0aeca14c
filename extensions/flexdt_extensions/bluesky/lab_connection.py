"""One connection to the twin for all of a laboratory's devices, and the newest known state.

Requests go through an `AsyncTwinClient`; one subscription serves all watchers.

The devices' signals are members of the twin's state: a backend reads by asking the twin,
receives changes from the connection's subscription, and puts through a coroutine. Values are
not cached.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import ssl as tls
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from typing import Any, Generic, TypeVar, cast

import numpy as np
from bluesky.protocols import Reading
from event_model import DataKey, Dtype, Limits
from ophyd_async.core import AsyncConfigurable, NotConnectedError, SignalBackend, SignalRW

from flexdt.clients import ConnectionLost, RpcError, State, Transport
from flexdt.clients.client.client import AsyncTwinClient

Watcher = Callable[[State], None]

RATE_HZ = 20.0
"""Largest rate of states that reach a watcher [1/s]."""

PATIENCE_S = 0.1
"""Longest wait for an event before the state is requested [s]."""

AT_EXIT_S = 2.0
"""Longest wait for a silent server at Python's end [s]."""


class LimitsExceeded(ValueError):
    """A target that the machine does not allow: beyond a limit, or in collision on the
    way.

    Attributes:
        data: the rejected and the allowed values.
    """

    def __init__(self, message: str, data: dict[str, object]) -> None:
        super().__init__(message)
        self.data = data


class LabConnection:
    """The twin, as devices need it; used from the event loop that connects it (RunEngine's).

    Args:
        host, port, token, ssl: of the twin server.
        transport: replaces TCP, such as that of a twin in process; host, port and ssl are not
            used then.

    Attributes:
        client: for all methods of the twin.
        state: the newest known; None before the first connection.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 55000,
        token: str | None = None,
        *,
        ssl: tls.SSLContext | None = None,
        transport: Transport | None = None,
    ) -> None:
        """Prepare a connection, which is made when it is first needed; no state is known.
        Arguments: see the class.
        """
        if transport is None:
            self.address = f"{host}:{port}"
        else:
            self.address = "in-process"
        self.client = AsyncTwinClient(
            host, port, token, transport, name="flexdt_extensions.bluesky", ssl=ssl
        )
        self.state: State | None = None
        self._watchers: list[Watcher] = []
        self._news = asyncio.Event()
        self._connecting = asyncio.Lock()
        self._pump: asyncio.Task[None] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    async def connect(self) -> None:
        """Connect, fetch the state and start to listen; nothing while it listens already.

        The connection is closed at the interpreter's end.

        Raises:
            ConnectionLost: no server answers.
            RpcError: the server refuses the client.
        """
        async with self._connecting:
            if self._pump is not None and not self._pump.done():
                return
            await self.client.connect()
            await self.fresh()
            self._pump = asyncio.create_task(self._listen(), name="flexdt-lab")
            self._loop = asyncio.get_running_loop()
            atexit.register(self._end_at_exit)

    async def close(self) -> None:
        """End the task that reads the connection, wait for it, and close the client."""
        atexit.unregister(self._end_at_exit)
        if self._pump is not None:
            self._pump.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._pump
        await self.client.close()

    def _end_at_exit(self) -> None:
        """Close a connection left open, if RunEngine's loop still runs in its thread;
        wait at most `AT_EXIT_S`, and drop errors.

        Python's end would destroy its waiting tasks, each with lines on standard error.
        """
        if self._loop is None or not self._loop.is_running():
            return
        ending = asyncio.run_coroutine_threadsafe(self.close(), self._loop)
        with contextlib.suppress(Exception):  # of a server that is gone
            ending.result(AT_EXIT_S)

    async def fresh(self) -> State:
        """Fetch the present state, keep it and return it; start listening again if that
        has ended because the connection was lost.
        """
        state = await self.client.state()
        self._take(state)
        if self._pump is not None and self._pump.done():  # the twin was gone for too long
            self._pump = asyncio.create_task(self._listen(), name="flexdt-lab")
        return state

    async def known(self) -> State:
        """Return the newest state that has arrived; request it where states no longer
        arrive."""
        if self.state is None or self._pump is None or self._pump.done():
            return await self.fresh()
        return self.state

    def watch(self, watcher: Watcher) -> Callable[[], None]:
        """Call `watcher` with the state known now, if any, and every new one; the
        returned function ends that.
        """
        self._watchers.append(watcher)
        if self.state is not None:
            watcher(self.state)

        def end() -> None:
            if watcher in self._watchers:
                self._watchers.remove(watcher)

        return end

    async def states(self) -> AsyncIterator[State]:
        """Yield fresh states for ever: one at once, then one after every event of the
        twin or after `PATIENCE_S` of silence.
        """
        while True:
            self._news.clear()
            yield await self.fresh()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(PATIENCE_S):
                    await self._news.wait()

    async def _listen(self) -> None:
        """Take the twin's states, and wake whoever waits in `states` at each event of
        states and jobs; return when the connection is lost.
        """
        async with self.client.subscribe("state", "job", max_rate_hz=RATE_HZ) as events:
            with contextlib.suppress(ConnectionLost):
                async for event in events:
                    if isinstance(event.data, State):
                        self._take(event.data)
                    self._news.set()

    def _take(self, state: State) -> None:
        """Keep a state unless it is older than the one before, and call all watchers with
        it.
        """
        if self.state is not None and state.time < self.state.time:
            return  # an event that is older than the answer to a request
        self.state = state
        for watcher in list(self._watchers):
            watcher(state)


class ReadBeforeDescribed(AsyncConfigurable):
    """A device whose configuration is read completely before it is described.

    Bluesky starts both at once and takes a described value for a read one, even if an
    interruption came in between.
    """

    async def describe_configuration(self) -> dict[str, DataKey]:
        """Describe the values of `read_configuration`, after reading them."""
        described = await super().describe_configuration()  # type: ignore[safe-super]
        await self.read_configuration()  # after a description started earlier
        return described


Value = bool | int | float | str
_T = TypeVar("_T", bound=Value)

Get = Callable[[State], _T]
Put = Callable[[_T], Awaitable[object]]

DTYPES: Mapping[type[Value], tuple[Dtype, str]] = {
    bool: ("boolean", np.dtype(bool).str),
    int: ("integer", np.dtype(int).str),
    float: ("number", np.dtype(float).str),
    str: ("string", "|S64"),
}
"""Names of a type in documents: JSON's, and NumPy's."""


class TwinBackend(SignalBackend[_T], Generic[_T]):
    """A member of the state.

    Args:
        link: to the twin.
        path: the value's place in the state: `axes.rot_obj.position`.
        datatype: of the value.
        put: request another value.
        get: the value, from a state, where it is not the one at `path`.
        units: of the value.
        limits: lowest and highest value, from a state.
    """

    def __init__(
        self,
        link: LabConnection,
        path: str,
        datatype: type[_T],
        put: Put[_T] | None = None,
        units: str | None = None,
        get: Get[_T] | None = None,
        limits: Callable[[State], tuple[float, float]] | None = None,
    ) -> None:
        """Make the backend of a signal.

        Args:
            link: to the twin.
            path: name in the twin's state.
            datatype: of the value.
            put: sets the value; None: read-only.
            units: of the value.
            get: reads the value from a state; the member at `path` without.
            limits: reads its limits from a state.
        """
        super().__init__(datatype)
        self._link = link
        self._path = path
        self._get = get or self._member
        self._put = put
        self._units = units
        self._limits = limits
        self._end: Callable[[], None] | None = None

    def _member(self, state: State) -> _T:
        """Get the value at `path` of the state; the zero of its type where it is None."""
        value: Any = state
        for name in self._path.split("."):
            if isinstance(value, Mapping):
                value = value[name]
            else:
                value = getattr(value, name)
        return cast(_T, cast(type[Any], self.datatype)() if value is None else value)

    def source(self, name: str, read: bool) -> str:
        """Return the address of the value."""
        return f"flexdt://{self._link.address}/{self._path}"

    async def connect(self, timeout: float) -> None:
        """Connect the laboratory, if it is not yet connected; `timeout` is not used.

        Raises:
            NotConnectedError: no answer, or the server denies access; caused by the
                connection's error.
        """
        try:
            await self._link.connect()
        except (ConnectionLost, RpcError) as error:
            raise NotConnectedError(f"{self.source('', True)}: {error}") from error

    async def put(self, value: _T | None) -> None:
        """Set the value in the twin, and fetch the state.

        Raises:
            RuntimeError: the value is None, or the member is read-only.
            RpcError: the twin rejects the value.
        """
        if self._put is None or value is None:
            raise RuntimeError(f"{self._path} cannot be set to {value!r}")
        await self._put(cast(type[Any], self.datatype)(value))
        await self._link.fresh()

    async def get_datakey(self, source: str) -> DataKey:
        """Describe type, unit and limits, the last two where there are any; limits are
        those of a fresh state.
        """
        dtype, dtype_numpy = DTYPES[cast(type[Value], self.datatype)]
        key = DataKey(dtype=dtype, shape=[], source=source, dtype_numpy=dtype_numpy)
        if self._units is not None:
            key["units"] = self._units
        if self._limits is not None:
            low, high = self._limits(await self._link.fresh())
            key["limits"] = Limits(control={"low": low, "high": high})
        return key

    async def get_reading(self) -> Reading[_T]:
        """Get the value now, as a reading."""
        return _reading(await self.get_value())

    async def get_value(self) -> _T:
        """Get the value now."""
        return self._get(await self._link.fresh())

    get_setpoint = get_value

    def set_callback(self, callback: Callable[[Reading[_T]], None] | None) -> None:
        """Call `callback` with each changed reading from now on, in place of the one before;
        None ends that.
        """
        if self._end is not None:
            self._end()
        if callback is None:
            self._end = None
        else:
            self._end = self._link.watch(_changes(self._get, callback))


def _changes(
    get: Get[_T], callback: Callable[[Reading[_T]], None]
) -> Callable[[State], None]:
    """Return a watcher of states that calls `callback` with a reading at the first state
    and whenever the value has changed.
    """
    last: list[_T] = []

    def notify(state: State) -> None:
        """Call back with a reading if the value differs from the last one, and at the
        first state.
        """
        value = get(state)
        if not last or last[0] != value:
            last[:] = [value]
            callback(_reading(value))

    return notify


def _reading(value: _T) -> Reading[_T]:
    return Reading(value=value, timestamp=time.time(), alarm_severity=0)


def settable(
    link: LabConnection,
    path: str,
    datatype: type[_T],
    put: Put[_T],
    units: str | None = None,
    get: Get[_T] | None = None,
) -> SignalRW[_T]:
    """Make a signal to read and set; arguments as those of `TwinBackend`."""
    return SignalRW(TwinBackend(link, path, datatype, put, units, get))
