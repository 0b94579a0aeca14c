"""Framings and numbers of other programs: each is recognised and answered by one sentence,
in JSON, whole and byte by byte; an integral float is an integer."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any

import pytest

from flexdt.protocol import (
    METHODS,
    Codec,
    Connection,
    Failure,
    Malformed,
    Request,
    RpcError,
    parse_params,
)
from flexdt.protocol.field_checks import whole
from flexdt.protocol.projector import PROJECTOR_METHODS

CALL = {"jsonrpc": "2.0", "id": 1, "method": "axes.move", "params": {"targets": {"x": 1}}}
TEXT = json.dumps(CALL)
UTF8 = TEXT.encode()
PING = b'{"jsonrpc":"2.0","id":2,"method":"session.ping"}\n'
LINES = json.dumps(CALL, indent=2)

FATAL = {
    "LabVIEW's length before JSON": (struct.pack(">I", len(UTF8)) + UTF8, "a length"),
    "a length before a batch": (
        struct.pack(">I", len(UTF8) + 2) + b"[" + UTF8 + b"]",
        "a length",
    ),
    "UTF-16 with a mark, little": (b"\xff\xfe" + TEXT.encode("utf-16-le"), "UTF-16"),
    "UTF-16 with a mark, big": (b"\xfe\xff" + TEXT.encode("utf-16-be"), "UTF-16"),
    "UTF-16, little": (TEXT.encode("utf-16-le") + b"\n\0", "UTF-16"),
    "UTF-16, big": (TEXT.encode("utf-16-be") + b"\0\n", "UTF-16"),
    "UTF-32, little": (TEXT.encode("utf-32-le"), "UTF-16"),
    "UTF-32, big": (TEXT.encode("utf-32-be"), "UTF-16"),
}
GOES_ON = {
    "a length in little-endian order": (
        struct.pack("<I", len(UTF8)) + UTF8 + b"\n",
        "a length",
    ),
    "NUL at the end": (UTF8 + b"\0\n", "a NUL byte"),
    "NUL between messages": (UTF8 + b"\0" + UTF8 + b"\0\n", "a NUL byte"),
    "several lines": (LINES.encode() + b"\n", "JSON printed over several lines"),
    "several lines, CR LF": (
        LINES.replace("\n", "\r\n").encode() + b"\r\n",
        "JSON printed over several lines",
    ),
    "several lines without indent": (
        json.dumps(CALL, indent=0).encode() + b"\n",
        "JSON printed over several lines",
    ),
    "several lines with tabs": (
        json.dumps(CALL, indent="\t").encode() + b"\n",
        "JSON printed over several lines",
    ),
    "NaN": (UTF8.replace(b'"x": 1', b'"x": NaN') + b"\n", "NaN was recognised"),
    "Infinity": (
        UTF8.replace(b'"x": 1', b'"x": Infinity') + b"\n",
        "Infinity was recognised",
    ),
    "-Infinity": (
        UTF8.replace(b'"x": 1', b'"x": -Infinity') + b"\n",
        "-Infinity was recognised",
    ),
}


def received(data: bytes, size: int) -> tuple[Connection, list[Any]]:
    """The messages of a connection that gets `data` in parts of `size` bytes."""
    wire = Connection()
    parts = [data[at : at + size] for at in range(0, len(data), size)]
    return wire, [message for part in parts for message in wire.receive_data(part)]


@pytest.mark.parametrize("size", [1, 2, 3, 7, 10_000])
@pytest.mark.parametrize("name", FATAL)
def test_a_foreign_stream_is_refused_by_one_sentence(name: str, size: int) -> None:
    data, recognised = FATAL[name]
    wire, messages = received(data + PING, size)
    [refused] = messages
    assert isinstance(refused, Malformed)
    assert refused.fatal
    assert_sentence(refused, recognised)
    assert wire.codec is Codec.JSON
    answer = json.loads(wire.send(Failure(None, refused.error)))
    assert answer["error"]["code"] == -32700


@pytest.mark.parametrize("size", [1, 2, 3, 7, 10_000])
@pytest.mark.parametrize("name", GOES_ON)
def test_a_foreign_message_is_refused_by_one_sentence_and_the_next_one_is_read(
    name: str, size: int
) -> None:
    data, recognised = GOES_ON[name]
    _, messages = received(data + PING + data + PING, size)
    assert [type(message) for message in messages] == [Malformed, Request] * 2
    assert not messages[0].fatal
    assert_sentence(messages[0], recognised)
    assert messages[2] == messages[0]


def assert_sentence(refused: Malformed, recognised: str) -> None:
    text = refused.error.message
    assert refused.error.code == -32700
    assert text.startswith(f"parse error: {recognised}")
    assert "expected: " in text
    assert "column" not in text


@pytest.mark.parametrize("size", [1, 5, 10_000])
def test_an_estop_behind_a_document_that_never_ends_is_read(size: int) -> None:
    estop = b'{"jsonrpc":"2.0","id":3,"method":"safety.estop"}\n'
    for before in (b"{\n", b'{\n  "a": [\n', b"[\n  {\n", b"{\nnonsense\n"):
        for indent in (b"", b"  "):
            _, messages = received(before + indent + estop, size)
            assert messages[-1] == Request(3, "safety.estop")


@pytest.mark.parametrize("size", [1, 2, 10_000])
def test_frames_are_what_they_were(size: int) -> None:
    """Also lengths whose bytes are brackets, and bodies that are no message."""
    wire = Connection(Codec.MSGPACK)
    calls = [Request(1, "x", {"text": "y" * n}) for n in (0, 80, 81, 82, 83, 31_500)]
    data = b"".join(map(wire.send, calls))
    assert received(data, size)[1] == calls
    for body in (b"{", b"[", b"", b"\xc0"):
        other, messages = received(struct.pack(">I", len(body)) + body, size)
        assert other.codec is Codec.MSGPACK
        assert [type(message) for message in messages] == [Malformed]


def integers(schema: Any, converted: bool = False) -> Iterator[bool]:
    """Whether `whole` comes before each integer of a core schema."""
    if isinstance(schema, list | tuple):
        for inner in schema:
            yield from integers(inner, converted)
    if isinstance(schema, dict):
        kind = schema.get("type")
        if kind == "int":
            yield converted
        if kind == "function-before":
            converted = converted or schema["function"]["function"] is whole
        elif kind in ("model", "model-field", "dict", "list", "tuple"):
            converted = False
        for inner in schema.values():
            yield from integers(inner, converted)


def test_every_integer_of_a_request_may_be_written_with_a_fraction_of_zero() -> None:
    found = 0
    for method in (*METHODS.values(), *PROJECTOR_METHODS.values()):
        marks = list(integers(method.params.__pydantic_core_schema__))
        assert all(marks), method.name
        found += len(marks)
    assert found > 25


@pytest.mark.parametrize(
    ("method", "params"),
    [
        ("camera.set", {"averages": 8.0, "roi": [0.0, 0, 99.0, 99]}),
        ("dataset.frame", {"name": "a", "index": 8.0, "binning": 2.0}),
        ("script.check", {"text": "x", "seed": 8.0}),
        ("safety.reset", {"stop": 8.0}),
    ],
)
def test_an_integral_float_is_an_integer(method: str, params: dict[str, Any]) -> None:
    from_floats = parse_params(METHODS[method], params)
    text = json.dumps(params).replace(".0", "")
    assert from_floats == parse_params(METHODS[method], json.loads(text))
    assert ".0" not in json.dumps(from_floats.model_dump())
    for broken in (8.5, True, "8"):
        for name in {"averages", "index", "seed", "stop"} & params.keys():
            with pytest.raises(RpcError) as refused:
                parse_params(METHODS[method], {**params, name: broken})
            assert refused.value.code == -32602
