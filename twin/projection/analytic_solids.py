"""Analytic solids with exact chords, as frozen values: the parts of a phantom.

Attenuation is additive: a scene's line integral is the sum over its solids of chord length times
`mu_per_mm`, so a bead inside a brick carries the difference (bead minus brick) and a hole carries
minus the surrounding. Coordinates are in the object's frame, mm. `analytic` computes the chords.
"""

from __future__ import annotations

from dataclasses import dataclass

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Sphere:
    """Ball of `radius` [mm] about `center` [mm]."""

    center: Vector
    radius: float


@dataclass(frozen=True)
class Box:
    """Cuboid of full `size` [mm] about `center`; rows of `axes` are its edge directions."""

    center: Vector
    size: Vector
    axes: Matrix = IDENTITY


@dataclass(frozen=True)
class Cylinder:
    """Finite circular cylinder: `center` [mm], unit `axis`, `radius` and full `height` [mm]."""

    center: Vector
    radius: float
    height: float
    axis: Vector = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Ellipsoid:
    """Ellipsoid with `semi_axes` [mm] about `center`; rows of `axes` are their directions."""

    center: Vector
    semi_axes: Vector
    axes: Matrix = IDENTITY


@dataclass(frozen=True)
class ConvexPolyhedron:
    """Intersection of half-spaces n . p <= d: `normals` (unit) and `offsets` [mm]."""

    normals: tuple[Vector, ...]
    offsets: tuple[float, ...]


Shape = Sphere | Box | Cylinder | Ellipsoid | ConvexPolyhedron


@dataclass(frozen=True)
class Solid:
    """A shape filled with `material`, whose attenuation adds `mu_per_mm` [1/mm] (may be < 0)."""

    shape: Shape
    material: str
    mu_per_mm: float


@dataclass(frozen=True)
class Scene:
    """Solids whose line integrals add up."""

    solids: tuple[Solid, ...]
