"""A machine's components and its sample as bodies, placed as the X-ray geometry is.

The machine's linear map gives the motors that slide each part; zero offsets of the profile and a
correction in force shift every part along the directions in which its motors move it, so focal
spot, panel and sample sit exactly where `kinematics.poses` and `Poses.cone_vec` put them. Panel and
sample follow a correction's tilts too; the parts that carry them stay upright. `collision_scene`
decides which of the bodies may touch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from flexdt.twin.collision.bodies import DOWN, Body
from flexdt.twin.collision.convex_solids import Cylinder, Polytope, Solid, box
from flexdt.twin.geometry.conventions import (
    COLUMN_DIRECTION,
    ROW_DIRECTION,
    FloatArray,
    from_unity,
    rotation_x,
    rotation_y,
    stage_rotation,
    turn_detector,
)
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.machine.description import Component, Machine, Profile

SAMPLE = "sample"
"""Name of the sample's pieces in pairs."""

_COORDINATES = ("x", "y", "z")


def stage_bodies(machine: Machine, profile: Profile, parameters: Offsets = NOMINAL) -> list[Body]:
    """The components as bodies.

    Args:
        machine: its components and its linear map.
        profile: zero offsets.
        parameters: the correction in force.
    """
    shifts = _shifts(profile, parameters)
    bodies = []
    for part in machine.components:
        origin, slides, turns = _chain(machine, part, shifts)
        solid = _solid(part, profile, parameters)
        group = _group(machine, part)
        bodies.append(Body(part.name, solid, origin, slides, turns, group, part.anchor))
    return bodies


def sample_bodies(
    machine: Machine,
    profile: Profile,
    sample: Sequence[Solid],
    parameters: Offsets = NOMINAL,
) -> list[Body]:
    """The sample's pieces as bodies on the component whose role is `sample_holder`.

    A point b of a piece stands at c + T R(alpha + angle_scale * angle) (b - tau), the map of
    `Poses.cone_vec`.
    """
    holder = next((c for c in machine.components if c.role == "sample_holder"), None)
    if holder is None:
        return []
    p = parameters
    shifts = _shifts(profile, p)
    _, slides, turns = _chain(machine, holder, shifts)
    # All offsets count, as in `Poses.cone_vec`: also where no motor of this machine moves the axis.
    origin = shifts["object"] + np.array([0.0, 0.0, machine.sample_height_mm])
    tilt = rotation_y(p.axis_tilt_z) @ rotation_x(p.axis_tilt_x)
    place = tilt @ stage_rotation(p.alpha)
    tau = from_unity([p.tau_x, 0.0, p.tau_z])
    group = _group(machine, holder)
    return [
        Body(
            SAMPLE,
            _placed(piece, place, tau),
            origin,
            slides,
            p.angle_scale * turns,
            group,
            holder.anchor,
            tilt @ DOWN,
        )
        for piece in sample
    ]


def _shifts(profile: Profile, p: Offsets) -> dict[str, FloatArray]:
    """Offset of each anchor from what the motors read (3,) [mm]."""
    tau = from_unity([p.tau_x, 0.0, p.tau_z])
    return {
        "world": np.zeros(3),
        "source": np.array([0.0, 0.0, profile.src_ort]) + from_unity([p.dS_x, p.dS_y, 0.0]),
        "object": np.array([profile.axs_tan, profile.c_obj, 0.0])
        + from_unity([p.dO_x, p.dO_y, p.dO_z])
        + tau,
        "detector": np.array([profile.det_tan, profile.c_det, 0.0])
        + from_unity([p.dD_x, p.dD_y, p.dD_z]),
    }


def _chain(
    machine: Machine, part: Component, shifts: Mapping[str, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Origin, slides and turns of a component's frame.

    An offset belongs to the motor's reading, so it moves what the motor moves and no more.
    """
    chain = machine.chain(part)
    columns = {name: i for i, name in enumerate(machine.axes)}
    origin = np.zeros(3)
    slides, turns = np.zeros((len(columns), 3)), np.zeros(len(columns))
    for i, coordinate in enumerate(_COORDINATES):
        factors = machine.geometry.get(f"{part.anchor}_{coordinate}", {})
        for motor in chain:
            slides[columns[motor], i] += factors.get(motor, 0.0)
        if any(motor in chain for motor in factors):
            origin[i] = shifts[part.anchor][i]
    if part.anchor == "object":
        for motor in chain:
            factor = machine.geometry.get("angle", {}).get(motor, 0.0)
            turns[columns[motor]] = math.radians(factor)
    return origin, slides, turns


def _solid(part: Component, profile: Profile, p: Offsets) -> Solid:
    if part.shape == "cylinder":
        return Cylinder(part.center_mm, 0.5 * part.size_mm[0], part.size_mm[2])
    solid = box(part.size_mm, part.center_mm)
    turned = profile.det_roll_deg or p.det_yaw or p.det_pitch or p.det_roll
    if part.role == "panel" and turned:
        return Polytope(solid.vertices @ _panel_turn(profile, p).T, solid.faces)
    return solid


def _panel_turn(profile: Profile, p: Offsets) -> FloatArray:
    """The panel's orientation, from the directions of its columns and rows."""
    u, v = turn_detector(COLUMN_DIRECTION, ROW_DIRECTION, 0, 0, math.radians(profile.det_roll_deg))
    u, v = turn_detector(u, v, p.det_yaw, p.det_pitch, p.det_roll)
    upright = np.stack([COLUMN_DIRECTION, ROW_DIRECTION, np.cross(COLUMN_DIRECTION, ROW_DIRECTION)])
    turned: FloatArray = np.stack([u, v, np.cross(u, v)], axis=1) @ upright
    return turned


def _placed(piece: Solid, place: FloatArray, tau: FloatArray) -> Solid:
    """A piece moved by p -> place (p - tau)."""
    if not tau.any() and np.array_equal(place, np.eye(3)):
        return piece
    if isinstance(piece, Cylinder):
        piece = piece.prism()
    if not isinstance(piece, Polytope):
        raise TypeError(f"cannot place a {type(piece).__name__}")
    return Polytope((piece.vertices - tau) @ place.T, piece.faces)


def _group(machine: Machine, part: Component) -> str:
    """The topmost part that `part` is rigidly mounted on."""
    named = {c.name: c for c in machine.components}
    while part.axis is None and part.parent is not None:
        part = named[part.parent]
    return part.name if part.axis is not None else ""
