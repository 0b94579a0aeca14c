"""Requests and their answers on one connection, without a socket, for both ends of it.

`Connection` turns bytes into messages; a `Correlation` above it knows which requests have no
answer yet. A client asks and a server answers, so each role may receive only some messages:

| role   | may receive                                      | sends                          |
|--------|--------------------------------------------------|--------------------------------|
| client | answers to its own requests, notifications       | requests, notifications        |
| server | requests, notifications                          | answers, each once, and events |

Anything else is a `ProtocolError`, after which the connection cannot be trusted: if one answer has
a wrong id, the right one may have been given to somebody else. Either peer may end the stream, but
only between two messages (see `Connection.receive_end`).
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

from flexdt.protocol import messages as m
from flexdt.protocol.method import PROTOCOL
from flexdt.protocol.rpc_errors import Code, ProtocolError, RpcError, clip

_W = TypeVar("_W")


class Role(Enum):
    """Which end of a connection this is."""

    CLIENT = "client"
    SERVER = "server"


@dataclass(frozen=True)
class Answered(Generic[_W]):
    """An answer and the waiter that was registered with its request."""

    waiter: _W
    answer: m.Response | m.Failure

    def result(self) -> object:
        """The result of the request.

        Raises:
            RpcError: the answer is an error.
        """
        if isinstance(self.answer, m.Failure):
            raise self.answer.error
        return self.answer.result


class Correlation(Generic[_W]):
    """The open requests of one connection.

    `_W` is whatever the caller wants back with an answer: an event, a future, a record.
    Not thread-safe: callers that use several threads hold a lock around each call.

    Args:
        role: of this end.

    Attributes:
        reason: an error that the peer reported about the connection as a whole.
        violation: what the peer did that the protocol forbids; the connection must be closed.

    Example:
        >>> calls = Correlation[str](Role.CLIENT)
        >>> request = calls.request("session.ping", {}, "the ping's waiter")
        >>> [answered] = calls.receive(Response(request.id, {"time": 1.5}))
        >>> answered.waiter, answered.result()
        ("the ping's waiter", {'time': 1.5})
    """

    def __init__(self, role: Role) -> None:
        self.role = role
        self.reason: RpcError | None = None
        self.violation: ProtocolError | None = None
        self._ids = itertools.count(1)
        # Requests sent and not answered. The waiter is None once nobody waits any more: the
        # answer may still come, and it is not one that nobody asked for.
        self._asked: dict[m.Id, _W | None] = {}
        # Requests received and not answered; a client may use an id twice at the same time.
        self._owed: Counter[m.Id] = Counter()

    # -- the client's side -------------------------------------------------------------------

    def request(
        self, method: str, params: Mapping[str, object], waiter: _W, trace: str = ""
    ) -> m.Request:
        """A request to send, with a new id.

        Args:
            method: its name.
            params: by name; what cannot be encoded is found when the message is sent.
            waiter: comes back with the answer.
            trace: put in front of the id, so that the server's log shows what caused the request.

        Raises:
            TypeError: a name in `params` is not text, which no server could read.
        """
        _require_text_names(params, method)
        number = next(self._ids)
        id: m.Id = f"{trace}/{number}" if trace else number
        self._asked[id] = waiter
        return m.Request(id, method, dict(params))

    def abandon(self, request: m.Request, *, sent: bool = True) -> None:
        """Stop waiting for an answer.

        Args:
            request: made by `request`.
            sent: False if no byte of it was sent, so that no answer can come.
        """
        if not sent:
            self._asked.pop(request.id, None)
        elif request.id in self._asked:
            self._asked[request.id] = None

    def waiter(self, id: object) -> _W | None:
        """Who waits for the answer with this id, if anybody does."""
        return self._asked.get(id) if isinstance(id, (int, str)) else None

    def waiting(self) -> list[_W]:
        """Everybody who waits for an answer, oldest request first."""
        return [waiter for waiter in self._asked.values() if waiter is not None]

    # -- the server's side -------------------------------------------------------------------

    def owes(self, id: m.Id) -> bool:
        """Whether a request of this id has no answer yet."""
        return self._owed[id] > 0

    def answer(self, answer: m.Response | m.Failure) -> m.Response | m.Failure:
        """The answer, if it is to a request of the client that has none yet.

        An error without id is about the connection and always allowed.

        Raises:
            LookupError: no open request has this id.
        """
        if isinstance(answer, m.Response) or answer.id is not None:
            if not self._owed[answer.id]:
                raise LookupError(f"no open request has the id {answer.id!r}")
            self._owed[answer.id] -= 1
            if not self._owed[answer.id]:
                del self._owed[answer.id]  # a long connection has many ids
        return answer

    @property
    def open(self) -> int:
        """How many requests have no answer yet: sent by a client, received by a server."""
        return len(self._asked) if self.role is Role.CLIENT else self._owed.total()

    # -- both sides --------------------------------------------------------------------------

    def receive(self, message: m.Message) -> list[Answered[_W] | m.Request | m.Notification]:
        """What a message means here; the items of a batch one by one.

        Answers that nobody waits for any more are left out. A malformed message is the answer to
        the request whose id it has; on a server it must be answered by the caller, with `reply`.

        Raises:
            ProtocolError: the peer may not send this.
        """
        if self.violation is not None:
            raise self.violation
        if isinstance(message, m.Batch):
            return [found for item in message.items for found in self.receive(item)]
        if self.role is Role.SERVER:
            return self._receive_call(message)
        match message:
            case m.Notification():
                return [message]
            case m.Failure(None, RpcError(code=Code.PARSE)):
                # The server could not read one of our requests, not even its id, so no other
                # answer to that one will come; which one it was nobody knows.
                waiting = [(id, w) for id, w in self._asked.items() if w is not None]
                self._asked.update((id, None) for id, _ in waiting)
                return [Answered(waiter, message) for _, waiter in waiting]
            case m.Failure(None, error) | m.Malformed(error, None):
                self.reason = error
                if isinstance(message, m.Malformed) and message.fatal:
                    raise self._violated(error.message)
                return []
            case m.Malformed(error, id):
                return self._settle(m.Failure(id, error))
            case m.Response() | m.Failure():
                return self._settle(message)
        raise self._violated(f"the server sent a request ({clip(message.method, 40)})")

    def violate(self, violation: ProtocolError) -> None:
        """Note that the peer's bytes break the protocol (see `Connection.receive_end`)."""
        self.violation = violation

    def _settle(
        self, answer: m.Response | m.Failure
    ) -> list[Answered[_W] | m.Request | m.Notification]:
        if answer.id not in self._asked:
            raise self._violated(
                f"an answer to a request that is not open (id {clip(answer.id, 40)})"
            )
        waiter = self._asked.pop(answer.id)
        return [] if waiter is None else [Answered(waiter, answer)]

    def _receive_call(self, message: m.Message) -> list[Answered[_W] | m.Request | m.Notification]:
        match message:
            case m.Request(id):
                self._owed[id] += 1
                return [message]
            case m.Notification():
                return [message]
            case m.Malformed(_, id):
                self._owed[id] += id is not None
                return []
        raise self._violated("an answer to a server, which asks nothing")

    def _violated(self, what: str) -> ProtocolError:
        self.violation = ProtocolError(what)
        return self.violation


def hello_params(client: str, token: str | None) -> dict[str, object]:
    """Parameters of `session.hello`, with which every connection of a client begins.

    Args:
        client: name of the program, for people who look at the server.
        token: where the server wants one.
    """
    params: dict[str, object] = {"protocol": PROTOCOL, "client": client}
    return params if token is None else {**params, "token": token}


def _require_text_names(value: object, where: str) -> None:
    if isinstance(value, Mapping):
        for name, inner in value.items():
            if not isinstance(name, str):
                raise TypeError(
                    f"{where}: the name {name!r} must be text, not {type(name).__name__}"
                )
            _require_text_names(inner, f"{where}.{name}")
    elif isinstance(value, (list, tuple)):
        for inner in value:
            _require_text_names(inner, where)
