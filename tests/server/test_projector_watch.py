"""Whether the twin knows that no image can be computed, and that one can be again."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Literal

import pytest

from flexdt.protocol import Code, RpcError
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.imaging.projector_watch import ProjectorWatch
from flexdt.testing.in_process import SimulatedLoop

How = Literal["answers", "refuses", "hangs", "errs"]


@dataclass(eq=False)
class Standin:
    """A projector's client that does as told."""

    port: int
    how: How = "answers"
    host: str = "lab"
    asked: int = 0
    working: str | None = None

    async def health(self) -> SimpleNamespace:
        self.asked += 1
        while self.how == "hangs":
            await asyncio.sleep(0.05)
        if self.how == "refuses":
            raise ProjectorUnavailable(
                f"no projector at {self.host}:{self.port} (refused)"
            )
        if self.how == "errs":
            raise RpcError(Code.INTERNAL, "no figures")
        return SimpleNamespace(working=self.working)


def watched(
    clients: list[Standin], story: Callable[[ProjectorWatch], Awaitable[None]]
) -> None:
    async def work() -> None:
        watch = ProjectorWatch(clients)
        task = asyncio.create_task(watch.run())
        await story(watch)
        task.cancel()

    loop = SimulatedLoop(random.Random(1))
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        runner.run(work())


@pytest.mark.parametrize("seed", range(8))
def test_two_seconds_later_the_problem_is_that_of_the_projectors(seed: int) -> None:
    rng = random.Random(seed)
    clients = [Standin(port) for port in range(rng.randint(1, 3))]

    async def story(watch: ProjectorWatch) -> None:
        for _ in range(6):
            for client in clients:
                client.how = rng.choice(("answers", "refuses", "hangs", "errs"))
            await asyncio.sleep(2.0)
            dead = all(client.how in ("refuses", "hangs") for client in clients)
            assert (watch.problem is not None) == dead, [client.how for client in clients]
            if dead:
                assert "lab:0" in str(watch.problem)

    watched(clients, story)


def test_what_takes_any_projector_long_is_known_while_it_says_so() -> None:
    clients = [Standin(0), Standin(1)]

    async def story(watch: ProjectorWatch) -> None:
        for client in clients:
            client.working = f"compiling kernel {client.port}"
            await asyncio.sleep(1.0)
            assert watch.working == client.working
            if client.port:
                client.how = "refuses"
            else:
                client.working = None
            await asyncio.sleep(1.0)
            assert watch.working is None

    watched(clients, story)


def test_changes_are_told_once_and_nothing_is_asked_while_nobody_looks() -> None:
    client, told = Standin(1), list[str | None]()

    async def story(watch: ProjectorWatch) -> None:
        watch.changed = lambda: told.append(watch.problem)
        watch.asks = lambda: False
        await asyncio.sleep(5.0)
        assert client.asked <= 1
        watch.asks = lambda: True
        client.how = "refuses"
        await asyncio.sleep(5.0)
        client.how = "answers"
        await asyncio.sleep(5.0)

    watched([client], story)
    assert told == ["no projector at lab:1 (refused)", None]
