"""SPEC.md's examples are the test vectors: each whole, byte by byte, and with bytes after
it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import flexdt.protocol
from flexdt.protocol import (
    METHODS,
    Batch,
    Codec,
    Connection,
    Failure,
    Malformed,
    Message,
    Notification,
    ProtocolError,
    Request,
    Response,
    RpcError,
    event,
    parse_params,
    parse_result,
)
from flexdt.protocol.image import DTYPES
from flexdt.protocol.projector import PROJECTOR_METHODS
from flexdt.protocol.rpc_errors import Code

SPEC = (Path(__file__).parents[2] / "protocol" / "SPEC.md").read_text(encoding="utf-8")
NAMES = {
    cls.__name__: cls
    for cls in (Request, Notification, Response, Failure, Batch, RpcError)
} | {"event": event}  # fmt: skip
AFTER = {
    Codec.JSON: b'{"jsonrpc":"2.0","id":99,"method":"session.ping"}\n',
    Codec.MSGPACK: Connection(Codec.MSGPACK).send(Request(99, "session.ping")),
}
NEXT = Request(99, "session.ping")


def blocks(kind: str) -> list[str]:
    return re.findall(rf"```{kind}\n(.*?)```", SPEC, re.DOTALL)


def vectors() -> list[Any]:
    out = []
    for block in blocks("vector"):
        fields = dict(line.split(": ", 1) for line in block.strip().splitlines())
        out.append(pytest.param(fields, id=fields["name"]))
    return out


def wire_bytes(fields: Mapping[str, str]) -> tuple[Codec, bytes]:
    if "msgpack" in fields:
        return Codec.MSGPACK, bytes.fromhex(fields["msgpack"])
    return Codec.JSON, (fields.get("json") or fields["in"]).encode() + b"\n"


def expected(fields: Mapping[str, str], got: Message) -> Message:
    """The vector's message; of a malformed one only the code is fixed."""
    if "error" in fields:
        assert isinstance(got, Malformed)
        assert got.error.code == int(fields["error"])
        assert not got.fatal
        return got
    message: Message = eval(fields["message"], dict(NAMES))  # written by us, in SPEC.md
    return message


@pytest.mark.parametrize("fields", vectors())
def test_vector_as_a_whole(fields: Mapping[str, str]) -> None:
    codec, data = wire_bytes(fields)
    wire = Connection()
    [got] = wire.receive_data(data)
    assert wire.codec is codec
    assert got == expected(fields, got)
    assert not wire.mid_message


@pytest.mark.parametrize("fields", vectors())
def test_vector_one_byte_at_a_time(fields: Mapping[str, str]) -> None:
    _, data = wire_bytes(fields)
    wire = Connection()
    for i in range(len(data) - 1):
        assert wire.receive_data(data[i : i + 1]) == []
        assert wire.mid_message
    [got] = wire.receive_data(data[-1:])
    assert got == expected(fields, got)


@pytest.mark.parametrize("fields", vectors())
def test_vector_with_bytes_after_it(fields: Mapping[str, str]) -> None:
    codec, data = wire_bytes(fields)
    wire = Connection()
    tail = AFTER[codec]
    got, following = wire.receive_data(data + tail + tail[:-1])
    assert got == expected(fields, got)
    assert following == NEXT
    assert wire.receive_data(tail[-1:]) == [NEXT]


@pytest.mark.parametrize("fields", [p for p in vectors() if "message" in p.values[0]])
def test_vector_is_what_is_sent(fields: Mapping[str, str]) -> None:
    codec, data = wire_bytes(fields)
    message: Message = eval(fields["message"], dict(NAMES))
    assert Connection(codec).send(message) == data


@pytest.mark.parametrize("step", [1, 10**6], ids=["byte by byte", "whole"])
@pytest.mark.parametrize("line", blocks("cut")[0].strip().splitlines())
def test_a_stream_that_ends_inside_the_message_is_an_error(line: str, step: int) -> None:
    form, text = line.split(": ", 1)
    data = bytes.fromhex(text) if form == "msgpack" else text.encode() + b"\n"
    for cut in range(1, len(data) + 1):
        wire = Connection()
        pieces = [data[at : min(at + step, cut)] for at in range(0, cut, step)]
        got = [message for piece in pieces for message in wire.receive_data(piece)]
        if cut == len(data):
            assert [message.id for message in got if isinstance(message, Response)] == [1]
            wire.receive_end()
            continue
        assert got == []
        with pytest.raises(ProtocolError):
            wire.receive_end()


def test_the_spec_has_vectors_of_every_kind() -> None:
    text = "".join(str(p.values[0]) for p in vectors())
    for name in NAMES:
        assert name in text
    assert len(vectors()) >= 15


def test_conversations_fit_the_models() -> None:
    seen = set()
    for block in blocks("talk"):
        asked: Request | None = None
        for line in block.strip().splitlines():
            arrow, text = line.split(" ", 1)
            [message] = Connection().receive_data(text.encode() + b"\n")
            if arrow == "->":
                assert isinstance(message, Request)
                asked = message
                parse_params(METHODS[message.method], message.params)
                seen.add(message.method)
            else:
                assert isinstance(message, Response)
                assert asked is not None
                assert message.id == asked.id
                parse_result(METHODS[asked.method].result, message.result)
    assert {"axes.move", "projection.get", "script.submit", "state.subscribe"} <= seen


def test_the_table_of_methods_is_complete() -> None:
    rows = re.findall(r"^\| `([a-z_.]+)` \| ([a-z, ]*) \| (.*) \|$", SPEC, re.MULTILINE)
    table = {
        name: (set(filter(None, marks.split(", "))), text) for name, marks, text in rows
    }
    assert set(table) == set(METHODS)
    for name, method in METHODS.items():
        marks = {k for k in ("control", "urgent", "safe") if getattr(method, k)}
        assert table[name] == (marks, method.summary)


def test_the_table_of_errors_is_complete() -> None:
    rows = re.findall(r"^\| (-\d+) \| (.*) \|$", SPEC, re.MULTILINE)
    assert {int(code): text for code, text in rows} == {int(c): c.meaning for c in Code}


def test_dtypes_and_projector_methods_are_named() -> None:
    assert f"one of {', '.join(DTYPES)}" in SPEC
    section = SPEC.split("## The projector server")[1]
    for name in PROJECTOR_METHODS:
        assert f"`{name}`" in section


def test_json_of_the_spec_is_compact_json() -> None:
    for param in vectors():
        fields = param.values[0]
        if "json" in fields:
            document = json.loads(fields["json"])
            assert json.dumps(document, separators=(",", ":")) == fields["json"]


def test_the_package_exports_what_it_promises() -> None:
    for name in flexdt.protocol.__all__:
        assert hasattr(flexdt.protocol, name)
