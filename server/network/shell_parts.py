"""The interface of the TCP shells of twin and projector to an application, and
to other processes.

The shells differ in how they read and write: lines or frames in order for the twin,
frames side by side and without copies for the projector.
"""

from __future__ import annotations

import asyncio
import logging
import pickle
from collections.abc import Awaitable, Callable, Collection
from dataclasses import dataclass
from typing import Protocol

from flexdt.protocol import AnyMethod, Codec, Connection, Prepared, RpcError
from flexdt.protocol import messages as m
from flexdt.protocol.fields import Params
from flexdt.runtime.log import LOGGER, log, traced

Observe = Callable[[str, float, int | None], None]
"""Called for every answered request: method, seconds, error code or None."""


async def answered(
    work: Awaitable[m.Response | m.Failure],
    method: str,
    *,
    trace: str,
    client: str,
    known: Collection[str],
    observe: Observe,
) -> m.Response | m.Failure:
    """Await the answer to a request, count it with its time, and log it at the level
    `debug`.

    An exception of `work` is raised, neither counted nor logged. Log lines of `work`
    carry the trace, and a method's name is cut to 100 characters.

    Args:
        work: makes the answer.
        method: requested.
        trace: id of the request in the logs.
        client: that sent it.
        known: methods; others are counted together, as "unknown".
        observe: called with method, time taken [s], and error code or None.

    Returns:
        The answer of `work`, unchanged.
    """
    clock = asyncio.get_running_loop().time
    begun = clock()
    with traced(trace):
        answer = await work
    taken = clock() - begun
    code = None
    if isinstance(answer, m.Failure):
        code = answer.error.code
    observe(method if method in known else "unknown", taken, code)
    if LOGGER.isEnabledFor(logging.DEBUG):
        log(
            "request",
            logging.DEBUG,
            trace=trace,
            client=client,
            method=method[:100],
            ms=round(1000 * taken, 3),
            code=code,
        )
    return answer


def unobserved(method: str, seconds: float, code: int | None) -> None:
    """Ignore an answered request; an `Observe` for servers without metrics."""


@dataclass(frozen=True)
class Call:
    """A request that another process has read: its validated parameters, or the error in them.

    Attributes:
        answered: whether it wants an answer (a notification does not).
    """

    id: m.Id
    method: str
    params: Params | RpcError
    answered: bool

    @property
    def message(self) -> m.Request | m.Notification:
        """The message without parameters, as it concerns the order of requests and answers."""
        if self.answered:
            return m.Request(self.id, self.method)
        return m.Notification(self.method)


@dataclass(frozen=True)
class Frozen:
    """One message that another process has read, pickled by it.

    Attributes:
        data: to be thawed when its turn comes.
        method: that it calls; empty where it calls none.
    """

    data: bytes
    method: str

    def thawed(self) -> m.Single | Call:
        """Unpickle the message: a validated call, or no call."""
        message: m.Single | Call = pickle.loads(self.data)
        return message


Read = Callable[[bytes, Connection, bool], Awaitable[Frozen | tuple[Frozen, ...]]]
"""Reads a large message of a connection apart from the loop: one message, or those of a batch.

The last argument says whether it may be urgent, and must not wait behind others that are not.
Raises `RpcError` where that takes too much.
"""


class Session(Protocol):
    """The application's state of one connection."""

    async def handle(self, method: AnyMethod, params: Params) -> object:
        """Answer a call: a result model or plain data, or raise `RpcError`."""

    def close(self) -> None:
        """End the client's session; called once, when the connection has ended."""


class Peer(Protocol):
    """A connection as the application sees it."""

    name: str

    @property
    def codec(self) -> Codec:
        """The codec of the connection."""

    def post(self, message: m.Message | Prepared, slot: str | None = None) -> None:
        """Send an event: the newest of its `slot`, or (None) in order with all others."""

    def close(self, reason: str) -> None:
        """End the connection after the queue has been sent."""


Open = Callable[[Peer], Session]
"""Opens the application's state of a connection that has been made (and let in)."""
