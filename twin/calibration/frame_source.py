"""Where calibration gets its images from: a small protocol, images held in memory, and a scan.

A source detects beads in its frames and cuts windows out of them. How it reads and normalizes
the images, and on how many threads, is left to the source. Scans are checked before anything is
measured in them.
"""

from __future__ import annotations

import enum
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.detect.detection import Detections, SpotFinder, detect_beads
from flexdt.twin.calibration.detect.windows import Windows, crop
from flexdt.twin.calibration.fit.priors import ASSUMED
from flexdt.twin.errors import GeometryError, TwinError
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.poses import Poses

DARK = 3.5
"""Median line integral above which a frame counts as dark: 3 % of the open beam."""


class FrameState(enum.Enum):
    """Whether a frame can be used."""

    USABLE = "usable"
    MISSING = "missing"
    DARK = "dark"
    REPEATED = "repeated"


@dataclass(frozen=True, eq=False)
class FrameSpots:
    """The spots of one frame, its state, and the fault of an unusable file."""

    detections: Detections
    state: FrameState
    unusable: str = ""


def without_repeats(looks: Sequence[FrameSpots]) -> tuple[FrameSpots, ...]:
    """Mark usable frames that repeat the frame before as REPEATED.

    Noise never repeats: a frame whose two or more spots are all within 1e-7 px of the
    last frame's is a copy, of a camera that stuttered. Where more than half of the frames
    repeat (images without noise of an object at rest) nothing is changed.

    Args:
        looks: spots of each frame.

    Returns:
        As many frames; marked ones keep their spots.
    """
    out = list(looks)
    for i in range(1, len(out)):
        a = looks[i - 1].detections
        b = looks[i].detections
        same = len(a) == len(b) >= 2 and bool(np.abs(a.centers - b.centers).max() < 1e-7)
        if same and looks[i].state is FrameState.USABLE:
            out[i] = FrameSpots(b, FrameState.REPEATED)
    repeated = sum(look.state is FrameState.REPEATED for look in out)
    if 2 * repeated > len(out):
        return tuple(looks)
    return tuple(out)


class Frames(Protocol):
    """The images of one scan, in the order of its poses."""

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of every image."""

    def __len__(self) -> int: ...

    def look(self, detector: SpotFinder) -> list[FrameSpots]:
        """Detect the beads of every frame."""

    def windows(self, plan: Windows) -> Float32Array:
        """Cut the windows of every frame, (n, k, side, side), nan where there is no image."""


def nothing(shape: tuple[int, int]) -> Detections:
    """Return the detections of a frame without spots."""
    return Detections.of_points(np.zeros((0, 2)), 0.0, 0.0, shape)


def look_at(image: Float32Array, detector: SpotFinder) -> FrameSpots:
    """Detect the beads in line integrals (rows, cols).

    A frame whose median (of every 16th row and column) exceeds `DARK` is not searched,
    unless the detector is for intensities.
    """
    shape = (image.shape[0], image.shape[1])
    if not detector.intensities and float(np.median(image[::16, ::16])) > DARK:
        return FrameSpots(nothing(shape), FrameState.DARK)
    return FrameSpots(detect_beads(image, detector), FrameState.USABLE)


@dataclass(frozen=True, eq=False)
class ArrayFrames:
    """Line-integral images in memory; None for a missing frame.

    Attributes:
        images: (rows, cols) float32 each.
        shape: (rows, cols).
    """

    images: Sequence[Float32Array | None] | npt.NDArray[np.float32]
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.images)

    def look(self, detector: SpotFinder) -> list[FrameSpots]:
        """Detect the beads of every frame, as `Frames` declares; a frame that is None is
        MISSING.
        """
        return [
            FrameSpots(nothing(self.shape), FrameState.MISSING)
            if image is None
            else look_at(np.ascontiguousarray(image, dtype=np.float32), detector)
            for image in self.images
        ]

    def windows(self, plan: Windows) -> Float32Array:
        """Cut the windows (n, k, side, side) of every frame, as `Frames` declares; nan
        for a frame that is None.
        """
        n, k = plan.corner.shape[:2]
        out = np.full((n, k, plan.side, plan.side), np.nan, dtype=np.float32)
        for i, image in enumerate(self.images):
            if image is not None:
                out[i] = crop(image, plan, i)
        return out


@dataclass(frozen=True, eq=False)
class SpotFrames:
    """Frames with known spots: detected before, or marked by hand.

    Attributes:
        looks: spots of each frame.
        images: of the spots; None if there are only positions.
    """

    looks: Sequence[FrameSpots]
    images: Frames | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols)."""
        return self.looks[0].detections.shape

    def __len__(self) -> int:
        return len(self.looks)

    def look(self, detector: SpotFinder) -> list[FrameSpots]:
        """Return the known spots, as `Frames` declares."""
        return list(self.looks)

    def windows(self, plan: Windows) -> Float32Array:
        """Cut the windows (n, k, side, side) of every frame from its images; all nan if
        there are only positions.
        """
        if self.images is not None:
            return self.images.windows(plan)
        return np.full(
            (*plan.corner.shape[:2], plan.side, plan.side), np.nan, dtype=np.float32
        )


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan of the phantom: its images and the nominal pose of each.

    `priors` are the standard deviations of the scanner's offsets [mm, deg, 1], see
    `fit.priors`. `index` (n, beads) is the spot of each bead in each frame (-1: unseen),
    where that is known. `arc` is the part of a step that the object turns while a frame
    is exposed, 0 where it is at rest; None: not stated.
    """

    frames: Frames
    poses: Poses
    name: str = "scan"
    priors: Mapping[str, float] = field(default_factory=lambda: ASSUMED)
    index: npt.NDArray[np.int64] | None = None
    arc: float | None = None


def require_scans(scans: Sequence[Scan]) -> None:
    """Check that every scan has frames, each with a pose, as seen from the source.

    Returns nothing; no scans at all pass.

    Raises:
        TwinError: names the scan, its frames and poses.
        GeometryError: rows are counted upwards, or columns from right to left.
    """
    for scan in scans:
        if len(scan.poses) != len(scan.frames) or len(scan.frames) == 0:
            raise TwinError(
                f"{scan.name}: {len(scan.frames)} frames and {len(scan.poses)} poses; "
                "allowed: as many of both, at least one"
            )
        require_seen_from_source(scan)


def require_frames_that_move(scans: Sequence[Scan]) -> None:
    """Check that every scan has enough frames for a motion: three.

    Raises:
        TwinError: says how many frames the shortest has.
    """
    least = min((len(scan.poses) for scan in scans), default=3)
    if least < 3:
        raise TwinError(
            f"motion in a scan of {least} frames; allowed: 3 or more",
            {"asked": least, "allowed": 3},
        )


def require_seen_from_source(scan: Scan) -> None:
    """Check in each view that rows are counted downwards (v does not point up), and
    columns from left to right as seen from the source.

    Raises:
        GeometryError: they are not; names the first view that is wrong, rows before
            columns.
    """
    p = scan.poses
    beam = ((p.detector - p.source) * np.cross(p.u, p.v)).sum(axis=1)
    for wrong, what, way in (
        (p.v[:, 2] > 0.0, "rows upwards (v points up)", "top to bottom"),
        (beam < 0.0, "columns from right to left, seen from the source", "left to right"),
    ):
        if wrong.any():
            raise GeometryError(
                f"{scan.name}: the geometry counts {what} in view {int(np.argmax(wrong))}; "
                "allowed: row 0 on top, column 0 on the left. Negate this vector, and flip the "
                f"images {way} if they are counted so, too (docs/exchange.md, rows up or down)",
                {"asked": what, "allowed": "row 0 on top, column 0 on the left"},
            )


def require_different(
    scans: Sequence[Scan], looks: Sequence[Sequence[FrameSpots]]
) -> None:
    """Check that no image is given in two scans, which would count as twice the evidence.

    No two images have the same noise, so no image has all its spots at another's places,
    to the last digit. Frames without spots, and repeats within a scan, are ignored.

    Args:
        scans: give the names.
        looks: spots of each frame of each scan.

    Raises:
        TwinError: names two scans that share images, and the number of frames.
    """
    known: dict[bytes, int] = {}
    for j, some in enumerate(looks):
        shadows = [
            look.detections.centers.tobytes() for look in some if len(look.detections)
        ]
        for i, again in Counter(known[s] for s in shadows if s in known).items():
            raise TwinError(
                f"scans {i + 1} and {j + 1} ({scans[i].name}, {scans[j].name}) hold the same "
                f"images ({again} of {len(some)} frames); give each image once",
                {"asked": [scans[i].name, scans[j].name], "frames": again},
            )
        known |= dict.fromkeys(shadows, j)
