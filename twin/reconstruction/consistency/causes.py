"""Errors of a scan's geometry and line integrals, each with one number: the table's columns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.beam_hardening import BLACK

Views = Callable[[ConeVec, FloatArray], ConeVec]
Images = Callable[[Float32Array, FloatArray], Float32Array]
WAVES: Final = 6
"""Half waves of a course through the scan, up to which movement is smooth."""
CHANGING: Final = ("line", "wave", "sine", "step")
"""Kinds of courses in which a size changes."""
STEPS: Final = 15
"""Places of a scan at which something may have stepped."""


@dataclass(frozen=True, eq=False)
class Cause:
    """A possible error, of so much in each view.

    Attributes:
        name: of `flexdt.twin.projection.volume.CAUSES`.
        unit: of its size, as it is printed; mm are those at the axis.
        step: for its derivative [unit].
        most: that can be told: beyond it a scan is not nearly the stated one (assumed).
        views: geometry, sizes (n,) [unit] -> the geometry that is right if the stated one
            is wrong by them; None for an error of the images.
        images: line integrals (n, rows, cols), sizes (n,) -> what the error adds to them;
            None for an error of the geometry.
        courses: kinds of `Course` that may be told from a right scan.
        nuisance: fitted in every table, and never told: nearly the same as another object.
        turns: views about the axis.
        fine: told in hardly smoothed images alone.
        of_integral: a function of the line integral alone: opposed rays do not show it.
    """

    name: str
    unit: str
    step: float
    most: float
    views: Views | None = None
    courses: tuple[str, ...] = ("constant",)
    images: Images | None = None
    nuisance: bool = False
    turns: bool = False
    fine: bool = False
    of_integral: bool = False

    def corrected(
        self, images: Float32Array, cone_vec: ConeVec, sizes: FloatArray
    ) -> tuple[Float32Array, ConeVec]:
        """Return images and geometry without an error of these sizes, (n,)."""
        if self.views is not None:
            return images, self.views(cone_vec, sizes)
        assert self.images is not None
        return np.asarray(images - self.images(images, sizes), np.float32), cone_vec


@dataclass(frozen=True)
class Course:
    """How the size of an error goes through the scan.

    Attributes:
        kind: "constant", "line", "wave", "sine" or "step".
        number: half waves, or the share of the scan before the step.
    """

    kind: str = "constant"
    number: float = 0.0

    def __call__(self, share: FloatArray) -> FloatArray:
        """Compute sizes at shares (n,) of the scan, for a size of 1: of a line from begin to
        end, of a step that of the step."""
        if self.kind == "line":
            return share - 0.5
        if self.kind == "wave":
            return np.asarray(np.cos(np.pi * self.number * share))
        if self.kind == "sine":  # a wave of any phase
            return np.asarray(np.sin(np.pi * self.number * share))
        if self.kind == "step":
            return np.asarray(share >= self.number, np.float64) - (1.0 - self.number)
        return np.ones_like(share)


def courses(cause: Cause) -> list[Course]:
    """List the courses of an error that are told."""
    every = [Course(), Course("line")]
    for kind, first in (("wave", 2), ("sine", 1)):
        every += [Course(kind, float(k)) for k in range(first, WAVES + 1)]
    every += [Course("step", k / (STEPS + 1.0)) for k in range(1, STEPS + 1)]
    return [one for one in every if one.kind in cause.courses]


def pixel_at_axis(cone_vec: ConeVec, centre: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute how large a pixel of each view is at the axis, along u and along v, (n,) [mm].

    `centre`: (x, y) of the axis."""
    normal = _unit(np.cross(cone_vec.u, cone_vec.v))
    far = ((cone_vec.detector - cone_vec.source) * normal).sum(axis=1)
    near = ((centre - cone_vec.source[:, :2]) * normal[:, :2]).sum(axis=1)
    smaller = np.abs(near / far)
    u, v = (np.linalg.norm(side, axis=1) for side in (cone_vec.u, cone_vec.v))
    return u * smaller, v * smaller


def causes_of(cone_vec: ConeVec, centre: FloatArray, share: FloatArray) -> list[Cause]:
    """List the errors that are looked for.

    Args:
        cone_vec: n views, whose pixels limit what is told.
        centre: (x, y) of the rotation axis.
        share: (n,) of the scan before each view.
    """
    across, down = (float(side.mean()) for side in pixel_at_axis(cone_vec, centre))

    def beside(views: ConeVec, sizes: FloatArray) -> ConeVec:
        """Move each panel along its rows [mm at the axis]."""
        pixels = sizes / pixel_at_axis(views, centre)[0]
        panel = views.detector + pixels[:, None] * views.u
        return ConeVec.from_vectors(views.source, panel, views.u, views.v)

    def below(views: ConeVec, sizes: FloatArray) -> ConeVec:
        """Move each panel along its columns [mm at the axis]."""
        pixels = sizes / pixel_at_axis(views, centre)[1]
        panel = views.detector + pixels[:, None] * views.v
        return ConeVec.from_vectors(views.source, panel, views.u, views.v)

    def turned(views: ConeVec, sizes: FloatArray) -> ConeVec:
        """Turn each view about the axis [degrees]."""
        cos, sin = np.cos(np.deg2rad(sizes)), np.sin(np.deg2rad(sizes))
        axis = np.append(centre, 0.0)

        def about(vectors: FloatArray) -> FloatArray:
            x, y, z = vectors.T
            return np.column_stack([cos * x - sin * y, sin * x + cos * y, z])

        source, panel = (
            about(place - axis) + axis for place in (views.source, views.detector)
        )
        return ConeVec.from_vectors(source, panel, about(views.u), about(views.v))

    def scaled(views: ConeVec, sizes: FloatArray) -> ConeVec:
        """Stretch the angles, as they followed each other, about their mean [%]."""
        order = np.argsort(share, kind="stable")
        azimuth = np.arctan2(*(views.source[:, :2] - centre).T[::-1])
        azimuth[order] = np.unwrap(azimuth[order])
        return turned(views, 0.01 * sizes * np.rad2deg(azimuth - azimuth.mean()))

    return [
        Cause(
            "axis", "mm", 0.05 * across, 20.0 * across, beside, ("constant", *CHANGING)
        ),
        Cause("height", "mm", 0.05 * down, 20.0 * down, below, nuisance=True),
        Cause("slip", "mm", 0.05 * down, 20.0 * down, below, CHANGING),
        Cause("roll", "deg", 0.1, 20.0, _rolled),
        Cause("pitch", "deg", 0.3, 45.0, _pitched, nuisance=True),
        Cause("yaw", "deg", 0.3, 45.0, _yawed),
        Cause("distance", "%", 0.2, 10.0, _farther),
        Cause("turn", "%", 0.1, 20.0, scaled, turns=True),
        Cause("lost", "deg", 0.1, 45.0, turned, CHANGING[1:], turns=True),  # line: scale
        Cause(
            "gain",
            "% of the mean",
            1.0,
            30.0,
            images=_gained,
            courses=CHANGING,
        ),
        Cause(
            "haze",
            "% of the open beam",
            0.1,
            30.0,
            images=_hazed,
            fine=True,
            of_integral=True,
        ),
        Cause("lens", "%", 1.0, 20.0, images=_bulged, fine=True),
    ]


def _tilted(views: ConeVec, sizes: FloatArray, axis: FloatArray) -> ConeVec:
    """Turn panels about unit vectors (n, 3) through their centers [degrees]: exactly, because
    sheared pixels are larger, too, and large tilts would be told of a wrong distance."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(np.deg2rad(sizes)[:, None] * axis).as_matrix()
    u, v = (np.einsum("nij,nj->ni", turn, side) for side in (views.u, views.v))
    return ConeVec.from_vectors(views.source, views.detector, u, v)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _rolled(views: ConeVec, sizes: FloatArray) -> ConeVec:
    return _tilted(views, sizes, _unit(np.cross(views.u, views.v)))


def _pitched(views: ConeVec, sizes: FloatArray) -> ConeVec:
    return _tilted(views, sizes, _unit(views.u))


def _yawed(views: ConeVec, sizes: FloatArray) -> ConeVec:
    return _tilted(views, sizes, _unit(views.v))


def _farther(views: ConeVec, sizes: FloatArray) -> ConeVec:
    away = 1.0 + 0.01 * sizes[:, None]
    panel = views.source + away * (views.detector - views.source)
    return ConeVec.from_vectors(views.source, panel, views.u, views.v)


def _gained(images: Float32Array, sizes: FloatArray) -> Float32Array:
    return np.asarray(0.01 * sizes[:, None, None] * images, np.float32)


def _hazed(images: Float32Array, sizes: FloatArray) -> Float32Array:
    """Compute the change by a constant in the beam: in small integrals a scale, in large
    a bend.

    It is half of a pixel at most.
    """
    share = 0.01 * sizes[:, None, None]
    # What a pixel lacks of the open beam, over what it has.
    lacking = np.expm1(np.minimum(images, np.float32(BLACK)))
    return np.asarray(-np.minimum(share * lacking, 0.5), np.float32)


def _bulged(images: Float32Array, sizes: FloatArray) -> Float32Array:
    """Compute what a lens adds that moves the end of a row outwards by so many % of its half."""
    _, rows, cols = images.shape
    x = (np.arange(cols) - 0.5 * (cols - 1)) / (0.5 * cols)
    y = (np.arange(rows) - 0.5 * (rows - 1)) / (0.5 * cols)
    far = np.square(x) + np.square(y)[:, None]
    across = np.gradient(images, axis=2) * x
    if rows > 1:
        across = across + np.gradient(images, axis=1) * y[:, None]
    return np.asarray(
        -0.01 * sizes[:, None, None] * far * across * (0.5 * cols), np.float32
    )
