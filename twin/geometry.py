"""The cone-beam geometry as a value: n rows of twelve numbers, exactly ASTRA's `cone_vec`.

A row is source, detector centre, u (step to the next column), v (step to the next row), in mm and
in the object's frame (see `conventions`). This module refuses to know about motors, machines and
detectors' pixel counts: shapes are arguments.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.conventions import FloatArray
from flexdt.twin.errors import GeometryError

ROW_LENGTH = 12
DEGENERATE = 1e-12
"""Sine of an angle below which two directions count as one."""


@dataclass(frozen=True, eq=False)
class ConeVec:
    """A frozen stack of cone_vec rows.

    Attributes:
        rows: float64 (n, 12) [mm], read-only: source, detector centre, u, v of each view.

    Raises:
        GeometryError: the rows do not have twelve finite numbers each.
    """

    rows: FloatArray

    def __post_init__(self) -> None:
        rows = np.array(self.rows, dtype=np.float64, ndmin=2)
        if rows.ndim != 2 or rows.shape[1] != ROW_LENGTH:
            raise GeometryError(
                f"cone_vec has shape {np.shape(self.rows)}; allowed: (n, 12)",
                {"asked": list(np.shape(self.rows)), "allowed": ["n", ROW_LENGTH]},
            )
        finite = np.isfinite(rows).all(axis=1)
        if not finite.all():
            index = int(np.flatnonzero(~finite)[0])
            raise GeometryError(f"cone_vec row {index} is not finite", {"row": index})
        rows.setflags(write=False)
        object.__setattr__(self, "rows", rows)

    @classmethod
    def from_vectors(
        cls,
        source: npt.ArrayLike,
        detector: npt.ArrayLike,
        u: npt.ArrayLike,
        v: npt.ArrayLike,
    ) -> ConeVec:
        """Build from four vectors, each (3,) or (n, 3) [mm], broadcast against each other."""
        parts = np.broadcast_arrays(
            *(np.atleast_2d(np.asarray(p, dtype=np.float64)) for p in (source, detector, u, v))
        )
        return cls(np.concatenate(parts, axis=1))

    @classmethod
    def concatenate(cls, parts: Sequence[ConeVec]) -> ConeVec:
        """Stack several geometries, in order."""
        return cls(np.concatenate([p.rows for p in parts], axis=0))

    def __len__(self) -> int:
        return int(self.rows.shape[0])

    def __getitem__(self, index: int | slice | npt.NDArray[np.intp]) -> ConeVec:
        return ConeVec(self.rows[index])

    def __iter__(self) -> Iterator[ConeVec]:
        for row in self.rows:
            yield ConeVec(row)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ConeVec) and np.array_equal(self.rows, other.rows)

    def __hash__(self) -> int:
        return hash((self.rows.shape, self.rows.tobytes()))

    def __repr__(self) -> str:
        return f"ConeVec({self.rows.tolist()!r})"

    @property
    def source(self) -> FloatArray:
        """Focal spot of each view, (n, 3) [mm]."""
        return self.rows[:, 0:3]

    @property
    def detector(self) -> FloatArray:
        """Detector centre of each view, (n, 3) [mm]."""
        return self.rows[:, 3:6]

    @property
    def u(self) -> FloatArray:
        """Step to the next column of each view, (n, 3) [mm]."""
        return self.rows[:, 6:9]

    @property
    def v(self) -> FloatArray:
        """Step to the next row of each view, (n, 3) [mm]."""
        return self.rows[:, 9:12]

    @property
    def normal(self) -> FloatArray:
        """Unit normal u x v of each view, (n, 3): away from the source."""
        n = np.cross(self.u, self.v)
        return np.asarray(n / np.linalg.norm(n, axis=1, keepdims=True), dtype=np.float64)

    @property
    def source_detector_distance(self) -> FloatArray:
        """Distance of the focal spot from the detector plane, (n,) [mm]; positive if in front."""
        return np.asarray(np.sum((self.detector - self.source) * self.normal, axis=1))

    def rays(self, shape: tuple[int, int]) -> FloatArray:
        """What a projector walks along: source, first pixel's centre minus source, u and v of each
        view, (n, 12) [mm].

        The ray to pixel (row, column) is the second of these + column * u + row * v.

        Args:
            shape: detector (rows, cols).
        """
        rows, cols = shape
        first = self.detector - (cols - 1) / 2 * self.u - (rows - 1) / 2 * self.v - self.source
        return np.concatenate([self.source, first, self.u, self.v], axis=1)

    def project_points(self, points: npt.ArrayLike, shape: tuple[int, int]) -> FloatArray:
        """Project points through the focal spot onto the detector.

        Args:
            points: (k, 3) [mm], object frame.
            shape: detector (rows, cols).

        Returns:
            (n, k, 2) pixel coordinates (column, row); pixel centres are integers. A point in the
            plane of the source parallel to the detector gives inf or nan, as it has no shadow.
        """
        rows, cols = shape
        p = np.atleast_2d(np.asarray(points, dtype=np.float64))
        ray = p[None, :, :] - self.source[:, None, :]
        normal = np.cross(self.u, self.v)
        offset = self.source - self.detector
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = -np.einsum("ni,ni->n", offset, normal)[:, None] / np.einsum(
                "nki,ni->nk", ray, normal
            )
            hit = offset[:, None, :] + scale[:, :, None] * ray
        uu = np.einsum("ni,ni->n", self.u, self.u)
        vv = np.einsum("ni,ni->n", self.v, self.v)
        uv = np.einsum("ni,ni->n", self.u, self.v)
        hu = np.einsum("nki,ni->nk", hit, self.u)
        hv = np.einsum("nki,ni->nk", hit, self.v)
        det = (uu * vv - uv * uv)[:, None]
        column = (vv[:, None] * hu - uv[:, None] * hv) / det + (cols - 1) / 2
        row = (uu[:, None] * hv - uv[:, None] * hu) / det + (rows - 1) / 2
        return np.stack([column, row], axis=-1)

    def piercing_points(self, shape: tuple[int, int]) -> FloatArray:
        """Foot of the perpendicular from the focal spot, (n, 2) pixels (column, row)."""
        foot = self.source + self.normal * self.source_detector_distance[:, None]
        return np.stack(
            [
                one.project_points(point[None, :], shape)[0, 0]
                for one, point in zip(self, foot, strict=True)
            ]
        )

    def pixel_centers(self, shape: tuple[int, int]) -> FloatArray:
        """Positions of all pixel centres, (n, rows, cols, 3) [mm]."""
        rows, cols = shape
        c = np.arange(cols) - (cols - 1) / 2
        r = np.arange(rows) - (rows - 1) / 2
        return np.asarray(
            self.detector[:, None, None, :]
            + c[None, None, :, None] * self.u[:, None, None, :]
            + r[None, :, None, None] * self.v[:, None, None, :]
        )

    def moved(self, rotation: npt.ArrayLike, translation: npt.ArrayLike) -> ConeVec:
        """The geometry in another frame: points p become R p + t, steps u, v become R u, R v.

        Args:
            rotation: (3, 3) or (n, 3, 3).
            translation: (3,) or (n, 3) [mm].
        """
        r = np.broadcast_to(np.asarray(rotation, dtype=np.float64), (len(self), 3, 3))
        t = np.broadcast_to(np.asarray(translation, dtype=np.float64), (len(self), 3))
        turned = [np.einsum("nij,nj->ni", r, part) for part in (self.source, self.detector)]
        steps = [np.einsum("nij,nj->ni", r, part) for part in (self.u, self.v)]
        return ConeVec(np.concatenate([turned[0] + t, turned[1] + t, *steps], axis=1))

    def binned(self, factor: int, shape: tuple[int, int]) -> ConeVec:
        """The geometry of the image binned by `factor`; surplus columns and rows are cut off.

        Args:
            factor: pixels per coarse pixel along each side.
            shape: (rows, cols) of the fine image.
        """
        rows, cols = shape
        shift_u = (cols // factor * factor - cols) / 2
        shift_v = (rows // factor * factor - rows) / 2
        centre = self.detector + shift_u * self.u + shift_v * self.v
        return ConeVec.from_vectors(self.source, centre, self.u * factor, self.v * factor)


def check_spread(cone_vec: ConeVec) -> ConeVec:
    """Each pixel of each view must have a ray of its own; returns its argument.

    Raises:
        GeometryError: names the first row in which u or v is zero, u and v are parallel, or the
            source lies in the detector's plane.
    """
    with np.errstate(all="ignore"):
        u, v, beam = (
            part / np.linalg.norm(part, axis=1, keepdims=True)
            for part in (cone_vec.u, cone_vec.v, cone_vec.detector - cone_vec.source)
        )
        normal = np.cross(u, v)
        flat = ~(np.linalg.norm(normal, axis=1) > DEGENERATE)
        level = ~(np.abs(np.einsum("ni,ni->n", normal, beam)) > DEGENERATE)
    bad = np.flatnonzero(flat | level)
    if len(bad):
        i = int(bad[0])
        problem = (
            "u and v do not span a plane (one is zero, or they are parallel)"
            if flat[i]
            else "the source lies in the detector's plane"
        )
        raise GeometryError(
            f"cone_vec row {i}: {problem}; allowed: pixels that each have a ray of their own",
            {"row": i, "check": "degenerate", "asked": cone_vec.rows[i].tolist()},
        )
    return cone_vec


def check_cone_vec(
    cone_vec: ConeVec, pixel_mm: float, *, relative_tolerance: float = 1e-6
) -> ConeVec:
    """The sanity checks of thesis 4.8.3; returns its argument, so it can guard an expression.

    Args:
        cone_vec: what is about to leave the twin.
        pixel_mm: the binned pixel pitch that |u| and |v| must have [mm].
        relative_tolerance: allowed deviation of |u| and |v| and of the right angle.

    Raises:
        GeometryError: names the first offending row, the check, the value and what is allowed.
    """
    u, v = cone_vec.u, cone_vec.v
    lengths = {"|u|": np.linalg.norm(u, axis=1), "|v|": np.linalg.norm(v, axis=1)}
    for name, length in lengths.items():
        bad = np.abs(length - pixel_mm) > relative_tolerance * pixel_mm
        if bad.any():
            i = int(np.flatnonzero(bad)[0])
            raise GeometryError(
                f"cone_vec row {i}: {name} is {length[i]:.9g} mm, the binned pixel pitch is "
                f"{pixel_mm:.9g} mm",
                {"row": i, "check": "pitch", "asked": float(length[i]), "allowed": pixel_mm},
            )
    cosine = np.einsum("ni,ni->n", u, v) / (lengths["|u|"] * lengths["|v|"])
    if (np.abs(cosine) > relative_tolerance).any():
        i = int(np.argmax(np.abs(cosine)))
        raise GeometryError(
            f"cone_vec row {i}: u and v are not orthogonal (cosine {cosine[i]:.3g}, allowed "
            f"{relative_tolerance:.1g})",
            {"row": i, "check": "orthogonal", "asked": float(cosine[i])},
        )
    distance = cone_vec.source_detector_distance
    if (distance <= 0).any():
        i = int(np.argmin(distance))
        raise GeometryError(
            f"cone_vec row {i}: the source-detector distance is {distance[i]:.6g} mm; it must be "
            "positive",
            {"row": i, "check": "sdd", "asked": float(distance[i]), "allowed": "> 0"},
        )
    return cone_vec
