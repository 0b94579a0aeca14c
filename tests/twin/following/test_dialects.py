"""Message servers that differ: every fault is told in time, and a healthy machine is left
alone."""

from __future__ import annotations

import json
import random

import pytest

from flexdt.clients.following.session import FollowSession
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Alarm
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from tests.support.dialect_runs import Listener, missed
from tests.support.dialects import DIALECTS, FAULTS, SLIPS, Dialect, conversation, healthy

each = pytest.mark.parametrize("dialect", DIALECTS, ids=lambda d: d.name)
DRAWN = 25
HOURS = 0.5


def test_there_are_ten_dialects_and_every_fault_and_slip_is_drawn() -> None:
    assert len({d.name for d in DIALECTS}) == len(DIALECTS) == 10
    drawn = [conversation(d, seed) for d in DIALECTS for seed in range(DRAWN)]
    told = {kind for made in drawn for fault in made.faults for kind in fault.kinds}
    assert told == {"slow", "range", "offset", "off_path", "limits", "limit", "silent"}
    assert len(FAULTS) == 5
    assert len(SLIPS) == 6
    assert sum(not made.faults for made in drawn) > 10


@each
@pytest.mark.daily(3)
def test_every_fault_is_told_within_a_second_and_nothing_else_is(
    dialect: Dialect,
) -> None:
    for seed in range(DRAWN):
        assert missed(conversation(dialect, seed)) == [], f"seed {seed}"


@each
@pytest.mark.daily(2)
def test_healthy_traffic_raises_no_error_and_at_most_one_warning(
    dialect: Dialect,
) -> None:
    messages = sorted(healthy(dialect, 1, 3600.0 * HOURS), key=lambda message: message[0])
    listener = Listener().hear(messages)
    assert [a for a in listener.alarms if a.severity == "error"] == []
    assert len(listener.alarms) <= 1
    mirror = listener.wait(listener.now + 10.0).session.mirror
    assert mirror.under_way == ()
    assert mirror.axes["mag_obj"].heard_s is not None
    assert listener.session.unread == sum(b'"UUID"' not in data for _, data in messages)
    if dialect.raw:
        assert "not a JSON object" in listener.session.unread_example


@each
@pytest.mark.daily(5)
def test_a_listener_that_does_not_read_for_seconds_finds_no_fault(
    dialect: Dialect,
) -> None:
    rng = random.Random(dialect.name)
    stalls, at = [], 0.0
    while at < 900.0:
        at += rng.expovariate(1.0 / 10.0)
        stalls.append((at, at + rng.uniform(0.05, 3.0)))
        at = stalls[-1][1]
    messages = sorted(healthy(dialect, 2, 900.0), key=lambda message: message[0])
    listener = Listener(stalls).hear(messages)
    assert [a for a in listener.alarms if a.severity == "error"] == []
    assert len(listener.alarms) <= 2


# -- what a tick and a UUID are for, message by message --------------------------------------


def session() -> tuple[FollowSession, list[Alarm]]:
    flexray, alarms = builtin_machine("flexray"), list[Alarm]()
    follower = Follower(flexray, builtin_profile(flexray.default_profile))
    return FollowSession(follower, alarms.append, clock=lambda: 0.0), alarms


def say(
    made: FollowSession, at: float, words: str, what: str = "", **more: object
) -> None:
    component, command, arg1 = words.split("|")
    told: dict[str, object] = {"component": component, "command": command, "arg1": arg1,
                               "reply type": what, "UUID": 5}  # fmt: skip
    made.message(json.dumps(told | more).encode(), at)


def test_the_tick_tells_two_commands_of_one_uuid_apart() -> None:
    made, alarms = session()
    one, two = "tra_obj|move absolute|10", "tra_obj|move absolute|20"
    say(made, 0.0, one, **{"tick count": 1})
    say(made, 0.1, two, **{"tick count": 2})
    say(made, 1.3, "tra_obj|move absolute|", "ACK", reply="20.0", **{"tick count": 2})
    assert [w.heard.tick for w in made.mirror.waiting.values()] == [1]
    assert made.mirror.positions["tra_obj"] == 20.0
    assert [a.kind for a in alarms if a.severity == "error"] == []


@pytest.mark.parametrize("uuid", [5, 5.0, "5"])
def test_a_reply_whose_uuid_is_written_otherwise_is_still_its(uuid: object) -> None:
    made, _ = session()
    say(made, 0.0, "tube|set kV|70")
    say(made, 0.1, "tube|set kV|", "ACK", UUID=uuid, **{"tick count": 99})
    assert made.mirror.kV == 70.0
    assert not made.mirror.waiting


def test_an_end_that_is_heard_before_its_command_ends_it() -> None:
    made, alarms = session()
    say(made, 0.0, "tube|set kV|", "ACK", **{"tick count": 3})
    say(made, 0.01, "tube|set kV|70", **{"tick count": 2})
    assert made.mirror.kV == 70.0
    assert not made.mirror.waiting
    assert alarms == []


def test_a_double_of_the_end_and_of_the_command_changes_nothing() -> None:
    made, alarms = session()
    say(made, 0.0, "tra_obj|move absolute|10")
    say(made, 0.9, "tra_obj|move absolute|10", "ACK", reply="10.0")
    say(made, 1.0, "tra_obj|move absolute|40", UUID=6)
    say(made, 1.6, "tra_obj|move absolute|10", "ACK", reply="10.0")
    say(made, 1.7, "tra_obj|move absolute|10")
    say(made, 2.6, "tra_obj|move absolute|40", "ACK", reply="40.0", UUID=6)
    assert made.mirror.positions["tra_obj"] == 40.0
    assert not made.mirror.waiting
    assert alarms == []


def test_what_is_read_late_is_as_early_as_it_may_have_come() -> None:
    for late, kinds in ((0.0, ["slow"]), (0.5, [])):
        made, alarms = session()
        say(made, 0.0, "mag_obj|move absolute|400")
        told = {"component": "mag_obj", "command": "move absolute", "reply type": "FDB",
                "UUID": 5, "reply": "565.0"}  # fmt: skip
        made.message(json.dumps(told).encode(), 1.9, late)  # 1.2 s by the trapezium
        assert [a.kind for a in alarms] == kinds
