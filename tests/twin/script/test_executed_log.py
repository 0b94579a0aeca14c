"""Executed scripts: reading them, whatever is wrong with them, and the machine fitted to one.

The log is that of the published scan 201106_001 on a UniTOM XL (documentation of the meta-cli
project, file `script_executed.txt`); what it should give is written out here by hand.
"""

from __future__ import annotations

import json
import math
import random
import struct
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from flexdt.clients.cli.command_tree import run
from flexdt.twin.machine.description import (
    Machine,
    Timing,
    builtin_machine,
    builtin_profile,
    parse_machine,
)
from flexdt.twin.script import check_script, parse_script, plan_script
from flexdt.twin.script import commands as c
from flexdt.twin.script.executed_log import (
    Executed,
    MotorReply,
    motor_cluster,
    motor_reply,
    read_log,
)
from flexdt.twin.script.log_fit import Fit, LogComparison, first_difference, fit_machine
from flexdt.twin.script.planning.time_ranges import step_range, total_range

DATA = Path(__file__).parents[2] / "data" / "logs"
LOG = DATA / "unitom_xl_201106_001.txt"
SCRIPT = DATA / "unitom_xl_201106_001.tsv"

LIMITS = {  # lower, upper, greatest speed, greatest acceleration: read from the bytes by hand
    "ver_tube": (-62.0, 1000.0, 75.0, 250.0),
    "ver_det": (60.0, 1000.0, 75.0, 250.0),
    "tra_obj": (12.0, 319.0, 50.0, 80.0),
    "tra_det": (-220.0, 197.0, 200.0, 200.0),
    "mag_det": (412.0, 2032.0, 40.0, 80.0),
    "mag_obj": (-38.0, 1685.0, 40.0, 80.0),
    "rot_obj": (-127500.0, 127500.0, 200.0, 300.0),
}


@pytest.fixture(scope="module")
def log() -> tuple[Executed, ...]:
    lines, problems = read_log(LOG.read_bytes())
    assert problems == ()
    return lines


@pytest.fixture(scope="module")
def blank() -> Machine:
    """The UniTOM XL without anything that the log tells."""
    machine = builtin_machine("unitom_xl")
    wrong = {"lower": -1e4, "upper": 1e4, "max_speed": 500.0, "max_acceleration": 500.0}
    axes = {
        n: a.model_copy(update={**wrong, "source": ""}) for n, a in machine.axes.items()
    }
    return machine.model_copy(update={"axes": axes, "timing": Timing(source="assumed")})


@pytest.fixture(scope="module")
def fitted(log: tuple[Executed, ...], blank: Machine) -> Fit:
    return fit_machine([log], blank, "measured: log")


def test_every_line_is_read_with_its_time_moment_and_reply(
    log: tuple[Executed, ...],
) -> None:
    assert [x.line for x in log] == list(range(1, 58))
    assert sum(x.own_s for x in log) == pytest.approx(146.132)
    assert log[0].sent_s == pytest.approx(9 * 3600 + 34 * 60 + 16.183)
    assert log[4].reply == b"25.018500"
    assert first_difference(parse_script(SCRIPT.read_bytes()).commands, log) is None


def test_limits_and_rates_are_those_of_the_log_exactly(fitted: Fit) -> None:
    found = {n: fitted.machine.axes[n] for n in fitted.axes}
    assert {
        n: (a.lower, a.upper, a.max_speed, a.max_acceleration) for n, a in found.items()
    } == LIMITS
    assert found["tra_obj"].source == "measured, log, n = 5"
    assert found["tra_obj"].speed == 40.0
    assert fitted.machine.axes["PI_X"].source == ""
    assert fitted.axes["tra_obj"][-1].position == pytest.approx(55.769165)


def test_rates_that_the_script_sets_stay_those_of_the_base(
    log: tuple[Executed, ...], blank: Machine
) -> None:
    """Only the turntable's speed and acceleration are set, between its moves."""
    slow = {"speed": 3.0, "acceleration": 4.0}
    axes = {n: a.model_copy(update=slow) for n, a in blank.axes.items()}
    found = fit_machine([log], blank.model_copy(update={"axes": axes}), "slow").machine
    rates = {n: (a.speed, a.acceleration) for n, a in found.axes.items()}
    assert rates["rot_obj"] == rates["PI_X"] == (3.0, 4.0)
    assert rates["ver_tube"] == rates["ver_det"] == (37.5, 125.0)
    assert (rates["tra_obj"], rates["mag_obj"]) == ((40.0, 80.0), (40.0, 50.0))


def test_errors_of_the_fit_and_cross_validated(fitted: Fit) -> None:
    rows = fitted.lines.rows
    assert len(fitted.samples) <= 12
    errors = sum(abs(row.real_s - row.predicted_s) for row in rows)
    assert errors == pytest.approx(fitted.lines.sum_abs_error_s)
    assert errors <= 8.5
    assert fitted.cross_validated_s <= 12.0
    assert fitted.cross_validated_s > errors
    document = fitted.to_dict()
    assert document["single"] == [
        "xrayon",
        "xray_ready",
        "write_settings",
        "xrayoff_again",
    ]
    assert fitted.frame_period_s == (pytest.approx(36.079 / 1440),)
    assert fitted.machine.timing.move_standing_s == pytest.approx(0.2485)


def test_the_shipped_machine_is_the_fitted_one(fitted: Fit) -> None:
    shipped = builtin_machine("unitom_xl")
    for name in LIMITS:
        assert shipped.axes[name].source == fitted.machine.axes[name].source
    assert {n: (a.lower, a.upper, a.max_speed, a.max_acceleration) for n, a in
            shipped.axes.items() if n in LIMITS} == LIMITS  # fmt: skip
    assert shipped.timing == fitted.machine.timing.model_copy(
        update={"source": shipped.timing.source, "set_tube_s": shipped.timing.set_tube_s}
    )
    assert all(part.source.startswith("assumed") for part in shipped.components)
    for target in ("tra_obj move absolute -200 ACK", "mag_det move absolute 150 ACK"):
        profile = builtin_profile(shipped.default_profile)
        plan = plan_script(target, shipped, profile)
        assert [p.code for p in plan.problems] == ["limit_clamped"]


def test_ranges_of_steps_and_of_the_total(fitted: Fit) -> None:
    profile = builtin_profile(fitted.machine.default_profile)
    plan = plan_script(SCRIPT, fitted.machine, profile)
    timing = fitted.machine.timing
    for step in plan.steps:
        low, high = step_range(step, timing) or (1.0, 0.0)
        assert 0.0 <= low <= step.holds_s <= high
    low, high = total_range(plan.steps, plan.duration_s, timing) or (1.0, 0.0)
    assert 100.0 < low < plan.duration_s < 146.132 < high
    document = check_script(SCRIPT.read_bytes(), fitted.machine, profile).to_dict()
    assert (document["p5_s"], document["p95_s"]) == (low, high)
    flexray = builtin_machine()
    assumed = check_script(
        "tube xrayon ACK", flexray, builtin_profile(flexray.default_profile)
    )
    assert assumed.to_dict()["p5_s"] is None


def test_a_log_is_no_script_and_the_message_says_what_it_is_good_for() -> None:
    (problem,) = check_script(LOG.read_bytes()).problems
    assert (problem.severity, problem.code) == ("error", "executed_log")
    assert "flexdt commission" in problem.message


def line(own: str = "5", reply: bytes = b"", moment: str = "09:00:00.000") -> bytes:
    text = f"rot_obj\tmove absolute\t10\t\tACK\t\t\t{own}\t"
    return text.encode() + reply + f"\t{moment}\r\n".encode()


def motor(*, upper: float = 90.0, copy: float = 90.0, target: float = 10.0) -> bytes:
    values = [10.0, target, 5.0, 0.0, 6.0, upper, -90.0, 1.0, 50.0, 1.0, 60.0, *[0.0] * 6]
    return (
        struct.pack(">17d", *values)
        + bytes(7)
        + struct.pack(">2d", copy, -90.0)
        + bytes(90)
    )


@pytest.mark.parametrize(
    ("data", "number", "severity", "said"),
    [
        (line() + b"tube\txrayoff\t\t\tACK\t\t\t50", 2, "warning", "cut off"),
        (line(own="-5"), 1, "error", "must not be negative"),
        (line(own="1e300"), 1, "error", "beyond"),
        (line(own="700000000"), 1, "error", "at most 604800"),
        (line(own=""), 1, "error", "own time [ms] (column 8)"),
        (line(moment="25:00:00.000"), 1, "error", "no time of day"),
        (line(moment="24:00:00.000"), 1, "error", "no time of day"),
        (line(moment="23:60:00.000"), 1, "error", "no time of day"),
        (line(moment="23:59:60.000"), 1, "error", "no time of day"),
        (
            line(reply=motor(upper=1.1e9, copy=1.1e9)),
            1,
            "warning",
            "17 big-endian doubles",
        ),
        (
            line(reply=motor(upper=float("inf"), copy=float("inf"))),
            1,
            "warning",
            "17 big-endian",
        ),
        (b"tube\txrayoff\t09:00:00.000\r\n", 1, "error", "3 columns, or no wait"),
        (line(reply=motor())[:-20] + b"\t09:00:00.000\r\n", 1, "warning", ""),
        (line(reply=motor(copy=80.0)), 1, "warning", "limits twice"),
        (line(reply=motor(target=40.0)), 1, "warning", "position near the target"),
        (line(reply=motor(upper=float("nan"))), 1, "warning", "17 big-endian doubles"),
    ],
)
def test_what_does_not_hold_is_said_with_its_line(
    data: bytes, number: int, severity: str, said: str
) -> None:
    _, problems = read_log(data)
    if not said:
        assert all(p.line == number for p in problems)
        return
    assert [(p.line, p.severity) for p in problems if said in p.message] == [
        (number, severity)
    ]


def test_a_sound_reply_is_decoded() -> None:
    (found,), problems = read_log(line(reply=motor()))
    assert problems == ()
    assert found.motor is not None
    assert (found.motor.lower, found.motor.upper, found.motor.max_speed) == (
        -90.0,
        90.0,
        50.0,
    )


@settings(max_examples=200, deadline=None)
@given(
    reply=st.binary(max_size=200) | st.text("\t\r\n0:.", max_size=30).map(str.encode),
    own=st.integers(0, 604_800_000),
    after=st.timedeltas(timedelta(0), timedelta(days=1) - timedelta(milliseconds=1)),
    bounds=st.sampled_from([(None, None), (2000.0, None), (None, 150.0), (7.0, 8.0)]),
)
def test_columns_come_back_whatever_bytes_the_reply_has(
    reply: bytes, own: int, after: timedelta, bounds: tuple[float | None, float | None]
) -> None:
    assume(reply.count(b":") < 2)  # what might be a moment ends a line
    moment = (datetime(2026, 1, 1) + after).time()
    words = "\t".join("" if bound is None else f"{bound:g}" for bound in bounds)
    data = line(str(own), reply, moment.isoformat("milliseconds"))
    data = data.replace(b"ACK\t\t", f"ACK\t{words}".encode(), 1)
    (found,), _ = read_log(data)
    assert (found.reply, found.own_s) == (reply, own / 1000)
    assert found.sent_s == pytest.approx(after.total_seconds(), abs=1e-3)
    command = found.command
    assert (command.line, command.timeout_ms, command.expected_ms) == (1, *bounds)


RATE = st.floats(1e-3, 1e6)
PLACE = st.floats(-1e9, 1e9)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(PLACE, min_size=17, max_size=17),
    st.tuples(RATE, RATE, RATE, RATE),
    st.data(),
)
def test_a_reply_is_decoded_from_its_own_bytes_or_not_at_all(
    values: list[float], rates: tuple[float, ...], data: st.DataObject
) -> None:
    """0 position, 1 target, 2 speed, 4 acceleration, 5 upper, 6 lower, 8 and 10 the maxima."""
    lower, upper = sorted(
        data.draw(st.tuples(PLACE, PLACE).filter(lambda x: x[0] != x[1]))
    )
    assume(upper - lower > 1e-6)
    values[0] = data.draw(st.floats(lower - 1, upper + 1))
    (speed, max_speed), (acceleration, most) = sorted(rates[:2]), sorted(rates[2:])
    values[2], values[4], values[5], values[6] = speed, acceleration, upper, lower
    values[8], values[10] = max_speed, most
    wrong = data.draw(st.sampled_from([None, *FAULTS]))
    copy = [upper, lower]
    if wrong is not None:
        FAULTS[wrong](values, copy)
    raw = struct.pack(">17d", *values) + bytes(7) + struct.pack(">2d", *copy)
    assume(max(raw) >= 0x80)
    assume(all(abs(values[i]) <= 1e9 for i in (0, 1)) or wrong is not None)
    expected = MotorReply(
        values[0], values[1], speed, acceleration, lower, upper, max_speed, most
    )
    assert motor_reply(raw) == (expected if wrong is None else None), wrong
    assert motor_reply(raw[:-1]) is None


def _put(index: int, value: Callable[[list[float]], float]) -> Callable[..., None]:
    def change(values: list[float], copy: list[float]) -> None:
        values[index] = value(values)

    return change


FAULTS: dict[str, Callable[[list[float], list[float]], None]] = {
    "copy of the upper limit": lambda v, copy: copy.__setitem__(0, copy[0] + 1000.0),
    "copy of the lower limit": lambda v, copy: copy.__setitem__(1, copy[1] - 1000.0),
    "far above": _put(0, lambda v: v[5] + 1.01 + 1e-6 * abs(v[5])),
    "far below": _put(0, lambda v: v[6] - 1.01 - 1e-6 * abs(v[6])),
    "target": _put(1, lambda v: 1.01e9),
    "no speed": _put(2, lambda v: 0.0),
    "too fast": _put(2, lambda v: 1.01 * v[8]),
    "no acceleration": _put(4, lambda v: 0.0),
    "too sharp": _put(4, lambda v: 1.01 * v[10]),
    "absurd speed": _put(8, lambda v: 1.01e6),
    "absurd acceleration": _put(10, lambda v: 1.01e6),
}


def test_what_nobody_knows_of_a_reply_is_zero() -> None:
    made = motor_cluster(MotorReply(4.0, 5.0, 6.0, 7.0, -8.0, 9.0, 10.0, 11.0))
    head = struct.unpack_from(">17d", made)
    assert head == (4.0, 5.0, 6.0, 0, 7.0, 9.0, -8.0, 0, 10.0, 0, 11.0, *[0] * 6)
    assert struct.unpack_from(">2d", made, 17 * 8 + 7) == (9.0, -8.0)
    assert not any(made[17 * 8 : 17 * 8 + 7] + made[17 * 8 + 23 :])


@pytest.mark.parametrize(("upper", "text"), [(512.0, False), (256.0, True)])
def test_a_reply_that_was_saved_as_plain_text_is_none(upper: float, text: bool) -> None:
    """512 has the byte 0x80, the other powers of two have smaller ones."""
    values = [4.0, 4.0, 8.0, 0.0, 32.0, upper, 2.0, 0.0, 16.0, 0.0, 64.0, *[0.0] * 6]
    raw = struct.pack(">17d", *values) + bytes(7) + struct.pack(">2d", upper, 2.0)
    assert (motor_reply(raw) is None) == text


@pytest.mark.parametrize(
    ("asked", "target", "position", "near"),
    [
        (0.0, 0.001, 0.001, True),
        (10.0, 10.0109, 10.0, True),
        (10.0, 10.0112, 10.0, False),
        (10.0, 10.0, 11.0109, True),
        (10.0, 10.0, 8.9888, False),
        (500.0, 90.0, 90.0, True),  # the limit stopped it
        (-500.0, -90.0, -90.5, True),
        (-500.0, 90.0, 90.0, False),
    ],
)
def test_a_reply_is_about_its_own_move(
    asked: float, target: float, position: float, near: bool
) -> None:
    """The target to a thousandth of itself and a micrometre, the position to a millimetre
    more."""
    reply = motor(target=target).replace(
        struct.pack(">d", 10.0), struct.pack(">d", position), 1
    )
    (found,), problems = read_log(
        line(reply=reply).replace(b"\t10\t", f"\t{asked:g}\t".encode())
    )
    assert (found.motor is not None, [p.code for p in problems]) == (
        near,
        [] if near else ["reply"],
    )


def drawn_log(rng: np.random.Generator, slower: float) -> tuple[Executed, ...]:
    """Commands that only take the time of their kind, in another order each time."""
    words = [("tube\tset kV\t80", 0.2), ("camera\tset exposure\t100", 0.7)] * 6
    words += [("scanner\tpause\t250", 0.05)] * 6 + [
        ("scanner\twrite settings file\t", 1.0)
    ]
    data = b""
    for i in rng.permutation(len(words)):
        text, typical = words[i]
        own = 250 * ("pause" in text) + 1000 * typical * slower * rng.lognormal(0.0, 0.2)
        data += f"{text}\t\tACK\t\t\t{own:.0f}\t\t09:00:00.000\r\n".encode()
    lines, problems = read_log(data)
    assert problems == ()
    return lines


@pytest.mark.parametrize("seed", range(4))
def test_times_and_their_ranges_follow_the_description(seed: int, blank: Machine) -> None:
    """The sums of the module's description, with another library's distributions."""
    rng = np.random.default_rng(seed)
    logs = [drawn_log(rng, slower) for slower in (1.0, 1.1, 1.3)]
    fit = fit_machine(logs, blank, "drawn")
    kinds = {"set_tube": c.SetVoltage, "set_camera": c.SetExposure, "command": c.Pause,
             "write_settings": c.WriteSettingsFile}  # fmt: skip
    times = {
        kind: [x.own_s - 0.25 * (type_ is c.Pause) for log in logs for x in log
               if isinstance(x.command, type_)]
        for kind, type_ in kinds.items()
    }  # fmt: skip
    assert {k: list(v) for k, v in fit.samples.items()} == {
        k: pytest.approx(v) for k, v in times.items()
    }
    logs_of = {kind: np.log(np.array(found) + 0.003) for kind, found in times.items()}
    middles = {kind: math.log(median(found) + 0.003) for kind, found in times.items()}
    shifts = []
    for kind, found in times.items():
        half = math.ceil(len(found) / 2)
        later = np.mean(logs_of[kind][half:]) - math.log(median(found[:half]) + 0.003)
        shifts.append(later / math.sqrt(1 + 1 / half))
    shift = float(np.mean(shifts))
    error = float(np.std(shifts, ddof=1)) / math.sqrt(len(shifts))
    agreed = max(0.0, 1.0 - (error / shift) ** 2) * shift * 4 / 3
    scales = {
        kind: np.abs(y - middles[kind]).sum() / (len(y) - 0.5)
        for kind, y in logs_of.items()
    }
    common = np.mean(list(scales.values()))
    timing = fit.machine.timing
    assert timing.drift == pytest.approx(math.exp(abs(shift) * 4 / 3) - 1, abs=1e-4)
    for kind, found in times.items():
        middle, n = median(found), len(found)
        scale = np.average([common, scales[kind]], weights=[4, n - 1])
        beyond = -scale * math.log(min(1.0, 0.05 * (n + 1))) * math.hypot(1.0, 1.0 / n)
        low, high = np.quantile(logs_of[kind], (0.05, 0.95), method="weibull")
        low = math.exp(low - beyond + min(agreed, 0.0)) - 0.003
        high = math.exp(high + beyond + max(agreed, 0.0)) - 0.003
        spread = timing.spread[kind]
        assert timing.seconds(kind) == pytest.approx(middle, abs=1e-4)
        assert (spread.p5_s, spread.p95_s) == pytest.approx(
            (max(low, 0.0), high), abs=2e-4
        )
        assert spread.p5_s <= low + 1e-12
        assert spread.p95_s >= high - 1e-12
        assert spread.n == len(found)
    expected = fit.lines.sum_abs_error_s
    for kind, found in times.items():
        for i, x in enumerate(found):
            others = median(found[:i] + found[i + 1 :])
            expected += abs(x - others) - abs(x - timing.seconds(kind))
    assert fit.cross_validated_s == pytest.approx(expected)
    assert fit.to_dict()["single"] == []


def test_damaged_logs_never_raise_and_never_shift_a_limit_unsaid() -> None:
    """Truncated, cut, doubled and overwritten logs; a fit has the true limits or none."""
    whole, rng = LOG.read_bytes(), random.Random(17)
    base = builtin_machine("unitom_xl")
    for trial in range(150):
        data = bytearray(whole)
        for _ in range(rng.choice((1, 3, 30))):
            at, kind = rng.randrange(max(1, len(data))), rng.randrange(5)
            if kind == 0:
                data[at : at + 1] = bytes([rng.randrange(256)])
            elif kind == 1:
                del data[at : at + rng.randrange(1, 40)]
            elif kind == 2:
                data[at:at] = rng.choice(
                    (b"\t", b"\r\n", b"\0", b"\xff", b"9" * 400, b"\xed\xa0\x80")
                )
            elif kind == 3:
                del data[at:]
                data += b"x"
            else:
                data[at:at] = data[: rng.randrange(200)]
        if trial % 3 == 0:  # an editor took it for text
            data[:] = data.decode("ascii", "replace").encode("ascii", "replace")
        lines, problems = read_log(bytes(data))
        assert all(p.line >= 1 and p.message for p in problems)
        if lines and not any(p.severity == "error" for p in problems):
            found = fit_machine([lines], base, "damaged").machine
            assert {n: found.axes[n].upper for n in LIMITS} == {
                n: v[1] for n, v in LIMITS.items()
            }


def test_fit_writes_a_file_that_is_accepted_and_keeps_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "mine.toml"
    assert (
        run(
            [
                "machine",
                "fit",
                str(LOG),
                "--base",
                "unitom_xl",
                "--out",
                str(out),
                "--json",
            ]
        )
        == 0
    )
    document = json.loads(capsys.readouterr().out)
    for name, values in LIMITS.items():
        axis = document["axes"][name]
        keys = ("lower", "upper", "max_speed", "max_acceleration")
        assert tuple(axis[key] for key in keys) == values
        assert axis["source"].startswith("measured, log, n = ")
    assert set(document["timing"]["set_camera"]) == {"median_s", "p5_s", "p95_s", "n"}
    assert document["sum_abs_error_s"] <= 8.5 < document["total_s"]
    made, shipped = parse_machine(out.read_text()), builtin_machine("unitom_xl")
    times = (
        out.read_text()
        .split("[timing]")[1]
        .split("[timing.spread]")[0]
        .strip()
        .splitlines()
    )
    for row in times:
        kind = row.split(" = ")[0].removesuffix("_s")
        told = "measured, log" if kind in (*document["timing"], "drift") else "assumed"
        assert row.partition("  # ")[2] == ("" if kind == "source" else told)
    assert len(times) > 8
    assert made.components == shipped.components
    assert made.axes == shipped.axes
    assert run(["check", str(SCRIPT), "--machine", str(out), "--json"]) == 0
    step = json.loads(capsys.readouterr().out)["steps"][11]
    assert step["p5_s"] <= step["holds_s"] <= step["p95_s"]
    assert run(["machine", "check", str(out)]) == 0
    assert run(["machine", "show", str(out)]) == 0
    assert "measured, log, n = 5" in capsys.readouterr().out


def test_against_says_line_real_predicted_error_worst_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    words = ["check", str(SCRIPT), "--against", str(LOG), "--machine", "unitom_xl"]
    assert run([*words, "--json", "--html", str(page)]) == 0
    document = json.loads(capsys.readouterr().out)
    rows = document["lines"]
    assert len(rows) == 57
    errors = [abs(row["error_s"]) for row in rows]
    assert errors == sorted(errors, reverse=True)
    assert all(
        row["real_s"] - row["predicted_s"] == pytest.approx(row["error_s"])
        for row in rows
    )
    assert document["sum_abs_error_s"] == pytest.approx(sum(errors))
    assert document["total_real_s"] == pytest.approx(146.132)
    assert page.read_text().count("<tr>") == 58
    assert run(words) == 0
    text = capsys.readouterr().out
    assert text.startswith("line  real [s]  predicted [s]")
    inside = sum(
        row["p5_s"] - 1e-9 <= row["real_s"] <= row["p95_s"] + 1e-9 for row in rows
    )
    assert f"in their 90 % range:  {inside} of 57 lines" in text
    assert "where an axis stood before its first move, a log does not say" in text
    assert run(["check", str(LOG), "--against", str(LOG), "--machine", "unitom_xl"]) == 0


def test_a_log_of_another_script_and_files_that_are_no_logs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.txt"
    other.write_bytes(SCRIPT.read_bytes().replace(b"13.000000", b"14.000000", 1))
    assert run(["check", str(other), "--against", str(LOG)]) == 1
    assert (
        "line 14: 'tra_obj to 14' is 'tra_obj to 13' in the log"
        in capsys.readouterr().err
    )
    out = tmp_path / "out.toml"
    assert run(["machine", "fit", str(SCRIPT), "--out", str(out)]) == 1
    assert "no line of an executed script" in capsys.readouterr().err
    bench = str(DATA.parent / "machines" / "mini.toml")
    assert run(["machine", "fit", str(LOG), "--base", bench, "--out", str(out)]) == 1
    assert "(another machine is named with --base)" in capsys.readouterr().err
    assert not out.exists()


def test_a_log_of_another_machine_is_said_with_its_axes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["check", str(LOG), "--against", str(LOG), "--json"]
    assert run([*words, "--machine", "unitom_xl"]) == 0
    own = capsys.readouterr()
    assert own.err == ""
    assert json.loads(own.out)["problems"] == []
    low, high = json.loads(own.out)["total_range_s"]
    assert low < 146.132 < high
    assert run([*words, "--machine", "flexray"]) == 0
    other = capsys.readouterr()
    assert (
        "ver_tube goes from -62 to 1000 in the log, from 0 to 379 on machine flexray"
        in other.err
    )
    axes = [p["message"].split()[0] for p in json.loads(other.out)["problems"]]
    assert sorted(axes) == sorted(LIMITS)
    assert json.loads(other.out)["total_range_s"] is None
    assert run([*words, "--machine", str(DATA.parent / "machines" / "mini.toml")]) == 0
    assert "machine mini has no axis 'ver_tube'; it has: stage, panel, turn" in (
        capsys.readouterr().err
    )
    assert run(["machine", "fit", str(LOG), "--out", str(tmp_path / "a.toml")]) == 0
    said = capsys.readouterr()
    assert said.err.count("on machine flexray [other_machine]") == len(LIMITS)
    assert "one log does not show how a scan differs from the next" in said.out


def test_predictions_do_not_see_the_log(log: tuple[Executed, ...], fitted: Fit) -> None:
    """Times of the log changed: what is predicted on a given machine stays as it is."""
    slow = tuple(
        Executed(x.command, 2.0 * x.own_s, x.sent_s, x.reply, x.motor) for x in log
    )
    before, after = (LogComparison.of(x, fitted.machine) for x in (log, slow))
    assert [r.predicted_s for r in before.rows] == [r.predicted_s for r in after.rows]
    assert after.total_real_s == pytest.approx(2.0 * before.total_real_s)
