"""Who is next for heavy work: the controller, then the clients in rotation.

Many connections that ask for dear work at once wait for each other; who controls the
scanner waits for one piece of work at most. The requester is that of the task's context,
so that whatever asks for work on a client's behalf has the client's turn.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Final

from flexdt.protocol.rpc_errors import busy


@dataclass(frozen=True)
class Requester:
    """For whom a task works.

    Attributes:
        who: the client, hashable; None for the server itself.
        first: returns whether it goes before the others, asked when a place is free.
    """

    who: object
    first: Callable[[], bool]


_SERVER: Final = Requester(None, lambda: True)
REQUESTER: Final[ContextVar[Requester]] = ContextVar("flexdt_requester", default=_SERVER)
"""Requester of the running task; the server's own work goes first."""


class FairTurns:
    """Some places, which those who wait get by client in rotation, the first ones first.

    Args:
        count: of places.
        most: requests that may wait; None for any number.
    """

    def __init__(self, count: int, most: int | None = None) -> None:
        """Begin with all places free."""
        self._free = count
        self._most = most
        self._waiting: OrderedDict[
            object, deque[tuple[Requester, asyncio.Future[None]]]
        ] = OrderedDict()

    async def __aenter__(self) -> None:
        """Take a place, once it is the requester's turn.

        Raises:
            RpcError: -32003, `most` requests wait already and this is none that goes
                first.
        """
        requester = REQUESTER.get()
        if self._free and not self._waiting:
            self._free -= 1
            return
        waiting = sum(map(len, self._waiting.values()))
        if self._most is not None and waiting >= self._most and not requester.first():
            raise busy(
                f"{waiting} requests for such work wait already; try again later",
                {"asked": waiting + 1, "allowed": self._most},
            )
        turn = asyncio.get_running_loop().create_future()
        queue = self._waiting.setdefault(requester.who, deque())
        queue.append((requester, turn))
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self._give()  # it came together with the end of who waited
            raise

    async def __aexit__(self, *_: object) -> None:
        self._give()

    def _give(self) -> None:
        """Give a place to the next who waits; canceled ones are skipped."""
        while self._waiting:
            who = next(
                (w for w, queue in self._waiting.items() if queue[0][0].first()),
                next(iter(self._waiting)),
            )
            queue = self._waiting.pop(who)
            _, turn = queue.popleft()
            if queue:  # behind the others
                self._waiting[who] = queue
            if not turn.done():
                turn.set_result(None)
                return
        self._free += 1
