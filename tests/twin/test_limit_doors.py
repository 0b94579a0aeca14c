"""One limit rule through every door: scripts, trajectories, follow, requests, gateway, jog."""

from __future__ import annotations

import ast
import asyncio
import random
from collections.abc import Iterator, Mapping
from decimal import Decimal
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, get_args, get_origin

import pytest
from pydantic import BaseModel

from flexdt.clients.following.hearing import heard
from flexdt.clients.gateway.actions import ACTIONS
from flexdt.clients.gateway.connected_twin import CommandProgress
from flexdt.twin.errors import LimitError
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Mirror
from flexdt.twin.machine.description import (
    Axis,
    Machine,
    builtin_machine,
    builtin_machines,
    profile_of,
)
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.script import commands as c
from flexdt.twin.script.planning.planner import plan_script
from flexdt.twin.script.planning.pose_plan import plan_poses
from tests.support.scanner_traffic import event

TARGETS = 60
Outcome = tuple[str, float | None]
"""`arrives`, `told` (it arrives at a limit and says so) or `refused`; and where the motor
rests, None where it has not moved."""


def variants() -> Iterator[Machine]:
    """The shipped machines, with either kind of limit, and with a tolerance on every axis."""
    for name in builtin_machines():
        machine = builtin_machine(name)
        wide = {
            n: a.model_copy(update={"arrival_tolerance": 0.5})
            for n, a in machine.axes.items()
        }
        for on_limit in ("clamp", "reject"):
            yield machine.model_copy(update={"on_limit": on_limit})
            yield machine.model_copy(update={"on_limit": on_limit, "axes": wide})


def targets(machine: Machine, seed: int) -> Iterator[tuple[str, float]]:
    """Targets within the travel, at its ends, and beyond them by rounding, tolerance and
    more."""
    rng = random.Random(seed)
    for _ in range(TARGETS):
        name, axis = rng.choice(list(machine.axes.items()))
        tolerance = axis.arrival_tolerance
        by = rng.choice([-1.0, -1e-6, 0.0, 5e-10, 1e-7, 0.9 * tolerance, tolerance,
                         tolerance + 1e-3, 1.0 + tolerance, 1e4])  # fmt: skip
        yield name, rng.choice([axis.upper + by, axis.lower - by])


def request_rule(machine: Machine, name: str, target: float) -> Outcome:
    """What docs/scripts.md says of a request by itself, worked out here."""
    axis = machine.axes[name]
    by = max(axis.lower - target, target - axis.upper)
    limit = axis.lower if target < axis.lower else axis.upper
    if by <= 0.0:
        return "arrives", target
    if by <= 1e-9:
        return "arrives", limit
    return ("told", limit) if by <= axis.arrival_tolerance + 1e-9 else ("refused", None)


def script_rule(machine: Machine, name: str, target: float) -> Outcome:
    """What it says of a line of a script; a plan goes on at the limit behind an error, too."""
    kind, at = request_rule(machine, name, target)
    if kind != "refused":
        return kind, at
    axis = machine.axes[name]
    limit = axis.lower if target < axis.lower else axis.upper
    return ("told" if machine.on_limit == "clamp" else "refused"), limit


def of_problems(problems: Any, at: float) -> Outcome:
    codes = {(p.severity, p.code) for p in problems if p.code.startswith("limit")}
    assert codes in (set(), {("warning", "limit_clamped")}, {("error", "limit")})
    kind = "refused" if ("error", "limit") in codes else "told" if codes else "arrives"
    return kind, at


def by_script(machine: Machine, name: str, target: float) -> Outcome:
    script = c.Script.of([c.MoveAbsolute(component=name, target=target, line=1)])
    plan = plan_script(script, machine, profile_of(machine))
    return of_problems(plan.problems, float(plan.positions(1e9)[name]))


def by_trajectory(machine: Machine, name: str, target: float) -> Outcome:
    plan = plan_poses([{name: target}], machine, profile_of(machine), flat=False)
    return of_problems(plan.problems, float(plan.positions(1e9)[name]))


def by_following(machine: Machine, name: str, target: float) -> Outcome:
    follower = Follower(machine, profile_of(machine))
    said = heard(
        event(1, (name, "move absolute", repr(target))), machine.axes, "00:00:03.000"
    )
    mirror = follower.hear(Mirror.of(machine), said, 3.0)
    alarms = {a.severity for a in mirror.alarms if a.kind == "limit"}
    assert len(alarms) <= 1
    kind = {(): "arrives", ("warning",): "told", ("error",): "refused"}[tuple(alarms)]
    return kind, mirror.axes[name].target


def by_request(machine: Machine, name: str, target: float) -> Outcome:
    scanner = ScannerTwin(machine, profile_of(machine))
    told = scanner.limit_messages({name: target}, 0.0)
    try:
        scanner.move({name: target}, 0.0)
    except LimitError:
        assert not scanner.moving(0.0)
        return "refused", None
    return "told" if told else "arrives", scanner.final_positions()[name]


class _Twin:
    """The gateway's twin: a scanner, without a wire between them."""

    def __init__(self, machine: Machine) -> None:
        self.machine, self.now = machine, 0.0
        self.scanner = ScannerTwin(machine, profile_of(machine))

    async def state(self) -> object:
        safety = SimpleNamespace(state="ok", message="")
        return SimpleNamespace(axes=self.scanner.state(self.now).axes, safety=safety)

    async def ask(self, method: str, params: Mapping[str, Any]) -> None:
        if method == "axes.set":
            self.scanner.set_axis(**params)
            return
        assert method == "axes.move"
        self.scanner.move(params["targets"], self.now)
        self.now = self.scanner.rest_time(self.now)

    def motor_text(self, axis: str, at: Any) -> str:
        return repr(at.position)


def through_gateway(machine: Machine, command: c.Command) -> tuple[str, ScannerTwin]:
    """The reply to a line, and the scanner afterwards."""
    twin: Any = _Twin(machine)
    return asyncio.run(
        ACTIONS[type(command)](twin, command, CommandProgress())
    ), twin.scanner


def by_gateway(machine: Machine, name: str, target: float) -> Outcome:
    try:
        reply, _ = through_gateway(machine, c.MoveAbsolute(component=name, target=target))
    except LimitError:
        return "refused", None
    at = float(reply)
    return "told" if abs(at - target) > 1e-9 else "arrives", at


def by_jog(machine: Machine, name: str, target: float) -> Outcome:
    """Towards the target until the limit: a jog has no target, and ends at the latest there."""
    scanner = ScannerTwin(machine, profile_of(machine))
    axis = machine.axes[name]
    to = axis.max_speed if target > axis.home else -axis.max_speed
    jogged = scanner.jog(name, to, 1e9, 0.0)
    return "arrives", jogged.rests.get(name, axis.home)


SCRIPTS = {"script": by_script, "trajectory": by_trajectory, "follow": by_following}
MACHINES = [*variants()]


@pytest.mark.parametrize("number", range(len(MACHINES)))
@pytest.mark.daily(4)
def test_every_door_has_the_same_rule(number: int) -> None:
    machine = MACHINES[number]
    for name, target in targets(machine, number):
        asked = f"{machine.name} ({machine.on_limit}) {name} {target!r}"
        axis = machine.axes[name]
        expected = request_rule(machine, name, target)
        assert by_request(machine, name, target) == expected, asked
        line = script_rule(machine, name, target)
        for door, through in SCRIPTS.items():
            assert through(machine, name, target) == line, (door, asked)
        sent = (line[0], None) if line[0] == "refused" else line
        assert by_gateway(machine, name, target) == sent, asked
        end = axis.upper if target > axis.home else axis.lower
        kind, at = by_jog(machine, name, target)
        assert at is not None
        assert (kind, abs(at - end) <= 1e-9) == ("arrives", True), asked


@pytest.mark.parametrize("number", range(len(MACHINES)))
@pytest.mark.daily(8)
def test_rates_beyond_the_greatest_have_the_same_rule(number: int) -> None:
    machine, rng = MACHINES[number], random.Random(number)
    for _ in range(10):
        name, axis = rng.choice(list(machine.axes.items()))
        by = rng.choice([0.5, 1.0, 1.0 + 1e-12, 1.1])
        command = c.SetSpeed(component=name, speed=axis.max_speed * by, line=1)
        plan = plan_script(c.Script.of([command]), machine, profile_of(machine))
        codes = [p.code for p in plan.problems if p.code.startswith("limit")]
        if by <= 1.0 + 1e-9:
            assert codes == []
        else:
            assert codes == ["limit_clamped" if machine.on_limit == "clamp" else "limit"]
        try:
            _, scanner = through_gateway(machine, command)
        except LimitError:
            assert (codes, machine.on_limit) == (["limit"], "reject")
        else:
            assert codes != ["limit"]
            assert scanner.settings(name)[0] == min(command.speed, axis.max_speed)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_what_is_no_number_is_refused_by_every_request(value: float) -> None:
    machine = builtin_machine("flexray")
    scanner = ScannerTwin(machine, profile_of(machine))
    for axis in ("mag_det", "ver_obj"):
        for refused in (
            lambda axis=axis: scanner.move({axis: value}, 0.0),
            lambda axis=axis: scanner.move({axis: value}, 0.0, relative=True),
            lambda axis=axis: scanner.jog(axis, value, 1.0, 0.0),
            lambda axis=axis: scanner.set_axis(axis, speed=value),
            lambda axis=axis: scanner.set_axis(axis, acceleration=value),
        ):
            with pytest.raises(LimitError):
                refused()
    with pytest.raises(LimitError):
        scanner.place({"mag_det": value}, 0.0)


@pytest.mark.parametrize("seed", range(40))
def test_decimal_steps_arrive_at_the_limit(seed: int) -> None:
    """Walks of decimal steps that end at a limit by decimal sums, of motors and coupled
    axes."""
    rng = random.Random(seed)
    machine = builtin_machine(rng.choice(builtin_machines()))
    name, axis = rng.choice([*machine.axes.items()])
    step = Decimal(rng.choice(["0.1", "0.01", "0.3", "0.7", "1.1"]))
    count = rng.randint(2, 60)
    up = rng.random() < 0.5
    limit = Decimal(str(axis.upper if up else axis.lower))
    start = limit - step * count * (1 if up else -1)
    if not axis.lower <= float(start) <= axis.upper:
        pytest.skip("the travel is shorter than the walk")
    scanner = ScannerTwin(machine, profile_of(machine))
    scanner.place({name: float(start)}, 0.0)
    now = 0.0
    for _ in range(count):
        scanner.move({name: float(step if up else -step)}, now, relative=True)
        now = scanner.rest_time(now)
    assert scanner.positions(now)[name] == pytest.approx(float(limit), abs=1e-9)
    assert axis.lower <= scanner.positions(now)[name] <= axis.upper


def test_a_coupled_axis_beyond_its_tolerance_keeps_its_motors_in_step() -> None:
    machine = builtin_machine("flexray")
    wide = {
        n: a.model_copy(update={"arrival_tolerance": 1.0})
        for n, a in machine.axes.items()
    }
    machine = machine.model_copy(update={"axes": wide})
    scanner = ScannerTwin(machine, profile_of(machine))
    before = scanner.final_positions()
    room = before["ver_det"] - machine.axes["ver_det"].lower
    scanner.move({"ver_obj": room + 0.5}, 0.0, relative=True)
    after = scanner.final_positions()
    assert after["ver_det"] == machine.axes["ver_det"].lower
    moved = {n: after[n] - before[n] for n in machine.virtual_axes["ver_obj"].moves}
    shares = machine.virtual_axes["ver_obj"].moves
    ways = [moved[n] / shares[n] for n in moved]
    assert ways == pytest.approx([ways[0]] * len(ways), abs=1e-9)


SOURCES = Path(__file__).resolve().parents[2]
ROOMS = ("twin", "server", "clients", "phantoms", "runtime", "flexdt/library",
         "extensions/flexdt_extensions")  # fmt: skip


def models(model: type[BaseModel], seen: set[type[BaseModel]]) -> set[type[BaseModel]]:
    """A model, and those that its fields hold."""
    seen.add(model)
    for field in model.model_fields.values():
        pending: list[Any] = [field.annotation]
        while pending:
            kind = pending.pop()
            pending += get_args(kind)
            if (
                isinstance(kind, type)
                and issubclass(kind, BaseModel)
                and kind not in seen
            ):
                models(kind, seen)
    return seen


def unread(model: type[BaseModel], read: set[str], words: set[str]) -> set[str]:
    """Keys that no code reads. A key of one allowed value is read by its check, and the times
    of `Timing` by the kind of command, a word."""
    return {
        name
        for each in models(model, set())
        for name, field in each.model_fields.items()
        if not (name in read or name.removesuffix("_s") in words - {name})
        and (
            get_origin(field.annotation) is not Literal
            or len(get_args(field.annotation)) > 1
        )
    }


def test_every_key_of_a_machine_file_is_read_by_something() -> None:
    """A key that nothing reads promises what nothing does."""
    read, words = set[str](), set[str]()
    for room in ROOMS:
        for file in (SOURCES / room).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                    read.add(node.attr)
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    words.add(node.value)
    assert unread(Machine, read, words) == set()

    class Idle(Axis):  # the test finds one, in a model within a model
        idle_threshold: float = 0.0

    class WithIdle(Machine):
        more: dict[str, Idle] = {}  # noqa: RUF012

    assert unread(WithIdle, read, words) == {"idle_threshold"}
