"""Events as typed values, and a subscription to iterate over.

It refuses to wait for a slow reader: a full queue drops its oldest event, as the server would.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Final

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from flexdt.protocol import image, parse_result
from flexdt.protocol.errors import RpcError
from flexdt.protocol.results import Projection as WireProjection
from flexdt.protocol.state import JobStatus, LogEntry, State

MODELS: Final[Mapping[str, type[BaseModel]]] = {
    "state": State,
    "projection": WireProjection,
    "job": JobStatus,
    "log": LogEntry,
}


@dataclass(frozen=True, eq=False)
class Projection:
    """An X-ray image and the geometry it was made with.

    Attributes:
        image: (rows, cols), read-only; float32 line integrals or uint16 counts.
        cone_vec: twelve numbers [mm], object frame.
        kind: line_integral or counts.
        time: of the pose, on the twin's clock [s].
    """

    image: npt.NDArray[np.generic]
    cone_vec: tuple[float, ...]
    kind: str
    time: float | None = None

    @classmethod
    def from_wire(cls, value: WireProjection) -> Projection:
        """Make one from the wire's model.

        Raises:
            RpcError: shape and data do not match.
        """
        pixels = image.from_bytes(value.data, value.dtype, value.shape)
        return cls(pixels, tuple(value.cone_vec), value.kind, value.time)


@dataclass(frozen=True)
class Event:
    """Something the server tells.

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
        """Make one from an event's params.

        Raises:
            RpcError: not an event of the protocol.
        """
        topic, seq, time = params.get("topic"), params.get("seq"), params.get("time")
        if (
            not isinstance(topic, str)
            or topic not in MODELS
            or not isinstance(seq, int)
            or not isinstance(time, (int, float))
        ):
            raise RpcError(-32603, f"the server sent an event that is none: topic {topic!r}")
        data = parse_result(MODELS[topic], params.get("data"))
        if isinstance(data, WireProjection):
            return cls(topic, seq, float(time), Projection.from_wire(data))
        assert isinstance(data, (State, JobStatus, LogEntry))
        return cls(topic, seq, float(time), data)


class Subscription:
    """Events of some topics, oldest first; an iterator and a context manager.

    It goes on over a lost connection: the client reconnects and subscribes again.
    """

    def __init__(
        self,
        topics: tuple[str, ...],
        max_queue: int,
        keep_alive: Callable[[], None],
        cancel: Callable[[Subscription], None],
    ) -> None:
        self.topics = topics
        self.dropped = 0
        self._keep_alive, self._cancel = keep_alive, cancel
        self._queue: deque[Mapping[str, object]] = deque()
        self._max_queue = max_queue
        self._changed = threading.Condition()
        self._lost = False
        self._closed = False

    def __enter__(self) -> Subscription:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __iter__(self) -> Subscription:
        return self

    def __next__(self) -> Event:
        return self.next()

    def next(self, timeout_s: float | None = None) -> Event:
        """The next event.

        Raises:
            TimeoutError: none came in time.
            StopIteration: the subscription was closed.
            ConnectionLost: the server does not come back.
        """
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._lost or self._closed, timeout_s)
                if self._queue:
                    params = self._queue.popleft()
                    break
                if self._closed:
                    raise StopIteration
                if not self._lost:
                    raise TimeoutError(f"no {' or '.join(self.topics)} event in {timeout_s:g} s")
                self._lost = False
            try:
                self._keep_alive()
            except ConnectionError:
                if self._closed:
                    raise StopIteration from None
                raise
        return Event.from_wire(params)

    def close(self) -> None:
        """Stop listening; an iteration in another thread ends."""
        if not self._closed:
            self.end()
            self._cancel(self)

    def put(self, params: Mapping[str, object]) -> None:
        """Take an event (called by the client)."""
        with self._changed:
            if len(self._queue) >= self._max_queue:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(params)
            self._changed.notify_all()

    def connection_lost(self) -> None:
        """The client's connection has ended (called by the client)."""
        with self._changed:
            self._lost = True
            self._changed.notify_all()

    def end(self) -> None:
        """Nothing will come any more (called by the client)."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
