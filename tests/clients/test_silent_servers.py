"""Time limits are for silence: a server that says that it works at a request is waited for."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Coroutine
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from in_process import Lab, run

from flexdt.clients.client import transport as module
from flexdt.clients.client.transport import Link
from flexdt.protocol import Message, Request, Response
from flexdt.server.imaging.projector_watch import ProjectorWatch
from flexdt.testing.in_process import SimulatedLoop
from flexdt.twin import long_work

LIMIT_S = 0.1
Pongs = Callable[[int], dict[str, Any] | None]
"""The result of each ping; None: it is not answered."""


class Scripted:
    """A server that answers a call after some pings, which it answers as it is told."""

    place = "nowhere"

    def __init__(self, pongs: Pongs, pings: int) -> None:
        self.pongs, self.needed, self.pings = pongs, pings, 0
        self.asked: Request | None = None
        self.waiting: asyncio.Queue[list[Message]] = asyncio.Queue()

    async def send(self, message: Message) -> None:
        assert isinstance(message, Request)
        if message.method != "session.ping":
            self.asked = message
            return
        self.pings += 1
        if (pong := self.pongs(self.pings)) is not None:
            self.waiting.put_nowait([Response(message.id, {"time": 0.0, **pong})])
        if self.pings == self.needed:
            assert self.asked is not None
            self.waiting.put_nowait([Response(self.asked.id, {"done": True})])

    async def receive(self) -> list[Message]:
        return await self.waiting.get()

    def close(self) -> None:
        self.waiting.put_nowait([])


def on_virtual_time(body: Coroutine[Any, Any, Any]) -> Any:
    loop = SimulatedLoop(random.Random(1))
    with asyncio.Runner(loop_factory=lambda: loop) as runner:
        return runner.run(body)


def outcome(pongs: Pongs, pings: int, limit_s: float | None = LIMIT_S) -> object:
    """The answer to a call, or the type of what it raises, and how many pings came."""

    async def body() -> object:
        server = Scripted(pongs, pings)
        link = Link(server, lambda params: None, lambda: None)  # type: ignore[arg-type]
        try:
            return await link.request("projection.get", {}, limit_s), server.pings
        except TimeoutError as error:
            return str(error), server.pings
        finally:
            await link.close()

    return on_virtual_time(body())


def test_a_server_at_work_is_waited_for_beyond_the_limit() -> None:
    # Eight pings half a limit apart are four limits.
    assert outcome(lambda n: {"serving": ["projection.get"]}, 8) == ({"done": True}, 8)


@pytest.mark.parametrize(
    "pong",
    [None, {}, {"serving": None}, {"serving": []}],
    ids=["hangs", "protocol 1.0", "null", "has forgotten the request"],
)
@pytest.mark.parametrize("good", [0, 3])
def test_silence_ends_the_wait(pong: dict[str, Any] | None, good: int) -> None:
    at_work = {"serving": ["sample.set"]}  # requests are worked at one after the other
    told, pings = outcome(lambda n: at_work if n <= good else pong, 100)  # type: ignore[misc]
    assert told == f"no answer to projection.get within {LIMIT_S:g} s"
    assert pings == good + 1


def test_without_a_limit_nothing_is_asked() -> None:
    async def body() -> None:
        server = Scripted(lambda n: {}, 100)
        link = Link(server, lambda params: None, lambda: None)  # type: ignore[arg-type]
        call = asyncio.create_task(link.request("axes.move", {}, None))
        await asyncio.sleep(0.05)
        server.waiting.put_nowait([Response(server.asked.id, {})])  # type: ignore[union-attr]
        await call
        assert server.pings == 0
        await link.close()

    on_virtual_time(body())


def test_what_takes_long_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    def during(what: str, progress: long_work.Progress = None) -> Any:
        shown.append(what)
        return long_work.unseen(what, progress)

    monkeypatch.setattr(module, "long_work", SimpleNamespace(during=during))
    what = "compiling mark_convex, once on this machine"
    outcome(lambda n: {"serving": ["projection.get"], "working": what}, 4)
    assert shown == [
        "waiting for projection.get: the projector is compiling mark_convex, once on this machine"
    ]


def test_a_twin_says_what_it_works_at(tmp_path: Path) -> None:
    """What the cases above are told, asked of a twin whose projector takes long."""
    looks = iter([None, "compiling project_rays"])
    said: str | None = None

    class Compiles:
        port, host = 1, "lab"

        async def health(self) -> SimpleNamespace:
            return SimpleNamespace(working=said)

    async def body(lab: Lab) -> None:
        nonlocal said
        client, other = lab.client(), lab.client()
        for said in looks:
            lab.projector.limit = lab.projector.views
            image = asyncio.create_task(client.call("projection.get", binning=8))
            await asyncio.sleep(3.0)  # the watch looks every second
            pong = await client.call("session.ping")
            assert pong["serving"] == ["projection.get"]
            assert pong["working"] == said
            assert (await other.call("session.ping"))["serving"] == []
            lab.projector.limit = None
            await image
            assert (await client.call("session.ping"))["serving"] == []

    run(tmp_path, body, virtual=True, projector_watch=ProjectorWatch([Compiles()]))
