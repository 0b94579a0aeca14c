"""What the motion that a scanner published did: contacts, limits, speeds, accelerations.

It shares no code with the guard that it watches. It reads the machine file itself (tomllib),
builds its own forward kinematics, recovers the motion from positions and velocities asked of
the scanner (`recover`), and measures distances between the exact shapes: closed forms for
upright boxes, prisms and cylinders, python-fcl for what is tilted, with a second opinion before
anything is reported.

mm, deg and s throughout; angles turn clockwise seen from above. A pose is a row of an array,
its columns are the machine's motors in the order of the file.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import fcl
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Pair = tuple[str, str]
Reading = Mapping[str, float]

ALLOWED_MM = 0.01
"""Parts may be nearer than the machine's margin by so much, all that is asked together."""
FINEST_MM = 0.03
"""Looks at parts near the margin are no further apart than this, in relative motion."""
KNOT_S = 1e-3
"""Changes of acceleration are located to so much; in between the motion is a parabola."""
OVERLAP_MM = 0.5
"""Parts that overlap from the beginning may do so deeper by this much on their way out."""
LONGEST_S = 0.4
"""Asked at least so often: a motion out and back in between cannot hide."""
MACHINES = Path(__file__).parents[1] / "data" / "machines"
SHIPPED = Path(__file__).parents[2] / "twin" / "data"


# Shapes -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Prism:
    """An upright solid: an outline (k, 2), counter-clockwise, or a disc about `centre`."""

    low: float
    high: float
    outline: Array | None = None
    centre: tuple[float, float] = (0.0, 0.0)
    radius: float = 0.0

    @classmethod
    def box(
        cls, size: Sequence[float], centre: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> Prism:
        (x, y, z), (a, b, c) = centre, (0.5 * s for s in size)
        corners = [(x - a, y - b), (x + a, y - b), (x + a, y + b), (x - a, y + b)]
        return cls(z - c, z + c, np.array(corners))

    @classmethod
    def cylinder(cls, diameter: float, height: float, centre: Sequence[float]) -> Prism:
        x, y, z = centre
        return cls(z - 0.5 * height, z + 0.5 * height, None, (x, y), 0.5 * diameter)

    @cached_property
    def reach(self) -> float:
        """Farthest point from the frame's vertical axis."""
        if self.outline is None:
            return math.hypot(*self.centre) + self.radius
        return float(np.hypot(*self.outline.T).max())

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper corner of the box around it, along the axes."""
        if self.outline is None:
            middle = np.array(self.centre)
            lower, upper = middle - self.radius, middle + self.radius
        else:
            lower, upper = self.outline.min(axis=0), self.outline.max(axis=0)
        return np.append(lower, self.low), np.append(upper, self.high)

    def turned(self, degrees: float) -> Prism:
        """Turned counter-clockwise about the frame's vertical axis."""
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        turn = np.array([[c, -s], [s, c]])
        if self.outline is None:
            x, y = turn @ self.centre
            return Prism(self.low, self.high, None, (float(x), float(y)), self.radius)
        return Prism(self.low, self.high, self.outline @ turn.T)

    def moved(self, x: float, y: float, z: float) -> Prism:
        """The same prism, shifted."""
        if self.outline is None:
            at = (self.centre[0] + x, self.centre[1] + y)
            return Prism(self.low + z, self.high + z, None, at, self.radius)
        return Prism(self.low + z, self.high + z, self.outline + [x, y])

    def corners(self, ring: int = 360) -> Array:
        """All corners, the lower ring first.

        Args:
            ring: corners of the polygon around a disc; it lies outside the disc, at 360
                by 4e-5 of the radius.

        Returns:
            (2 k, 3).
        """
        outline = self.outline
        if outline is None:
            angles = 2.0 * np.pi * np.arange(ring) / ring
            around = np.stack([np.cos(angles), np.sin(angles)], axis=1)
            outline = self.radius / math.cos(math.pi / ring) * around + self.centre
        flat = [
            np.column_stack([outline, np.full(len(outline), z)])
            for z in (self.low, self.high)
        ]
        return np.concatenate(flat)


@dataclass(frozen=True, eq=False)
class Hull:
    """The convex hull of `points` (k, 3): what is tilted."""

    points: Array

    @cached_property
    def reach(self) -> float:
        """Farthest point from the frame's origin."""
        return float(np.linalg.norm(self.points, axis=1).max())

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        return self.points.min(axis=0), self.points.max(axis=0)

    @cached_property
    def faces(self) -> npt.NDArray[np.int64]:
        """Triangles of the hull (n, 3), numbers of points, counter-clockwise from
        outside.
        """
        from scipy.spatial import ConvexHull

        found = ConvexHull(self.points)
        faces = found.simplices.copy()
        a, b, c = (self.points[faces[:, k]] for k in range(3))
        inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), found.equations[:, :3]) < 0
        faces[inward] = faces[inward][:, ::-1]
        return faces


Shape = Prism | Hull


@dataclass(frozen=True)
class Placed:
    """A test's own sample: an upright prism, where `sample.set` puts it on the stage.

    Attributes:
        shape: centred as the phantom is; None is an empty stage.
        offset: x, y, z [mm], rx, ry, rz [deg]: turned about x, then y, then z (right-handed),
            then shifted.
    """

    shape: Prism | None = None
    offset: Mapping[str, float] = field(default_factory=dict)


# Machine ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Body:
    """A part on its motors: origin + pose @ slides, turned by pose @ turns about `axle`."""

    name: str
    group: str
    shape: Shape
    origin: Array
    slides: Array
    turns: Array
    axle: Array
    upright: bool

    @property
    def spins(self) -> bool:
        """Whether turning changes where it is: false for a disc about its own axle."""
        if not self.turns.any():
            return False
        centred = isinstance(self.shape, Prism) and self.shape.centre == (0.0, 0.0)
        return not (centred and self.shape.outline is None)


def machine_file(name: str) -> Path:
    """A machine of the tests, or one that ships."""
    own = MACHINES / f"{name}.toml"
    return own if own.exists() else SHIPPED / "machines" / f"{name}.toml"


class MachineModel:
    """A machine file, read anew."""

    def __init__(self, file: Path, profile: Mapping[str, Any] | None = None) -> None:
        """Read a machine file.

        Args:
            file: TOML.
            profile: zero offsets; None for those of the file's default profile, as
                shipped.
        """
        self.file = file
        self.text = file.read_text(encoding="utf-8")
        self.data: dict[str, Any] = tomllib.loads(self.text)
        if profile is None:
            named = SHIPPED / "profiles" / f"{self.data['default_profile']}.toml"
            profile = tomllib.loads(named.read_text(encoding="utf-8"))
        self.profile = profile
        self.motors = tuple(self.data["axes"])
        axes = [self.data["axes"][m] for m in self.motors]
        self.lower, self.upper, self.fastest, self.hardest = (
            np.array([a[key] for a in axes], dtype=float)
            for key in ("lower", "upper", "max_speed", "max_acceleration")
        )
        self.margin = float(self.data.get("safety_margin_mm", 1.0))
        self.virtual: dict[str, dict[str, Any]] = self.data.get("virtual_axes", {})
        self._parts = {part["name"]: part for part in self.data.get("components", [])}

    def turns(self, motor: str) -> bool:
        """Whether a motor turns something."""
        return bool(self.data["axes"][motor].get("kind") == "rotation")

    def along(self, what: str) -> str | None:
        """The motor that moves `object` or `detector` along the beam, if there is one."""
        factors: dict[str, float] = self.data["geometry"].get(f"{what}_y", {})
        return max(factors, key=lambda m: abs(factors[m])) if factors else None

    def vector(self, reading: Reading) -> Array:
        return np.array([reading[m] for m in self.motors])

    def moves(self, axis: str) -> dict[str, float]:
        """Motor -> its share of `axis`."""
        return (
            {axis: 1.0}
            if axis in self.data["axes"]
            else dict(self.virtual[axis]["moves"])
        )

    def _lineage(self, part: Mapping[str, Any] | None) -> list[Mapping[str, Any]]:
        """A part, its parent, and so on; empty for None."""
        out = []
        while part is not None:
            out.append(part)
            part = self._parts.get(part.get("parent", ""))
        return out

    def _quantity(self, name: str, only: set[str] | None = None) -> Array:
        """Change of a quantity of [geometry] per unit of each motor."""
        factors = self.data["geometry"].get(name, {})
        return np.array(
            [
                factors.get(m, 0.0) if only is None or m in only else 0.0
                for m in self.motors
            ]
        )

    def _offset(self, quantity: str, correction: Mapping[str, float]) -> float:
        """Zero offset and correction of a quantity of [geometry]; x, y, z are the
        world's.

        Args:
            quantity: its name, as "object_x".
            correction: values by name; those absent are 0.

        Returns:
            Profile, fixed part and correction together [mm]; 0 for quantities without
            any.
        """
        c = {"dO_x": 0.0, **correction}
        profile = {
            "source_z": "src_ort",
            "object_x": "axs_tan",
            "object_y": "c_obj",
            "detector_x": "det_tan",
            "detector_y": "c_det",
        }
        # Unity's y is the world's z.
        terms = {
            "source_x": ("dS_x",),
            "source_z": ("dS_y",),
            "object_x": ("dO_x", "tau_x"),
            "object_y": ("dO_z", "tau_z"),
            "object_z": ("dO_y",),
            "detector_x": ("dD_x",),
            "detector_y": ("dD_z",),
            "detector_z": ("dD_y",),
        }
        zero = float(self.profile.get(profile.get(quantity, ""), 0.0))
        zero += float(self.data.get("fixed", {}).get(quantity, 0.0))
        return zero + sum(c.get(t, 0.0) for t in terms.get(quantity, ()))

    def bodies(self, sample: Placed, correction: Mapping[str, float]) -> list[Body]:
        """Every part, and the sample."""
        out = [self._part(part, correction) for part in self._parts.values()]
        holder = next(
            (p for p in self._parts.values() if p.get("role") == "sample_holder"), None
        )
        if sample.shape is not None and holder is not None:
            out.append(self._sample(sample, holder, correction))
        return out

    def _mounting(self, part: Mapping[str, Any]) -> tuple[set[str], str]:
        """Motors of a part's chain, and the topmost part that it is rigidly fixed to."""
        line = self._lineage(part)
        motors = {p["axis"] for p in line if p.get("axis")}
        moved = next((p["name"] for p in line if p.get("axis")), "the ground")
        return motors, moved

    def _part(self, part: Mapping[str, Any], correction: Mapping[str, float]) -> Body:
        """Make the body of a part from its table in the file.

        Parts with a role go with the corrected X-ray geometry; others only where their
        motors move them. A turned panel becomes a hull.
        """
        motors, group = self._mounting(part)
        anchor = part.get("anchor", "world")
        slides = np.stack(
            [self._quantity(f"{anchor}_{k}", motors) for k in "xyz"], axis=1
        )
        # What stands for the focal spot, the active area or the sample's holder goes with the
        # X-ray geometry; other parts go where their motors move them.
        goes = bool(part.get("role"))
        origin = np.array(
            [
                self._offset(f"{anchor}_{k}", correction)
                if goes or motors & set(self.data["geometry"].get(f"{anchor}_{k}", {}))
                else 0.0
                for k in "xyz"
            ]
        )
        turns = (
            self._quantity("angle", motors)
            if anchor == "object"
            else np.zeros(len(self.motors))
        )
        size, centre = part["size_mm"], part["center_mm"]
        shape: Shape
        if part.get("shape", "box") == "cylinder":
            shape = Prism.cylinder(size[0], size[2], centre)
        else:
            shape = Prism.box(size, centre)
        if part.get("role") == "panel" and part.get("shape", "box") == "box":
            turn = self._panel_turn(correction)
            if not np.array_equal(turn, np.eye(3)):
                shape = Hull(shape.corners() @ turn.T)
        up = np.array([0.0, 0.0, 1.0])
        return Body(
            part["name"],
            group,
            shape,
            origin,
            slides,
            turns,
            up,
            isinstance(shape, Prism),
        )

    def _panel_turn(self, correction: Mapping[str, float]) -> Array:
        """How the panel is turned: roll of the profile, then yaw about the columns, pitch
        about the rows, roll about the normal, each about the direction already turned.
        """
        u, v = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
        roll = float(self.profile.get("det_roll_deg", 0.0))
        yaw, pitch, more = (
            correction.get(f"det_{k}", 0.0) for k in ("yaw", "pitch", "roll")
        )
        turn = np.eye(3)
        for which, angle in (("n", roll), ("v", yaw), ("u", pitch), ("n", more)):
            about = {"u": turn @ u, "v": turn @ v, "n": np.cross(turn @ u, turn @ v)}[
                which
            ]
            if angle:
                turn = _turn(about, angle) @ turn
        return turn

    def _sample(
        self, sample: Placed, holder: Mapping[str, Any], correction: Mapping[str, float]
    ) -> Body:
        """Make the body of a sample on its holder.

        A point b stands at c + T R(alpha + scale * angle) (b - tau) (docs/coordinates). A
        sample that is tilted becomes a hull, its disc a polygon of 64 corners around it.
        """
        assert sample.shape is not None
        motors, group = self._mounting(holder)
        slides = np.stack([self._quantity(f"object_{k}") for k in "xyz"], axis=1)
        origin = np.array([self._offset(f"object_{k}", correction) for k in "xyz"])
        origin[2] += float(self.data.get("sample_height_mm", 0.0))
        turns = self._quantity("angle", motors) * correction.get("angle_scale", 1.0)
        tau = np.array([correction.get("tau_x", 0.0), correction.get("tau_z", 0.0), 0.0])
        tilt = _turn(
            np.array([0.0, 1.0, 0.0]), correction.get("axis_tilt_z", 0.0)
        ) @ _turn(np.array([1.0, 0.0, 0.0]), correction.get("axis_tilt_x", 0.0))
        alpha = -correction.get("alpha", 0.0)
        o = {
            k: float(sample.offset.get(k, 0.0)) for k in ("x", "y", "z", "rx", "ry", "rz")
        }
        up = np.array([0.0, 0.0, 1.0])
        level = np.array_equal(tilt, np.eye(3))
        if level and o["rx"] == 0.0 and o["ry"] == 0.0:
            shape: Shape = (
                sample.shape.turned(o["rz"])
                .moved(o["x"], o["y"], o["z"])
                .moved(*(-tau))
                .turned(alpha)
            )
            return Body("sample", group, shape, origin, slides, turns, up, True)
        x, y, z = np.eye(3)
        put = _turn(z, o["rz"]) @ _turn(y, o["ry"]) @ _turn(x, o["rx"])
        points = sample.shape.corners(64) @ put.T + [o["x"], o["y"], o["z"]]
        points = (points - tau) @ (tilt @ _turn(up, alpha)).T
        return Body(
            "sample", group, Hull(points), origin, slides, turns, tilt @ up, False
        )


def _turn(axis: Array, degrees: float) -> Array:
    """Right-handed turn about a direction."""
    if degrees == 0.0:
        return np.eye(3)
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    a = math.radians(degrees)
    turned: Array = np.eye(3) + math.sin(a) * k + (1.0 - math.cos(a)) * (k @ k)
    return turned


# Distances --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PairModel:
    """Two bodies and how far apart they are in many poses."""

    a: Body
    b: Body

    @cached_property
    def names(self) -> Pair:
        return self.a.name, self.b.name

    @cached_property
    def plain(self) -> bool:
        """Two boxes along the axes: their clearance is that of intervals."""
        return all(
            isinstance(p.shape, Prism) and p.shape.outline is not None and not p.spins
            and _along_axes(p.shape.outline) for p in (self.a, self.b)
        )  # fmt: skip

    @cached_property
    def swing(self) -> Array:
        """How far a degree of each motor turns a point of either, at most [mm]."""
        out = np.zeros(len(self.a.turns))
        for body in (self.a, self.b):
            if body.spins:
                out = out + np.radians(np.abs(body.turns)) * body.shape.reach
        return out

    @cached_property
    def _extent(self) -> tuple[Array, Array, Array, Array]:
        """For two plain boxes: slides, origin, and the places at which they begin to
        overlap."""
        (a0, a1), (b0, b1) = self.a.shape.bounds, self.b.shape.bounds
        return (
            self.a.slides - self.b.slides,
            self.a.origin - self.b.origin,
            b1 - a0,
            a1 - b0,
        )

    def distances(self, poses: Array) -> Array:
        """(n,): below zero where they overlap (how deep, for upright bodies; else -1)."""
        if self.plain:
            slides, origin, below, above = self._extent
            return interval_gaps(poses @ slides + origin, below, above)
        if self.a.upright and self.b.upright:
            return self._upright(poses)
        return np.array([self._tilted(pose) for pose in poses])

    def _place(self, body: Body, poses: Array) -> Array:
        return body.origin + poses @ body.slides

    def _upright(self, poses: Array) -> Array:
        """Distances of two prisms in poses (n, axes); negative by how far they overlap."""
        a, b = self.a.shape, self.b.shape
        assert isinstance(a, Prism)
        assert isinstance(b, Prism)
        at_a, at_b = self._place(self.a, poses), self._place(self.b, poses)
        dz = np.maximum(at_a[:, 2] + a.low - at_b[:, 2] - b.high,
                        at_b[:, 2] + b.low - at_a[:, 2] - a.high)  # fmt: skip
        flat = _flat(
            _laid(a, at_a[:, :2], poses @ self.a.turns),
            _laid(b, at_b[:, :2], poses @ self.b.turns),
        )
        apart = np.hypot(np.maximum(dz, 0.0), np.maximum(flat, 0.0))
        return np.where(apart > 0.0, apart, np.maximum(dz, flat))

    @cached_property
    def _fcl(self) -> tuple[Any, Any]:
        return _as_fcl(self.a.shape), _as_fcl(self.b.shape)

    def _frame(self, body: Body, pose: Array) -> tuple[Array, Array]:
        turn = _turn(body.axle, -float(pose @ body.turns))
        return turn, body.origin + pose @ body.slides

    def _tilted(self, pose: Array) -> float:
        """Distance of the two bodies in one pose, by fcl; -1 where they touch or overlap."""
        made = []
        for (shape, shift), body in zip(self._fcl, (self.a, self.b), strict=True):
            turn, at = self._frame(body, pose)
            made.append(
                fcl.CollisionObject(shape, fcl.Transform(turn, at + turn @ shift))
            )
        found = fcl.distance(*made, fcl.DistanceRequest(), fcl.DistanceResult())
        return float(found) if found > 0.0 else -1.0

    def second_opinion(self, pose: Array) -> float:
        """The distance in one pose by another method: the nearest points of two hulls, by
        projection.

        Discs count as polygons around them. It is 0 where the hulls overlap.
        """
        points = []
        for body in (self.a, self.b):
            turn, at = self._frame(body, pose)
            corners = (
                body.shape.points
                if isinstance(body.shape, Hull)
                else body.shape.corners()
            )
            points.append(corners @ turn.T + at)
        return hull_distance(*points)


def hull_distance(a: Array, b: Array) -> float:
    """Distance of two convex hulls by Wolfe's least-norm point of a - b.

    Args:
        a, b: corners (n, 3).

    Returns:
        The distance, 0 where they overlap; after 1000 steps the best so far, which is an
        upper bound.
    """
    direction = a.mean(axis=0) - b.mean(axis=0)
    simplex: list[Array] = []

    def support(d: Array) -> Array:
        corner: Array = a[np.argmin(a @ d)] - b[np.argmax(b @ d)]
        return corner

    nearest = support(direction)
    simplex, weights = [nearest], np.array([1.0])
    for _ in range(1000):
        corner = support(nearest)
        if nearest @ nearest - nearest @ corner <= 1e-10 * (1.0 + nearest @ nearest):
            break
        simplex.append(corner)
        weights = np.append(weights, 0.0)
        while True:
            s = np.array(simplex)
            gram = np.block(
                [[s @ s.T, np.ones((len(s), 1))], [np.ones((1, len(s))), 0.0]]
            )
            affine = np.linalg.lstsq(gram, np.append(np.zeros(len(s)), 1.0), rcond=None)[
                0
            ][:-1]
            if (affine > 1e-12).all():
                weights = affine
                break
            falling = affine < 1e-12
            ratios = np.where(
                falling, weights / np.maximum(weights - affine, 1e-300), 1.0
            )
            weights = weights + min(1.0, ratios.min()) * (affine - weights)
            keep = weights > 1e-12
            if keep.all():
                keep[np.argmin(weights)] = False
            simplex = [p for p, k in zip(simplex, keep, strict=True) if k]
            weights = weights[keep] / weights[keep].sum()
            if len(simplex) == 1:
                break
        nearest = weights @ np.array(simplex)
        if nearest @ nearest < 1e-16:
            return 0.0
    return float(np.linalg.norm(nearest))


def _as_fcl(shape: Shape) -> tuple[Any, Array]:
    """A shape for fcl, and where its own centre lies in the body's frame.

    Prisms on outlines other than rectangles along the axes become hulls.
    """
    if isinstance(shape, Hull):
        faces = np.concatenate([np.full((len(shape.faces), 1), 3), shape.faces], axis=1)
        return fcl.Convex(shape.points, len(faces), faces.flatten()), np.zeros(3)
    lower, upper = shape.bounds
    if shape.outline is None:
        return fcl.Cylinder(shape.radius, shape.high - shape.low), 0.5 * (lower + upper)
    if _along_axes(shape.outline):
        return fcl.Box(*(upper - lower)), 0.5 * (lower + upper)
    return _as_fcl(Hull(shape.corners()))


def _along_axes(outline: Array) -> bool:
    edges = np.roll(outline, -1, axis=0) - outline
    return len(outline) == 4 and bool((np.abs(edges).min(axis=1) == 0.0).all())


@dataclass(frozen=True, eq=False)
class _Laid:
    """Outlines in the plane: (n, k, 2) corners, or (n, 2) centres and a radius."""

    points: Array
    radius: float


def _laid(shape: Prism, at: Array, degrees: Array) -> _Laid:
    """A prism's outline in the plane, turned clockwise by `degrees` (n,) and put at `at`
    (n, 2).
    """
    angle = -np.radians(degrees)  # clockwise from above
    c, s = np.cos(angle), np.sin(angle)
    own = np.array([shape.centre]) if shape.outline is None else shape.outline
    x = at[:, :1] + c[:, None] * own[:, 0] - s[:, None] * own[:, 1]
    y = at[:, 1:] + s[:, None] * own[:, 0] + c[:, None] * own[:, 1]
    return _Laid(np.stack([x, y], axis=2), shape.radius)


def _flat(a: _Laid, b: _Laid) -> Array:
    """Distances (n,) of two convex outlines in the plane, negative by how far they
    overlap.
    """
    if a.points.shape[1] == 1 and b.points.shape[1] == 1:
        gap = np.hypot(*(a.points - b.points)[:, 0].T)
    elif a.points.shape[1] == 1 or b.points.shape[1] == 1:
        point, ring = (a, b) if a.points.shape[1] == 1 else (b, a)
        heights = _heights(ring.points, point.points).max(axis=(1, 2))
        gap = np.where(heights > 0.0, _to_edges(point.points, ring.points), heights)
    else:
        over = np.maximum(
            _heights(a.points, b.points).min(axis=2).max(axis=1),
            _heights(b.points, a.points).min(axis=2).max(axis=1),
        )
        edges = np.minimum(_to_edges(a.points, b.points), _to_edges(b.points, a.points))
        gap = np.where(over > 0.0, edges, over)
    return np.asarray(gap - a.radius - b.radius)


def _heights(ring: Array, points: Array) -> Array:
    """Heights of points over the edges of rings, (n, edges, points); inside is negative."""
    edge = np.concatenate([ring[:, 1:], ring[:, :1]], axis=1) - ring
    out = np.stack([edge[..., 1], -edge[..., 0]], axis=2)
    out = out / np.sqrt((out * out).sum(axis=2, keepdims=True))
    gap = (
        np.einsum("nek,npk->nep", out, points)
        - np.einsum("nek,nek->ne", out, ring)[:, :, None]
    )
    return np.asarray(gap)


def _to_edges(points: Array, ring: Array) -> Array:
    """Least distance of any of (n, p, 2) points from any edge of (n, k, 2) rings."""
    edge = np.concatenate([ring[:, 1:], ring[:, :1]], axis=1) - ring
    way = points[:, :, None, :] - ring[:, None, :, :]
    share = (
        np.einsum("npek,nek->npe", way, edge)
        / np.einsum("nek,nek->ne", edge, edge)[:, None]
    )
    foot = way - np.clip(share, 0.0, 1.0)[..., None] * edge[:, None]
    return np.asarray(np.sqrt(np.einsum("npek,npek->npe", foot, foot)).min(axis=(1, 2)))


def interval_gaps(place: Array, below: Array, above: Array) -> Array:
    """Clearances (...) of boxes at relative places (..., 3); negative by how far they
    overlap."""
    gap = np.maximum(place - below, -place - above)
    out = np.maximum(gap, 0.0)
    apart = np.sqrt((out * out).sum(axis=-1))
    return np.asarray(np.where(apart > 0.0, apart, gap.max(axis=-1)))


class Stage:
    """What may not touch what, with one sample and one correction in force."""

    def __init__(
        self,
        machine: MachineModel,
        sample: Placed | None = None,
        correction: Mapping[str, float] | None = None,
    ) -> None:
        """Pair all bodies but those of one group and those whose contact is allowed.

        Args:
            machine: its file.
            sample: None for none.
            correction: values by name; None for none.
        """
        self.machine = machine
        bodies = machine.bodies(sample or Placed(), correction or {})
        allowed = {frozenset(pair) for pair in machine.data.get("allowed_contacts", [])}
        self.pairs = [
            PairModel(a, b)
            for i, a in enumerate(bodies)
            for b in bodies[i + 1 :]
            if a.group != b.group and frozenset((a.name, b.name)) not in allowed
        ]
        self._last: tuple[tuple[bytes, float], Array] | None = None
        if not self.pairs:
            return
        boxes = {id(b): _box_of(b) for b in bodies}
        self._slides = np.array(
            [p.a.slides - p.b.slides for p in self.pairs]
        )  # (p, axes, 3)
        self._origin = np.array([p.a.origin - p.b.origin for p in self.pairs])
        self._below = np.array(
            [boxes[id(p.b)][1] - boxes[id(p.a)][0] for p in self.pairs]
        )
        self._above = np.array(
            [boxes[id(p.a)][1] - boxes[id(p.b)][0] for p in self.pairs]
        )
        self._plain = np.array([p.plain for p in self.pairs])

    def boxes_apart(self, low: Array, high: Array) -> Array:
        """Lower bounds (n, pairs) of clearances, from ranges (n, pairs, 3) of relative
        places."""
        gap = np.maximum(np.maximum(low - self._below, -high - self._above), 0.0)
        return np.asarray(np.sqrt((gap * gap).sum(axis=2)))

    def relative(self, rows: Array) -> Array:
        """(n, axes) to (n, pairs, 3): how first bodies move as seen from second ones."""
        return np.einsum("na,pak->npk", rows, self._slides)

    def clearances(self, pose: Array, exact: float = 5.0) -> Array:
        """Clearances (pairs,) in one pose, negative where pairs overlap.

        The last answer is kept, and given again for the same pose.

        Args:
            pose: positions of the motors.
            exact: pairs whose boxes are nearer than this [mm] are measured; others are
                given by their boxes, which is less than the distance.
        """
        if not self.pairs:
            return np.empty(0)
        if self._last is None or self._last[0] != (pose.tobytes(), exact):
            here = (self.relative(pose[None]) + self._origin)[0]
            out = interval_gaps(here, self._below, self._above)
            for i in np.flatnonzero((out < exact) & ~self._plain).tolist():
                out[i] = self.pairs[i].distances(pose[None])[0]
            self._last = (pose.tobytes(), exact), out
        return self._last[1]

    def least(self, reading: Reading) -> tuple[float, Pair]:
        """Least clearance and the pair."""
        found = self.clearances(self.machine.vector(reading))
        if not len(found):
            return math.inf, ("", "")
        i = int(np.argmin(found))
        return float(found[i]), self.pairs[i].names


def _box_of(body: Body) -> tuple[Array, Array]:
    """Lower and upper corner of the box that holds a body at any angle, about its own
    origin.
    """
    lower, upper = body.shape.bounds
    if not body.spins:
        return lower, upper
    r = body.shape.reach
    if isinstance(body.shape, Prism):
        return np.array([-r, -r, lower[2]]), np.array([r, r, upper[2]])
    return np.full(3, -r), np.full(3, r)


# Motion -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion from the first of `times` to the last: a parabola in each stretch.

    Attributes:
        times: (n,) starts of the stretches.
        lengths: (n,) how long each is.
        x, v, a: (n, axes) at the starts.
        x_end, v_end: (n, axes) at the ends.
        short: (n,) whether it holds a change of acceleration (then it is at most KNOT_S long).
    """

    times: Array
    lengths: Array
    x: Array
    v: Array
    a: Array
    x_end: Array
    v_end: Array
    short: npt.NDArray[np.bool_]

    def poses(self, i: npt.NDArray[np.int64], parts: Array) -> Array:
        """Poses (m, axes) of stretches `i` (m,) at `parts` (m,) of their lengths."""
        t = (parts * self.lengths[i])[:, None]
        return np.asarray(self.x[i] + t * (self.v[i] + 0.5 * t * self.a[i]))


def recover(
    machine: MachineModel,
    positions: Callable[[float], Reading],
    velocities: Callable[[float], Reading],
    start: float,
    end: float,
) -> Motion:
    """The motion between two times, from what the scanner says of single moments.

    A stretch counts as a parabola when positions and velocities in its middle and at its end
    are those of one; else it is halved, until it is KNOT_S long.

    Args:
        machine: whose motors they are.
        positions, velocities: the scanner's, at any time.
        start, end: [s]; `end` is the later one.
    """

    hardest = machine.hardest

    def at(t: float) -> tuple[float, Array, Array]:
        return t, machine.vector(positions(t)), machine.vector(velocities(t))

    longest = max(LONGEST_S, (end - start) / 4000.0)
    count = max(1, math.ceil((end - start) / longest))
    moments = [at(t) for t in np.linspace(start, end, count + 1).tolist()]
    open_ = [(moments[k], moments[k + 1]) for k in reversed(range(count))]
    rows: list[tuple[float, float, Array, Array, Array, Array, Array, bool]] = []
    while open_:
        first, last = open_.pop()
        (t0, x0, v0), (t1, x1, v1) = first, last
        h = t1 - t0
        if h <= 0.0:
            continue
        middle = at(0.5 * (t0 + t1))
        a = (v1 - v0) / h
        slack = 1e-7 + 1e-12 * np.abs(x0) + 4.0 * math.ulp(t1) * (np.abs(v0) + np.abs(v1))
        parabola = (
            (np.abs(middle[1] - x0 - 0.5 * h * (v0 + 0.25 * h * a)) < slack).all()
            and (np.abs(x1 - x0 - 0.5 * h * (v0 + v1)) < slack).all()
            and (
                np.abs(middle[2] - 0.5 * (v0 + v1)) < 1e-6 + 8.0 * math.ulp(t1) * hardest
            ).all()
        )
        if parabola or h <= KNOT_S:
            rows.append((t0, h, x0, v0, a, x1, v1, not parabola))
        else:
            open_ += [(middle, last), (first, middle)]
    return Motion(*(np.array(c) for c in zip(*rows, strict=True)))


@dataclass(frozen=True)
class Violation:
    """Something that must not be.

    Attributes:
        kind: contact, margin, limit, speed, acceleration, jump, state, changed, coupling,
            unrest.
        time: when [s].
        what: a pair, or a motor, with figures.
        amount: by how much.
    """

    kind: str
    time: float
    what: str
    amount: float

    def __str__(self) -> str:
        return f"{self.kind} at {self.time:.6f} s: {self.what}"


class Watch:
    """Follows one scanner from command to command.

    Args:
        stage: what stands there at first.
        reading: where the motors are, so that what begins too near may stay, but not come
            nearer.
    """

    def __init__(self, stage: Stage, reading: Reading) -> None:
        """Begin with a stage, and motors where the reading says."""
        self.least = math.inf
        """Least clearance that was looked at, of pairs that were free [mm]."""
        self._last: tuple[Array, Array] | None = None
        self.put(stage, reading)

    def put(self, stage: Stage, reading: Reading, *, anew: bool = True) -> None:
        """Watch another stage from now on; pairs that are too near there may be so (see
        `begun`).

        Args:
            stage: what stands there.
            reading: where the motors are.
            anew: false if the same parts stand a little elsewhere; then what they may not
                fall below stays.
        """
        kept = (
            {}
            if anew
            else dict(zip((p.names for p in self.stage.pairs), self._floor, strict=True))
        )
        self.stage = stage
        self.machine = stage.machine
        self._floor = np.array([kept.get(p.names, -math.inf) for p in stage.pairs])
        self.begun(reading)

    def rest(self) -> None:
        """Motors were put where they stand (a restart): velocities may have jumped to zero."""
        self._last = None

    def begun(self, reading: Reading) -> None:
        """A command was given: what is too near now may not come nearer; what is free must
        stay."""
        clear = self.stage.clearances(self.machine.vector(reading))
        free = self.machine.margin - ALLOWED_MM
        self._floor = np.maximum(self._floor, np.minimum(free, clear - ALLOWED_MM))

    def too_near(self, reading: Reading) -> list[Pair]:
        """Names of pairs nearer than the margin, by more than ALLOWED_MM.

        Tilted pairs count if the second opinion agrees.
        """
        pose = self.machine.vector(reading)
        near = self.machine.margin - ALLOWED_MM
        clear = self.stage.clearances(pose)
        pairs = [self.stage.pairs[i] for i in np.flatnonzero(clear < near).tolist()]
        return [
            p.names
            for p in pairs
            if (p.a.upright and p.b.upright) or p.second_opinion(pose) < near
        ]

    def look(
        self,
        positions: Callable[[float], Reading],
        velocities: Callable[[float], Reading],
        start: float,
        end: float,
        accelerations: Reading | None = None,
    ) -> list[Violation]:
        """What was wrong with the motion from `start` to `end`.

        Args:
            positions, velocities: the scanner's, at any time.
            start, end: [s]; no command came in between.
            accelerations: motor -> the most its programme may use; the machine's where left
                out.
        """
        if not end > start:
            return []
        motion = recover(self.machine, positions, velocities, start, end)
        joint = self._joined(motion)
        hardest = self.machine.hardest.copy()
        for i, motor in enumerate(self.machine.motors):
            hardest[i] = min(hardest[i], (accelerations or {}).get(motor, math.inf))
        return [*joint, *self._moves(motion, hardest), *self._meets(motion)]

    def _joined(self, m: Motion) -> list[Violation]:
        """Violations at the begin of a motion: jumps in position or velocity since the
        last one's end.

        The end of this motion is remembered for the next.
        """
        out, last = [], self._last
        if last is not None:
            tick = 8.0 * math.ulp(float(m.times[0]))
            for what, before, after, rounding in (
                ("", last[0], m.x[0], tick * self.machine.fastest),
                (" mm/s", last[1], m.v[0], tick * self.machine.hardest),
            ):
                jump = np.abs(after - before)
                for j in np.flatnonzero(jump > 1e-6 + rounding).tolist():
                    said = f"{self.machine.motors[j]} {before[j]:.9f} to {after[j]:.9f}{what}"
                    out.append(Violation("jump", float(m.times[0]), said, float(jump[j])))
        self._last = m.x_end[-1], m.v_end[-1]
        return out

    def _moves(self, m: Motion, hardest: Array) -> list[Violation]:
        """Violations of limits of travel, speed and acceleration, and jumps within a
        motion.

        Args:
            m: the motion, in parabolas.
            hardest: the acceleration allowed for each motor.
        """
        machine, out = self.machine, []

        def report(
            kind: str, over: Array, value: Array, allowed: Array, slack: float
        ) -> None:
            """Add a violation for each motor that is over by more than the slack; the
            worst stretch tells.
            """
            excess = over.max(axis=0)
            for j in np.flatnonzero(excess > slack * (1.0 + np.abs(allowed))).tolist():
                i = int(np.argmax(over[:, j]))
                what = f"{machine.motors[j]} {value[i, j]:.6f}, allowed {allowed[j]:g}"
                out.append(Violation(kind, float(m.times[i]), what, float(excess[j])))

        low, high = _ranges(m)
        tick = 8.0 * np.spacing(m.times + m.lengths)[:, None]
        off = tick * machine.fastest
        report("limit", machine.lower - low - off, low, machine.lower, 1e-7)
        report("limit", high - machine.upper - off, high, machine.upper, 1e-7)
        top = np.maximum(np.abs(m.v), np.abs(m.v_end))
        report(
            "speed",
            top - machine.fastest - tick * machine.hardest,
            top,
            machine.fastest,
            1e-7,
        )
        # A stretch too short for a parabola: its mean acceleration bounds nothing, its mean is
        # one.
        a = np.abs(m.a)
        h = m.lengths[:, None]
        slack = 1e-6 + tick * machine.hardest / h
        report("acceleration", a - hardest - slack, a, hardest, 1e-5)
        drift = 0.25 * machine.hardest * h * h + 1e-6 + tick * machine.fastest
        jump = np.abs(m.x_end - m.x - 0.5 * h * (m.v + m.v_end)) - drift
        report("jump", jump, jump, np.zeros(len(hardest)), 1e-6)
        return out

    def _meets(self, m: Motion) -> list[Violation]:
        """Violations by pairs nearer than they may be: the worst of each pair.

        Tilted pairs count if the second opinion agrees; those that overlap at the start
        may do so by OVERLAP_MM more.
        """
        stage = self.stage
        if not stage.pairs:
            return []
        r0 = stage.relative(m.x) + stage._origin
        r1, r2 = stage.relative(m.v), stage.relative(m.a)
        h = m.lengths[:, None, None]
        low, high = _parabola_range(r0, r1, r2, h)
        bound = stage.boxes_apart(low, high)
        out = []
        near = np.argwhere(
            (bound < self._floor + FINEST_MM) | ((bound <= 0.0) & (self._floor > -99.0))
        )
        by_pair: dict[int, list[int]] = {}
        for i, p in near.tolist():
            by_pair.setdefault(p, []).append(i)
        for p, stretches in by_pair.items():
            worst = self._worst(m, p, stretches)
            if worst is None:
                continue
            depth, time, pose = worst
            floor = float(self._floor[p])
            pair = stage.pairs[p]
            deeper = OVERLAP_MM if floor < 0.0 else 0.0
            if depth >= floor - deeper:
                continue
            if not (pair.a.upright and pair.b.upright):
                depth = pair.second_opinion(pose)
                if depth >= floor or floor < 0.0:
                    continue
            kind = "contact" if depth <= 0.0 else "margin"
            reading = ", ".join(
                f"{k} {x:.4f}"
                for k, x in zip(self.machine.motors, pose.tolist(), strict=True)
            )
            what = f"{' and '.join(pair.names)} {depth:.4f} mm, allowed {floor:.4f}, at {reading}"
            out.append(Violation(kind, time, what, floor - depth))
        return out

    def _worst(
        self, m: Motion, p: int, stretches: list[int]
    ) -> tuple[float, float, Array] | None:
        """Where a pair is nearest, if it may be nearer than its floor.

        Stretches are cut in eight, again and again, until parts move less than FINEST_MM
        a step (four times that if tilted).

        Args:
            m: the motion.
            p: the pair's number in the stage.
            stretches: numbers of the parabolas to look at.

        Returns:
            (distance, time, pose); None of no stretch.
        """
        pair, floor = self.stage.pairs[p], float(self._floor[p])
        slides, swing = pair.a.slides - pair.b.slides, pair.swing
        best: tuple[float, float, Array] | None = None
        fine = FINEST_MM if pair.a.upright and pair.b.upright else 4.0 * FINEST_MM
        k = np.array(stretches)  # the stretch that each step lies in
        low, high = np.zeros(len(k)), np.ones(len(k))
        d_low, d_high = (pair.distances(m.poses(k, parts)) for parts in (low, high))
        while len(low):
            cuts = np.linspace(low, high, 9, axis=1)  # (n, 9)
            within = np.repeat(k, 9)
            poses = m.poses(within, cuts.ravel())
            d = pair.distances(m.poses(np.repeat(k, 7), cuts[:, 1:-1].ravel()))
            grid = np.column_stack([d_low, d.reshape(len(low), 7), d_high])
            j = int(np.argmin(grid))
            if best is None or grid.flat[j] < best[0]:
                time = m.times[within[j]] + cuts.flat[j] * m.lengths[within[j]]
                best = float(grid.flat[j]), float(time), poses[j]
            if best[0] < min(floor, 0.0) - 0.5:
                break
            d_low, d_high = grid[:, :-1].ravel(), grid[:, 1:].ravel()
            low, high = cuts[:, :-1].ravel(), cuts[:, 1:].ravel()
            k = np.repeat(k, 8)
            steps = poses.reshape(len(cuts), 9, -1)
            step = (steps[:, 1:] - steps[:, :-1]).reshape(len(k), -1)
            h = (high - low) * m.lengths[k]
            # A parabola may turn round inside: it strays from the chord by at most a h^2 / 8.
            bow = np.abs(m.a[k]) * (h * h)[:, None] / 8.0
            far = np.sqrt(((step @ slides) ** 2).sum(axis=1)) + np.abs(step) @ swing
            far = far + 2.0 * (bow @ (np.abs(slides).sum(axis=1) + swing))
            doubt = (np.minimum(d_low, d_high) - 0.5 * far < floor) & (far > fine)
            low, high, d_low, d_high, k = (
                c[doubt] for c in (low, high, d_low, d_high, k)
            )
        if best is not None and floor > 0.0:
            self.least = min(self.least, best[0])
        return best


def _ranges(m: Motion) -> tuple[Array, Array]:
    """Least and greatest position in each stretch, (n, axes)."""
    low, high = _parabola_range(m.x, m.v, m.a, m.lengths[:, None])
    ends = np.minimum(m.x, m.x_end), np.maximum(m.x, m.x_end)
    short = m.short[:, None]  # no parabola: its ends are all that is known
    return np.where(short, ends[0], low), np.where(short, ends[1], high)


def _parabola_range(x: Array, v: Array, a: Array, h: Array) -> tuple[Array, Array]:
    """Least and greatest x + v t + a t^2 / 2 for t in 0..h, elementwise."""
    end = x + h * (v + 0.5 * h * a)
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.where(a != 0.0, -v / a, -1.0)
    turn = np.where((turn > 0.0) & (turn < h), turn, 0.0)
    at = x + turn * (v + 0.5 * turn * a)
    return np.minimum(np.minimum(x, end), at), np.maximum(np.maximum(x, end), at)
