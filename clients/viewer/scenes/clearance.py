"""Clearances between components, for warnings and highlights; computed beside the drawing.

The twin sweeps every motion before it starts; this only shows the machine's present clearance. A
clearance in the state is used as it is; otherwise it follows from the same collision scene, at most
a few times a second, in a thread, for the newest state.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass

from flexdt.clients.viewer.page import watched
from flexdt.clients.viewer.scenes.sample import Wardrobe
from flexdt.clients.viewer.scenes.world import motors, offset_of
from flexdt.protocol.state_model import SampleState, State
from flexdt.twin.collision.collision_scene import Scene, build_scene
from flexdt.twin.collision.sample_hull import convex_pieces
from flexdt.twin.collision.scene_search import clearance
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.description import Machine, Profile

INTERVAL_S = 0.2
CLOSE_MM = 20.0


@dataclass(frozen=True)
class Near:
    """The nearest pair of parts that may not touch."""

    mm: float | None = None
    pair: tuple[str, ...] = ()

    @property
    def close(self) -> bool:
        """Whether the clearance is small enough for a warning."""
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
        """Whether no computation is under way."""
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
            phantom.mesh(around=True),
            rotation=offset.rotation,
            offset=(offset.x, offset.y, offset.z),
        )
        return build_scene(self._machine, self._profile, pieces)
