"""From path lengths to counts, as the scanner makes them: tube, materials, panel, image quality."""

from flexdt.twin.attenuation.substances import Substance, parse_formula
from flexdt.twin.physics.chain import Chain, Expected, expected_signal, read_out
from flexdt.twin.physics.effective import EffectiveBeam, effective_beam
from flexdt.twin.physics.panel import Panel, panel_of
from flexdt.twin.physics.spectrum import (
    Filter,
    Spectrum,
    TubeModel,
    monochromatic,
    tube_of,
    tube_spectrum,
)

__all__ = [
    "Chain",
    "EffectiveBeam",
    "Expected",
    "Filter",
    "Panel",
    "Spectrum",
    "Substance",
    "TubeModel",
    "effective_beam",
    "expected_signal",
    "monochromatic",
    "panel_of",
    "parse_formula",
    "read_out",
    "tube_of",
    "tube_spectrum",
]
