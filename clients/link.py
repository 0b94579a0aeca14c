"""One connection's life: requests and their answers by id, events to whoever listens.

A thread reads; any number of threads ask. When the connection ends, whoever waits gets
`ConnectionLost`, and the link is of no more use: making a new one is `client`'s business.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Mapping

from flexdt.clients.transport import ConnectionLost, Transport
from flexdt.protocol import (
    Batch,
    Failure,
    Malformed,
    Message,
    Notification,
    Request,
    Response,
    RpcError,
)


class _Answer:
    """A request that waits for its answer."""

    def __init__(self) -> None:
        self.here = threading.Event()
        self.message: Response | Failure | None = None


class Link:
    """An open connection.

    Args:
        transport: opened here.
        on_event: called from the reading thread with each event's params.
        on_end: called from the reading thread when the connection has ended.

    Raises:
        ConnectionLost: nobody answers.
    """

    def __init__(
        self,
        transport: Transport,
        on_event: Callable[[Mapping[str, object]], None],
        on_end: Callable[[], None],
    ) -> None:
        self._transport = transport
        self._on_event, self._on_end = on_event, on_end
        self._ids = itertools.count(1)
        self._lock = threading.Lock()
        self._waiting: dict[int, _Answer] = {}
        self.alive = True
        self.reason: RpcError | None = None
        transport.open()
        self._thread = threading.Thread(target=self._read, name="flexdt-link", daemon=True)
        self._thread.start()

    def request(self, method: str, params: Mapping[str, object], timeout_s: float | None) -> object:
        """Ask and wait for the answer.

        Raises:
            RpcError: the server's answer is an error.
            ConnectionLost: the connection ended; `.sent` says whether the request had gone out.
            TimeoutError: no answer in time.
        """
        answer = _Answer()
        with self._lock:
            if not self.alive:
                raise self._lost(sent=False)
            id = next(self._ids)
            self._waiting[id] = answer
        try:
            self._transport.send(Request(id, method, dict(params)))
            if not answer.here.wait(timeout_s):
                raise TimeoutError(f"no answer to {method} within {timeout_s:g} s")
        finally:
            with self._lock:
                self._waiting.pop(id, None)
        match answer.message:
            case Response(_, result):
                return result
            case Failure(_, error):
                raise error
        raise self._lost(sent=True)

    def close(self) -> None:
        """End the connection; waiting requests fail."""
        self._transport.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(5.0)

    def _read(self) -> None:
        try:
            while messages := self._transport.receive():
                for message in messages:
                    self._take(message)
        finally:
            with self._lock:
                self.alive = False
                waiting = list(self._waiting.values())
            for answer in waiting:
                answer.here.set()
            self._on_end()

    def _take(self, message: Message) -> None:
        match message:
            case Batch(items):
                for item in items:
                    self._take(item)
            case Response(id) | Failure(id) if isinstance(id, int):
                with self._lock:
                    answer = self._waiting.get(id)
                if answer is not None:
                    answer.message = message
                    answer.here.set()
            case Failure(_, error):
                self.reason = error
            case Malformed(error):
                self.reason = error
            case Notification("event", params) if isinstance(params, Mapping):
                self._on_event(params)

    def _lost(self, *, sent: bool) -> ConnectionLost:
        why = "" if self.reason is None else f": {self.reason.message}"
        return ConnectionLost(f"the server ended the connection{why}", sent=sent)
