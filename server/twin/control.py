"""Who may move: one controller at a time, everyone may watch.

Control belongs to a connection. While nobody holds it, a request that moves takes it; the end of
the connection gives it back, and so does a long silence once somebody else asks; `force` takes it
from whoever has it. The caller says which requests move.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from flexdt.protocol.rpc_errors import RpcError, busy


class Control:
    """The controller's lease; `holder` is a connection's name or None.

    Args:
        idle_s: a controller that has asked for nothing for so long gives way to whoever asks [s].
        clock: real time [s].
    """

    def __init__(
        self, idle_s: float = math.inf, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.holder: str | None = None
        self._idle_s, self._clock = idle_s, clock
        self._heard = clock()

    def heard(self, who: str) -> None:
        """`who` has asked for something: its lease runs anew."""
        if who == self.holder:
            self._heard = self._clock()

    def require(self, who: str, what: str) -> None:
        """Let `who` move: it holds control, or nobody does and it takes it.

        Raises:
            RpcError: -32003, somebody else is the controller.
        """
        expired = self._clock() - self._heard > self._idle_s
        if self.holder is None or expired:
            self.holder = who
        self.heard(who)
        if self.holder != who:
            raise self._taken(what)

    def ensure_allowed(self, who: str, what: str) -> None:
        """Let `who` go on after a wait: nobody else has become the controller meanwhile.

        Raises:
            RpcError: -32003, somebody else is the controller.
        """
        if self.holder not in (None, who):
            raise self._taken(what)

    def release(self, who: str) -> None:
        """Give control back; nothing happens if `who` does not hold it."""
        if self.holder == who:
            self.holder = None

    def force(self, who: str) -> str | None:
        """Take control from whoever has it; returns who lost it."""
        loser = self.holder if self.holder != who else None
        self.holder = who
        self.heard(who)
        return loser

    def _taken(self, what: str) -> RpcError:
        return busy(
            f"{what}: {self.holder} is the controller; session.control with action force takes "
            "control over",
            {"asked": what, "controller": self.holder, "allowed": "session.control force"},
        )
