"""Geometric calibration from a bead phantom: detect, identify, fit, certify, predict.

Names are looked up on first use, because phantoms import the bead model alone.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from flexdt.twin.calibration.bead_model import (
    BeadModel,
    BeadPhantom,
    bead_model,
    spot_radii,
)

if TYPE_CHECKING:
    from flexdt.twin.calibration.detect.detection import Detections as Detections
    from flexdt.twin.calibration.detect.detection import SpotFinder as SpotFinder
    from flexdt.twin.calibration.detect.detection import detect_beads as detect_beads
    from flexdt.twin.calibration.diagnose.identifiability import Prediction as Prediction
    from flexdt.twin.calibration.diagnose.identifiability import (
        identifiability as identifiability,
    )
    from flexdt.twin.calibration.fit.certificate import Certificate as Certificate
    from flexdt.twin.calibration.fit.certificate import Estimate as Estimate
    from flexdt.twin.calibration.fit.fit import IN_IMAGES as IN_IMAGES
    from flexdt.twin.calibration.fit.fit import LEAST_SQUARES as LEAST_SQUARES
    from flexdt.twin.calibration.fit.fit import FitResult as FitResult
    from flexdt.twin.calibration.fit.fit import Solver as Solver
    from flexdt.twin.calibration.fit.fit import axis_in_image as axis_in_image
    from flexdt.twin.calibration.fit.fit import estimate_geometry as estimate_geometry
    from flexdt.twin.calibration.fit.fit import fit_geometry as fit_geometry
    from flexdt.twin.calibration.fit.fit import image_slopes as image_slopes
    from flexdt.twin.calibration.fit.fit import (
        require_identifiable as require_identifiable,
    )
    from flexdt.twin.calibration.fit.forecast import visible_beads as visible_beads
    from flexdt.twin.calibration.fit.problem import EIGHT as EIGHT
    from flexdt.twin.calibration.fit.problem import SIX as SIX
    from flexdt.twin.calibration.fit.problem import Centre as Centre
    from flexdt.twin.calibration.fit.problem import Reading as Reading
    from flexdt.twin.calibration.fit.problem import build_problem as build_problem
    from flexdt.twin.calibration.fit.problem import edge_factor as edge_factor
    from flexdt.twin.calibration.fit.problem import edge_factors as edge_factors
    from flexdt.twin.calibration.fit.weak_directions import Direction as Direction
    from flexdt.twin.calibration.fit.weak_directions import tolerance_of as tolerance_of
    from flexdt.twin.calibration.identify import Identification as Identification
    from flexdt.twin.calibration.identify import Search as Search
    from flexdt.twin.calibration.identify import identify_beads as identify_beads
    from flexdt.twin.calibration.identify import overlapping as overlapping

_HOMES: Final = {
    "axis_in_image": "flexdt.twin.calibration.fit.fit",
    "build_problem": "flexdt.twin.calibration.fit.problem",
    "Centre": "flexdt.twin.calibration.fit.problem",
    "Certificate": "flexdt.twin.calibration.fit.certificate",
    "detect_beads": "flexdt.twin.calibration.detect.detection",
    "Detections": "flexdt.twin.calibration.detect.detection",
    "Direction": "flexdt.twin.calibration.fit.weak_directions",
    "edge_factor": "flexdt.twin.calibration.fit.problem",
    "edge_factors": "flexdt.twin.calibration.fit.problem",
    "EIGHT": "flexdt.twin.calibration.fit.problem",
    "Estimate": "flexdt.twin.calibration.fit.certificate",
    "estimate_geometry": "flexdt.twin.calibration.fit.fit",
    "fit_geometry": "flexdt.twin.calibration.fit.fit",
    "FitResult": "flexdt.twin.calibration.fit.fit",
    "identifiability": "flexdt.twin.calibration.diagnose.identifiability",
    "Identification": "flexdt.twin.calibration.identify",
    "identify_beads": "flexdt.twin.calibration.identify",
    "image_slopes": "flexdt.twin.calibration.fit.fit",
    "IN_IMAGES": "flexdt.twin.calibration.fit.fit",
    "LEAST_SQUARES": "flexdt.twin.calibration.fit.fit",
    "overlapping": "flexdt.twin.calibration.identify",
    "Prediction": "flexdt.twin.calibration.diagnose.identifiability",
    "Reading": "flexdt.twin.calibration.fit.problem",
    "require_identifiable": "flexdt.twin.calibration.fit.fit",
    "Search": "flexdt.twin.calibration.identify",
    "SIX": "flexdt.twin.calibration.fit.problem",
    "Solver": "flexdt.twin.calibration.fit.fit",
    "SpotFinder": "flexdt.twin.calibration.detect.detection",
    "tolerance_of": "flexdt.twin.calibration.fit.weak_directions",
    "visible_beads": "flexdt.twin.calibration.fit.forecast",
}

__all__ = ["BeadModel", "BeadPhantom", "bead_model", "spot_radii", *_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
