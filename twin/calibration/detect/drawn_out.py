"""Shadows that an exposure draws out along the paths of their beads, so that few look round.

Told without a measured spot, from the second moments of the light in windows where the beads
are expected: along its path a shadow's variance is larger than across by that of the path. A
detector that blurs more along rows than along columns draws shadows out, too, but all alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import BLUR_PX
from flexdt.twin.calibration.detect.smear import LEAST_SPOTS, Smear
from flexdt.twin.calibration.detect.windows import Turning, Windows, ways
from flexdt.twin.calibration.repeated_frames import ROBUST
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

LEAST_DARK = 0.1
"""Light that a pixel of a shadow lacks at least, as a share of the darkest's: above noise."""
ROUNDS = 30
"""Steps to the least sum of absolute residuals."""
LEAST_LEFT = 1e-4
"""Residual, as a share of the largest, below which its weight does not grow."""
MOST_CONDITION = 1e6
"""Condition number of the normal equations from which paths do not tell the arc from blur."""
CERTAIN_SIGMAS = 5.0
"""Standard deviations of the mean from which an arc is certain."""


@dataclass(frozen=True)
class DrawnOut:
    """An arc by which shadows are drawn out.

    Attributes:
        squared: square of the share of a step that an exposure lasts.
        sigma: its standard deviation, by the scatter of the shadows; inf: not determined.
    """

    squared: float
    sigma: float

    @property
    def certain(self) -> bool:
        """Whether the shadows are longer along their paths beyond doubt."""
        return self.squared > CERTAIN_SIGMAS * self.sigma

    @property
    def share(self) -> float:
        """Share of a step that an exposure lasts."""
        return math.sqrt(max(self.squared, 0.0))

    @property
    def smear(self) -> Smear:
        """The smear from which spots are followed, of images with a usual blur."""
        return Smear(self.squared, self.sigma, True, BLUR_PX)


def drawn_out(
    images: Float32Array, windows: Windows, model: BeadModel, turning: Turning
) -> DrawnOut:
    """Estimate the arc of an exposure from the second moments of free, complete shadows.

    Shadows are longer by the square of their paths, and by a blur that is not round.

    Args:
        images: (n, k, side, side) line integrals.
        windows: their places.
        model: the beads.
        turning: geometry within an exposure.
    """
    way = ways(windows, model, turning)
    told = windows.whole & np.isfinite(images).all(axis=(2, 3))
    told &= np.linalg.norm(way, axis=2) > 0.0
    if told.sum() < LEAST_SPOTS:
        return DrawnOut(0.0, math.inf)
    paths = way[told]
    square = np.square(paths).sum(axis=1)
    along = paths / np.sqrt(square)[:, None]
    longer = [_longer(one, to) for one, to in zip(images[told], along, strict=True)]
    x, y = along.T
    columns = np.column_stack([square / 12.0, x**2 - y**2, 2.0 * x * y])
    return _robust(columns, np.array(longer))


def _robust(columns: FloatArray, values: FloatArray) -> DrawnOut:
    """Fit columns to values with the least sum of absolute residuals.

    Args:
        columns: (m, 3), that of the squared share of a step first.
        values: (m,).
    """
    gram = columns.T @ columns
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    if np.linalg.cond(gram / np.outer(scale, scale)) > MOST_CONDITION:
        return DrawnOut(0.0, math.inf)
    weight = np.ones(len(values))
    for _ in range(ROUNDS):
        found = np.linalg.solve(
            (columns.T * weight) @ columns, columns.T @ (weight * values)
        )
        left = np.abs(values - columns @ found)
        weight = 1.0 / np.maximum(left, LEAST_LEFT * max(float(left.max()), 1e-12))
    scatter = ROBUST * float(np.median(left))
    unit = float(np.linalg.inv(gram)[0, 0])
    return DrawnOut(float(found[0]), scatter * math.sqrt(0.5 * math.pi * unit))


def _longer(image: Float32Array, along: FloatArray) -> float:
    """Compute by how much the variance of a shadow is larger along a direction than across
    it [px^2]; 0 without a shadow.
    """
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    dark = 1.0 - np.exp(np.median(border) - image)
    weight = np.maximum(dark - LEAST_DARK * dark.max(), 0.0)
    if not weight.any():
        return 0.0
    y, x = np.mgrid[: len(image), : len(image)]
    one = along[0] * x + along[1] * y
    other = along[0] * y - along[1] * x
    means = (np.average(part, weights=weight) for part in (one, other))
    first, second = (
        np.average((part - mean) ** 2, weights=weight)
        for part, mean in zip((one, other), means, strict=True)
    )
    return float(first - second)
