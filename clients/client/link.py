"""One connection's life in threads: requests and their answers, events to a callback.

One thread reads; any number of threads send requests. When the connection ends, everybody who
waits gets `ConnectionLost` and the link cannot be used again: `policy` makes a new one.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from flexdt.clients.client.transport import ConnectionLost, Transport
from flexdt.protocol import Answered, Correlation, Message, Notification, ProtocolError, Role


class _Waiter:
    """A request that waits for its answer."""

    def __init__(self) -> None:
        self.done = threading.Event()
        self.answered: Answered[_Waiter] | None = None


class Link:
    """An open connection.

    Args:
        transport: opened here.
        on_event: called from the reading thread with each event's params.
        on_end: called from the reading thread when the connection has ended.

    Attributes:
        alive: until the connection has ended.
        calls: its open requests; `calls.reason` is what the server reported about the connection.

    Raises:
        ConnectionLost: no server answers.
    """

    def __init__(
        self,
        transport: Transport,
        on_event: Callable[[Mapping[str, object]], None],
        on_end: Callable[[], None],
    ) -> None:
        self._transport, self._on_event, self._on_end = transport, on_event, on_end
        self.calls: Correlation[_Waiter] = Correlation(Role.CLIENT)
        self._lock = threading.Lock()  # around every use of `calls`
        self.alive = True
        transport.open()
        self._thread = threading.Thread(target=self._read, name="flexdt-link", daemon=True)
        self._thread.start()

    def request(self, method: str, params: Mapping[str, object], timeout_s: float | None) -> object:
        """Send a request and wait for its result.

        Raises:
            RpcError: the server's answer is an error.
            ConnectionLost: the connection ended; `.sent` says whether the request had been sent.
            TimeoutError: no answer in time.
        """
        waiter, sent = _Waiter(), False
        with self._lock:
            if not self.alive:
                raise ConnectionLost.of(self.calls, sent=False)
            request = self.calls.request(method, params, waiter)
        try:
            self._transport.send(request)
            sent = True
            if not waiter.done.wait(timeout_s):
                raise TimeoutError(f"no answer to {method} within {timeout_s:g} s")
        finally:
            with self._lock:
                self.calls.abandon(request, sent=sent)
        if waiter.answered is None:
            raise ConnectionLost.of(self.calls, sent=True)
        return waiter.answered.result()

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
        except ProtocolError as violation:
            self.calls.violate(violation)
            self._transport.close()
        finally:
            with self._lock:
                self.alive = False
                waiting = self.calls.waiting()
            for waiter in waiting:
                waiter.done.set()
            self._on_end()

    def _take(self, message: Message) -> None:
        with self._lock:
            received = self.calls.receive(message)
        for item in received:
            match item:
                case Answered(waiter):
                    waiter.answered = item
                    waiter.done.set()
                case Notification("event", params) if isinstance(params, Mapping):
                    self._on_event(params)
