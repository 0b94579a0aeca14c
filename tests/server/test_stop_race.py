"""Several people at E-STOP and RESET of one twin: nobody releases a stop that he has not seen.

States and requests of each person are on their way for a drawn time, each in its order. Whether
a release was meant is judged by the times at which presses came to the twin and the time of the
state that the person saw; the numbers of stops are not looked at.
"""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from in_process import Client
from simulation import Simulation

from flexdt.protocol import Message, Prepared, RpcError

DELAYS_S = (0.0, 0.01, 0.1, 0.5, 2.0)
"""Means of how long a state or a request is on its way, drawn for each person and episode."""
ACTIONS = 3
"""Presses of one person in an episode."""
Request = tuple[str, dict[str, Any]]
Logic = Callable[[str, dict[str, Any]], Request | None]
"""(what the person wants, the safety state that the page shows) -> what the page asks for."""


def page(wish: str, seen: dict[str, Any]) -> Request | None:
    """Two controls; the reset names the stop that is shown."""
    if wish == "stop":
        return "safety.estop", {}
    return None if seen["state"] == "ok" else ("safety.reset", {"stop": seen["stop"]})


def unnumbered(wish: str, seen: dict[str, Any]) -> Request | None:
    """Two controls, but the reset releases whatever there is."""
    asked = page(wish, seen)
    return None if asked is None else (asked[0], {})


def toggle(wish: str, seen: dict[str, Any]) -> Request | None:
    """One button, as the page once was: it resets where the state shown is down."""
    down = seen["state"] != "ok"
    if wish == "reset" and not down:
        return None
    return ("safety.reset" if down else "safety.estop"), {}


class Person(Client):
    """Sees states and presses buttons, both late."""

    def __init__(self, room: Room, name: str, delays: tuple[float, float]) -> None:
        super().__init__(room.sim.twin, name)
        self.room, self.loop = room, asyncio.get_running_loop()
        self.seen: dict[str, Any] | None = None
        self._delays = delays
        self._free = [0.0, 0.0]
        """When the last state and the last request arrive."""

    def post(self, message: Message | Prepared, slot: str | None = None) -> None:
        super().post(message, slot)
        state = self.events.pop()["data"]
        self._later(0, lambda: setattr(self, "seen", state))

    def _later(self, way: int, do: Callable[[], object]) -> None:
        delay = self.room.rng.expovariate(1.0 / (self._delays[way] + 1e-9))
        self._free[way] = max(self._free[way], self.loop.time() + delay)
        self.loop.call_at(self._free[way], do)

    async def play(self) -> None:
        """Press ACTIONS times, each on the state seen then."""
        rng = self.room.rng
        for _ in range(ACTIONS):
            await asyncio.sleep(rng.expovariate(rng.choice((1.0, 10.0, 100.0))))
            wish = rng.choice(("stop", "reset"))
            seen = self.seen
            asked = None if seen is None else self.room.logic(wish, seen["safety"])
            if seen is not None and asked is not None:
                based = seen["time"]
                done = self.loop.create_future()
                self._later(1, partial(done.set_result, None))
                tasks = self.room.tasks
                tasks.append(self.loop.create_task(self._ask(done, wish, asked, based)))

    async def _ask(
        self, arrives: asyncio.Future[None], wish: str, asked: Request, based: float
    ) -> None:
        await arrives
        room, (method, params) = self.room, asked
        now = room.sim.twin.clock.now()
        if method == "safety.estop":
            room.last_press = now
            room.down = True
            answer = await self.call(method)
            assert answer["safety"]["estop"], "every E-stop ends in estop"
        else:
            newer = room.last_press > based
            await self.call("session.control", action="force")
            try:
                released = (await self.call(method, **params))["safety"]["state"] == "ok"
            except RpcError as error:
                released = False
                if error.code != -32003:
                    raise
            meant = wish == "reset" and not newer
            room.outcomes[released, meant] += room.down
            room.down = room.down and not released
        assert room.stopped == room.down, (
            "the twin is stopped unless a reset has released it"
        )


class Room:
    """A twin, and people who come and go; counts what their resets of a stopped twin did."""

    def __init__(self, sim: Simulation, logic: Logic, seed: int) -> None:
        self.sim, self.logic, self.rng = sim, logic, random.Random(seed)
        self.last_press = -math.inf
        """When the last E-STOP came to the twin."""
        self.down = False
        """Whether it must be stopped."""
        self.tasks: list[asyncio.Task[None]] = []
        self.outcomes = {(r, m): 0 for r in (False, True) for m in (False, True)}
        """(released, meant) -> how often."""

    @property
    def stopped(self) -> bool:
        return self.sim.twin.scanner.safety.state == "estopped"

    async def episode(self, count: int) -> None:
        """Two people or three, one after the other joining the topic `state`, press for a
        while."""
        draw = lambda: self.rng.choice(DELAYS_S)  # noqa: E731
        people = [Person(self, f"person-{i}", (draw(), draw())) for i in range(count)]
        for person in people:
            await person.call("state.subscribe", topics=["state"])
        await asyncio.gather(*(person.play() for person in people))
        while self.tasks:
            await self.tasks.pop()
        for person in people:
            person.close()


def played(folder: Path, logic: Logic, episodes: int) -> Room:
    with Simulation(folder) as sim:
        sim.start()
        room = Room(sim, logic, seed=37)
        for episode in range(episodes):
            sim.run(room.episode(2 + episode % 2))
        return room


@pytest.mark.parametrize(
    "episodes", [100, pytest.param(1000, marks=pytest.mark.campaign)]
)
@pytest.mark.slow
def test_no_interleaving_releases_a_stop_that_was_not_seen(
    tmp_path: Path, episodes: int
) -> None:
    room = played(tmp_path, page, episodes)
    assert room.outcomes[True, False] == 0, "unintended releases"
    assert room.outcomes[False, True] == 0, "a reset that is meant is done"
    assert min(room.outcomes[True, True], room.outcomes[False, False]) > episodes / 5, (
        "both were drawn"
    )


@pytest.mark.parametrize("logic", [toggle, unnumbered])
@pytest.mark.daily(1)
def test_the_same_people_with_other_pages_release_stops(
    tmp_path: Path, logic: Logic
) -> None:
    assert played(tmp_path, logic, 50).outcomes[True, False] > 10
