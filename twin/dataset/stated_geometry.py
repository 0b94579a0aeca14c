"""A geometry as the settings texts state it: SOD, SDD, HC, VC and COR, and the poses of these.

HC and VC are the piercing point's column and row, COR the rotation axis's column, in binned
pixels from the region's corner, measured from the pixel's EDGE: half a pixel more than the
integer-centre coordinates used everywhere else. This module is the only place that adds or
takes that half.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses

EDGE = 0.5
"""Coordinate of the center of pixel 0, measured from the edge [px]."""


@dataclass(frozen=True)
class Figures:
    """A geometry as stated in the settings texts.

    Attributes:
        sod_mm, sdd_mm: source-object and source-detector distance along the beam.
        hc_px, vc_px: piercing point (column, row) from the edge, binned pixels.
        cor_px: column of the rotation axis at the height of the focal spot, from the
            edge.
        pixel_mm: binned pixel pitch.
    """

    sod_mm: float
    sdd_mm: float
    hc_px: float
    vc_px: float
    cor_px: float
    pixel_mm: float

    @property
    def magnification(self) -> float:
        """SDD / SOD."""
        return self.sdd_mm / self.sod_mm

    @property
    def stated(self) -> dict[str, Any]:
        """Values by `ScanSettings` field, voxel size [um] and magnification included."""
        numbers = {
            name: value for name, value in vars(self).items() if name != "pixel_mm"
        }
        return {
            **numbers,
            "binned_pixel_mm": self.pixel_mm,
            "voxel_um": self.voxel_um,
            "magnification": self.magnification,
        }

    @property
    def voxel_um(self) -> float:
        """pixel * SOD / SDD [um] (the thesis inverts the ratio)."""
        return 1000.0 * self.pixel_mm * self.sod_mm / self.sdd_mm


def figures_of(pose: Poses, shape: tuple[int, int]) -> Figures:
    """Compute the figures of one nominal pose: SOD, SDD [mm], HC, VC, COR [px, from the edge]
    and pixel [mm].

    COR is the column of the rotation axis at the source's height; the pixel is the pitch from
    column to column.
    `pose`: one (n = 1); `shape`: image (rows, cols).
    """
    cone = pose.cone_vec()
    hc, vc = (cone.piercing_points(shape)[0] + EDGE).tolist()
    height = float(pose.source[0, 2] - pose.axis[0, 2])
    on_axis = np.array([0.0, 0.0, height]) - pose.mount[0]
    cor = float(cone.project_points(on_axis, shape)[0, 0, 0] + EDGE)
    pixel = float(np.linalg.norm(pose.u[0]))
    return Figures(float(pose.sod[0]), float(pose.sdd[0]), hc, vc, cor, pixel)


def poses_of(
    figures: Figures,
    shape: tuple[int, int],
    angles: FloatArray,
    *,
    source_x: float = 0.0,
    source_z: float = 0.0,
    axis_z: float = 0.0,
) -> Poses:
    """Compute poses with these figures and an upright detector; the inverse of
    `figures_of`.

    The source is at y = 0. Figures do not determine the scanner's origin and the sample's
    height: `source_x`, `source_z` and `axis_z` [mm] are world coordinates. `angles`: of
    the stage, (n,) [rad].
    """
    f, (rows, cols) = figures, shape
    axis_x = source_x + (f.cor_px - f.hc_px) * f.pixel_mm * f.sod_mm / f.sdd_mm
    detector_x = source_x + (cols / 2.0 - f.hc_px) * f.pixel_mm
    detector_z = source_z - (rows / 2.0 - f.vc_px) * f.pixel_mm
    return Poses.upright(
        [source_x, 0.0, source_z],
        [axis_x, f.sod_mm, axis_z],
        [detector_x, f.sdd_mm, detector_z],
        f.pixel_mm,
        angles,
    )
