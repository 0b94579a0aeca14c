"""The scanner while a plan is being made: motors, tube and camera on the plan's clock.

It is used only inside the planner and models how devices behave in time; the planner's
results are frozen values of `plan`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine
from flexdt.twin.machine.kinematics import motor_targets
from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.script.planning.plan_values import BeamOn, StartState


@dataclass(frozen=True)
class Span:
    """When a command takes effect and is complete; `release` is when a POS lets the
    script go on.

    `assumed` is the part of it that comes from the machine's timing, `kind` which of its
    times.
    """

    start: float
    end: float
    assumed: float = 0.0
    kind: str = "command"
    release: float | None = None
    note: str = ""


@dataclass(frozen=True)
class Trigger:
    """The last move that waited for a position; `run_up` is the length before it."""

    axis: str
    motor: str
    unit: str
    trajectory: Trajectory
    position: float
    time: float
    run_up: float

    @property
    def speed(self) -> float:
        """Greatest speed of the motion [unit/s]."""
        return max(abs(p.velocity) for p in self.trajectory.pieces)

    @property
    def acceleration(self) -> float:
        """Greatest acceleration of the motion [unit/s2]."""
        return max(abs(p.acceleration) for p in self.trajectory.pieces)


class Motor:
    """One motor: settings for moves to come and all motion so far."""

    def __init__(self, position: float, speed: float, acceleration: float) -> None:
        """Make a motor at rest at `position` that has never moved [mm, deg; per s; per s²]."""
        self.home = position
        self.speed = speed
        self.acceleration = acceleration
        self.moves: list[tuple[float, Trajectory]] = []

    @property
    def end(self) -> float:
        """Moment at which the last move ends [s]; 0 without one."""
        if self.moves:
            return self.moves[-1][1].end
        return 0.0

    def position(self, time: float) -> float:
        """Return the position at `time`, which is not before the last move."""
        if self.moves:
            return self.moves[-1][1].position(time)
        return self.home

    def move(
        self, target: float, time: float, speed: float, acceleration: float
    ) -> Trajectory:
        """Start a move to `target` at `time`, from the position and velocity then.

        It replaces one under way; it is recorded unless it takes no time. Units are mm or
        deg, and s.
        """
        v = 0.0
        if self.moves:
            v = self.moves[-1][1].velocity(time)
        trajectory = motion.move(
            self.position(time), v, target, speed, acceleration, time
        )
        if trajectory.end > time:
            self.moves.append((time, trajectory))
        return trajectory


class Motors:
    """All motors of a machine, virtual axes resolved."""

    def __init__(self, machine: Machine, start: StartState) -> None:
        """Make a motor for each axis of the machine, with the position and rates of `start`."""
        self.machine = machine
        self.all = {
            n: Motor(start.positions[n], start.speeds[n], start.accelerations[n])
            for n in machine.axes
        }

    def positions(self, time: float) -> dict[str, float]:
        """Return motor -> position at `time`, not before any motor's last move."""
        return {n: m.position(time) for n, m in self.all.items()}

    def targets(self, axis: str, value: float, time: float) -> dict[str, float]:
        """Compute motor -> target for a move of a motor or virtual axis, limits ignored."""
        here = {m: self.all[m].position(time) for m in self.machine.moves(axis)}
        return motor_targets(self.machine, axis, value, here)

    def rates(self, axis: str) -> dict[str, tuple[float, float]]:
        """Compute motor -> (speed, acceleration) for a move of `axis`.

        Motors of a virtual axis keep in step: the slowest determines all.
        """
        moves = self.machine.moves(axis)
        speed = min(self.all[n].speed / abs(f) for n, f in moves.items())
        acceleration = min(self.all[n].acceleration / abs(f) for n, f in moves.items())
        return {n: (speed * abs(f), acceleration * abs(f)) for n, f in moves.items()}

    def moving(self, time: float) -> list[str]:
        """List the motors still under way at `time`."""
        return [n for n, m in self.all.items() if m.end > time]

    def go_on(self, paths: Mapping[str, Trajectory]) -> None:
        """Put motors on paths that they are on already, before the plan's first command."""
        for name, path in paths.items():
            self.all[name].moves.append((path.start, path))

    def begun(self, time: float) -> dict[str, Trajectory]:
        """Return motor -> path of those whose last move began at `time`."""
        last = {n: m.moves[-1] for n, m in self.all.items() if m.moves}
        return {n: path for n, (began, path) in last.items() if began == time}

    @property
    def end(self) -> float:
        """Moment at which all motion is over [s]."""
        return max(m.end for m in self.all.values())


@dataclass
class PlannedTube:
    """The X-ray tube: its setting, and the intervals with X-rays on."""

    kV: float
    power_W: float
    on: bool
    known: bool = True
    """Whether X-rays are known to be on or off; an unknown start counts as off."""
    ready_at: float = 0.0
    since: float = 0.0

    def __post_init__(self) -> None:
        """Begin without settings made by the script and without recorded beam; it is lit
        from 0 s.
        """
        self.said: set[str] = set()
        self.beam: list[BeamOn] = []
        self.lit_from = 0.0

    def _close(self, time: float) -> None:
        """End the interval of one setting at `time` [s]; recorded if X-rays were on and it
        has a length.
        """
        if self.on and time > self.since:
            self.beam.append(BeamOn(self.since, time, self.kV, self.power_W))
        self.since = time

    def switch(self, on: bool, time: float) -> None:
        """Turn X-rays on or off at `time` [s]; the beam until then is recorded."""
        self._close(time)
        self.on = on
        self.known = True
        self.lit_from = time

    def lit(self, time: float) -> bool:
        """Return whether X-rays are on at `time`, not before the last switching."""
        return self.on and time >= self.lit_from

    def set(self, time: float, name: str, value: float) -> None:
        """Set `kV` or `power_W` at `time` [s], as a setting of the script."""
        self._close(time)
        setattr(self, name, value)
        self.said.add(name)

    def intervals(self, end: float) -> tuple[BeamOn, ...]:
        """List the intervals with X-rays on, one for each setting, up to `end` [s]."""
        self._close(end)
        return tuple(self.beam)


class PlannedCamera:
    """The camera's settings, which of them the script stated, and when it is free again."""

    def __init__(self, settings: CameraSettings) -> None:
        """Take the settings at the start; the script has made none yet, and the camera is free."""
        self.settings = settings
        self.said: set[str] = set()
        self.free_at = 0.0

    def set(self, name: str, value: Any) -> None:
        """Set a field of CameraSettings as stated by the script."""
        self.settings = replace(self.settings, **{name: value})
        self.said.add(name)

    def assume(self, name: str, value: Any) -> None:
        """Set a field that the script does not state."""
        self.settings = replace(self.settings, **{name: value})
