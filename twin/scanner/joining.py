"""Join new motion to the present one, so that the motors always follow one swept programme.

A `Lookahead` is all motors at one moment, with the guard that finds the first contact
along any motion of all of them. It makes the first programme that is certified: swept
completely, or along a path that was. Where there is none, nothing changes: the programme
in force stays free, since it was certified with all motors in it. This module returns
values; the scanner takes them over.

Another sample or correction may be put in force while motors are at rest or moving. The
bodies on the stage and their places change with the sample and with the correction. Both
are certified as moves are: whatever is under way must be free of the new stage, or at
least a stop of it, and where nothing moves no pair may come within the safety margin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from flexdt.twin.errors import CollisionError, SafetyError
from flexdt.twin.machine.description import Machine
from flexdt.twin.machine.travel import POSITION_ROUNDING, distance_beyond
from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.braking import (
    Most,
    braked_along,
    braked_apart,
    braked_at,
    greatest,
    programme_time_at_rest,
)
from flexdt.twin.motion.drives import Drive
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.scanner.safety import Contact, Guard, floor, would_touch
from flexdt.twin.scanner.state import NamedCorrection, Sample

MIN_STEP = 0.05
"""Shortest motion that begins before a contact [mm or deg that the motor moves a part]."""
FIRST_LEAD_S = 0.5
"""Lead of the first attempt at braking before a contact [s]."""
HALVINGS = 7
"""Bisection steps for the moment at which motors must brake before a contact."""
SWEPT_HALVINGS = 4
"""The same where each step is a sweep."""
QUICKER_STOP_SHARES = (0.0, 0.125, 0.25, 0.5)
"""Shares of a stop along the path after which stopping each motor by itself is tried."""
MIN_GAIN_S = 0.02
"""Least gain of time for which a quicker stop is used [s]."""

Trajectories = Mapping[str, Trajectory]
StopPath = Literal["along", "apart", "coasting"]
"""How motors come to rest, see `StopMotion`."""
MAX_SWEPT_LEGS = 500
"""Largest number of trajectories of a programme that is swept at a takeover."""


@dataclass(frozen=True)
class Joined:
    """A certified programme that follows the request, or the free part of it.

    For a change of the stage it is the programme under way, or its halt.

    Attributes:
        trajectories: of the motors whose programme changes; none if nothing does.
        contact: that cut it short; None where all of it is free.
    """

    trajectories: Trajectories
    contact: Contact | None = None


@dataclass(frozen=True)
class JogMotion:
    """The motion that a jog results in.

    Attributes:
        duration_s: until the motors rest.
        cut_short: the contact that it ends before; None where it runs for all of its
            lease.
        rests: motor -> where it comes to rest [mm, deg].
    """

    duration_s: float
    cut_short: Contact | None
    rests: Mapping[str, float]

    @property
    def warnings(self) -> list[str]:
        """Message naming the pair that a jog would hit and where it ends before; [] if not
        cut short.
        """
        if self.cut_short is None:
            return []
        where = ", ".join(f"{name}={value:g}" for name, value in self.rests.items())
        pair = " and ".join(self.cut_short.pair)
        return [f"{pair} would collide: the jog ends before, at {where}"]


@dataclass(frozen=True)
class StopMotion:
    """How motors come to rest.

    Attributes:
        trajectories: of the motors whose programme changes.
        path: `along` the path they were on together; `apart`, each motor by itself, on a
            path that was swept for it; `coasting`, without power, on a path that nothing
            keeps free.
        duration_s: until all motors rest.
        distances: motor -> how far it still travels [mm, deg], of those that move.
        would_hit: contact while coasting; None for the other two.
    """

    trajectories: Trajectories
    path: StopPath
    duration_s: float
    distances: Mapping[str, float]
    would_hit: Contact | None = None

    @classmethod
    def of(
        cls,
        trajectories: Trajectories,
        path: StopPath,
        now: float,
        would_hit: Contact | None = None,
    ) -> StopMotion:
        """Make the value: seconds until the last motor rests, and distances of those moving
        at `now`.

        The trajectories have begun at `now` [s] or earlier; without motion it takes 0 s.
        """
        distances = {
            n: abs(t.target - t.position(now))
            for n, t in trajectories.items()
            if t.moving(now)
        }
        seconds = max((t.end - now for t in trajectories.values()), default=0.0)
        return cls(trajectories, path, max(0.0, seconds), distances, would_hit)


@dataclass(frozen=True)
class Lookahead:
    """All motors from `now` on.

    Attributes:
        machine: which motors are coupled, and the greatest acceleration they can brake
            with.
        guard: finds the first contact; None finds none.
        drives: every motor with its complete programme.
        now: the moment [s].
    """

    machine: Machine
    guard: Guard | None
    drives: Mapping[str, Drive]
    now: float

    @property
    def hardest(self) -> dict[str, float]:
        """Motor -> greatest acceleration that it can brake with [mm/s2, deg/s2]."""
        return {name: axis.max_acceleration for name, axis in self.machine.axes.items()}

    def ahead(self) -> dict[str, Trajectory]:
        """Return the programmes of the motors that have not come to their last rest."""
        return {n: d.ahead(self.now) for n, d in self.drives.items() if d.end > self.now}

    def contact(
        self, trajectories: Trajectories, since: float | None = None
    ) -> Contact | None:
        """Find the first contact if some motors follow `trajectories`, the others their
        programme.

        None also without a guard.
        `trajectories`: motor -> trajectory. `since`: everything before is known to be free [s];
        now if None.
        """
        if self.guard is None:
            return None
        start = self.now if since is None else since
        others = {
            n: d.ahead(self.now) for n, d in self.drives.items() if n not in trajectories
        }
        return self.guard({**others, **trajectories}, start)

    def touching(
        self, *, deep: bool = False, standing: bool = False
    ) -> Mapping[tuple[str, str], float]:
        """Find the pairs within the safety margin now, -> clearance [mm]; as
        `Guard.touching`.

        Overlaps are 0 unless `deep`; `standing` is of parts at their present places.
        Empty without a guard.
        """
        here = {
            name: d.at(self.now).position(self.now) for name, d in self.drives.items()
        }
        if self.guard is None:
            return {}
        if standing:
            guard = self.guard.standing(here)
        else:
            guard = self.guard
        return guard.touching(here, deep=deep)

    # Joining
    # ------------------------------------------------------------------------------------

    def joined(self, new: Trajectories) -> Joined:
        """Find the first certified programme for a requested motion; nothing moves yet.

        A request without contact is taken as it is. Else the first that is free and takes
        some motor `MIN_STEP` farther or halts one: 1. No other motor is under way: a
        single new one goes to its last free position, several halt along their path. 2.
        Others are: the new ones halt before the contact, others carry on. 3. One of the
        new ones is, too: all halt along the new path. Without a later free moment none is
        tried.
        Returns trajectories, empty without one, and the contact of the request.
        """
        contact = self.contact(new)
        if contact is None:
            return Joined(new)
        if contact.last_free_time <= self.now:
            return Joined({}, contact)
        others = any(name not in new for name in self.ahead())
        halted = (self._halt_alone(new, contact) if not others else None) or (
            self._new_halt_swept(new, contact)
            if others
            else self._halt_along(new, contact)
        )
        if halted is None and others and any(name in new for name in self.ahead()):
            halted = self._halt_along({**self.ahead(), **new}, contact)
        if halted is None or not any(
            self._advances(name, t) for name, t in halted.items()
        ):
            return Joined({}, contact)
        return Joined(halted, contact)

    def _advances(self, name: str, way: Trajectory) -> bool:
        """Return whether a motor is under way, or gets farther than `MIN_STEP`."""
        here = self.drives[name].at(self.now)
        least = MIN_STEP * self.drives[name].counts
        far = abs(way.target - here.position(self.now)) >= least
        return far or here.velocity(self.now) != 0.0

    def _halt_alone(
        self, new: Trajectories, contact: Contact
    ) -> dict[str, Trajectory] | None:
        """Shorten the motion of a single motor to its last free position before the contact.

        It goes there with the planned top speed and acceleration (at least `profiles.MIN_RATE`);
        the shorter motion is swept.

        Args:
            new: motor -> requested trajectory.
            contact: ahead on it.

        Returns motor -> trajectory; None for several motors, or if the sweep finds a contact.
        """
        if len(new) != 1:
            return None
        ((name, planned),) = new.items()
        current = self.drives[name].at(self.now)
        least = motion.MIN_RATE * self.drives[name].counts
        speed = max(planned.top_speed, least)
        acceleration = max(planned.acceleration(self.now), least)
        way = current.redirected(contact.last_free[name], speed, acceleration, self.now)
        # Swept although it ends where the path is free: a motor that cannot stop before it
        # passes the place, and comes back.
        halted = {name: way}
        if self.contact(halted) is None:
            return halted
        return None

    def _halt_along(
        self, new: Trajectories, contact: Contact
    ) -> dict[str, Trajectory] | None:
        """Slow `new` along its path as late as possible before the contact; the path is free up
        to there, so nothing is swept.

        Braking is with the hardest accelerations allowed. The moment is found by `HALVINGS`
        bisection steps.

        `new`: motor -> requested trajectory; `contact`: ahead on it.
        Returns motor -> trajectory that rests by the last free moment; None if none does.
        """
        moving = {name: self.drives[name].following(t) for name, t in new.items()}

        def rests_in_time(at: float) -> bool:
            """Return whether a stop begun at `at` ends before the contact."""
            return (
                programme_time_at_rest(moving, at, self.hardest) <= contact.last_free_time
            )

        at = self._latest(rests_in_time, contact, HALVINGS)
        if at is None:
            return None
        return _trajectories(braked_at(self.drives, at, new, self.hardest), new)

    def _new_halt_swept(
        self, new: Trajectories, contact: Contact
    ) -> dict[str, Trajectory] | None:
        """Slow `new` by itself as late as possible while the others carry on; each trial is
        swept.

        At most `SWEPT_HALVINGS` trials follow the first moment that holds.

        Args:
            new: motor -> requested trajectory.
            contact: ahead on it.

        Returns motor -> trajectory that is free; None if none is found.
        """

        new_drives = {name: self.drives[name] for name in new}

        def halted(at: float) -> dict[str, Trajectory]:
            """Brake the new motors from `at` on."""
            return _trajectories(braked_at(new_drives, at, new, self.hardest), new)

        def free(at: float) -> bool:
            """Return whether that is free of contacts."""
            # Until it brakes, the motors do what was asked for, which is free up to its
            # contact.
            return self.contact(halted(at), since=at) is None

        at = self._latest(free, contact, SWEPT_HALVINGS)
        return None if at is None else halted(at)

    def _latest(
        self, holds: Callable[[float], bool], contact: Contact, halvings: int
    ) -> float | None:
        """Find a late moment [s] before the contact for which `holds`, perhaps not the
        latest.

        Steps back from it double from `FIRST_LEAD_S`, never before now, until it holds;
        then bisection. None if it does not hold even now.
        """
        late = contact.last_free_time
        back = FIRST_LEAD_S
        while True:
            early = max(self.now, contact.last_free_time - back)
            if holds(early):
                break
            if early == self.now:
                return None
            late = early
            back = 2.0 * back
        for _ in range(halvings):
            middle = 0.5 * (early + late)
            if holds(middle):
                early = middle
            else:
                late = middle
        return early

    # Stopping
    # -----------------------------------------------------------------------------------

    def stopped(self, most: Most = None) -> StopMotion:
        """Compute how everything stops: along the path, or quicker "apart" where that is
        free.

        Nothing moves yet. `most`: motor -> greatest acceleration; None: planned ones.
        """
        along = braked_along(self.drives, self.now, most)
        try:
            quicker = self._quicker_stop(along, most)
        except Exception:  # whatever a sweep meets, motors are stopped
            quicker = None
        if quicker is not None:
            return StopMotion.of(quicker, "apart", self.now)
        return StopMotion.of(along, "along", self.now)

    def _quicker_stop(
        self, along: Trajectories, most: Most
    ) -> dict[str, Trajectory] | None:
        """Find a quicker stop: along the path for a while, then each motor by itself, if
        free.

        It is tried after each of `QUICKER_STOP_SHARES` of the stop's duration, and given
        up at the first that gains less than `MIN_GAIN_S`. Each is swept, but for a single
        motor under way that brakes at once; every motor must rest within its travel.

        Args:
            along: motor -> trajectory of the stop along the path.
            most: motor -> greatest acceleration; None: those that the motion was planned
                with.

        Returns:
            Motor -> trajectory, of all motors of `along` too; None where nothing is
            quicker and free.
        """
        duration = max((t.end for t in along.values()), default=self.now) - self.now
        due = [n for n, d in self.drives.items() if d.end > self.now]
        strongest = {
            name: greatest(name, d.at(self.now), self.now, most)
            for name, d in self.drives.items()
        }
        slowed = {name: self.drives[name].following(t) for name, t in along.items()}
        for share in QUICKER_STOP_SHARES:
            at = self.now + share * duration
            # After some of the stop, each motor goes on from there and not from its
            # programme.
            drives = slowed if share else self.drives
            stops = braked_apart(self.machine, drives, at, strongest)
            if (
                max((t.end for t in stops.values()), default=at)
                > self.now + duration - MIN_GAIN_S
            ):
                return None
            trajectories = {
                n: motion.rejoined(along[n], at, rest) for n, rest in stops.items()
            }
            # The one motor that has anything to do brakes on the path that it was swept
            # on. Where another is to set off later, it may rely on the room that one
            # would make.
            single = not share and len(due) == 1
            free = single or self.contact({**along, **trajectories}, since=at) is None
            if free and self._within_travel(trajectories):
                return {**along, **trajectories}
        return None

    # Changes of the stage
    # -----------------------------------------------------------------------

    def on(self, guard: Guard | None) -> Lookahead:
        """Return the same motors with another stage's guard."""
        return Lookahead(self.machine, guard, self.drives, self.now)

    @property
    def legs(self) -> int:
        """Number of trajectories of the motors under way; a long programme has thousands."""
        return sum(len(d.trajectories) for d in self.drives.values() if d.end > self.now)

    def halted_at_once(self, contact: Contact) -> Trajectories | None:
        """Slow what is under way along its path with the hardest accelerations, unswept.

        None if it rests later than the contact's last free moment.
        """
        if (
            programme_time_at_rest(self.drives, self.now, self.hardest)
            > contact.last_free_time
        ):
            return None
        return braked_along(self.drives, self.now, self.hardest)

    def halted(self, under_way: Trajectories, contact: Contact) -> Trajectories | None:
        """Find a halt of what is under way before a contact that a new stage has put
        ahead.

        The first that is free: a single motor goes to its last free position; all brake
        as late as possible along the path; all at once along it; each by itself. The last
        two brake as hard as the machine can, are swept, and rest within travel. Returns
        None if no halt is free.
        """
        halted = self._halt_alone(under_way, contact) or self._halt_along(
            under_way, contact
        )
        if halted is not None:
            return halted
        # Neither is certified by what was swept: the first may rest behind the contact, and
        # the second leaves the path.
        for trajectories in (
            braked_along(self.drives, self.now, self.hardest),
            braked_apart(self.machine, self.drives, self.now, self.hardest),
        ):
            if self._within_travel(trajectories) and self.contact(trajectories) is None:
                return trajectories
        return None

    def _within_travel(self, trajectories: Trajectories) -> bool:
        """Return whether all motors rest within their travel.

        In step with a weaker one they go farther.
        """
        return all(
            distance_beyond(self.machine, name, t.target) <= POSITION_ROUNDING
            for name, t in trajectories.items()
        )


def _trajectories(
    drives: Mapping[str, Drive], names: Trajectories
) -> dict[str, Trajectory]:
    """Return the first trajectory of each named motor."""
    return {name: drives[name].trajectories[0] for name in names}


@dataclass(frozen=True)
class UnsweptProgramme:
    """A programme that must be swept before it may be followed, and the sweep's inputs.

    Frozen, so that the sweep may run in another thread while the scanner lives on.

    Attributes:
        programme: motor -> trajectories on a clock that shows 0 when it is taken over.
        start: position of every motor then, at rest [mm, deg].
        version: of the stage and of the stops that it is prepared for.
        guard: of that stage.
    """

    programme: Mapping[str, Sequence[Trajectory]]
    start: Mapping[str, float]
    version: tuple[int, int]
    guard: Guard | None = field(repr=False)

    def certified(self) -> CertifiedProgramme:
        """Sweep the whole programme for its first contact; takes about 60 ms for 1440 steps.

        Without a guard nothing is swept, and the programme counts as free.
        """
        # Motors without a programme are part of what may be hit.
        standing = {name: motion.at_rest(x, 0.0) for name, x in self.start.items()}
        legs = {name: motion.joined(legs) for name, legs in self.legs.items()}
        contact = None
        if self.guard is not None:
            contact = self.guard({**standing, **legs}, 0.0)
        return CertifiedProgramme(self, contact)

    @property
    def legs(self) -> dict[str, tuple[Trajectory, ...]]:
        """Motor -> its trajectories, with a wait at rest first if they begin after 0.

        Motors without a trajectory are left out.
        """
        out = {}
        for name, legs in self.programme.items():
            if legs and legs[0].start > 0.0:
                wait = [motion.at_rest(self.start[name], 0.0)]
            else:
                wait = []
            out[name] = (*wait, *legs)
        return {name: legs for name, legs in out.items() if legs}


@dataclass(frozen=True)
class CertifiedProgramme:
    """Result of the sweep of a programme; valid for the version it was prepared for."""

    prepared: UnsweptProgramme
    contact: Contact | None


@dataclass(frozen=True)
class StageChange:
    """A change of the stage with its sweep's inputs; frozen, so that the sweep may
    run in a thread.

    Attributes:
        sample: the sample to be on the stage.
        correction: the correction to be in force; None for none.
        guard: finds contacts with both of them.
        ahead: all motors, with the guard that is in force.
        version: of the stage, the stops and the programmes that it is made for.
        moves: motor -> trajectory that begins with the change.
        targets, paces: origin of those moves.
    """

    sample: Sample
    correction: NamedCorrection | None
    guard: Guard | None = field(repr=False)
    ahead: Lookahead = field(repr=False)
    version: tuple[int, int, int]
    moves: Mapping[str, Trajectory] = field(repr=False)
    targets: Mapping[str, float]
    paces: Mapping[str, tuple[float, float]]
    found: Joined | None = None
    """Result of `certified`."""

    def certified(self) -> StageChange:
        """Judge the change; return it with the verdict.

        Raises:
            CollisionError: the present motion is not free of the new stage, and no stop
                of it is.
        """
        return replace(self, found=self.verdict())

    def renewed(self, before: StageChange) -> Joined:
        """Judge the change at the takeover, reusing the verdict found `before` where
        possible.

        1. Stage, stops and programmes are the same, nothing moves by it, and the motion
        was free: it still is. 2. At most `MAX_SWEPT_LEGS` trajectories are under way: it
        is judged anew. 3. A longer programme that must halt does at once, if it rests
        before the contact found. Returns halting motion and contact, or none.
        Raises CollisionError: as `verdict`; SafetyError: none of the three applies (a
        long programme went on meanwhile).
        """
        still = before.version == self.version and not self.moves
        found = before.found
        if still and found is not None and found.contact is None:
            return Joined({})  # a motion that was free to its end still is
        if self.ahead.legs <= MAX_SWEPT_LEGS:
            return self.verdict()
        if still and found is not None and found.contact is not None:
            halted = self.ahead.halted_at_once(found.contact)
            if halted is not None:
                return Joined(halted, found.contact)
        what = "the motion under way has changed meanwhile; nothing changes"
        raise SafetyError(what, {"allowed": "asking again"})

    def verdict(self) -> Joined:
        """Judge whether what is under way may carry on with the new stage, or how it
        halts.

        In this order: clearances now, the motion under way to its end, then the moves of
        the change together with it. Moves of the change need motion under way that is
        free.

        Returns:
            The halting motion and its contact; no trajectories and None where motion
            carries on.

        Raises:
            CollisionError: a pair is too near, a move of the change would collide, or
                motion under way is not free and either no halt is, or the change has
                moves.
        """
        changed = self.ahead.on(self.guard)
        now = self.ahead.now
        under_way = self.ahead.ahead()
        self._require_no_nearer(changed)
        contact = None
        if under_way:
            contact = changed.contact(under_way)
        halted: Trajectories = {}
        if contact is not None:
            found = changed.halted(under_way, contact)
            if found is None or self.moves:
                raise self._refused(contact.pair, contact.time - now, contact.last_free)
            halted = found
        if self.moves:
            met = changed.contact({**under_way, **self.moves})
            if met is not None:
                raise self._refused(met.pair, met.time - now, met.last_free)
        return Joined(halted, contact)

    def _require_no_nearer(self, changed: Lookahead) -> None:
        """Check that the new stage brings no pair within the safety margin, or below its
        floor.

        A sample on a stage of the turntable counts as the region that the stage can
        reach. Pairs near already are measured at their places as well: else it would
        excuse a sample that really overlaps.
        Raises CollisionError: names the first such pair.
        """
        margin = self.ahead.machine.safety_margin_mm
        for standing in (False, True):
            after = changed.touching(deep=True, standing=standing)
            if after:
                before = self.ahead.touching(deep=True, standing=standing)
            else:
                before = {}
            for pair, clearance in after.items():
                if pair not in before or clearance < floor(before[pair], margin):
                    raise self._refused(pair, 0.0, {})
            if not after:
                return

    def _refused(
        self, pair: tuple[str, str], seconds: float, last_free: Mapping[str, float]
    ) -> CollisionError:
        """Make the error for a change that brings parts together; returned, not raised.

        It names sample and correction, and that nothing changes.

        Args:
            pair: the two parts.
            seconds: from now to the contact.
            last_free: motor -> last free position [mm, deg].
        """
        what = "the empty stage"
        if self.sample.name:
            what = f"sample {self.sample.name!r}"
        if self.correction is not None:
            what += f" with correction {self.correction.name!r}"
        allowed = "a pose at which it is free, or another placement"
        return would_touch(
            what,
            pair,
            seconds,
            last_free,
            "would be too close",
            "nothing changes",
            halts_at={},
            allowed=allowed,
        )
