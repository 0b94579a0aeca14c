"""Closed forms of what a pixel sees: chords of drawn bodies by their own formulas, averaged over
the pixel by fine quadrature. Shares no code with the projectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
COARSE, FINE = 6, 40
"""Points along each side of a pixel, and of one in which they differ."""
BLOCK = 400_000
"""Rays at a time."""


@dataclass(frozen=True)
class Drawn:
    """A body in a frame of its own: `kind` sphere, cylinder, box or cone (tip up, about its
    middle), half sizes or radius and half height [mm], turned by rows of `axes`."""

    kind: str
    size: tuple[float, float, float]
    axes: Array
    center: Array
    mu: float

    def chords(self, source: Array, rays: Array) -> Array:
        """Lengths of rays (..., 3) from a source within the body [mm]."""
        s = self.axes @ (source - self.center)
        d = rays @ self.axes.T
        length = np.linalg.norm(d, axis=-1)
        with np.errstate(all="ignore"):
            if self.kind == "box":
                low, high = _slab(s, d, np.array(self.size))
            elif self.kind == "sphere":
                low, high = _roots(
                    (d * d).sum(-1), (d * s).sum(-1), s @ s - self.size[0] ** 2
                )
            elif self.kind == "cylinder":
                low, high = _roots(
                    d[..., 0] ** 2 + d[..., 1] ** 2,
                    d[..., 0] * s[0] + d[..., 1] * s[1],
                    s[0] ** 2 + s[1] ** 2 - self.size[0] ** 2,
                )
                ends = _slab(s[2:], d[..., 2:], np.array(self.size[2:]))
                low, high = np.maximum(low, ends[0]), np.minimum(high, ends[1])
            else:
                return self._cone(s, d) * length
        return np.maximum(high - low, 0.0) * length

    def _cone(self, s: Array, d: Array) -> Array:
        """Parts of rays within a cone of radius size[0] at z = -size[2] and tip at size[2]."""
        radius, half = self.size[0], self.size[2]
        k = (radius / (2 * half)) ** 2
        h = half - s[2]  # height of the tip above the source
        a = d[..., 0] ** 2 + d[..., 1] ** 2 - k * d[..., 2] ** 2
        b = d[..., 0] * s[0] + d[..., 1] * s[1] + k * h * d[..., 2]
        c = s[0] ** 2 + s[1] ** 2 - k * h**2
        root = np.sqrt(np.maximum(b * b - a * c, 0.0))
        # Where it crosses surface and base: it is inside between two of these, or nowhere.
        cuts = np.sort(
            np.stack([(-b - root) / a, (-b + root) / a, -(half + s[2]) / d[..., 2]]),
            axis=0,
        )
        total = np.zeros(a.shape)
        for low, high in pairwise(cuts):
            middle = 0.5 * (low + high)
            x, y, z = (s[i] + middle * d[..., i] for i in range(3))
            room = radius * (half - z) / (2 * half)
            inside = (z > -half) & (z < half) & (x * x + y * y < room * room)
            total += np.where(inside, high - low, 0.0)
        return total


def _slab(s: Array, d: Array, half: Array) -> tuple[Array, Array]:
    one, two = (-half - s) / d, (half - s) / d
    return np.minimum(one, two).max(-1), np.maximum(one, two).min(-1)


def _roots(a: Array, b: Array, c: float) -> tuple[Array, Array]:
    square = b * b - a * c
    root = np.sqrt(np.maximum(square, 0.0))
    return (-b - root) / a, np.where(square > 0, (-b + root) / a, -np.inf)


def line_integrals(bodies: Sequence[Drawn], source: Array, rays: Array) -> Array:
    """Sums over bodies of chord times attenuation, of rays (..., 3)."""
    return np.asarray(sum(body.mu * body.chords(source, rays) for body in bodies))


def area_means(
    bodies: Sequence[Drawn],
    row: Array,
    shape: tuple[int, int],
    *,
    counts: bool = False,
    everywhere: bool = False,
) -> Array:
    """Means over each pixel of the line integrals of a view (12,), (rows, cols), or of their
    transmission; `everywhere` has the fine points in all pixels."""
    rows, cols = shape
    source, u, v = row[:3], row[6:9], row[9:12]
    first = row[3:6] - source - 0.5 * (cols - 1) * u - 0.5 * (rows - 1) * v
    r, c = (x.ravel() for x in np.mgrid[:rows, :cols])

    def seen(pixels: npt.NDArray[Any], points: int) -> Array:
        """Values along points^2 rays of some pixels, (k, points^2)."""
        at = (np.arange(points) + 0.5) / points - 0.5
        y, x = (z.ravel() for z in np.meshgrid(at, at, indexing="ij"))
        out = np.empty((len(pixels), points**2))
        step = max(1, BLOCK // points**2)
        for i in range(0, len(pixels), step):
            some = pixels[i : i + step]
            across, down = c[some, None] + x, r[some, None] + y
            rays = first + across[..., None] * u + down[..., None] * v
            out[i : i + step] = line_integrals(bodies, source, rays)
        return np.exp(-out) if counts else out

    all_pixels = np.arange(rows * cols)
    if everywhere:
        return seen(all_pixels, FINE).mean(1).reshape(shape)
    coarse = seen(all_pixels, COARSE)
    means = coarse.mean(1)
    # Edges within a pixel, and those between its outermost points and its neighbour's.
    least = 5e-3 * np.ptp(coarse)
    image = means.reshape(shape)
    varied = (np.ptp(coarse, axis=1) > least).reshape(shape)
    for one, other in (
        (np.s_[1:], np.s_[:-1]),
        (np.s_[:, 1:], np.s_[:, :-1]),
    ):
        apart = np.abs(image[one] - image[other]) > least
        varied[one] |= apart
        varied[other] |= apart
    again = np.flatnonzero(varied)
    means[again] = seen(again, FINE).mean(1)
    return means.reshape(shape)


def drawn_objects(seed: int) -> list[Drawn]:
    """Draw one soft body with one to three dense ones in it, of the four kinds; those of every
    other seed stand upright, so that their edges follow rows and columns."""
    rng = np.random.default_rng([seed, 79])
    kinds = ["sphere", "cylinder", "box", "cone"]

    def turned() -> Array:
        if seed % 2:
            return np.eye(3)
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        return np.asarray(q * np.sign(np.linalg.det(q)))

    def body(kind: str, size: float, center: Array, mu: float) -> Drawn:
        a, b, c = size * rng.uniform(0.6, 1.0, 3)
        return Drawn(kind, (a, a if kind != "box" else b, c), turned(), center, mu)

    soft = body(kinds[seed % 4], rng.uniform(5, 7.5), rng.uniform(-1, 1, 3), 0.02)
    bodies = [soft]
    for _ in range(rng.integers(1, 4)):
        kind = kinds[rng.integers(4)]
        place = soft.center + rng.uniform(-3, 3, 3)
        bodies.append(body(kind, rng.uniform(0.3, 2.5), place, rng.uniform(0.1, 0.6)))
    return bodies
