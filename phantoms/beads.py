"""Bead phantoms: cuboids of Table 6.2 with beads on a spiral, and the chiral sign-test phantom.

Everything is in the object's frame, centered on the rotation axis at the sample's
reference height. Width is along x, breadth along y, height along z. Beads must be inside
their body.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.phantom import Phantom
from flexdt.twin.attenuation.materials import material
from flexdt.twin.errors import LimitError, UnknownNameError, shape_words
from flexdt.twin.geometry.conventions import FloatArray, from_unity
from flexdt.twin.projection.analytic_solids import Box, Scene, Solid, Sphere, Vector
from flexdt.twin.signatures import called, public

CUBOIDS_MM: Final[Mapping[str, Vector]] = {
    "normal": (20.0, 40.0, 60.0),
    "small": (20.0, 22.0, 40.0),
    "square": (30.0, 30.0, 30.0),
    "tall": (10.0, 15.0, 80.0),
    "wide": (80.0, 80.0, 20.0),
    "compact": (10.0, 15.0, 20.0),
    "coplanar": (40.0, 60.0, 10.0),
}
"""Table 6.2 of the thesis: width, breadth, height [mm]."""

DEFAULT_BEADS: Final = 5
"""Number of beads that the thesis recommends (chapter 7)."""

MAX_BEADS: Final = 10_000
"""Largest number of beads of a phantom."""


def spiral_positions(
    size_mm: Sequence[float], beads: int, radius_mm: float
) -> FloatArray:
    """Compute bead centers on the elliptic spiral that fits a cuboid.

    Beads may overlap.

    The thesis's Unity application computes y_k = (k/(K-1) - 1/2)(H - 2r) at angle
    2 pi k / K on semi-axes W/2 - r (x) and B/2 - r (z); a single bead sits at
    mid-height, angle 0 (the thesis describes the spiral but not its formula: assumed).

    Args:
        size_mm: width (x), breadth (y), height (z) [mm].
        beads: K, 1 to `MAX_BEADS`.
        radius_mm: bead radius [mm].

    Returns:
        (K, 3) [mm], object frame.

    Raises:
        LimitError: another number of beads, a side that is not above 0 and finite, or a
            radius that is not above 0 and at most half the smallest side.

    Example:
        >>> spiral_positions((20.0, 40.0, 60.0), beads=5, radius_mm=2.0).shape
        (5, 3)
    """
    width, breadth, height = (float(s) for s in size_mm)
    if not 1 <= beads <= MAX_BEADS:
        raise LimitError.instead(f"{beads} beads asked", beads, f"1 to {MAX_BEADS}")
    if not 0.0 < min(width, breadth, height) <= max(width, breadth, height) < math.inf:
        message = f"a cuboid of {width:g} x {breadth:g} x {height:g} mm cannot be"
        raise LimitError.instead(
            message, [width, breadth, height], "sides of more than 0 mm"
        )
    if not 0.0 < 2.0 * radius_mm <= min(width, breadth, height):
        raise LimitError(
            f"a bead of radius {radius_mm:g} mm does not fit into {width:g} x {breadth:g} x "
            f"{height:g} mm; allowed: more than 0 and at most "
            f"{min(width, breadth, height) / 2:g}",
            {"asked": radius_mm, "allowed": [0.0, min(width, breadth, height) / 2]},
        )
    k = np.arange(beads, dtype=np.float64)
    if beads > 1:
        y = (k / (beads - 1) - 0.5) * (height - 2.0 * radius_mm)
    else:
        y = np.zeros(1)
    angle = 2.0 * math.pi * k / beads
    unity = np.stack(
        [
            (width / 2 - radius_mm) * np.cos(angle),
            y,
            (breadth / 2 - radius_mm) * np.sin(angle),
        ],
        axis=1,
    )
    return from_unity(unity)


def loop_positions(size_mm: Sequence[float], beads: int, inset_mm: float) -> FloatArray:
    """Compute bead centers on one turn of a rectangular loop inside a cuboid, equally
    spaced in height.

    The layout of the thesis's public code: from (x max, y min) along y min, x min, y max
    and x max, the last bead above the first. A single bead is at the lower end. A side
    shorter than twice the inset counts as 0: then all are in the middle along it. Nothing
    is checked.

    Args:
        size_mm: width (x), breadth (y), height (z) [mm].
        beads: K >= 1.
        inset_mm: of the centers from the faces [mm].

    Returns:
        (K, 3) [mm], object frame.

    Example:
        >>> loop_positions((20.0, 40.0, 60.0), beads=3, inset_mm=3.0)[:, 2].tolist()
        [-27.0, 0.0, 27.0]
    """
    x, y, z = np.maximum(np.asarray(size_mm) / 2.0 - inset_mm, 0.0)
    phase = np.arange(beads) / max(beads - 1, 1)
    ends = np.cumsum([0.0, x, y, x, y]) / (2.0 * (x + y))
    return np.stack(
        [
            np.interp(phase % 1.0, ends, [x, -x, -x, x, x]),
            np.interp(phase % 1.0, ends, [-y, -y, y, y, -y]),
            z * (2.0 * phase - 1.0),
        ],
        axis=1,
    )


@public
@called("phantoms.beads")
def bead_phantom(
    name_or_dims: str | npt.ArrayLike = "normal",
    beads: int = DEFAULT_BEADS,
    *,
    bead_radius_mm: float = 2.0,
    body_material: str = "abs",
    bead_material: str = "steel",
) -> Phantom:
    """Make a cuboid with `beads` beads on the spiral, or beads in air at given positions.

    Overlapping beads of the spiral are allowed; the pair that overlaps most is stated in
    `assumed`. With positions there is no body, and the size is that of the box about the
    origin that holds the beads.

    Args:
        name_or_dims: a name of Table 6.2, (width, breadth, height) [mm], or the beads'
            centers (k, 3) [mm], in the object's frame.
        beads: K; not used with positions.
        bead_radius_mm: 2 mm in the thesis's simulations.
        body_material: of the cuboid (assumed: the thesis does not say); not used with
            positions.
        bead_material: of the beads (assumed: the thesis says "metallic").

    Raises:
        UnknownNameError: a name that Table 6.2 does not have, or an unknown material.
        LimitError: the beads do not fit, see `spiral_positions`, or an array of another
            shape.

    >>> bead_phantom("tall", beads=3).name
    'tall-3'
    >>> bead_phantom([[0, 0, 5], [8, 0, -5]], bead_radius_mm=0.5).beads.shape
    (2, 3)
    """
    if isinstance(name_or_dims, str):
        if name_or_dims not in CUBOIDS_MM:
            message = f"unknown bead cuboid {name_or_dims!r}; Table 6.2 has"
            raise UnknownNameError.among(message, name_or_dims, CUBOIDS_MM)
        name = f"{name_or_dims}-{beads}"
        size = CUBOIDS_MM[name_or_dims]
    else:
        numbers = np.asarray(name_or_dims, dtype=np.float64)
        if numbers.shape[-1:] != (3,) or numbers.ndim > 2 or not numbers.size:
            raise LimitError.instead(
                f"numbers of shape {shape_words(numbers.shape)} in place of a cuboid"
                if numbers.ndim
                else f"{numbers:g} in place of a cuboid",
                list(numbers.shape),
                "the name of a cuboid, its three edges [mm], or the places of beads, "
                "three numbers each [mm]",
            )
        if numbers.ndim == 2:
            many = len(numbers)
            x, y, z = (2.0 * (np.abs(numbers).max(axis=0) + bead_radius_mm)).tolist()
            return cuboid_with_beads(
                f"beads-{many}",
                (x, y, z),
                numbers,
                np.full(many, bead_radius_mm),
                body_material=None,
                bead_materials=(bead_material,) * many,
                description=f"{many} {bead_material} bead(s) of radius {bead_radius_mm:g} mm",
            )
        x, y, z = numbers.tolist()
        size = (x, y, z)
        name = f"cuboid-{size[0]:g}x{size[1]:g}x{size[2]:g}-{beads}"
    assumed: tuple[str, ...] = (
        "the spiral's formula (thesis: in words only)",
        f"body of {body_material} and beads of {bead_material} (thesis: metallic beads)",
    )
    centers = spiral_positions(size, beads, bead_radius_mm)
    radii = np.full(beads, bead_radius_mm)
    overlap = worst_overlap(centers, radii)
    if overlap is not None:
        assumed += (
            f"the spiral makes beads {overlap[0]} and {overlap[1]} overlap by "
            f"{overlap[2]:.3g} mm; "
            "attenuation adds up there",
        )
    return cuboid_with_beads(
        name,
        size,
        centers,
        radii,
        body_material=body_material,
        bead_materials=(bead_material,) * beads,
        description=f"cuboid {size[0]:g} x {size[1]:g} x {size[2]:g} mm of {body_material} with "
        f"{beads} {bead_material} bead(s) of radius {bead_radius_mm:g} mm on a spiral",
        assumed=assumed,
    )


def cuboid_with_beads(
    name: str,
    size_mm: Vector,
    beads: npt.ArrayLike,
    radii_mm: npt.ArrayLike,
    *,
    body_material: str | None,
    bead_materials: Sequence[str],
    description: str,
    assumed: tuple[str, ...] = (),
) -> Phantom:
    """Make a cuboid about the origin (or nothing) with beads anywhere inside it.

    A bead's solid has its material's attenuation less the body's, as attenuation adds up;
    overlaps are not checked.

    `name`: the phantom's name; `size_mm`: width, breadth, height [mm]; `beads`: (k, 3) centers
    [mm]; `radii_mm`: (k,) or one for all [mm]; `body_material`: None leaves the beads in air;
    `bead_materials`: one for each bead; `description`: one line for people; `assumed`: facts
    without a source.
    Raises LimitError: a bead sticks out of the body; names the first. Beads in air are not
    checked; UnknownNameError: an unknown material.
    """
    centers = np.asarray(beads, dtype=np.float64).reshape(-1, 3)
    radii = np.broadcast_to(np.asarray(radii_mm, dtype=np.float64), (len(centers),))
    solids: list[Solid] = []
    surrounding = 0.0
    if body_material is not None:
        _check_inside(centers, radii, size_mm)
        surrounding = material(body_material).mu_per_mm
        solids.append(Solid(Box((0.0, 0.0, 0.0), size_mm), body_material, surrounding))
    for center, radius, bead_material in zip(centers, radii, bead_materials, strict=True):
        mu = material(bead_material).mu_per_mm - surrounding
        x, y, z = (float(c) for c in center)
        solids.append(Solid(Sphere((x, y, z), float(radius)), bead_material, mu))
    return Phantom(
        name, description, Scene(tuple(solids)), size_mm, centers, radii, assumed
    )


def chiral_phantom() -> Phantom:
    """Make four unequal beads at unequal distances along +x, +y, +z and -x: no
    mirror image fits.

    For tests of signs and handedness: the largest bead is along +x, the middle one along
    +y, the small one along +z, the smallest along -x and lower.

    Example:
        >>> chiral_phantom().beads.shape
        (4, 3)
    """
    centers = np.array(
        [[14.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 18.0], [-6.0, 2.0, -9.0]]
    )
    return cuboid_with_beads(
        "chiral",
        (40.0, 34.0, 46.0),
        centers,
        np.array([4.0, 3.0, 2.0, 1.5]),
        body_material="pmma",
        bead_materials=("aluminium",) * 4,
        description="four aluminium beads of radius 4 (+x), 3 (+y), 2 (+z) and 1.5 mm in PMMA; "
        "not equal to any mirror image of itself",
    )


def _check_inside(centers: FloatArray, radii: FloatArray, size_mm: Vector) -> None:
    """Check that every bead is inside the body.

    Each bead with its whole radius, to 1e-9 mm.

    Args:
        centers: (k, 3) [mm].
        radii: (k,) [mm].
        size_mm: of the body, about the origin.

    Raises LimitError: names the first bead that sticks out.
    """
    room = np.asarray(size_mm) / 2.0 - np.abs(centers) - radii[:, None]
    if (room < -1e-9).any():
        i, axis = (int(v) for v in np.argwhere(room < -1e-9)[0])
        place = centers[i].tolist()
        along = "xyz"[axis]
        limit = float(size_mm[axis] / 2 - radii[i])
        raise LimitError(
            f"bead {i} at {place} mm with radius {radii[i]:g} mm sticks out of the body along "
            f"{along}: |{along}| may be at most {limit:g} mm",
            {"bead": i, "asked": place, "allowed": limit},
        )


def worst_overlap(
    centers: FloatArray, radii: FloatArray
) -> tuple[int, int, float] | None:
    """Find the two beads that overlap most.

    The lower index is first; overlaps up to 1e-9 mm do not count.

    Args:
        centers: (k, 3) [mm].
        radii: (k,) [mm].

    Returns:
        Their indices and the overlap [mm]; None if no beads overlap.
    """
    worst: tuple[int, int, float] | None = None
    for i in range(len(centers) - 1):
        gap = (
            np.linalg.norm(centers[i + 1 :] - centers[i], axis=1)
            - radii[i + 1 :]
            - radii[i]
        )
        j = int(np.argmin(gap))
        if gap[j] < -1e-9 and (worst is None or -gap[j] > worst[2]):
            worst = (i, i + 1 + j, float(-gap[j]))
    return worst
