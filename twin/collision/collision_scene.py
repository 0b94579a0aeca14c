"""The collision scene of a machine: bodies on their chains, and the pairs that may not touch.

It is built from the machine's bodies and the sample's pieces (see `stages`) and frozen
afterwards. Pairs that are fixed to each other or allowed to touch are left out. Pairs
that cannot meet at any position within reach (travel limits and a little more) are kept
apart from the rest when they belong to one stage or run at different levels, so that
"least clearance" describes possible contacts and not the construction of the machine.
`relative` and `guard` add time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from flexdt.twin.collision.convex_solids import ConvexSolid
from flexdt.twin.collision.relative import Limits, Path, Separate, path_of
from flexdt.twin.collision.separation import separation_of
from flexdt.twin.collision.stages import Body, sample_bodies, stage_bodies
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.motion.profiles import AxisPath, Trajectory

REACH_SLACK_MM = 10.0
"""Distance beyond the travel limits within which the short list of pairs suffices [mm].

Table 6.1 is outside by up to 9 mm; farther out, every pair is checked.
"""
TOLERANCE_MM = 0.01
"""A gap within this of the margin is a contact [mm]."""
ACCURACY = (0.1, 0.02)
"""Error allowed in the least clearance: [mm], and relative; see `Limits`."""


@dataclass(frozen=True, eq=False)
class SceneParts:
    """Values from which a scene is built; see `build_scene`."""

    machine: Machine
    profile: Profile
    sample: tuple[ConvexSolid, ...]
    parameters: Offsets
    margin_mm: float | None

    @property
    def mounts(self) -> tuple[str, ...]:
        """Motors of stages on the turntable; the scene covers all their positions."""
        geometry = self.machine.geometry
        return tuple(m for q in ("mount_x", "mount_y") for m in geometry.get(q, {}))

    def at(self, positions: Mapping[str, float]) -> CollisionScene:
        """Build the scene with the stages on the turntable (`mounts`) fixed at the
        motors' `positions`.

        Positions of other motors are not used: all their travel stays covered.

        Args:
            positions: motor -> position [mm]; those left out are at home.
        """
        axes = dict(self.machine.axes)
        for name in self.mounts:
            here = positions.get(name, axes[name].home)
            axes[name] = axes[name].model_copy(
                update={"lower": here, "upper": here, "home": here}
            )
        standing = self.machine.model_copy(update={"axes": axes})
        return build_scene(
            standing, self.profile, self.sample, self.parameters, margin_mm=self.margin_mm
        )


@dataclass(frozen=True, eq=False)
class CollisionScene:
    """Bodies of a machine, and the pairs of them that must not touch.

    Attributes:
        axes: motors, in the order of all columns.
        bodies: convex bodies.
        pairs: indices of the bodies that must not touch.
        distant: pairs that cannot touch while every motor stays within `reach`, either
            parts of one stage or always at different levels.
        reach: (axes, 2) lower and upper position for which `distant` holds.
        home: (axes,) positions of motors that a pose leaves out.
        limits: margin, tolerance, accuracy.
        parts: values from which it was built; None for other bodies.
    """

    axes: tuple[str, ...]
    bodies: tuple[Body, ...]
    pairs: tuple[tuple[int, int], ...]
    distant: tuple[tuple[int, int], ...]
    reach: FloatArray
    home: FloatArray
    limits: Limits
    parts: SceneParts | None = None
    _separations: dict[tuple[int, int], Separate] = field(
        default_factory=dict, repr=False
    )
    """Filled on first use. Threads that share a scene may compute one twice.

    That costs only the work: the results are equal, keep no state, and are stored
    complete.
    """

    def separation(self, pair: tuple[int, int]) -> Separate:
        """Return the function that certifies a pair's distance; see `separation_of`.

        `pair`: indices of bodies.
        """
        if pair not in self._separations:
            a, b = (self.bodies[i].solid for i in pair)
            self._separations[pair] = separation_of(a, b)
        return self._separations[pair]

    def names(self, pair: tuple[int, int]) -> tuple[str, str]:
        """Return the names of a pair's components."""
        return self.bodies[pair[0]].name, self.bodies[pair[1]].name

    @cached_property
    def counts(self) -> FloatArray:
        """Units of each motor that move a part by 1 mm or 1 deg, (axes,); 1 for other bodies."""
        if self.parts is None:
            return np.ones(len(self.axes))
        return np.array([self.parts.machine.counts(name) for name in self.axes])

    @cached_property
    def near(self) -> PairStack:
        """`pairs` as arrays."""
        return PairStack.of(len(self.axes), self.bodies, self.pairs)

    @cached_property
    def all(self) -> PairStack:
        """`pairs` and `distant` as arrays."""
        return PairStack.of(len(self.axes), self.bodies, (*self.pairs, *self.distant))

    def candidates(self, lower: FloatArray, upper: FloatArray) -> PairStack:
        """Return the pairs to check while motors stay in [lower, upper]: the near ones, or all
        if a motor may leave `reach`. `lower` and `upper`: positions, (axes,) [mm, deg]."""
        within = (lower >= self.reach[:, 0]).all() and (upper <= self.reach[:, 1]).all()
        return self.near if within else self.all

    def path(
        self, trajectories: Mapping[str, Trajectory], start: float, end: float
    ) -> Path:
        """Make the path of all motors from `start` to `end` [s], from trajectories by
        motor; motors left out stand at home.

        Names that are no motors of the scene are ignored.
        """
        tables = {
            name: AxisPath.along(trajectories[name])
            if name in trajectories
            else AxisPath.standing(home)
            for name, home in zip(self.axes, self.home.tolist(), strict=True)
        }
        return path_of(self.axes, tables, start, end, self.counts)

    def vector(self, positions: Mapping[str, float]) -> FloatArray:
        """Convert positions to (axes,) [mm, deg]; motors left out are at home, other names
        ignored.
        """
        return np.array(
            [
                positions.get(n, h)
                for n, h in zip(self.axes, self.home.tolist(), strict=True)
            ]
        )


@dataclass(frozen=True, eq=False)
class PairStack:
    """Pairs of bodies as arrays, for bounds of many clearances at once.

    Attributes:
        pairs: m pairs of indices of bodies.
        slides: (axes, 3 m) displacement of the first as seen from the second, per unit.
        offset: (m, 3) the same with every motor at zero.
        below: (m, 3) second's upper corner minus first's lower corner.
        above: (m, 3) first's upper corner minus second's lower corner.
        moves: (m, axes) whether a motor changes a pair.
    """

    pairs: tuple[tuple[int, int], ...]
    slides: FloatArray
    offset: FloatArray
    below: FloatArray
    above: FloatArray
    moves: npt.NDArray[np.bool_]

    @classmethod
    def of(
        cls, axes: int, bodies: Sequence[Body], pairs: Sequence[tuple[int, int]]
    ) -> PairStack:
        """Stack pairs of bodies as arrays, for bounds of all their clearances at once.

        For each pair: relative slides, origins and boxes, and which motors move the two
        against each other.

        Args:
            axes: number of motors that move them.
            bodies: all bodies, with slides (axes, 3) and turns (axes,).
            pairs: indices of the two bodies of each pair.
        """
        chosen = [(bodies[i], bodies[j]) for i, j in pairs]
        slides = np.array([a.slides - b.slides for a, b in chosen]).reshape(
            len(pairs), axes, 3
        )
        turns = [
            (a.turns != 0.0) & a.spins | (b.turns != 0.0) & b.spins for a, b in chosen
        ]
        return cls(
            tuple(pairs),
            np.ascontiguousarray(np.moveaxis(slides, 1, 0)).reshape(axes, 3 * len(pairs)),
            np.array([a.origin - b.origin for a, b in chosen]).reshape(-1, 3),
            np.array([b.bounds[1] - a.bounds[0] for a, b in chosen]).reshape(-1, 3),
            np.array([a.bounds[1] - b.bounds[0] for a, b in chosen]).reshape(-1, 3),
            slides.any(axis=2) | np.array(turns, dtype=bool).reshape(len(pairs), axes),
        )

    @cached_property
    def _reach(self) -> FloatArray:
        return np.abs(self.slides)

    def clearances(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        """Compute lower bounds of the clearances [mm] while motors stay within a box,
        (..., m).

        Motors that carry both bodies of a pair cancel; turning bodies count at every
        angle. Bodies are bounded by boxes; where these may overlap it is 0. `lower`,
        `upper`: (..., axes) [mm, deg].
        """
        shape = (*lower.shape[:-1], len(self.pairs), 3)
        middle = (0.5 * (lower + upper) @ self.slides).reshape(shape) + self.offset
        spread = (0.5 * (upper - lower) @ self._reach).reshape(shape)
        distance = np.maximum(middle - self.below, -middle - self.above) - spread
        distance = np.maximum(distance, 0.0)
        return np.asarray(np.sqrt((distance * distance).sum(axis=-1)))


def build_scene(
    machine: Machine,
    profile: Profile,
    sample: Sequence[ConvexSolid] = (),
    parameters: Offsets = NOMINAL,
    *,
    margin_mm: float | None = None,
) -> CollisionScene:
    """Build the scene of a machine with a sample.

    Without components the scene has no bodies and no pairs, a sample or not. Positions up
    to `REACH_SLACK_MM` beyond the travel are covered by the near pairs.

    Args:
        machine: its components, limits, margin.
        profile: zero offsets, so that bodies sit where the X-ray geometry is.
        sample: convex pieces in the object's frame (see `convex_solids.convex_pieces`).
        parameters: the correction in force; bodies are at the places that it gives.
        margin_mm: clearance to keep; None: the machine's `safety_margin_mm`.

    Returns:
        The scene, with `parts` to build it again.
    """
    axes = tuple(machine.axes)
    bodies = stage_bodies(machine, profile, parameters)
    bodies += sample_bodies(machine, profile, sample, parameters)
    if margin_mm is None:
        margin = machine.safety_margin_mm
    else:
        margin = margin_mm
    scene = scene_of(
        axes,
        bodies,
        {frozenset(pair) for pair in machine.allowed_contacts},
        reach=np.array(
            [
                (a.lower - REACH_SLACK_MM, a.upper + REACH_SLACK_MM)
                for a in machine.axes.values()
            ]
        ),
        home=np.array([a.home for a in machine.axes.values()]),
        limits=Limits(margin, TOLERANCE_MM, ACCURACY),
    )
    return replace(
        scene, parts=SceneParts(machine, profile, tuple(sample), parameters, margin_mm)
    )


def scene_of(
    axes: Sequence[str],
    bodies: Sequence[Body],
    allowed: Iterable[frozenset[str]],
    *,
    reach: FloatArray,
    home: FloatArray,
    limits: Limits,
) -> CollisionScene:
    """Build a scene of any bodies: sort their pairs into near, distant and allowed.

    Bodies of one group are no pair, nor are those in `allowed`. Distant pairs are beyond
    margin and tolerance everywhere in reach, and apart by construction: of one stage (or
    with the world), or separated along a coordinate that no motor changes.

    Args:
        axes: motors, in the order of the bodies' columns.
        bodies: all bodies.
        allowed: pairs of names that may touch.
        reach: (axes, 2) lower and upper positions for which pairs may be called distant.
        home: (axes,) positions of motors that a pose leaves out.
        limits: margin, tolerance, accuracy.

    Returns:
        The scene, without `parts`.
    """
    may_touch = set(allowed)
    pairs = [
        (i, j)
        for i in range(len(bodies))
        for j in range(i + 1, len(bodies))
        if bodies[i].group != bodies[j].group
        and frozenset((bodies[i].name, bodies[j].name)) not in may_touch
    ]
    scene = CollisionScene(
        tuple(axes), tuple(bodies), tuple(pairs), (), reach, home, limits
    )
    if not pairs:
        return scene
    least = scene.all.clearances(reach[:, 0], reach[:, 1])
    built_in = [
        _one_stage(bodies[i], bodies[j]) or _levels_apart(bodies[i], bodies[j])
        for i, j in pairs
    ]
    far = (np.array(built_in) & (least > limits.margin + limits.tolerance)).tolist()
    return replace(
        scene,
        pairs=tuple(p for p, f in zip(pairs, far, strict=True) if not f),
        distant=tuple(p for p, f in zip(pairs, far, strict=True) if f),
    )


def _one_stage(a: Body, b: Body) -> bool:
    """Return whether two bodies belong to one stage, or one of them to the world."""
    return a.stage == b.stage or "world" in (a.stage, b.stage)


def _levels_apart(a: Body, b: Body) -> bool:
    """Return whether the bodies' boxes are separated along a coordinate in which no motor
    slides one against the other.

    Touching boxes are not separated.
    """
    fixed = ~(a.slides - b.slides).any(axis=0)
    offset = a.origin - b.origin
    above = offset + a.bounds[0] - b.bounds[1] > 0.0
    below = b.bounds[0] - a.bounds[1] - offset > 0.0
    return bool((fixed & (above | below)).any())
