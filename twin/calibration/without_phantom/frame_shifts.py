"""Shifts of single frames: those that make planes through two sources agree.

The shift of the object in every frame, aside and down, follows from one linear system:
each pair of views adds as many equations for the shifts of its two frames as it sees
planes. Shifts that the object could make too, one common to all frames and one that turns
once with the stage, cannot be separated from the geometry and are left out. The shifts'
noise is that of an image made of noise alone, processed the same way. From it and the
shifts' own scatter follow their size, and the part of each that is kept where noise
dominates.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from flexdt.twin.calibration.without_phantom.plane_pairs import PlanePairs, without
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

SHIFT_ROUNDS: Final = 3
PRIOR_WEIGHT: Final = 1e-6
"""Weight that keeps shifts near 0 in directions that the images do not determine."""
MIN_EVIDENCE: Final = 6.0
"""Gain in log likelihood from which frames count as moving."""
ERROR_FACTOR: Final = 1.5
"""Factor on the errors estimated from disagreements and noise (assumed)."""
MIN_SQUARE_RATIO: Final = 5.0
"""Least ratio of squares of shifts to those of their errors (assumed)."""
LEAST_TOLD: Final = 0.1
"""Share of the slopes' squares that is the object's is taken to be this at least."""


class Shifts(NamedTuple):
    """Of the object in the binned frames, to the right and down, (n, 2) each [px]."""

    values: FloatArray
    sigmas: FloatArray
    evidence: tuple[float, float]


def find_shifts(
    pairs: PlanePairs, at: FloatArray, angle: FloatArray, random: np.random.Generator
) -> Shifts:
    """Estimate the shifts of all frames, without those that an offset of the object
    explains (constant, cosine and sine of the angle).

    Values are reduced by the part that noise and disagreement have in them.

    Args:
        pairs: the frames' pairs.
        at: arguments of their geometry.
        angle: of the stage in each frame, (n,) [rad].
        random: for the image of noise.

    Returns:
        Shifts right and down with sigmas [px of the binned frames], and the evidence of
        each direction (gain in log likelihood). In a direction of no more than
        `MIN_EVIDENCE`, or less than `MIN_SQUARE_RATIO`, shifts are 0 and sigmas nan.
    """
    n = len(angle)
    modes = np.column_stack([np.ones(n), np.cos(angle), np.sin(angle)])
    free = np.eye(n) - modes @ np.linalg.pinv(modes)
    values = np.zeros((n, 2))
    for _ in range(SHIFT_ROUNDS):
        system = _System(pairs, at, values)
        values = free @ (values - system.solve(system.rest))
    system = _System(pairs, at, values)
    image = pairs.noise(random)
    noise = system.of(image)
    # Slopes that are noise in part make the equations stiffer than what there is to be seen.
    object_share = np.maximum(1.0 - system.share(image), LEAST_TOLD)
    scatter = (free @ system.solve(noise)).var(axis=0) / np.square(object_share)
    # What planes disagree by beyond noise (sampling, beam hardening) is in the shifts as well.
    # A face along the beam is sampled alike in all pairs of a frame: more than they tell.
    scatter *= ERROR_FACTOR**2 * max(1.0, system.power(system.rest) / system.power(noise))
    found = values.var(axis=0)
    sigmas = np.zeros((n, 2))
    evidence = []
    for i, (s, v) in enumerate(zip(scatter.tolist(), found.tolist(), strict=True)):
        if v > s:
            gain = n / 2 * (v / s - 1.0 - math.log(v / s))
        else:
            gain = 0.0
        evidence.append(gain)
        if gain > MIN_EVIDENCE and v > MIN_SQUARE_RATIO * s:
            share = 1.0 - s / v
        else:
            share = 0.0
        values[:, i] *= share
        sigmas[:, i] = math.sqrt(share * s) if share else math.nan
    return Shifts(values, sigmas, (evidence[0], evidence[1]))


class _System:
    """Equations for changes of shifts, at given ones."""

    def __init__(self, pairs: PlanePairs, at: FloatArray, shifts: FloatArray) -> None:
        """Set up the normal equations of shifts of all frames, with pairs of one distance
        weighted by their usual disagreement.

        A weak prior about no change keeps them solvable.

        Args:
            pairs: of views.
            at: parameters of the geometry.
            shifts: (frames, 2) right and down, about which the equations are linear [px].
        """
        self.pairs = pairs
        self.at = at
        self.views = pairs.rows(at).copy()
        u = self.views[:, 6:9]
        v = self.views[:, 9:12]
        self.views[:, 3:6] -= shifts[:, :1] * u + shifts[:, 1:] * v
        found, self.ones = pairs.integrals(at, self.views)
        self.rest = self._difference(found)
        self.slopes = self._slopes(pairs.sums)
        usual = (
            np.add.reduceat(np.square(self.rest).sum(axis=1), pairs.starts) / pairs.sizes
        )
        self.weight = np.repeat(1.0 / np.maximum(usual, 1e-300), pairs.sizes)
        self.places = (2 * pairs.pairs[:, :, None] + [0, 1]).reshape(-1, 4)
        n = 2 * len(shifts)
        self.normal = np.zeros((n, n))
        blocks = np.einsum(
            "qak,qbk,q->qab", self.slopes, self.slopes, self.weight, optimize=True
        )
        np.add.at(self.normal, (self.places[:, :, None], self.places[:, None]), blocks)
        self.normal[np.diag_indices(n)] += (
            PRIOR_WEIGHT * np.trace(self.normal) / n + 1e-300
        )

    def _difference(self, found: FloatArray) -> FloatArray:
        return without(self.ones, found[:, 0] - found[:, 1], self.pairs.valid)

    def _slopes(self, sums: Float32Array) -> FloatArray:
        """Compute the change of the differences with both shifts of the first view, then
        of the second, by central differences of a pixel.

        Args:
            sums: running sums of the images.

        Returns:
            (q, 4, k): for each of q pairs right and down of the first view, right and
            down of the second.
        """
        parts = []
        for first in (6, 9):
            ends = []
            for sign in (0.5, -0.5):
                moved = self.views.copy()
                moved[:, 3:6] -= sign * moved[:, first : first + 3]
                ends.append(self.pairs.integrals(self.at, moved, sums)[0])
            change = ends[0] - ends[1]
            parts.append(
                [
                    without(self.ones, s * change[:, i], self.pairs.valid)
                    for i, s in ((0, 1.0), (1, -1.0))
                ]
            )
        return np.stack([parts[a][side] for side in (0, 1) for a in (0, 1)], axis=1)

    def share(self, noise: Float32Array) -> FloatArray:
        """Compute the share of noise in the squared slopes for either shift (right,
        down), (2,).

        Args:
            noise: images of noise, laid out as `PlanePairs.sums`.
        """
        own, all_ = (
            np.einsum("qak,qak,q->a", slopes, slopes, self.weight)
            .reshape(2, 2)
            .sum(axis=0)
            for slopes in (self._slopes(noise), self.slopes)
        )
        return np.asarray(own / np.maximum(all_, 1e-300))

    def of(self, sums: Float32Array) -> FloatArray:
        """Compute differences (q, k) in other images, laid out as `PlanePairs.sums`."""
        return self._difference(self.pairs.integrals(self.at, self.views, sums)[0])

    def solve(self, rest: FloatArray) -> FloatArray:
        """Solve by weighted least squares for the frames' shifts that would leave such
        differences.

        `rest`: (q, k).
        Returns (n, 2) right and down [px]."""
        right = np.zeros(len(self.normal))
        np.add.at(
            right, self.places, np.einsum("qak,qk,q->qa", self.slopes, rest, self.weight)
        )
        return np.asarray(np.linalg.solve(self.normal, right).reshape(-1, 2))

    def power(self, rest: FloatArray) -> float:
        """Compute the weighted sum of squares."""
        return float((self.weight[:, None] * np.square(rest)).sum())
