"""What is known of the energies of a scan, and how they bend its line integrals.

A spectrum attenuates less, a millimeter, behind much of a material than behind little. Where
tube and filter are known, a material that attenuates as the object does tells by how much; a
volume is then compared with that of the straightened line integrals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection.volume import ONE_ENERGY, WARNING_BOUND
from flexdt.twin.reconstruction.beam_hardening import Hardening, hardening
from flexdt.twin.reconstruction.coarse_scan import NODES, CoarseScan
from flexdt.twin.reconstruction.uniform_nodes import UniformNodes

if TYPE_CHECKING:
    from flexdt.twin.physics.detector import Detector
    from flexdt.twin.physics.tube import TubeModel

MATERIAL: Final = "material"
"""What is taken as stated where line integrals are corrected for a material."""


@dataclass(frozen=True)
class Beam:
    """Tube and panel of a scan whose line integrals are not corrected for a material.

    Attributes:
        kV: tube voltage.
        tube: with its filters; None is the default one.
        panel: detector; None is the default one.
    """

    kV: float
    tube: TubeModel | None = None
    panel: Detector | None = None

    def likely(self, mu_per_mm: float, line_integral: float) -> Hardening:
        """Choose the material, of those with a name, that attenuates as an object does.

        Args:
            mu_per_mm: of the object, by its measured line integrals [1/mm].
            line_integral: measured, of a typical ray through it.

        Raises:
            LimitError: there is no spectrum for the voltage.
        """
        from flexdt.twin.attenuation.materials import materials, stated_keV

        found: list[tuple[float, int, Hardening]] = []
        for one in materials().values():
            curve = hardening(one.substance, self.kV, stated_keV(), self.panel, self.tube)
            if curve.measured[-1] < line_integral:
                continue  # air
            straight = float(np.interp(line_integral, curve.measured, curve.straight))
            own = line_integral / straight * one.mu_at(curve.energy_keV)
            found.append((abs(np.log(own / mu_per_mm)), len(found), curve))
        return min(found)[2]


@dataclass(frozen=True)
class KnownBeam:
    """What is known of a scan's energies.

    Attributes:
        beam: bends the line integrals; None where it does not, or none is known.
        taken: what is taken as stated.
    """

    beam: Beam | None = None
    taken: tuple[str, ...] = ()


UNKNOWN_BEAM: Final = KnownBeam(taken=(ONE_ENERGY,))
STRAIGHT_BEAM: Final = KnownBeam()
CORRECTED_BEAM: Final = KnownBeam(taken=(MATERIAL,))


@dataclass(eq=False)
class StraightCopies:
    """Copies of a scan whose line integrals are as one energy would give them.

    Attributes:
        measured: makes a copy as measured, of so many nodes.
        beam: of the scan.
    """

    measured: Callable[[int], CoarseScan]
    beam: Beam
    _made: dict[int, CoarseScan] = field(default_factory=dict)

    def __call__(self, nodes: int) -> CoarseScan:
        """Return the straightened copy of so many nodes."""
        if nodes not in self._made:
            scan = self.measured(nodes)
            images = self.straight(scan.images)
            self._made[nodes] = replace(scan, images=images)
        return self._made[nodes]

    @cached_property
    def curve(self) -> Hardening:
        """Hardening of the material that the object is likely of."""
        scan = self.measured(NODES)
        nodes = UniformNodes.of(scan.volume, scan.rim)
        some = scan.images[scan.images > 0.0]
        # Rays count by their line integral, as the volume's values do.
        typical = float(np.square(some).sum() / max(some.sum(), 1e-30))
        value = float(np.median(nodes.found[nodes.uniform])) if nodes.uniform.any() else 0
        return self.beam.likely(max(value, 1e-9), max(typical, 1e-6))

    @cached_property
    def _scale(self) -> float:
        """Factor by which straightened line integrals are nearest to the measured ones."""
        images = self.measured(NODES).images
        straight = self.curve(images)
        power = float(np.square(straight).sum())
        return float((straight * images).sum()) / max(power, 1e-30)

    def straight(self, images: Float32Array) -> Float32Array:
        """Straighten line integrals of any shape, on the measured scale."""
        return np.asarray(self._scale * self.curve(images), np.float32)

    def bent_share(self, nodes: UniformNodes) -> float:
        """Compute the change by the spectrum of nine of ten nodes of the object, relative to
        it, but for a common factor: one energy fits best.

        A change that blurs no edge is as sure a node away from one as elsewhere.

        Args:
            nodes: of the straightened copy's volume.
        """
        from scipy.ndimage import binary_erosion

        whole = binary_erosion(nodes.inside, border_value=1)
        if not whole.any():
            whole = nodes.inside
        if not whole.any():
            return 0.0
        measured = np.nan_to_num(self.measured(NODES).volume)[whole]
        ratio = measured / nodes.sharp[whole]
        return float(np.percentile(np.abs(ratio / np.median(ratio) - 1.0), 90.0))

    @property
    def strong(self) -> bool:
        """True if the object's line integrals are bent by more than `WARNING_BOUND`."""
        some = np.percentile(self.measured(NODES).images, (50.0, 99.0))
        some = np.maximum(some, 1e-3 * max(float(some[-1]), 1e-30)).astype(np.float32)
        ratio = self.straight(some) / some
        return bool(np.ptp(ratio) > WARNING_BOUND * ratio.mean())

    @property
    def figure(self) -> str:
        """Of what it is, in words."""
        return f"as of {self.curve.material} at {self.beam.kV:g} kV"
