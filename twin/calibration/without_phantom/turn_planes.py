"""The source's row and shifts of frames of a full turn, from planes through two sources."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from flexdt.twin.calibration.without_phantom.alignment import AlignEstimate, refuse_if
from flexdt.twin.calibration.without_phantom.circular_scan import about_axis
from flexdt.twin.calibration.without_phantom.frame_shifts import Shifts, find_shifts
from flexdt.twin.calibration.without_phantom.mirror_symmetry import REACH, sharpness
from flexdt.twin.calibration.without_phantom.plane_pairs import PlanePairs
from flexdt.twin.calibration.without_phantom.source_row import Height, find_height
from flexdt.twin.calibration.without_phantom.turn import Image, Turn
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.motion import Motion
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

COLUMNS: Final = 256
"""Number of columns to which frames are binned for planes."""
FRAMES: Final = 90, 360
"""For the row: of more frames than this every second, third and so on is used; the second
number where the first are too few."""
MOST_SHIFTS: Final = 2000
"""Largest number of frames whose shifts are estimated."""
FLOOR_OF_ROW: Final = 0.1
"""Least sigma of the row: the effect of sampling (assumed) [px of the binned frames]."""
SHARP_ROWS: Final = 2.0
"""Effect of sampling on edges along rows as sharp as those of points (assumed) [px]."""
STEP_OF_ROW: Final = 10.0
"""A step of the images may move the row so many times as far (assumed)."""


class TurnPlanes:
    """Estimates from planes through two sources, once the plane of symmetry is known.

    Args:
        image, poses: as of `align_turn`.
        turn: the frames' mean.
        offsets: of dO_x, det_roll and det_yaw to all.
        values: of those three.
        covariance: of those three.
        priors: as of `align_turn`.
    """

    def __init__(
        self,
        image: Image,
        poses: Poses,
        turn: Turn,
        offsets: Callable[[FloatArray], Offsets],
        values: FloatArray,
        covariance: FloatArray,
        priors: Mapping[str, float],
    ) -> None:
        """Sort the frames of a turn by angle; images are read later, when pairs are made.

        Args:
            image: reads the line integrals of a frame.
            poses: of all frames.
            turn: the used frames and their mean.
            offsets: of parameters.
            values: (p,) parameters found in the plane of symmetry.
            covariance: (p, p) of them, positive definite.
            priors: standard deviation of each offset.
        """
        self.image = image
        self.poses = poses
        self.turn = turn
        self.offsets = offsets
        self.values = values
        self.priors = priors
        self.doubts = np.linalg.cholesky(covariance)
        self.pitch = float(np.linalg.norm(poses.v[turn.used[0]]))
        self.factor = max(1, round(turn.mean.shape[1] / COLUMNS))
        scale = offsets(values).angle_scale
        around = scale * poses.angle[list(turn.used)] % (2 * np.pi)
        self.sorted = np.array(turn.used)[np.argsort(around)]
        self.stack: Float32Array | None = None

    def _of(self, at: FloatArray) -> Offsets:
        """Compute offsets for the panel's height above the stated one [px], three doubts
        of the plane of symmetry and those of SDD and pitch [sigma].

        Args:
            at: (6,) in this order; zeros are the offsets found so far.
        """
        given = self.offsets(self.values + self.doubts @ at[1:4])
        return replace(
            given,
            dD_y=given.dD_y + float(at[0]) * self.pitch,
            dD_z=given.dD_z + float(at[4]) * self.priors["dD_z"],
            det_pitch=given.det_pitch
            + math.radians(float(at[5]) * self.priors["det_pitch"]),
        )

    def _pairs(self, stride: int, coarser: int = 1) -> PlanePairs:
        """Make pairs of every `stride`-th frame, binned by a further factor `coarser`.

        The stack of images is read when the number of frames changes, and kept for later
        calls.

        Raises:
            NotIdentifiableError: too few pairs are clear of the object.
        """
        frames = self.sorted[::stride]
        if self.stack is None or len(self.stack) != len(frames):
            images = [binned_mean(self.image(i), self.factor) for i in frames.tolist()]
            self.stack = np.stack(images)
        poses = self.poses[frames]
        stack = binned_mean(self.stack, coarser)

        def views(at: FloatArray) -> ConeVec:
            return about_axis(poses, self._of(at))

        return PlanePairs(
            stack, self.turn.mean, coarser * self.factor, views, np.zeros(6)
        )

    def row(self, random: np.random.Generator) -> tuple[Offsets, AlignEstimate]:
        """Estimate the panel's height and the row of the source's plane.

        The sigma contains sampling, the sharpness of edges and a step of the images. `FRAMES`
        rise where the row is refused, or noise has most of its sigma.

        Args:
            random: for the images of noise.

        Returns:
            Offsets with the height, as `dD_y` [mm], and the row [px].

        Raises:
            NotIdentifiableError: the images do not determine it, or not twice as well as
                the priors of dD_y and axis_tilt_x.
        """
        of_turn = (
            FLOOR_OF_ROW * self.factor,
            SHARP_ROWS * sharpness(self.turn.mean) ** 2,
            STEP_OF_ROW * math.hypot(*self.turn.step_px),
        )
        sdd = float(self.poses.sdd[self.sorted[0]])
        lean = sdd * math.tan(math.radians(self.priors["axis_tilt_x"]))
        known = math.hypot(self.priors["dD_y"], lean) / self.pitch
        few, many = (-(-len(self.sorted) // count) for count in FRAMES)
        try:
            height = self._height(few, random)
            rest = math.sqrt(height.sigma**2 - height.of_noise**2)
            enough = few == many or height.of_noise < math.hypot(rest, *of_turn)
        except NotIdentifiableError:
            if few == many:
                raise
            enough = False
        if not enough:
            height = self._height(many, random)
        sigma = math.hypot(height.sigma, *of_turn)
        refuse_if(
            sigma > known / 2,
            f"the images tell it to +- {sigma:.2g} px, the priors of dD_y and "
            f"axis_tilt_x to +- {known:.2g} px",
        )
        at = np.array([height.px, *(5 * [0.0])])
        cone_vec = about_axis(self.poses[self.sorted[:1]], self._of(at))
        level = [[0.0, 0.0, float(cone_vec.source[0, 2])]]
        row = cone_vec.project_points(level, self.turn.mean.shape)[0, 0, 1]
        return self._of(at), AlignEstimate(float(row), sigma, "px")

    def _height(self, stride: int, random: np.random.Generator) -> Height:
        """Find the panel's height in every `stride`-th frame."""
        fine, coarse = (self._pairs(stride, coarser) for coarser in (1, 2))
        return find_height(fine, coarse, REACH * self.turn.mean.shape[0], random)

    def motion(self, corrected: Offsets, random: np.random.Generator) -> Motion:
        """Estimate shifts of single frames as shifts of the sample, dO_x and dO_y.

        `corrected`: offsets; only the panel's height and angle_scale are used. `random`: for the
        image of noise.
        Raises NotIdentifiableError: the images have too few pairs of views, or there are more
        than `MOST_SHIFTS` frames.
        """
        n = len(self.sorted)
        refuse_if(
            n > MOST_SHIFTS, f"{n} frames; shifts are looked for in up to {MOST_SHIFTS}"
        )
        at = np.zeros(6)
        at[0] = (corrected.dD_y - self._of(at).dD_y) / self.pitch
        angle = corrected.angle_scale * self.poses.angle[self.sorted]
        return self._as_motion(find_shifts(self._pairs(1), at, angle, random))

    def _as_motion(self, shifts: Shifts) -> Motion:
        """Convert shifts on the detector into motions of the object, `dO_x` and `dO_y`,
        of all frames; frames that were not used get motion 0 and the shifts' rms as
        sigma.

        Args:
            shifts: of the used frames, sorted by angle [px of the binned frames].

        Returns:
            [mm]; sigmas nan in a direction without evidence.
        """
        pose = self.poses[self.sorted[:1]]
        scale = self.factor * float(pose.sod[0] / pose.sdd[0])
        values, sigmas = np.zeros((2, len(self.poses), 2))
        sigmas[:] = np.sqrt(
            np.square(shifts.values).mean(axis=0)
        )  # of frames that are not used
        across = scale * float(pose.u[0, 0])
        upwards = scale * float(pose.v[0, 2])
        values[self.sorted] = shifts.values * [across, upwards]
        sigmas[self.sorted] = shifts.sigmas
        return Motion(
            ("dO_x", "dO_y"), values, sigmas * np.abs([across, upwards]), shifts.evidence
        )
