"""The geometry of a scan as it travels between programs, and the error for formats that cannot
represent it.

`ScanGeometry` is returned by every reader of this package and taken by every writer:
cone_vec rows and the detector's shape. `circle_of` finds the circle of a cone_vec, for
formats that support nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.dataset.provenance import Provenance
from flexdt.twin.errors import TwinError, shape_words
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, rotation_z
from flexdt.twin.geometry.poses import Poses

SAME_MM: Final = 1e-9
"""Largest error of a geometry in an exchange format [mm]."""
SQUARE_TOLERANCE: Final = 1e-9
"""Largest cosine of u and v, and relative difference of pitches, that count as zero."""


class ExchangeError(TwinError):
    """A file that is not valid, or a geometry that a format cannot carry, with place and
    reason.
    """


@dataclass(frozen=True)
class ScanGeometry:
    """Geometry of the projections of one scan.

    Attributes:
        cone_vec: geometry for the reconstruction, object frame [mm].
        shape: detector (rows, cols); None if unknown.
        real: true geometry, unknown to a reconstruction (CTSimU); None: as cone_vec.
        name: of the scan, "" if unknown.
        files: the images' names, () if unknown.
        notes: remarks for the reader.
        full_scale: largest count of the images; None if unknown.
        kV: voltage of the tube; None if unknown.
        provenance: values of the files that it came from, with their uses.
    """

    cone_vec: ConeVec
    shape: tuple[int, int] | None = None
    real: ConeVec | None = None
    name: str = ""
    files: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=(), compare=False)
    full_scale: int | None = field(default=None, compare=False)
    provenance: Provenance = field(default=Provenance(), compare=False)
    kV: float | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        """Check the lengths of `real` and of `files`, where given, and the detector's
        shape.

        Raises:
            ExchangeError: one does not have an entry for each view, or the shape has no
                pixel.
        """
        for noun, count in (("real rows", self.real), ("files", self.files or None)):
            if count is not None and len(count) != len(self):
                problem = f"{len(self)} views but {len(count)} {noun}"
                raise ExchangeError.instead(problem, len(count), len(self))
        if self.shape is not None and min(self.shape) < 1:
            raise ExchangeError(
                f"detector shape {shape_words(self.shape)}; allowed: at least one pixel"
            )

    def accounted(self, said: Ledger) -> ScanGeometry:
        """Return the geometry with what became of its file's values, and what they told as
        notes. Raises TwinError: of the ledger: a value that is refused has an effect."""
        values = said.finish()
        notes = (*self.notes, *said.warnings)
        return replace(self, notes=notes, provenance=self.provenance.and_also(values))

    def __len__(self) -> int:
        return len(self.cone_vec)

    @property
    def pitch_mm(self) -> tuple[float, float]:
        """Pixel pitch (u, v) of the first view [mm]; others are not looked at."""
        first = self.cone_vec.rows[0]
        return float(np.linalg.norm(first[6:9])), float(np.linalg.norm(first[9:12]))

    def rows_up(self) -> ScanGeometry:
        """Return the geometry with rows counted from the other side: v is negated, in
        `real` too.

        It belongs to images turned upside down. Twice gives the same geometry; files,
        shape and notes stay.
        """
        down = np.repeat([1.0, -1.0], [9, 3])
        real = None
        if self.real is not None:
            real = ConeVec(self.real.rows * down)
        return replace(self, cone_vec=ConeVec(self.cone_vec.rows * down), real=real)


@dataclass(frozen=True, eq=False)
class CircularScan:
    """One circle about an axis parallel to z.

    Attributes:
        angle: (n,) [rad], growing as ASTRA's; the object turns clockwise.
        center: where the axis pierces the object's xy plane, (2,) [mm].
        source, detector: at angle 0, from the axis, (3,) [mm].
        u, v: at angle 0, (3,) [mm].
    """

    angle: FloatArray
    center: FloatArray
    source: FloatArray
    detector: FloatArray
    u: FloatArray
    v: FloatArray

    def cone_vec(self) -> ConeVec:
        """Compute one view for each angle: source, detector, u and v turned about z by
        the angle, about the circle's center.
        """
        standing = np.concatenate([self.source, self.detector, self.u, self.v])
        return ConeVec(np.tile(standing, (len(self.angle), 1))).moved(
            rotation_z(self.angle), np.array([*self.center, 0.0])
        )


def circle_of(
    cone_vec: ConeVec, format_name: str, tolerance_mm: float = SAME_MM
) -> CircularScan:
    """Find the circle that `cone_vec` describes.

    The axis is found by least squares; coordinates of it below a tenth of `SAME_MM` are
    0, and views of one direction have it at the origin. Source, detector, u and v are
    means over the views.

    Args:
        cone_vec: at least one view.
        format_name: format that needs a circle, for the message.
        tolerance_mm: largest deviation of any number of a view from the circle.

    Returns:
        Angles of the views, the axis's place, and source, detector, u and v at angle 0
        [mm].

    Raises:
        ExchangeError: it is not a circle; names the view and its deviation.
    """
    poses = Poses.from_cone_vec(cone_vec)
    angle = poses.angle
    c, s = np.cos(angle), np.sin(angle)
    center = np.zeros(2)
    # One direction does not determine the axis: it is the object frame's own then.
    if max(np.ptp(c), np.ptp(s)) >= 1e-3:
        # A point p at angle 0 is seen at center + Rz(angle) p: linear in center and p.
        one = np.ones_like(c)
        zero = np.zeros_like(c)
        table = np.concatenate([np.c_[one, zero, c, -s], np.c_[zero, one, s, c]])
        target = np.concatenate([cone_vec.source[:, 0], cone_vec.source[:, 1]])
        center = np.linalg.lstsq(table, target, rcond=None)[0][:2]
        center[np.abs(center) < SAME_MM / 10] = 0.0
    moved = cone_vec.moved(np.eye(3), np.array([-center[0], -center[1], 0.0]))
    world = moved.moved(rotation_z(-angle), np.zeros(3))
    middle = world.rows.mean(axis=0)
    circle = CircularScan(
        angle, center, middle[0:3], middle[3:6], middle[6:9], middle[9:12]
    )
    miss = np.abs(circle.cone_vec().rows - cone_vec.rows).max(axis=1)
    message = (
        f"{format_name} knows one circle with everything else standing still; "
        "the distance [mm]"
    )
    require_each(f"{message} from it", miss, tolerance_mm)
    return circle


def require_panel(cone_vec: ConeVec, format_name: str) -> tuple[float, float]:
    """Return the pixel pitch (u, v) [mm] of a panel with rectangular pixels of one size.

    Orthogonal, and of one length over the views, within `SQUARE_TOLERANCE`; u and v may differ.
    The pitches are means over the views.

    `cone_vec`: n views; `format_name`: format that needs such a panel, for the message.
    Raises ExchangeError: u and v are not orthogonal, or their lengths vary; names the view.
    """
    u, v = cone_vec.u, cone_vec.v
    lengths = np.stack([np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1)], axis=1)
    cosine = np.abs(np.einsum("ni,ni->n", u, v)) / (lengths[:, 0] * lengths[:, 1])
    message = f"{format_name} knows panels with orthogonal rows and columns; their cosine"
    require_each(message, cosine, SQUARE_TOLERANCE)
    change = np.abs(lengths / lengths[0] - 1.0).max(axis=1)
    require_each(
        f"{format_name} knows one pixel size; its change", change, SQUARE_TOLERANCE
    )
    return float(lengths[:, 0].mean()), float(lengths[:, 1].mean())


def require_each(what: str, off: FloatArray, most: float) -> None:
    """Check that a figure of every view, (n,), is at most `most`.

    Raises ExchangeError with its name `what`, and the view with the largest.
    """
    view = int(np.argmax(off))
    if off[view] > most:
        raise ExchangeError(
            f"{what} in view {view} is {off[view]:.3g}; allowed: {most:g}",
            {"row": view, "asked": float(off[view]), "allowed": most},
        )
