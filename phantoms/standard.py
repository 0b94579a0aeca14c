"""Phantoms of the field, of balls whose carrier shows no edge: two rings, helix, plate and bar.

Two rings (Cho et al., Medical Physics 32 (2005) 968), a ball plate and an upright bar look alike
in several ways on a turntable: a calibration then tells axis and magnification but not how they
stand, unless one ball is odd. A helix and a leaning bar look alike in one way only.
"""

from __future__ import annotations

import math

import numpy as np

from flexdt.phantoms.beads import cuboid_with_beads
from flexdt.phantoms.phantom import Phantom
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.signatures import public

RUBY = "Al2O3@3.99"
CARRIER = ("a carrier that shows no edge (foam or a thin tube) is left out",)


@public
def two_rings(
    balls: int = 12,
    radius_mm: float = 20.0,
    apart_mm: float = 30.0,
    *,
    ball_radius_mm: float = 1.0,
    odd_radius_mm: float | None = None,
    material: str = "steel",
) -> Phantom:
    """Make two rings of balls about the z axis, one above the other.

    Args:
        balls: of each ring, 3 or more.
        radius_mm: of the rings [mm].
        apart_mm: distance of their planes [mm].
        ball_radius_mm: of the balls [mm].
        odd_radius_mm: of the first ball of the lower ring, which tells how the phantom stands;
            None: as the others.
        material: of the balls.

    Raises:
        LimitError: fewer balls, or they overlap.

    Example:
        >>> two_rings().beads.shape, two_rings(odd_radius_mm=2.0).bead_radius_mm.max()
        ((24, 3), np.float64(2.0))
    """
    if balls < 3:
        raise LimitError.instead(f"{balls} balls in a ring", balls, "3 or more")
    turn = 2.0 * math.pi * np.arange(balls) / balls
    ring = radius_mm * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    up = np.array([0.0, 0.0, apart_mm / 2.0])
    about = f"two rings of {balls} balls, radius {radius_mm:g} mm, {apart_mm:g} mm apart"
    centres = np.concatenate([ring - up, ring + up])
    return _of_balls("two-rings", about, centres, ball_radius_mm, material, odd_radius_mm)


@public
def ball_helix(
    balls: int = 16,
    radius_mm: float = 18.0,
    height_mm: float = 44.0,
    turns: float = 1.5,
    *,
    ball_radius_mm: float = 1.0,
    material: str = "steel",
) -> Phantom:
    """Make balls on a right-handed helix about the z axis.

    Args:
        balls: 4 or more.
        radius_mm, height_mm: of the helix, through the balls' middles [mm].
        turns: from the lowest to the highest ball.
        ball_radius_mm: of the balls [mm].
        material: of the balls.

    Raises:
        LimitError: fewer balls, or they overlap.

    Example:
        >>> ball_helix().beads[[0, -1], 2]
        array([-22.,  22.])
    """
    if balls < 4:
        raise LimitError.instead(f"{balls} balls on a helix", balls, "4 or more")
    part = np.linspace(0.0, 1.0, balls)
    turn = 2.0 * math.pi * turns * part
    centres = np.stack(
        [
            radius_mm * np.cos(turn),
            radius_mm * np.sin(turn),
            height_mm * (part - 0.5),
        ],
        axis=1,
    )
    about = f"{balls} balls on a helix of {turns:g} turns, {height_mm:g} mm high"
    return _of_balls("helix", about, centres, ball_radius_mm, material)


@public
def ball_plate(
    balls: int = 5,
    pitch_mm: float = 9.0,
    *,
    ball_radius_mm: float = 1.0,
    odd_radius_mm: float | None = None,
    material: str = RUBY,
) -> Phantom:
    """Make an upright square plate of balls in the plane of x and z.

    Args:
        balls: along a side, 2 or more.
        pitch_mm: distance between neighboring balls [mm].
        ball_radius_mm: of the balls [mm].
        odd_radius_mm: of the ball in a lower corner, which tells how the phantom stands; None: as
            the others.
        material: of the balls.

    Raises:
        LimitError: fewer balls, or they overlap.

    Example:
        >>> ball_plate().beads.shape
        (25, 3)
    """
    if balls < 2:
        raise LimitError.instead(f"{balls} balls along a side", balls, "2 or more")
    side = pitch_mm * (np.arange(balls) - (balls - 1) / 2.0)
    centres = np.array([[x, 0.0, z] for z in side for x in side])
    about = f"plate of {balls} x {balls} balls, {pitch_mm:g} mm from each other"
    return _of_balls(
        "ball-plate", about, centres, ball_radius_mm, material, odd_radius_mm
    )


@public
def ball_bar(
    balls: int = 5,
    pitch_mm: float = 9.0,
    lean_deg: float = 20.0,
    *,
    ball_radius_mm: float = 1.0,
    material: str = RUBY,
) -> Phantom:
    """Make balls on a line through the origin that leans from z towards x.

    Args:
        balls: 3 or more.
        pitch_mm: distance between neighboring balls [mm].
        lean_deg: of the bar; 0: upright, so that it looks alike at every angle.
        ball_radius_mm: of the balls [mm].
        material: of the balls.

    Raises:
        LimitError: fewer balls, or they overlap.

    Example:
        >>> ball_bar(3, 10.0, lean_deg=0.0).beads[:, 2]
        array([-10.,   0.,  10.])
    """
    if balls < 3:
        raise LimitError.instead(f"{balls} balls on a bar", balls, "3 or more")
    along = pitch_mm * (np.arange(balls) - (balls - 1) / 2.0)
    lean = math.radians(lean_deg)
    centres = np.outer(along, [math.sin(lean), 0.0, math.cos(lean)])
    about = (
        f"bar of {balls} balls, {pitch_mm:g} mm from each other, leaning {lean_deg:g} deg"
    )
    return _of_balls("ball-bar", about, centres, ball_radius_mm, material)


def _of_balls(
    name: str,
    about: str,
    centres: FloatArray,
    radius_mm: float,
    material: str,
    odd_radius_mm: float | None = None,
) -> Phantom:
    """Make a phantom of balls without a body; the first ball may have another radius.

    Raises:
        LimitError: balls overlap.
    """
    radii = np.full(len(centres), radius_mm)
    if odd_radius_mm is not None:
        radii[0] = odd_radius_mm
        about += f", the first of radius {odd_radius_mm:g} mm"
    gap = np.linalg.norm(centres[:, None] - centres, axis=2) - radii[:, None] - radii
    np.fill_diagonal(gap, math.inf)
    if gap.min() < 0.0:
        raise LimitError(
            f"balls of {name} overlap by {-gap.min():.3g} mm; allowed: 0",
            {"asked": float(gap.min()), "allowed": 0.0},
        )
    x, y, z = (2.0 * (np.abs(centres).max(axis=0) + radii.max())).tolist()
    return cuboid_with_beads(
        name, (x, y, z), centres, radii, body_material=None,
        bead_materials=(material,) * len(centres),
        description=f"{about}, {material}, radius {radius_mm:g} mm", assumed=CARRIER,
    )  # fmt: skip
