"""`ScannerTwin`, the one mutable object: where every motor is bound, tube, camera, sample, safety.

Nothing in it ticks: each method takes `now`, the time of the twin's clock in seconds, and any
reader may ask for positions, poses or the whole state at any `now`. Commands are checked whole
before anything moves. It refuses to know a hidden misalignment (only the server's projection path
does), to sleep, and to send anything anywhere.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy.typing as npt

from flexdt.twin import drives as plan
from flexdt.twin import motion
from flexdt.twin.camera import CameraSettings, Roi, binning_of, check_roi
from flexdt.twin.drives import Drive
from flexdt.twin.errors import CollisionError, GeometryError, LimitError, SafetyError
from flexdt.twin.geometry import ConeVec, check_cone_vec
from flexdt.twin.halting import Jog, Outlook, Sweep, joined_programme
from flexdt.twin.kinematics import poses, resolve_targets, virtual_reading
from flexdt.twin.machine import Machine, Profile
from flexdt.twin.motion import Trajectory
from flexdt.twin.parameters import NOMINAL, Parameters, require_plausible
from flexdt.twin.pose import Poses
from flexdt.twin.readout import readout
from flexdt.twin.safety import (
    Contact,
    Guard,
    after_contact,
    after_free_motion,
    collision_error,
    estopped,
    released,
    require_ready,
)
from flexdt.twin.state import (
    AxisState,
    Correction,
    Safety,
    Sample,
    ScannerState,
    TubeState,
    check_tube,
    switched,
)

JOG_STEP = 0.05
"""A jog that cannot get farther than this [mm, deg] is a blocked attempt."""


class ScannerTwin:
    """A scanner: commands change it, readers ask it, both say when.

    Args:
        machine: what it is.
        profile: zero offsets in force.
        now: time at which it stands at home [s].
        guard: finds the first contact along planned motion; None sweeps nothing.
    """

    def __init__(
        self, machine: Machine, profile: Profile, now: float = 0.0, guard: Guard | None = None
    ) -> None:
        self.machine = machine
        self.profile = profile
        self.guard = guard
        self.tube = TubeState(machine.tube.kV, machine.tube.power_W, since=now)
        self.camera = machine.detector.camera
        self.sample = Sample()
        self.correction: Correction | None = None
        self.safety = Safety(max_blocked_attempts=machine.max_blocked_attempts)
        self._drives: dict[str, Drive] = plan.home(machine, now)

    # Reading ------------------------------------------------------------------------------------

    def trajectories(self, now: float) -> dict[str, Trajectory]:
        """The trajectory in force of every motor."""
        return {name: d.at(now) for name, d in self._drives.items()}

    def positions(self, now: float) -> dict[str, float]:
        """Position of every motor [mm, deg], script's sign."""
        return {name: d.at(now).position(now) for name, d in self._drives.items()}

    def velocities(self, now: float) -> dict[str, float]:
        """Velocity of every motor [mm/s, deg/s]."""
        return {name: d.at(now).velocity(now) for name, d in self._drives.items()}

    def targets(self, now: float) -> dict[str, float]:
        """Where every motor will come to rest."""
        return {name: d.at(now).target for name, d in self._drives.items()}

    def final_positions(self) -> dict[str, float]:
        """Where every motor stands when all that is under way has ended."""
        return {name: d.trajectories[-1].target for name, d in self._drives.items()}

    def moving(self, now: float) -> bool:
        """Whether any motor is under way."""
        return any(d.at(now).moving(now) for d in self._drives.values())

    def rest_time(self, now: float) -> float:
        """When the last motor comes to rest, at least `now` [s]."""
        return max(now, *(d.trajectories[-1].end for d in self._drives.values()))

    def settings(self, axis: str) -> tuple[float, float]:
        """Speed and acceleration that the next motion of motor `axis` will have."""
        self.machine.axis(axis)
        return self._drives[axis].speed, self._drives[axis].acceleration

    @property
    def parameters(self) -> Parameters:
        """The correction in force, as offsets; all nominal when there is none."""
        return NOMINAL if self.correction is None else self.correction.parameters

    @property
    def pixel_mm(self) -> float:
        """Binned pixel pitch [mm]."""
        return self.camera.pixel_mm(self.machine.detector.sensor)

    def poses(self, now: float) -> Poses:
        """Nominal poses, n = 1."""
        return self.poses_at(self.positions(now), self.camera)

    def poses_at(self, positions: Mapping[str, npt.ArrayLike], camera: CameraSettings) -> Poses:
        """Nominal poses for positions [mm, deg], scalars or (n,), and any camera settings."""
        return poses(self.machine, self.profile, camera, positions)

    def corrected(
        self, nominal: Poses, camera: CameraSettings, correction: Correction | None
    ) -> ConeVec:
        """Geometry of poses with `correction`, checked (thesis 4.8.3).

        Raises:
            GeometryError: a geometry no scanner can have.
        """
        parameters = NOMINAL if correction is None else correction.parameters
        pixel = camera.pixel_mm(self.machine.detector.sensor)
        return check_cone_vec(nominal.cone_vec(parameters), pixel)

    def cone_vec(self, now: float) -> ConeVec:
        """Nominal geometry plus the correction in force, checked (thesis 4.8.3), n = 1.

        Raises:
            GeometryError: a geometry no scanner can have.
        """
        return self.corrected(self.poses(now), self.camera, self.correction)

    def state(self, now: float) -> ScannerState:
        """Everything public, as one frozen value."""
        axes = {name: self._axis_state(name, now) for name in self.machine.axes}
        for name, virtual in self.machine.virtual_axes.items():
            axes[name] = self._virtual_state(name, axes[virtual.of], now)
        return ScannerState(
            time=now,
            axes=axes,
            tube=self.tube,
            camera=self.camera,
            sample=self.sample,
            readout=readout(
                self.poses(now), self.camera, self.machine.detector.sensor, self.parameters
            ),
            safety=self.safety,
            correction=self.correction,
            moving=self.moving(now),
        )

    # Motion -------------------------------------------------------------------------------------

    def move(
        self,
        targets: Mapping[str, float],
        now: float,
        *,
        relative: bool = False,
        shortest: bool = False,
    ) -> dict[str, float]:
        """Send axes to targets; all start together, nothing moves if any target is bad.

        Args:
            targets: motor or virtual axis -> position [mm, deg], script's sign.
            now: time of the command [s].
            relative: targets are displacements from where the motors are bound for.
            shortest: rotations go the shorter way round; otherwise angles are accumulated.

        Returns:
            Motor -> seconds until it rests.

        Raises:
            UnknownNameError, LimitError: nothing moves.
            SafetyError: E-stopped or blocked; nothing moves.
            CollisionError: the motion halts at its last free position.
        """
        require_ready(self.safety, "motion")
        new = plan.plan_move(
            self.machine, self._drives, targets, now, relative=relative, shortest=shortest
        )
        what = "move " + ", ".join(f"{name}={value:g}" for name, value in targets.items())
        return self._commit(new, now, what)

    def resolve(
        self,
        targets: Mapping[str, float],
        now: float,
        *,
        relative: bool = False,
        shortest: bool = False,
    ) -> dict[str, float]:
        """Motor targets that a move would have; raises as `move`, and nothing moves."""
        planned = plan.plan_move(
            self.machine, self._drives, targets, now, relative=relative, shortest=shortest
        )
        return {name: t.target for name, t in planned.items()}

    def jog(self, axis: str, velocity: float, lease_s: float, now: float) -> Jog:
        """Run `axis` at `velocity` until the lease ends or a limit nears.

        A jog that a contact cuts short runs as far as it is free, and says so; one that cannot
        move at all is a blocked attempt.

        Raises:
            UnknownNameError, LimitError, SafetyError, CollisionError: as `move`.
        """
        require_ready(self.safety, "motion")
        new = plan.plan_jog(self.machine, self._drives, axis, velocity, lease_s, now)
        sweep = self._sweep(now)
        contact = sweep.contact(new)
        free = new if contact is None else sweep.halted(new, contact)
        goes = any(abs(t.target - t.position(now)) >= JOG_STEP for t in free.values())
        if contact is not None and not goes:
            raise self._blocked(new, contact, now, f"jog {axis} at {velocity:g}")
        if contact is None and goes:
            self.safety = after_free_motion(self.safety)
        seconds = max(self._apply(free, now).values(), default=0.0)
        return Jog(seconds, contact, {name: t.target for name, t in free.items()})

    def stop(self, now: float) -> None:
        """Brake every motor; works in every state and ends a programme."""
        self._apply(plan.plan_stop(self._drives, now), now)

    def estop(self, now: float) -> None:
        """Brake as hard as the motors can, switch X-rays off, refuse motion until a reset."""
        hardest = {name: a.max_acceleration for name, a in self.machine.axes.items()}
        self._apply(plan.plan_stop(self._drives, now, hardest), now)
        self.tube = switched(self.machine, self.tube, False, now, warm=True)
        self.safety = estopped(self.safety)

    def reset(self) -> None:
        """Leave E-stop or blocked; nothing starts by itself."""
        self.safety = released(self.safety)

    def place(self, positions: Mapping[str, float], now: float) -> None:
        """Put motors where they are known to stand, at rest: a start, not a motion.

        Raises:
            UnknownNameError, LimitError: no such motor, or outside its travel; nothing is changed.
        """
        wanted = resolve_targets(self.machine, positions, self.positions(now))
        stand = {**self.targets(now), **wanted}
        self._drives = {
            name: replace(d, trajectories=(motion.at_rest(stand[name], now),))
            for name, d in self._drives.items()
        }

    def follow(self, programme: Mapping[str, Sequence[Trajectory]], now: float) -> None:
        """Take over a programme: per motor its trajectories, in the order of their starts.

        Raises:
            SafetyError: E-stopped or blocked; nothing moves.
            CollisionError: a contact anywhere along it; nothing moves, the attempt counts.
        """
        self.require_free(programme, now)
        for name, trajectories in joined_programme(self._drives, programme, now).items():
            self._drives[name] = replace(self._drives[name], trajectories=trajectories)

    def require_free(
        self,
        programme: Mapping[str, Sequence[Trajectory]],
        now: float,
        start: Mapping[str, float] | None = None,
    ) -> None:
        """Sweep the whole of a programme; a contact counts as a blocked attempt.

        Args:
            programme: as for `follow`.
            now: when it would be taken over [s].
            start: where motors would stand then, at rest; None is where they are [mm, deg].

        Raises:
            UnknownNameError: no such motor.
            SafetyError, CollisionError: as `follow`.
        """
        require_ready(self.safety, "a programme")
        for name in programme:
            self.machine.axis(name)
        ways = joined_programme(self._drives, programme, now, start)
        contact = self._sweep(now).contact({n: motion.joined(t) for n, t in ways.items()})
        if contact is not None:
            self.safety = after_contact(self.safety, contact)
            raise collision_error(contact, now, self.safety, "the programme", {})

    def look_again(self, now: float) -> Outlook:
        """After a change of the sample, its place or the correction: sweep what is under way.

        Whatever would come to a contact (moves, jogs, programmes) is halted at its last free
        position, and counts as a blocked attempt. What stands too close already stays.
        """
        sweep = self._sweep(now)
        touching, ahead = sweep.touching(), sweep.ahead()
        contact = sweep.contact(ahead) if ahead else None
        halted = None
        if contact is not None:
            halted = self._blocked(ahead, contact, now, "the motion under way")
        return Outlook(None if touching is None else touching.pair, halted)

    # Settings -----------------------------------------------------------------------------------

    def set_axis(
        self, axis: str, *, speed: float | None = None, acceleration: float | None = None
    ) -> None:
        """Speed and acceleration of the motors of `axis`, from their next motion on.

        Raises:
            UnknownNameError, LimitError.
        """
        self._drives = plan.with_settings(self.machine, self._drives, axis, speed, acceleration)

    def set_tube(
        self,
        *,
        kV: float | None = None,
        power_W: float | None = None,
        on: bool | None = None,
        now: float | None = None,
        warm: bool = False,
    ) -> None:
        """Change the tube's settings; those left out stay.

        Args:
            kV, power_W: settings.
            on: X-rays on or off.
            now: time of the switch [s]; None is long ago, so that X-rays are ready at once.
            warm: leave out the warm-up after a long rest (scripts are planned without one).

        Raises:
            LimitError: outside the tube's range.
            SafetyError: X-rays on while the E-stop is in force.
        """
        tube = replace(
            self.tube,
            kV=self.tube.kV if kV is None else kV,
            power_W=self.tube.power_W if power_W is None else power_W,
        )
        if on and self.safety.state == "estopped":
            raise SafetyError(
                f"X-rays on is refused: {self.safety.reason}; a reset is needed",
                {"asked": "xrays on", "state": self.safety.state, "allowed": "reset"},
            )
        tube = check_tube(self.machine, tube)
        if on is not None and now is not None:
            tube = switched(self.machine, tube, on, now, warm=warm)
        elif on is not None:
            tube = replace(tube, on=on, ready_at=-math.inf)
        self.tube = tube

    def set_camera(
        self,
        *,
        exposure_ms: float | None = None,
        mode: str | None = None,
        roi: Roi | None = None,
        averages: int | None = None,
        frames: int | None = None,
    ) -> None:
        """Change the camera's settings; those left out stay.

        Raises:
            LimitError: outside what the detector allows.
        """
        old = self.camera
        camera = CameraSettings(
            old.mode if mode is None else mode,
            old.roi if roi is None else roi,
            old.exposure_ms if exposure_ms is None else exposure_ms,
            old.averages if averages is None else averages,
            old.frames if frames is None else frames,
        )
        spec = self.machine.detector
        check_roi(camera.roi, spec.sensor, binning_of(camera.mode))
        for name, value, lower, upper in (
            ("exposure_ms", camera.exposure_ms, spec.min_exposure_ms, spec.max_exposure_ms),
            ("averages", camera.averages, 1, 10_000),
            ("frames", camera.frames, 1, 1_000_000),
        ):
            if not lower <= value <= upper:
                raise LimitError(
                    f"camera {name} {value:g} is outside [{lower:g}, {upper:g}]",
                    {"setting": name, "asked": value, "allowed": [lower, upper]},
                )
        self.camera = camera

    def set_sample(self, sample: Sample, guard: Guard | None) -> None:
        """Put `sample` on the stage; from now on `guard` sweeps what moves. See `look_again`."""
        self.sample, self.guard = sample, guard

    def apply(self, correction: Correction | None) -> None:
        """Put `correction` in force instead of the last (never added to it); None removes it.

        Raises:
            GeometryError: the corrected geometry is one no scanner can have.
        """
        parameters = NOMINAL if correction is None else correction.parameters
        travels = (a.upper - a.lower for a in self.machine.axes.values() if a.unit == "mm")
        require_plausible(parameters, max(travels, default=math.inf))
        nearest = poses(self.machine, self.profile, self.camera, _nearest(self.machine))
        cone = check_cone_vec(nearest.cone_vec(parameters), self.pixel_mm)
        if readout(nearest, self.camera, self.machine.detector.sensor, parameters) is None:
            raise GeometryError(
                "the correction puts the rotation axis behind the source somewhere in the travel",
                {"check": "sod", "source": cone.source[0].tolist(), "allowed": "SOD > 0"},
            )
        self.correction = correction

    # Inside -------------------------------------------------------------------------------------

    def _commit(self, new: Mapping[str, Trajectory], now: float, what: str) -> dict[str, float]:
        contact = self._sweep(now).contact(new)
        if contact is not None:
            raise self._blocked(new, contact, now, what)
        self.safety = after_free_motion(self.safety)
        return self._apply(new, now)

    def _apply(self, new: Mapping[str, Trajectory], now: float) -> dict[str, float]:
        for name, trajectory in new.items():
            self._drives[name] = self._drives[name].following(trajectory)
        return {name: max(0.0, t.end - now) for name, t in new.items()}

    def _sweep(self, now: float) -> Sweep:
        hardest = {name: a.max_acceleration for name, a in self.machine.axes.items()}
        return Sweep(self.guard, self._drives, now, hardest)

    def _blocked(
        self, new: Mapping[str, Trajectory], contact: Contact, now: float, what: str
    ) -> CollisionError:
        """Halt at the last free position (or stay, when that was once too often); what to raise."""
        self.safety = after_contact(self.safety, contact)
        if self.safety.state == "blocked":
            halted = plan.plan_stop({name: self._drives[name] for name in new}, now)
        else:
            halted = self._sweep(now).halted(new, contact)
        self._apply(halted, now)
        stops = {name: t.target for name, t in halted.items()}
        return collision_error(contact, now, self.safety, what, stops)

    def _axis_state(self, name: str, now: float) -> AxisState:
        axis, drive = self.machine.axes[name], self._drives[name]
        t = drive.at(now)
        return AxisState(
            position=t.position(now),
            target=t.target,
            velocity=t.velocity(now),
            moving=t.moving(now),
            lower=axis.lower,
            upper=axis.upper,
            speed=drive.speed,
            acceleration=drive.acceleration,
            unit=axis.unit,
        )

    def _virtual_state(self, name: str, other: AxisState, now: float) -> AxisState:
        """A virtual axis, read from the one motor it is defined by."""
        virtual = self.machine.virtual_axes[name]
        ends = sorted(virtual.constant + virtual.factor * x for x in (other.lower, other.upper))
        return AxisState(
            position=virtual_reading(self.machine, name, self.positions(now)),
            target=virtual_reading(self.machine, name, self.targets(now)),
            velocity=virtual.factor * other.velocity + 0.0,  # no negative zero
            moving=other.moving,
            lower=ends[0],
            upper=ends[1],
            speed=other.speed * abs(virtual.factor),
            acceleration=other.acceleration * abs(virtual.factor),
            unit=other.unit,
            motor=False,
        )


def _nearest(machine: Machine) -> dict[str, float]:
    """Motor positions at which sample and detector are as near to the source as they get."""
    along = {
        name: machine.geometry["object_y"].get(name, 0.0)
        + machine.geometry["detector_y"].get(name, 0.0)
        for name in machine.axes
    }
    return {
        name: a.lower if along[name] > 0 else a.upper if along[name] < 0 else a.home
        for name, a in machine.axes.items()
    }
