"""Events as typed values, and subscriptions to iterate over, blocking and asynchronous.

A subscription whose queue is full drops its oldest event, as the server would for a slow
client.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from flexdt.protocol import image, parse_result
from flexdt.protocol.methods.image_messages import ImageOrigin
from flexdt.protocol.methods.image_messages import Projection as WireProjection
from flexdt.protocol.rpc_errors import RpcError
from flexdt.protocol.state_model import ImageFlags, JobStatus, LogEntry, State

MODELS: Final[Mapping[str, type[BaseModel]]] = {
    "state": State,
    "projection": WireProjection,
    "job": JobStatus,
    "log": LogEntry,
}


@dataclass(frozen=True, eq=False, repr=False)
class Projection:
    """An X-ray image and the geometry it was made with; a notebook shows it as a picture.

    Attributes:
        image: (rows, cols), read-only; float32 line integrals or uint16 counts.
        cone_vec: twelve numbers [mm], object frame.
        kind: line_integral or counts.
        time: of the pose, on the twin's clock [s].
        flags: fractions of saturated and starved pixels, edges at which the sample is cut off.
        marks: uint8 (rows, cols), if requested: sum of 1 saturated, 2 starved, 4 cut off.
        origin: sample, tube, camera and correction that it was made of.
    """

    image: npt.NDArray[np.generic]
    cone_vec: tuple[float, ...]
    kind: str
    time: float | None = None
    flags: ImageFlags | None = None
    marks: npt.NDArray[np.generic] | None = None
    origin: ImageOrigin | None = None

    @classmethod
    def from_wire(cls, value: WireProjection) -> Projection:
        """Convert the wire's model.

        Image and marks (None without any) become arrays. Pixels are read-only arrays of
        the wire's data type and shape.

        Raises:
            RpcError: shape and data do not match.
        """
        pixels = image.from_bytes(value.data, value.dtype, value.shape)
        m = value.marks
        if m is None:
            marks = None
        else:
            marks = image.from_bytes(m.data, m.dtype, m.shape)
        return cls(
            image=pixels,
            cone_vec=tuple(value.cone_vec),
            kind=value.kind,
            time=value.time,
            flags=value.flags,
            marks=marks,
            origin=value.origin,
        )

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Return the pixels, so that `numpy.asarray(projection)` is the image."""
        if copy or (dtype is not None and np.dtype(dtype) != self.image.dtype):
            return np.array(self.image, dtype=dtype)
        return self.image

    def __repr__(self) -> str:
        """Return `<Projection COLUMNS x ROWS DTYPE, KIND, t = TIME s>`; without the time
        if it is None.
        """
        rows, cols = self.image.shape
        if self.time is None:
            at = ""
        else:
            at = f", t = {self.time:.3f} s"
        return f"<Projection {cols} x {rows} {self.image.dtype}, {self.kind}{at}>"

    def _repr_png_(self) -> bytes:
        """Return a PNG for notebooks: dense parts dark, windowed between percentiles,
        marks in color."""
        from flexdt.library.datasets.pictures import png

        return png(
            self.image, dark_is_dense=self.kind == "line_integral", marks=self.marks
        )


@dataclass(frozen=True)
class Event:
    """An event of the server.

    Attributes:
        topic: state, projection, job or log.
        seq: counts per topic; a gap means values that were overtaken.
        time: the twin's clock [s].
        data: `State`, `Projection`, `JobStatus` or `LogEntry`.
    """

    topic: str
    seq: int
    time: float
    data: State | Projection | JobStatus | LogEntry = field(repr=False)

    @classmethod
    def from_wire(cls, params: Mapping[str, object]) -> Event:
        """Validate the params of an event and build it.

        The data become a `Projection`, state, job status or log entry, by the topic. A
        boolean passes as a number; the sequence number is an integer. The error's code is
        -32603.

        Args:
            params: topic, seq, time and data, as decoded from the wire.

        Raises:
            RpcError: they are not an event of the protocol.
        """
        topic = params.get("topic")
        seq = params.get("seq")
        time = params.get("time")
        if (
            not isinstance(topic, str)
            or topic not in MODELS
            or not isinstance(seq, int)
            or not isinstance(time, (int, float))
        ):
            raise RpcError(
                -32603, f"the server sent an event that is none: topic {topic!r}"
            )
        data = parse_result(MODELS[topic], params.get("data"))
        if isinstance(data, WireProjection):
            return cls(topic, seq, float(time), Projection.from_wire(data))
        assert isinstance(data, (State, JobStatus, LogEntry))
        return cls(topic, seq, float(time), data)


class AsyncSubscription:
    """Events of some topics, oldest first; an async iterator and an async context manager.

    Entering it (or awaiting the first event) subscribes; it goes on over a lost connection.

    Attributes:
        topics: whose events come.
        dropped: number of events dropped because they were not read in time.
    """

    def __init__(
        self,
        topics: tuple[str, ...],
        max_queue: int,
        start: Callable[[AsyncSubscription], Awaitable[object]],
        keep_alive: Callable[[], Awaitable[object]],
        cancel: Callable[[AsyncSubscription], Awaitable[object]],
    ) -> None:
        """Store the subscription's parameters; nothing is sent before it is entered.

        `max_queue`: events that wait; older ones are dropped then, and counted. `start`
        subscribes, `keep_alive` reconnects, `cancel` unsubscribes.
        """
        self.topics = topics
        self.dropped = 0
        self._start = start
        self._keep_alive = keep_alive
        self._cancel = cancel
        self._max_queue = max_queue
        self._events: deque[Mapping[str, object]] = deque()
        self._stirred = asyncio.Event()
        self._started = self._lost = self._closed = False

    async def __aenter__(self) -> AsyncSubscription:
        """Subscribe unless that has happened already, and return this subscription; after
        a failure it may be entered again.
        """
        if not self._started:
            self._started = True
            try:
                await self._start(self)
            except BaseException:
                self._started = False
                raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    def __aiter__(self) -> AsyncSubscription:
        return self

    async def __anext__(self) -> Event:
        return await self.next()

    async def next(self, timeout_s: float | None = None) -> Event:
        """Wait for the next event and return it; reconnect after a lost connection.

        Subscribes first, unless that has happened. The time limit is for each wait, and
        not for reconnecting. Events at hand come first, also after `close`. Only the wait
        for an event is limited; the flag of a lost connection is cleared before
        reconnecting.

        Args:
            timeout_s: time limit [s]; None waits for ever.

        Raises:
            TimeoutError: none came in time.
            StopAsyncIteration: the subscription was closed.
            ConnectionLost: the server does not come back.
        """
        await self.__aenter__()
        while True:
            if self._events:
                return Event.from_wire(self._events.popleft())
            if self._closed:
                raise StopAsyncIteration
            if self._lost:
                self._lost = False
                try:
                    await self._keep_alive()
                except ConnectionError:
                    if self._closed:
                        raise StopAsyncIteration from None
                    raise
                continue
            self._stirred.clear()
            try:
                async with asyncio.timeout(timeout_s) as limit:
                    await self._stirred.wait()
            except TimeoutError:
                if not limit.expired() or timeout_s is None:
                    raise
                what = " or ".join(self.topics)
                raise TimeoutError(f"no {what} event in {timeout_s:g} s") from None

    async def close(self) -> None:
        """End the subscription and unsubscribe at the twin, if it had started; an
        iteration in another task ends. A second call does nothing.
        """
        if not self._closed:
            self.end()
            if self._started:
                await self._cancel(self)

    def put(self, params: Mapping[str, object]) -> None:
        """Append an event and wake the waiting `next`; drop and count the oldest event if
        `max_queue` are waiting.
        """
        if len(self._events) >= self._max_queue:
            self._events.popleft()
            self.dropped += 1
        self._events.append(params)
        self._stirred.set()

    def connection_lost(self) -> None:
        """Mark the connection as lost; `next` reconnects (called by the client)."""
        self._lost = True
        self._stirred.set()

    def end(self) -> None:
        """End the iteration after the events at hand (called by the client)."""
        self._closed = True
        self._stirred.set()


class Subscription:
    """Events of some topics, oldest first; an iterator and a context manager.

    It continues after a lost connection: the client reconnects and subscribes again.

    Args:
        events: the subscription in the client's event loop.
        wait: runs a coroutine there and waits for its result.
    """

    def __init__(
        self, events: AsyncSubscription, wait: Callable[[Coroutine[Any, Any, Any]], Any]
    ) -> None:
        self._events = events
        self._wait = wait

    @property
    def dropped(self) -> int:
        """Number of events that were dropped because they were not read in time."""
        return self._events.dropped

    def __enter__(self) -> Subscription:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Subscription:
        return self

    def __next__(self) -> Event:
        return self.next()

    def next(self, timeout_s: float | None = None) -> Event:
        """Wait for the next event and return it.

        Blocks the calling thread; `timeout_s` is the limit [s], None waits for ever.
        Subscribes first if necessary.

        Raises:
            TimeoutError: none came in time.
            StopIteration: the subscription was closed.
            ConnectionLost: the server cannot be reached any more.
        """
        try:
            found: Event = self._wait(self._events.next(timeout_s))
        except StopAsyncIteration:
            raise StopIteration from None
        return found

    def close(self) -> None:
        """Stop listening; an iteration in another thread ends."""
        self._wait(self._events.close())
