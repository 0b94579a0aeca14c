"""Corrections of line integrals before reconstruction: rings and beam hardening.

Flat field and logarithm are in `flexdt.twin.dataset`. A ring comes from a pixel whose error stays
the same in all views; beam hardening comes from low energies being absorbed first. The correction
is for objects of a single material and leaves scattered radiation as it is.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.physics.chain import Chain, weights_of
from flexdt.twin.physics.panel import Panel
from flexdt.twin.physics.spectrum import TubeModel

RING_WIDTH = 9
"""Columns over which a pixel is compared with its neighbours."""
RING_GROUP = 24
"""Views held at a time: the median over all is taken as that of such groups' medians."""
DEPTHS = 400


def ring_errors(views: Iterable[Float32Array], width: int = RING_WIDTH) -> Float32Array:
    """What each pixel adds to all views, to be subtracted from each.

    In each view a pixel is compared with the mean of its neighbours in the row, left and right
    alike, so that a slope does not matter. Edges of the object pass through a pixel in few views;
    the median over views is what stood still.

    Args:
        views: (rows, cols) line integrals of all views of a turn.
        width: columns of the neighbourhood.

    Raises:
        LimitError: no views.
    """
    from scipy.ndimage import uniform_filter1d

    size = 2 * max(1, width // 2) + 1
    medians: list[Float32Array] = []
    group: list[Float32Array] = []
    for view in views:
        mean = uniform_filter1d(view, size, axis=1, mode="nearest")
        group.append(np.asarray((view - mean) * np.float32(size / (size - 1)), dtype=np.float32))
        if len(group) == RING_GROUP:
            medians.append(np.median(group, axis=0))
            group = []
    if len(group) > RING_GROUP // 2 or not medians:
        if not group:
            raise LimitError("no views to find rings in", {"asked": 0, "allowed": "> 0"})
        medians.append(np.median(group, axis=0))
    return np.asarray(np.median(medians, axis=0), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Hardening:
    """Measured (polychromatic) line integral to what one energy would have measured.

    Attributes:
        measured: growing line integrals.
        straight: the same thicknesses at `energy_keV`.
        energy_keV: whose attenuation the volume will have.
        material: name.
    """

    measured: FloatArray
    straight: FloatArray
    energy_keV: float
    material: str

    def __call__(self, line_integrals: Float32Array) -> Float32Array:
        """Corrected line integrals; outside the table by its first and last slope."""
        x = np.asarray(line_integrals)
        out = np.interp(x, self.measured, self.straight)
        first = self.straight[1] / self.measured[1]
        last = (self.straight[-1] - self.straight[-2]) / (self.measured[-1] - self.measured[-2])
        out = np.where(x < 0.0, x * first, out)
        over = x - self.measured[-1]
        out = np.where(over > 0.0, self.straight[-1] + over * last, out)
        return np.asarray(out, dtype=np.float32)


def hardening(
    material: Substance,
    kV: float,
    energy_keV: float,
    panel: Panel | None = None,
    tube: TubeModel | None = None,
) -> Hardening:
    """The correction for an object of one material, from tube and detector as modelled.

    Args:
        material: what the object is made of.
        kV: of the scan.
        energy_keV: the volume shall hold the attenuation at this energy.
        panel, tube: of the scan; default the default ones.

    Raises:
        LimitError: there is no spectrum for `kV`.
    """
    chain = Chain(Panel() if panel is None else panel, TubeModel() if tube is None else tube)
    signal, _ = weights_of(chain, kV)
    mu = material.attenuation()
    at = int(np.argmin(np.abs(_energies() - energy_keV)))
    # Up to where hardly anything gets through.
    thick = 1.0
    while np.exp(-thick * mu) @ signal > 1e-5 * signal.sum() and thick < 1e5:
        thick *= 1.5
    depth = thick * np.linspace(0.0, 1.0, DEPTHS) ** 2
    measured = -np.log(np.exp(-np.outer(depth, mu)) @ signal / signal.sum())
    return Hardening(measured, depth * mu[at], float(_energies()[at]), material.name)


def _energies() -> FloatArray:
    from flexdt.twin.attenuation.tables import tables

    return tables().energy_keV
