"""Heavy work: the controller is next, the others in rotation, and what waits is bounded."""

from __future__ import annotations

import asyncio
import random
from pathlib import Path
from typing import Any

import pytest
from in_process import Lab
from in_process import run as in_process_run

from flexdt.protocol.rpc_errors import RpcError
from flexdt.runtime.fair_turns import REQUESTER, FairTurns, Requester
from flexdt.server.twin import application


async def turns(times: int = 5) -> None:
    for _ in range(times):
        await asyncio.sleep(0)


class Bench:
    """Clients whose work ends when the test says so."""

    def __init__(self, count: int, most: int | None = None) -> None:
        self.places = FairTurns(count, most)
        self.begun: list[object] = []
        self.ends: list[asyncio.Event] = []
        self.controller: object = None
        self.tasks: list[asyncio.Task[None]] = []

    def ask(self, who: object) -> asyncio.Task[None]:
        async def work() -> None:
            REQUESTER.set(Requester(who, lambda: self.controller == who))
            async with self.places:
                self.begun.append(who)
                end = asyncio.Event()
                self.ends.append(end)
                await end.wait()

        task = asyncio.create_task(work())
        self.tasks.append(task)
        return task

    async def end_one(self) -> None:
        self.ends.pop(0).set()
        await turns()


def run(body: Any) -> None:
    asyncio.run(body())


@pytest.mark.parametrize("count", [1, 2])
def test_the_controllers_work_starts_within_one_of_the_others(count: int) -> None:
    async def body() -> None:
        bench = Bench(count)
        bench.controller = "controller"
        for number in range(20):
            bench.ask(number)
            bench.ask(number)
        await turns()
        bench.ask("controller")
        await turns()
        assert "controller" not in bench.begun
        await bench.end_one()
        assert bench.begun[-1] == "controller"

    run(body)


def test_who_takes_control_while_waiting_is_next() -> None:
    async def body() -> None:
        bench = Bench(1)
        for number in range(5):
            bench.ask(number)
        await turns()
        bench.controller = 4
        await bench.end_one()
        assert bench.begun == [0, 4]

    run(body)


def test_clients_alternate_however_much_one_of_them_asks() -> None:
    async def body() -> None:
        bench = Bench(1)
        for _ in range(10):
            bench.ask("flood")
        bench.ask("other")
        await turns()
        await bench.end_one()
        await bench.end_one()
        assert bench.begun == ["flood", "flood", "other"]

    run(body)


def test_too_many_who_wait_are_refused_but_not_the_controller() -> None:
    async def body() -> None:
        bench = Bench(1, most=3)
        bench.controller = "controller"
        tasks = [bench.ask(number) for number in range(5)]
        await turns()
        with pytest.raises(RpcError, match="3 requests for such work wait") as refused:
            await tasks[-1]
        assert (refused.value.code, refused.value.data["allowed"]) == (-32003, 3)  # type: ignore[index]
        bench.ask("controller")
        await turns()
        await bench.end_one()
        assert bench.begun == [0, "controller"]

    run(body)


@pytest.mark.parametrize("seed", range(30))
def test_no_place_is_lost_whatever_is_cancelled(seed: int) -> None:
    rng = random.Random(seed)

    async def body() -> None:
        bench = Bench(2)
        for _ in range(60):
            match rng.choice(["ask", "ask", "end", "cancel", "turn"]):
                case "ask":
                    bench.controller = rng.choice([None, 1])
                    bench.ask(rng.randrange(4))
                case "end" if bench.ends:
                    bench.ends.pop(0).set()
                case "cancel" if bench.tasks:
                    rng.choice(bench.tasks).cancel()
                case "turn":
                    await turns(rng.choice([1, 1, 5]))
        for _ in range(200):
            for end in bench.ends:
                end.set()
            await turns(2)
        assert all(task.done() for task in bench.tasks)
        assert bench.places._free == 2
        assert not bench.places._waiting

    run(body)


def test_a_session_says_for_whom_it_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[object, bool]] = []

    async def state(twin: Any, client: Any, params: Any) -> dict[str, object]:
        requester = REQUESTER.get()
        seen.append((requester.who, requester.first()))
        return {}

    monkeypatch.setitem(application.HANDLERS, "state.get", state)

    async def body(lab: Lab) -> None:
        controller, observer = lab.client(), lab.client()
        await controller.call("session.control", action="acquire")
        for client in (controller, observer, controller):
            await client.call("state.get")

    in_process_run(tmp_path, body)
    assert [first for _, first in seen] == [True, False, True]
    assert seen[0] == seen[2] != seen[1]
