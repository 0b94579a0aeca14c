"""A client's connection policy, for both shells: greet, reconnect with back-off, subscribe again.

A call that only reads is repeated after a reconnect. One that acts is repeated only if it was never
sent; otherwise the caller gets an error that says that its outcome is unknown. So no move is ever
repeated silently. The policy is a set of flows (see `flows`) and does no I/O itself.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar

from flexdt.clients.client.flows import Alone, Ask, Drop, Effect, Exchange, Flow, Open, Pause
from flexdt.clients.client.transport import ConnectionLost
from flexdt.protocol import METHODS, RpcError, hello_params, parse_result
from flexdt.protocol.results import HelloResult

if TYPE_CHECKING:
    from flexdt.clients.client.transport import Link

FIRST_PAUSE_S: Final = 0.05
LONGEST_PAUSE_S: Final = 1.0
ATTEMPTS: Final = 3

_R = TypeVar("_R")


def back_off(first_s: float = FIRST_PAUSE_S) -> Iterator[float]:
    """Pauses between attempts to connect [s]: each twice the one before, at most a second."""
    pause = first_s
    while True:
        yield pause
        pause = min(2 * pause, LONGEST_PAUSE_S)


class Listener(Protocol):
    """Receives the events of its topics."""

    topics: tuple[str, ...]

    def put(self, params: Mapping[str, object]) -> None:
        """Take an event's params."""

    def connection_lost(self) -> None:
        """The connection has ended; the client may reconnect."""

    def end(self) -> None:
        """No more events will come."""


class Core:
    """A client's state between calls.

    Args:
        name: of this program, for people who look at the server.
        token: where the server requires one.
        timeout_s: for an answer [s].
        reconnect_s: how long to try after a connection has been lost [s].
        wait_s: how long to try the first time, for a server that is just starting [s].
        clock: monotonic time [s].
    """

    def __init__(
        self,
        *,
        name: str,
        token: str | None = None,
        timeout_s: float = 30.0,
        reconnect_s: float = 10.0,
        wait_s: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._name, self._token, self._clock = name, token, clock
        self.timeout_s, self.reconnect_s, self.wait_s = timeout_s, reconnect_s, wait_s
        self.hello: HelloResult | None = None
        self.link: Link | None = None
        self.closed = False
        self._listeners: dict[Listener, Mapping[str, object]] = {}

    def run(self, flow: Flow[_R]) -> Flow[_R]:
        """A method's flow with each `Ask` replaced by effects that a shell can perform."""
        given: Any = None
        failed: BaseException | None = None
        while True:
            try:
                effect = flow.send(given) if failed is None else flow.throw(failed)
            except StopIteration as end:
                result: _R = end.value
                return result
            given, failed = None, None
            try:
                given = (yield from self._call(effect)) if isinstance(effect, Ask) else (
                    yield effect
                )  # fmt: skip
            except GeneratorExit:
                flow.close()
                raise
            except BaseException as error:
                failed = error

    def connected(self) -> Flow[Link]:
        """A link that is alive.

        Raises:
            ConnectionLost: no server answers, or the client is closed.
            RpcError: the server refuses the client.
        """
        if not self.closed and self.link is not None and self.link.alive:
            return self.link
        link: Link = yield Alone(self._join())
        return link

    def subscribe(self, listener: Listener, options: Mapping[str, object]) -> Flow[None]:
        """Send `listener` its topics' events, also after reconnects.

        Raises:
            ValueError: another listener follows one of the topics with other options; the server
                keeps one set of options for each topic of a connection.
        """
        params = {
            "topics": list(listener.topics),
            **{k: v for k, v in options.items() if v is not None},
        }
        self.follow(listener, params)
        try:
            yield from self._call(Ask("state.subscribe", params))
        except BaseException:
            self._listeners.pop(listener, None)
            raise

    def follow(self, listener: Listener, params: Mapping[str, object]) -> None:
        """Have `listener` subscribed with these params whenever a connection is made.

        Raises:
            ValueError: as `subscribe`.
        """
        for other, theirs in list(self._listeners.items()):
            for topic in set(listener.topics) & set(other.topics):
                _require_same(topic, params, theirs)
        self._listeners[listener] = params

    def unsubscribe(self, listener: Listener) -> Flow[None]:
        """Send it no more events; cancel topics without another listener at the server."""
        self._listeners.pop(listener, None)
        still = {topic for other in list(self._listeners) for topic in other.topics}
        gone = [topic for topic in listener.topics if topic not in still]
        link = self.link
        if gone and link is not None and link.alive:
            # If this fails, the connection has ended and the subscriptions with it.
            with contextlib.suppress(ConnectionLost, TimeoutError, RpcError):
                yield Exchange(link, "state.unsubscribe", {"topics": gone}, self.timeout_s)

    def close(self) -> Flow[None]:
        """End the connection and all subscriptions."""
        self.closed = True
        listeners = list(self._listeners)
        self._listeners.clear()
        for listener in listeners:
            listener.end()
        yield from self.disconnect()

    def disconnect(self) -> Flow[None]:
        """End the connection; another one may be made, with the same subscriptions."""
        link, self.link = self.link, None
        if link is not None:
            yield Drop(link)

    def deliver(self, params: Mapping[str, object]) -> None:
        """Pass an event's params to its listeners."""
        topic = params.get("topic")
        for listener in list(self._listeners):
            if topic in listener.topics:
                listener.put(params)

    def ended(self) -> None:
        """Tell the listeners that the connection has ended."""
        for listener in list(self._listeners):
            listener.connection_lost()

    def _call(self, asked: Ask) -> Flow[object]:
        patience = asked.patience_s
        limit = self.timeout_s if patience is not None and patience < 0 else patience
        for attempt in range(ATTEMPTS):
            link = yield from self.connected()
            try:
                answer: object = yield Exchange(link, asked.method, asked.params, limit)
            except ConnectionLost as lost:
                if attempt == ATTEMPTS - 1 or self.closed:
                    raise
                if lost.sent and not METHODS[asked.method].safe:
                    raise ConnectionLost(
                        f"{lost} during {asked.method}: it is not known whether it was carried "
                        "out; it was not repeated",
                        sent=True,
                    ) from lost
            else:
                return answer
        raise AssertionError("unreachable")

    def _join(self) -> Flow[Link]:
        """Connect, unless another call has done so meanwhile."""
        patience = self.wait_s if self.hello is None else self.reconnect_s
        deadline = self._clock() + patience
        pauses = back_off()
        while True:
            if self.closed:
                raise ConnectionLost("the client is closed")
            if self.link is not None and self.link.alive:
                return self.link
            try:
                yield from self._greet()
                continue
            except ConnectionLost:
                pause = next(pauses)
                if self._clock() + pause > deadline:
                    raise
            yield Pause(pause)

    def _greet(self) -> Generator[Effect, Any, None]:
        link: Link = yield Open()
        try:
            params = hello_params(self._name, self._token)
            answer = yield Exchange(link, "session.hello", params, self.timeout_s)
            hello = parse_result(HelloResult, answer)
            for wanted in list(self._listeners.values()):
                yield Exchange(link, "state.subscribe", wanted, self.timeout_s)
        except ConnectionLost:
            yield Drop(link)
            if link.calls.reason is not None:  # e.g. too many clients: trying again is no help
                raise link.calls.reason from None
            raise
        except BaseException:
            yield Drop(link)
            raise
        if self.closed:  # by another thread or task, meanwhile
            yield Drop(link)
            raise ConnectionLost("the client is closed")
        self.link, self.hello = link, hello


__all__ = ["ATTEMPTS", "Core", "Listener"]


def _require_same(topic: str, asked: Mapping[str, object], known: Mapping[str, object]) -> None:
    view = ("projection_kind", "projection_binning") if topic == "projection" else ()
    for name in ("max_rate_hz", *view):
        if asked.get(name) != known.get(name):
            raise ValueError(
                f"{topic} with {name} {asked.get(name)}: this client follows it with "
                f"{known.get(name)} already; use the same, or another client"
            )
