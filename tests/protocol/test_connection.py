"""The sans-io connection: any chunking, oversize, hostile bytes; properties by hypothesis."""

from __future__ import annotations

import itertools
import json
import random
import time
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.protocol import (
    MAX_FRAME,
    Batch,
    Codec,
    Connection,
    Failure,
    Malformed,
    Message,
    Notification,
    Prepared,
    Request,
    Response,
    RpcError,
    connection,
)

PING = Request(1, "session.ping")
LINE = Connection().send(PING)

text = st.text(max_size=20)
numbers = st.integers(-(2**53), 2**53) | st.floats(allow_nan=False, allow_infinity=False)
values = st.recursive(
    st.none() | st.booleans() | numbers | text,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(text, inner, max_size=4),
    max_leaves=12,
)
ids = text | st.integers(-(2**53), 2**53)
params = (
    st.none() | st.lists(values, max_size=4) | st.dictionaries(text, values, max_size=4)
)
errors = st.builds(
    RpcError,
    st.integers(-40000, 40000),
    text,
    st.none() | values.filter(lambda v: v is not None),
)
singles: st.SearchStrategy[Any] = (
    st.builds(Request, ids, text, params)
    | st.builds(Notification, text, params)
    | st.builds(Response, ids | st.none(), values)
    | st.builds(Failure, ids | st.none(), errors)
)
messages: st.SearchStrategy[Any] = singles | st.builds(
    Batch, st.lists(singles, min_size=1, max_size=4).map(tuple)
)


def pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    at = sorted({0, len(data), *(c % (len(data) + 1) for c in cuts)})
    return [data[a:b] for a, b in itertools.pairwise(at)]


@given(st.sampled_from(Codec), st.lists(messages, min_size=1, max_size=5),
       st.lists(st.integers(0, 10**6), max_size=12))  # fmt: skip
def test_whatever_is_sent_arrives_however_it_is_cut(
    codec: Codec, sent: list[Message], cuts: list[int]
) -> None:
    sender, receiver = Connection(codec), Connection()
    data = b"".join(sender.send(m) for m in sent)
    got = [m for piece in pieces(data, cuts) for m in receiver.receive_data(piece)]
    assert got == sent
    assert receiver.codec is codec
    assert not receiver.mid_message


@pytest.mark.parametrize("separator", ["\u2028", "\u2029", "\x85", "\x1c"])
def test_only_a_line_feed_ends_a_line(separator: str) -> None:
    """Characters that some readers take for ends of lines, raw and escaped (pi#1908, #1910)."""
    name = f"a{separator}b"
    asked = Request(1, "session.ping", {"name": name})
    escaped = json.dumps(name)[1:-1]
    raw = separator if ord(separator) >= 0x20 else escaped[1:-1]
    for written in (escaped, f"a{raw}b"):
        line = '{"jsonrpc":"2.0","id":1,"method":"session.ping","params":{"name":"%s"}}\n'
        assert Connection().receive_data((line % written).encode()) == [asked]
    assert Connection().receive_data(Connection().send(asked)) == [asked]


@given(st.binary(max_size=300), st.lists(st.integers(0, 10**6), max_size=8))
def test_any_bytes_give_messages_and_never_an_exception(
    data: bytes, cuts: list[int]
) -> None:
    whole = Connection(max_message=100)
    expected = whole.receive_data(data)
    split = Connection(max_message=100)
    got = [m for piece in pieces(data, cuts) for m in split.receive_data(piece)]
    # A line found to be too long says so as soon as it is; how long it was depends on the cuts.
    assert [_comparable(m) for m in got] == [_comparable(m) for m in expected]
    for message in got:
        if isinstance(message, Malformed):
            assert whole.send(message.reply)  # every error can be answered


@given(st.lists(st.binary(max_size=60).map(lambda b: b.replace(b"\n", b" ")), max_size=6))
def test_a_json_connection_recovers_at_the_next_newline(lines: list[bytes]) -> None:
    lines = [line for line in lines if not line.startswith((b"\x00",))]
    wire = Connection(Codec.JSON, max_message=50)
    got = wire.receive_data(b"\n".join([*lines, b""]) + LINE)
    if not wire.closed:
        assert got[-1] == PING


def _comparable(message: Message) -> object:
    if isinstance(message, Malformed):
        return message.error.code, message.id, message.fatal
    return repr(message)


def test_a_long_line_is_reported_once_and_skipped() -> None:
    wire = Connection(Codec.JSON, max_message=1000)
    [first] = [m for _ in range(50) for m in wire.receive_data(b"x" * 100)]
    assert isinstance(first, Malformed)
    assert first.error.code == -32008
    assert first.error.data["allowed"] == 1000  # type: ignore[index]
    assert wire.pending == 0
    assert wire.mid_message
    assert wire.receive_data(b"more\n" + LINE) == [PING]


def test_a_line_of_exactly_the_limit_is_read() -> None:
    line = LINE.rstrip(b"\n")
    assert Connection(max_message=len(line)).receive_data(LINE) == [PING]
    [refused] = Connection(max_message=len(line) - 1).receive_data(LINE)
    assert isinstance(refused, Malformed)


def test_a_frame_above_the_limit_is_skipped_by_its_length() -> None:
    frame = Connection(Codec.MSGPACK).send(PING)
    wire = Connection(max_message=1000)
    big = (5000).to_bytes(4, "big") + b"\x00" * 5000
    got = [
        m
        for piece in pieces(big + frame, [3, 4, 700, 5003])
        for m in wire.receive_data(piece)
    ]
    assert isinstance(got[0], Malformed)
    assert got[0].error.code == -32008
    assert got[1:] == [PING]
    assert wire.pending == 0


def test_a_frame_of_16_mib_ends_the_connection() -> None:
    wire = Connection()
    assert wire.receive_data(b"\x00\x00\x00") == []
    [message] = wire.receive_data(
        b"\x01\xc0" + (MAX_FRAME + 1).to_bytes(4, "big") + b"xxxx"
    )[1:]
    assert isinstance(message, Malformed)
    assert message.fatal
    assert wire.receive_data(LINE) == []


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from([1001, 70_000, 200_000, MAX_FRAME, MAX_FRAME + 1, 2**25]),
    st.integers(0, 3),
    st.integers(65_000, 100_000),
)
def test_a_frame_too_large_is_refused_at_its_head_however_much_came_with_it(
    size: int, frames: int, came: int
) -> None:
    """Nothing of it is held, a whole message before it is read, and one after it too."""
    ping = Connection(Codec.MSGPACK).send(PING)
    wire = Connection(Codec.MSGPACK, max_message=1000)
    body = bytes(min(came, size))
    *before, refused = wire.receive_data(ping * frames + size.to_bytes(4, "big") + body)
    assert before == [PING] * frames
    assert isinstance(refused, Malformed)
    assert refused.error.code == -32008
    assert refused.fatal == (size > MAX_FRAME)
    assert wire.pending == 0
    after = wire.receive_data(bytes(size - len(body)) + ping)
    assert after == ([] if refused.fatal else [PING])


def test_sending_16_mib_in_a_frame_is_refused_and_15_is_not() -> None:
    wire = Connection(Codec.MSGPACK)
    assert len(wire.send(Response(1, b"x" * (15 * 2**20)))) > 15 * 2**20
    with pytest.raises(RpcError) as caught:
        wire.send(Response(1, b"x" * 2**24))
    assert caught.value.code == -32008


@pytest.mark.parametrize(
    "line",
    [
        b"GET / HTTP/1.1",
        b"POST /rpc HTTP/1.0\r",
        b"PRI * HTTP/2.0\r",
        b"OPTIONS * HTTP/1.1",
    ],
)
def test_http_closes_the_connection(line: bytes) -> None:
    wire = Connection()
    [message] = wire.receive_data(line + b"\n" + LINE)
    assert isinstance(message, Malformed)
    assert message.fatal
    assert wire.receive_data(LINE) == []


def test_blank_lines_and_carriage_returns_are_white_space() -> None:
    assert Connection().receive_data(b"\n \r\n" + LINE[:-1] + b"\r\n\n") == [PING]


def test_a_byte_order_mark_before_a_document_says_nothing() -> None:
    mark = (
        b"\xef\xbb\xbf"  # .NET's streams begin with it (vs-streamjsonrpc#695, Jayrock#49)
    )
    assert Connection().receive_data(mark + LINE) == [PING]
    assert Connection().receive_data(LINE + mark + LINE) == [PING, PING]
    wire = Connection()
    assert [wire.receive_data(bytes([byte])) for byte in mark] == [[], [], []]
    assert wire.receive_data(LINE) == [PING]


MALFORMED_JSON = [
    b"\xff\xfe{}",
    b'{"jsonrpc":"2.0","id":1,"method":"\xff"}',
    b'{"jsonrpc":"2.0","id":1,"method":"\\ud800"}',
    b'{"jsonrpc":"2.0","id":Infinity,"method":"x"}',
    b"[" * 100_000,
    b'{"a":' * 100_000,
    b'"' + b"x" * 1000,
    b"{}{}",
    b"\xef\xbb\xbf\xef\xbb\xbf{}",
    b'{"jsonrpc":"2.0","id":1,"method":"x","params":[' + b"9" * 10_000 + b"]}",
    b"nul",
]


@pytest.mark.parametrize("line", MALFORMED_JSON, ids=lambda b: repr(b[:30]))
def test_what_is_no_json_is_a_parse_error(line: bytes) -> None:
    [message] = Connection(Codec.JSON).receive_data(line + b"\n")
    assert isinstance(message, Malformed)
    assert message.error.code == -32700
    assert message.id is None


MALFORMED_MSGPACK = [
    b"\xc1",
    b"\x93\x01\x02",
    b"\xc0\xc0",
    b"",
    b"\xdd\xff\xff\xff\xff" * 2000,
    b"\xdf\x00\xff\xff\xff" * 2000,
    b"\x91" * 5000 + b"\xc0",
    b"\x91" * 300 + b"\xc0",
    b"\xa1\xff",
    msgpack.packb(msgpack.ExtType(5, b"x")),
    msgpack.packb(msgpack.Timestamp(1)),
    msgpack.packb([{"a": [msgpack.Timestamp(1)]}]),
    msgpack.packb({1: 2}),
    b"\xc6\xff\xff\xff\xff",
]


@pytest.mark.parametrize("body", MALFORMED_MSGPACK, ids=lambda b: repr(b[:12]))
def test_what_is_no_msgpack_is_a_parse_error(body: bytes) -> None:
    [message] = Connection(Codec.MSGPACK).receive_data(
        len(body).to_bytes(4, "big") + body
    )
    assert isinstance(message, Malformed)
    assert message.error.code == -32700


@pytest.mark.parametrize(
    "document",
    [
        {"jsonrpc": "2.0", "id": True, "method": "x"},
        {"jsonrpc": "2.0", "id": float("nan"), "method": "x"},
        {"jsonrpc": "2.0", "id": b"x", "method": "x"},
        {"jsonrpc": "2.0", "id": 1, "method": b"x"},
        {"jsonrpc": "2.0", "id": 1, "method": "x", "params": {b"k": 1}},
        {"jsonrpc": "2.0", "id": 1, "method": "x", "params": b"k"},
        {"jsonrpc": "2.0", "id": 1, "method": "x", "extra": 1},
        {"jsonrpc": 2.0, "id": 1, "method": "x"},
        {"jsonrpc": "2.0", "id": 1},
        {"jsonrpc": "2.0", "result": 1},
        {"jsonrpc": "2.0", "id": 1, "result": 1, "error": {"code": 1, "message": "x"}},
        {"jsonrpc": "2.0", "id": 1, "error": {"code": "1", "message": "x"}},
        {"jsonrpc": "2.0", "id": 1, "error": 7},
        b"raw",
        None,
        True,
        "text",
        1.5,
    ],
)
def test_what_is_no_message_is_an_invalid_request(document: object) -> None:
    body = msgpack.packb(document)
    [message] = Connection(Codec.MSGPACK).receive_data(
        len(body).to_bytes(4, "big") + body
    )
    assert isinstance(message, Malformed)
    assert message.error.code == -32600
    assert not message.fatal


def test_the_id_of_a_bad_request_is_echoed_where_it_can_be_read() -> None:
    [message] = Connection().receive_data(b'{"jsonrpc":"2.0","id":"a","method":5}\n')
    assert isinstance(message, Malformed)
    assert message.reply.id == "a"


def test_a_batch_may_hold_bad_items_but_not_too_many() -> None:
    [message] = Connection().receive_data(b'[1,{"jsonrpc":"2.0","method":"x"}]\n')
    assert isinstance(message, Batch)
    assert isinstance(message.items[0], Malformed)
    assert message.items[1] == Notification("x")
    [refused] = Connection(max_batch=2).receive_data(b"[1,2,3]\n")
    assert isinstance(refused, Malformed)
    assert refused.error.code == -32008


def test_a_prepared_message_is_encoded_once_for_each_codec() -> None:
    prepared = Prepared(PING)
    for codec in Codec:
        first = Connection(codec).send(prepared)
        assert first == Connection(codec).send(PING)
        assert Connection(codec).send(prepared) is first


def test_what_cannot_travel_is_refused_when_sent() -> None:
    wire = Connection()
    for value in (float("nan"), float("inf"), object(), 1j):
        with pytest.raises((ValueError, TypeError)):
            wire.send(Response(1, {"x": value}))


@settings(max_examples=30)
@given(st.integers(1, 2000), st.binary(min_size=1, max_size=50))
def test_memory_held_is_bounded_by_the_limit(limit: int, chunk: bytes) -> None:
    wire = Connection(Codec.JSON, max_message=limit)
    for _ in range(100):
        wire.receive_data(chunk.replace(b"\n", b"."))
        assert wire.pending <= limit + len(chunk)


def test_an_id_that_overflows_is_told_what_it_must_be() -> None:
    [message] = Connection().receive_data(b'{"jsonrpc":"2.0","id":1e400,"method":"x"}\n')
    assert isinstance(message, Malformed)
    assert message.error.message.endswith('"id" must be text or a finite number, not inf')


def test_a_name_that_comes_twice_is_found_in_one_pass() -> None:
    """Each name was compared with all: 26 kB of them held a server's loop for a second."""

    def seconds(last: str) -> float:
        names = (*(f'"{n:x}":0' for n in range(20_000)), last)
        data = b"{" + ",".join(names).encode() + b"}"
        wire, begun = Connection(Codec.JSON), time.process_time()
        assert wire.decode(data).error.code in (-32700, -32600)  # type: ignore[union-attr]
        return time.process_time() - begun

    others = max(seconds('"other":0') for _ in range(3))
    assert seconds('"4e1f":0') < 20 * others + 0.1


PIECE = 1 << 16


class Queue:
    """What a connection should do, said with lists: whole messages, and bytes without an
    end."""

    def __init__(self, codec: Codec) -> None:
        self.json, self.whole, self.judged = codec is Codec.JSON, list[bytes](), 0
        self.rest, self.fed = b"", list[bytes]()

    def end(self) -> int:
        """Bytes of the message that `rest` begins with, framing included; 0: not all have
        come."""
        if self.json:
            return self.rest.find(b"\n") + 1
        size = 4 + int.from_bytes(self.rest[:4], "big")
        return size if 4 <= size <= len(self.rest) and len(self.rest) >= 4 else 0

    def feed(self, data: bytes) -> None:
        self.rest, self.fed = self.rest + data, []
        while size := self.end():
            message, self.rest = self.rest[:size], self.rest[size:]
            if message.strip() or not self.json:
                self.whole.append(message)
                self.fed.append(message)

    def urgent(self, message: bytes) -> bool:
        return b"stop" in message and len(self.body(message)) <= PIECE

    def body(self, message: bytes) -> bytes:
        return message[:-1] if self.json else message[4:]

    def next(self) -> bytes | None:
        if not self.whole:
            return None
        self.judged = max(0, self.judged - 1)
        return self.body(self.whole.pop(0))

    def overtake(self, most: int, shown: list[bytes]) -> list[bytes]:
        out, seen = [], 0
        if not any(map(self.urgent, self.whole[self.judged :])):
            self.judged = len(self.whole)
        while self.judged < len(self.whole) and seen < most:
            message = self.whole[self.judged]
            seen += self.urgent(message)
            if self.urgent(message):
                shown.append(self.body(message))
            if self.urgent(message) and b"stop now" in message:
                out.append(self.body(self.whole.pop(self.judged)))
            else:
                self.judged += 1
        return out


@pytest.mark.parametrize("codec", Codec)
@pytest.mark.parametrize("seed", range(40))
def test_messages_come_out_whole_once_and_urgent_ones_first(
    codec: Codec, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "MAX_EXAMINED_BYTES", PIECE)
    rng = random.Random(seed)
    wire, queue, stream = Connection(codec), Queue(codec), b""
    for _ in range(rng.randrange(2, 30)):
        body = rng.choice([b"stop", b"stop now", b"go", b"x", b"", b" \r"]) * rng.choice(
            [1, 1, 3]
        )
        if rng.random() < 0.15:
            body += b"." * (PIECE - rng.randrange(-3, 12))
        stream += body + b"\n" if queue.json else len(body).to_bytes(4, "big") + body
    while stream or queue.whole:
        if rng.random() < 0.5:
            size = rng.choice(
                [rng.randrange(1, 9), rng.randrange(1, 90), PIECE - 2, PIECE, 200_000]
            )
            piece, stream = stream[:size], stream[size:]
            wire.feed(piece)
            queue.feed(piece)
            assert wire.holds(b"stop") is any(map(queue.urgent, queue.fed))
        elif rng.random() < 0.5:
            raw = wire.next_raw()
            assert not isinstance(raw, Malformed)
            assert raw == queue.next()
        else:
            shown: list[list[bytes]] = [[], []]

            def wanted(body: bytes, shown: list[bytes] = shown[0]) -> bool:
                shown.append(body)
                return b"stop now" in body

            most = rng.choice([1, 2, 32])
            got = wire.overtake((b"halt", b"stop"), wanted, most)
            assert got == queue.overtake(most, shown[1])
            assert shown[0] == shown[1]
        assert wire.whole is (len(queue.whole) > 0)
        assert wire.waiting == len(queue.whole)
        assert wire.unjudged is (queue.judged < len(queue.whole))
        assert wire.mid_message is (len(queue.rest) > 0)
        assert wire.pending == sum(map(len, queue.whole)) + len(queue.rest)
    assert wire.next_raw() is None
