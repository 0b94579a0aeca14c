"""A move around obstacles: free moves one after the other, found before the first one starts.

The way is planned from where the motors will rest; every leg goes through the scanner's own guard
again. Any other command to the motors ends it. The search is
`flexdt.twin.collision.obstacle_path`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from flexdt.server.scans.stage import Stage
from flexdt.server.scans.twin_clock import TwinClock
from flexdt.twin.collision.obstacle_path import free_moves
from flexdt.twin.errors import CollisionError, SafetyError, TwinError
from flexdt.twin.motion import profiles as motion
from flexdt.twin.scanner.safety import require_ready
from flexdt.twin.scanner.scanner import ScannerTwin


@dataclass(frozen=True)
class Way:
    """What a planned move does: legs in order, seconds in all, and why it is no direct move."""

    legs: tuple[Mapping[str, float], ...]
    duration_s: float
    warnings: tuple[str, ...]


@dataclass(eq=False, repr=False)
class ObstacleMoves:
    """Plans and executes paths around obstacles, one at a time.

    Attributes:
        scanner, clock, stage: see their modules.
        changed: called when a leg has started.
    """

    scanner: ScannerTwin
    clock: TwinClock
    stage: Stage
    changed: Callable[[], None]
    _task: asyncio.Task[None] | None = None
    _commands: int = 0

    def cancel(self) -> None:
        """Another command has come: no further leg starts, and no way that is being planned."""
        self._commands += 1
        if self._task is not None:
            self._task.cancel()
            self._task = None

    async def plan(
        self, targets: Mapping[str, float], *, relative: bool = False, shortest: bool = False
    ) -> Way:
        """A free way from where the motors will rest.

        Raises:
            UnknownNameError, LimitError, SafetyError: as a move.
            CollisionError: no free way was found; nothing moves.
            SafetyError: another command came meanwhile; nothing moves.
        """
        commands = self._commands
        way = await self._plan(targets, relative=relative, shortest=shortest)
        if commands != self._commands:
            raise SafetyError(
                "another command came while the way was being planned; nothing moves",
                {"asked": dict(targets), "allowed": "asking again"},
            )
        return way

    async def _plan(self, targets: Mapping[str, float], *, relative: bool, shortest: bool) -> Way:
        scanner = self.scanner
        require_ready(scanner.safety, "motion")
        goal = scanner.resolve(targets, self.clock.now(), relative=relative, shortest=shortest)
        start = scanner.final_positions()
        scene = await asyncio.to_thread(self.stage.scene, scanner.sample, scanner.parameters)
        if scene is None:
            return self._way(start, [goal])
        found, contact = await asyncio.to_thread(
            free_moves, scene, scanner.machine, start, goal, scanner.paces
        )
        if found is not None and len(found) <= 1:
            return self._way(start, found)
        pair = ("?", "?") if contact is None else contact.pair
        if found is None:
            raise CollisionError(
                f"no free way to {_text(goal)} was found: {' and '.join(pair)} would collide on "
                "the direct one",
                {
                    "asked": dict(goal),
                    "pair": list(pair),
                    "last_free": {} if contact is None else dict(contact.last_free),
                    "allowed": "a target or an order of moves without contact",
                },
            )
        order = "; then ".join(_text(leg) for leg in found)
        warning = f"{' and '.join(pair)} would collide on the direct way; going {order}"
        return self._way(start, found, warning)

    def go(self, way: Way) -> asyncio.Task[None]:
        """Set off; the task is done when the last leg has ended, or fails where one cannot go."""
        self.cancel()
        self._task = asyncio.create_task(self._legs(way))
        return self._task

    async def _legs(self, way: Way) -> None:
        scanner, clock = self.scanner, self.clock
        mine: int | None = None
        """The programme of the last leg; another one is somebody else's."""
        for leg in way.legs:
            await clock.at_rest(scanner.rest_time)
            if mine is not None and scanner.programmes != mine:
                raise SafetyError(
                    "other motion has begun or motion was stopped; no further leg starts",
                    {"asked": dict(leg), "allowed": "asking again"},
                )
            scanner.move(leg, clock.now())
            mine = scanner.programmes
            self.changed()
        await clock.at_rest(scanner.rest_time)

    def _way(
        self, start: Mapping[str, float], legs: Sequence[Mapping[str, float]], *warnings: str
    ) -> Way:
        seconds, here = 0.0, dict(start)
        for leg in legs:
            moves = {axis: (here[axis], 0.0, value) for axis, value in leg.items()}
            ends = [motion.move(*m, *self.scanner.settings(a), 0.0).end for a, m in moves.items()]
            seconds += max(ends, default=0.0)
            here.update(leg)
        return Way(tuple(legs), seconds, warnings)


async def finished(task: asyncio.Task[None]) -> list[str]:
    """Wait for a way to be gone; what ended it early, as warnings."""
    await asyncio.wait([task])
    if task.cancelled():
        return ["another command ended the way before its last leg"]
    error = task.exception()
    if error is None:
        return []
    if isinstance(error, TwinError):
        return [error.message]
    raise error


def _text(leg: Mapping[str, float]) -> str:
    return ", ".join(f"{axis}={value:g}" for axis, value in leg.items())
