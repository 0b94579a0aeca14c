"""What an object has in it beside its outline's own material, as coarse pixels.

Views that a panel cuts off do not tell a wrong outline from a smooth change of the inside. Few
things do: of all insides that explain the views, the one with the least sum of absolute values is
taken (Tibshirani, J. R. Stat. Soc. B 58 (1996) 267), and the outline's numbers go free with it. So
voids and dense things may cover most rays, as long as they do not fill most of the field of view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexdt.twin.geometry.conventions import FloatArray

SIDE = 28
"""Pixels across the field of view."""
STRENGTH = 1e-3
"""Weight of the sum of absolute values, relative to that at which no thing would be left."""
ROUNDS = 150
"""Of the fast iterative shrinkage (Beck and Teboulle, SIAM J. Imaging Sci. 2 (2009) 183)."""


@dataclass(frozen=True, eq=False)
class Things:
    """Pixels in the field of view, and how the rays of some views cross them.

    Attributes:
        lengths: (rays, pixels) [mm].
        gram: products of its columns (pixels, pixels).
        steepest: largest eigenvalue of `gram`.
    """

    lengths: FloatArray
    gram: FloatArray
    steepest: float

    @classmethod
    def of(cls, source: FloatArray, rays: FloatArray, radius: float) -> Things:
        """Of rays (n, k, 2) from sources (n, 1, 2), in a field of view about the origin [mm]."""
        along = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        foot = source - (source * along).sum(axis=-1, keepdims=True) * along
        half = np.sqrt(np.maximum(radius**2 - (foot**2).sum(axis=-1), 0.0)).reshape(-1, 1)
        steps = np.linspace(-1.0, 1.0, 4 * SIDE + 1)[1::2]
        points = foot.reshape(-1, 1, 2) + (half * steps)[..., None] * along.reshape(-1, 1, 2)
        place = (points / radius + 1.0) / 2.0 * SIDE - 0.5
        corner = np.clip(np.floor(place), 0, SIDE - 2).astype(np.intp)
        part = np.clip(place - corner, 0.0, 1.0)
        step = np.broadcast_to(half * 2.0 / len(steps), part.shape[:2])
        first = np.arange(len(half))[:, None] * SIDE**2
        lengths = np.zeros(len(half) * SIDE**2)
        for a, b in np.ndindex(2, 2):
            share = np.abs(1 - a - part[..., 0]) * np.abs(1 - b - part[..., 1]) * step
            pixel = first + (corner[..., 1] + b) * SIDE + corner[..., 0] + a
            lengths += np.bincount(pixel.ravel(), share.ravel(), lengths.size)
        at = (np.arange(SIDE) + 0.5) / SIDE * 2.0 - 1.0
        in_sight = (np.hypot(at[:, None], at) < 1.0).ravel()
        lengths = lengths.reshape(-1, SIDE**2)[:, in_sight]
        gram = lengths.T @ lengths
        return cls(lengths, gram, float(np.linalg.eigvalsh(gram)[-1]))

    def found(
        self, rest: FloatArray, slopes: FloatArray, weight: float, near: FloatArray
    ) -> FloatArray:
        """Attenuations (pixels,) that explain what an outline leaves of the views, few of them.

        Args:
            rest: (rays,) line integrals less the outline's.
            slopes: (rays, numbers) of the outline's integrals: what changes of its numbers
                explain is not the things'.
            weight: of the sum of absolute values.
            near: (pixels,) to start from.
        """
        basis, triangle = np.linalg.qr(slopes)
        size = np.abs(np.diag(triangle))
        basis = basis[:, size > 1e-6 * size.max()]
        shared = basis.T @ self.lengths
        gram = self.gram - shared.T @ shared
        wanted = self.lengths.T @ rest - shared.T @ (basis.T @ rest)
        now, ahead, speed = near, near, 1.0
        for _ in range(ROUNDS):
            moved = ahead - (gram @ ahead - wanted) / self.steepest
            after = np.sign(moved) * np.maximum(np.abs(moved) - weight / self.steepest, 0.0)
            faster = 0.5 + np.sqrt(0.25 + speed * speed)
            ahead = after + (speed - 1.0) / faster * (after - now)
            now, speed = after, faster
        return np.asarray(now)

    def weight(self, seen: FloatArray) -> float:
        """Of the sum of absolute values, for views (rays,)."""
        return float(STRENGTH * np.abs(self.lengths.T @ seen).max())
