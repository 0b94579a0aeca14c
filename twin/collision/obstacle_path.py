"""A free path to a target when the direct one collides: other orders of the axes, then a
path around the obstacle.

First all motors at once, then one after the other in any order, then with motors of the
obstructing parts moving aside first (to the ends of their travel, home or the middle;
turns by a quarter). Every proposed move has been swept. The search is a shortest-path
search over such stations and returns the quickest path among them; None means only that
none of those is free.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import assert_never

from flexdt.twin.collision.collision_scene import CollisionScene
from flexdt.twin.collision.first_contact import first_contact, touching
from flexdt.twin.machine.description import Machine
from flexdt.twin.motion import profiles as motion
from flexdt.twin.scanner.safety import Contact

Pace = tuple[float, float]
Station = tuple[float, ...]
Way = tuple[tuple[str, float], ...]

MAX_SWEEPS = 2000
"""Largest number of sweeps of a search; about half a second."""
HALVINGS = 4
"""Bisection steps with which an excursion is shortened."""
ASIDE_TURN_DEG = 90.0
"""Turn of a rotation that moves aside [deg]."""


def free_moves(
    scene: CollisionScene,
    machine: Machine,
    start: Mapping[str, float],
    targets: Mapping[str, float],
    paces: Mapping[str, Pace] | None = None,
) -> tuple[list[dict[str, float]] | None, Contact | None]:
    """Find moves from `start` to `targets` without a contact, each from rest to rest.

    First all motors at once, then one by one, then with obstructing motors aside. Motors
    at their target are not moved.
    `start`, `targets`: motor -> [mm, deg], left out in the former at home; `paces`: motor
    -> (speed, acceleration), default the machine's.
    Returns moves in order, motors of one together; [] if nothing is to move, None if no
    free path was found, or the target touches. The contact is that of all motors moving
    at once, or None.
    """
    search = _Planner(scene, machine, dict(start), dict(paces or {}))
    goal = {axis: value for axis, value in targets.items() if value != search.at(axis)}
    if not goal:
        return [], None
    contact = search.contact({}, goal)
    if touching(scene, {**start, **goal}):
        return None, contact
    if contact is None:
        return [goal], None
    way = search.shortest({axis: [search.at(axis), goal[axis]] for axis in goal}, goal)
    if way is None:
        way = search.shortest(search.stations(goal), goal)
        if way is not None:
            way = search.shortened(way, goal)
    return None if way is None else search.joined(way), contact


@dataclass(eq=False)
class _Planner:
    """One search: counts its sweeps and remembers which parts were obstacles."""

    scene: CollisionScene
    machine: Machine
    start: dict[str, float]
    paces: dict[str, Pace]
    sweeps: int = 0
    blockers: dict[str, None] = field(default_factory=dict)
    known: dict[tuple[object, ...], bool] = field(default_factory=dict)

    def at(self, axis: str) -> float:
        """Return the position of a motor at the start."""
        return self.start.get(axis, self.machine.axes[axis].home)

    def pace(self, axis: str) -> Pace:
        """Return a motor's speed and acceleration: the search's, else the machine's."""
        a = self.machine.axes[axis]
        return self.paces.get(axis, (a.speed, a.acceleration))

    def contact(
        self, moved: Mapping[str, float], step: Mapping[str, float]
    ) -> Contact | None:
        """Sweep one move and count it; remember the bodies that it touches as obstacles.

        All motors of the step start together at rest; others stand.

        Args:
            moved: motor -> position before the move, where it is not that of the start
                [mm, deg].
            step: motor -> target of the move.

        Returns:
            The first contact, or None.
        """
        trajectories = {}
        for axis in self.scene.axes:
            here = moved.get(axis, self.at(axis))
            trajectories[axis] = motion.at_rest(here)
            if axis in step:
                trajectories[axis] = motion.move(
                    here, 0.0, step[axis], *self.pace(axis), 0.0
                )
        self.sweeps += 1
        end = max(t.end for t in trajectories.values())
        contact = first_contact(self.scene, self.scene.path(trajectories, 0.0, end))
        if contact is not None:
            self.blockers.update(dict.fromkeys(contact.pair))
        return contact

    def free(self, moved: Mapping[str, float], axis: str, value: float) -> bool:
        """Return whether one motor's move touches nothing; answers are kept.

        `moved`: positions not of the start [mm, deg].
        """
        key = (tuple(sorted(moved.items())), axis, value)
        if key not in self.known:
            self.known[key] = self.contact(moved, {axis: value}) is None
        return self.known[key]

    def duration(self, axis: str, start: float, end: float) -> float:
        """Compute the time of a move from rest to rest [s]."""
        return motion.move(start, 0.0, end, *self.pace(axis), 0.0).duration

    def stations(self, goal: Mapping[str, float]) -> dict[str, list[float]]:
        """List positions worth a stop for the goal's motors and for all that move a
        blocking body.

        A rotation is tried `ASIDE_TURN_DEG` to each side, within travel; a slide at its
        limits, home and the middle.

        Args:
            goal: motor -> target [mm, deg].

        Returns:
            Motor -> positions without repeats: where it is, its target, then those aside.
        """
        chains = [
            body.slides.any(axis=1) | (body.turns != 0.0)
            for body in self.scene.bodies
            if body.name in self.blockers
        ]
        movable = [
            axis
            for i, axis in enumerate(self.scene.axes)
            if any(chain[i] for chain in chains)
        ]
        out = {}
        for axis in dict.fromkeys([*goal, *movable]):
            a = self.machine.axes[axis]
            here = self.at(axis)
            match a.kind:
                case "linear":
                    aside = [a.lower, a.upper, a.home, 0.5 * (a.lower + a.upper)]
                case "rotation":
                    turns = (here - ASIDE_TURN_DEG, here + ASIDE_TURN_DEG)
                    aside = [x for x in turns if a.lower <= x <= a.upper]
                case _:
                    assert_never(a.kind)
            out[axis] = list(dict.fromkeys([here, goal.get(axis, here), *aside]))
        return out

    def shortest(
        self, stations: Mapping[str, Sequence[float]], goal: Mapping[str, float]
    ) -> list[tuple[str, float]] | None:
        """Search for the quickest free path over stations (A*), one motor at a time.

        The cost is the time of the moves one after the other; `free` is asked only for
        moves that would be an improvement.

        Args:
            stations: motor -> positions that are tried [mm, deg].
            goal: motor -> target [mm, deg]; the others return to where they are.

        Returns:
            (motor, position) in order; None if there is none, or none before the planner
            has made `MAX_SWEEPS` sweeps in all.
        """
        axes = list(stations)
        begin: Station = tuple(self.at(axis) for axis in axes)
        end: Station = tuple(goal.get(axis, self.at(axis)) for axis in axes)

        def left(station: Station) -> float:
            """Compute the least remaining time [s]: each axis directly to its end, one by
            one.
            """
            return sum(
                self.duration(axis, x, y)
                for axis, x, y in zip(axes, station, end, strict=True)
            )

        order = itertools.count()
        queue: list[tuple[float, int, float, Station, Way]] = [
            (left(begin), next(order), 0.0, begin, ())
        ]
        best: dict[Station, float] = {begin: 0.0}
        while queue and self.sweeps < MAX_SWEEPS:
            _, _, cost, station, way = heapq.heappop(queue)
            if station == end:
                return list(way)
            if cost > best[station]:
                continue
            moved = dict(zip(axes, station, strict=True))
            for i, axis in enumerate(axes):
                for value in stations[axis]:
                    following = (*station[:i], value, *station[i + 1 :])
                    total = cost + self.duration(axis, station[i], value)
                    if value == station[i] or total >= best.get(following, float("inf")):
                        continue
                    if self.free(moved, axis, value):
                        best[following] = total
                        step = (*way, (axis, value))
                        estimate = total + left(following)
                        heapq.heappush(
                            queue, (estimate, next(order), total, following, step)
                        )
        return None

    def shortened(
        self, way: list[tuple[str, float]], goal: Mapping[str, float]
    ) -> list[tuple[str, float]]:
        """Shorten the excursions of a path by bisection (`HALVINGS` steps each), as far
        as the whole path stays free.

        One after the other; moves to a motor's goal, or back to its start, stay.

        Args:
            way: (motor, position) in order, free.
            goal: motor -> target [mm, deg]; moves to it are not changed.

        Returns:
            The path with the same motors in the same order.
        """
        for i, (axis, value) in enumerate(way):
            earlier = [v for a, v in way[:i] if a == axis]
            before = earlier[-1] if earlier else self.at(axis)
            if value == goal.get(axis, self.at(axis)):
                continue
            short = 0.0
            long = 1.0
            for _ in range(HALVINGS):
                share = 0.5 * (short + long)
                trial = [
                    *way[:i],
                    (axis, before + share * (value - before)),
                    *way[i + 1 :],
                ]
                if self._all_free(trial):
                    way = trial
                    long = share
                else:
                    short = share
        return way

    def _all_free(self, way: Sequence[tuple[str, float]]) -> bool:
        """Return whether every move of a path (motor, position) is free, made one after
        the other from the start.
        """
        moved: dict[str, float] = {}
        for axis, value in way:
            if not self.free(moved, axis, value):
                return False
            moved[axis] = value
        return True

    def joined(self, way: Sequence[tuple[str, float]]) -> list[dict[str, float]]:
        """Join each move with the one before it where moving together is free as well.

        Two moves of one motor are never joined.

        Args:
            way: (motor, position) in order, free.

        Returns:
            Moves in order, each motor -> position.
        """
        moves: list[dict[str, float]] = []
        moved: dict[str, float] = {}
        for axis, value in way:
            if moves:
                together = {**moves[-1], axis: value}
            else:
                together = {}
            if moves and axis not in moves[-1] and self.contact(moved, together) is None:
                moves[-1] = together
                continue
            if moves:
                moved.update(moves[-1])
            moves.append({axis: value})
        return moves
