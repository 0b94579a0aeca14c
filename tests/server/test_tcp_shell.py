"""The asyncio shell over real loopback sockets, with a small application behind it."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.protocol import (
    METHODS,
    PROTOCOL,
    Codec,
    Connection,
    Failure,
    Method,
    Prepared,
    Request,
    Response,
    RpcError,
    event,
)
from flexdt.protocol.fields import Params
from flexdt.runtime.access import AccessError, ConnectionLimits
from flexdt.server.network import tcp
from flexdt.server.network.shell_parts import Peer
from flexdt.server.network.tcp import TcpServer, serve

TOKEN = "0123456789abcdef"


class FakeSession:
    def __init__(self, app: FakeApp, peer: Peer) -> None:
        self.app, self.peer = app, peer

    async def handle(self, method: Method, params: Params) -> object:
        self.app.calls.append(method.name)
        match method.name:
            case "axes.move":
                if getattr(params, "wait", False):
                    await self.app.moved.wait()
                return {"duration_s": 1.0, "warnings": []}
            case "axes.stop":
                self.app.moved.set()
                return {"stopped": True}
            case "axes.set":
                raise RpcError(-32001, "too fast", {"asked": 99, "allowed": [0, 50]})
            case "tube.set":
                raise KeyError("a bug")
            case "camera.set":
                return {"not": {"a": complex(1, 2)}}
            case "session.ping":
                return {"time": 0.0, "padding": "x" * 30_000}
            case "clock.set":
                return {"time_s": float("nan")}
        return {"method": method.name}

    def close(self) -> None:
        self.app.closed += 1


class FakeApp:
    def __init__(self) -> None:
        self.peers: list[Peer] = []
        self.calls: list[str] = []
        self.closed = 0
        self.moved = asyncio.Event()

    def open(self, peer: Peer) -> FakeSession:
        self.peers.append(peer)
        return FakeSession(self, peer)


Body = Callable[[TcpServer, FakeApp], Awaitable[None]]


def run(body: Body, **options: Any) -> None:
    async def main() -> None:
        app = FakeApp()
        server = await serve(app.open, **options)
        try:
            await asyncio.wait_for(body(server, app), 120)
        finally:
            await server.close()

    asyncio.run(main())


async def dial(server: TcpServer) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    return await asyncio.open_connection("127.0.0.1", server.port, limit=2**26)


async def ask(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *lines: bytes
) -> list[Any]:
    writer.write(b"".join(line + b"\n" for line in lines))
    return [json.loads(await reader.readline()) for _ in lines]


def call(method: str, id: int = 1, **params: object) -> bytes:
    return json.dumps(
        {"jsonrpc": "2.0", "id": id, "method": method, "params": params}
    ).encode()


def test_a_line_is_answered_by_a_line() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        [reply] = await ask(reader, writer, call("state.get", 7))
        assert reply == {"jsonrpc": "2.0", "id": 7, "result": {"method": "state.get"}}
        writer.close()

    run(body)


def test_msgpack_when_the_first_byte_is_zero() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        wire = Connection(Codec.MSGPACK)
        writer.write(wire.send(Request(1, "state.get", {})))
        size = int.from_bytes(await reader.readexactly(4), "big")
        frame = size.to_bytes(4, "big") + await reader.readexactly(size)
        assert wire.receive_data(frame) == [Response(1, {"method": "state.get"})]
        writer.close()

    run(body)


def test_bad_input_each_gets_its_code_and_the_connection_lives_on() -> None:
    cases: list[tuple[bytes, int]] = [
        (b"{", -32700),
        (b"\xff\xfe", -32700),
        (b'{"jsonrpc":"2.0","id":1,"method":"state.get","params":{"x":NaN}}', -32700),
        (b"[" * 5000, -32700),
        (b"[]", -32600),
        (b"42", -32600),
        (b'{"id":1,"method":"state.get"}', -32600),
        (b'{"jsonrpc":"2.0","id":{},"method":"state.get"}', -32600),
        (b'{"jsonrpc":"2.0","id":1,"method":7}', -32600),
        (b'{"jsonrpc":"2.0","id":1,"method":"state.get","params":"x"}', -32600),
        (call("axes.fly"), -32601),
        (call("__class__"), -32601),
        (call("axes.move", targets={"mag_obj": "far"}), -32602),
        (call("axes.move", targets={"mag_obj": True}), -32602),
        (call("axes.move", targets={}), -32602),
        (call("axes.move"), -32602),
        (call("axes.move", targets={"mag_obj": 1}, then=1), -32602),
        (call("axes.move", targets={"mag_obj": 1}).replace(b"1}", b"1e999}"), -32602),
        (call("axes.set", axis="mag_obj", speed=99), -32001),
        (call("tube.set"), -32603),
        (call("camera.set"), -32603),
        (call("clock.set", speed_up=2), -32603),
    ]

    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        for line, code in cases:
            [reply] = await ask(reader, writer, line)
            assert reply["error"]["code"] == code, (line[:60], reply)
            assert "Traceback" not in json.dumps(reply)
            assert "a bug" not in json.dumps(reply)
        [reply] = await ask(reader, writer, call("state.get"))
        assert "result" in reply
        writer.close()

    logging.disable(logging.CRITICAL)
    try:
        run(body)
    finally:
        logging.disable(logging.NOTSET)


def test_handler_failures_are_logged_with_a_traceback(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        await ask(reader, writer, call("tube.set"))
        writer.close()

    with caplog.at_level(logging.ERROR, "flexdt"):
        run(body)
    [record] = [r for r in caplog.records if r.levelno == logging.ERROR]
    assert record.exc_info is not None
    assert record.exc_info[0] is KeyError
    assert record.facts["method"] == "tube.set"  # type: ignore[attr-defined]


def test_a_100_mb_line_is_refused_and_the_next_line_served() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)

        async def flood() -> None:
            chunk = b"x" * 2**20
            for _ in range(100):
                writer.write(chunk)
                await writer.drain()
            writer.write(b"\n" + call("state.get") + b"\n")

        task = asyncio.create_task(flood())
        first = json.loads(await reader.readline())
        assert first["error"]["code"] == -32008
        assert first["error"]["data"]["allowed"] == 2**24 - 1
        assert "result" in json.loads(await reader.readline())
        await task
        [link] = server.links
        assert link.wire.pending == 0
        writer.close()

    run(body)


def test_half_frames_and_clients_gone_in_mid_request_cost_nothing() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        for start in (b'{"jsonrpc": "2.0", "me', b"\x00\x00\x10\x00abc"):
            _, writer = await dial(server)
            writer.write(start)
            await writer.drain()
            writer.transport.abort()
        _, writer = await dial(server)
        writer.write(call("axes.move", targets={"mag_obj": 1}, wait=True) + b"\n")
        while "axes.move" not in app.calls:
            await asyncio.sleep(0.005)
        writer.transport.abort()
        while app.closed < 3:
            await asyncio.sleep(0.005)
        assert not server.links
        reader, writer = await dial(server)
        assert "result" in (await ask(reader, writer, call("state.get")))[0]
        writer.close()

    run(body, limits=ConnectionLimits(end_timeout_s=0.2))


def test_requests_of_a_connection_are_served_in_order_but_stop_overtakes() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        writer.write(
            call("axes.move", 1, targets={"mag_obj": 1}, wait=True)
            + b"\n"
            + call("state.get", 2)
            + b"\n"
        )
        while "axes.move" not in app.calls:
            await asyncio.sleep(0.005)
        await asyncio.sleep(0.02)
        assert "state.get" not in app.calls
        writer.write(call("axes.stop", 3) + b"\n")
        ids = [json.loads(await reader.readline())["id"] for _ in range(3)]
        assert ids == [3, 1, 2]
        writer.close()

    run(body)


def test_batches_are_answered_in_one_line_without_the_notifications() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        batch = [
            {"jsonrpc": "2.0", "id": 1, "method": "state.get"},
            {"jsonrpc": "2.0", "method": "state.get"},
            7,
            {
                "jsonrpc": "2.0",
                "id": 2,
                "method": "axes.set",
                "params": ["mag_obj", 99.0],
            },
        ]
        [reply] = await ask(reader, writer, json.dumps(batch).encode())
        assert [r["id"] for r in reply] == [1, None, 2]
        assert [r.get("error", {}).get("code") for r in reply] == [None, -32600, -32001]
        silent = json.dumps([batch[1]]).encode() + b"\n"
        writer.write(silent)
        [reply] = await ask(reader, writer, call("state.get", 9))
        assert reply["id"] == 9
        writer.close()

    run(body)


def test_end_of_file_after_the_requests_still_gets_all_replies() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        writer.write(b"".join(call("state.get", i) + b"\n" for i in range(50)))
        writer.write_eof()
        lines = (await reader.read()).splitlines()
        assert [json.loads(line)["id"] for line in lines] == list(range(50))
        writer.close()

    run(body)


def test_an_answer_to_the_server_ends_the_connection() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        writer.write(b'{"jsonrpc":"2.0","id":1,"result":null}\n')
        error = json.loads(await reader.read())  # up to the end: the server closes
        assert (error["id"], error["error"]["code"]) == (None, -32600)
        assert "asks nothing" in error["error"]["message"]
        assert app.calls == []
        writer.close()

    run(body)


@pytest.mark.parametrize(
    "last",
    [call("state.get", 9), call("state.get", 9) + b"\r", b'{"jsonrpc"', b"\0\0\0\x09abc"],
)
def test_end_of_file_inside_a_message_is_answered_with_an_error(last: bytes) -> None:
    """The line is not served, also where only its end is missing: it may have been cut off
    (ironfish#1614, bjsonrpc#14, jayson#114)."""

    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        codec = Codec.MSGPACK if last[:1] == b"\0" else Codec.JSON
        wire = Connection(codec)
        writer.write(wire.send(Request(1, "state.get")) + last)
        writer.write_eof()
        first, error = wire.receive_data(await reader.read())
        assert isinstance(first, Response)
        assert isinstance(error, Failure)
        assert (error.id, error.error.code) == (None, -32700)
        assert "ended inside a message" in error.error.message
        assert app.calls == ["state.get"]
        writer.close()

    run(body)


def test_a_client_that_never_reads_loses_values_and_then_only_its_own_connection() -> (
    None
):
    async def body(server: TcpServer, app: FakeApp) -> None:
        heard, deaf = await dial(server)
        reader, writer = await dial(server)
        await ask(heard, deaf, call("state.get"))
        await ask(reader, writer, call("state.get"))
        deaf.transport.pause_reading()  # type: ignore[attr-defined]
        payload = "x" * 200_000
        for seq in range(200):
            message = Prepared(event("state", seq, 0.0, payload))
            for peer in app.peers:
                peer.post(message, slot="state")
            line = json.loads(await reader.readline())
            assert line["params"]["seq"] == seq
        while len(server.links) > 1:
            await asyncio.sleep(0.01)
        assert app.closed == 1
        assert "result" in (await ask(reader, writer, call("state.get")))[0]
        writer.close()
        deaf.close()

    run(body, limits=ConnectionLimits(send_timeout_s=2.0))


def test_newest_value_wins_per_slot_and_ordered_events_keep_their_order() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        await ask(reader, writer, call("state.get"))
        [peer] = app.peers
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        filler = "x" * 500_000
        for seq in range(100):  # far more than the sockets' buffers hold
            peer.post(event("state", seq, 0.0, filler), slot="state")
            peer.post(event("projection", seq, 0.0, filler), slot="projection")
            peer.post(event("job", seq, 0.0, "small"))
        writer.transport.resume_reading()  # type: ignore[attr-defined]
        seen: dict[str, list[int]] = {"state": [], "projection": [], "job": []}
        while not all(s and s[-1] == 99 for s in seen.values()):
            params = json.loads(await reader.readline())["params"]
            seen[params["topic"]].append(params["seq"])
        assert seen["job"] == list(range(100))
        for topic in ("state", "projection"):
            assert seen[topic] == sorted(set(seen[topic]))
            assert len(seen[topic]) < 60
        writer.close()

    run(body)


def test_too_many_unread_ordered_events_cut_the_connection() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        await ask(reader, writer, call("state.get"))
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        for seq in range(400):
            app.peers[0].post(event("log", seq, 0.0, "x" * 100_000))
        while server.links:
            await asyncio.sleep(0.01)
        writer.close()

    run(body, limits=ConnectionLimits(max_events=50))


def test_a_client_that_pipelines_without_reading_is_held_back() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        writer.write(b"".join(call("state.get", i) + b"\n" for i in range(5000)))
        got = [json.loads(await reader.readline())["id"] for _ in range(5000)]
        assert got == list(range(5000))
        writer.close()

    run(body, limits=ConnectionLimits(max_waiting=10, max_unsent=1000))


def test_urgent_requests_of_a_client_that_does_not_read_are_held_back_too() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        count = 3000
        task = asyncio.create_task(
            _write_all(writer, call("session.ping") + b"\n", count)
        )
        before = -1
        while before != len(app.calls):
            before = len(app.calls)
            await asyncio.sleep(0.1)
        assert before < count
        [link] = server.links
        assert len(link.tasks) <= 50
        writer.transport.resume_reading()  # type: ignore[attr-defined]
        for _ in range(count):
            assert b"result" in await reader.readline()
        await task
        writer.close()

    run(body, limits=ConnectionLimits(max_waiting=50, max_unsent=10_000))


async def _write_all(writer: asyncio.StreamWriter, line: bytes, count: int) -> None:
    for _ in range(count // 100):
        writer.write(line * 100)
        await writer.drain()


def test_tokens() -> None:
    def hello(token: object = None) -> bytes:
        extra = {} if token is None else {"token": token}
        return call("session.hello", 1, protocol="1.0", client="test", **extra)

    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        for line in (
            call("state.get"),
            call("axes.stop"),
            hello(),
            hello("wrong"),
            hello(7),
        ):
            [reply] = await ask(reader, writer, line)
            assert reply["error"]["code"] in (-32004, -32602), (line, reply)
        assert not app.peers
        [reply] = await ask(reader, writer, hello(TOKEN))
        assert "result" in reply
        [reply] = await ask(reader, writer, call("state.get"))
        assert "result" in reply
        writer.close()
        reader, writer = await dial(server)
        for _ in range(3):
            [reply] = await ask(reader, writer, hello("x" * 16))
            assert reply["error"]["code"] == -32004
        assert await reader.read() == b""
        writer.close()

    run(body, token=TOKEN)


def test_a_silent_client_without_a_token_is_cut_off() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        assert await reader.read() == b""
        writer.close()

    run(body, token=TOKEN, limits=ConnectionLimits(hello_timeout_s=0.05))


def test_slowloris_is_cut_off_but_a_steady_talker_is_not() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        other_reader, other = await dial(server)
        line = call("state.get") + b"\n"
        half = len(line) // 2
        other.write(line[:half])
        writer.write(b'{"jsonrpc"')
        cut_off = asyncio.create_task(reader.read())
        while not cut_off.done():  # every packet ends in the middle of a request
            await asyncio.sleep(0.03)
            other.write(line[half:] + line[:half])
            assert "result" in json.loads(await other_reader.readline())
        assert cut_off.result() == b""
        writer.close()
        other.close()

    run(body, limits=ConnectionLimits(message_timeout_s=2.0))


def test_an_estop_that_comes_in_two_parts_leaves_no_time_out_behind() -> None:
    """It is taken out of the queue as it comes, and the wait for its end went on for a
    minute."""

    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        line = call("safety.estop") + b"\n"
        for half in (line[:20], line[20:]):
            writer.write(half)
            await asyncio.sleep(0.1)
        assert "result" in json.loads(await reader.readline())
        [link] = server.links
        assert "message" not in link.deadlines._timers
        writer.close()

    run(body)


def test_http_is_turned_away_before_its_body_is_read() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        writer.write(
            b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" + call("axes.stop") + b"\n"
        )
        lines = (await reader.read()).splitlines()
        assert len(lines) == 1
        assert json.loads(lines[0])["error"]["code"] == -32600
        assert app.calls == []
        writer.close()

    run(body)


def test_limits_on_clients_rate_and_broken_messages() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        reader, writer = await dial(server)
        replies = await ask(reader, writer, *(call("state.get", i) for i in range(100)))
        stops = await ask(reader, writer, *(call("axes.stop", i) for i in range(40)))
        assert all("result" in r for r in stops)  # safety is never refused for its rate
        refused = [r for r in replies if "error" in r]
        assert refused
        assert {r["error"]["code"] for r in refused} == {-32003}
        lines = [b"{"] * 5
        await ask(reader, writer, *lines)
        assert await reader.read() == b""
        writer.close()

    run(body, limits=ConnectionLimits(max_clients=1, requests_per_s=20.0, malformed=5))


def test_one_too_many_is_told_in_its_own_codec_until_there_is_a_place() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        heard, first = await dial(server)
        await ask(heard, first, call("session.ping"))
        _, silent = await dial(server)
        late = []
        for codec in Codec:
            reader, writer = await dial(server)
            wire = Connection(codec)
            writer.write(
                wire.send(Request(1, "state.get", {})) + wire.send(Request(2, "x", {}))
            )
            told: list[Any] = []
            while len(told) < 2:
                told += wire.receive_data(await reader.read(65536))
            assert [(t.id, t.error.code) for t in told] == [(1, -32003), (2, -32601)]
            assert told[0].error.data == {"allowed": 1}
            late.append((wire, reader, writer))
        assert app.calls == ["session.ping"]
        first.close()
        while server.links:
            await asyncio.sleep(0)
        # The ones that wait hold no place: the first that asks has it.
        for (wire, reader, writer), kind in zip(late, (Response, Failure), strict=True):
            writer.write(wire.send(Request(3, "state.get", {})))
            [answer] = wire.receive_data(await reader.read(65536))
            assert isinstance(answer, kind)
        for _, _, writer in late:
            writer.close()
        silent.close()

    run(body, limits=ConnectionLimits(max_clients=1))


def test_many_too_many_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp, "RESERVED_PLACES", 3)

    async def body(server: TcpServer, app: FakeApp) -> None:
        links = [await dial(server) for _ in range(9)]
        for reader, writer in links:
            [answer] = await ask(reader, writer, call("session.ping"))
            assert "result" in answer
        ends = [asyncio.create_task(reader.read()) for reader, _ in links]
        while sum(end.done() for end in ends) < 5:  # one is served and three wait
            await asyncio.sleep(0.01)
        assert len(server.reserved.guests) == 3
        await asyncio.wait(ends, timeout=0.05)
        assert sum(end.done() for end in ends) == 5
        assert app.closed == 5
        for _, writer in links:
            writer.close()
        await asyncio.gather(*ends, return_exceptions=True)

    run(body, limits=ConnectionLimits(max_clients=1))


def test_another_version_is_not_let_in_with_the_right_token() -> None:
    async def body(server: TcpServer, app: FakeApp) -> None:
        for codec in Codec:
            reader, writer = await dial(server)
            wire = Connection(codec)
            said = {"protocol": "2.0", "client": "test", "token": TOKEN}
            for message in (Request(1, "session.hello", said), Request(2, "state.get", {}),
                            Request(3, "axes.stop", {})):  # fmt: skip
                writer.write(wire.send(message))
            answers: list[Any] = []
            while len(answers) < 3:
                answers += wire.receive_data(await reader.read(65536))
            assert {a.id: a.error.code for a in answers} == {
                1: -32602,
                2: -32004,
                3: -32004,
            }
            assert not app.peers
            said["token"] = "x" * 16  # who has no token is not told what is spoken here
            writer.write(wire.send(Request(4, "session.hello", said)))
            [answer] = wire.receive_data(await reader.read(65536))
            assert answer.error.code == -32004
            said |= {"protocol": PROTOCOL, "token": TOKEN}
            writer.write(wire.send(Request(5, "session.hello", said)))
            [answer] = wire.receive_data(await reader.read(65536))
            assert isinstance(answer, Response)
            assert app.peers.pop()
            writer.close()

    run(body, token=TOKEN)


anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["targets", "axis", "mag_obj", "x"]), inner, max_size=3
        )
    ),
    max_leaves=6,
)
requests = st.fixed_dictionaries(
    {},
    optional={
        "jsonrpc": st.just("2.0") | anything,
        "id": st.integers() | anything,
        "method": st.sampled_from([*METHODS]) | anything,
        "params": anything,
    },
)
lines = st.one_of(
    requests.map(lambda r: json.dumps(r).encode()),
    st.lists(requests, max_size=3).map(lambda r: json.dumps(r).encode()),
    st.binary(max_size=30).map(lambda b: b.replace(b"\n", b"")),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(lines, max_size=25))
def test_fuzzed_lines_never_cause_an_internal_error_of_ours(sent: list[bytes]) -> None:
    sent = [line for line in sent if not line.startswith(b"\x00")]

    async def body(server: TcpServer, app: FakeApp) -> None:
        app.moved.set()
        reader, writer = await dial(server)
        writer.write(
            b" " + b"".join(line + b"\n" for line in sent) + call("state.get", -7) + b"\n"
        )
        while True:
            reply = json.loads(await reader.readline())
            for one in reply if isinstance(reply, list) else [reply]:
                if "error" in one and one["error"]["code"] == -32603:
                    assert app.calls[-1] in ("tube.set", "camera.set", "clock.set")
            if isinstance(reply, dict) and reply.get("id") == -7:
                break
        assert reply["result"] == {"method": "state.get"}
        writer.close()

    logging.disable(logging.CRITICAL)
    try:
        run(body)
    finally:
        logging.disable(logging.NOTSET)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "", "192.0.2.1", "example.org"])
def test_others_can_reach_it_only_with_a_token(host: str) -> None:
    with pytest.raises(AccessError, match="token"):
        asyncio.run(serve(FakeApp().open, host))


def test_a_token_of_a_few_letters_is_refused() -> None:
    with pytest.raises(AccessError, match="at least 16"):
        asyncio.run(serve(FakeApp().open, token="short"))
