"""A followed machine: mirrored state, alarms and record, from messages and times alone."""

from __future__ import annotations

import itertools
import pickle
import random
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from flexdt.clients.following.hearing import heard
from flexdt.phantoms import load_phantom
from flexdt.twin.collision.convex_pieces import convex_pieces
from flexdt.twin.collision.plan_report import collision_check
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Alarm, Mirror
from flexdt.twin.machine.description import (
    Machine,
    builtin_machine,
    builtin_profile,
    profile_of,
)
from flexdt.twin.script import parse_script
from flexdt.twin.script.executed_log import read_log
from flexdt.twin.script.log_fit import fit_machine
from tests.support.scanner_traffic import Motor, event, replay

LOGS = Path(__file__).parents[2] / "data" / "logs"
LOG = (LOGS / "unitom_xl_201106_001.txt").read_bytes()
FLEXRAY = builtin_machine("flexray")
UNITOM = builtin_machine("unitom_xl")
Timed = tuple[float, bytes]


def follower(machine: Machine = FLEXRAY, **more: object) -> Follower:
    profile = builtin_profile(machine.default_profile)
    return Follower(machine, profile, **more)  # type: ignore[arg-type]


class Listener:
    """Feeds messages in time order, and lets time pass between them in tenths of a second."""

    def __init__(self, follow: Follower) -> None:
        self.follower, self.mirror = follow, Mirror.of(follow.machine)
        self.now = 0.0
        self.alarms: list[Alarm] = []
        self.record = b""

    def hear(self, messages: Iterable[Timed]) -> Listener:
        axes = (*self.follower.machine.axes, *self.follower.machine.virtual_axes)
        for at, data in messages:
            self.now = self.now or at - 0.1
            self.wait(at)
            said = heard(data, axes, _stamp(at))
            self._take(self.follower.hear(self.mirror, said, at))
            self.record += b"".join(self.mirror.lines)
        return self

    def wait(self, until: float) -> Listener:
        while self.now + 0.1 < until:
            self.now += 0.1
            self._take(self.follower.tick(self.mirror, self.now))
        self.now = max(self.now, until)
        return self

    def _take(self, mirror: Mirror) -> None:
        new = mirror.raised - self.mirror.raised
        self.alarms += mirror.alarms[len(mirror.alarms) - new :] if new else ()
        self.mirror = mirror

    @property
    def errors(self) -> list[tuple[str, str]]:
        return [(a.kind, a.about) for a in self.alarms if a.severity == "error"]


def _stamp(seconds: float) -> str:
    ms = round(1000 * seconds)
    return f"{ms // 3600000 % 24:02d}:{ms // 60000 % 60:02d}:{ms // 1000 % 60:02d}.{ms % 1000:03d}"


def motor(name: str, target: float, machine: Machine = FLEXRAY, **more: float) -> Motor:
    axis = machine.axes[name]
    values = {
        "start": axis.home,
        "speed": axis.speed,
        "acceleration": axis.acceleration,
        **more,
    }
    return Motor(name, target=target, **values)


# -- the one recorded scan -------------------------------------------------------------------


def test_the_recorded_scan_is_mirrored_and_its_record_fits_the_same_machine() -> None:
    lines, _ = read_log(LOG)
    listener = Listener(follower(UNITOM)).hear(replay(LOG, lines))
    mirror = listener.mirror
    assert mirror.positions["tra_obj"] == pytest.approx(55.769165, abs=1e-3)
    assert mirror.positions["mag_det"] == pytest.approx(625.675232, abs=1e-3)
    assert str(mirror.camera.roi) == "0 12 1919 1907"
    assert (mirror.camera.frames, mirror.camera.exposure_ms) == (1, 25.018499)
    assert mirror.xrays_on is False, "the last command but three"
    # Nothing of it is an error: the machine file is fitted to this very log.
    assert listener.errors == []
    again, problems = read_log(listener.record)
    assert [p.message for p in problems if p.severity == "error"] == []
    assert [(type(x.command), x.command.wait, x.own_s) for x in again] == [
        (type(x.command), x.command.wait, x.own_s) for x in lines
    ]
    ours, theirs = (fit_machine([log], UNITOM, "x").machine for log in (again, lines))
    for name in ("tra_obj", "rot_obj", "mag_det"):
        assert ours.axes[name].lower == theirs.axes[name].lower
        assert ours.axes[name].max_speed == theirs.axes[name].max_speed
    assert ours.timing.move_s == pytest.approx(theirs.timing.move_s, abs=0.002)


def test_the_recorded_scan_on_a_machine_with_other_limits_is_alarmed_at_its_first_reply() -> (
    None
):
    lines, _ = read_log(LOG)
    axis = UNITOM.axes["tra_obj"].model_copy(update={"upper": 400.0})
    wrong = UNITOM.model_copy(update={"axes": {**UNITOM.axes, "tra_obj": axis}})
    listener = Listener(follower(wrong)).hear(replay(LOG, lines))
    found = [a for a in listener.alarms if a.kind == "limits"]
    assert [a.about for a in found] == ["tra_obj"] * len(found)
    first = next(x for x in lines if getattr(x.command, "component", "") == "tra_obj")
    assert 0.0 <= found[0].at_s - (first.sent_s + first.own_s) < 0.01
    assert "12 and 319" in found[0].message


# -- faults, each on a machine of the test's own ---------------------------------------------


def test_a_sound_machine_raises_no_error(
    rng_moves: Callable[[int], Iterator[Timed]],
) -> None:
    listener = Listener(follower()).hear(rng_moves(40))
    assert listener.errors == []
    assert listener.mirror.raised == len(listener.alarms)


@pytest.fixture
def rng_moves() -> Callable[[int], Iterator[Timed]]:
    """Moves to places drawn at random, within reach, after delays drawn at random."""

    def make(count: int) -> Iterator[Timed]:
        rng = random.Random(20261121)
        at, places = 0.0, {n: a.home for n, a in FLEXRAY.axes.items()}
        for key in range(1, count + 1):
            name = rng.choice(["tra_obj", "mag_obj", "rot_obj", "tra_det"])
            axis = FLEXRAY.axes[name]
            low, high = max(axis.lower, -400.0) + 1.0, min(axis.upper, 900.0) - 1.0
            made = motor(
                name,
                rng.uniform(low, high),
                start=places[name],
                delay_s=rng.uniform(0, 0.2),
            )
            yield from made.messages(key, at)
            at += made.duration_s + 1.0
            places[name] = made.target

    return make


@pytest.mark.parametrize("factor", [0.5, 0.7, 1.5])
def test_a_motor_of_another_speed_is_alarmed_within_two_feedbacks(factor: float) -> None:
    axis = FLEXRAY.axes["mag_obj"]
    moved = motor(
        "mag_obj",
        axis.home + (300.0 if axis.home < 500 else -300.0),
        speed=axis.speed * factor,
    )
    listener = Listener(follower()).hear(moved.messages(1, 5.0))
    kind = "slow" if factor < 1 else "fast"
    assert (kind, "mag_obj") in listener.errors
    first = next(a for a in listener.alarms if a.kind == kind)
    # From the message that first shows 0.3 s of difference, which FDB brings every 0.8 s.
    shown = next(
        k * 0.8 for k in itertools.count(1)
        if abs(_delay(moved, axis.speed, k * 0.8)) > 0.3
    )  # fmt: skip
    assert first.at_s <= 5.0 + shown + 0.001


def _delay(moved: Motor, speed: float, time: float) -> float:
    """How far behind the nominal motor this one is: by bisection of the nominal trapezium."""
    nominal = Motor(moved.name, moved.start, moved.target, speed, moved.acceleration)
    low, high, way = 0.0, nominal.duration_s, abs(moved.position(time) - moved.start)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (
            (middle, high)
            if abs(nominal.position(middle) - moved.start) < way
            else (low, middle)
        )
    return time - low


def test_a_move_that_starts_late_is_no_slow_motor_but_one_that_hangs_is_told() -> None:
    moved = motor("tra_obj", 100.0, delay_s=0.25)
    assert Listener(follower()).hear(moved.messages(1, 0.0)).errors == []
    begun = list(moved.messages(1, 0.0))[:2]
    listener = Listener(follower()).hear(begun).wait(10.0)
    assert ("range", "tra_obj") in [(a.kind, a.about) for a in listener.alarms]
    silent = next(a for a in listener.alarms if a.kind == "silent")
    assert 2.5 < silent.at_s < 2.7


@pytest.mark.parametrize("offset", [0.05, -0.5, 20.0])
def test_an_offset_is_alarmed_with_the_reply_that_shows_it(offset: float) -> None:
    moved = motor("tra_obj", 50.0)
    messages = list(moved.messages(1, 0.0))
    shown = [
        (at, event(1, ("tra_obj", "move absolute", "50.0"), "ACK", f"{50 + offset:.10f}"))
        if i == len(messages) - 1
        else (at, data)
        for i, (at, data) in enumerate(messages)
    ]
    listener = Listener(follower()).hear(shown)
    assert listener.errors == [("offset", "tra_obj")]
    assert listener.alarms[-1].at_s == messages[-1][0]
    assert listener.mirror.positions["tra_obj"] == 50 + offset


def test_what_lies_beyond_a_limit_is_told_when_it_is_sent() -> None:
    beyond = FLEXRAY.axes["tra_obj"].upper + 5.0
    strict = FLEXRAY.model_copy(update={"on_limit": "reject"})
    for machine, severity in ((FLEXRAY, "warning"), (strict, "error")):
        listener = Listener(follower(machine)).hear(
            [(3.0, event(1, ("tra_obj", "move absolute", str(beyond))))]
        )
        told = [(a.kind, a.about, a.severity, a.at_s) for a in listener.alarms]
        assert ("limit", "tra_obj", severity, 3.0) in told
    near = Listener(follower()).hear(
        [(0.0, event(1, ("tra_obj", "move absolute", str(beyond - 5.1))))]
    )
    assert [(a.kind, a.severity) for a in near.alarms] == [("limit_near", "warning")]


def test_a_motor_that_moved_by_itself_and_one_that_is_refused() -> None:
    ask = ("mag_obj", "status_position_get")
    messages = [
        (0.0, event(1, ask)), (0.1, event(1, ask, "ACK", "300.0000000000")),
        (1.0, event(2, ask)), (1.1, event(2, ask, "ACK", "300.0100000000")),
        (2.0, event(3, ask)), (2.1, event(3, ask, "ACK", "301.0000000000")),
        (3.0, event(4, ("tube", "xrayon"))), (3.1, event(4, ("tube", "xrayon"), "ERR", "door")),
    ]  # fmt: skip
    listener = Listener(follower()).hear(messages)
    assert listener.errors == [("moved", "mag_obj"), ("failed", "tube")]
    assert listener.mirror.xrays_on is None, "what failed has changed nothing"


@pytest.mark.parametrize("asked", ["Z", "z"])
def test_motors_in_capitals_are_followed_and_one_that_there_is_not_is_told(
    asked: str,
) -> None:
    cabinet = builtin_machine("xyzr_cabinet")
    script = parse_script("z move absolute 250 ACK\nX move absolute 5 ACK")
    moved = replace(motor("Z", 250.0, cabinet), name=asked)
    shown = list(moved.messages(1, 0.0))
    follow = Follower(cabinet, profile_of(cabinet), script=script)
    listener = Listener(follow).hear(shown)
    assert listener.errors == []
    assert listener.mirror.positions["Z"] == 250.0
    assert listener.mirror.axes["Z"].heard_s == shown[-1][0]
    assert listener.mirror.next_line == 1
    listener.hear([(100.0, event(9, ("tra_obj", "move absolute", "5")))])
    assert ("unknown_axis", "tra_obj") in listener.errors


def test_a_lost_link_is_told_at_once_and_forgets_what_was_under_way() -> None:
    follow = follower()
    listener = Listener(follow).hear(list(motor("tra_obj", 50.0).messages(1, 0.0))[:3])
    lost = follow.linked(listener.mirror, False, 2.0, "cable")
    assert (lost.alarms[-1].kind, lost.alarms[-1].at_s) == ("lost", 2.0)
    assert not lost.waiting
    back = follow.linked(lost, True, 60.0)
    assert back.connected
    assert follow.tick(back, 61.0).raised == back.raised
    assert back.to_dict(61.0)["age_s"] == pytest.approx(61.0 - 0.8)


# -- scripts ---------------------------------------------------------------------------------

SCRIPT = """tra_obj\tmove absolute\t20\t\tACK\t\t
camera\tset number of averages\t2\t\tACK\t\t
scanner\tpause\t3000\t\tACK\t\t
mag_obj\tmove absolute\t{mag}\t\tACK\t\t
"""


def said(key: int, at: float, took: float, *words: str) -> list[Timed]:
    return [(at, event(key, words)), (at + took, event(key, words, "ACK"))]


def test_a_late_script_and_a_command_that_is_not_in_it() -> None:
    script = parse_script(SCRIPT.format(mag=600))
    listener = Listener(follower(script=script))
    listener.hear(motor("tra_obj", 20.0).messages(1, 0.0))
    assert listener.mirror.next_line == 1
    end = listener.now
    listener.wait(end + 5.0)
    assert listener.errors == [("late", "script")]
    assert "line 2" in listener.alarms[-1].message
    assert listener.alarms[-1].at_s < end + 1.0
    listener.hear(said(2, listener.now, 0.1, "camera", "set number of averages", "2"))
    listener.hear(said(3, listener.now + 0.1, 0.1, "tube", "set kV", "70"))
    assert listener.alarms[-1].kind == "off_script"
    assert listener.mirror.next_line == 2


def test_the_rest_of_the_script_is_checked_from_where_the_machine_really_is() -> None:
    pieces = convex_pieces(load_phantom("lego").mesh(around=True))
    script = parse_script(
        "scanner\tpause\t10\t\tACK\t\t\nmag_det\tmove absolute\t400\t\tACK\t\t\n"
    )
    follow = follower(script=script, collision=collision_check(pieces))
    home = Mirror.of(FLEXRAY)
    free = home.with_axis("mag_obj", position=150.0, heard_s=0.0)
    assert follow.ahead(free, 0.0) == ()
    blocked = home.with_axis("mag_obj", position=700.0, heard_s=0.0).with_axis(
        "mag_det", position=1000.0, heard_s=0.0
    )
    found = follow.ahead(blocked, 5.0)
    assert [a.kind for a in found] == ["collision"]
    assert "line 2" in found[0].message
    assert "tra_obj" in found[0].message, "says what is assumed"
    twice = follow.with_ahead(follow.with_ahead(home, found), found)
    assert twice.raised == 1


def test_an_exposure_ahead_that_saturates_the_panel_is_a_warning() -> None:
    rows = [
        ("tube", "set kV", "90"), ("tube", "set power", "60"), ("camera", "set exposure", "5000"),
        ("tube", "xrayon", ""), ("camera", "take image", ""), ("camera", "save image", "a.tif"),
    ]  # fmt: skip
    text = "".join(f"{part}\t{what}\t{value}\t\tACK\t\t\n" for part, what, value in rows)
    follow = follower(script=parse_script(text))
    found = follow.ahead(Mirror.of(FLEXRAY), 0.0)
    assert [(a.severity, a.kind) for a in found] == [("warning", "saturated_open_beam")]
    assert "would fill 90 %" in found[0].message


# -- a day -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_day_leaves_nothing_behind() -> None:
    """24 hours of scans on a clock of the test's own: what is kept is as large as after one."""
    follow = follower(script=parse_script(SCRIPT.format(mag=600)))
    listener = Listener(follow)
    sizes: list[int] = []
    key, tra, mag = 0, FLEXRAY.axes["tra_obj"].home, FLEXRAY.axes["mag_obj"].home
    at = 0.0
    for hour in range(24):
        while at < 3600.0 * (hour + 1):
            batch: list[Timed] = []
            one = motor("tra_obj", 20.0 if tra != 20.0 else 21.0, start=tra)
            batch += one.messages(key + 1, at)
            at += one.duration_s + 0.2
            batch += said(key + 2, at, 0.1, "camera", "set number of averages", "2")
            batch += said(key + 3, at + 0.2, 3.0, "scanner", "pause", "3000")
            batch += said(key + 4, at + 4.0, 0.1, "heater", f"set temp {key}", "20")
            batch += [(at + 4.5, event(key + 5, ("unknown", "never ends")))]
            two = motor("mag_obj", 600.0 if mag != 600.0 else 500.0, start=mag)
            at += 5.0
            batch += two.messages(key + 6, at)
            at += two.duration_s + 200.0
            tra, mag, key = one.target, two.target, key + 6
            for when, data in batch:
                axes = (*FLEXRAY.axes, *FLEXRAY.virtual_axes)
                listener._take(
                    follow.hear(listener.mirror, heard(data, axes, "00:00:00.000"), when)
                )
            listener._take(follow.tick(listener.mirror, at))
        # Each second scan ends with a move that is not the script's, so the script's is late.
        assert set(listener.errors) == {("late", "script")}
        listener.alarms.clear()
        sizes.append(len(pickle.dumps(listener.mirror)))
    assert key > 2000
    assert max(sizes[12:]) <= 1.02 * max(sizes[:12])
    assert len(listener.mirror.waiting) <= 2


def test_a_cluster_that_is_no_utf8_is_read_byte_for_byte() -> None:
    reply = struct.pack(
        ">17d", 25.0, 25.0, 40.0, 0, 80.0, 319.0, 12.0, 0, 50.0, 0, 80.0, *[0.0] * 6
    )
    reply = reply + bytes(7) + struct.pack(">2d", 319.0, 12.0) + bytes(108)
    text = event(1, ("tra_obj", "move absolute", "25.0"), "ACK", "@").decode()
    raw = text.encode("latin-1").replace(
        b'"@"', b'"' + reply.replace(b'"', b'\\"').replace(b"\\", b"\\\\") + b'"'
    )
    said = heard(raw, ["tra_obj"], "00:00:00.000")
    assert said.reply.encode("latin-1") == reply
