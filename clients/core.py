"""One client's connection policy, for both shells: greet, reconnect with back-off, subscribe again.

A call that only reads is repeated after a reconnect. One that acts is repeated only if it never
went out; otherwise the caller is told that nobody knows whether it was carried out. Moves are
never repeated silently. It refuses to wait: it yields what is to be done (see `flows`).
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Mapping
from typing import Any, Final, Protocol, TypeVar

from flexdt.clients.flows import Alone, Ask, Drop, Effect, Exchange, Flow, Open, Pause
from flexdt.clients.transport import ConnectionLost
from flexdt.protocol import METHODS, PROTOCOL, RpcError, parse_result
from flexdt.protocol.results import HelloResult

FIRST_PAUSE_S: Final = 0.05
LONGEST_PAUSE_S: Final = 1.0
ATTEMPTS: Final = 3

_R = TypeVar("_R")


class Link(Protocol):
    """An open connection, as far as the policy looks at it.

    Attributes:
        alive: until the connection has ended.
        reason: what the server said about the whole connection before it ended.
    """

    alive: bool
    reason: RpcError | None


class Listener(Protocol):
    """Takes events of its topics."""

    topics: tuple[str, ...]

    def put(self, params: Mapping[str, object]) -> None:
        """Take an event's params."""

    def connection_lost(self) -> None:
        """The connection has ended; the client may come back."""

    def end(self) -> None:
        """Nothing will come any more."""


class Core:
    """What a client remembers between calls.

    Args:
        name: of this program, for the server's people.
        token: where the server wants one.
        timeout_s: for an answer.
        reconnect_s: how long to try after a connection has been lost.
        wait_s: how long to try at first (a server that is just starting).
        clock: real seconds.
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
        self._listeners: dict[Listener, dict[str, object]] = {}

    def run(self, flow: Flow[_R]) -> Flow[_R]:
        """A method's flow with its `Ask`s turned into what a shell can do."""
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
            ConnectionLost: nobody answers, or the client is closed.
            RpcError: the server does not let us in.
        """
        if not self.closed and self.link is not None and self.link.alive:
            return self.link
        link: Link = yield Alone(self._join())
        return link

    def subscribe(self, listener: Listener, options: Mapping[str, object]) -> Flow[None]:
        """Send `listener` its topics' events, also after reconnects.

        Raises:
            ValueError: another listener follows one of the topics with other options; the server
                keeps one set of them a topic and connection.
        """
        params = {
            "topics": list(listener.topics),
            **{k: v for k, v in options.items() if v is not None},
        }
        for other, theirs in list(self._listeners.items()):
            for topic in set(listener.topics) & set(other.topics):
                _require_same(topic, params, theirs)
        self._listeners[listener] = params
        try:
            yield from self._call(Ask("state.subscribe", params))
        except BaseException:
            self._listeners.pop(listener, None)
            raise

    def unsubscribe(self, listener: Listener) -> Flow[None]:
        """Send it no more; topics that nobody else wants are cancelled at the server."""
        self._listeners.pop(listener, None)
        still = {topic for other in list(self._listeners) for topic in other.topics}
        gone = [topic for topic in listener.topics if topic not in still]
        link = self.link
        if gone and link is not None and link.alive:
            # A failure means that they end with the connection.
            with contextlib.suppress(ConnectionLost, TimeoutError, RpcError):
                yield Exchange(link, "state.unsubscribe", {"topics": gone}, self.timeout_s)

    def close(self) -> Flow[None]:
        """End the connection and all subscriptions."""
        self.closed = True
        link, self.link = self.link, None
        listeners = list(self._listeners)
        self._listeners.clear()
        for listener in listeners:
            listener.end()
        if link is not None:
            yield Drop(link)

    def deliver(self, params: Mapping[str, object]) -> None:
        """An event has come."""
        topic = params.get("topic")
        for listener in list(self._listeners):
            if topic in listener.topics:
                listener.put(params)

    def ended(self) -> None:
        """A connection has ended."""
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
        """Connect, unless somebody has; one at a time."""
        patience = self.wait_s if self.hello is None else self.reconnect_s
        deadline = self._clock() + patience
        pause = FIRST_PAUSE_S
        while True:
            if self.closed:
                raise ConnectionLost("the client is closed")
            if self.link is not None and self.link.alive:
                return self.link
            try:
                yield from self._greet()
                continue
            except ConnectionLost:
                if self._clock() + pause > deadline:
                    raise
            yield Pause(pause)
            pause = min(2 * pause, LONGEST_PAUSE_S)

    def _greet(self) -> Generator[Effect, Any, None]:
        link: Link = yield Open()
        try:
            params: dict[str, object] = {"protocol": PROTOCOL, "client": self._name}
            if self._token is not None:
                params["token"] = self._token
            answer = yield Exchange(link, "session.hello", params, self.timeout_s)
            hello = parse_result(HelloResult, answer)
            for wanted in list(self._listeners.values()):
                yield Exchange(link, "state.subscribe", wanted, self.timeout_s)
        except ConnectionLost:
            yield Drop(link)
            if link.reason is not None:  # e.g. too many clients: trying again is no help
                raise link.reason from None
            raise
        except BaseException:
            yield Drop(link)
            raise
        if self.closed:  # by another thread or task, meanwhile
            yield Drop(link)
            raise ConnectionLost("the client is closed")
        self.link, self.hello = link, hello


__all__ = ["ATTEMPTS", "Core", "Link", "Listener"]


def _require_same(topic: str, asked: Mapping[str, object], known: Mapping[str, object]) -> None:
    view = ("projection_kind", "projection_binning") if topic == "projection" else ()
    for name in ("max_rate_hz", *view):
        if asked.get(name) != known.get(name):
            raise ValueError(
                f"{topic} with {name} {asked.get(name)}: this client follows it with "
                f"{known.get(name)} already; use the same, or another client"
            )
