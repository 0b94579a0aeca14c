"""One connection's life in threads: requests and their answers, events to whoever listens.

A thread reads; any number of threads ask. When the connection ends, whoever waits gets
`ConnectionLost`, and the link is of no more use: making a new one is `core`'s business.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from flexdt.clients.answers import Answers, result
from flexdt.clients.transport import Transport
from flexdt.protocol import Failure, Message, Response, RpcError


class _Waiter:
    """A request that waits for its answer."""

    def __init__(self) -> None:
        self.here = threading.Event()
        self.answer: Response | Failure | None = None


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
        self._transport, self._on_end = transport, on_end
        self._answers: Answers[_Waiter] = Answers(on_event)
        self._lock = threading.Lock()
        self.alive = True
        transport.open()
        self._thread = threading.Thread(target=self._read, name="flexdt-link", daemon=True)
        self._thread.start()

    @property
    def reason(self) -> RpcError | None:
        """What the server said about the connection as a whole."""
        return self._answers.reason

    @reason.setter
    def reason(self, value: RpcError | None) -> None:
        self._answers.reason = value

    def request(self, method: str, params: Mapping[str, object], timeout_s: float | None) -> object:
        """Ask and wait for the answer.

        Raises:
            RpcError: the server's answer is an error.
            ConnectionLost: the connection ended; `.sent` says whether the request had gone out.
            TimeoutError: no answer in time.
        """
        waiter = _Waiter()
        with self._lock:
            if not self.alive:
                raise self._answers.lost(sent=False)
            request = self._answers.expect(method, params, waiter)
        try:
            self._transport.send(request)
            if not waiter.here.wait(timeout_s):
                raise TimeoutError(f"no answer to {method} within {timeout_s:g} s")
        finally:
            with self._lock:
                self._answers.forget(request)
        if waiter.answer is None:
            raise self._answers.lost(sent=True)
        return result(waiter.answer)

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
                waiting = self._answers.waiting()
            for waiter in waiting:
                waiter.here.set()
            self._on_end()

    def _take(self, message: Message) -> None:
        for waiter, answer in self._answers.take(message):
            waiter.answer = answer
            waiter.here.set()
