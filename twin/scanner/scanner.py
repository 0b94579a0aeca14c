"""`ScannerTwin`, the one mutable object: where every motor is bound, tube,
camera, sample, safety.

Nothing in it ticks: each method takes `now`, the time of the twin's clock in seconds, and
positions, poses or the complete state can be read at any `now`. The motors always follow
one programme of all of them that was swept to its end and ends at rest; `_take` is the
only place where it is replaced, and takes nothing that was not certified (see `joining`).
A hidden misalignment is known to the server's projection path alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Unpack, assert_never

import numpy.typing as npt

from flexdt.twin.errors import CollisionError, GeometryError, SafetyError
from flexdt.twin.geometry.cone_vec import ConeVec, check_cone_vec
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import (
    motor_poses,
    motor_targets,
    resolve_targets,
    virtual_reading,
)
from flexdt.twin.machine.travel import arrival
from flexdt.twin.motion import drives as plan
from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.braking import coasting
from flexdt.twin.motion.drives import Drive
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.scanner import safety as rules
from flexdt.twin.scanner.joining import (
    MIN_STEP,
    CertifiedProgramme,
    JogMotion,
    Joined,
    Lookahead,
    StageChange,
    StopMotion,
    UnsweptProgramme,
)
from flexdt.twin.scanner.safety import Guard, after_contact, collision_error, with_contact
from flexdt.twin.scanner.state import (
    AxisReading,
    CameraChange,
    NamedCorrection,
    Readout,
    Safety,
    Sample,
    ScannerState,
    TubeSettings,
    changed_camera,
    changed_tube,
    readout,
    require_applicable,
    switched,
)


class ScannerTwin:
    """A scanner: commands change it, queries read it, each at a stated time.

    Args:
        machine: its description.
        profile: zero offsets in force.
        now: time at which it is at home [s].
        guard: finds the first contact along planned motion; None sweeps nothing.
        last_stop: number of the stop before the first one here (`Safety.stop`).
    """

    def __init__(
        self,
        machine: Machine,
        profile: Profile,
        now: float = 0.0,
        guard: Guard | None = None,
        last_stop: int = 0,
    ) -> None:
        """Make the scanner at rest at home at twin time `now` [s], X-rays off, stage empty.

        Tube and camera have the machine's settings; no correction is applied. `guard`
        finds collisions of a motion (None: none are looked for); safety counts stops from
        `last_stop` on.
        """
        self.machine = machine
        self.profile = profile
        self.guard = guard
        self.tube = TubeSettings(machine.tube.kV, machine.tube.power_W, since=now)
        self.camera = machine.detector.camera
        self.sample = Sample()
        self.correction: NamedCorrection | None = None
        self.safety = Safety(
            max_blocked_attempts=machine.max_blocked_attempts, stop=last_stop
        )
        self._drives: dict[str, Drive] = plan.home(machine, now)
        self._coasts_until = -math.inf
        self._stage = self._stops = self._programmes = 0
        """How often the stage was changed, motion stopped, another programme begun: a
        certificate is bound to these."""
        self._derived: tuple[object, Readout | None] = (None, None)
        """The last readout, and its inputs."""
        self._judged: tuple[object, tuple[str, str] | None] = (None, None)
        """The last pair in contact, and the positions and stage that it was found for."""

    # Reading
    # ------------------------------------------------------------------------------------

    def trajectories(self, now: float) -> dict[str, Trajectory]:
        """Return the trajectory in force of every motor."""
        return {name: d.at(now) for name, d in self._drives.items()}

    def positions(self, now: float) -> dict[str, float]:
        """Return the position of every motor [mm, deg], script's sign."""
        return {name: d.at(now).position(now) for name, d in self._drives.items()}

    def velocities(self, now: float) -> dict[str, float]:
        """Return the velocity of every motor [mm/s, deg/s]."""
        return {name: d.at(now).velocity(now) for name, d in self._drives.items()}

    def targets(self, now: float) -> dict[str, float]:
        """Return where every motor's present motion comes to rest [mm, deg]."""
        return {name: d.at(now).target for name, d in self._drives.items()}

    def final_positions(self) -> dict[str, float]:
        """Return motors' positions after their programme [mm, deg]."""
        return {name: d.final for name, d in self._drives.items()}

    def moving(self, now: float) -> bool:
        """Return whether any motor is under way."""
        return any(d.at(now).moving(now) for d in self._drives.values())

    def rest_time(self, now: float) -> float:
        """Return when the last motor rests, at least `now` [s]."""
        return max(now, *(d.end for d in self._drives.values()))

    @property
    def programmes(self) -> int:
        """Number of programmes that have been taken over; it identifies the present one."""
        return self._programmes

    @property
    def stops(self) -> int:
        """Number of times motion was stopped; a permission from before a stop is void."""
        return self._stops

    def settings(self, axis: str) -> tuple[float, float]:
        """Return speed and acceleration of the next motion of motor `axis`."""
        self.machine.axis(axis)
        return self._drives[axis].speed, self._drives[axis].acceleration

    @property
    def paces(self) -> dict[str, tuple[float, float]]:
        """Motor -> speed and acceleration of its next motion."""
        return {axis: self.settings(axis) for axis in self.machine.axes}

    @property
    def parameters(self) -> Offsets:
        """The correction in force, as offsets; all nominal when there is none."""
        if self.correction is None:
            return NOMINAL
        return self.correction.parameters

    @property
    def pixel_mm(self) -> float:
        """Binned pixel pitch [mm]."""
        return self.camera.pixel_mm(self.machine.detector.pixels)

    def poses(self, now: float) -> Poses:
        """Compute the nominal poses, n = 1."""
        return self.poses_at(self.positions(now), self.camera)

    def poses_at(
        self, positions: Mapping[str, npt.ArrayLike], camera: CameraSettings
    ) -> Poses:
        """Compute nominal poses for positions [mm, deg], scalars or (n,), and any camera."""
        return motor_poses(self.machine, self.profile, camera, positions)

    def corrected(
        self, nominal: Poses, camera: CameraSettings, correction: NamedCorrection | None
    ) -> ConeVec:
        """Compute the geometry of poses with `correction`, checked (thesis 4.8.3).

        Without a correction nominal; pixels must have the camera's pitch.

        Raises:
            GeometryError: a geometry no scanner can have.
        """
        parameters = NOMINAL
        if correction is not None:
            parameters = correction.parameters
        pixel = camera.pixels_mm(self.machine.detector.pixels)
        return check_cone_vec(nominal.cone_vec(parameters), pixel)

    def cone_vec(self, now: float) -> ConeVec:
        """Compute the nominal geometry plus the correction in force, checked (thesis
        4.8.3), n = 1.

        Raises:
            GeometryError: a geometry no scanner can have.
        """
        return self.corrected(self.poses(now), self.camera, self.correction)

    def state(self, now: float) -> ScannerState:
        """Return everything public, as one frozen value.

        Motors and virtual axes, tube, camera, sample, readout, safety, correction, and
        whether anything moves at `now`.

        Args:
            now: twin time [s].
        """
        axes = {name: self._axis_state(name, now) for name in self.machine.axes}
        for name, virtual in self.machine.virtual_axes.items():
            axes[name] = self._virtual_state(name, axes[virtual.of], now)
        return ScannerState(
            time=now,
            axes=axes,
            tube=self.tube,
            camera=self.camera,
            sample=self.sample,
            readout=self._readout(now),
            safety=self._safety_at(now),
            correction=self.correction,
            moving=self.moving(now),
        )

    def _readout(self, now: float) -> Readout | None:
        """Compute derived geometry, or return the last one if nothing has changed.

        It takes most of a state's time, and keeping it halves the answer to an E-stop.

        Args:
            now: twin time [s].

        Returns distances, magnification, voxel and field; None where SOD or SDD is not positive,
        or no geometry can be computed.
        """
        positions = self.positions(now)
        made_of = (tuple(positions.values()), self.camera, self.parameters)
        if self._derived[0] != made_of:
            poses = self.poses_at(positions, self.camera)
            sensor = self.machine.detector.pixels
            found = None
            with suppress(GeometryError):
                found = readout(poses, self.camera, sensor, self.parameters)
            self._derived = (made_of, found)
        return self._derived[1]

    # Motion
    # -------------------------------------------------------------------------------------

    def move(
        self,
        targets: Mapping[str, float],
        now: float,
        *,
        relative: bool = False,
        shortest: bool = False,
    ) -> dict[str, float]:
        """Send axes to targets; all start together, nothing moves if any target is bad.

        A free move clears the count of blocked attempts. A contact ahead counts as one;
        at the machine's maximum all motors stop and the state is blocked.

        Args:
            targets: motor or virtual axis -> position [mm, deg], script's sign.
            now: time of the command [s].
            relative: targets are displacements from where the motors are bound for.
            shortest: rotations go the shorter way round; otherwise angles are
                accumulated. Ignored for relative targets.

        Returns:
            Motor -> seconds until it rests, of the motors that are sent.

        Raises:
            UnknownNameError, LimitError: nothing moves; also for a motion that would end
                after the twin's clock (`drives.require_time`).
            SafetyError: E-stopped or blocked; nothing moves.
            CollisionError: a contact is ahead. The motion halts before it where that is
                free, and else nothing changes; the error's data has the outcome
                (`halts_at`).
        """
        self._require_ready("motion", now)
        new = plan.plan_move(
            self.machine, self._drives, targets, now, relative=relative, shortest=shortest
        )
        plan.require_time(
            "the move", max((t.end for t in new.values()), default=now), now
        )
        joined = self._lookahead(now).joined(new)
        if joined.contact is not None:
            what = "move " + ", ".join(
                f"{name}={value:g}" for name, value in targets.items()
            )
            raise self._blocked(joined, now, what)
        self.safety = rules.after_free_motion(self.safety)
        self._take(joined.trajectories)
        return {name: max(0.0, t.end - now) for name, t in new.items()}

    def resolve(
        self,
        targets: Mapping[str, float],
        now: float,
        *,
        relative: bool = False,
        shortest: bool = False,
    ) -> dict[str, float]:
        """Compute the motor targets [mm, deg] of a `move`; nothing moves.

        Safety and contacts are not checked. Raises UnknownNameError, LimitError.
        """
        planned = plan.plan_move(
            self.machine, self._drives, targets, now, relative=relative, shortest=shortest
        )
        return {name: t.target for name, t in planned.items()}

    def limit_messages(
        self, targets: Mapping[str, float], now: float, *, relative: bool = False
    ) -> list[str]:
        """List messages about targets that would end at a limit; nothing moves.

        Arguments are those of `move`. All end with "set to the limit", also where the
        machine refuses such targets.

        Raises:
            UnknownNameError: no such axis.
        """
        bound = self.targets(now)
        found = (
            arrival(
                self.machine,
                axis,
                motor_targets(self.machine, axis, value, bound, relative=relative),
            )
            for axis, value in targets.items()
        )
        return [
            f"{message}; set to the limit" for each in found for message in each.messages
        ]

    def jog(self, axis: str, velocity: float, lease_s: float, now: float) -> JogMotion:
        """Run `axis` at `velocity` until the lease ends or a limit nears, then brake.

        A jog that a contact cuts short runs as far as it is free, returns the contact,
        and leaves the count of blocked attempts. One that cannot go at all is a blocked
        attempt and changes nothing, unless it is once too often (then all motors stop):
        the lease that it was to renew runs out. A free jog of at least `MIN_STEP` clears
        the count.

        Args:
            axis: motor or virtual axis.
            velocity: [mm/s, deg/s], of either sign; 0 brakes.
            lease_s: time until it brakes unless renewed, above 0 [s].
            now: twin time [s].

        Returns:
            Time until the motors rest, the contact that it ends before, and where they
            come to rest.

        Raises:
            UnknownNameError: no such axis.
            LimitError: a velocity or lease out of range, or an end after the twin's clock.
            SafetyError: E-stopped or blocked; nothing changes.
            CollisionError: a contact, and no free motion before it.
        """
        self._require_ready("motion", now)
        new = plan.plan_jog(self.machine, self._drives, axis, velocity, lease_s, now)
        plan.require_time("the jog", max((t.end for t in new.values()), default=now), now)
        joined = self._lookahead(now).joined(new)
        if joined.contact is not None and not joined.trajectories:
            raise self._blocked(joined, now, f"jog {axis} at {velocity:g}")
        goes = any(
            abs(t.target - t.position(now)) >= MIN_STEP * self._drives[name].counts
            for name, t in joined.trajectories.items()
        )
        if joined.contact is None and goes:
            self.safety = rules.after_free_motion(self.safety)
        self._take(joined.trajectories)
        seconds = max((t.end - now for t in joined.trajectories.values()), default=0.0)
        rests = {name: t.target for name, t in joined.trajectories.items()}
        return JogMotion(max(0.0, seconds), joined.contact, rests)

    def stop(self, now: float) -> StopMotion:
        """Stop every motor on a swept path; works in every state, and ends a programme."""
        if now < self._coasts_until:  # without power nothing brakes
            return StopMotion.of(self.trajectories(now), "coasting", now)
        return self._stopped(self._lookahead(now).stopped())

    def estop(self, now: float, by: str = "") -> StopMotion:
        """Stop the motors by the machine's stop category; switch X-rays off.

        Category 0 coasts, others brake as hard as allowed. Calling it again stops again.

        Motion and X-rays are rejected until a reset. Motors that coast already go on
        coasting.

        Args:
            now: time of the command [s].
            by: connection that pressed it.

        Returns:
            The stopping motion: path, duration, distances, and the contact that it cannot
            avoid.
        """
        self.tube = switched(self.machine, self.tube, False, now, warm=True)
        self.safety = rules.estopped(self.safety, by)
        ahead = self._lookahead(now)
        if now < self._coasts_until:
            return self.stop(now)
        match self.machine.estop.category:
            case 0:
                trajectories = coasting(
                    self.machine, self._drives, now, self.machine.estop.coasting
                )
                hit = None
                with suppress(Exception):  # whatever a sweep meets, the motors coast
                    hit = ahead.contact(trajectories) if trajectories else None
                ends = (t.end for t in trajectories.values())
                self._coasts_until = max(ends, default=now)
                return self._stopped(StopMotion.of(trajectories, "coasting", now, hit))
            case 1:
                return self._stopped(ahead.stopped(ahead.hardest))
            case _:
                assert_never(self.machine.estop.category)

    def reset(self, now: float, stop: int | None = None) -> None:
        """Leave E-stop or blocked; no motion starts, and a contact remains one.

        Args:
            now: time of the command [s].
            stop: `Safety.stop` as the requester knows it; None releases whichever stop
                it is.

        Raises:
            SafetyError: motors coast still (a reset is judged by where they come to
                rest), or there has been another stop since `stop`; nothing is released.
        """
        self._require_power("a reset", now)
        self.safety = rules.released(self._safety_at(now), stop)

    def place(self, positions: Mapping[str, float], now: float) -> None:
        """Set motors to positions [mm, deg] at rest, at once: a start, not a motion.

        Others rest where their motion would have ended. Nothing is swept; touching parts
        block the scanner. Raises UnknownNameError, LimitError: nothing is changed.
        """
        wanted = resolve_targets(self.machine, positions, self.positions(now))
        stand = {**self.targets(now), **wanted}
        self._take({name: motion.at_rest(x, now) for name, x in stand.items()})
        self.safety = with_contact(self.safety, self._touching(now))

    # Programmes
    # ---------------------------------------------------------------------------------

    def prepared(
        self,
        programme: Mapping[str, Sequence[Trajectory]],
        now: float,
        start: Mapping[str, float] | None = None,
    ) -> UnsweptProgramme:
        """Prepare a programme for its sweep; nothing moves, and `certified` on the result
        may run in another thread.

        Args:
            programme: motor -> trajectories in the order of their starts, on a clock that
                shows 0 when it is taken over.
            now: time of the command [s].
            start: positions of motors then, at rest; those left out where their
                programme ends [mm, deg].

        Returns:
            The programme with its start, the guard, and the numbers of the stage and of
            the stops, to which its certificate is bound.

        Raises:
            UnknownNameError: no such motor.
            SafetyError: E-stopped or blocked.
        """
        self._require_ready("a programme", now)
        for name in programme:
            self.machine.axis(name)
        stand = {**self.final_positions(), **(start or {})}
        return UnsweptProgramme(programme, stand, (self._stage, self._stops), self.guard)

    def may_follow(self, certificate: CertifiedProgramme, now: float) -> bool:
        """Return whether stage, stops and motors are as the programme was prepared for."""
        here = not self.moving(now) and self.positions(now) == certificate.prepared.start
        return here and self.holds(certificate)

    def holds(self, certificate: CertifiedProgramme) -> bool:
        """Return whether stage and stops are a prepared programme's."""
        return certificate.prepared.version == (self._stage, self._stops)

    def follow(self, certificate: CertifiedProgramme, now: float) -> None:
        """Start a programme that was swept: its motors follow it from `now` on, the
        others rest.

        It counts as a new programme, and leaves the count of blocked attempts.

        Args:
            certificate: the programme with the verdict of its sweep.
            now: twin time [s], the zero of the programme's clock.

        Raises:
            LimitError: it would end after the twin's clock; nothing moves.
            CollisionError: a contact anywhere along it, on the stage that it was prepared
                for; the attempt counts, and nothing moves.
            SafetyError: E-stopped or blocked; the motors are not at rest exactly at its
                start, or stage or stops have changed since it was prepared (prepare it
                again).
        """
        self._require_ready("a programme", now)
        prepared = certificate.prepared
        if certificate.contact is not None and self.holds(certificate):
            raise self._blocked(
                Joined({}, certificate.contact), now, "the programme", now
            )
        if not self.may_follow(certificate, now):
            what = "the programme was checked for another stage or another start; nothing moves"
            raise SafetyError(
                what, {"asked": "a programme", "allowed": "checking it again"}
            )
        ends = [legs[-1].end for legs in prepared.legs.values() if legs]
        plan.require_time("the programme", now + max(ends, default=0.0), now)
        self._programmes += 1
        for name, legs in prepared.legs.items():
            self._drives[name] = self._drives[name].following(*legs, origin=now)

    # The stage
    # ----------------------------------------------------------------------------------

    def stage_change(
        self,
        sample: Sample,
        correction: NamedCorrection | None,
        guard: Guard | None,
        now: float,
        *,
        targets: Mapping[str, float] | None = None,
        paces: Mapping[str, tuple[float, float]] | None = None,
    ) -> StageChange:
        """Prepare another sample or correction for its sweep; the stage stays as it is.

        Targets that the motors are bound for already are left out; the safety state must
        allow the others.

        `certified` on it may run in another thread; then `take_stage` puts it in force.

        Args:
            sample: the sample to be on the stage.
            correction: the correction to be in force; None for none.
            guard: finds contacts with both of them.
            now: time of the command [s].
            targets: where motors are sent together with the change; None sends none.
            paces: motor or virtual axis -> (speed, acceleration) that the moves have and
                the change sets [mm/s, mm/s2, ...]; None sets none.

        Returns:
            The change without a verdict, bound to stage, stops and programmes as they are
            now.

        Raises:
            GeometryError: a correction that no scanner can have.
            UnknownNameError, LimitError: `targets` or `paces`.
            SafetyError: motors coast, or a target is asked for while E-stopped or
                blocked.
        """
        self.require_applicable(correction)
        self._require_power("a change of the stage", now)
        bound = self.targets(now)
        targets = {
            n: x for n, x in (targets or {}).items() if n not in bound or x != bound[n]
        }
        if targets:
            self._require_ready("motion", now)
        version = (self._stage, self._stops, self._programmes)
        ahead = self._lookahead(now)
        drives = dict(self._drives)
        for name, (speed, acceleration) in (paces or {}).items():
            drives = plan.with_settings(self.machine, drives, name, speed, acceleration)
        if targets:
            moves = plan.plan_move(self.machine, drives, targets, now)
            plan.require_time("the move", max(t.end for t in moves.values()), now)
        else:
            moves = {}
        return StageChange(
            sample,
            correction,
            guard,
            ahead,
            version,
            moves,
            dict(targets or {}),
            dict(paces or {}),
        )

    def take_stage(self, change: StageChange, now: float) -> CollisionError | None:
        """Put a certified change of the stage in force: sample, correction, guard,
        paces and moves.

        The change is prepared and judged again for `now` (see `StageChange.renewed`).
        Motion under way that is not free of the new stage is halted, if the change has no
        moves of its own and halting is free; such a halt counts as a stop and as a blocked
        attempt. The moves of the change begin.

        Args:
            change: with its verdict.
            now: twin time [s].

        Returns:
            The contact that halted the motion under way, as an error; None where nothing
            was halted.

        Raises:
            CollisionError: a pair is too near, a move of the change would collide, motion
                under way is not free and the change has moves, or not even halting is free
                of the new stage; nothing changes.
            SafetyError: the stage was changed meanwhile; motion was stopped meanwhile and
                the change has targets; motors coast; or a long programme has begun.
                Nothing changes.
            GeometryError, UnknownNameError, LimitError: as `stage_change`.
        """
        if change.version[0] != self._stage:
            raise SafetyError(
                "the stage was changed meanwhile; nothing changes",
                {"allowed": "asking again"},
            )
        if change.targets and change.version[1] != self._stops:
            raise SafetyError(
                "motion was stopped meanwhile; nothing changes",
                {"allowed": "asking again"},
            )
        anew = self.stage_change(
            change.sample,
            change.correction,
            change.guard,
            now,
            targets=change.targets,
            paces=change.paces,
        )
        verdict = anew.renewed(change)
        for name, (speed, acceleration) in change.paces.items():
            self._drives = plan.with_settings(
                self.machine, self._drives, name, speed, acceleration
            )
        self._set_stage(change.sample, change.correction, change.guard)
        if anew.moves:
            self._take(anew.moves)
        self.safety = self._safety_at(now)
        contact = verdict.contact
        halted = verdict.trajectories
        if contact is None:
            return None
        # Also when that was once too often: another stop would not be certified on this stage.
        self.safety = after_contact(self.safety, contact)
        self._stops += 1
        self._take(halted)
        stops = {name: t.target for name, t in halted.items()}
        return collision_error(contact, now, self.safety, "the motion under way", stops)

    def initialise_stage(
        self,
        sample: Sample,
        correction: NamedCorrection | None,
        guard: Guard | None,
        now: float,
    ) -> list[str]:
        """Begin with this stage, whatever it touches, as after a restart.

        Nothing is swept and no motor stops; certificates of before are void.

        Args:
            sample: on the stage.
            correction: in force; None for none.
            guard: finds contacts with both of them.
            now: time [s].

        Returns:
            One message that names the nearest pair within the safety margin, and the
            state is blocked (or stays E-stopped); [] without such a pair.

        Raises:
            GeometryError: a correction that no scanner can have.
        """
        self.require_applicable(correction)
        self._set_stage(sample, correction, guard)
        self.safety = self._safety_at(now)
        pair = self.safety.contact
        if pair is None:
            return []
        return [f"{pair[0]} and {pair[1]} are closer than the margin"]

    def require_applicable(self, correction: NamedCorrection | None) -> None:
        """Check that a correction leaves a geometry that a scanner can have.

        Raises:
            GeometryError: it does not; the message names the offset or the check.
        """
        require_applicable(self.machine, self.profile, self.camera, correction)

    # Settings
    # -----------------------------------------------------------------------------------

    def set_axis(
        self, axis: str, *, speed: float | None = None, acceleration: float | None = None
    ) -> None:
        """Set speed and acceleration of the motors of `axis`, from their next motion on.

        Raises:
            UnknownNameError, LimitError.
        """
        self._drives = plan.with_settings(
            self.machine, self._drives, axis, speed, acceleration
        )

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
            now: time of the switch [s]; None: long ago, X-rays are ready.
            warm: leave out the warm-up after a long rest, as scripts do.

        Raises:
            LimitError: outside the tube's range; nothing is changed.
            SafetyError: X-rays on while the E-stop is in force; nothing is changed.
        """
        if on and self.safety.state == "estopped":
            raise SafetyError(
                f"X-rays on is refused: {self.safety.reason}; a reset is needed",
                {"asked": "xrays on", "state": self.safety.state, "allowed": "reset"},
            )
        tube = changed_tube(self.machine.tube, self.tube, kV, power_W)
        if on is not None:
            tube = switched(self.machine, tube, on, now, warm=warm)
        self.tube = tube

    def set_camera(self, **change: Unpack[CameraChange]) -> None:
        """Change the camera's settings; those left out stay.

        Raises:
            LimitError: outside the detector's range.
        """
        self.camera = changed_camera(self.machine.detector, self.camera, change)

    # Inside
    # -------------------------------------------------------------------------------------

    def _take(self, trajectories: Mapping[str, Trajectory]) -> None:
        """Replace the programmes of motors; the caller holds a certificate for it."""
        self._programmes += 1
        for name, trajectory in trajectories.items():
            self._drives[name] = self._drives[name].following(trajectory)

    def _stopped(self, stopping: StopMotion) -> StopMotion:
        """Let the motors follow a stop, count it, and return it; certificates of before are
        void.
        """
        self._stops += 1
        self._take(stopping.trajectories)
        return stopping

    def _set_stage(
        self, sample: Sample, correction: NamedCorrection | None, guard: Guard | None
    ) -> None:
        """Set sample, correction and guard; certificates of before are void."""
        self.sample = sample
        self.correction = correction
        self.guard = guard
        self._stage += 1

    def _lookahead(self, now: float) -> Lookahead:
        """Return all motors and the guard at `now`."""
        return Lookahead(self.machine, self.guard, dict(self._drives), now)

    def _require_power(self, what: str, now: float) -> None:
        """Check that no motor coasts.

        Args:
            what: command, for the message.
            now: twin time [s].

        Raises:
            SafetyError: motors coast for a while.
        """
        if now < self._coasts_until:
            left = self._coasts_until - now
            raise SafetyError(
                f"{what} is refused: motors coast for another {left:.3g} s",
                {
                    "asked": what,
                    "state": self.safety.state,
                    "allowed": "asking again at rest",
                },
            )

    def _touching(self, now: float) -> tuple[str, str] | None:
        """Find the nearest pair in contact, or closer than the safety margin by more than
        rounding (2 `ROUNDING_MM`).

        The result is kept as long as positions and stage stay the same.

        Args:
            now: twin time [s].

        Returns:
            The two names; None if all pairs keep the margin, or without a guard.
        """
        positions = self.positions(now)
        made_of = (tuple(positions.values()), self._stage)
        if self._judged[0] != made_of:
            least = self.machine.safety_margin_mm - 2.0 * rules.ROUNDING_MM
            if self.guard is not None:
                near = self.guard.touching(positions)
            else:
                near = {}
            found = {pair: mm for pair, mm in near.items() if mm <= 0.0 or mm < least}
            self._judged = (
                made_of,
                min(found, key=lambda pair: found[pair], default=None),
            )
        return self._judged[1]

    def _safety_at(self, now: float) -> Safety:
        """Return the safety state, with contact judged by where parts are.

        Where that fails it is as known before.
        """
        try:
            return with_contact(self.safety, self._touching(now))
        except Exception:  # whatever the guard meets, the safety state is told
            return self.safety

    def _require_ready(self, what: str, now: float) -> None:
        """Update the safety state, and raise SafetyError unless motion is allowed."""
        self.safety = with_contact(self.safety, self._touching(now))
        rules.require_ready(self.safety, what)

    def _blocked(
        self, joined: Joined, now: float, what: str, zero: float = 0.0
    ) -> CollisionError:
        """Count a blocked attempt, and let the motors follow the motion that is left.

        If that was once too often (blocked, and by no lasting contact), all motors stop
        instead. `what`: the command, for people; `zero`: time at which the contact's
        clock shows 0 [s]. Returns the error to raise, with where motors come to rest.
        """
        contact = joined.contact
        assert contact is not None
        self.safety = after_contact(self.safety, contact)
        trajectories = joined.trajectories
        if self.safety.state == "blocked" and self.safety.contact is None:
            trajectories = self.stop(now).trajectories  # once too often: all motion ends
        else:
            self._take(trajectories)
        stops = {name: t.target for name, t in trajectories.items()}
        return collision_error(contact, now - zero, self.safety, what, stops)

    def _axis_state(self, name: str, now: float) -> AxisReading:
        """Read a motor.

        Limits, speed and acceleration are the present ones; position in mm or deg
        (`unit`).

        Args:
            name: of the motor.
            now: twin time [s].
        """
        axis = self.machine.axes[name]
        drive = self._drives[name]
        t = drive.at(now)
        return AxisReading(
            position=t.position(now),
            target=t.target,
            velocity=t.velocity(now) + 0.0,  # no negative zero
            moving=t.moving(now),
            limits=(axis.lower, axis.upper),
            speed=drive.speed,
            acceleration=drive.acceleration,
            unit=axis.unit,
        )

    def _virtual_state(self, name: str, other: AxisReading, now: float) -> AxisReading:
        """Make the reading of a virtual axis from that of the motor it is defined by.

        Position, target, velocity, limits, speed and acceleration are converted; the rest
        is kept. `now` is ignored.
        """
        virtual = self.machine.virtual_axes[name]
        lower, upper = sorted(virtual.constant + virtual.factor * x for x in other.limits)
        return replace(
            other,
            position=virtual_reading(self.machine, name, {virtual.of: other.position}),
            target=virtual_reading(self.machine, name, {virtual.of: other.target}),
            velocity=virtual.factor * other.velocity + 0.0,  # no negative zero
            limits=(lower, upper),
            speed=other.speed * abs(virtual.factor),
            acceleration=other.acceleration * abs(virtual.factor),
            virtual=True,
        )
