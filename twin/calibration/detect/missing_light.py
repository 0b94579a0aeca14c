"""Light that is missing in all images, because the dark image is too bright: found behind beads
and given back.

A bead passes a share of the light that falls on it. So the light behind it is proportional to
that beside it, wherever the object's body takes some away. Scattered light and a beam that
hardens leave the bead more than that where the body is thick; a dark image that is too bright,
or a detector that is not linear, leaves it less.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.detect.windows import Windows, distances2
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

MISSING_SIGMAS: Final = 5.0
"""Standard deviations from which light is missing beyond doubt, as of lag."""
CORE_SHARE: Final = 0.4
"""Part of a spot's radius within which the light behind a bead is taken."""
RIM_SHARE: Final = 1.12
RIM_PX: Final = 2.0
"""Beyond this part of the major semi-axis and these pixels, light is beside a bead."""
LEAST_FRAMES: Final = 4
"""Spots from which a bead's share of the light, and what is missing, have an error."""
LEAST_BEADS: Final = 2
"""Beads that have to agree."""
MOST_TIED: Final = 0.5
"""Part of the pixels beside or behind a bead that may have the largest, or the least value:
more are saturated, or have no light left."""
ROUNDING: Final = 1e-6
"""Error of light, relative to the open beam, that is assumed at least."""


@dataclass(frozen=True)
class MissingLight:
    """Light that is missing in all pixels.

    Attributes:
        part: of the open beam; negative: there is more light, such as scattered one.
        sigma: standard deviation of it.
        dark: share of the spots that have no light left: how much they would have is lost.
    """

    part: float = 0.0
    sigma: float = math.inf
    dark: float = 0.0

    @property
    def seen(self) -> bool:
        """It is missing beyond doubt."""
        return self.part > MISSING_SIGMAS * self.sigma


def missing_light(
    images: Float32Array, plan: Windows, usable: npt.NDArray[np.bool_]
) -> MissingLight:
    """Estimate the light that is missing from how the light behind beads falls with that
    beside them.

    For each bead a line is fitted to both over the frames; where it reaches as much behind
    the bead as beside it, nothing but the missing light is left. The beads are averaged, and
    the standard deviation is the larger of that of the lines and that of the beads' scatter.

    Args:
        images: (n, k, side, side) line integrals, nan where there is none.
        plan: their places.
        usable: (n,) frames that count.

    Returns:
        The light; nothing is known where fewer than `LEAST_BEADS` tell something.
    """
    behind, beside, none_left = _light(images, plan)
    seen = np.isfinite(behind) & np.isfinite(beside) & usable[:, None]
    told = [
        _of_bead(behind[some, bead], beside[some, bead])
        for bead, some in enumerate(seen.T)
        if some.sum() >= LEAST_FRAMES
    ]
    if len(told) < LEAST_BEADS:
        return MissingLight()
    parts, variances = np.array(told).T
    weights = 1.0 / variances
    weights = weights / weights.sum()
    part = float(weights @ parts)
    own = 1.0 / float((1.0 / variances).sum())
    scatter = float(weights @ (parts - part) ** 2) / (len(parts) - 1)
    dark = float(none_left[seen].mean())
    return MissingLight(part, math.sqrt(max(own, scatter)), dark)


def with_light(images: Float32Array, part: float) -> Float32Array:
    """Add light, a part of the open beam, to line integrals (nan stays)."""
    return np.asarray(-np.log((np.exp(-images) + part) / (1.0 + part)), dtype=np.float32)


def _light(
    images: Float32Array, plan: Windows
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Average the light behind the middle of each complete, free spot, and beside it.

    Args:
        images: (n, k, side, side) line integrals.
        plan: their places.

    Returns:
        Both, (n, k), as parts of the open beam; nan without a spot, or where it is saturated
        beside it; and the spots of which most pixels have the least value, (n, k).
    """
    light = np.exp(-images.astype(np.float64))
    d2 = distances2(plan.corner, plan.side, plan.predicted)
    rim = RIM_SHARE * plan.radii * plan.stretch[..., 2] + RIM_PX
    core = d2 < (CORE_SHARE * plan.radii)[..., None, None] ** 2
    ring = (d2 > rim[..., None, None] ** 2) & (d2 < (0.5 * plan.side) ** 2)
    ring &= np.isfinite(light)
    behind = _mean(light, core)
    beside = _mean(light, ring)
    most = np.where(ring, light, -np.inf).max(axis=(2, 3))
    tied = (ring & (light == most[..., None, None])).sum(axis=(2, 3))
    clear = plan.whole & (tied <= MOST_TIED * ring.sum(axis=(2, 3)))
    least = np.where(core, light, np.inf).min(axis=(2, 3))
    lowest = (core & (light == least[..., None, None])).sum(axis=(2, 3))
    none_left = lowest > MOST_TIED * core.sum(axis=(2, 3))
    return np.where(clear, behind, np.nan), np.where(clear, beside, np.nan), none_left


def _mean(values: FloatArray, use: npt.NDArray[np.bool_]) -> FloatArray:
    """Average each window, (n, k), over the pixels to use; nan without any."""
    with np.errstate(invalid="ignore"):
        total = np.where(use, values, 0.0).sum(axis=(2, 3))
        return np.asarray(total / use.sum(axis=(2, 3)))


def _of_bead(behind: FloatArray, beside: FloatArray) -> tuple[float, float]:
    """Fit a line to the light behind a bead against that beside it.

    Args:
        behind, beside: (m,) parts of the open beam.

    Returns:
        The missing light and its variance.
    """
    middle = float(beside.mean())
    off = beside - middle
    power = max(float(off @ off), ROUNDING**2)
    passed = float(off @ behind) / power
    left = behind - behind.mean() - passed * off
    variance = float(left @ left) / (len(behind) - 2) + ROUNDING**2
    lever = max(1.0 - passed, ROUNDING)
    start = float(behind.mean()) - passed * middle
    return -start / lever, variance * (1.0 / len(behind) + middle**2 / power) / lever**2
