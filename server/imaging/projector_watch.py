"""Reports that no projector answers, so that no image can be computed now.

Each projector is asked for its health repeatedly; one that computes answers as well. A
refused or lost connection is reported at once, a silent process after `SILENT_S`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

from flexdt.protocol import RpcError
from flexdt.runtime.wire_errors import ProjectorUnavailable

ASK_EVERY_S: Final = 0.4
"""Time between an answer and the next question [s]."""
SILENT_S: Final = 1.2
"""Time after which a projector without an answer is reported [s]."""


class Sign(Protocol):
    """A projector's answer, as far as it is looked at."""

    @property
    def working(self) -> str | None:
        """What takes it long now."""


class Watched(Protocol):
    """A projector's client, as far as it is watched."""

    host: str
    port: int

    async def health(self) -> Sign:
        """Ask for the projector's load.

        Raises:
            ProjectorUnavailable: it does not answer.
        """


@dataclass(eq=False, repr=False)
class ProjectorWatch:
    """Watches the projectors of one twin.

    Attributes:
        clients: of the projectors.
        asks: whether somebody wants to know; nothing is asked before.
        changed: called whenever `problem` has changed.
        every_s: between an answer and the next question [s].
        silent_s: after which a projector that is asked does not answer [s].
        problem: why none answers, of the first one; None where any answers, or none was
            asked.
    """

    clients: Sequence[Watched]
    asks: Callable[[], bool] = lambda: True
    changed: Callable[[], None] = lambda: None
    every_s: float = ASK_EVERY_S
    silent_s: float = SILENT_S
    problem: str | None = None
    _problems: dict[Watched, str | None] = field(default_factory=dict)
    _working: dict[Watched, str | None] = field(default_factory=dict)

    @property
    def working(self) -> str | None:
        """What took a projector long at its last answer, such as a kernel that compiles."""
        return next(filter(None, self._working.values()), None)

    async def run(self) -> None:
        """Watch all projectors at once, until canceled."""
        async with asyncio.TaskGroup() as group:
            for client in self.clients:
                group.create_task(self._watch(client))

    async def _watch(self, client: Watched) -> None:
        """Check one projector, wait `every_s`, and so on until canceled; skipped while
        nobody asks.

        The wait begins when the projector has answered or failed."""
        while True:
            if self.asks():
                await self._check(client)
            await asyncio.sleep(self.every_s)

    async def _check(self, client: Watched) -> None:
        """Ask one projector for its health, and report silence, a failure, or that it
        answers.

        An error of the wire is an answer, too.

        An answer later than `silent_s` is reported and waited for.

        Args:
            client: of the projector.
        """
        answer = asyncio.ensure_future(client.health())
        working = None
        try:
            if not (await asyncio.wait([answer], timeout=self.silent_s))[0]:
                self._report(
                    client,
                    f"the projector at {client.host}:{client.port} does not answer",
                )
            working = (await answer).working
        except ProjectorUnavailable as error:
            self._report(client, str(error))
        except RpcError:  # an answer, too
            self._report(client, None)
        else:
            self._report(client, None)
        finally:
            self._working[client] = working
            answer.cancel()

    def _report(self, client: Watched, problem: str | None) -> None:
        """Record the problem of one projector (None: it answers), and announce the
        pool's.

        The pool has the first projector's problem if all have one; unchecked ones have
        none.
        """
        self._problems[client] = problem
        known = [self._problems.get(each) for each in self.clients]
        now = None if None in known else known[0]
        if now != self.problem:
            self.problem = now
            self.changed()
