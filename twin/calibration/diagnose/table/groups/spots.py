"""Errors of spots: each bead's positions err smoothly as the object turns, or slowly, or all
err with their place within a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.polynomial.chebyshev import chebvander

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.table.group import (
    Acts,
    Family,
    Found,
    Known,
)
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.conventions import FloatArray

NAME: Final = "spots"
WORDS: Final = "errors of single spots that change slowly"
LOG_CHANCE_OF_ERRORS: Final = math.log(0.5)
"""Logarithm of the probability that spots have such errors: by far more often than anything moves
or distorts, however small they are (assumed)."""
KINDS: Final = 4
"""Kinds of errors, which share the odds."""
HARMONICS: Final = 3
LEAST_FRAMES: Final = 16
MOST_WAVES: Final = 16
"""Half waves over the scan, of slow errors."""
MOST_COLUMNS: Final = 360
"""Columns of slow errors, from which the waves of many beads are fewer."""
WITHIN: Final = "within their pixels"
PIXEL_HARMONICS: Final = 2
"""Of the distance between pixels, of errors that repeat from pixel to pixel."""
MOST_WITHIN_PX: Final = 0.5
"""Largest of them: a center lies in its pixel."""
BEAD_ERROR_SPREADS: Final = 1.0
"""Errors, in standard deviations of a position, up to which they widen the intervals alone and are
no finding."""


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make errors that repeat with the turn, errors that follow a spot's column (its size,
    its distance, a slope), and errors that are slow, of each coordinate of each bead's
    positions; and errors of all spots that repeat from pixel to pixel.
    """
    if table.n < LEAST_FRAMES:
        return
    number = np.arange(HARMONICS + 1)
    turn = table.problem.poses.angle[:, None] * number
    size = 1.0 / np.maximum(number, 1)
    size[0] = math.hypot(*size[1:])  # What stays is as large as all that changes.
    harmonics = np.concatenate(
        [size * np.cos(turn), size[1:] * np.sin(turn[:, 1:])], axis=1
    )
    place = (np.arange(table.n) + 0.5) / table.n
    waves = np.arange(
        min(MOST_WAVES, max(MOST_COLUMNS // (2 * table.k) - 1, HARMONICS)) + 1
    )
    slow = np.cos(math.pi * place[:, None] * waves) / np.sqrt(1.0 + (waves / 4.0) ** 2)
    column = table.places[..., 0]
    middle = (column.max(axis=0) + column.min(axis=0)) / 2.0
    reach = np.maximum(np.ptp(column, axis=0) / 2.0, 1.0)
    # Chebyshev's polynomials: of a circle these are the harmonics that are even about its ends.
    along = chebvander((column - middle) / reach, HARMONICS) * size
    along = np.repeat(along.transpose(1, 0, 2), 2, axis=0)
    problem = table.problem
    enlarged = float(np.median(problem.poses.sdd / problem.poses.sod))
    pixel = float(np.median(np.linalg.norm(problem.poses.u, axis=1)))
    radius = enlarged * float(np.median(problem.model.bead_radius_mm)) / pixel
    slopes = table.spot_slopes[None]
    count = slopes.shape[1]
    for how, each in (
        ("with the turn", np.broadcast_to(harmonics, (count, *harmonics.shape))),
        ("along their way", along),
        ("slowly", np.broadcast_to(slow, (count, *slow.shape))),
    ):
        yield Family(
            NAME,
            (f"spots err {how}",),
            Acts.IMAGE,
            (how,),
            LOG_CHANCE_OF_ERRORS - math.log(KINDS),
            slopes=slopes,
            courses=_each_by_itself(each)[None],
            widest=radius,  # A spot is not found beside its ball.
        )
    yield Family(
        NAME,
        (f"spots err {WITHIN}",),
        Acts.IMAGE,
        (WITHIN,),
        LOG_CHANCE_OF_ERRORS - math.log(KINDS),
        table.rows_of(_within_pixels(table.places))[None],
        widest=MOST_WITHIN_PX,
    )


def _within_pixels(places: FloatArray) -> FloatArray:
    """Make shifts of spots (n, k, 2, c) that repeat from pixel to pixel along each axis: what
    sampling by pixels does to the center of a shadow.
    """
    phase = 2.0 * math.pi * places[..., None] * np.arange(1, PIXEL_HARMONICS + 1)
    waves = np.concatenate([np.cos(phase), np.sin(phase)], axis=3)
    count = waves.shape[3]
    out = np.zeros((*places.shape, 2 * count))
    for axis in (0, 1):
        out[:, :, axis, axis * count : (axis + 1) * count] = waves[:, :, axis]
    return out


def _each_by_itself(courses: FloatArray) -> FloatArray:
    """Give each slope columns of its own for its courses, (s, n, c): (s, n, s c)."""
    s, n, c = courses.shape
    out = np.zeros((s, n, s, c))
    out[np.arange(s), :, np.arange(s)] = courses
    return out.reshape(s, n, s * c)


def told(found: Found) -> list[Finding]:
    """Tell errors of spots that exceed the noise of a position."""
    seen = found.of(NAME)
    within = all(s.place == WITHIN for s in seen)
    how = "with their place within a pixel" if within else "smoothly as the object turns"
    size = math.sqrt(sum(s.effect_px**2 for s in seen))
    spread = found.fit.certificate.rms_px  # which contains them
    if not seen or 2.0 * size**2 < BEAD_ERROR_SPREADS**2 * spread**2:
        return []
    return [
        warning(
            CalibrationCode.BEAD_ERRORS,
            f"single beads err by about {size:.2g} px, {how} (bead positions, background, "
            "distortion, sampling): the intervals allow for it",
        )
    ]
