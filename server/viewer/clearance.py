"""How near things are to touching, for warnings and highlights; computed beside the drawing.

The twin sweeps every motion before it starts; this only shows where the machine stands now. Where
the state carries a clearance that one is taken, else it follows from the same collision scene. At
most a few times a second, in a thread, for the newest state. It refuses to forbid anything.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass

from flexdt.protocol.state import SampleState, State
from flexdt.server.viewer.sample import Wardrobe
from flexdt.server.viewer.tasks import watched
from flexdt.server.viewer.world import motors, offset_of
from flexdt.twin.collision import Scene, build_scene, clearance, convex_pieces
from flexdt.twin.errors import TwinError
from flexdt.twin.machine import Machine, Profile

INTERVAL_S = 0.2
CLOSE_MM = 20.0


@dataclass(frozen=True)
class Near:
    """The nearest pair of parts that may not touch."""

    mm: float | None = None
    pair: tuple[str, ...] = ()

    @property
    def close(self) -> bool:
        """Whether people should be warned."""
        return self.mm is not None and self.mm < CLOSE_MM

    def document(self) -> dict[str, object]:
        """For pages."""
        return {"mm": self.mm, "pair": list(self.pair), "close": self.close}


class Nearness:
    """The clearance of the newest state.

    Args:
        machine, profile: whose bodies.
        wardrobe: shapes of samples.
        news: called when another clearance has been found.
    """

    def __init__(
        self, machine: Machine, profile: Profile, wardrobe: Wardrobe, news: Callable[[], None]
    ) -> None:
        self._machine, self._profile, self._wardrobe = machine, profile, wardrobe
        self._news = news
        self.newest = Near()
        self._scene: Scene | None = None
        self._sample: SampleState | None = None
        self._asked: State | None = None
        self._last: dict[str, float] | None = None
        self._task: asyncio.Task[None] | None = None

    def ask(self, state: State) -> None:
        """Work out the clearance of `state` soon."""
        self._asked = state
        if self._machine.components and self.idle:
            self._task = watched(self._work(), "working out the clearance")

    @property
    def idle(self) -> bool:
        """Whether nothing is being worked out."""
        return self._task is None or self._task.done()

    def forget(self) -> None:
        """The sample's shape is known better than before."""
        self._scene = self._last = None

    async def _work(self) -> None:
        while (state := self._asked) is not None:
            self._asked = None
            before = self.newest
            if state.safety.clearance_mm is not None:
                self.newest = Near(state.safety.clearance_mm, tuple(state.safety.pair or ()))
            else:
                positions = motors(self._machine, state)
                if positions != self._last or state.sample != self._sample:
                    self.newest = await asyncio.to_thread(self._measure, state, positions)
                    self._last = positions
            if self.newest != before:
                self._news()
            await asyncio.sleep(INTERVAL_S)

    def _measure(self, state: State, positions: dict[str, float]) -> Near:
        try:
            if self._scene is None or self._sample != state.sample:
                self._scene, self._sample = self._build(state), state.sample
            found = clearance(self._scene, positions)
        except TwinError:
            return Near()
        return Near(found.mm if math.isfinite(found.mm) else None, found.pair or ())

    def _build(self, state: State) -> Scene:
        phantom = self._wardrobe.phantom(state.sample)
        if phantom is None:
            return build_scene(self._machine, self._profile)
        offset = offset_of(state.sample.offset)
        pieces = convex_pieces(
            phantom.mesh(), rotation=offset.rotation, offset=(offset.x, offset.y, offset.z)
        )
        return build_scene(self._machine, self._profile, pieces)
