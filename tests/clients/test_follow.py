"""`flexdt follow` over real sockets: a scanner that publishes, goes away and comes back."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path

import pytest
import zmq
import zmq.asyncio

from flexdt.clients.cli.entry import run
from flexdt.clients.client.async_client import AsyncTwinClient
from flexdt.clients.following.read_only_twin import ReadOnlyTwin
from flexdt.clients.following.scanner_link import endpoint
from flexdt.clients.following.session import Session
from flexdt.protocol import RpcError
from flexdt.server.runtime.access import AccessError
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Alarm
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.script.executed_log import read_log
from tests.support.scanner_traffic import event

FLEXRAY = builtin_machine("flexray")
MOVE = ("tra_obj", "move absolute", "50.0")


async def until(holds: Callable[[], bool]) -> None:
    """Wait for a condition, however long a loaded machine takes."""
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.01)


def session(tmp_path: Path | None = None) -> tuple[Session, list[Alarm]]:
    alarms: list[Alarm] = []
    follower = Follower(FLEXRAY, builtin_profile(FLEXRAY.default_profile))
    return Session(follower, alarms.append), alarms


def test_it_mirrors_records_and_comes_back_and_sends_nothing(tmp_path: Path) -> None:
    async def work() -> None:
        made, alarms = session()
        with zmq.asyncio.Context() as context, (tmp_path / "log").open("wb") as made.record:
            out = context.socket(zmq.XPUB)  # an XPUB socket hears what subscribers send
            port = out.bind_to_random_port("tcp://127.0.0.1")
            task = asyncio.create_task(made.run(f"tcp://127.0.0.1:{port}"))
            assert await out.recv() == b"\x01", "a subscription, and nothing else"
            for data in (b"\xff no event", event(1, MOVE), event(1, MOVE, "RCV")):
                await out.send(data)
            await out.send(event(1, MOVE, "ACK", "50.0000000000"))
            await until(lambda: made.mirror.positions["tra_obj"] == 50.0)
            assert made.mirror.axes["tra_obj"].heard_s is not None
            assert made.unread == 1
            out.close(linger=0)
            await until(lambda: any(a.kind == "lost" for a in alarms))
            assert not made.mirror.connected
            again = context.socket(zmq.XPUB)
            again.bind(f"tcp://127.0.0.1:{port}")
            await until(lambda: made.mirror.connected)
            assert await again.recv() == b"\x01"
            await again.send(event(2, ("tra_obj", "move absolute", "9999")))
            await until(lambda: ("limit", "tra_obj") in [(a.kind, a.about) for a in alarms])
            assert not await again.poll(50), "nothing is ever sent to the scanner"
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            again.close(linger=0)
        lines, problems = read_log((tmp_path / "log").read_bytes())
        assert [x.line for x in lines] == [1]
        assert not [p for p in problems if p.severity == "error"]

    asyncio.run(work())


def test_it_is_shown_as_a_twin_that_nobody_commands() -> None:
    made, _ = session()

    async def work() -> None:
        twin = ReadOnlyTwin(made.follower, lambda: made.mirror, made.clock, "tcp://scanner:50000")
        server = await twin.serve("127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        made.link(True, "")
        for data in (event(1, MOVE), event(1, MOVE, "ACK", "50.3")):
            made.message(data)
        async with AsyncTwinClient("127.0.0.1", port) as client:
            state = await client.state()
            assert state.axes["tra_obj"].position == 50.3
            said = " ".join(state.safety.warnings)
            assert "tcp://scanner:50000: connected, last message" in said
            assert "tra_obj stands at 50.3 mm after a move to 50" in said
            assert "assumed at home, never heard" in said
            assert "mag_obj" in said
            with pytest.raises(RpcError, match="nothing commands it"):
                await client.move({"tra_obj": 1.0})
            assert made.mirror.positions["tra_obj"] == 50.3
        server.close()

    asyncio.run(work())


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_it_is_not_shown_to_others(host: str) -> None:
    made, _ = session()
    twin = ReadOnlyTwin(made.follower, lambda: made.mirror, made.clock, "tcp://scanner:50000")
    with pytest.raises(AccessError):
        asyncio.run(twin.serve(host, 0))


def test_the_command_says_that_nobody_is_there_and_refuses_what_is_no_address(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(["follow", "tcp://127.0.0.1:9", "--for", "0.3", "--json"]) == 4
    told = capsys.readouterr()
    document = json.loads(told.out)
    assert (document["connected"], document["age_s"], document["raised"]) == (False, None, 0)
    assert "there has been no connection" in told.err
    assert run(["follow", "tcp://nowhere:99999"]) == 2
    assert "allowed: tcp://HOST[:PORT]" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text", ["", "tcp://", "udp://x", "tcp://x:0", "tcp://x:70000", "a b", "x:y"]
)
def test_what_is_no_address_is_an_error_that_says_what_is(text: str) -> None:
    with pytest.raises(ValueError, match=r"tcp://HOST\[:PORT\]"):
        endpoint(text)
