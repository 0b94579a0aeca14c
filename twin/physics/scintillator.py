"""What a scintillator of any material keeps of a photon's energy."""

from __future__ import annotations

import numpy as np

from flexdt.twin.attenuation.scattering import cross_sections
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.physics.spectrum import Filter


def deposited(screen: Filter) -> FloatArray:
    """Part of a photon's energy that a scintillator keeps on average, by energy, (e,).

    Photoelectric part of what interacts; fluorescence that escapes and scattered light are left
    out.
    """
    sections = cross_sections([screen.substance])
    photo = sections.total - sections.coherent - sections.incoherent
    depth = sections.total[0] * screen.thickness_mm
    return np.asarray(photo[0] / sections.total[0] * -np.expm1(-depth))
