"""What a model leaves of the residuals, and what further columns explain of that."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from flexdt.twin.geometry.conventions import FloatArray

LEAST_SHARE: Final = 1e-12
"""Part of a sum of squares that is rounding."""


class Score(NamedTuple):
    """What a piece explains.

    Attributes:
        gain: logarithm of its odds against none.
        width: of the displacements [mm].
        noise: standard deviation of the residuals that it leaves.
    """

    gain: float
    width: float
    noise: float


class Left:
    """What a model leaves of the residuals.

    Attributes:
        values: (m,) residuals.
        basis: (m, c) of what the model takes up, with its priors.
        along: (c,) products of both.
        noise: standard deviation of what is left.
    """

    def __init__(
        self, rows: FloatArray, widths: FloatArray, values: FloatArray, noise: float
    ) -> None:
        """Project the residuals.

        Args:
            rows, widths: (m, c) columns of the model, and (c,) widths of their priors.
            values: (m,) to be explained, priors of mean 0.
            noise: standard deviation of the values.
        """
        weight = np.where(np.isinf(widths), 0.0, noise / widths)
        size = np.sqrt(np.einsum("mc,mc->c", rows, rows) + weight**2)
        size = np.where(size > 0, size, 1.0)
        table = np.concatenate([rows / size, np.diag(weight / size)])
        self.values = values
        self.basis = np.linalg.qr(table)[0][: len(rows)]
        self.along = self.basis.T @ values
        square = float(values @ values)
        total = square - float(self.along @ self.along)
        self._total = max(total, LEAST_SHARE * square)
        self.noise = math.sqrt(self._total / len(values))

    def score(self, gram: FloatArray, push: FloatArray, width: float) -> Score:
        """Judge further columns of a width.

        Args:
            gram: (q, q) products of the columns, less what the model takes up.
            push: (q,) products with the residuals, likewise.
            width: of their priors.
        """
        one = np.eye(len(push))
        count = len(self.values)
        noise = self.noise
        for _ in range(2):
            whole = gram + (noise / width) ** 2 * one
            left = self._total - float(push @ np.linalg.solve(whole, push))
            left = max(left, LEAST_SHARE * self._total)
            noise = math.sqrt(left / count)
        volume = float(np.linalg.slogdet(one + gram * (width / noise) ** 2)[1])
        gain = -0.5 * (count * math.log(left / self._total) + volume)
        return Score(gain, width, noise)
