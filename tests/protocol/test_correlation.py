"""Requests and answers of one connection: vectors whole, byte by byte and cut off;
properties."""

from __future__ import annotations

import itertools
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexdt.protocol import (
    PROTOCOL,
    Answered,
    Batch,
    Codec,
    Connection,
    Correlation,
    Failure,
    Malformed,
    Message,
    Notification,
    ProtocolError,
    Request,
    Response,
    Role,
    RpcError,
    event,
    hello_params,
)
from flexdt.protocol.rpc_errors import invalid_request, parse_error

BUSY = RpcError(-32003, "busy")
EVENT = event("job", 7, 12.5, {"job": "job-1"})


def client() -> Correlation[str]:
    """A client with three open requests, ids 1 to 3."""
    calls = Correlation[str](Role.CLIENT)
    calls.request("session.hello", hello_params("a test", None), "hello")
    calls.request("state.get", {}, "state")
    calls.request("axes.stop", {}, "stop")
    return calls


# What the server sends, and what the client with three open requests makes of it.
CONVERSATIONS: dict[str, tuple[list[Message], list[object]]] = {
    "in order": (
        [Response(1, {}), EVENT, Response(2, {"time": 1.0}), Failure(3, BUSY)],
        [("hello", {}), EVENT, ("state", {"time": 1.0}), ("stop", BUSY)],
    ),
    "overtaken": ([Response(3, 3), Response(1, 1)], [("stop", 3), ("hello", 1)]),
    "a batch": ([Batch((Response(2, 2), EVENT, Response(1, 1)))], [
        ("state", 2), EVENT, ("hello", 1),
    ]),
    "one could not be read": ([Response(1, 1), Failure(None, parse_error("?")), Response(2, 2)], [
        ("hello", 1), ("state", parse_error("?")), ("stop", parse_error("?")),
    ]),
    "too many clients": ([Failure(None, BUSY)], []),
}  # fmt: skip


def outcomes(calls: Correlation[str], messages: list[Message]) -> list[object]:
    out: list[object] = []
    for item in (found for message in messages for found in calls.receive(message)):
        match item:
            case Answered(waiter, Response(_, result)):
                out.append((waiter, result))
            case Answered(waiter, Failure(_, error)):
                out.append((waiter, error))
            case _:
                out.append(item)
    return out


@pytest.mark.parametrize("codec", Codec)
@pytest.mark.parametrize("step", [1, 10**6], ids=["byte by byte", "whole"])
@pytest.mark.parametrize("name", CONVERSATIONS)
def test_a_conversation_however_it_is_read(name: str, step: int, codec: Codec) -> None:
    sent, expected = CONVERSATIONS[name]
    sender, wire, calls = Connection(codec), Connection(codec), client()
    data = b"".join(sender.send(message) for message in sent)
    got = [
        found
        for at in range(0, len(data), step)
        for found in outcomes(calls, wire.receive_data(data[at : at + step]))
    ]
    assert got == expected
    wire.receive_end()  # between two messages: nothing is wrong


@pytest.mark.parametrize("codec", Codec)
@pytest.mark.parametrize("step", [1, 10**6], ids=["byte by byte", "whole"])
def test_a_stream_that_ends_inside_a_message_is_an_error(codec: Codec, step: int) -> None:
    whole = Connection(codec).send(Response(1, {"time": 1.5}))
    for cut in range(1, len(whole)):
        wire = Connection(codec)
        data = whole + whole[:cut]
        pieces = [data[at : at + step] for at in range(0, len(data), step)]
        got = [message for piece in pieces for message in wire.receive_data(piece)]
        assert got == [Response(1, {"time": 1.5})]
        with pytest.raises(ProtocolError, match="ended inside a message"):
            wire.receive_end()
        assert wire.receive_data(whole) == []  # nothing comes after the end
        wire.receive_end()


def test_the_end_inside_a_message_that_is_too_long_is_an_error_too() -> None:
    for codec, begun in (
        (Codec.JSON, b"x" * 200),
        (Codec.MSGPACK, b"\0\0\1\0" + b"x" * 200),
    ):
        wire = Connection(codec, max_message=100)
        [refused] = wire.receive_data(begun)
        assert isinstance(refused, Malformed)
        with pytest.raises(ProtocolError):
            wire.receive_end()


@pytest.mark.parametrize("answer", [
    Response(4, {}), Response("1", {}), Response(None, {}), Failure(0, BUSY), Failure("a/1", BUSY),
    Malformed(invalid_request("no code"), 9), Request(1, "state.get"),
    Batch((Response(1, 1), Response(1, 1))),
])  # fmt: skip
def test_what_a_client_has_not_asked_for_ends_the_connection(answer: Message) -> None:
    calls = client()
    with pytest.raises(ProtocolError):
        calls.receive(answer)
    assert isinstance(calls.violation, ProtocolError)
    with pytest.raises(ProtocolError):
        calls.receive(Response(2, {}))  # nothing of this server is believed any more


def test_the_second_answer_to_a_request_is_one_that_nobody_asked_for() -> None:
    calls = client()
    assert outcomes(calls, [Response(1, 1)]) == [("hello", 1)]
    with pytest.raises(ProtocolError, match="not open"):
        calls.receive(Response(1, 1))


def test_an_answer_that_comes_after_its_waiter_has_gone_is_none_of_these() -> None:
    calls = client()
    late = calls.request("geometry.get", {}, "late")
    calls.abandon(late)
    assert calls.waiter(late.id) is None
    assert "late" not in calls.waiting()
    assert calls.receive(Response(late.id, {})) == []
    never = calls.request("geometry.get", {}, "never")
    calls.abandon(never, sent=False)
    assert calls.open == 3
    with pytest.raises(ProtocolError):
        calls.receive(Response(never.id, {}))


def test_a_malformed_answer_is_the_answer_to_its_request() -> None:
    broken = invalid_request("no code or message")
    assert outcomes(client(), [Malformed(broken, 2)]) == [("state", broken)]
    calls = client()
    assert calls.receive(Malformed(broken)) == []
    assert calls.reason == broken
    with pytest.raises(ProtocolError, match="no code"):
        calls.receive(Malformed(broken, fatal=True))


def test_ids_say_what_caused_the_request() -> None:
    calls = Correlation[int](Role.CLIENT)
    assert [calls.request("x", {}, i, trace).id for i, trace in enumerate(["", "job-1"])] == [
        1, "job-1/2",
    ]  # fmt: skip
    assert calls.waiter("job-1/2") == 1
    with pytest.raises(TypeError, match=r"x\.a: the name 3 must be text, not int"):
        calls.request("x", {"a": [{3: 1}]}, 0)
    assert calls.open == 2


def test_hello_brings_the_token_if_there_is_one() -> None:
    said = {"protocol": PROTOCOL, "client": "a test"}
    assert hello_params("a test", "secret") == {**said, "token": "secret"}
    assert hello_params("a test", None) == said


def test_a_server_answers_each_request_once_and_takes_no_answers() -> None:
    calls = Correlation[None](Role.SERVER)
    ping, note = Request("a", "session.ping"), Notification("axes.stop")
    assert calls.receive(Batch((ping, ping, note))) == [ping, ping, note]
    assert calls.open == 2
    assert calls.owes("a")
    assert not calls.owes("b")
    calls.answer(Response("a", 1))
    assert calls.owes("a")
    calls.answer(Failure("a", BUSY))
    assert not calls.owes("a")
    with pytest.raises(LookupError, match="'a'"):
        calls.answer(Response("a", 1))
    calls.answer(Failure(None, BUSY))  # about the connection
    malformed = Malformed(invalid_request("no method"), 5)
    assert calls.receive(malformed) == []
    assert calls.answer(malformed.reply).id == 5
    for answer in (Response("a", 1), Failure(None, BUSY)):
        with pytest.raises(ProtocolError, match="asks nothing"):
            Correlation[None](Role.SERVER).receive(answer)


def test_a_server_keeps_nothing_of_what_it_has_answered() -> None:
    calls = Correlation[None](Role.SERVER)

    def served(ids: range) -> None:
        for id in ids:
            calls.receive(Request(id, "session.ping"))
            calls.answer(Response(id, None))

    served(range(10))
    tracemalloc.start()
    try:
        served(range(10**6, 10**6 + 20_000))
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 50_000


@given(
    st.sampled_from(Codec),
    st.permutations(range(8)),
    st.sets(st.integers(0, 7)),
    st.lists(st.integers(0, 10**6), max_size=12),
)
def test_every_request_gets_its_own_answer(
    codec: Codec, order: list[int], abandoned: set[int], cuts: list[int]
) -> None:
    """A client and a server over one pair of streams, answers in any order, cut anywhere."""
    asking, serving = Correlation[int](Role.CLIENT), Correlation[None](Role.SERVER)
    client_wire, server_wire = Connection(codec), Connection()
    requests = [asking.request("echo", {"value": i}, i) for i in range(8)]
    received = [
        item
        for message in server_wire.receive_data(b"".join(map(client_wire.send, requests)))
        for item in serving.receive(message)
    ]
    assert received == requests
    for i in abandoned:
        asking.abandon(requests[i])
    answers = [serving.answer(Response(requests[i].id, i)) for i in order]
    data = b"".join(map(server_wire.send, answers))
    at = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    got = [
        (item.waiter, item.result())
        for a, b in itertools.pairwise(at)
        for message in client_wire.receive_data(data[a:b])
        for item in asking.receive(message)
        if isinstance(item, Answered)
    ]
    assert got == [(i, i) for i in order if i not in abandoned]
    assert (asking.open, asking.waiting(), serving.open) == (0, [], 0)
    for wire in (client_wire, server_wire):
        wire.receive_end()
