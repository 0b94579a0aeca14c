"""Scatter as transmission convolved with kernels that few simulated views are enough to fit.

A ray of transmission T scatters what is left of it wherever it is weakened, in proportion to
-T ln T (Ohnesorge et al., Eur. Radiol. 9 (1999) 563), and that spreads the more, the longer its way
to the panel: FDK says how far the scatterer stands away. Kernels are sums of Gaussians for each
material, superposed as by Sun and Star-Lack (Phys. Med. Biol. 55 (2010) 6695). Their amplitudes are
fitted to a Monte Carlo simulation of the object as it is first reconstructed (Baer and
Kachelriess, Phys. Med. Biol. 57 (2012) 6849). Views that were not fitted, simulated from the
corrected volume, say how far to trust them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.physics.chain import Chain
from flexdt.twin.physics.scatter import simulation
from flexdt.twin.physics.scatter.simulation import Object, ScanScatter, ScatterSettings
from flexdt.twin.projection import Volume, forward
from flexdt.twin.reconstruction import scatter_correction as correction

Shape = tuple[int, int]

WIDTHS = (0.1, 0.2, 0.4, 0.8, 1.6)
"""Standard deviations of the Gaussians, over the way from the scatterer to the panel."""
PLANES = 3
"""Ways for which Gaussians are evaluated in a view; scatterers between two count for both."""
SIMULATED = 10
"""Views of a scan that are simulated: every other one to fit kernels, the rest to check them."""
REPEATS = 6
"""Times that scatter is found from what remains without it."""
TOLERATED = 0.01
"""Error of the line integrals, relative to them, that the check takes without a warning."""


@dataclass(frozen=True, eq=False)
class KernelScatter:
    """Scatter of a scan by fitted kernels.

    Attributes:
        scatter: of the views.
        amplitudes: (materials, widths) of the Gaussians, parts of -T ln T.
        missed: how far simulated views that were not fitted are from them, as an error of the line
            integrals and relative to these; root mean squares.
        doubts: what is doubtful, in sentences.
    """

    scatter: ScanScatter
    amplitudes: FloatArray
    missed: float
    doubts: tuple[str, ...]


def kernel_scatter(
    line_integrals: Float32Array,
    cone_vec: ConeVec,
    chain: Chain,
    kV: float,
    settings: ScatterSettings | None = None,
    panels: tuple[ConeVec, tuple[int, int]] | None = None,
    amplitudes: FloatArray | None = None,
) -> KernelScatter:
    """Find the scatter of a circular scan by kernels.

    Args:
        line_integrals: float32 (n, rows, cols); coarse ones are enough.
        cone_vec: of the n views.
        chain: tube, panel and materials (see `scatterer_of`).
        kV: tube voltage.
        settings: of the simulations.
        panels: all views of the scan and their shape (rows, cols), of which the n are each k-th,
            with coarser pixels; default: the n themselves.
        amplitudes: of another scan's kernels, with the same materials, beam and panel; default:
            those fitted to this one.

    Raises:
        As `without_scatter`.

    Example:
        >>> from flexdt.twin.attenuation.substances import Substance
        >>> from flexdt.twin.physics.panel import Panel
        >>> scan = ConeVec.circular(sod=300, sdd=500, angles=36, shape=(20, 30), pixel=2)
        >>> chain = Chain(Panel(), substances=(Substance.of("water", "H2O", 1.0),))
        >>> air = np.zeros((36, 20, 30), np.float32)
        >>> float(kernel_scatter(air, scan, chain, 90.0).scatter.signal(0).max())
        0.0
    """
    wanted = ScatterSettings() if settings is None else settings
    stack = correction.as_stack(line_integrals, cone_vec)
    shape = correction.shape_of(stack)
    every, whole = (cone_vec, shape) if panels is None else panels
    known = np.arange(0, len(every), -(-len(every) // len(stack)))
    beam, (mu, straighten) = simulation.Beam.of(chain, kV), correction.attenuations(chain, kV)
    grid = correction.coarse_grid(cone_vec, shape, wanted)

    def reconstructed(integrals: Float32Array) -> tuple[Volume, Object]:
        volume = correction.volume_of(straighten(integrals), cone_vec, grid)
        return volume, correction.object_in(volume, chain, mu)

    def simulated(thing: Object, chosen: npt.NDArray[np.intp]) -> list[simulation.ScatterImage]:
        rows = cone_vec.rows
        return [simulation.scatter_image(thing, rows[i], shape, beam, wanted, i) for i in chosen]

    fitted, checked = np.linspace(0, len(stack) - 1, SIMULATED).astype(int).reshape(-1, 2).T
    _, thing = reconstructed(stack)
    images = simulated(thing, fitted)
    views = _Views.of(thing, mu, cone_vec, shape, images[0].mean.shape)
    if amplitudes is None:
        amplitudes = views.fitted(stack, fitted, images)
    direct = views.without_scatter(stack, amplitudes)
    means = [
        views.spread(i, direct[i], amplitudes, every.rows[k], whole).sum(axis=(0, 1))
        for i, k in enumerate(known)
    ]
    found = [replace(images[0], shape=whole, mean=m, error=0 * m, spread=0 * m) for m in means]

    volume, thing = reconstructed(direct)
    truth = np.stack([one.full() for one in simulated(thing, checked)])
    wrong = correction.subtracted(stack[checked], truth) - direct[checked]
    missed = math.sqrt((wrong**2).sum() / max((direct[checked] ** 2).sum(), 1e-9))
    dark = float(np.mean(1.0 - np.exp(stack - direct) > 0.999 * correction.MOST))
    doubts = correction.doubts_about(dark, volume, chain, mu)
    if missed > TOLERATED:
        doubts.append(
            f"scatter kernels miss {100 * missed:.1f} % of the line integrals in views whose "
            "scatter was simulated beside them: they do not describe this object; simulate it all"
        )
    way = simulation.way_of(every.rows)
    scan = ScanScatter(wanted, tuple(found), tuple(known.tolist()), way, way[known])
    return KernelScatter(scan, amplitudes, missed, tuple(doubts))


@dataclass(frozen=True, eq=False)
class _Views:
    """What weakens the rays of each view, and how far from the panel.

    Attributes:
        rows: (n, 12) of `ConeVec`.
        shape: rows and columns of their panels.
        nodes: rows and columns of the places on a panel where scatter is evaluated.
        parts: of the line integrals, by material, (m, n, rows, cols).
        gaps: from the middle of each material to the panel's plane [mm], 0 where it is not,
            (m, n, rows, cols).
    """

    rows: FloatArray
    shape: Shape
    nodes: Shape
    parts: FloatArray
    gaps: FloatArray

    @classmethod
    def of(
        cls, thing: Object, mu: FloatArray, cone_vec: ConeVec, shape: Shape, nodes: Shape
    ) -> _Views:
        """Of an object whose materials attenuate by `mu` [1/mm]."""
        paths, gaps = _paths(thing, cone_vec, shape)
        weakened = mu[:, None, None, None] * paths
        parts = weakened / np.maximum(weakened.sum(axis=0), 1e-12)
        return cls(cone_vec.rows, shape, nodes, parts, gaps)

    def spread(
        self, i: int, direct: Float32Array, amplitudes: FloatArray, panel: FloatArray, size: Shape
    ) -> FloatArray:
        """What each Gaussian brings to the nodes of a panel (12,) of `size` in view `i`, whose line
        integrals without scatter are `direct`, (m, widths, v, u)."""
        pixels = _places(self.rows[i], self.shape, self.shape, self.rows[i])
        at = _places(panel, size, self.nodes, self.rows[i])
        inside = np.clip(np.exp(-direct), 1e-30, 1.0)
        left = inside * np.log(inside)
        out = np.zeros((*amplitudes.shape, *self.nodes))
        for m, gap in enumerate(self.gaps[:, i]):
            there = gap[gap > 0.0] if gap.any() else np.ones(1)
            ways = np.unique(np.linspace(there.min(), there.max(), PLANES))
            between = max(float(np.ptp(ways)) / (PLANES - 1), 1e-9)
            for way, k in product(ways, np.flatnonzero(amplitudes[m])):
                share = self.parts[m, i] * np.maximum(1.0 - np.abs(gap - way) / between, 0.0)
                sigma = WIDTHS[k] * way
                down, across = (
                    np.exp(-0.5 * ((to[:, None] - pixel) / sigma) ** 2) * np.ptp(pixel[:2]) / sigma
                    for to, pixel in zip(at, pixels, strict=True)
                )
                out[m, k] -= down @ (share * left) @ across.T
        return np.asarray(out * amplitudes[..., None, None] / (2.0 * np.pi))

    def fitted(
        self,
        stack: Float32Array,
        chosen: npt.NDArray[np.intp],
        images: list[simulation.ScatterImage],
    ) -> FloatArray:
        """Amplitudes (m, widths) with which the chosen views scatter as simulated: the object as
        FDK shows it transmits what it was reconstructed from."""
        from scipy.optimize import nnls

        ones = np.ones((len(self.parts), len(WIDTHS)))
        columns = [self.spread(i, stack[i], ones, self.rows[i], self.shape) for i in chosen]
        matrix = np.stack(columns, axis=-1).reshape(ones.size, -1).T
        seen = np.stack([one.mean for one in images], axis=-1).ravel()
        return np.asarray(nnls(matrix, seen)[0].reshape(ones.shape))

    def without_scatter(self, stack: Float32Array, amplitudes: FloatArray) -> Float32Array:
        """Line integrals of what remains when the scatter that it causes is subtracted."""
        direct = stack.copy()
        for i, _ in product(range(len(stack)), range(REPEATS)):
            scatter = self.spread(i, direct[i], amplitudes, self.rows[i], self.shape)
            whole = simulation.spread_out(scatter.sum(axis=(0, 1)), self.shape)
            direct[i] = correction.subtracted(stack[i], whole)
        return direct


def _paths(thing: Object, cone_vec: ConeVec, shape: Shape) -> tuple[FloatArray, FloatArray]:
    """Path lengths through each material, and from their middle on to the panel's plane, 0 where
    there is none, (m, n, rows, cols) both [mm]."""
    like = Volume(thing.amounts[..., 0], thing.voxel_mm, thing.center_mm)
    x, y, z = like.centers()
    amounts = [like.like(one) for one in np.moveaxis(thing.amounts, -1, 0)]
    lengths, *moments = (
        np.array([forward(one.like(one.data * at), cone_vec, shape) for one in amounts])
        for at in (1.0, x, y[:, None], z[:, None, None])
    )
    normal = cone_vec.normal * np.sign(cone_vec.source_detector_distance)[:, None]
    middle = np.einsum("kmnrc,nk->mnrc", moments, normal) / np.maximum(lengths, 1e-12)
    ahead = (cone_vec.detector * normal).sum(axis=1)[:, None, None] - middle
    return lengths.astype(np.float64), np.where(lengths > 0.0, ahead, 0.0)


def _places(panel: FloatArray, size: Shape, counts: Shape, about: FloatArray) -> list[FloatArray]:
    """Places from corner to corner of a panel of (rows, cols), down and along its rows, from the
    centre of the panel `about` [mm]."""
    out = []
    for n, count, axis in zip(size, counts, (slice(9, 12), slice(6, 9)), strict=True):
        pitch = np.linalg.norm(panel[axis])
        aside = (panel[3:6] - about[3:6]) @ panel[axis] / pitch
        out.append(aside + pitch * np.linspace(-(n - 1) / 2, (n - 1) / 2, count))
    return out
