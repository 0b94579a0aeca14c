"""Whatever comes in as an event: the gateway answers, and serves the next one."""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile
import zmq
import zmq.asyncio
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexdt.clients.client.transport import ConnectionLost
from flexdt.clients.gateway import event_server as shell
from flexdt.clients.gateway.connected_twin import ConnectedTwin
from flexdt.clients.gateway.event_server import Gateway
from flexdt.clients.gateway.saved_images import Image, Recording
from flexdt.clients.gateway.vocabulary import Refusal
from flexdt.protocol.acquila import (
    FIELDS,
    MAX_BYTES,
    AcquilaError,
    AcquilaEvent,
    format_event,
    parse_event,
)
from flexdt.protocol.rpc_errors import RpcError
from flexdt.twin.dataset.dataset_errors import DatasetError

pytestmark = pytest.mark.slow

NUMBERS = [0, -1, 2**31, 2**63, 2**64, 2**70, -(2**70), 10**400, 1e300, -1e300, 1e-300]
TEXTS = ["", " ", "\x00", "\ud800", "tube\ud800", "\udfff", "x" * 1000, "x" * 100_000, "NaN",
         "1e999", "1" * 5000, "\u2028", "../../etc/passwd", "%s%n", "{}", "\n" * 50]  # fmt: skip
ABSURD = st.one_of(
    st.sampled_from([*NUMBERS, *TEXTS, float("nan"), float("inf"), None, True]),
    st.text(st.characters(), max_size=20),
    st.integers(),
    st.floats(),
    st.recursive(st.none(), lambda inner: st.lists(inner, max_size=2), max_leaves=5),
    st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
)
SENSIBLE: dict[str, st.SearchStrategy[Any]] = {
    "component": st.sampled_from(["tube", "camera", "scanner", "mag_obj", "rot_obj", "heater"]),
    "command": st.sampled_from(
        ["xrayon", "set kV", "move absolute", "move relative", "stop", "status_time_get", "pause",
         "status_position_get", "take image", "save image", "run script", "set ROI", "explode",
         "set output path", "take and save image sequence", "set sample info", "abort script"]
    ),
    "arg1": st.sampled_from(["", "5", "1e400", "0 0 9 9", "tube\txrayon\t\t\tACK"]),
    "arg2": st.sampled_from(["", "0.0", "x"]),
    "UUID": st.integers(0, 2**64 - 1),
    "reply type": st.sampled_from(["", "SEND", "ACK", "RCV", "ERR", "FDB"]),
}  # fmt: skip
EVENTS = st.fixed_dictionaries(
    {}, optional={name: st.one_of(SENSIBLE.get(name, ABSURD), ABSURD) for name in FIELDS}
)
RUBBISH = st.one_of(st.binary(max_size=200), st.text(max_size=80).map(str.encode))


@settings(max_examples=300, deadline=None)
@given(st.one_of(EVENTS.map(lambda e: json.dumps(e).encode()), RUBBISH))
def test_any_bytes_are_an_event_or_an_error(data: bytes) -> None:
    told = ""
    try:
        told = format_event(parse_event(data))
    except AcquilaError as error:
        told = str(error)[:400]
        assert told == str(error)  # noqa: PT017
    assert told.encode()


class Nowhere:
    """A link to a twin that is not there, or that answers in a way that nobody expects."""

    hello = None
    connected = True
    answers: object = None

    async def request(self, method: str, params: object = None) -> object:
        if self.answers is None:
            raise ConnectionLost("nobody answers")
        if isinstance(self.answers, Exception):
            raise self.answers
        return self.answers


class Program:
    """Says events and hears what the gateway says."""

    def __init__(self, gateway: Gateway) -> None:
        self.context = zmq.asyncio.Context()
        self.hear, self.say = self.context.socket(zmq.SUB), self.context.socket(zmq.PUB)
        self.hear.subscribe(b"")
        for socket in (self.hear, self.say):
            socket.set_hwm(100_000)
        self.hear.connect(f"tcp://127.0.0.1:{gateway.port}")
        self.say.connect(f"tcp://127.0.0.1:{gateway.inbound}")
        self.uuid = 10**12

    async def event(self, seconds: float = 20.0) -> dict[str, Any]:
        async with asyncio.timeout(seconds):
            return dict(json.loads(await self.hear.recv()))

    async def ends(self, component: str = "scanner", command: str = "status_time_get",
                   seconds: float = 20.0, **more: object) -> dict[str, Any]:  # fmt: skip
        """The end of a command."""
        self.uuid += 1
        said = {"component": component, "command": command, "UUID": self.uuid, **more}
        await self.say.send(json.dumps(said).encode())
        async with asyncio.timeout(seconds):
            while True:
                heard = await self.event(seconds)
                if heard["UUID"] == self.uuid and heard["reply type"] in ("ACK", "ERR"):
                    return heard

    async def meet(self) -> None:
        for _ in range(100):
            try:
                await self.ends(seconds=0.2)
                return
            except TimeoutError:
                continue
        raise AssertionError("the gateway does not answer")


def with_gateway(
    work: Callable[[Gateway, Program], Awaitable[None]], tmp_path: Any, link: Any = None
) -> None:
    async def run() -> None:
        twin = ConnectedTwin(link or Nowhere(), tmp_path)
        twin.axes = ("mag_obj", "rot_obj")
        gateway = Gateway(twin, "127.0.0.1", 0)
        serving = asyncio.create_task(gateway.run())
        program = Program(gateway)
        try:
            await program.meet()
            await work(gateway, program)
            assert not serving.done()
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            program.context.destroy(linger=0)

    asyncio.run(run())


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    told: list[Any] = []
    monkeypatch.setattr(shell, "FOREIGN_S", 0.05)
    monkeypatch.setattr(
        shell, "log", lambda *event, **facts: told.append((event[0], facts))
    )
    return told


@settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.one_of(EVENTS.map(lambda e: json.dumps(e).encode()), RUBBISH))
def test_no_event_ends_the_loop(
    data: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """In process, without sockets between: what `run` does with each."""

    async def run() -> None:
        twin = ConnectedTwin(Nowhere(), tmp_path_factory.getbasetemp())  # type: ignore[arg-type]
        twin.axes = ("mag_obj", "rot_obj")
        gateway = Gateway(twin, "127.0.0.1", 0)
        said: list[AcquilaEvent] = []
        gateway._send = said.append  # type: ignore[method-assign, assignment]
        try:
            gateway._receive([data])
            await asyncio.sleep(0.01)
        finally:
            for task in list(gateway._tasks):
                task.cancel()
            await asyncio.gather(*gateway._tasks, return_exceptions=True)
            gateway._context.destroy(linger=0)
        assert said
        assert not any(event.reply == shell.FAILED for event in said)

    asyncio.run(run())


HOSTILE = [
    b'{"component": "tube\\ud800", "command": "xray on"}',
    b'{"component": "tube", "command": "xray on\\ud800", "UUID": "\\udfff"}',
    b'{"component": "scanner", "command": "run script", "arg1": "\\udcff"}',
    b'{"component": "camera", "command": "save image", "arg1": "a\\u0000b"}',
    b'{"component": "scanner", "command": "set output path", "arg1": "\\u0000"}',
    b'{"component": "tube", "command": "set kV", "arg1": NaN}',
    b'{"component": "tube", "command": "set kV", "arg1": 1e999}',
    b'{"component": "tube", "command": "set kV", "arg1": %d}' % 2**70,
    b'{"component": "mag_obj", "command": "move absolute", "arg1": -Infinity, "tick count": 1e300}',
    b'{"component": "mag_obj", "command": "status_position_get", "UUID": %d}' % 2**70,
    b'{"component": 3, "command": [], "arg1": {}}',
    b'{"component": "x", "command": "y", "tick count": {"a": [1]}}',
    b'{"component": "%s", "command": "y"}' % (b"x" * 10**5),
    b'{"component": "tube", "command": "%s"}' % (b"x" * 10**5),
    b"{}", b"[]", b"null", b"", b"\x00", b"\xff\xfe\xfd", b"[" * 10**6, b'{"a":' * 10**5,
    b"9" * 10**5, b'"' + b"x" * (MAX_BYTES - 2) + b'"',
]  # fmt: skip


def test_hostile_events_over_real_sockets_are_answered_and_the_next_is_served(
    tmp_path: Any, quick: list[Any]
) -> None:
    async def work(gateway: Gateway, program: Program) -> None:
        for data in HOSTILE:
            await program.say.send(data)
            heard = await program.event()
            while heard["reply type"] not in ("ACK", "ERR"):
                heard = await program.event()
            assert heard["reply"] != shell.FAILED, data[:80]
            assert "the twin cannot be reached" in (await program.ends())["reply"]
        await program.say.send_multipart([b"x"] * 10_000)
        while "10000 frames" not in (await program.event())["reply"]:
            continue
        await program.say.send(
            b"x" * (MAX_BYTES + 1)
        )  # ZeroMQ itself hangs up, and meets again
        await program.meet()
        _, writer = await asyncio.open_connection("127.0.0.1", gateway.inbound)
        writer.write(
            b"\xff"
            + b"\x00" * 8
            + b"\x01\x7f"
            + b"\xaa" * 4096
            + b"GET / HTTP/1.1\r\n\r\n"
        )
        await writer.drain()
        writer.close()
        await program.ends()

    with_gateway(work, tmp_path)
    assert not [facts for event, facts in quick if event == "gateway command failed"]


def test_what_nobody_expected_is_told_once_and_the_next_event_is_served(
    tmp_path: Any, quick: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shell, "MAX_LOGGED", 2)

    def broken(component: str, axes: object) -> None:
        raise RuntimeError("not this one")

    async def work(gateway: Gateway, program: Program) -> None:
        for link in ({"axes": "no state"}, RuntimeError("odd"), OverflowError("odd")):
            gateway.twin.link.answers = link  # type: ignore[attr-defined]
            assert (await program.ends())["reply"] == shell.FAILED
        gateway.twin.link.answers = RpcError(-32001, "so far and no further")  # type: ignore[attr-defined]
        assert (await program.ends())["reply"] == "so far and no further"
        with monkeypatch.context() as patch:
            patch.setattr(shell, "component_type", broken)
            assert (await program.ends())["reply"] == shell.FAILED
        assert (await program.ends())["reply"] == "so far and no further"

    with_gateway(work, tmp_path, Nowhere())
    assert [event for event, _ in quick] == [
        "gateway command failed"
    ] * 2  # as many as are shown


def test_commands_beyond_the_limit_are_told_and_stop_is_not(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shell, "MAX_RUNNING", 3)
    held = asyncio.Event()

    async def slow(twin: ConnectedTwin, command: object, progress: object) -> str:
        await held.wait()
        return "done"

    async def stop(twin: ConnectedTwin, command: object, progress: object) -> str:
        raise Refusal("stopped")

    from flexdt.clients.gateway.vocabulary import Question, StopAll

    monkeypatch.setattr(shell, "ACTIONS", {Question: slow, StopAll: stop})

    async def work(gateway: Gateway, program: Program) -> None:
        held.clear()
        said = {"component": "scanner", "command": "status_time_get"}
        for uuid in (1, 2, 3):
            await program.say.send(json.dumps({**said, "UUID": uuid}).encode())
        while len(gateway._running) < 3:
            await asyncio.sleep(0.01)
        assert "3 commands are under way" in (await program.ends())["reply"]
        assert (await program.ends("mag_obj", "Stop"))["reply"] == "stopped"
        held.set()
        while gateway._running:
            await asyncio.sleep(0.01)
        assert (await program.ends())["reply"] == "done"

    held.set()
    with_gateway(work, tmp_path)


def test_an_image_and_another_output_path_at_once(tmp_path: Path) -> None:
    """Images are saved in threads: one is whole in the old folder, or refused in words."""
    axes = {"mag_obj": SimpleNamespace(position=1.0, virtual=False)}
    camera = SimpleNamespace(
        mode="HW2SW1High", roi=(0, 0, 15, 15), exposure_ms=50.0, averages=1, frames=1
    )
    tube = SimpleNamespace(ready=True)
    state: Any = SimpleNamespace(time=1.0, axes=axes, camera=camera, tube=tube)
    image = Image(np.ones((8, 8), np.uint16), state)
    outcomes = Counter[str]()
    with ThreadPoolExecutor(1) as thread:
        for k in range(200):
            recording = Recording(tmp_path, f"E:\\r{k}", None, None, datetime.now(UTC))
            saved = thread.submit(recording.save, "a.tif", image)
            if k % 3:
                time.sleep(1e-5 * (k % 50))
            recording.close()
            try:
                assert tifffile.imread(saved.result()).shape == (8, 8)
                outcomes["saved"] += 1
            except DatasetError as error:
                assert "output path" in str(error)  # noqa: PT017
                outcomes["refused"] += 1
            with pytest.raises(DatasetError, match="output path"):
                recording.save("b.tif", image)
    assert outcomes["saved"] > 0
