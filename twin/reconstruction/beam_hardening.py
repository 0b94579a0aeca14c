"""Beam hardening of a scan's line integrals, in one material or in several.

It comes from low energies being absorbed first. `hardening` corrects the line integrals of an
object of a single material; iterative methods take the hardening in several into account
(`Polychromatic`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from flexdt.twin.attenuation.substances import Substance, tables
from flexdt.twin.errors import LimitError, require_within
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.signatures import public

if TYPE_CHECKING:
    from flexdt.twin.physics.detector import Detector
    from flexdt.twin.physics.effective import EffectiveBeam
    from flexdt.twin.physics.tube import TubeModel

BLACK: Final = 80.0
"""Line integral of a pixel without signal; its transmission still has a finite
inverse."""
APART: Final = 0.05
"""Least relative difference of attenuation by which two materials are separated."""
DEPTHS = 400
THIN: Final = 1e-3
"""Line integral below which a spectrum attenuates as its mean does."""
THICKEST_MM = 1e4
FINE = 2e-4
"""Largest path through a material for effective energies [mm] (tables end where
nothing gets through), and the largest relative error of the signal."""


@dataclass(frozen=True, eq=False)
class Hardening:
    """Conversion of measured (polychromatic) line integrals to those at one energy.

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
        """Convert measured line integrals to straight ones (without beam hardening) by
        linear interpolation in the table; outside it by its first and last slope.

        Args:
            line_integrals: of any shape.

        Returns:
            float32 of that shape.
        """
        x = np.asarray(line_integrals)
        out = np.interp(x, self.measured, self.straight)
        first = self.straight[1] / self.measured[1]
        last = (self.straight[-1] - self.straight[-2]) / (
            self.measured[-1] - self.measured[-2]
        )
        out = np.where(x < 0.0, x * first, out)
        over = x - self.measured[-1]
        out = np.where(over > 0.0, self.straight[-1] + over * last, out)
        return np.asarray(out, dtype=np.float32)


def hardening(
    material: Substance,
    kV: float,
    energy_keV: float,
    panel: Detector | None = None,
    tube: TubeModel | None = None,
) -> Hardening:
    """Compute the correction for an object of one material, by the models of tube and detector.

    `material`: of the object. `kV`: of the scan. `energy_keV`: the volume shall hold the
    attenuation at this energy; the nearest in the tables is taken. `panel` and `tube`: of the
    scan; default the default ones.
    Returns table up to where a 1e-5th of the signal gets through, 1e5 mm at most.
    Raises LimitError: there is no spectrum for `kV`.
    """
    signal, _ = _weights(kV, panel, tube)
    mu = material.attenuation()
    energies = tables().energy_keV
    at = int(np.argmin(np.abs(energies - energy_keV)))
    # Up to where hardly anything gets through.
    thick = 1.0
    while np.exp(-thick * mu) @ signal > 1e-5 * signal.sum() and thick < 1e5:
        thick *= 1.5
    depth = thick * np.linspace(0.0, 1.0, DEPTHS) ** 2
    measured = -np.log(np.exp(-np.outer(depth, mu)) @ signal / signal.sum())
    return Hardening(measured, depth * mu[at], float(energies[at]), material.name)


@public
@dataclass(frozen=True, eq=False)
class Polychromatic:
    """Measurement of a spectrum behind several materials, for `sirt` and `sart`.

    A voxel is of one material, with the density of its value (Joseph and Spital, J.
    Comput. Assist. Tomogr. 2 (1978) 100); the border between two is the geometric mean of
    their attenuation at one energy. Paths through the materials so give the line
    integrals that the volume has at this energy, and the measurement of the spectrum.
    Mixtures in proportion instead would take noise of plastic for traces of metal, which
    harden the beam, on average too much; a border halfway would take metal, which looks
    thin before it is corrected, for dense plastic for good.

    Attributes:
        mu: (m,) attenuation of each material at `energy_keV` [1/mm].
        beam: effective energies of the spectrum behind the materials.
        energy_keV: whose attenuation the volume will have.

    Example:
        >>> pmma, steel = Substance.parse("C5H8O2@1.18"), Substance.parse("Fe@7.87")
        >>> both = Polychromatic.of((pmma, steel), kV=90.0, energy_keV=60.0)
        >>> seen, straighter = both.line_integrals(np.array([[40.0], [1.0]], np.float32))  # mm
        >>> round(float(seen[0]), 2), round(float(straighter[0]), 2)
        (2.91, 0.64)
    """

    mu: FloatArray
    beam: EffectiveBeam
    energy_keV: float

    @classmethod
    def of(
        cls,
        materials: Sequence[Substance],
        kV: float,
        energy_keV: float,
        panel: Detector | None = None,
        tube: TubeModel | None = None,
    ) -> Polychromatic:
        """Compute the model of a beam from tube and detector.

        `materials`: of the object, in any order. `kV`: tube voltage. `energy_keV`: at which the
        volume's attenuations hold. `panel`: detector; the default one without. `tube`: the
        default one without.
        Raises LimitError: no material, two that attenuate alike (`require_apart`), no spectrum
        for `kV`, or an energy that the tables do not have.
        """
        ends = tables().energy_keV[[0, -1]]
        require_within("energy_keV", energy_keV, float(ends[0]), float(ends[1]), "keV")
        from flexdt.twin.physics.effective import effective_beam

        signal, noise = _weights(kV, panel, tube)
        mu = np.array([one.attenuation_at(energy_keV) for one in materials])
        require_apart(materials, mu)
        beam = effective_beam(signal, noise, materials, [THICKEST_MM] * len(mu), FINE)
        return cls(mu, beam, energy_keV)

    def amounts(self, values: Float32Array) -> Iterator[Float32Array]:
        """Yield each material's relative density in voxels [1/mm], in the order of `mu`.

        A voxel is of the material with the nearest attenuation by ratio; negative ones of
        the least.
        """
        order = np.argsort(self.mu)
        of = order[
            np.searchsorted(np.sqrt(self.mu[order][1:] * self.mu[order][:-1]), values)
        ]
        for m, mu in enumerate(self.mu.astype(np.float32)):
            yield np.where(of == m, values / mu, np.float32(0))

    def line_integrals(self, paths_mm: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Compute the spectrum's line integrals, and the factor to those at one energy.

        A signal is never below exp(-`BLACK`); paths below the line integral `THIN`
        attenuate as the mean does.

        Args:
            paths_mm: float32 (m, ...) through the materials; negative ones, of voxels
                below zero, harden nothing.

        Returns:
            Two float32 arrays (...): line integrals, and those at one energy over these.
        """
        mean = self.beam.mu @ self.beam.signal / self.beam.signal.sum()
        least = np.maximum(paths_mm, np.float32(0))
        thin, straight = np.tensordot(np.array([mean, self.mu], np.float32), least, 1)
        seen, _ = self.beam.transmit(least)
        dark = np.maximum(
            seen / np.float32(self.beam.signal.sum()), np.float32(np.exp(-BLACK))
        )
        found = np.where(thin > THIN, -np.log(dark), thin)
        none = thin < THIN * THIN
        light = int(np.argmin(self.mu))
        limit = np.float32(self.mu[light] / mean[light])
        ratio = np.where(none, limit, straight / np.where(none, np.float32(1), found))
        total = np.tensordot(self.mu.astype(np.float32), paths_mm, 1)
        return np.asarray(total / ratio, dtype=np.float32), ratio


def require_apart(materials: Sequence[Substance], mu: FloatArray) -> None:
    """Check that there are materials, and that a volume separates them: attenuations differ by
    the share `APART` of the larger.

    Args:
        materials: m of them.
        mu: (m,) their attenuations.

    Raises LimitError: none, or two that attenuate alike, which it names.
    """
    if not len(materials):
        raise LimitError(
            "no material; allowed: one or more", {"asked": 0, "allowed": "> 0"}
        )
    for one, other in pairwise(np.argsort(mu)):
        if mu[other] - mu[one] < APART * mu[other]:
            names = [materials[i].name for i in (one, other)]
            reason = f"{' and '.join(names)} attenuate alike: a volume does not tell them apart"
            raise LimitError.instead(reason, names, f"{100 * APART:g} % apart")


def _weights(
    kV: float, panel: Detector | None, tube: TubeModel | None
) -> tuple[FloatArray, FloatArray]:
    """Compute the signal and its noise by energy, as `weights_of`; None is the default
    panel or tube."""
    # Here, because plain iterative methods need nothing of tube and panel.
    from flexdt.twin.physics.chain import Chain, weights_of
    from flexdt.twin.physics.detector import Detector
    from flexdt.twin.physics.tube import TubeModel

    chain = Chain(
        Detector() if panel is None else panel, TubeModel() if tube is None else tube
    )
    return weights_of(chain, kV)
