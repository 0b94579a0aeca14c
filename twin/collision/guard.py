"""A whole scene along the motion of all its motors: first contact, least clearance, trace.

Pairs are taken in the order in which their swept boxes could be near, so that most are decided
without computing a distance.

A `SceneGuard` is the look-ahead of the scanner: given where every motor is bound, the first contact
or None. A guard belongs to one scene: another sample, profile or correction is another guard.

Bodies that overlap already (after a restart) may only come apart: a retreat.

A sweep cannot measure how deep two bodies overlap, so every motion that begins in an overlap would
be a contact, a retreat included. Here such a pair is judged by its separation: the gap between the
two bodies across a direction, the widest of all directions, negative for an overlap. Where the
motion begins it is exact, from the faces of the bodies' Minkowski difference; later the same
directions are looked at, standing and turning with either body, which can only make the separation
seem less than it is. As long as it keeps to its floor the motion is a retreat, and from the moment
the pair is free the usual margin applies to it again. All other pairs keep the margin throughout.

Both moments are found by conservative advancement, so that none is stepped over: the separation is
looked at again where it may have fallen to the floor, the distance where it may have grown to what
counts as free.

`check_home` says whether a machine file describes a machine that can stand at home and travel.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from flexdt.twin.collision.collision_scene import CollisionScene, build_scene
from flexdt.twin.collision.convex_solids import ConvexSolid, Polytope, Separation, UprightCylinder
from flexdt.twin.collision.relative import (
    START,
    Limits,
    Moment,
    PairResult,
    Path,
    RelativeMotion,
    Separate,
    refine_pair,
    sweep_pair,
)
from flexdt.twin.collision.stages import Body
from flexdt.twin.errors import MachineFileError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import place
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.scanner.safety import ROUNDING_MM, Contact, floor

Pair = tuple[int, int]


@dataclass(frozen=True)
class NearestPair:
    """The nearest pair of a pose."""

    mm: float
    pair: tuple[str, str] | None


@dataclass(frozen=True)
class SweepResult:
    """What a sweep found.

    Attributes:
        contact: the first, or None.
        min_clearance_mm: least clearance up to the contact of bodies that move relative to each
            other; inf when none do. It occurs in the motion, and no clearance before the contact
            is smaller by more than the scene's accuracy (0.1 mm, or 2 % if that is more).
        nearest: the pair that has it.
        looks: number of distance evaluations.
    """

    contact: Contact | None
    min_clearance_mm: float
    nearest: tuple[str, str] | None
    looks: int = 0


def first_contact(scene: CollisionScene, path: Path) -> Contact | None:
    """The first contact along a path, without its clearances."""
    return PathSearch(scene, path).first_contact(only_contacts=True).contact


@dataclass(frozen=True, eq=False)
class PathSearch:
    """A scene on a path: the pairs that move relative to each other, nearest boxes first."""

    scene: CollisionScene
    path: Path
    _motions: dict[int, RelativeMotion] = field(default_factory=dict, init=False, repr=False)
    """Made when first asked for; a search belongs to the one thread that made it."""

    @cached_property
    def _nearest_first(self) -> tuple[list[Pair], list[float]]:
        lower, upper = self.path.q.min(axis=0), self.path.q.max(axis=0)
        stack = self.scene.candidates(lower, upper)
        bounds = stack.clearances(lower, upper)
        moving = np.asarray((stack.moves & self.path.moving).any(axis=1))
        order = [k for k in np.argsort(bounds, kind="stable").tolist() if moving[k]]
        return [stack.pairs[k] for k in order], bounds[order].tolist()

    @property
    def pairs(self) -> list[Pair]:
        """Indices of the bodies of the pairs that move relative to each other."""
        return self._nearest_first[0]

    @property
    def bounds(self) -> list[float]:
        """Lower bounds of the pairs' clearances on the whole path, ascending [mm]."""
        return self._nearest_first[1]

    def motion(self, k: int) -> RelativeMotion:
        """The relative motion of pair k."""
        if k not in self._motions:
            a, b = (self.scene.bodies[i] for i in self.pairs[k])
            self._motions[k] = RelativeMotion(a, b, self.path)
        return self._motions[k]

    def first_contact(self, *, only_contacts: bool = False) -> SweepResult:
        """The first contact, and the least clearance seen on the way (not refined)."""
        limits = self.scene.limits
        best, nearest, looks = math.inf, None, 0
        first: tuple[float, int, PairResult] | None = None
        for k, bound in enumerate(self.bounds):
            if bound > limits.margin + limits.tolerance and (only_contacts or bound >= best):
                break
            motion = self.motion(k)
            until = math.inf if first is None else first[0]
            if motion.time(START) > until:
                continue
            separate = self.scene.separation(self.pairs[k])
            found = sweep_pair(motion, separate, limits, until=until)
            looks += found.looks
            if found.contact is not None and motion.time(found.contact) < until:
                first = (motion.time(found.contact), k, found)
            if found.least < best:
                best, nearest = found.least, self.scene.names(self.pairs[k])
        if first is None:
            return SweepResult(None, best, nearest, looks=looks)
        contact = self.contact(*first[1:])
        return SweepResult(contact, contact.clearance_mm, contact.pair, looks=looks)

    def refined(self, guess: SweepResult) -> SweepResult:
        """The least clearance of a free path, from a guess."""
        best, nearest, looks = guess.min_clearance_mm, guess.nearest, guess.looks
        for k, bound in enumerate(self.bounds):
            if bound >= best - self.scene.limits.slack(best):
                break
            separate = self.scene.separation(self.pairs[k])
            least, more = refine_pair(self.motion(k), separate, self.scene.limits, best)
            looks += more
            if least < best:
                best, nearest = least, self.scene.names(self.pairs[k])
        return SweepResult(None, best, nearest, looks=looks)

    def contact(self, k: int, found: PairResult) -> Contact:
        """The contact of pair k in the scene's terms."""
        motion = self.motion(k)
        at = START if found.contact is None else found.contact
        time = motion.time(at)
        free = float(self.path.times[0])
        if found.last_free is not None:
            free = motion.time(found.last_free)
        return Contact(
            self.scene.names(self.pairs[k]),
            time,
            self.path.positions(time),
            self.path.positions(free),
            free,
            found.least,
            found.last_free is not None,
        )


def clearance(scene: CollisionScene, positions: Mapping[str, float]) -> NearestPair:
    """The nearest pair of a pose (all pairs that may not touch), clearance 0 for a contact."""
    q = scene.vector(positions)
    stack = scene.candidates(q, q)
    return _nearest(scene, q, stack.pairs, stack.clearances(q, q))


def touching(
    scene: CollisionScene, positions: Mapping[str, float]
) -> list[tuple[tuple[str, str], float]]:
    """Every pair of a pose that is within the margin, with its clearance [mm]."""
    found = bodies_touching(scene, scene.vector(positions))
    return [(scene.names(pair), gap) for pair, gap in found]


def bodies_touching(scene: CollisionScene, q: FloatArray) -> list[tuple[Pair, float]]:
    """Every pair within the margin with the motors at `q` (axes,), with its clearance [mm]."""
    stack = scene.candidates(q, q)
    limit = scene.limits.margin + scene.limits.tolerance
    near = np.flatnonzero(stack.clearances(q, q) <= limit).tolist()
    gaps = [(stack.pairs[k], separation_at(scene, stack.pairs[k], q)) for k in near]
    return [(pair, gap) for pair, gap in gaps if gap <= limit]


def clearance_trace(
    scene: CollisionScene, path: Path, times: Sequence[float] | FloatArray
) -> tuple[tuple[float, float, tuple[str, str] | None], ...]:
    """(time [s], clearance [mm], pair) at each of `times`."""
    if len(times) == 0:
        return ()
    q = path.vectors(np.asarray(times, dtype=np.float64))
    stack = scene.candidates(q.min(axis=0), q.max(axis=0))
    bounds = stack.clearances(q, q)
    nearest = [_nearest(scene, at, stack.pairs, near) for at, near in zip(q, bounds, strict=True)]
    return tuple((float(t), n.mm, n.pair) for t, n in zip(times, nearest, strict=True))


def _nearest(
    scene: CollisionScene, q: FloatArray, pairs: Sequence[Pair], bounds: FloatArray
) -> NearestPair:
    best = NearestPair(math.inf, None)
    for k in np.argsort(bounds, kind="stable").tolist():
        if bounds[k] >= best.mm:
            break
        gap = separation_at(scene, pairs[k], q)
        if gap < best.mm:
            best = NearestPair(gap, scene.names(pairs[k]))
    return best


def separation_at(scene: CollisionScene, pair: Pair, q: FloatArray) -> float:
    """Certified clearance [mm] of a pair with the motors at `q` (axes,); 0 for an overlap."""
    a, b = (scene.bodies[i] for i in pair)
    offset = q @ (a.slides - b.slides) + (a.origin - b.origin)
    turn_a = a.rotation(float(q @ a.turns)) if a.spins else None
    turn_b = b.rotation(float(q @ b.turns)) if b.spins else None
    return scene.separation(pair)(offset, turn_a, turn_b)[0]


GRAZING_MM = 1e-3
"""Pairs this near are judged as overlapping ones: their direction is rounding in a sweep."""
STANDING = 1e-12
"""What rounding makes of an orientation that has not changed."""
MANY = 100
"""Corners of a body beyond which not all of their directions are looked at (a mesh has thousands,
and the directions of a pair grow with the product): some, and the best one, refined."""
REFINEMENTS = 40
"""Halvings of the step in which the direction of a round body's least overlap is looked for."""


def leaving(scene: CollisionScene, path: Path) -> Contact | None:
    """The first contact of a motion that begins with bodies overlapping, or None.

    Args:
        scene: what may touch what.
        path: the motion.
    """
    stuck = [pair for pair, gap in bodies_touching(scene, path.q[0]) if gap <= GRAZING_MM]
    others = first_contact(_without(scene, stuck), path)
    found = [c for pair in stuck if (c := _of_pair(scene, path, pair)) is not None]
    contacts = [*found, *([] if others is None else [others])]
    return min(contacts, key=lambda contact: contact.time, default=None)


def _of_pair(scene: CollisionScene, path: Path, pair: Pair) -> Contact | None:
    """What stops one overlapping pair: coming closer, or touching again once free."""
    a, b = (scene.bodies[i] for i in pair)
    motion, overlap = RelativeMotion(a, b, path), _Overlap.at(a, b, path.q[0])
    deeper = _deeper(motion, overlap, scene.limits.margin)
    until = math.inf if deeper is None else motion.time(deeper[1])
    free = _free_from(motion, scene.separation(pair), scene.limits, until)
    if free is not None:
        alone = replace(scene, pairs=(pair,), distant=())
        return first_contact(alone, path.after(free))
    if deeper is None:
        return None
    last = motion.time(deeper[0])
    here = path.positions(last)
    return Contact(scene.names(pair), until, here, here, last, 0.0, free_before=False)


def _deeper(
    motion: RelativeMotion, overlap: _Overlap, margin: float
) -> tuple[Moment, Moment] | None:
    """When the separation comes down to its floor, after the last look before; None for never."""
    look = motion.look(START, overlap.separate)
    level = floor(look.gap, margin)
    while (at := motion.next_at(look, level)) is not None:
        before, look = look.at, motion.look(at, overlap.separate)
        if look.gap <= level + 0.5 * ROUNDING_MM:
            return before, at
    return None


def _free_from(
    motion: RelativeMotion, separate: Separate, limits: Limits, until: float
) -> float | None:
    """When the two are clear of the margin by twice the tolerance, before `until`; else None [s].

    Where they are not clear by one tolerance, the other one has yet to be travelled, so that every
    look is that far from the one before.
    """
    at: Moment | None = START
    while at is not None and motion.time(at) < until:
        gap = motion.look(at, separate).gap
        if gap > limits.margin + limits.tolerance:
            return motion.time(at)
        at = motion.after_travel(at, limits.margin + 2.0 * limits.tolerance - gap)
    return None


def _without(scene: CollisionScene, pairs: list[Pair]) -> CollisionScene:
    left_out = set(pairs)
    return replace(
        scene,
        pairs=tuple(p for p in scene.pairs if p not in left_out),
        distant=tuple(p for p in scene.distant if p not in left_out),
    )


@dataclass(frozen=True, eq=False)
class _Overlap:
    """Two bodies that overlap at the beginning, and the directions across which they may part.

    Attributes:
        bodies: the two.
        turned: their orientations at the beginning, (3, 3) each.
        directions: (k, 3) unit directions in the world then, from the second to the first.
    """

    bodies: tuple[Body, Body]
    turned: tuple[FloatArray, FloatArray]
    directions: FloatArray

    @classmethod
    def at(cls, a: Body, b: Body, q: FloatArray) -> _Overlap:
        """The overlap with the motors at `q` (axes,)."""
        from scipy.spatial import ConvexHull

        (turn_a, at_a), (turn_b, at_b) = _pose(a, q), _pose(b, q)
        corners_a = _corners(a.solid) @ turn_a.T + (at_a - at_b)
        corners_b = _corners(b.solid) @ turn_b.T
        between = (corners_a[:, None] - corners_b[None]).reshape(-1, 3)
        outward = np.unique(ConvexHull(between).equations[:, :3].round(9), axis=0)
        outward /= np.linalg.norm(outward, axis=1)[:, None]
        overlap = cls((a, b), (turn_a, turn_b), -outward)
        return replace(overlap, directions=np.vstack([overlap.directions, overlap._refined(q)]))

    @cached_property
    def _reach(self) -> tuple[FloatArray, FloatArray]:
        """(k,) each: how far either body reaches across the directions that turn with it [mm]."""
        first, second = (self._reach_of(i, self.directions, self.turned) for i in (0, 1))
        return first, second

    def _reach_of(
        self, i: int, directions: FloatArray, turned: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        towards = directions if i else -directions
        return self.bodies[i].solid.support(towards @ turned[i])

    def separate(
        self, offset: FloatArray, turn_a: FloatArray | None, turn_b: FloatArray | None
    ) -> Separation:
        """Width of the widest slab between them [mm] and its direction, as `relative.Separate`.

        The width is negative for an overlap, and never too large. Looked at are directions that
        turn with either body. How far that body reaches across them does not change, so that one
        of many corners costs no more than another.
        """
        turned = (np.eye(3) if turn_a is None else turn_a, np.eye(3) if turn_b is None else turn_b)
        off = (np.abs(now - then).max() for now, then in zip(turned, self.turned, strict=True))
        turns = max(off) > STANDING
        widest, across = -math.inf, self.directions[0]
        for i in (0, 1) if turns else (0,):
            if turns and _many(self.bodies[1 - i].solid):
                continue
            now = self.directions @ (turned[i] @ self.turned[i].T).T
            other = self._reach_of(1 - i, now, turned) if turns else self._reach[1 - i]
            gaps = now @ offset - self._reach[i] - other
            best = int(np.argmax(gaps))
            if gaps[best] > widest:
                widest, across = float(gaps[best]), now[best]
        return widest, across

    def separation(self, q: FloatArray) -> float:
        """That width with the motors at `q` (axes,) [mm]."""
        (turn_a, at_a), (turn_b, at_b) = (_pose(body, q) for body in self.bodies)
        return self.separate(at_a - at_b, turn_a, turn_b)[0]

    def _refined(self, q: FloatArray) -> FloatArray:
        """(1, 3): the direction of the widest gap, where no faces tell it exactly."""
        (_, at_a), (_, at_b) = (_pose(body, q) for body in self.bodies)

        def gaps(directions: FloatArray) -> FloatArray:
            reach = self._reach_of(0, directions, self.turned)
            return directions @ (at_a - at_b) - reach - self._reach_of(1, directions, self.turned)

        best = self.directions[int(np.argmax(gaps(self.directions)))]
        step = 0.1
        for _ in range(REFINEMENTS):
            around = np.vstack([best, best + step * np.eye(3), best - step * np.eye(3)])
            around /= np.linalg.norm(around, axis=1)[:, None]
            widest = int(np.argmax(gaps(around)))
            best = around[widest]
            step *= 0.7 if widest == 0 else 1.0
        return np.asarray(best[None])


def _pose(body: Body, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    turn = body.rotation(float(q @ body.turns)) if body.spins else np.eye(3)
    return turn, q @ body.slides + body.origin


def _many(solid: ConvexSolid) -> bool:
    return isinstance(solid, Polytope) and len(solid.vertices) > MANY


def _corners(solid: ConvexSolid) -> FloatArray:
    """(k, 3): corners of a body, of one with very many only some."""
    if _many(solid):
        ways = np.random.default_rng(0).normal(size=(MANY, 3))
        return np.unique(solid.farthest(ways), axis=0)
    upright = solid.prism() if isinstance(solid, UprightCylinder) else solid
    assert isinstance(upright, Polytope)
    return upright.vertices


HORIZON = 3600.0
"""A motion without an end (a jog that is held) is looked at so far ahead [s]."""


@dataclass(frozen=True)
class SceneGuard:
    """Sweeps one scene; it keeps nothing between calls, so that threads may share it."""

    scene: CollisionScene

    def __call__(self, trajectories: Mapping[str, Trajectory], now: float) -> Contact | None:
        """The first contact from `now` on; when nothing moves, the nearest pair that touches.

        Args:
            trajectories: motor -> trajectory; motors left out stand at home.
            now: since when [s].
        """
        scene = self.scene
        ends = [t.end if math.isfinite(t.end) else now + HORIZON for t in trajectories.values()]
        path = scene.path(trajectories, now, max([now, *ends]))
        if path.moving.any():
            contact = first_contact(scene, path)
            if contact is None or contact.free_before:
                return contact
            return leaving(scene, path)
        here = path.positions(now)
        near = self.touching(here)
        if not near:
            return None
        pair = min(near, key=lambda names: near[names])
        return Contact(pair, now, here, here, now, near[pair], free_before=False)

    def touching(
        self, positions: Mapping[str, float], *, deep: bool = False
    ) -> dict[tuple[str, str], float]:
        """Pairs of a pose that are within the safety margin, with their clearances [mm].

        Args:
            positions: motor -> position; motors left out stand at home [mm, deg].
            deep: measure overlaps, as negative clearances; it takes some milliseconds a pair.
        """
        scene, q = self.scene, self.scene.vector(positions)
        out: dict[tuple[str, str], float] = {}
        for pair, gap in bodies_touching(scene, q):  # a sample may be several bodies
            if deep and gap <= 0.0:
                a, b = (scene.bodies[i] for i in pair)
                gap = min(0.0, _Overlap.at(a, b, q).separation(q))
            out[scene.names(pair)] = min(gap, out.get(scene.names(pair), math.inf))
        return out


def check_home(machine: Machine, profile: Profile, file: str) -> None:
    """Check that the machine can stand at home: source, sample, panel in order, nothing touching.

    No motor may take the rotation axis or the panel behind the source.

    Args:
        machine: read from `file`.
        profile: its zero offsets.
        file: for the error.

    Raises:
        MachineFileError: file, what is wrong, and where.
    """

    def wrong(what: str, **data: object) -> MachineFileError:
        return MachineFileError(f"{file}: axes: {what}", {"file": file, "path": "axes", **data})

    stage, panel = place(machine, "object_y"), place(machine, "detector_y")
    sod, sdd = stage.home, panel.home
    if not (math.isfinite(sod) and 0.0 < sod < sdd):
        what = f"at home SOD is {sod:g} mm and SDD {sdd:g} mm; allowed: 0 < SOD < SDD"
        more = "(flexdt machine check prints what they are the sum of)"
        raise wrong(f"{what} {more}", sod=sod, sdd=sdd)
    for at, offset in ((stage, profile.c_obj), (panel, profile.c_det)):
        least, most = at.least + offset, at.most + offset
        if least <= 0.0:
            what = f"{at.name} goes from {least:g} to {most:g} mm over the travel ({at.total}; zero"
            more = f"offset {offset:g} mm); allowed: above 0 everywhere, in front of the focal spot"
            raise wrong(f"{what} {more}", asked=[least, most], allowed="> 0")
    found = touching(build_scene(machine, profile), {})
    if found:
        what = f"at home {_pairs(found)}; the safety margin is {machine.safety_margin_mm:g} mm"
        more = (
            "another home, other sizes or places; or say in allowed_contacts that they are mounted"
        )
        raise wrong(f"{what} ({more} on each other)", pairs=[list(pair) for pair, _ in found])


def _pairs(found: Iterable[tuple[tuple[str, str], float]]) -> str:
    return ", ".join(
        f"{a} and {b} {f'are {gap:.3g} mm apart' if gap > 0.0 else 'touch'}"
        for (a, b), gap in found
    )
