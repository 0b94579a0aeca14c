"""Requests that wait for their answers, by id: the state of one connection, for both shells.

It refuses to send, read and wait (see `link` and `async_link`).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Generic, TypeVar

from flexdt.clients.transport import ConnectionLost
from flexdt.protocol import (
    Batch,
    Code,
    Failure,
    Malformed,
    Message,
    Notification,
    Request,
    Response,
    RpcError,
)

_W = TypeVar("_W")


class Answers(Generic[_W]):
    """Waiters of one connection.

    Args:
        on_event: called with each event's params.

    Attributes:
        reason: an error about the whole connection.
    """

    def __init__(self, on_event: Callable[[Mapping[str, object]], None]) -> None:
        self._on_event = on_event
        self._ids = itertools.count(1)
        self._waiting: dict[int, _W] = {}
        self.reason: RpcError | None = None

    def expect(self, method: str, params: Mapping[str, object], waiter: _W) -> Request:
        """The request to send; its answer will be `waiter`'s.

        Raises:
            TypeError: a name in `params` is no text, which no server could read.
        """
        _require_text_names(params, method)
        id = next(self._ids)
        self._waiting[id] = waiter
        return Request(id, method, dict(params))

    def forget(self, request: Request) -> None:
        """Nobody waits for this answer any more."""
        if isinstance(request.id, int):
            self._waiting.pop(request.id, None)

    def take(self, message: Message) -> Iterator[tuple[_W, Response | Failure]]:
        """Who gets an answer by this message."""
        match message:
            case Batch(items):
                for item in items:
                    yield from self.take(item)
            case Response(id) | Failure(id) if isinstance(id, int):
                waiter = self._waiting.get(id)
                if waiter is not None:
                    yield waiter, message
            case Failure(None, RpcError(code=Code.PARSE)):
                # One of ours could not be read, not even its id: no other answer will come to it.
                for waiter in self.waiting():
                    yield waiter, message
            case Failure(_, error):
                self.reason = error
            case Malformed(error):
                self.reason = error
            case Notification("event", params) if isinstance(params, Mapping):
                self._on_event(params)

    def waiting(self) -> list[_W]:
        """Who has got none."""
        return list(self._waiting.values())

    def lost(self, *, sent: bool) -> ConnectionLost:
        """The error of those who wait when the connection ends."""
        why = "" if self.reason is None else f": {self.reason.message}"
        return ConnectionLost(f"the server ended the connection{why}", sent=sent)


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


def result(answer: Response | Failure) -> object:
    """What the server answered.

    Raises:
        RpcError: an error.
    """
    if isinstance(answer, Failure):
        raise answer.error
    return answer.result
