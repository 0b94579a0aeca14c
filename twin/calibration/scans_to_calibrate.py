"""Checks of the scans before anything is measured in them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from flexdt.twin.calibration.frame_source import (
    FrameSpots,
    Scan,
)
from flexdt.twin.errors import GeometryError, TwinError


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
