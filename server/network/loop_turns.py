"""Which request is served next: connections take turns, urgent lanes go first."""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque

FIRST, URGENT, ORDINARY = range(3)
"""Lanes by priority: E-stop; stop, abort and ping; everything else."""
_Lane = OrderedDict[object, deque[asyncio.Future[None]]]


class LoopTurns:
    """One turn is given in each turn of the loop; within a lane, connections alternate.

    Between two requests the loop polls its sockets, so an E-stop is received after at
    most one request of another connection, however many are queued.
    """

    def __init__(self) -> None:
        """Begin with three empty lanes."""
        self._lanes: tuple[_Lane, ...] = (OrderedDict(), OrderedDict(), OrderedDict())
        self._due = False

    async def take(self, who: object, lane: int) -> None:
        """Wait for a turn of connection `who` in a lane; within a lane connections alternate.

        One turn is given in each round of the loop: to the lowest lane in which anybody waits.

        `who`: the connection, hashable; `lane`: FIRST, URGENT or ORDINARY.
        """
        loop = asyncio.get_running_loop()
        turn = loop.create_future()
        self._lanes[lane].setdefault(who, deque()).append(turn)
        if not self._due:
            self._due = True
            loop.call_soon(self._give_turn)
        await turn

    def _give_turn(self) -> None:
        """Give the first waiting connection of the most urgent lane its turn.

        Its further waits come last in the lane. Canceled waits are skipped. Scheduled
        for the next round of the loop again if others wait; nothing if nobody does.
        """
        self._due = False
        for lane in self._lanes:
            while lane:
                who, waiting = lane.popitem(last=False)
                turn = waiting.popleft()
                if waiting:
                    lane[who] = waiting
                if not turn.done():  # cancelled: its connection is gone
                    turn.set_result(None)
                    if any(self._lanes):
                        self._due = True
                        asyncio.get_running_loop().call_soon(self._give_turn)
                    return
