"""Beads of a phantom for calibration: positions, sizes, and the tolerance of the positions.

`BeadPhantom` is the protocol that any phantom satisfies; `BeadModel` is the frozen value
that calibration computes with. It has no meshes, and of materials only the contrast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere

LEAST_SPREAD_MM: Final = 1e-6
"""Standard deviation of a bead that is exact where others are not [mm]."""


@runtime_checkable
class BeadPhantom(Protocol):
    """Anything with bead centers (k, 3) [mm, object frame] and bead radii [mm]."""

    @property
    def beads(self) -> FloatArray:
        """Bead centers, (k, 3) [mm]."""

    @property
    def bead_radius_mm(self) -> FloatArray | float:
        """Bead radii, (k,) or one for all [mm]."""


@dataclass(frozen=True)
class Tolerance:
    """How well a phantom is known, as its file states it.

    Attributes:
        source: of the figures, in words, such as a certificate's number.
        bead_mm: standard deviation of each coordinate of each bead [mm], of all or of each;
            None: not stated.
        scale: standard deviation of the phantom's scale [1]; None: not stated.
    """

    source: str
    bead_mm: float | tuple[float, ...] | None = None
    scale: float | None = None

    def __post_init__(self) -> None:
        """Check the figures.

        Raises:
            TwinError: none at all, one that is below 0 or not finite, or no source.
        """
        own = () if self.bead_mm is None else np.ravel(self.bead_mm).tolist()
        figures = [*own, *(() if self.scale is None else (self.scale,))]
        if not figures:
            raise TwinError(
                "a tolerance states nothing; allowed: bead_mm, scale, or both"
            )
        for figure in figures:
            if not 0.0 <= figure < np.inf:
                raise TwinError.instead(
                    f"a tolerance of {figure:g}",
                    figure,
                    "a standard deviation, 0 or more",
                )
        if not self.source.strip():
            raise TwinError(
                "a tolerance without its source; allowed: words, such as a certificate"
            )

    @property
    def typical_mm(self) -> float | None:
        """Root mean square of the beads' standard deviations [mm]; None: not stated."""
        if self.bead_mm is None:
            return None
        return float(np.sqrt(np.mean(np.square(self.bead_mm))))


@dataclass(frozen=True, eq=False)
class BeadModel:
    """The beads of a phantom, read-only float64.

    Attributes:
        beads: centers in the object's frame, (k, 3) [mm].
        bead_radius_mm: (k,) [mm].
        tolerance_mm: standard deviation of each coordinate of each bead about `beads` [mm]; 0
            if the phantom is exact.
        name: for reports.
        contrast: (k,) line integral through each bead's middle above its surroundings;
            None: all are of one material.
        stated: how well the phantom is known by its file; None: it does not say.
    """

    beads: FloatArray
    bead_radius_mm: FloatArray
    tolerance_mm: float = 0.0
    name: str = "phantom"
    contrast: FloatArray | None = None
    stated: Tolerance | None = None

    def __post_init__(self) -> None:
        """Check the beads and store them as read-only arrays, one radius a bead.

        One radius counts for all beads. Contrasts are not checked here.

        Raises:
            TwinError: `beads` is not (k, 3), finite, k >= 1, a radius is not positive, or the
                tolerances are not one for each bead.
        """
        beads = np.array(self.beads, dtype=np.float64, ndmin=2, order="C")
        if beads.shape[1:] != (3,) or len(beads) == 0 or not np.isfinite(beads).all():
            shape = np.shape(self.beads)
            raise TwinError.of_shape("beads", shape, ("k", 3), ", finite, with k >= 1")
        radius = np.broadcast_to(
            np.asarray(self.bead_radius_mm, dtype=np.float64), (len(beads),)
        ).copy()
        if not (radius > 0).all():
            raise TwinError("bead radii must be positive", {"asked": radius.tolist()})
        stated = None if self.stated is None else self.stated.bead_mm
        if isinstance(stated, tuple) and len(stated) != len(beads):
            raise TwinError.of_shape("tolerances of beads", (len(stated),), (len(beads),))
        beads.setflags(write=False)
        radius.setflags(write=False)
        object.__setattr__(self, "beads", beads)
        object.__setattr__(self, "bead_radius_mm", radius)

    def __len__(self) -> int:
        return len(self.beads)

    @property
    def middle(self) -> FloatArray:
        """Mean place of the beads, (3,) [mm]: the point of a phantom that is as its file says,
        whatever its scale and its shape are.

        No image shows another one, and the origin of a file is where somebody drew it."""
        return np.asarray(self.beads.mean(axis=0))

    @property
    def about_middle(self) -> FloatArray:
        """Bead centers from their middle, (k, 3) [mm]."""
        return np.asarray(self.beads - self.middle)

    @property
    def reach(self) -> float:
        """Root mean square distance of the beads from their middle [mm]."""
        return float(np.sqrt((self.about_middle**2).sum(axis=1).mean()))

    @property
    def spreads(self) -> FloatArray:
        """Standard deviation of each bead's coordinates over their root mean square, (k,)."""
        stated = None if self.stated is None else self.stated.bead_mm
        if not isinstance(stated, tuple) or not any(stated):
            return np.ones(len(self))
        spreads = np.asarray(stated, dtype=np.float64)
        rms = float(np.sqrt(np.mean(spreads**2)))
        return np.asarray(np.maximum(spreads, LEAST_SPREAD_MM) / rms, dtype=np.float64)

    @property
    def contrasts(self) -> FloatArray:
        """Contrast of each bead to a common factor, (k,): `contrast`, or the diameters
        without it.
        """
        if self.contrast is None:
            return 2.0 * self.bead_radius_mm
        return self.contrast

    def mirrored(self) -> BeadModel:
        """Return the mirror image (x to -x), as of a model of the wrong handedness."""
        beads = self.beads * np.array([-1.0, 1.0, 1.0])
        return replace(self, beads=beads, name=f"{self.name}, mirrored")

    def turned_over(self) -> BeadModel:
        """Turn the model by 180 deg about x: a phantom upside down."""
        beads = self.beads * np.array([1.0, -1.0, -1.0])
        return replace(self, beads=beads, name=f"{self.name}, upside down")


def bead_model(phantom: BeadPhantom | BeadModel | npt.ArrayLike) -> BeadModel:
    """Make the bead model of a phantom, or of bare bead centers (k, 3) (radius then 1 mm,
    exact).

    A bead model is returned as it is. Of a phantom, tolerances, name and scene are
    optional (not stated, "phantom", none); the scene gives the contrast (`with_contrast`).

    Raises:
        TwinError: no beads, a shape other than (k, 3), a coordinate that is not finite,
            or a radius that is not positive.
    """
    match phantom:
        case BeadModel():
            return phantom
        case BeadPhantom():
            model = BeadModel(
                np.asarray(phantom.beads),
                np.asarray(phantom.bead_radius_mm, dtype=np.float64),
                float(getattr(phantom, "bead_tolerance_mm", 0.0)),
                str(getattr(phantom, "name", "phantom")),
                stated=getattr(phantom, "tolerance", None),
            )
            return with_contrast(model, getattr(phantom, "scene", None))
        case _:
            return BeadModel(np.asarray(phantom, dtype=np.float64), np.array(1.0))


def with_contrast(model: BeadModel, scene: Scene | None) -> BeadModel:
    """Add the contrast that the phantom's solids give each bead: diameter times
    attenuation of the nearest ball.

    Args:
        model: the beads.
        scene: the phantom's solids; None if it has none.

    Returns:
        A copy with contrasts; the model itself if it has some already, if the scene has
        no balls, or if a bead is half its radius or more from the nearest one.
    """
    balls = [
        solid for solid in (scene or Scene(())).solids if isinstance(solid.shape, Sphere)
    ]
    if model.contrast is not None or not balls:
        return model
    nearest = [_ball_of(balls, centre) for centre in model.beads]
    gaps = np.linalg.norm(
        np.array([_centre(ball) for ball in nearest]) - model.beads, axis=1
    )
    if not (gaps < 0.5 * model.bead_radius_mm).all():
        return model
    attenuation = np.array([ball.mu_per_mm for ball in nearest])
    return replace(model, contrast=2.0 * model.bead_radius_mm * attenuation)


def _ball_of(balls: Sequence[Solid], centre: FloatArray) -> Solid:
    """Return the ball whose center is nearest."""
    return min(balls, key=lambda ball: float(np.linalg.norm(_centre(ball) - centre)))


def _centre(ball: Solid) -> FloatArray:
    assert isinstance(ball.shape, Sphere)
    return np.asarray(ball.shape.center, dtype=np.float64)


def spot_radii(model: BeadModel, cone: ConeVec) -> FloatArray:
    """Compute the radius of each bead's spot (minor semi-axis) to first order: radius times
    magnification over the column pitch. `model`: k beads; `cone`: n views. Returns (n, k) [px];
    below 0 for a bead behind the source."""
    depth = np.einsum("nkj,nj->nk", model.beads[None] - cone.source[:, None], cone.normal)
    scale = cone.source_detector_distance / np.linalg.norm(cone.u, axis=1)
    return np.asarray(model.bead_radius_mm[None] * scale[:, None] / depth)
