"""Connections without a place: a drawn flood of peers without the token beside clients with
it."""

from __future__ import annotations

import asyncio
import io
import itertools
import json
import logging
import random
from collections import Counter
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strangers import draw, hello, play, request

from flexdt.protocol import (
    PROTOCOL,
    Codec,
    Connection,
    Failure,
    Method,
    Request,
    Response,
)
from flexdt.protocol.fields import Params
from flexdt.runtime.access import ConnectionLimits
from flexdt.runtime.log import JsonLines, Sparing
from flexdt.runtime.waiting_room import WaitingList, neighbourhood
from flexdt.server.network import tcp
from flexdt.server.network.shell_parts import Peer
from flexdt.server.network.tcp import TcpServer, serve

pytestmark = pytest.mark.slow

TOKEN = "sixteen letters or more"
PEER, OTHER = "127.0.0.2", "127.0.0.3"


class App:
    """Remembers who called what."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, str]] = []

    def open(self, peer: Peer) -> Session:
        return Session(self, peer.name.split(":")[0])


class Session:
    def __init__(self, app: App, host: str) -> None:
        self.app, self.host = app, host

    async def handle(self, method: Method, params: Params) -> object:
        self.app.calls.append((self.host, method.name))
        return {"method": method.name}

    def close(self) -> None:
        pass


class Client:
    """Sends lines, one after the other."""

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self.reader, self.writer = reader, writer

    @classmethod
    async def dial(cls, server: TcpServer, source: str = "127.0.0.1") -> Client:
        return cls(
            *await asyncio.open_connection(
                "127.0.0.1", server.port, local_addr=(source, 0)
            )
        )

    async def ask(self, line: bytes) -> dict[str, Any]:
        self.writer.write(line)
        answer: dict[str, Any] = json.loads(await self.reader.readline())
        return answer

    async def end(self) -> bytes:
        """What comes up to the end of the connection."""
        try:
            return await self.reader.read()
        except ConnectionError:
            return b""


async def served(client: Client, *methods: str) -> None:
    """All of these have a result."""
    for method in methods:
        line = hello(TOKEN) if method == "session.hello" else request(method)
        assert (await client.ask(line))["result"] == {"method": method}


HELLO = Request(0, "session.hello", {"protocol": PROTOCOL, "client": "test"})
STATE = Request(0, "state.get", {})
NEW = ("session.hello", "session.ping", "safety.estop")
"""What a new client asks to stop the scanner."""


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.daily(2)
def test_new_clients_are_served_whatever_peers_without_the_token_do(
    seed: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tcp.waiting_room, "MAX_WAITING", 12)
    monkeypatch.setattr(tcp, "RESERVED_PLACES", 3)
    rng = random.Random(seed)

    async def main() -> list[bytes]:
        app, playing = App(), list[asyncio.Task[bytes]]()
        server = await serve(
            app.open, token=TOKEN, limits=ConnectionLimits(max_clients=2)
        )
        holders = [await Client.dial(server, OTHER) for _ in range(2)]
        for holder in holders:  # these have all the places
            await served(holder, "session.hello", "state.get")
        newcomers = [await Client.dial(server, OTHER)]
        for _ in range(200):
            peer = play(draw(rng), "127.0.0.1", server.port, PEER)
            playing.append(asyncio.create_task(peer))
            if rng.random() < 0.2:
                await served(newcomers[-1], *NEW)
                newcomers.append(await Client.dial(server, OTHER))
            if rng.random() < 0.2:
                await served(rng.choice(holders), "state.get")
            await asyncio.sleep(0.001)
            assert len(server.links) == 2
            assert len(server.waiting.guests) <= 12
            assert len(server.reserved.guests) <= 3
        await served(newcomers[-1], *NEW)  # it has waited
        asked = Counter(app.calls)
        assert {host for host, _ in asked} == {OTHER}  # the peer has called nothing
        assert asked[OTHER, "safety.estop"] == len(newcomers)
        await server.close()
        for client in (*holders, *newcomers):
            client.writer.close()
        return await asyncio.gather(*playing)

    with caplog.at_level(logging.INFO, "flexdt"):
        heard = asyncio.run(asyncio.wait_for(main(), 120))
    assert any(b"-32004" in said for said in heard)
    assert not any(b'"result"' in said for said in heard)
    events = Counter(record.getMessage() for record in caplog.records)
    assert set(events) <= {"closing", "cut off", "wrong token"}
    assert (
        max(events.values()) <= 2 * 10 + 5
    )  # ten, with and without the token, and the seconds


def test_a_client_with_the_token_has_no_place_but_is_served_what_is_urgent() -> None:
    async def main() -> None:
        app = App()
        server = await serve(
            app.open, token=TOKEN, limits=ConnectionLimits(max_clients=1)
        )
        first, second = await Client.dial(server), await Client.dial(server)
        silent = await Client.dial(server)
        await served(first, "session.hello", "state.get")
        await served(second, *NEW, "axes.stop")
        for _ in range(2):  # it stays
            error = (await second.ask(request("state.get")))["error"]
            assert (error["code"], error["data"]) == (-32003, {"allowed": 1})
        assert (await silent.ask(request("safety.estop")))["error"]["code"] == -32004
        first.writer.close()
        while server.links:
            await asyncio.sleep(0)
        await served(second, "state.get")  # it has the place now
        assert len(server.links) == 1
        assert not server.reserved.guests
        assert [method for _, method in app.calls].count("state.get") == 2
        for client in (second, silent):
            client.writer.close()
        await server.close()

    asyncio.run(asyncio.wait_for(main(), 60))


def test_clients_beyond_the_reserved_places_displace_the_oldest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tcp, "RESERVED_PLACES", 3)

    async def main() -> None:
        server = await serve(
            App().open, token=TOKEN, limits=ConnectionLimits(max_clients=1)
        )
        clients = [await Client.dial(server) for _ in range(10)]
        for client in clients:
            await served(client, *NEW)
        for client in clients[1:7]:
            error = json.loads(await client.end())["error"]  # why it was cut off
            assert (error["code"], error["data"]) == (-32003, {"allowed": 1})
        await served(clients[0], "state.get")
        for client in clients[7:]:
            await served(client, "safety.estop")
            client.writer.close()
        clients[0].writer.close()
        await server.close()

    asyncio.run(asyncio.wait_for(main(), 60))


@settings(max_examples=25, deadline=None)
@given(
    codec=st.sampled_from(list(Codec)),
    before=st.lists(st.sampled_from([HELLO, STATE]), max_size=3),
    cuts=st.lists(st.integers(1, 400), max_size=4),
)
def test_without_a_token_a_full_server_serves_estops_however_they_come(
    codec: Codec, before: list[Request], cuts: list[int]
) -> None:
    """In either codec, after a hello or a request that is refused, in any pieces."""

    async def main() -> None:
        app = App()
        server = await serve(app.open, limits=ConnectionLimits(max_clients=1))
        first, late = await Client.dial(server), await Client.dial(server)
        await served(first, "state.get")
        wire, asked = Connection(codec), [*before, Request(0, "safety.estop", {})]
        data = b"".join(wire.send(replace(r, id=i)) for i, r in enumerate(asked))
        ends = [0, *sorted(cut for cut in set(cuts) if cut < len(data)), len(data)]
        for begin, end in itertools.pairwise(ends):
            late.writer.write(data[begin:end])
            await late.writer.drain()
            for _ in range(5):
                await asyncio.sleep(0)
        answers = dict[Any, Response | Failure]()
        while len(answers) < len(asked):
            for answer in wire.receive_data(await late.reader.read(65536)):
                assert isinstance(answer, Response | Failure)
                answers[answer.id] = answer
        for i, request_ in enumerate(asked):
            answer = answers[i]
            if request_.method == "state.get":
                assert isinstance(answer, Failure)
                assert (answer.error.code, answer.error.data) == (-32003, {"allowed": 1})
            else:
                assert isinstance(answer, Response)
        assert [method for _, method in app.calls].count("safety.estop") == 1
        assert len(server.links) == 1
        for client in (first, late):
            client.writer.close()
        await server.close()

    asyncio.run(asyncio.wait_for(main(), 60))


def test_without_a_token_a_crowd_at_a_full_server_displaces_only_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tcp, "RESERVED_PLACES", 8)

    async def main() -> None:
        app = App()
        server = await serve(app.open, limits=ConnectionLimits(max_clients=2))
        holders = [await Client.dial(server, OTHER) for _ in range(2)]
        for holder in holders:
            await served(holder, "state.get")

        async def came() -> Client:
            one = await Client.dial(server, PEER)
            assert (await one.ask(request("state.get")))["error"]["code"] == -32003
            return one

        crowd = [await came() for _ in range(30)]
        assert len(server.reserved.guests) == 8

        late = await Client.dial(server)
        for count in range(1, 4):
            crowd += [await came() for _ in range(20)]
            assert (await late.ask(hello(None)))["result"] == {"method": "session.hello"}
            assert (await late.ask(request("state.get")))["error"]["code"] == -32003
            await served(late, "safety.estop", "session.ping")
            assert app.calls.count(("127.0.0.1", "safety.estop")) == count
        holders[0].writer.close()
        while len(server.links) == 2:
            await asyncio.sleep(0)
        await served(late, "state.get")  # it has waited, and has the place now
        for client in (*holders, *crowd, late):
            client.writer.close()
        await server.close()

    asyncio.run(asyncio.wait_for(main(), 60))


def test_without_a_token_who_says_nothing_takes_no_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tcp.waiting_room, "MAX_WAITING", 8)

    async def main() -> None:
        app = App()
        server = await serve(app.open, limits=ConnectionLimits(max_clients=2))
        client = await Client.dial(server, PEER)
        await served(client, "state.get")
        silent = [await Client.dial(server, PEER) for _ in range(40)]
        while server.opened < 41:
            await asyncio.sleep(0)
        assert len(server.waiting.guests) == 8
        for other in silent[:32]:  # the oldest have gone
            assert json.loads(await other.end())["error"]["code"] == -32003
        late = await Client.dial(server, PEER)
        await served(late, "state.get", "safety.estop")
        await served(client, "state.get", "axes.stop")  # it had its place
        await _ended(server, client, late, *silent)

    asyncio.run(asyncio.wait_for(main(), 60))


async def _said(client: Client, line: bytes) -> Client:
    client.writer.write(line)
    return client


def test_what_is_kept_of_a_peer_without_the_token_is_little() -> None:
    async def unread(*_: object) -> Any:
        raise AssertionError("nothing of theirs is read apart")

    async def main() -> None:
        app, limits = App(), ConnectionLimits(hello_timeout_s=0.5)
        server = await serve(app.open, token=TOKEN, limits=limits, read=unread)
        endless, long, many = [await Client.dial(server) for _ in range(3)]
        assert (await long.ask(b'{"x":"' + b"x" * 40_000 + b'"}\n'))["error"][
            "code"
        ] == -32004
        endless.writer.write(b"x" * 5_000_000)
        lines = (await (await _said(many, request("state.get") * 100)).end()).splitlines()
        assert len(lines) == 10  # then it is closed
        assert {json.loads(line)["error"]["code"] for line in lines} == {-32004}
        for guest in server.waiting.guests:
            assert guest.wire.pending < 600_000  # type: ignore[attr-defined]
        assert await endless.end() == b""  # no hello came
        # What follows a hello at once is read on, however large it is.
        ready = await Client.dial(server)
        ready.writer.write(hello(TOKEN) + b" " * 1_000_000 + request("state.get"))
        assert (
            json.loads(await ready.reader.readline())["result"]["method"]
            == "session.hello"
        )
        await _ended(server, long, endless, many, ready)

    asyncio.run(asyncio.wait_for(main(), 60))


async def _ended(server: TcpServer, *clients: Client) -> None:
    for client in clients:
        client.writer.close()
    await server.close()


class Guest:
    def __init__(self, address: str) -> None:
        self.address, self.gone = address, asyncio.Event()
        self.ended = False

    def displace(self) -> None:
        self.ended = True


@given(
    st.integers(1, 6),
    st.lists(st.tuples(st.sampled_from("abcd"), st.booleans()), max_size=60),
)
@settings(deadline=None)
def test_a_newcomer_gets_in_and_who_goes_is_the_oldest_of_the_most(
    most: int, steps: list[tuple[str, bool]]
) -> None:
    room, inside = WaitingList(most), list[Guest]()
    for address, leaves in steps:
        if leaves and inside:
            room.leave(inside.pop(0))
            continue
        before = [*inside, newcomer := Guest(address)]
        room.enter(newcomer)
        inside = [guest for guest in before if not guest.ended]
        assert list(room.guests) == inside
        if len(before) <= most:
            assert inside == before
            continue
        [gone] = [guest for guest in before if guest.ended]
        counts = Counter(guest.address for guest in before)
        assert counts[gone.address] == max(counts.values())
        assert gone is next(guest for guest in before if guest.address == gone.address)
        assert gone is not newcomer


@pytest.mark.parametrize(
    ("host", "share"),
    [("192.0.2.7", "192.0.2.7"), ("::ffff:192.0.2.7", "192.0.2.7"), ("::1", "::/64"),
     ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"), ("fe80::1%eth0", "fe80::/64"), ("?", "?")],
)  # fmt: skip
def test_an_address_has_one_share(host: str, share: str) -> None:
    assert neighbourhood(host) == share


def test_an_hour_of_complaints_is_less_than_a_megabyte_and_none_is_uncounted() -> None:
    kinds = ("refused", "closing", "cut off", "wrong token")
    stream, now, sent = io.StringIO(), [0.0], 0
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonLines())
    logger = logging.getLogger("flexdt")
    before = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    try:
        lines = Sparing(clock=lambda: now[0])
        for i in range(3600 * 30):
            now[0] = i / 30.0
            kind = kinds[i % 4]
            lines.log(
                kind,
                logging.WARNING,
                client="[2001:db8::1]:65535#9999999",
                reason="x" * 60,
            )
            sent += 1
        now[0] += 1000.0
        for kind in kinds:
            lines.log(kind)
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before[0])
        logger.propagate = before[1]
    written = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert len(written) - 4 + sum(line.get("left_out", 0) for line in written) == sent
    assert len(stream.getvalue()) / 4 < 1e6 / 10  # ten kinds are below a megabyte
    assert [line["event"] for line in written[:4]] == [
        "refused",
        "closing",
        "cut off",
        "wrong token",
    ]
