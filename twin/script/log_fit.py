"""A machine fitted to executed scripts: limits and rates from motors' replies,
times of commands.

The time of a command beyond its motion, pause or exposures is the median over its kind.
Its 90 % range is about the next time. From 19 times on it is that of order statistics
(Wilks 1941, doi:10.1214/aoms/1177731788), whatever the times are distributed like: the
next one is as likely in each of the n + 1 gaps between and beyond those that were
measured. Of fewer times, 1 / (n + 1) is more than 5 % at each end, and the range reaches
beyond the least and the greatest. The distance is that of an exponential tail in the
logarithm, whose scale is the kind's mean absolute deviation, into which that of all kinds
enters as `BORROWED_TIMES` times (a variance moderated by those of all groups, Smyth 2004,
doi:10.2202/1544-6115.1027); so a kind that was seen once has a range, too. The extremes
of one or two times need not be in the tails: the root of 1 + 1/n^2 corrects for that,
within 2 % of the value for a Laplace distribution.

All kinds have drift in common: the logarithms of the later half of a kind's times over
the median of the earlier half (a split in time, Tashman 2000,
doi:10.1016/S0169-2070(00)00065-0), over the root of 1 + 1/n, as for a mean of n. It goes
on until the next scan. Ranges reach so much further, as far as the kinds agree on it
(James and Stein 1961); in a total it is common to all lines.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean, median, mode, variance
from typing import ClassVar, Final

import numpy as np

from flexdt.twin.errors import MachineFileError
from flexdt.twin.findings import Finding, Findings, Place, warning
from flexdt.twin.machine.description import MAX_TIME_S, Axis, Machine, Spread, Timing
from flexdt.twin.script import commands as c
from flexdt.twin.script.executed_log import Executed, MotorReply
from flexdt.twin.script.grammar import describe, own_name
from flexdt.twin.script.planning.plan_values import StartState
from flexdt.twin.script.planning.planner import simulated
from flexdt.twin.script.planning.simulated_script import Simulation
from flexdt.twin.script.planning.time_ranges import Range, step_range, total_range
from flexdt.twin.script.problems import ScriptCode

BORROWED_TIMES: Final = 4.0
"""Weight of the deviations of all kinds, in number of a kind's own times."""
_TAIL_PROBABILITY: Final = 0.05
"""Probability of a time below the range, and of one above it."""
_LOG_OFFSET_S: Final = 0.003
"""Added to a time before its logarithm: a few times the resolution, since times may be 0."""
RESOLUTION_S: Final = 0.001
"""Resolution of own times in column 8 [s]."""
_MAX_READY_WAIT_S: Final = 0.05
"""Longest wait for X-rays that were ready already [s]; it contains no warm-up time."""
_TIME_DECIMALS: Final = 4
"""Number of decimals of times in the machine file."""

Log = Sequence[Executed]
Times = Sequence[float]


@dataclass(frozen=True)
class Fit:
    """A machine as its logs show it.

    Attributes:
        machine: with measured limits, rates and times.
        samples: kind of command -> measured times beyond motion, pause and exposures [s].
        axes: axis -> replies of its motor.
        frame_period_s: own time of each sequence over its frames; overhead included.
        lines: those of all logs beside their predictions.
    """

    machine: Machine
    samples: Mapping[str, tuple[float, ...]]
    axes: Mapping[str, tuple[MotorReply, ...]]
    frame_period_s: tuple[float, ...]
    lines: LogComparison

    @property
    def cross_validated_s(self) -> float:
        """Sum of absolute errors [s] with each line of a fitted kind predicted by the
        median of the kind's other lines.

        A line that is the only one of its kind is predicted by itself; lines of other
        kinds count with their fitted error.
        """
        total = self.lines.sum_abs_error_s
        for kind, times in self.samples.items():
            middle = self.machine.timing.seconds(kind)
            for x, others in zip(times, _left_out(times), strict=True):
                total += abs(x - others) - abs(x - middle)
        return total

    def to_dict(self) -> dict[str, object]:
        """Return the part `fit` of the JSON document of `flexdt commission`.

        Axes have limits, maxima, source, last position and number of replies; `single`
        lists kinds with one sample.

        Its keys are axes, timing, drift, frame_period_s, lines, sum_abs_error_s,
        cross_validated_s, single and total_s.
        """
        timing = self.machine.timing
        return {
            "axes": {
                name: {
                    **self.machine.axes[name].model_dump(
                        include={
                            "lower",
                            "upper",
                            "max_speed",
                            "max_acceleration",
                            "source",
                        }
                    ),
                    "position": replies[-1].position,
                    "n": len(replies),
                }
                for name, replies in self.axes.items()
            },
            "timing": {
                kind: {"median_s": timing.seconds(kind), **spread.model_dump()}
                for kind, spread in timing.spread.items()
            },
            "drift": timing.drift,
            "frame_period_s": list(self.frame_period_s),
            "lines": len(self.lines.rows),
            "sum_abs_error_s": self.lines.sum_abs_error_s,
            "cross_validated_s": self.cross_validated_s,
            "single": [kind for kind, times in self.samples.items() if len(times) == 1],
            "total_s": self.lines.total_real_s,
        }


@dataclass(frozen=True)
class LogRow:
    """A line of a log beside its prediction [s]."""

    line: int
    what: str
    real_s: float
    predicted_s: float
    p5_s: float | None
    p95_s: float | None
    kind: str = "command"

    @property
    def error_s(self) -> float:
        """Real minus predicted time [s]."""
        return self.real_s - self.predicted_s

    @property
    def inside(self) -> bool | None:
        """Whether the real time is in the 90 % range, widened by half the log's
        resolution; None without a range.
        """
        if self.p5_s is None or self.p95_s is None:
            return None
        half = 0.5 * RESOLUTION_S + 1e-9
        return self.p5_s - half <= self.real_s <= self.p95_s + half

    def to_dict(self) -> dict[str, object]:
        """Return the JSON form: all fields, error_s and inside."""
        return {**vars(self), "error_s": self.error_s, "inside": self.inside}


@dataclass(frozen=True)
class LogComparison:
    """An executed script beside its prediction.

    Attributes:
        machine: that predicts.
        rows: in the log's order.
        problems: warnings that the log is of another machine.
    """

    machine: Machine
    rows: tuple[LogRow, ...]
    problems: Findings = field(default_factory=Findings)

    HEADER: ClassVar = ("line", "real [s]", "predicted [s]", "90 %", "error [s]", "what")

    @classmethod
    def of(cls, log: Log, machine: Machine) -> LogComparison:
        """Predict each line of `log` on `machine`; warn of lacking axes (`unlike`)."""
        return cls(machine, tuple(against_log(log, machine)), unlike(log, machine))

    @property
    def total_real_s(self) -> float:
        """Sum of the lines' own times [s]."""
        return sum(row.real_s for row in self.rows)

    @property
    def total_predicted_s(self) -> float:
        """Sum of the lines' predicted times [s]."""
        return sum(row.predicted_s for row in self.rows)

    @property
    def sum_abs_error_s(self) -> float:
        """Sum of absolute errors of all lines [s]."""
        return sum(abs(row.error_s) for row in self.rows)

    @property
    def total_range(self) -> Range | None:
        """90 % range of the sum of own times [s], with axes starting at home."""
        return total_range(self.rows, self.total_predicted_s, self.machine.timing)

    @property
    def by_error(self) -> list[LogRow]:
        """The lines, greatest absolute error first."""
        return sorted(self.rows, key=lambda row: -abs(row.error_s))

    def table(self) -> list[tuple[str, ...]]:
        """Format the lines as rows of text, with the columns of `HEADER`, greatest
        absolute error first.

        Line, real, predicted, range (empty if unknown), error ("!" outside the range),
        command.
        """
        return [
            (
                str(r.line),
                f"{r.real_s:.3f}",
                f"{r.predicted_s:.3f}",
                "" if r.p5_s is None else f"{r.p5_s:.2f} to {r.p95_s:.2f}",
                f"{r.error_s:+.3f}" + (" !" if r.inside is False else ""),
                r.what,
            )
            for r in self.by_error
        ]

    def to_dict(self) -> dict[str, object]:
        """Return the JSON document of `flexdt check --against`, the line with the
        greatest error first.

        Keys are machine, timing_source, problems, lines, total_real_s, total_predicted_s,
        total_range_s and sum_abs_error_s.
        """
        return {
            "machine": self.machine.name,
            "timing_source": self.machine.timing.source,
            "problems": [p.to_dict() for p in self.problems],
            "lines": [row.to_dict() for row in self.by_error],
            "total_real_s": self.total_real_s,
            "total_predicted_s": self.total_predicted_s,
            "total_range_s": self.total_range,
            "sum_abs_error_s": self.sum_abs_error_s,
        }


def first_difference(script: Sequence[c.Command], log: Log) -> str | None:
    """Describe the first command in which a script and a log differ, as one line of text;
    None if they agree.

    Lines, columns, time-outs and expected durations do not count; a command that only one
    of them has does.

    Args:
        script: its commands.
        log: lines of the executed script.
    """
    for i in range(max(len(script), len(log))):
        if i >= len(script) or i >= len(log):
            longer = "script" if i >= len(log) else "log"
            return f"only the {longer} has command {i + 1}"
        own, done = (
            replace(k, line=0, column=1, timeout_ms=None, expected_ms=None)
            for k in (script[i], log[i].command)
        )
        if own != done:
            return f"line {script[i].line}: {describe(own)!r} is {describe(done)!r} in the log"
    return None


def fit_machine(logs: Sequence[Log], base: Machine, source: str) -> Fit:
    """Fit a machine to executed scripts: limits and rates of axes, and times of commands.

    The base gives everything that the logs do not contain. Axes are fitted to their
    motors' replies (`_axis`), times of commands to the lines' own times (`_samples`,
    `_timing`), twice, since better times tell better when motion without a wait ends.

    Args:
        logs: lines of each log, from `read_log`, the oldest first.
        base: machine that the fit begins with.
        source: names the logs, for the machine file.

    Returns:
        The machine, the times and replies that it is fitted to, time per frame of each
        sequence, and all lines beside their predictions.

    Raises:
        MachineFileError: no line at all, or a motor that the base machine lacks.
    """
    if not any(logs):
        raise MachineFileError(
            "no line of the logs can be read, so there is nothing to fit", {}
        )
    replies = _replies(logs, base)
    commands = [x.command for log in logs for x in log]
    axes = dict(base.axes)
    for name, replies_of_axis in replies.items():
        of_axis = [k for k in commands if _axis_of(k, base) == name]
        axes[name] = _axis(base.axes[name], replies_of_axis, of_axis)
    start = base.timing.model_copy(update={"spread": {}, "sequence_overhead_s": None})
    machine = base.model_copy(update={"axes": axes, "timing": start})
    samples: dict[str, tuple[float, ...]] = {}
    for _ in range(
        2
    ):  # with better times, motion without a wait ends before the right line
        samples = _samples(logs, machine)
        timing = _timing(samples, machine.timing, source, len(logs))
        machine = machine.model_copy(update={"timing": timing})
    rows = tuple(row for log in logs for row in against_log(log, machine))
    periods = tuple(
        x.own_s / len(group)
        for log in logs
        for group in _plan(log, machine).imaging.groups()
        for x in (log[group.step],)
        if isinstance(x.command, c.TakeSequence)
    )
    checked = Machine.model_validate(machine.model_dump(by_alias=True))
    return Fit(checked, samples, replies, periods, LogComparison(checked, rows))


def against_log(log: Log, machine: Machine) -> list[LogRow]:
    """Simulate the commands of an executed script, from the machine's home.

    Rows, in the log's order, have real and predicted time [s]; the 5 % to 95 % range is
    None where none is measured.
    """
    rows = []
    for x, step in zip(log, _plan(log, machine).steps, strict=True):
        low, high = step_range(step, machine.timing) or (None, None)
        rows.append(
            LogRow(x.line, step.what, x.own_s, step.holds_s, low, high, step.kind)
        )
    return rows


def unlike(log: Log, machine: Machine) -> Findings:
    """Warn of each axis of a log that the machine lacks, or whose motor has other limits
    there.

    Args:
        log: an executed script.
        machine: that it is compared with.

    Returns:
        One warning, `other_machine`, for each such axis, at its first line.
    """
    warnings: dict[str, Finding] = {}
    for x in log:
        name = _axis_of(x.command, machine)
        reply = x.motor
        message = ""
        axis = machine.axes.get(name)
        if isinstance(x.command, c.MotorCommand) and not machine.has(name):
            message = (
                f"machine {machine.name} has no axis {name!r}; it has: "
                f"{', '.join(machine.axes)}"
            )
        elif axis and reply and (reply.lower, reply.upper) != (axis.lower, axis.upper):
            message = (
                f"{name} goes from {reply.lower:g} to {reply.upper:g} in the log, from "
                f"{axis.lower:g} "
                f"to {axis.upper:g} on machine {machine.name}"
            )
        if message:
            warnings.setdefault(
                name, warning(ScriptCode.OTHER_MACHINE, message, place=Place(x.line))
            )
    return Findings(warnings.values())


def _plan(log: Log, machine: Machine) -> Simulation:
    """Simulate the commands of a log on `machine`, from its home."""
    return simulated(tuple(x.command for x in log), machine, StartState.of(machine))


def _replies(logs: Sequence[Log], base: Machine) -> dict[str, tuple[MotorReply, ...]]:
    """Collect the motors' decoded replies of the logs by axis.

    Args:
        logs: executed scripts.
        base: machine whose names of axes are used.

    Returns:
        Axis -> its replies, in the order of the logs.

    Raises:
        MachineFileError: a motor that `base` lacks.
    """
    by_axis: dict[str, list[MotorReply]] = {}
    for log in logs:
        for x in log:
            if x.motor is None or not isinstance(x.command, c.MotorCommand):
                continue
            name = _axis_of(x.command, base)
            if name not in base.axes:
                raise MachineFileError(
                    f"line {x.line}: the log has a motor {name!r}; machine {base.name} has: "
                    f"{', '.join(base.axes)} (another machine is named with --base)",
                    {"asked": name, "allowed": list(base.axes), "line": x.line},
                )
            by_axis.setdefault(name, []).append(x.motor)
    return {name: tuple(replies) for name, replies in by_axis.items()}


def _axis_of(command: c.Command, machine: Machine) -> str:
    """Return the axis of a command, as `machine` writes it."""
    return own_name(getattr(command, "component", ""), machine.axes)


def _axis(axis: Axis, replies: Sequence[MotorReply], own: Collection[c.Command]) -> Axis:
    """Fit an axis to replies: its limits and maxima are the four that most replies give
    together.

    Speed and acceleration are those of the last such reply; where a command in `own` sets
    them, the base's, at most the maximum. Home stays if it is within the limits, else it
    is the last position.

    Args:
        axis: of the base machine.
        replies: of its motor, oldest first; at least one.
        own: the commands to this axis.

    Returns:
        A copy of `axis` with these values and their source.
    """
    common = mode((r.lower, r.upper, r.max_speed, r.max_acceleration) for r in replies)
    agree = [
        r
        for r in replies
        if (r.lower, r.upper, r.max_speed, r.max_acceleration) == common
    ]
    lower, upper, max_speed, max_acceleration = common
    last = agree[-1]
    of = ""
    if len(agree) != len(replies):
        of = f" of {len(replies)}"
    set_speed, set_acceleration = (
        any(isinstance(k, kind) for k in own) for kind in (c.SetSpeed, c.SetAcceleration)
    )
    return axis.model_copy(
        update={
            "lower": lower,
            "upper": upper,
            "home": axis.home if lower <= axis.home <= upper else last.position,
            "speed": min(axis.speed, max_speed) if set_speed else last.speed,
            "max_speed": max_speed,
            "acceleration": (
                min(axis.acceleration, max_acceleration)
                if set_acceleration
                else last.acceleration
            ),
            "max_acceleration": max_acceleration,
            "source": f"measured, log, n = {len(agree)}{of}",
        }
    )


def _samples(logs: Sequence[Log], machine: Machine) -> dict[str, tuple[float, ...]]:
    """Collect the time of commands beyond motion, pause and exposures [s], by kind.

    Left out: commands that do not wait (ACK), and a motor's first move, whose start is
    unknown. A wait for ready X-rays counts as the whole time since X-rays on; one of up
    to `_MAX_READY_WAIT_S` is left out.

    Args:
        logs: executed scripts.
        machine: with which motion is computed.

    Returns:
        Kind -> times [s], at least 0, in the order of the logs.
    """
    times_by_kind: dict[str, list[float]] = {}
    for log in logs:
        moved: set[str] = set()
        since = 0.0
        for x, step in zip(log, _plan(log, machine).steps, strict=True):
            command = x.command
            kind = step.kind
            first = isinstance(command, c.MoveAbsolute) and command.component not in moved
            if isinstance(command, c.MoveAbsolute):
                moved.add(command.component)
            since += x.own_s
            took = max(0.0, x.own_s - step.computed_s)
            if isinstance(command, c.WaitXrayReady):
                kind = "xray_ready"
                if x.own_s > _MAX_READY_WAIT_S:
                    took = since
                else:
                    took = math.nan
            elif isinstance(command, c.XrayOn):
                since = 0.0
            # An axis's place before its first move is unknown.
            if command.wait is c.Wait.ACK and not first and math.isfinite(took):
                times_by_kind.setdefault(kind, []).append(took)
    return {kind: tuple(times) for kind, times in times_by_kind.items()}


def _timing(
    samples: Mapping[str, Times], before: Timing, source: str, logs: int
) -> Timing:
    """Fit the times of commands: medians, 90 % ranges and the common drift.

    The drift is the mean relative change from earlier to later times over the kinds
    (changes are of logarithms), without its sign, shrunk by its uncertainty in the ranges
    and stretched by 1 + 1/`logs` to the next scan; 0 where no kind has two times.

    Args:
        samples: kind of command -> times [s], oldest first.
        before: times of the base machine.
        source: names the logs.
        logs: number of logs, from which the drift to the next scan follows.

    Returns:
        A copy of `before` with the fitted times.
    """
    shifts = [fmean(changes) for times in samples.values() if (changes := _later(times))]
    shift = fmean(shifts) if shifts else 0.0
    unsure = 0.0
    if len(shifts) > 1:
        unsure = variance(shifts) / len(shifts)
    sure = 0.0
    if shift:
        sure = max(0.0, 1.0 - unsure / shift / shift)
    # From the middle of the earlier half to that of the later it is half of the logs, from the
    # middle of all logs to that of the next scan half of them and half a scan.
    shift *= 1.0 + 1.0 / logs
    medians = {kind: median(times) for kind, times in samples.items()}
    # About their median, n times of a Laplace distribution are apart by n - 1/2 of its scale.
    off = {
        kind: sum(abs(_log(x) - _log(medians[kind])) for x in times) / (len(times) - 0.5)
        for kind, times in samples.items()
    }
    common = fmean(
        [off[kind] for kind, times in samples.items() if len(times) > 1] or [1.0]
    )
    spread = {
        kind: _spread(times, off[kind], common, sure * shift)
        for kind, times in samples.items()
    }
    update = {f"{kind}_s": round(x, _TIME_DECIMALS) for kind, x in medians.items()}
    others = {
        "source": source,
        "drift": round(math.expm1(abs(shift)), _TIME_DECIMALS),
        "spread": spread,
    }
    return before.model_copy(update={**update, **others})


def _log(time: float) -> float:
    """Return the logarithm of a time [s], which may be zero."""
    return math.log(time + _LOG_OFFSET_S)


def _later(times: Times) -> list[float]:
    """Return logarithms of the later half's times over the earlier half's median.

    They are divided by sqrt(1 + 1/h) of h earlier times.
    """
    half = (len(times) + 1) // 2
    middle = _log(median(times[:half]))
    scale = math.sqrt(1.0 + 1.0 / half)
    return [(_log(x) - middle) / scale for x in times[half:]]


def _spread(times: Times, own: float, common: float, shift: float) -> Spread:
    """Estimate the 5 % and 95 % quantiles of the next time of a kind.

    Own and common scale are averaged with weights n - 1 and `BORROWED_TIMES`. A drift
    widens one end only.

    Args:
        times: of the kind [s].
        own: scale of the kind's logarithms.
        common: scale of all kinds' logarithms.
        shift: drift of the logarithms until the next scan.

    Returns:
        The quantiles [s], rounded outwards, from 0 to `MAX_TIME_S`, and the number of
        times.
    """
    n = len(times)
    scale = (BORROWED_TIMES * common + (n - 1) * own) / (BORROWED_TIMES + n - 1)
    beyond = (
        scale
        * max(0.0, -math.log(_TAIL_PROBABILITY * (n + 1)))
        * math.sqrt(1.0 + 1.0 / n**2)
    )
    low, high = np.quantile(
        [_log(x) for x in times],
        (_TAIL_PROBABILITY, 1.0 - _TAIL_PROBABILITY),
        method="weibull",
    )
    low = low - beyond + min(0.0, shift)
    high = high + beyond + max(0.0, shift)
    place = 10.0**_TIME_DECIMALS
    return Spread(
        p5_s=math.floor(max(0.0, math.exp(low) - _LOG_OFFSET_S) * place) / place,
        p95_s=min(
            math.ceil((math.exp(high) - _LOG_OFFSET_S) * place) / place, MAX_TIME_S
        ),
        n=n,
    )


def _left_out(times: Times) -> list[float]:
    """Return for each time the median of the others; itself if it is the only one."""
    if len(times) == 1:
        return list(times)
    return [median([*times[:i], *times[i + 1 :]]) for i in range(len(times))]
