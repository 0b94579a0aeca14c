"""Frames whose spots are not where the fit to all frames has them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.diagnose import CalibrationCode, listed
from flexdt.twin.calibration.diagnose.frame_numbers import frame_numbers
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, nothing
from flexdt.twin.findings import Finding, error, warning
from flexdt.twin.geometry.conventions import FloatArray

BLOCK_SHARE = 0.7
"""Part of the frames of a block, from the first or to the last of a scan, that do not fit."""
MOST_LEFT_OUT: Final = 0.3
"""Largest part of a scan, frames or positions, that may be left out: a fit to less is a fit to
another scan."""
ASIDE: Final = ("dO_x", "dO_y", "dO_z", "alpha", "dD_x", "dD_y")
"""Parameters that are advised to differ between frames where all shadows stand aside."""
ASIDE_REST: Final = 0.2
"""Part of the shadows' distances from where they should be that stands for noise there."""
LEAST_ASIDE: Final = 4
"""Least number of shadows that are said to stand aside alike."""


def judge_places(fit: FitResult, looks: Sequence[Sequence[FrameSpots]]) -> list[Finding]:
    """Judge frames whose spots are not at the fitted places, each scan by itself.

    A frame is bad if most of its complete spots are 5 px or more from every prediction,
    or most positions were left out of the fit. Wrong frame numbers come first; then a
    block at an end ("angle_step"); else "frames_inconsistent", an error for more than 30
    % of the frames. Returns a finding a scan at most.
    """
    group = np.repeat(np.arange(len(looks)), [len(some) for some in looks])
    predicted = fit.problem.predictions(fit.solution.x)[0]
    out: list[Finding] = []
    for scan, some in enumerate(looks):
        detections = [
            nothing(look.detections.shape)
            if look.state is FrameState.REPEATED
            else look.detections
            for look in some
        ]
        out += listed(_judged_scan(fit, scan, group == scan, detections, predicted))
    return out


def _judged_scan(
    fit: FitResult,
    scan: int,
    own: npt.NDArray[np.bool_],
    detections: Sequence[Detections],
    predicted: FloatArray,
) -> Finding | None:
    """Judge the places of the spots of one scan, see `judge_places`.

    Args:
        fit: to the frames of all scans.
        scan: its number.
        own: which frames are its own.
        detections: spots of each of them.
        predicted: places of the beads in all frames.
    """
    of_scan = f" of scan {scan + 1}" if not own.all() else ""
    bad = _frames_off(fit, own, detections, predicted)
    if not bad:
        return None
    n = len(detections)
    whole = fit.certificate.used.sum(axis=1) > 0
    spread = float(np.nanmedian(fit.certificate.rms_per_frame[whole]))
    numbers = frame_numbers(
        detections,
        fit.beads,
        fit.problem.poses[np.flatnonzero(own)],
        fit.group_parameters[scan],
        2.0 * spread,
    )
    if numbers is not None:
        odd = numbers.judged(f"scan {scan + 1}" if of_scan else "the scan")
        if odd is not None:
            return odd
    # A frame of a block that happens to fit is of it all the same.
    at_end = bad[0] == 0 or bad[-1] == n - 1
    block = len(bad) >= BLOCK_SHARE * (bad[-1] - bad[0] + 1)
    block = block and at_end and 2 <= len(bad) < n
    listed_frames = ", ".join(str(i) for i in bad[:12])
    places_of = f"{bad[0]} to {bad[-1]}" if block else listed_frames
    if block and (aside := _aside(fit, np.flatnonzero(own)[bad].tolist())) is not None:
        column, row = aside.tolist()
        return error(
            CalibrationCode.FRAMES_INCONSISTENT,
            f"in frames {places_of} of {n}{of_scan} all shadows stand {column:+.1f} columns "
            f"and {row:+.1f} rows aside: the panel, the source or the object moved, or what "
            f"the camera reads of the panel: --per-frame {','.join(ASIDE)} follows it",
            per_frame=ASIDE,
        )
    if block:
        return error(
            CalibrationCode.ANGLE_STEP,
            f"in frames {places_of} of {n}{of_scan} the shadows are not where the others put "
            "them: frames are missing there, or the phantom slipped",
        )
    many = len(bad) > MOST_LEFT_OUT * n
    return (error if many else warning)(
        CalibrationCode.FRAMES_INCONSISTENT,
        f"in {len(bad)} of {n} frames{of_scan} ({places_of}) the shadows are not where the "
        "others put them" + ("" if many else "; those frames are not used"),
    )


def _frames_off(
    fit: FitResult,
    own: npt.NDArray[np.bool_],
    detections: Sequence[Detections],
    predicted: FloatArray,
) -> list[int]:
    """List the frames of a scan of which the fit left out most beads, or where most
    complete spots are at no bead's place; arguments as of `_judged_scan`.
    """
    seen = fit.problem.seen[own].sum(axis=1)
    used = fit.certificate.used[own].sum(axis=1)
    bad = set(np.flatnonzero((seen >= 2) & (used < 0.5 * seen)).tolist())
    for i, (d, beads) in enumerate(zip(detections, predicted[own], strict=True)):
        places = d.centers[d.whole]
        if len(places) < 2:
            continue
        gap = np.linalg.norm(beads[:, None] - places[None], axis=2).min(axis=0)
        near = int((gap < 5.0).sum())
        if near < 0.5 * min(len(places), len(beads)):
            bad.add(i)
    return sorted(bad)


def _aside(fit: FitResult, frames: Sequence[int]) -> FloatArray | None:
    """Compute by how much spots of some frames stand aside: measured minus predicted.

    `fit`: to all frames; `frames`: the frames.
    Returns (2,) columns and rows [px]: the median; None if it leaves more than `ASIDE_REST` of
    the distances (what turns moves shadows of near and far beads apart), or for fewer than
    `LEAST_ASIDE` spots.
    """
    off = (fit.problem.pixels - fit.problem.predictions(fit.solution.x)[0])[list(frames)]
    off = off[np.isfinite(off).all(axis=-1)]
    if len(off) < LEAST_ASIDE:
        return None
    middle = np.asarray(np.median(off, axis=0))
    rest = float(np.median(np.linalg.norm(off - middle, axis=1)))
    return middle if rest < ASIDE_REST * float(np.linalg.norm(middle)) else None
