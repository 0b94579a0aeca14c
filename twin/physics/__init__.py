"""From path lengths to counts, as the scanner makes them: tube, materials,
panel, image quality."""

from flexdt.twin.physics.blur import FWHM, blurred, spot_blur_px
from flexdt.twin.physics.chain import (
    Chain,
    PixelPaths,
    expected_signal,
    flux_of,
    transmitted,
    weights_of,
)
from flexdt.twin.physics.detector import Detector, detector_of
from flexdt.twin.physics.effective import EffectiveBeam, effective_beam
from flexdt.twin.physics.exposure import (
    Counts,
    ExposureSettings,
    expose,
    frame_rng,
    ideal_response,
    open_beam,
)
from flexdt.twin.physics.readout import read_out
from flexdt.twin.physics.sampled_views import edges_needed
from flexdt.twin.physics.scatter import Beam, ScanScatter, ScatterSettings, scan_scatter
from flexdt.twin.physics.scintillator import deposited
from flexdt.twin.physics.tube import (
    Filter,
    Spectrum,
    TubeModel,
    monochromatic,
    tube_of,
    tube_spectrum,
)
from flexdt.twin.rays_a_pixel import MAX_RAYS, Rays, check_rays

__all__ = [
    "FWHM",
    "MAX_RAYS",
    "Beam",
    "Chain",
    "Counts",
    "Detector",
    "EffectiveBeam",
    "ExposureSettings",
    "Filter",
    "PixelPaths",
    "Rays",
    "ScanScatter",
    "ScatterSettings",
    "Spectrum",
    "TubeModel",
    "blurred",
    "check_rays",
    "deposited",
    "detector_of",
    "edges_needed",
    "effective_beam",
    "expected_signal",
    "expose",
    "flux_of",
    "frame_rng",
    "ideal_response",
    "monochromatic",
    "open_beam",
    "read_out",
    "scan_scatter",
    "spot_blur_px",
    "transmitted",
    "tube_of",
    "tube_spectrum",
    "weights_of",
]
