"""What stands in the way of motors, and how they are brought to rest before it.

A `Sweep` is what every motor is going to do from a moment on, with the guard that looks along it: a
new motion is judged together with all that is already programmed, and halted where it is last free.
It refuses to change anything: it returns trajectories, the scanner takes them over.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flexdt.twin import motion
from flexdt.twin.drives import Drive
from flexdt.twin.errors import CollisionError
from flexdt.twin.motion import Trajectory
from flexdt.twin.safety import Contact, Guard

HALVINGS = 12
"""Bisection steps for the moment at which motors must brake before a contact."""


@dataclass(frozen=True)
class Outlook:
    """What a changed sample or correction means for what stands and for what moves.

    Attributes:
        near: pair that is within the safety margin now; None if there is none.
        halted: the contact that lay ahead of the motion, which has been halted; None if none did.
    """

    near: tuple[str, str] | None = None
    halted: CollisionError | None = None

    @property
    def warnings(self) -> list[str]:
        """Both, in words."""
        near = [] if self.near is None else [f"{_and(self.near)} are closer than the safety margin"]
        return near if self.halted is None else [*near, self.halted.message]


@dataclass(frozen=True)
class Jog:
    """What a jog comes to.

    Attributes:
        duration_s: until the motors rest.
        cut_short: the contact that it ends before; None where it runs for all of its lease.
        rests: motor -> where it comes to rest [mm, deg].
    """

    duration_s: float
    cut_short: Contact | None
    rests: Mapping[str, float]

    @property
    def warnings(self) -> list[str]:
        """A jog that was cut short, in words."""
        if self.cut_short is None:
            return []
        where = ", ".join(f"{name}={value:g}" for name, value in self.rests.items())
        return [f"{_and(self.cut_short.pair)} would collide: the jog ends before, at {where}"]


@dataclass(frozen=True)
class Sweep:
    """All motors from `now` on.

    Attributes:
        guard: finds the first contact; None finds none.
        drives: every motor with all that it is to follow.
        now: the moment [s].
        hardest: motor -> the most it can brake with.
    """

    guard: Guard | None
    drives: Mapping[str, Drive]
    now: float
    hardest: Mapping[str, float]

    def ahead(self) -> dict[str, Trajectory]:
        """What is programmed for the motors that have not come to their last rest."""
        ways = {name: drive.ahead(self.now) for name, drive in self.drives.items()}
        return {name: way for name, way in ways.items() if way.end > self.now}

    def contact(self, new: Mapping[str, Trajectory], since: float | None = None) -> Contact | None:
        """The first contact if some motors follow `new` and the others what they are to follow.

        Args:
            new: motor -> trajectory.
            since: everything before is known to be free [s]; now if None.
        """
        if self.guard is None:
            return None
        start = self.now if since is None else since
        others = {n: d.ahead(self.now) for n, d in self.drives.items() if n not in new}
        return self.guard({**others, **new}, start)

    def touching(self) -> Contact | None:
        """What is within the safety margin now, wherever it is going."""
        here = {name: d.at(self.now).position(self.now) for name, d in self.drives.items()}
        return self.contact({name: motion.at_rest(x, self.now) for name, x in here.items()})

    def halted(self, new: Mapping[str, Trajectory], contact: Contact) -> dict[str, Trajectory]:
        """`new`, cut so that every motor rests before `contact`.

        A contact that is nearer than the braking distance is braked for as hard as the motors can.
        """
        alone = self._alone(new, contact)
        if alone is not None:
            return alone
        # Braking leaves the planned path, so each candidate is swept again, from where it does.
        free = {name: motion.braked(self.drives[name].at(self.now), self.now) for name in new}
        if self.contact(free) is not None:
            free = {
                name: motion.braked(self.drives[name].at(self.now), self.now, self.hardest[name])
                for name in new
            }
        early, late = self.now, max(self.now, contact.last_free_time)
        for _ in range(HALVINGS):
            middle = 0.5 * (early + late)
            trial = {name: motion.braked(t, middle) for name, t in new.items()}
            if self.contact(trial, since=middle) is None:
                free, early = trial, middle
            else:
                late = middle
        return free

    def _alone(
        self, new: Mapping[str, Trajectory], contact: Contact
    ) -> dict[str, Trajectory] | None:
        """One motor that moves alone, on one trajectory: its last free position is known."""
        if len(new) != 1 or any(name not in new for name in self.ahead()):
            return None
        ((name, planned),) = new.items()
        drive = self.drives[name]
        if planned.start > self.now or (
            len(drive.trajectories) > 1 and planned == drive.ahead(self.now)
        ):
            return None
        current = drive.at(self.now)
        halted = {
            name: motion.move(
                current.position(self.now),
                current.velocity(self.now),
                contact.last_free[name],
                max(planned.top_speed, motion.LEAST_RATE),
                max(
                    planned.acceleration(self.now),
                    current.acceleration(self.now),
                    drive.acceleration,
                ),
                self.now,
            )
        }
        return halted if self.contact(halted) is None else None


def joined_programme(
    drives: Mapping[str, Drive],
    programme: Mapping[str, Sequence[Trajectory]],
    now: float,
    start: Mapping[str, float] | None = None,
) -> dict[str, tuple[Trajectory, ...]]:
    """Per motor the whole of a programme that begins at or after `now`, its wait included.

    Args:
        drives: every motor.
        programme: motor -> trajectories in the order of their starts.
        now: when it is taken over [s].
        start: where motors will stand then; where they are now, if left out [mm, deg].
    """
    stand = {} if start is None else start
    out: dict[str, tuple[Trajectory, ...]] = {
        name: (motion.at_rest(x, now),) for name, x in stand.items()
    }
    for name, trajectories in programme.items():
        if trajectories:
            here = stand.get(name, drives[name].at(now).position(now))
            first = (motion.at_rest(here, now),) if trajectories[0].start > now else ()
            out[name] = (*first, *trajectories)
    return out


def _and(pair: tuple[str, str]) -> str:
    return " and ".join(pair)
