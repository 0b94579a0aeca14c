"""Frames with large payloads: the same bytes as ever, views instead of copies, never fooled."""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexdt.protocol import (
    Codec,
    Connection,
    Malformed,
    Message,
    Notification,
    Request,
    Response,
    RpcError,
    image,
)
from flexdt.protocol.codec import write_json
from flexdt.protocol.connection import MAX_COPIED_BYTES, pack, unpack


def whole(message: Message) -> bytes:
    head, payload = pack(message)
    return head + (b"" if payload is None else bytes(payload))


@given(
    st.sampled_from([0, 1, MAX_COPIED_BYTES, MAX_COPIED_BYTES + 1, 200_000]),
    st.sampled_from(["result", "params"]),
)
def test_the_bytes_are_those_of_an_ordinary_frame(size: int, where: str) -> None:
    data = np.arange(size, dtype=np.uint8)
    value = image.encode(data)
    message: Message = (
        Response(7, value)
        if where == "result"
        else Request(7, "x", {"a": 1, "image": value})
    )
    assert whole(message) == Connection(Codec.MSGPACK).send(message)


def test_a_large_payload_is_a_view_into_the_frame() -> None:
    data = np.arange(100_000, dtype=np.float32)
    head, payload = pack(Response(1, image.encode(data)))
    assert payload is not None
    assert np.shares_memory(np.frombuffer(payload, np.float32), data)
    body = np.frombuffer(head[4:] + bytes(payload), np.uint8).data
    message = unpack(body)
    assert isinstance(message, Response)
    got = image.decode(message.result)  # type: ignore[arg-type]
    assert np.array_equal(got, data)
    assert np.shares_memory(got, np.frombuffer(body, np.uint8))


@pytest.mark.parametrize(("size", "copied"), [(2**16 - 1, True), (2**16, False)])
def test_a_payload_with_a_long_header_travels_by_itself(size: int, copied: bool) -> None:
    """MessagePack counts up to 65 535 bytes with two bytes, more with four."""
    assert (pack(Response(1, {"data": bytes(size)}))[1] is None) == copied


def test_packing_leaves_the_message_as_it_was() -> None:
    value = image.encode(np.zeros(MAX_COPIED_BYTES, np.float32))
    before = value["data"]
    pack(Response(1, value))
    assert value["data"] is before


def test_bytes_that_look_like_a_payload_do_not_mislead() -> None:
    inner = b"\xa4data\xc6" + (90_000).to_bytes(4, "big") + b"x" * 90_000
    for message in (
        Response(1, {"blob": inner}),
        Response(1, [{"data": b"x" * 90_000}]),
        Response(1, {"data": b"x" * 5, "blob": inner}),
        Response(1, inner),
        Notification("x", [inner]),
        Request(1, "x", {"data": {"data": inner}, "text": "x" * 50_000}),
    ):
        frame = Connection(Codec.MSGPACK).send(message)
        assert unpack(memoryview(frame)[4:]) == message


@given(st.binary(max_size=40), st.binary(max_size=40), st.integers(0, 100))
def test_hostile_bodies_never_raise(head: bytes, tail: bytes, off: int) -> None:
    filling = (
        b"\xa4data\xc6"
        + (MAX_COPIED_BYTES + off).to_bytes(4, "big")
        + b"\x00" * (MAX_COPIED_BYTES + 50)
    )
    for body in (head, head + filling + tail):
        unpack(memoryview(body))


@pytest.mark.parametrize("seen", [2, 3])
def test_a_length_that_the_window_cuts_is_none(seen: int) -> None:
    """Its first `seen` bytes, taken for the whole, would reach to the frame's end by chance."""
    window, size = 4096, 65_000
    head = b"\x83\xa7jsonrpc\xa32.0\xa2id\x01\xa6result\x82\xa1x\xda"
    filling = window - seen - len(b"\xa4data\xc6") - len(head) - 2
    head += filling.to_bytes(2, "big") + b"a" * filling + b"\xa4data\xc6"
    assert len(head) == window - seen
    length = (size << 8 * (4 - seen)).to_bytes(4, "big")
    body = head + length + bytes(window - seen + 4 + size - len(head) - 4)
    assert isinstance(unpack(memoryview(body)), Malformed)


def test_a_broken_body_is_malformed() -> None:
    assert isinstance(unpack(memoryview(b"\xc1")), Malformed)


def test_16_mib_are_refused() -> None:
    with pytest.raises(RpcError) as caught:
        pack(Response(1, {"data": b"x" * 2**24}))
    assert caught.value.code == -32008
    rest = len(whole(Response(1, {"data": bytes(2**16)}))) - 4 - 2**16
    fits = bytes(2**24 - 1 - rest)
    assert len(whole(Response(1, {"data": fits}))) == 4 + 2**24 - 1
    with pytest.raises(RpcError):
        pack(Response(1, {"data": fits + b"x"}))


@pytest.mark.parametrize("size", [65_535, 65_536, 3 << 16, (3 << 16) + 1, 500_000])
def test_large_bytes_are_whole_in_json(size: int) -> None:
    data = np.random.default_rng(size).bytes(size)
    found = json.loads(write_json({"a": data, "n": 1, "b": data[::-1]}))
    assert base64.b64decode(found["a"]) == data
    assert base64.b64decode(found["b"]) == data[::-1]
    assert found["n"] == 1
