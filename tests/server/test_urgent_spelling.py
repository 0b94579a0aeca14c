"""Urgent is what a message means: every spelling of an urgent request overtakes a motion
that is awaited on its connection, as soon as the plain spelling does."""

from __future__ import annotations

import asyncio
import json
import random
import struct
from typing import Any

import msgpack
import pytest

from flexdt.protocol import METHODS, AnyMethod, Codec, Connection
from flexdt.protocol import connection as wire_module
from flexdt.protocol.connection import MAX_EXAMINED_BYTES
from flexdt.protocol.fields import Params
from flexdt.runtime.access import ConnectionLimits
from flexdt.server.network.shell_parts import Frozen, Peer
from flexdt.server.network.tcp import BUFFER_BYTES, TcpServer, _Link
from flexdt.server.twin import message_reading
from tests.server.test_batch_lanes import Wire

URGENT = [method.name for method in METHODS.values() if method.urgent]
TURNS = 40
"""Rounds of the loop within which every spelling is served; the plain one takes four."""


class Moving:
    """An application in which `axes.move` waits for a motion that never ends."""

    def __init__(self) -> None:
        self.served: list[str] = []
        self.moving = asyncio.Event()

    def open(self, peer: Peer) -> Moving:
        return self

    async def handle(self, method: AnyMethod, params: Params) -> object:
        if method.name == "axes.move":
            self.moving.set()
            await asyncio.Event().wait()
        self.served.append(method.name)
        return {}

    def close(self) -> None:
        pass


async def read(
    raw: bytes, wire: Connection, urgent: bool = False
) -> Frozen | tuple[Frozen, ...]:
    """Read a large message as the worker does, in this process."""
    kind, *items = message_reading.work(wire.codec, wire.max_batch, raw)
    pairs = zip(items[::2], items[1::2], strict=True)
    frozen = tuple(Frozen(item, method.decode()) for method, item in pairs)
    return frozen if kind == b"batch" else frozen[0]


def turns_until_served(codec: Codec, sent: bytes, method: str) -> int | None:
    """Rounds of the loop from the last byte of `sent` until `method` is served behind an
    awaited motion and an ordinary request; None: it waits for the motion."""

    async def main() -> int | None:
        app = Moving()
        server = TcpServer(app.open, ConnectionLimits(), None, METHODS, read=read)
        link = _Link(server)
        link.connection_made(Wire())
        plain = Connection(codec)
        move = {"jsonrpc": "2.0", "id": 1, "method": "axes.move"}
        move |= {"params": {"targets": {"mag_obj": 100.0}, "wait": True}}
        get = {"jsonrpc": "2.0", "id": 2, "method": "state.get"}
        link.data_received(framed(plain, move) + framed(plain, get))
        await app.moving.wait()
        for at in range(0, len(sent), BUFFER_BYTES):
            link.data_received(sent[at : at + BUFFER_BYTES])
        try:
            for turn in range(TURNS):
                if method in app.served:
                    assert "state.get" not in app.served
                    return turn
                await asyncio.sleep(0)
            return None
        finally:
            link.connection_lost(None)

    return asyncio.run(main())


def framed(wire: Connection, document: Any) -> bytes:
    if wire.codec is Codec.JSON:
        return json.dumps(document).encode() + b"\n"
    body = msgpack.packb(document)
    return struct.pack(">I", len(body)) + body


def space(rng: random.Random) -> str:
    return "".join(rng.choices(" \t\r", k=rng.choice([0, 0, 1, 3])))


def json_text(rng: random.Random, text: str) -> str:
    """A spelling of a text: any subset of its characters as escapes, in either case."""
    share = rng.choice([0.0, 0.1, 0.5, 1.0])
    out = []
    for character in text:
        digits = f"{ord(character):04x}"
        digits = rng.choice([digits, digits.upper()])
        out.append("\\u" + digits if rng.random() < share else character)
    return '"' + "".join(out) + '"'


def json_value(rng: random.Random, value: Any) -> str:
    match value:
        case str():
            return json_text(rng, value)
        case dict():
            members = list(value.items())
            rng.shuffle(members)
            inner = ",".join(
                f"{space(rng)}{json_text(rng, k)}{space(rng)}:{space(rng)}{json_value(rng, v)}"
                for k, v in members
            )
            return f"{{{inner}{space(rng)}}}"
        case list():
            return "[" + ",".join(json_value(rng, v) for v in value) + "]"
    return json.dumps(value)


def packed_text(rng: random.Random, text: str) -> bytes:
    """A spelling of a text in MessagePack: any header that can hold its length."""
    data = text.encode()
    heads = [
        b"\xd9" + struct.pack(">B", len(data)),
        b"\xda" + struct.pack(">H", len(data)),
    ]
    heads.append(b"\xdb" + struct.pack(">I", len(data)))
    if len(data) < 32:
        heads.append(bytes([0xA0 | len(data)]))
    return rng.choice(heads) + data


def packed_value(rng: random.Random, value: Any) -> bytes:
    match value:
        case str() if len(value) < 100:
            return packed_text(rng, value)
        case dict():
            members = list(value.items())
            rng.shuffle(members)
            head = rng.choice(
                [bytes([0x80 | len(members)]), struct.pack(">BH", 0xDE, len(members))]
            )
            return head + b"".join(
                packed_text(rng, k) + packed_value(rng, v) for k, v in members
            )
        case list():
            return struct.pack(">BH", 0xDC, len(value)) + b"".join(
                packed_value(rng, v) for v in value
            )
    packed: bytes = msgpack.packb(value)
    return packed


def spelling(rng: random.Random, codec: Codec, method: str) -> bytes:
    """A message that calls an urgent method, alone or in a batch, of up to 1 MiB."""
    call: Any = {"jsonrpc": "2.0", "method": method}
    if rng.random() < 0.8:
        call["id"] = rng.choice([7, "seven"])
    if rng.random() < 0.5:
        call["params"] = {}
    size = rng.choice([0, 0, 0, 31 << 10, 33 << 10, 70 << 10, MAX_EXAMINED_BYTES])
    document = call
    if rng.random() < 0.3 or (size and codec is Codec.MSGPACK):
        # Many values are read in a process, few on the loop.
        count = rng.choice([2, 2, 600]) if codec is Codec.JSON else 2
        others = [{"jsonrpc": "2.0", "method": "geometry.get"} for _ in range(count)]
        document = [*others, call]
        rng.shuffle(document)
    if codec is Codec.JSON:
        body = json_value(rng, document).encode()
        room = max(0, size - len(body))
        pad = b" " * room
        at = rng.choice([0, 1, len(body) - 1, len(body)])
        body = body[:at] + pad + body[at:]
        return body + b"\n"
    if size:
        room = size - 400
        document.append(
            {"jsonrpc": "2.0", "method": "script.check", "params": {"text": "x" * room}}
        )
    body = packed_value(rng, document)
    return struct.pack(">I", len(body)) + body


@pytest.mark.parametrize("codec", Codec)
@pytest.mark.parametrize("method", URGENT)
def test_every_spelling_overtakes_an_awaited_motion(method: str, codec: Codec) -> None:
    rng = random.Random(f"{method} {codec}")
    for _ in range(60):
        sent = spelling(rng, codec, method)
        assert turns_until_served(codec, sent, method) is not None, sent[:300]


def test_an_estop_in_escapes_is_served_in_as_many_turns_as_the_plain_one() -> None:
    plain = b'{"jsonrpc":"2.0","id":3,"method":"safety.estop"}\n'
    spelt = plain.replace(b"y.e", rb"y\u002ee")
    wanted = turns_until_served(Codec.JSON, plain, "safety.estop")
    assert wanted is not None
    assert turns_until_served(Codec.JSON, spelt, "safety.estop") == wanted


def test_a_name_twice_is_refused_and_nothing_of_it_overtakes() -> None:
    twice = b'{"jsonrpc":"2.0","id":3,"method":"state.get","method":"safety.estop"}\n'
    assert turns_until_served(Codec.JSON, twice, "safety.estop") is None


def test_a_message_above_the_limit_waits_for_its_turn() -> None:
    long = b" " * MAX_EXAMINED_BYTES + b'{"jsonrpc":"2.0","method":"safety.estop"}\n'
    assert turns_until_served(Codec.JSON, long, "safety.estop") is None


def test_what_the_bytes_exclude_names_nothing() -> None:
    """False of `may_name` is certain: no drawn spelling of a name is excluded, and a plain
    message, with escapes of letters that are not ASCII, is."""
    rng = random.Random(80)
    names = tuple(name.encode() for name in URGENT)
    for _ in range(2000):
        name = rng.choice(URGENT)
        assert wire_module.may_name(Codec.JSON, json_text(rng, name).encode(), names)
        assert wire_module.may_name(Codec.MSGPACK, packed_text(rng, name), names)
    ordinary = json.dumps({"method": "state.get", "params": {"name": "Röhre \n \x01"}})
    assert not wire_module.may_name(Codec.JSON, ordinary.encode(), names)


def test_many_large_messages_that_may_be_urgent_are_read_one_at_a_time() -> None:
    """A connection has one of them read at a time, so that those of others come between."""
    reading = most = 0

    async def slow(raw: bytes, wire: Connection, urgent: bool) -> Any:
        nonlocal reading, most
        assert urgent
        reading += 1
        most = max(most, reading)
        await asyncio.sleep(0)
        reading -= 1
        return await read(raw, wire)

    async def main() -> None:
        app = Moving()
        server = TcpServer(app.open, ConnectionLimits(), None, METHODS, read=slow)
        link, wire = _Link(server), Wire()
        link.connection_made(wire)
        lie = {"jsonrpc": "2.0", "id": 1, "method": "script.check"}
        lie |= {"params": {"text": "safety.estop" + "," * (40 << 10)}}
        for number in range(6):
            link.data_received(framed(Connection(Codec.JSON), lie | {"id": number}))
        while len(app.served) < 6:
            await asyncio.sleep(0)
        assert [answer["id"] for answer in wire.answers()][:5] == list(range(5))
        link.connection_lost(None)

    asyncio.run(main())
    assert most == 1
