"""Size of the beads with its standard deviation, by the joint likelihood of size and blur.

Blur widens the shadow of a small ball as a larger ball does, and a beam that hardens changes its
rim: images tell sizes no better than they tell these apart. The spots are compared with rendered
ones by Gauss-Newton steps; size, blur and hardening are common to all, and each spot has its own
place, contrast and background. What these leave of the size is its variance; where that speaks
against the stated size, the likelihood of this one is asked: size and blur trade along a curve.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.detect.patches import Patches, usable
from flexdt.twin.calibration.detect.windows import (
    Windows,
    blur_kernel,
    blurred_light,
    distances2,
    rays_of,
    window_rays,
)
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere

HARDENING = 0.5
"""Standard deviation of a beam's hardening: variance of the attenuation over the square of its
mean (steel in light of 40 to 90 keV has 0.5, a veil of a tenth of the light 0.1)."""
FAINTEST = 0.02
"""Share of the light below which a pixel counts as if it had that much."""
STEP = 0.01
"""Change by which derivatives are taken: of logarithms, and of the blur's variance [px^2]."""
LARGEST_STEP = 0.2
"""Largest change of a logarithm, and of the hardening, in a round, as far as derivatives hold."""
LEAST_DAMPING = 0.1
"""Damping after the first step that leads away."""
MOST_ROUNDS = 12
DOUBTED = 2.0
"""Standard deviations by the slopes from which the likelihood of the stated size is asked."""
SETTLED = 0.3
"""Change in standard deviations below which a round is the last."""
LEAST_SPOTS = 3
LOG_SIZE, VARIANCE, SPREAD = range(3)
"""Places of what is common to all spots; the contrast is each spot's last own column."""


@dataclass(frozen=True)
class BeadSize:
    """Beads as the images have them.

    Attributes:
        size: factor on the radii.
        sigma: standard deviation of its logarithm.
        variance: of the blur [px^2].
        spread: of the attenuation, its variance over the square of its mean.
        contrast: factor on the line integrals through the middle, of the mean attenuation.
        wider: sigma over that of independent pixels.
    """

    size: float
    sigma: float
    variance: float
    spread: float = 0.0
    contrast: float = 1.0
    wider: float = 1.0

    def lift(self, peak: float) -> float:
        """Return the factor on the line integral `peak` that a bead shows in its middle where
        nothing blurs it.
        """
        return float(hardened(np.array(self.contrast * peak), self.spread)) / peak


@dataclass(frozen=True, eq=False)
class _Spots:
    """Spots as the images have them.

    Attributes:
        windows: m windows of one bead each.
        cone: geometry of each.
        light: (m, pixels) share of the beam.
        use: (m, pixels) that count.
    """

    windows: Windows
    cone: ConeVec
    light: FloatArray
    use: npt.NDArray[np.bool_]


def bead_size(
    patches: Patches,
    sample: npt.NDArray[np.intp],
    cone: ConeVec,
    balls: Scene,
    fine: int,
    first: BeadSize,
) -> BeadSize | None:
    """Estimate the size of the beads, and what else their shadows have in common, by steps that
    are damped where they lead away (Levenberg and Marquardt).

    Args:
        patches: windows of the images, less the body.
        sample: indices of complete spots.
        cone: geometry of the frames.
        balls: beads, for one energy, of which `first` and the result are factors.
        fine: rays along a pixel's side.
        first: to begin with; its variance is that of the blur besides the pixels'.

    Returns:
        The estimate; what a last step would still change counts as its standard deviation.
        None with fewer than `LEAST_SPOTS` spots that have light.
    """
    spots = _spots(patches, sample, cone)
    if len(spots.light) < LEAST_SPOTS:
        return None

    def compared(now: BeadSize) -> _Compared:
        return _compared(spots, balls, fine, now)

    found, best = _settled(compared, first)
    if abs(math.log(found.size)) < DOUBTED * found.sigma:
        return found
    stated, there = _settled(compared, replace(found, size=1.0), held=True)
    noise2 = best.misfit / best.freedom
    lost = (there.misfit - best.misfit) / noise2
    lost += (stated.spread**2 - found.spread**2) / HARDENING**2
    # Where the stated size is likelier, the best one may be as far on its other side.
    wide = found.wider * abs(math.log(found.size)) / math.sqrt(max(lost, 1.0))
    likeliest = found if lost > 0.0 else replace(stated, size=1.0)
    return replace(likeliest, sigma=max(found.sigma, wide))


def _settled(
    compared: Callable[[BeadSize], _Compared], first: BeadSize, *, held: bool = False
) -> tuple[BeadSize, _Compared]:
    """Step to the most likely beads.

    Args:
        compared: compares spots with rendered ones.
        first: to begin with.
        held: keep the size.

    Returns:
        The estimate; what a last step would still change counts as its standard deviation; and
        the comparison with it, or the one before where it is settled.
    """
    now = first
    best, damping = compared(now), 0.0
    for _ in range(MOST_ROUNDS):
        moved, settled = best.moved(now, damping, held=held)
        if settled and damping == 0.0:
            return moved, best
        there = compared(moved)
        if there.misfit > best.misfit:
            damping = max(10.0 * damping, LEAST_DAMPING)
            continue
        now, best = moved, there
        damping = 0.1 * damping if damping > LEAST_DAMPING else 0.0
    moved, _ = best.moved(now, 0.0, held=held)
    open_ = math.hypot(moved.sigma, math.log(moved.size / now.size))
    return replace(now, sigma=open_), best


def hardened(rays: FloatArray, spread: float) -> FloatArray:
    """Return line integrals as seen in polychromatic light: attenuation is Gamma
    distributed.

    `spread`: its variance over the square of its mean.
    """
    return np.asarray(rays if spread == 0.0 else np.log1p(spread * rays) / spread)


def _spots(patches: Patches, sample: npt.NDArray[np.intp], cone: ConeVec) -> _Spots:
    """Collect the light of those spots that have some, over that of their windows."""
    frames, beads = np.divmod(sample, patches.windows.corner.shape[1])
    few = patches.windows.pick(frames, beads)
    seen = patches.flat[sample].astype(np.float64)
    reach = (1.35 * few.radii * few.stretch[..., 2] + 3.0)[..., None] ** 2
    use = distances2(few.corner, few.side, few.predicted)[:, 0] < reach
    use &= (usable(patches, sample) > 0) & np.isfinite(seen)
    light = np.where(use, np.exp(-np.where(use, seen, 0.0)), 0.0)
    lit = light.any(axis=(1, 2))
    few = patches.windows.pick(frames[lit], beads[lit])
    m = int(lit.sum())
    return _Spots(
        few, cone[frames[lit]], light[lit].reshape(m, -1), use[lit].reshape(m, -1)
    )


@dataclass(frozen=True, eq=False)
class _Compared:
    """Spots less rendered ones, without what each spot has of its own; all in the noise of a
    pixel in the open beam.

    Attributes:
        columns: (m, pixels, 3) changes with what is common to all spots.
        left: (m, pixels) difference.
        gram, right: (3, 3), (3,) normal equations of all spots.
        contrast: (m, 4) change of each spot's contrast, less what the common changes take.
        freedom: pixels less what is estimated.
    """

    columns: FloatArray
    left: FloatArray
    gram: FloatArray
    right: FloatArray
    contrast: FloatArray
    freedom: int

    @property
    def misfit(self) -> float:
        """Sum of squares."""
        return float(np.square(self.left).sum())

    def moved(
        self, now: BeadSize, damping: float, *, held: bool = False
    ) -> tuple[BeadSize, bool]:
        """Return a better estimate than `now`, of its size if that is `held`, and whether it is
        settled.
        """
        best = np.linalg.lstsq(self.gram, self.right)[0]
        noise2 = max(self.misfit - float(self.right @ best), 0.0) / self.freedom
        gram, right = self.gram.copy(), self.right.copy()
        gram[SPREAD, SPREAD] += noise2 / HARDENING**2
        right[SPREAD] -= now.spread * noise2 / HARDENING**2
        if held:
            gram[LOG_SIZE, LOG_SIZE + 1 :] = gram[LOG_SIZE + 1 :, LOG_SIZE] = 0.0
            right[LOG_SIZE] = 0.0
        inverse = np.linalg.inv(gram)
        gram += damping * np.diag(np.diag(gram))
        change = _bounded(gram, right, np.array([-np.inf, -now.variance, -now.spread]))
        # Errors of the profile, and noise that neighbours share, differ from spot to spot.
        rest = self.left - self.columns @ change
        scores = np.einsum("mpi,mp->mi", self.columns, rest) @ inverse
        by_spots = np.square(scores).sum(axis=0)
        by_noise = noise2 * np.diag(inverse)
        sigmas = np.sqrt(np.maximum(by_noise, by_spots))
        contrast = float(np.median(self.contrast[:, -1] - self.contrast[:, :-1] @ change))
        most = max(abs(contrast), *np.abs(change[[LOG_SIZE, SPREAD]]).tolist())
        share = min(1.0, LARGEST_STEP / max(most, LARGEST_STEP))
        change, contrast = share * change, share * contrast
        found = BeadSize(
            now.size * math.exp(change[LOG_SIZE]),
            float(sigmas[LOG_SIZE]),
            max(now.variance + float(change[VARIANCE]), 0.0),
            max(now.spread + float(change[SPREAD]), 0.0),
            now.contrast * math.exp(contrast),
            float(sigmas[LOG_SIZE]) / math.sqrt(float(by_noise[LOG_SIZE]) + 1e-300),
        )
        return found, bool((np.abs(change[:2]) < SETTLED * sigmas[:2]).all())


def _compared(spots: _Spots, balls: Scene, fine: int, now: BeadSize) -> _Compared:
    """Compare the spots with rendered ones."""
    base, common, own = _drawn(spots, balls, fine, now)
    level = spots.light.sum(axis=1) / (base * spots.use).sum(axis=1)
    weight = spots.use / np.sqrt(np.maximum(base, FAINTEST))
    seen = (spots.light / level[:, None] - base) * weight
    basis, corner = np.linalg.qr(own * weight[..., None])
    some = np.concatenate([common * weight[..., None], seen[..., None]], axis=2)
    taken = basis.swapaxes(1, 2) @ some
    some = some - basis @ taken
    columns, left = some[..., :-1], some[..., -1]
    freedom = int(spots.use.sum()) - own.shape[2] * len(own) - columns.shape[2]
    return _Compared(
        columns,
        left,
        np.einsum("mpi,mpj->ij", columns, columns),
        np.einsum("mpi,mp->i", columns, left),
        np.linalg.solve(corner, taken)[:, -1],
        max(freedom, 1),
    )


def _bounded(gram: FloatArray, right: FloatArray, least: FloatArray) -> FloatArray:
    """Solve normal equations; what would fall below its least value has that.

    Args:
        gram: (n, n).
        right: (n,).
        least: (n,), not above 0.
    """
    out = np.zeros_like(right)
    free = np.ones(len(right), np.bool_)
    while free.any():
        rest = right - gram[:, ~free] @ out[~free]
        out[free] = np.linalg.solve(gram[np.ix_(free, free)], rest[free])
        low = free & (out < least)
        if not low.any():
            break
        free &= ~low
        out[low] = least[low]
    return out


def _drawn(
    spots: _Spots, balls: Scene, fine: int, now: BeadSize
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Render spots, and how they change.

    Args:
        spots: where.
        balls: beads, for one energy, of the size and contrast to begin with.
        fine: rays along a pixel's side.
        now: the estimate.

    Returns:
        Light (m, pixels); its changes with what is common to all spots, (m, pixels, 3); and with
        what each has of its own: background, place and contrast, (m, pixels, 6).
    """
    few = spots.windows
    m, side = len(few.corner), few.side
    one = _sized(balls, now.size, now.contrast)
    larger = _sized(one, 1.0 + STEP, 1.0)
    light = np.zeros((4, m, side, side))
    for view, place, weight in rays_of(spots.cone, few, fine):
        rays, wide = (
            window_rays(ball, view, few, place)[:, 0].astype(np.float64)
            for ball in (one, larger)
        )
        shown = np.stack(
            [
                hardened(rays, now.spread),
                hardened(wide, now.spread),
                hardened((1.0 + STEP) * rays, now.spread),
                hardened(rays, now.spread + STEP),
            ]
        )
        light += weight[None, :, :, None] * np.exp(-shown)
    light = blurred_light(light, blur_kernel(math.sqrt(now.variance)))
    base = light[0]
    blurred = blurred_light(base, blur_kernel(math.sqrt(STEP)))
    size, contrast, spread = (light[1:] - base) / STEP
    i = np.arange(side) - 0.5 * (side - 1)
    down, across = np.gradient(base, axis=(1, 2))
    common = [size, (blurred - base) / STEP, spread]
    own = [base, base * i, base * i[:, None], across, down, contrast]
    return (
        base.reshape(m, -1),
        np.stack(common, axis=3).reshape(m, side * side, -1),
        np.stack(own, axis=3).reshape(m, side * side, -1),
    )


def _sized(balls: Scene, size: float, contrast: float) -> Scene:
    """Return balls of another size and contrast in the middle, each a factor."""
    out = []
    for solid in balls.solids:
        assert isinstance(solid.shape, Sphere)
        ball = replace(solid.shape, radius=solid.shape.radius * size)
        out.append(Solid(ball, solid.material, solid.mu_per_mm * contrast / size))
    return Scene(tuple(out))
