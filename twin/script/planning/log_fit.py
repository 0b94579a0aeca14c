"""A machine fitted to executed scripts: limits and rates from motors' replies, times of commands.

The time of a command beyond its motion, pause or exposures is the median over its kind. Its 90 %
range assumes no distribution: it comes from the kind's own times and, with the weight of
`BORROWED_TIMES` times, from how the times of all kinds scatter about each other, scaled by the
square root of the time (a sum of independent delays).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median, mode
from typing import ClassVar, Final

from flexdt.twin.errors import MachineFileError
from flexdt.twin.machine.description import Axis, Machine, Spread, Timing
from flexdt.twin.script import commands as c
from flexdt.twin.script.executed_log import Executed, MotorReply
from flexdt.twin.script.planning.describe import describe
from flexdt.twin.script.planning.plan import StartState
from flexdt.twin.script.planning.planner import simulated
from flexdt.twin.script.planning.simulate import Simulation
from flexdt.twin.script.planning.time_range import step_range

BORROWED_TIMES: Final = 4.0
"""How many times of its own the scatter of the other kinds counts for."""
_TAIL: Final = 0.05
RESOLUTION_S: Final = 0.001
"""Of column 8: a time of n ms is known to half of it."""
_AT_ONCE_S: Final = 0.05
"""A wait for the X-rays as short as this found them ready and does not say how long that takes."""
_DECIMALS: Final = 4

Log = Sequence[Executed]
Points = list[tuple[float, float]]


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
    lines: Comparison

    @property
    def cross_validated_s(self) -> float:
        """The same with each time predicted from the other times of its kind, if there are any."""
        total = self.lines.sum_abs_error_s
        for kind, times in self.samples.items():
            middle = self.machine.timing.seconds(kind)
            for x, others in zip(times, _left_out(times), strict=True):
                total += abs(x - others) - abs(x - middle)
        return total

    def to_dict(self) -> dict[str, object]:
        """The JSON document of `flexdt machine fit`."""
        timing = self.machine.timing
        return {
            "axes": {
                name: {
                    **self.machine.axes[name].model_dump(
                        include={"lower", "upper", "max_speed", "max_acceleration", "source"}
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
            "frame_period_s": list(self.frame_period_s),
            "lines": len(self.lines.rows),
            "sum_abs_error_s": self.lines.sum_abs_error_s,
            "cross_validated_s": self.cross_validated_s,
            "single": [kind for kind, times in self.samples.items() if len(times) == 1],
            "total_s": self.lines.total_real_s,
        }


@dataclass(frozen=True)
class Row:
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
        """Real less predicted."""
        return self.real_s - self.predicted_s

    @property
    def inside(self) -> bool | None:
        """Whether the real time lies in the range, to the resolution of the log."""
        if self.p5_s is None or self.p95_s is None:
            return None
        half = 0.5 * RESOLUTION_S + 1e-9
        return self.p5_s - half <= self.real_s <= self.p95_s + half

    def to_dict(self) -> dict[str, object]:
        """JSON form."""
        return {**vars(self), "error_s": self.error_s, "inside": self.inside}


@dataclass(frozen=True)
class Comparison:
    """An executed script beside its prediction; `rows` in the log's order."""

    machine: Machine
    rows: tuple[Row, ...]

    HEADER: ClassVar = ("line", "real [s]", "predicted [s]", "90 %", "error [s]", "what")

    @classmethod
    def of(cls, log: Log, machine: Machine) -> Comparison:
        """Predict each line of `log` on `machine`."""
        return cls(machine, tuple(against_log(log, machine)))

    @property
    def total_real_s(self) -> float:
        """Sum of the lines' own times."""
        return sum(row.real_s for row in self.rows)

    @property
    def total_predicted_s(self) -> float:
        """Sum of their predictions."""
        return sum(row.predicted_s for row in self.rows)

    @property
    def sum_abs_error_s(self) -> float:
        """Sum of absolute errors of all lines [s]."""
        return sum(abs(row.error_s) for row in self.rows)

    @property
    def by_error(self) -> list[Row]:
        """The lines, greatest absolute error first."""
        return sorted(self.rows, key=lambda row: -abs(row.error_s))

    def table(self) -> list[tuple[str, ...]]:
        """The same as text, for `HEADER`."""
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
        """The JSON document of `flexdt check --against`."""
        return {
            "machine": self.machine.name,
            "timing_source": self.machine.timing.source,
            "lines": [row.to_dict() for row in self.by_error],
            "total_real_s": self.total_real_s,
            "total_predicted_s": self.total_predicted_s,
            "sum_abs_error_s": self.sum_abs_error_s,
        }


def first_difference(script: Sequence[c.Command], log: Log) -> str | None:
    """Where a script and a log part, in words; None where the log is one of the script."""
    for i in range(max(len(script), len(log))):
        if i >= len(script) or i >= len(log):
            longer = "script" if i >= len(log) else "log"
            return f"only the {longer} has command {i + 1}"
        own, done = (replace(k, line=0, column=1, timeout_ms=None, expected_ms=None)
                     for k in (script[i], log[i].command))  # fmt: skip
        if own != done:
            return f"line {script[i].line}: {describe(own)!r} is {describe(done)!r} in the log"
    return None


def fit_machine(logs: Sequence[Log], base: Machine, source: str) -> Fit:
    """Fit a machine to executed scripts.

    Args:
        logs: lines of each log, from `read_log`.
        base: what the logs do not say.
        source: names the logs, for the machine file.

    Raises:
        MachineFileError: no line at all, or an axis's replies do not fit the base machine.

    Returns:
        The machine, and how it agrees with the logs.
    """
    if not any(logs):
        raise MachineFileError("no line of the logs can be read, so there is nothing to fit", {})
    replies = _replies(logs, base)
    commands = [x.command for log in logs for x in log]
    axes = dict(base.axes)
    for name, found in replies.items():
        own = [k for k in commands if isinstance(k, c.MotorCommand) and k.component == name]
        axes[name] = _axis(base.axes[name], found, own)
    start = base.timing.model_copy(update={"spread": {}, "sequence_overhead_s": None})
    machine = base.model_copy(update={"axes": axes, "timing": start})
    samples: dict[str, tuple[float, ...]] = {}
    for _ in range(2):  # with better times, motion without a wait ends before the right line
        samples = _samples(logs, machine)
        timing = _timing(samples, machine.timing, source)
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
    return Fit(checked, samples, replies, periods, Comparison(checked, rows))


def against_log(log: Log, machine: Machine) -> list[Row]:
    """Each line of an executed script beside its prediction, in the log's order."""
    rows = []
    for x, step in zip(log, _plan(log, machine).steps, strict=True):
        low, high = step_range(step, machine.timing) or (None, None)
        rows.append(Row(x.line, step.what, x.own_s, step.holds_s, low, high, step.kind))
    return rows


def _plan(log: Log, machine: Machine) -> Simulation:
    return simulated(tuple(x.command for x in log), machine, StartState.of(machine))


def _replies(logs: Sequence[Log], base: Machine) -> dict[str, tuple[MotorReply, ...]]:
    found: dict[str, list[MotorReply]] = {}
    for log in logs:
        for x in log:
            if x.motor is None or not isinstance(x.command, c.MotorCommand):
                continue
            name = x.command.component
            if name not in base.axes:
                raise MachineFileError(
                    f"line {x.line}: the log has a motor {name!r}; machine {base.name} has: "
                    f"{', '.join(base.axes)} (another machine is named with --base)",
                    {"asked": name, "allowed": list(base.axes), "line": x.line},
                )
            found.setdefault(name, []).append(x.motor)
    return {name: tuple(replies) for name, replies in found.items()}


def _axis(axis: Axis, replies: Sequence[MotorReply], own: Collection[c.Command]) -> Axis:
    """The axis with the limits and maxima that most replies give.

    Speed and acceleration are those in force, unless a command in `own` has set them.
    """
    most = mode((r.lower, r.upper, r.max_speed, r.max_acceleration) for r in replies)
    agree = [r for r in replies if (r.lower, r.upper, r.max_speed, r.max_acceleration) == most]
    lower, upper, max_speed, max_acceleration = most
    last, of = agree[-1], "" if len(agree) == len(replies) else f" of {len(replies)}"
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
                min(axis.acceleration, max_acceleration) if set_acceleration else last.acceleration
            ),
            "max_acceleration": max_acceleration,
            "source": f"measured, log, n = {len(agree)}{of}",
        }
    )


def _samples(logs: Sequence[Log], machine: Machine) -> dict[str, tuple[float, ...]]:
    found: dict[str, list[float]] = {}
    for log in logs:
        moved: set[str] = set()
        since = 0.0
        for x, step in zip(log, _plan(log, machine).steps, strict=True):
            command, kind = x.command, step.kind
            first = isinstance(command, c.MoveAbsolute) and command.component not in moved
            if isinstance(command, c.MoveAbsolute):
                moved.add(command.component)
            since += x.own_s
            took = max(0.0, x.own_s - step.computed_s)
            if isinstance(command, c.WaitXrayReady):
                kind, took = "xray_ready", since if x.own_s > _AT_ONCE_S else math.nan
            elif isinstance(command, c.XrayOn):
                since = 0.0
            # Where an axis stood before its first move nobody knows.
            if command.wait is c.Wait.ACK and not first and math.isfinite(took):
                found.setdefault(kind, []).append(took)
    return {kind: tuple(times) for kind, times in found.items()}


def _timing(samples: Mapping[str, tuple[float, ...]], before: Timing, source: str) -> Timing:
    pooled: Points = []
    for times in samples.values():
        if len(times) > 1:
            for x, other in zip(times, _left_out(times), strict=True):
                scatter = (x - other) / math.sqrt(max(other, RESOLUTION_S))
                pooled.append((scatter, 1.0 / len(times)))
    medians = {kind: median(times) for kind, times in samples.items()}
    spread = {
        kind: _spread(times, medians[kind], pooled or [(-1.0, 0.5), (1.0, 0.5)])
        for kind, times in samples.items()
    }
    update = {f"{kind}_s": round(x, _DECIMALS) for kind, x in medians.items()}
    return before.model_copy(update={**update, "source": source, "spread": spread})


def _spread(times: Sequence[float], middle: float, pooled: Points) -> Spread:
    """5 % and 95 % of a kind: its own times, and the scatter of all kinds about its median."""
    share = BORROWED_TIMES / sum(weight for _, weight in pooled)
    root = math.sqrt(max(middle, RESOLUTION_S))
    points = [(x, 1.0) for x in times] + [(middle + z * root, w * share) for z, w in pooled]
    low, high = _quantile(points, _TAIL), _quantile(points, 1.0 - _TAIL)
    place = 10.0**_DECIMALS
    return Spread(
        p5_s=math.floor(max(0.0, min(low, middle)) * place) / place,
        p95_s=math.ceil(max(high, middle) * place) / place,
        n=len(times),
    )


def _quantile(points: Points, level: float) -> float:
    """Quantile of weighted points, between the middles of their weights."""
    ordered = sorted(points)
    total = sum(weight for _, weight in ordered)
    gone, before = 0.0, ordered[0]
    at = 0.0
    for x, weight in ordered:
        here = (gone + 0.5 * weight) / total
        if here >= level:
            if here == at:
                return x
            share = (level - at) / (here - at)
            return before[0] + share * (x - before[0]) if gone else x
        gone, before, at = gone + weight, (x, weight), here
    return ordered[-1][0]


def _left_out(times: Sequence[float]) -> list[float]:
    """For each time the median of the others; itself where it is the only one."""
    if len(times) == 1:
        return list(times)
    return [median([*times[:i], *times[i + 1 :]]) for i in range(len(times))]
