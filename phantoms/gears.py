"""A printed gear with its pinion: a sample without metal, for a first scan.

Both have teeth that slant one way and back, so that no slice is like the next one, and the rim
has pores that only a volume shows. Its measures are this project's own, not a real part's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.phantom import Phantom
from flexdt.phantoms.pieces import Surface, size_about_origin
from flexdt.twin.attenuation.materials import Material, material
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.analytic_solids import Cylinder, Ellipsoid, Scene, Solid

GEAR_MATERIAL: Final = "abs"
BORE_RADIUS_MM: Final = 3.0
"""Of the hole along the axis."""
GEAR_TEETH: Final = 20
PINION_TEETH: Final = 10
GEAR_RADII_MM: Final = (17.0, 20.0)
"""Of the gear's teeth, at their foot and tip."""
PINION_RADII_MM: Final = (8.5, 11.0)
"""Of the pinion's teeth, at their foot and tip."""
LEVELS_MM: Final = (-15.0, -1.0, 15.0)
"""Bottom of the gear, its top where the pinion begins, top of the pinion."""
SLANT_DEG: Final = (9.0, 18.0)
"""By which teeth are turned at half their height: of the gear, of the pinion."""
STEPS_PER_TOOTH: Final = 8
"""Corners of a ring for each of the gear's teeth."""
RINGS_A_HALF: Final = 6
"""Rings in each half of a gear's height."""
WINDOW_COUNT: Final = 6
"""Number of holes through the gear."""
WINDOW_RADIUS_MM: Final = 2.4
WINDOW_PLACE_MM: Final = 12.6
"""Distance of a hole's middle from the axis."""
PORES_MM: Final = (
    (15.6, 20.0, -6.0, 0.9),
    (15.4, 140.0, -10.5, 0.7),
    (15.6, 262.0, -8.0, 1.1),
    (6.2, 75.0, 8.0, 0.9),
    (6.0, 205.0, 3.0, 0.7),
)
"""Voids: distance from the axis [mm], angle [deg], height [mm], radius [mm]."""

Ring = FloatArray


def gear_phantom() -> Phantom:
    """Build the gear and its pinion: 40 x 40 x 30 mm about the origin.

    The body is one closed surface; windows and pores are negative solids in it. All
    measures are assumed.

    >>> gear_phantom().size_mm
    (40.0, 40.0, 30.0)
    """
    plastic = material(GEAR_MATERIAL)
    rings = [
        *_teeth(GEAR_TEETH, GEAR_RADII_MM, LEVELS_MM[:2], SLANT_DEG[0]),
        *_teeth(PINION_TEETH, PINION_RADII_MM, LEVELS_MM[1:], SLANT_DEG[1]),
    ]
    inner = [_circle(level) for level in (LEVELS_MM[2], LEVELS_MM[0])]
    vertices, faces = _closed([*rings, *inner])
    body = Surface(vertices, faces, plastic.name, plastic.mu_per_mm)
    return Phantom(
        "gear",
        f"gear of {GEAR_TEETH} teeth with a pinion of {PINION_TEETH}, printed of "
        f"{plastic.name}, "
        f"with {len(PORES_MM)} pores",
        Scene(tuple(_holes(plastic))),
        size_about_origin(Scene(()), [body]),
        surfaces=(body,),
        assumed=(
            "all measures: no real part's",
            f"teeth of {STEPS_PER_TOOTH} flat pieces a tooth stand for round forms",
        ),
    )


def _holes(plastic: Material) -> list[Solid]:
    """Make the gear's holes as solids of the plastic's negative attenuation: windows,
    then pores.

    Windows are cylinders through the whole height, pores are balls.
    """
    bottom, top, _ = LEVELS_MM
    shapes: list[Cylinder | Ellipsoid] = []
    for k in range(WINDOW_COUNT):
        x, y = _polar(WINDOW_PLACE_MM, 360.0 * k / WINDOW_COUNT)
        middle = (x, y, 0.5 * (bottom + top))
        shapes.append(Cylinder(middle, WINDOW_RADIUS_MM, top - bottom))
    for away, angle, height, radius in PORES_MM:
        x, y = _polar(away, angle)
        shapes.append(Ellipsoid((x, y, height), (radius, radius, radius)))
    return [Solid(shape, plastic.name, -plastic.mu_per_mm) for shape in shapes]


def _polar(away: float, angle_deg: float) -> tuple[float, float]:
    """Compute (x, y) of a place at a distance from the axis [mm] and an angle [deg]."""
    angle = math.radians(angle_deg)
    return away * math.cos(angle), away * math.sin(angle)


def _angles() -> FloatArray:
    """Compute the angles of the corners of each ring [rad], evenly over a turn from 0."""
    count = GEAR_TEETH * STEPS_PER_TOOTH
    return np.arange(count) * 2.0 * np.pi / count


def _circle(level_mm: float) -> Ring:
    """Return the points of a ring of the bore at a height, (n, 3) [mm]."""
    angle = _angles()
    flat = np.full(len(angle), level_mm)
    return np.stack(
        [BORE_RADIUS_MM * np.cos(angle), BORE_RADIUS_MM * np.sin(angle), flat], axis=1
    )


def _teeth(
    teeth: int,
    radii_mm: tuple[float, float],
    levels_mm: tuple[float, ...],
    slant_deg: float,
) -> list[Ring]:
    """Compute the rings of a gear's outer surface from its bottom to its top, turned by the
    slant towards the middle.

    The first and last ring are not turned; 2 `RINGS_A_HALF` + 1 rings.

    `teeth`: number of teeth; `radii_mm`: at the teeth's foot and tip; `levels_mm`: bottom and
    top; `slant_deg`: by which the ring at half the height is turned.
    Returns rings (n, 3) [mm], counter-clockwise seen from above.
    """
    foot, tip = radii_mm
    angle = _angles()
    wave = np.clip(1.6 * np.cos(teeth * angle), -1.0, 1.0)
    radius = 0.5 * (foot + tip) + 0.5 * (tip - foot) * wave
    made = []
    for share in np.linspace(0.0, 1.0, 2 * RINGS_A_HALF + 1):
        turn = math.radians(slant_deg) * (1.0 - abs(2.0 * share - 1.0))
        level = levels_mm[0] + share * (levels_mm[1] - levels_mm[0])
        x, y = radius * np.cos(angle + turn), radius * np.sin(angle + turn)
        made.append(np.stack([x, y, np.full(len(angle), level)], axis=1))
    return made


def _closed(rings: Sequence[Ring]) -> tuple[FloatArray, npt.NDArray[np.int32]]:
    """Build a closed surface through rings, each joined to the next and the last to the first.

    All rings have as many points.

    Args:
        rings: (n, 3) each, counter-clockwise seen from above; up outside, down inside.

    Returns vertices (v, 3) [mm] and faces (f, 3), outward.
    """
    n = len(rings[0])
    k = np.arange(n)
    ahead = (k + 1) % n
    faces = []
    for ring in range(len(rings)):
        here = ring * n
        there = (ring + 1) % len(rings) * n
        faces.append(np.stack([here + k, here + ahead, there + ahead], axis=1))
        faces.append(np.stack([here + k, there + ahead, there + k], axis=1))
    return np.concatenate(rings), np.concatenate(faces).astype(np.int32)
