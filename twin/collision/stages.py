"""A machine's components and its sample as bodies, placed as the X-ray geometry is.

The machine's linear map gives the motors that slide each part; zero offsets of the
profile and a correction in force shift every part along the directions in which its
motors move it, so focal spot, panel and sample sit exactly where `kinematics.poses` and
`Poses.cone_vec` put them. Panel and sample follow a correction's tilts too; the parts
that carry them stay upright. `collision_scene` decides which of the bodies may touch.

A `Body` is a convex solid carried by motors, as one linear map and at most one turn. The
origin of its frame slides linearly with the motors; the solid turns about a line through
that origin. A body's pose is therefore a closed form of the motor positions, however long
the kinematic chain is. Motors are columns of arrays, in the scene's order and the
script's units (mm, deg).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import assert_never

import numpy as np

from flexdt.twin.collision.convex_solids import (
    ConvexSolid,
    Polytope,
    UprightCylinder,
    box,
    hull,
)
from flexdt.twin.geometry.conventions import (
    COLUMN_DIRECTION,
    COORDINATES,
    ROW_DIRECTION,
    FloatArray,
    from_unity,
    rotation_x,
    rotation_y,
    stage_rotation,
    turn_detector,
)
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.machine.description import SAMPLE, Component, Machine, Profile

DOWN = np.array([0.0, 0.0, -1.0])
"""The stage's axis, so that growing angles turn clockwise seen from above."""
TINY = 1e-300
"""Added to a denominator to keep a quotient finite."""


@dataclass(frozen=True, eq=False)
class Body:
    """A named convex solid on its kinematic chain.

    Attributes:
        name: the component's; pieces of one sample share a name.
        solid: its shape, in the body's frame.
        origin: (3,) world position of the frame's origin with every motor at zero [mm].
        slides: (axes, 3) displacement of the origin per unit of each motor [mm].
        turns: (axes,) turn per unit of each motor [rad].
        spin_axis: (3,) unit direction of the turn.
        group: bodies with the same group are fixed to each other.
        stage: source, object or detector: bodies of different stages are of interest to
            each other even where no travel can bring them together.
    """

    name: str
    solid: ConvexSolid
    origin: FloatArray
    slides: FloatArray
    turns: FloatArray
    group: str
    stage: str
    spin_axis: FloatArray = field(default_factory=DOWN.copy)

    @cached_property
    def reach(self) -> float:
        """Largest distance of a point from the spin axis [mm]; 0 where
        turning changes nothing."""
        if not self.turns.any() or self.solid.is_round(self.spin_axis):
            return 0.0
        return self.solid.radius_about(self.spin_axis)

    @cached_property
    def spins(self) -> bool:
        """Whether its orientation ever matters."""
        return self.reach > 0.0

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Corners of a box about the body's origin, in world directions, that contains
        the solid, (3,) each [mm].

        A spinning body's box contains it at every angle.
        """
        lower, upper = self.solid.bounds()
        if not self.spins:
            return lower, upper
        k = self.spin_axis
        along = sorted((-float(self.solid.support(-k)), float(self.solid.support(k))))
        # A disc of radius `reach` across the axis, swept along it.
        across = self.reach * np.sqrt(np.maximum(0.0, 1.0 - k * k))
        ends = np.outer(along, k)
        return ends.min(axis=0) - across, ends.max(axis=0) + across

    def turn_until(self, toward: FloatArray, allowance: float, sense: float) -> float:
        """Compute a turn that the body can make before its support along `toward` grows
        by `allowance` [rad].

        For a cylinder it follows from its reach alone. One way it is at most half a turn.

        Args:
            toward: (3,) unit direction in the body's turned frame.
            allowance: [mm], > 0.
            sense: of the turn, +1 or -1; 0 for both ways.

        Returns:
            A lower bound of that turn; for both ways huge if it never grows so much.
        """
        if not isinstance(self.solid, Polytope):
            return allowance / self.reach
        # A point moves by sin(d) swing - (1 - cos(d)) inner, so by at most |swing| d + ... d^2 / 2.
        value, side, inner = (self._levers @ toward).reshape(3, -1)
        if sense == 0.0:
            ahead = np.abs(side)
        else:
            ahead = np.maximum(sense * side, 0.0)
        curve = np.maximum(-inner, 0.0)
        room = (allowance + value.max()) - value
        root = ahead + np.sqrt(ahead * ahead + 2.0 * curve * room)
        turn = float((2.0 * room / (root + TINY)).min())
        # A point that moves away comes back after half a turn.
        if sense == 0.0:
            return turn
        return min(turn, math.pi)

    @cached_property
    def _levers(self) -> FloatArray:
        """Points, their velocities about the axis, and their distances from it, stacked
        (3 k, 3).

        k is the number of vertices, 0 for a cylinder. Distances are vectors across the
        axis.
        """
        if isinstance(self.solid, Polytope):
            points = self.solid.vertices
        else:
            points = np.empty((0, 3))
        inner = points - np.outer(points @ self.spin_axis, self.spin_axis)
        return np.concatenate([points, np.cross(self.spin_axis, points), inner])

    @cached_property
    def _rodrigues(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Three (3, 3) matrices of the spin axis: projection on it, projection across it,
        cross product with it.
        """
        x, y, z = self.spin_axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        along = np.outer(self.spin_axis, self.spin_axis)
        return along, np.eye(3) - along, cross

    def rotation(self, angle: float) -> FloatArray:
        """Compute the orientation at spin angle `angle` [rad], (3, 3)."""
        along, across, cross = self._rodrigues
        turned: FloatArray = along + math.cos(angle) * across + math.sin(angle) * cross
        return turned


def stage_bodies(
    machine: Machine, profile: Profile, parameters: Offsets = NOMINAL
) -> list[Body]:
    """Place the components of a machine as bodies, one for each, in their order.

    Args:
        machine: its components and its linear map.
        profile: zero offsets.
        parameters: the correction in force.
    """
    shifts = _shifts(machine, profile, parameters)
    bodies = []
    for part in machine.components:
        origin, slides, turns = _chain(machine, part, shifts)
        solid = _enlarged_by_stage(machine, part, _solid(part, profile, parameters))
        group = _group(machine, part)
        bodies.append(Body(part.name, solid, origin, slides, turns, group, part.anchor))
    return bodies


def sample_bodies(
    machine: Machine,
    profile: Profile,
    sample: Sequence[ConvexSolid],
    parameters: Offsets = NOMINAL,
) -> list[Body]:
    """Place the sample's pieces as bodies on the component whose role is `sample_holder`.

    A point b of a piece is at c + T R(alpha + angle_scale * angle) (b + mount - tau), the
    map of `Poses.cone_vec`; a piece is as large as all that a stage on the turntable can
    sweep with it. All are called `SAMPLE` and are of the holder's group.

    Args:
        machine: whose component holds the sample.
        profile: zero offsets of the machine's motors.
        sample: convex pieces in the sample's frame [mm].
        parameters: the correction in force.

    Returns:
        One body for each piece; none for a machine without a holder.
    """
    holder = next((c for c in machine.components if c.role == "sample_holder"), None)
    if holder is None:
        return []
    p = parameters
    shifts = _shifts(machine, profile, p)
    _, slides, turns = _chain(machine, holder, shifts)
    # All offsets count, as in `Poses.cone_vec`: also where no motor of this machine moves
    # the axis.
    origin = shifts["object"] + np.array([0.0, 0.0, machine.sample_height_mm])
    tilt = rotation_y(p.axis_tilt_z) @ rotation_x(p.axis_tilt_x)
    place = tilt @ stage_rotation(p.alpha)
    tau = from_unity([p.tau_x, 0.0, p.tau_z])
    group = _group(machine, holder)
    return [
        Body(
            SAMPLE,
            _enlarged_by_stage(machine, holder, _placed(piece, place, tau), place),
            origin,
            slides,
            p.angle_scale * turns,
            group,
            holder.anchor,
            tilt @ DOWN,
        )
        for piece in sample
    ]


def _shifts(machine: Machine, profile: Profile, p: Offsets) -> dict[str, FloatArray]:
    """Compute the offset of each anchor from the motors' readings (3,) [mm].

    The anchors are world (0), source, object and detector; the object's contains tau.
    Fixed quantities of the machine are added.

    Args:
        machine: which motors move which anchor.
        profile: zero offsets of its motors.
        p: offsets of the geometry.

    Returns:
        Anchor -> offset (3,) [mm].
    """
    tau = from_unity([p.tau_x, 0.0, p.tau_z])
    shifts = {
        "world": np.zeros(3),
        "source": np.array([0.0, 0.0, profile.src_ort])
        + from_unity([p.dS_x, p.dS_y, 0.0]),
        "object": np.array([profile.axs_tan, profile.c_obj, 0.0])
        + from_unity([p.dO_x, p.dO_y, p.dO_z])
        + tau,
        "detector": np.array([profile.det_tan, profile.c_det, 0.0])
        + from_unity([p.dD_x, p.dD_y, p.dD_z]),
    }
    for quantity, value in machine.fixed.items():
        anchor, _, coordinate = quantity.partition("_")
        if anchor in shifts:
            shifts[anchor][COORDINATES.index(coordinate)] += value
    return shifts


def _enlarged_by_stage(
    machine: Machine,
    part: Component,
    solid: UprightCylinder | Polytope,
    place: FloatArray | None = None,
) -> ConvexSolid:
    """Enlarge `solid` to the hull of all places to which a stage on the turntable brings
    it.

    The stage moves it horizontally by its whole travel, plus the fixed part of `mount_x`
    and `mount_y`.

    Args:
        machine: whose stage it is.
        part: the component, or the holder of a sample.
        solid: in the frame of the turntable.
        place: of a sample, which is on top of every such stage: its turn on the turntable
            (3, 3). None for a component: only the motors that carry it count.

    Returns:
        The hull of all places; `solid` itself where no such stage moves it, or it is not
        at the object.
    """
    if part.anchor != "object":
        return solid
    if place is None:
        carriers = machine.chain(part)
    else:
        carriers = tuple(machine.axes)
    ends = np.zeros((2, 3))
    for i, coordinate in enumerate(COORDINATES[:2]):
        factors = machine.geometry.get(f"mount_{coordinate}", {})
        moved = [motor for motor in factors if motor in carriers]
        if moved or place is not None:
            ends[:, i] = machine.fixed.get(f"mount_{coordinate}", 0.0)
        for motor in moved:
            axis = machine.axes[motor]
            ends[:, i] += sorted(
                (factors[motor] * axis.lower, factors[motor] * axis.upper)
            )
    if not ends.any():
        return solid
    points = (solid.prism() if isinstance(solid, UprightCylinder) else solid).vertices
    corners = np.array([[x, y, 0.0] for x in ends[:, 0] for y in ends[:, 1]])
    if place is not None:
        corners = corners @ place.T
    return hull((points[:, None, :] + corners).reshape(-1, 3))


def _chain(
    machine: Machine, part: Component, shifts: Mapping[str, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute origin, slides and turns of a component's frame.

    Motors that do not carry the part have zero columns; only parts at the object turn.
    The anchor's offset counts along a coordinate that a carrying motor drives or the
    machine fixes, and along all for a part with a role.

    Args:
        machine: axes and components.
        part: the component.
        shifts: anchor -> offset (3,) [mm].

    Returns:
        Origin with every motor at zero (3,) [mm], slides (axes, 3) [mm] and turns (axes,)
        [rad] per unit of each motor.
    """
    chain = machine.chain(part)
    columns = {name: i for i, name in enumerate(machine.axes)}
    origin = np.zeros(3)
    slides = np.zeros((len(columns), 3))
    turns = np.zeros(len(columns))
    for i, coordinate in enumerate(COORDINATES):
        factors = machine.geometry.get(f"{part.anchor}_{coordinate}", {})
        for motor in chain:
            slides[columns[motor], i] += factors.get(motor, 0.0)
        fixed = f"{part.anchor}_{coordinate}" in machine.fixed
        if fixed or part.role or any(motor in chain for motor in factors):
            origin[i] = shifts[part.anchor][i]
    if part.anchor == "object":
        for motor in chain:
            factor = machine.geometry.get("angle", {}).get(motor, 0.0)
            turns[columns[motor]] = math.radians(factor)
    return origin, slides, turns


def _solid(part: Component, profile: Profile, p: Offsets) -> UprightCylinder | Polytope:
    """Make the solid of a component in its own frame [mm]: cylinder, hull of its points,
    or box.

    A panel that is no cylinder is turned by the profile's roll and the offsets' tilts.
    """
    match part.shape:
        case "cylinder":
            return UprightCylinder(part.center_mm, 0.5 * part.size_mm[0], part.size_mm[2])
        case "hull":
            solid = hull(part.points_mm)
        case "box":
            solid = box(part.size_mm, part.center_mm)
        case _:
            assert_never(part.shape)
    turned = profile.det_roll_deg or p.det_yaw or p.det_pitch or p.det_roll
    if part.role == "panel" and turned:
        return Polytope(solid.vertices @ _panel_turn(profile, p).T, solid.faces)
    return solid


def _panel_turn(profile: Profile, p: Offsets) -> FloatArray:
    """Compute the rotation (3, 3) of a panel: the profile's roll, then the offsets' tilts."""
    u, v = turn_detector(
        COLUMN_DIRECTION, ROW_DIRECTION, 0, 0, math.radians(profile.det_roll_deg)
    )
    u, v = turn_detector(u, v, p.det_yaw, p.det_pitch, p.det_roll)
    upright = np.stack(
        [COLUMN_DIRECTION, ROW_DIRECTION, np.cross(COLUMN_DIRECTION, ROW_DIRECTION)]
    )
    turned: FloatArray = np.stack([u, v, np.cross(u, v)], axis=1) @ upright
    return turned


def _placed(
    piece: ConvexSolid, place: FloatArray, tau: FloatArray
) -> UprightCylinder | Polytope:
    """Move a sample's piece by p -> place (p - tau); return it as it is if that changes nothing.

    A moved cylinder becomes a prism around it.

    `piece`: cylinder or polytope [mm]; `place`: (3, 3) rotation; `tau`: (3,) [mm].
    Raises TypeError: another kind of solid.
    """
    if not isinstance(piece, (UprightCylinder, Polytope)):
        raise TypeError(f"cannot place a {type(piece).__name__}")
    if not tau.any() and np.array_equal(place, np.eye(3)):
        return piece
    if isinstance(piece, UprightCylinder):
        piece = piece.prism()
    return Polytope((piece.vertices - tau) @ place.T, piece.faces)


def _group(machine: Machine, part: Component) -> str:
    """Return the name of the first part, from `part` up its parents, that a motor moves;
    "" if none does.

    Parts of one group are fixed to each other."""
    named = {c.name: c for c in machine.components}
    while part.axis is None and part.parent is not None:
        part = named[part.parent]
    return part.name if part.axis is not None else ""
