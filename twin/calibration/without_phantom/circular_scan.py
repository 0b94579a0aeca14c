"""A circular scan, and how its geometry follows from the parameters of its plane of
symmetry."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from flexdt.twin.calibration.fit.fit import axis_in_image
from flexdt.twin.calibration.without_phantom.alignment import refuse_if
from flexdt.twin.calibration.without_phantom.turn import Image
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, from_unity
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

FREE: Final = ("dO_x", "det_roll", "det_yaw", "dD_z", "dD_y")
"""Parameters of the plane, in this order. The last two are not determined, but add to the
uncertainty of opposite rays."""
OF_TURN: Final = 3
"""So many of them are parameters where there is a full turn."""
STANDS: Final = 0.05
"""Largest motion of source and panel between frames, seen from the axis [px]."""


@dataclass(frozen=True, eq=False)
class CircularScan:
    """A scan on one circle about the rotation axis.

    `values` are parameters in the order of `FREE`; those left out are as in `base`.

    Attributes:
        image: line integrals of a frame, (rows, cols).
        poses: nominal poses of all frames.
        present: indices of the frames that are there.
        shape: (rows, cols) of every image.
        base: offsets in force.
        priors: standard deviation of each offset [mm, deg].
        pose: the pose that all frames share but for the angle of the stage.
    """

    image: Image
    poses: Poses
    present: tuple[int, ...]
    shape: tuple[int, int]
    base: Offsets
    priors: Mapping[str, float]
    pose: Poses

    @classmethod
    def of(
        cls,
        image: Image,
        poses: Poses,
        present: tuple[int, ...],
        shape: tuple[int, int],
        base: Offsets,
        priors: Mapping[str, float],
    ) -> CircularScan:
        """Make the scan; NotIdentifiableError if no frame is there, or source or panel
        move.
        """
        refuse_if(len(present) == 0, "no frame is there")
        return cls(image, poses, present, shape, base, priors, _standing(poses, present))

    def offsets(self, values: FloatArray) -> Offsets:
        """Put the first parameters of `FREE` into a copy of the offsets in force."""
        return replace(self.base, **dict(zip(FREE, values.tolist(), strict=False)))

    def view(self, values: FloatArray) -> FloatArray:
        """Return the cone_vec row (12,) of the shared pose about the axis."""
        return np.asarray(about_axis(self.pose, self.offsets(values)).rows[0])

    def column(self, values: FloatArray, row: float | None = None) -> float:
        """Compute the column in which the axis crosses a row [px].

        Args:
            values: parameters in the order of `FREE`.
            row: None: the panel's middle one.
        """
        rows, cols = self.shape
        middle = np.array([(cols - 1) / 2, (rows - 1) / 2])
        column, angle, _ = axis_in_image(self.pose, self.offsets(values), middle)
        if row is None:
            return float(column)
        return float(column - math.tan(math.radians(angle)) * (row - middle[1]))

    def azimuth(self, frames: Sequence[int]) -> FloatArray:
        """Return the angle of the source about the axis in frames, (n,) [rad]."""
        source = about_axis(self.poses[np.array(frames)], self.offsets(self.start)).source
        return np.asarray(np.arctan2(source[:, 1], source[:, 0]))

    def source_row(self) -> float:
        """Return the row of the plane in which the source turns, by the offsets in force."""
        shown = about_axis(self.pose, self.offsets(self.start))
        level = [[0.0, 0.0, float(shown.source[0, 2])]]
        return float(shown.project_points(level, self.shape)[0, 0, 1])

    def slopes(self, values: FloatArray, scales: FloatArray) -> FloatArray:
        """Compute the axis column's change with each of (k,) parameters [px per unit].

        By differences of a tenth of a step (`scales`) to each side.
        """
        steps = np.diag(0.1 * scales)
        return np.array(
            [
                (self.column(values + e) - self.column(values - e)) / (2 * e.sum())
                for e in steps
            ]
        )

    @property
    def pitch_mm(self) -> float:
        """Pitch of the columns [mm]."""
        return float(np.linalg.norm(self.pose.u[0]))

    @property
    def sdd_mm(self) -> float:
        """Source-detector distance [mm]."""
        return float(self.pose.sdd[0])

    @property
    def start(self) -> FloatArray:
        """Parameters in force, (5,)."""
        return np.array([getattr(self.base, name) for name in FREE])

    @property
    def scales(self) -> FloatArray:
        """Change of each parameter of `FREE` [mm, rad] that moves the ends of the image
        (for roll, the upper and lower ones) by about a pixel, (5,).
        """
        rows, cols = self.shape
        pitch = self.pitch_mm
        sdd = self.sdd_mm
        ends = 2 * sdd / cols
        return np.array(
            [
                pitch * float(self.pose.sod[0]) / sdd,
                2 / rows,
                ends / (pitch * cols),
                ends,
                pitch,
            ]
        )

    @property
    def sideways_rad(self) -> float:
        """Yaw that the prior of a panel shifted sideways looks like [rad]."""
        return math.atan(self.priors["dD_x"] / self.sdd_mm)

    @property
    def yaw_prior_rad(self) -> float:
        """Standard deviation of the yaw before the images [rad]."""
        return max(
            math.hypot(math.radians(self.priors["det_yaw"]), self.sideways_rad), 1e-9
        )


def about_axis(poses: Poses, offsets: Offsets) -> ConeVec:
    """Return the views in a frame with the rotation axis at the origin."""
    foot = from_unity([offsets.tau_x, 0.0, offsets.tau_z]) - poses.mount
    return poses.cone_vec(offsets).moved(np.eye(3), -foot)


def _standing(poses: Poses, present: tuple[int, ...]) -> Poses:
    """Return the pose (of the first frame) that all frames share but for the angle of the
    stage.

    Args:
        poses: of all frames.
        present: frames that are compared, one at least.

    Raises:
        NotIdentifiableError: source or panel move by more than `STANDS`, so the scan is
            not on one circle.
    """
    chosen = np.array(present)
    table = np.hstack(
        [poses.source - poses.axis, poses.detector - poses.axis, poses.u, poses.v]
    )
    table = table[chosen]
    pitch = float(np.linalg.norm(poses.u[chosen[0]]))
    moved = float(np.abs(table - table[0]).max()) / pitch
    refuse_if(
        moved > STANDS,
        f"source or panel move by {moved:.4g} px between frames; allowed: {STANDS:g} px (one "
        "circle about z, the rotation axis)",
    )
    return poses[chosen[:1]]
