"""Calls that survive a lost connection: connect, reconnect with back-off, subscribe again.

A call that only reads is repeated after a reconnect. One that acts is repeated only if it never
went out; otherwise the caller is told that nobody knows whether it was carried out. Moves are
never repeated silently.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from typing import TypeVar

from pydantic import BaseModel

from flexdt.clients.events import Subscription
from flexdt.clients.link import Link
from flexdt.clients.transport import ConnectionLost, Transport
from flexdt.protocol import METHODS, PROTOCOL, RpcError, parse_result
from flexdt.protocol.results import HelloResult

_R = TypeVar("_R", bound=BaseModel)

FIRST_PAUSE_S = 0.05
LONGEST_PAUSE_S = 1.0


class Caller:
    """A connection to a twin that comes back.

    Args:
        transport: the way to the server.
        name: of this program, for the server's people.
        token: where the server wants one.
        timeout_s: for an answer.
        reconnect_s: how long to try after a connection has been lost.
        wait_s: how long to try at first (a server that is just starting).
        sleep: for tests.

    Raises:
        ConnectionLost: nobody answers.
        RpcError: the server does not let us in.
    """

    def __init__(
        self,
        transport: Transport,
        *,
        name: str,
        token: str | None,
        timeout_s: float,
        reconnect_s: float,
        wait_s: float,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._transport, self._name, self._token = transport, name, token
        self.timeout_s, self.reconnect_s, self._sleep = timeout_s, reconnect_s, sleep
        self._lock = threading.RLock()
        self._link: Link | None = None
        self._closed = False
        self._subscriptions: dict[Subscription, dict[str, object]] = {}
        self.hello = self._connect(wait_s)

    def call(
        self,
        method: str,
        params: Mapping[str, object],
        result: type[_R],
        timeout_s: float | None = -1.0,
    ) -> _R:
        """Ask the server.

        Args:
            method: as on the wire.
            params: without those that are None.
            result: model of the answer.
            timeout_s: None waits for ever; negative takes the client's.

        Raises:
            RpcError: the server's answer is an error.
            ConnectionLost: no connection, or lost during a call that must not be repeated.
            TimeoutError: no answer in time.
        """
        given = {key: value for key, value in params.items() if value is not None}
        limit = self.timeout_s if timeout_s is not None and timeout_s < 0 else timeout_s
        for attempt in range(3):
            link = self._connected()
            try:
                return parse_result(result, link.request(method, given, limit))
            except ConnectionLost as lost:
                if attempt == 2 or self._closed:
                    raise
                if lost.sent and not METHODS[method].safe:
                    raise ConnectionLost(
                        f"{lost} during {method}: it is not known whether it was carried out; "
                        "it was not repeated",
                        sent=True,
                    ) from lost
        raise AssertionError("unreachable")

    def subscribe(
        self, topics: tuple[str, ...], options: Mapping[str, object], max_queue: int
    ) -> Subscription:
        """Listen to events of `topics`."""
        made = Subscription(topics, max_queue, self._keep_alive, self._unsubscribe)
        params = {"topics": list(topics), **{k: v for k, v in options.items() if v is not None}}
        with self._lock:
            self._subscriptions[made] = params
        try:
            self._request_subscription(self._connected(), params)
        except BaseException:
            with self._lock:
                self._subscriptions.pop(made, None)
            raise
        return made

    def close(self) -> None:
        """End the connection and all subscriptions."""
        with self._lock:
            self._closed = True
            link, self._link = self._link, None
            subscriptions = list(self._subscriptions)
            self._subscriptions.clear()
        for subscription in subscriptions:
            subscription.end()
        if link is not None:
            link.close()

    def _keep_alive(self) -> None:
        self._connected()

    def _connected(self) -> Link:
        with self._lock:
            if self._closed:
                raise ConnectionLost("the client is closed")
            if self._link is None or not self._link.alive:
                self.hello = self._connect(self.reconnect_s)
            assert self._link is not None
            return self._link

    def _connect(self, patience_s: float) -> HelloResult:
        deadline = time.monotonic() + patience_s
        pause = FIRST_PAUSE_S
        while True:
            try:
                return self._open()
            except ConnectionLost:
                if time.monotonic() + pause > deadline:
                    raise
            self._sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE_S)

    def _open(self) -> HelloResult:
        link = Link(self._transport, self._deliver, self._ended)
        try:
            params: dict[str, object] = {"protocol": PROTOCOL, "client": self._name}
            if self._token is not None:
                params["token"] = self._token
            answer = link.request("session.hello", params, self.timeout_s)
            hello = parse_result(HelloResult, answer)
            for wanted in list(self._subscriptions.values()):
                self._request_subscription(link, wanted)
        except ConnectionLost:
            link.close()
            if link.reason is not None:  # e.g. too many clients: trying again is no help
                raise link.reason from None
            raise
        except BaseException:
            link.close()
            raise
        self._link = link
        return hello

    def _request_subscription(self, link: Link, params: Mapping[str, object]) -> None:
        link.request("state.subscribe", params, self.timeout_s)

    def _unsubscribe(self, subscription: Subscription) -> None:
        with self._lock:
            self._subscriptions.pop(subscription, None)
            still = {topic for s in self._subscriptions for topic in s.topics}
            link = self._link
        gone = [topic for topic in subscription.topics if topic not in still]
        if gone and link is not None and link.alive:
            with contextlib.suppress(ConnectionLost, TimeoutError, RpcError):
                link.request("state.unsubscribe", {"topics": gone}, self.timeout_s)

    def _deliver(self, params: Mapping[str, object]) -> None:
        topic = params.get("topic")
        for subscription in list(self._subscriptions):
            if topic in subscription.topics:
                subscription.put(params)

    def _ended(self) -> None:
        for subscription in list(self._subscriptions):
            subscription.connection_lost()
