"""Who is served when: no socket, no clock, no measured time; a loop and transports that
record."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from flexdt.protocol import METHODS, Codec, Connection, Method, Request
from flexdt.protocol.fields import Params
from flexdt.runtime.access import ConnectionLimits
from flexdt.server.network import tcp
from flexdt.server.network.loop_turns import FIRST, ORDINARY, URGENT, LoopTurns
from flexdt.server.network.shell_parts import Peer
from flexdt.server.network.tcp import READ_AHEAD_BYTES, TcpServer, _Link


class Transport(asyncio.Transport):
    """Takes everything, and remembers it."""

    def __init__(self) -> None:
        super().__init__()
        self.written: list[bytes] = []
        self.reading = True
        self.closed = False

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return _Sock() if name == "socket" else default

    def set_write_buffer_limits(
        self, high: int | None = None, low: int | None = None
    ) -> None:
        pass

    def write(self, data: Any) -> None:
        self.written.append(bytes(data))

    def is_closing(self) -> bool:
        return self.closed

    def close(self) -> None:
        self.closed = True

    abort = close

    def pause_reading(self) -> None:
        self.reading = False

    def resume_reading(self) -> None:
        self.reading = True

    def answers(self) -> list[Any]:
        return [json.loads(line) for line in b"".join(self.written).splitlines()]


class _Sock:
    family = None


class App:
    """Remembers who asked for what, in the order of service."""

    def __init__(self) -> None:
        self.served: list[tuple[str, str]] = []
        self.names: dict[Peer, str] = {}

    def open(self, peer: Peer) -> Session:
        self.names[peer] = f"client {len(self.names)}"
        return Session(self, self.names[peer])


class Session:
    def __init__(self, app: App, name: str) -> None:
        self.app, self.name = app, name

    async def handle(self, method: Method, params: Params) -> object:
        self.app.served.append((self.name, method.name))
        return {}

    def close(self) -> None:
        pass


class Bench:
    """Connections to one server; `turn` lets the loop go round once."""

    def __init__(self, **limits: Any) -> None:
        self.app = App()
        self.server = TcpServer(self.app.open, ConnectionLimits(**limits), None, METHODS)

    def dial(self) -> tuple[_Link, Transport]:
        link, transport = _Link(self.server), Transport()
        link.connection_made(transport)
        return link, transport

    async def turn(self, times: int = 1) -> None:
        for _ in range(times):
            await asyncio.sleep(0)

    async def served(self, count: int) -> list[tuple[str, str]]:
        while len(self.app.served) < count:
            await self.turn()
        return self.app.served


def run(body: Callable[[Bench], Awaitable[None]], **limits: Any) -> None:
    async def main() -> None:
        bench = Bench(**limits)
        try:
            await body(bench)
        finally:
            for link in list(bench.server.links):
                link.connection_lost(None)

    asyncio.run(main())


def call(method: str, id: int = 1) -> bytes:
    return b'{"jsonrpc":"2.0","id":%d,"method":"%b"}\n' % (id, method.encode())


def test_connections_alternate_however_much_one_of_them_has_sent() -> None:
    async def body(bench: Bench) -> None:
        (greedy, _), (modest, _) = bench.dial(), bench.dial()
        greedy.data_received(call("state.get") * 100)
        modest.data_received(call("geometry.get") * 3)
        order = [who for who, _ in (await bench.served(103))[:6]]
        assert order == ["client 0", "client 1"] * 3

    run(body)


def test_one_request_is_served_in_a_turn_of_the_loop() -> None:
    async def body(bench: Bench) -> None:
        links = [bench.dial()[0] for _ in range(5)]
        for link in links:
            link.data_received(call("state.get") * 10)
        before = 0
        while len(bench.app.served) < 50:
            await bench.turn()
            assert len(bench.app.served) - before <= 1
            before = len(bench.app.served)

    run(body)


@pytest.mark.parametrize("urgent", [m.name for m in METHODS.values() if m.urgent])
@pytest.mark.parametrize("codec", Codec)
def test_an_urgent_request_is_found_behind_a_deep_queue(
    urgent: str, codec: Codec
) -> None:
    async def body(bench: Bench) -> None:
        flood, stop = bench.dial()[0], bench.dial()[0]
        wire = Connection(codec)
        get = wire.send(Request(1, "state.get"))
        stop.data_received(get)
        flood.data_received(get * 1000)
        await bench.served(10)
        stop.data_received(get * 1000 + wire.send(Request(2, urgent)) + get[:9])
        served = await bench.served(20)
        at = served.index(("client 1", urgent))
        assert at <= 12  # at most the requests under way when it came

    run(body)


def test_an_estop_comes_before_other_urgent_requests() -> None:
    async def body(bench: Bench) -> None:
        links = [bench.dial()[0] for _ in range(4)]
        for link in links:
            link.data_received(call("axes.stop") * 30)
        await bench.served(4)
        links[2].data_received(call("safety.estop"))
        served = await bench.served(12)
        assert ("client 2", "safety.estop") in served[:7]

    run(body)


def test_urgent_items_of_a_batch_go_first_and_its_answers_keep_their_order() -> None:
    async def body(bench: Bench) -> None:
        link, transport = bench.dial()
        calls = [json.loads(call("state.get", i)) for i in range(50)]
        calls.append({"jsonrpc": "2.0", "id": 50, "method": "safety.estop"})
        link.data_received(json.dumps(calls).encode() + b"\n")
        served = await bench.served(51)
        assert served[0] == ("client 0", "safety.estop")
        await bench.turn(5)
        [answers] = transport.answers()
        assert [a["id"] for a in answers] == list(range(51))

    run(body)


def test_a_text_that_names_an_urgent_method_keeps_its_place() -> None:
    async def body(bench: Bench) -> None:
        link, transport = bench.dial()
        lie = {
            "jsonrpc": "2.0",
            "id": 1,
            "method": "state.get",
            "params": ["safety.estop"],
        }
        link.data_received(call("geometry.get", 0) + json.dumps(lie).encode() + b"\n")
        while len(transport.answers()) < 2:
            await bench.turn()
        assert [a["id"] for a in transport.answers()] == [0, 1]

    run(body)


def test_reading_stops_while_enough_waits_and_goes_on_later() -> None:
    async def body(bench: Bench) -> None:
        link, transport = bench.dial()
        line = call("state.get")
        link.data_received(line * (READ_AHEAD_BYTES // len(line) + 1))
        assert not transport.reading
        while bench.app.served == [] or not transport.reading:
            await bench.turn()
        assert link.wire.pending <= READ_AHEAD_BYTES // 2

    run(body, max_waiting=10**6)


def test_a_message_that_has_begun_is_read_to_its_end() -> None:
    async def body(bench: Bench) -> None:
        link, transport = bench.dial()
        link.data_received(
            b'{"jsonrpc":"2.0","id":1,"method":"state.get","params":{"x":"'
        )
        for _ in range(20):
            link.data_received(b"x" * READ_AHEAD_BYTES)
            assert transport.reading
            await bench.turn()
        link.data_received(b'"}}\n' + call("session.ping", 2))
        while len(transport.answers()) < 2:
            await bench.turn()
        assert sorted(a["id"] for a in transport.answers()) == [1, 2]

    run(body)


def test_a_turn_of_who_has_gone_is_given_to_the_next() -> None:
    async def body() -> None:
        turns, got = LoopTurns(), list[str]()

        async def take(who: str, lane: int) -> None:
            await turns.take(who, lane)
            got.append(who)

        asked = [("a", ORDINARY), ("b", ORDINARY), ("c", URGENT), ("d", FIRST)]
        tasks = [asyncio.create_task(take(*each)) for each in asked]
        await asyncio.sleep(0)
        tasks[0].cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        assert got == ["d", "c", "b"]

    asyncio.run(body())


class _Flood:
    """A connection that always has more to look at."""

    def __init__(
        self, server: TcpServer, turns: list[int], seen: list[tuple[int, object]]
    ) -> None:
        self.server, self.turns, self.seen, self.looks = server, turns, seen, 6

    def overtake(self) -> None:
        self.seen.append((self.turns[0], self))
        self.looks -= 1
        if self.looks == 3:
            raise RuntimeError("a look that fails must not end the others")
        if self.looks:
            self.server.look_soon(self)  # type: ignore[arg-type]


def test_floods_of_urgent_requests_are_looked_at_once_in_a_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tcp, "LOOK_S", 0.0)  # the shortest look: one connection

    async def body() -> None:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda loop, context: None)
        turns, seen = [0], list[tuple[int, object]]()
        server = TcpServer(None, ConnectionLimits(), None, METHODS)  # type: ignore[arg-type]
        floods = [_Flood(server, turns, seen) for _ in range(3)]
        for flood in (*floods, *floods):
            server.look_soon(flood)  # type: ignore[arg-type]
        while turns[0] < 30:
            await asyncio.sleep(0)
            turns[0] += 1
        assert [turn for turn, _ in seen] == list(range(len(seen)))  # one in each turn
        assert [
            flood for _, flood in seen
        ] == floods * 3  # in turn, up to the look that fails
        server.look_soon(floods[0])  # type: ignore[arg-type]
        await asyncio.sleep(0)
        assert seen[-1][1] is floods[0]

    asyncio.run(body())
