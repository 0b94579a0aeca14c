"""Events of the scanner software's interface, read and written as its own programs do."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.protocol.acquila import (
    AcquilaError,
    AcquilaEvent,
    Exchange,
    ReplyType,
    format_event,
    parse_event,
)

LIVE = (
    '{"component":"tube","comp_phys":"xraysource","command":"xrayon","arg1":"","arg2":"",'
    '"reply":"","reply type":"","comp_type":"tube","tick count":1380210404,"UUID":26481}'
)


def test_a_command_as_the_scanner_writes_it() -> None:
    event = parse_event(LIVE)
    assert event.is_command
    assert not event.anonymous
    assert (event.component, event.command, event.uuid) == ("tube", "xrayon", 26481)
    assert json.loads(format_event(event)) == json.loads(LIVE)


@pytest.mark.parametrize("word", ["", "SEND", "SENT", "send"])
def test_every_spelling_of_a_command_is_one(word: str) -> None:
    assert parse_event(json.dumps({**json.loads(LIVE), "reply type": word})).is_command


@pytest.mark.parametrize(
    "uuid", [0, 2**64 - 1, -7, 2**70, 1.5, 1.8446744073709552e19, "26ef64cc-01ab"]
)
def test_a_uuid_comes_back_as_it_came(uuid: float | str) -> None:
    event = parse_event(json.dumps({**json.loads(LIVE), "UUID": uuid}))
    answer = json.loads(format_event(event.answer(ReplyType.ACK, "done")))
    assert answer["UUID"] == uuid
    assert answer["tick count"] == 1380210404
    assert answer["reply type"] == "ACK"
    assert event.anonymous is (uuid == 0)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"component": ""}, "component"),
        ({"command": None}, "command"),
        ({"reply type": "MAYBE"}, "RCV, FDB, ACK, ERR"),
        ({"UUID": float("nan")}, "number below 1e"),
        ({"arg1": ["x"]}, "arg1 must be text"),
        (
            {"component": "tube\ud800"},
            r"component holds U\+D800 at 4; allowed: anything but",
        ),
        (
            {"component": "tube\x00"},
            r"component holds U\+0000 at 4; .* but surrogates and control characters$",
        ),
        ({"command": "x\u2028ray on"}, r"command holds U\+2028"),
        (
            {"arg1": "\udcff"},
            r"arg1 holds U\+DCFF at 0; allowed: anything but surrogates$",
        ),
        ({"UUID": "\ud800"}, r"UUID holds U\+D800"),
        ({"UUID": 10**200}, "number below 1e"),
        ({"UUID": True}, "number below 1e"),
        ({"UUID": "x" * 201}, "UUID of 201 characters; allowed: 200"),
        ({"component": "x" * 101}, "component of 101 characters; allowed: 100"),
        ({"command": "x" * 1001}, "command of 1001 characters"),
        ({"arg2": "x" * 10_000}, "arg2 of 10000 characters; allowed: 4096"),
        ({"reply type": "x" * 10_000}, "reply type of 10000 characters"),
        ({"component": {"a": 1}}, "component must be text, not dict"),
    ],
)
def test_what_is_no_event_is_refused_with_what_is_allowed(
    change: dict[str, object], says: str
) -> None:
    with pytest.raises(AcquilaError, match=says):
        parse_event(json.dumps({**json.loads(LIVE), **change}))


@pytest.mark.parametrize(
    "data", [b"", b"\xff\xfe", b"[]", b"{", b"[" * 100_000, b"x" * 2**21]
)
def test_bytes_that_are_no_event_are_refused(data: bytes) -> None:
    with pytest.raises(AcquilaError):
        parse_event(data)


WORD = st.text(
    st.characters(codec="utf-8", exclude_categories=["Cc", "Zl", "Zp", "Zs"]), min_size=1
).map(lambda s: "x" + s[:20])  # fmt: skip


@pytest.mark.parametrize(
    "tick", [2**70, -(2**70), 1e300, float("nan"), float("inf"), "x", [], True]
)
def test_a_tick_count_of_no_use_is_0(tick: object) -> None:
    event = parse_event(json.dumps({**json.loads(LIVE), "tick count": tick}))
    assert abs(event.tick_count) < 2**64
    assert json.loads(format_event(event))["tick count"] == event.tick_count


@pytest.mark.parametrize("tick", [2**64 - 1, 1 - 2**64, 0, 12, 7.9, -7.9])
def test_a_tick_count_is_a_whole_number_of_64_bits(tick: float) -> None:
    event = parse_event(json.dumps({**json.loads(LIVE), "tick count": tick}))
    assert event.tick_count == math.trunc(tick)
    for beyond in (2**64, -(2**64)):
        event = parse_event(json.dumps({**json.loads(LIVE), "tick count": beyond}))
        assert event.tick_count == 0


@pytest.mark.parametrize(
    ("field", "most"),
    [("component", 100), ("comp_phys", 1000), ("command", 1000), ("arg2", 4096), ("reply", 65536),
     ("comp_type", 100), ("UUID", 200)],
)  # fmt: skip
def test_the_longest_text_of_each_field(field: str, most: int) -> None:
    event = format_event(parse_event(json.dumps({**json.loads(LIVE), field: "x" * most})))
    assert json.loads(event)[field] == "x" * most
    with pytest.raises(
        AcquilaError, match=f"{field} of {most + 1} char.*allowed: {most}$"
    ):
        parse_event(json.dumps({**json.loads(LIVE), field: "x" * (most + 1)}))


def test_an_event_of_1_mib_is_read_and_one_byte_more_is_not() -> None:
    data = LIVE + " " * (2**20 - len(LIVE))
    assert parse_event(data) == parse_event(LIVE)
    with pytest.raises(AcquilaError, match="1048577 bytes; allowed: 1048576"):
        parse_event(data + " ")


def test_an_argument_may_be_binary() -> None:
    event = parse_event(json.dumps({**json.loads(LIVE), "arg1": "@>\x00\x01\n\xff"}))
    assert parse_event(format_event(event)).arg1 == "@>\x00\x01\n\xff"


@settings(max_examples=40, deadline=None)
@given(component=WORD, arg=st.text(max_size=40), uuid=st.integers(0, 2**64 - 1))
def test_events_survive_the_wire(component: str, arg: str, uuid: int) -> None:
    event = AcquilaEvent(component.strip(), "move absolute", arg, uuid=uuid, tick_count=7)
    assert parse_event(format_event(event)) == event


def test_an_exchange_tells_what_becomes_of_a_command() -> None:
    exchange = Exchange(parse_event(LIVE), "tube", now=10.0)
    assert exchange.received(10.0).reply_type is ReplyType.RCV
    assert exchange.next_feedback <= 11.0  # once a second at least
    assert exchange.feedback("half", 10.8).reply == "half"
    assert 10.8 < exchange.next_feedback <= 11.8
    end = exchange.done("90")
    assert (end.reply_type, end.reply, end.comp_type) == (ReplyType.ACK, "90", "tube")
    assert exchange.failed("why").reply_type is ReplyType.ERR


@pytest.mark.parametrize("digits", ["26481", "-7"])
def test_digits_as_text_are_the_same_command_as_the_number(digits: str) -> None:
    text, number = (AcquilaEvent("tube", "xrayon", uuid=u) for u in (digits, int(digits)))
    assert text.key == number.key
    assert AcquilaEvent("tube", "xrayon", uuid="26ef64cc-01ab").key == "26ef64cc-01ab"
