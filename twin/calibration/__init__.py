"""Geometric calibration from a bead phantom: detect, identify, fit, certify, predict."""

from flexdt.twin.calibration.bead_model import (
    BeadModel,
    BeadPhantom,
    bead_model,
    spot_radii,
)
from flexdt.twin.calibration.detect.detection import Detections, SpotFinder, detect_beads
from flexdt.twin.calibration.diagnose.identifiability import Prediction, identifiability
from flexdt.twin.calibration.fit.certificate import Certificate, Estimate
from flexdt.twin.calibration.fit.fit import (
    IN_IMAGES,
    LEAST_SQUARES,
    FitResult,
    Solver,
    axis_in_image,
    estimate_geometry,
    fit_geometry,
    image_slopes,
    require_identifiable,
)
from flexdt.twin.calibration.fit.forecast import visible_beads
from flexdt.twin.calibration.fit.problem import (
    EIGHT,
    SIX,
    Centre,
    Reading,
    build_problem,
    edge_factor,
    edge_factors,
)
from flexdt.twin.calibration.fit.weak_directions import Direction, tolerance_of
from flexdt.twin.calibration.identify import (
    Identification,
    Search,
    identify_beads,
    overlapping,
)

__all__ = [
    "EIGHT",
    "IN_IMAGES",
    "LEAST_SQUARES",
    "SIX",
    "BeadModel",
    "BeadPhantom",
    "Centre",
    "Certificate",
    "Detections",
    "Direction",
    "Estimate",
    "FitResult",
    "Identification",
    "Prediction",
    "Reading",
    "Search",
    "Solver",
    "SpotFinder",
    "axis_in_image",
    "bead_model",
    "build_problem",
    "detect_beads",
    "edge_factor",
    "edge_factors",
    "estimate_geometry",
    "fit_geometry",
    "identifiability",
    "identify_beads",
    "image_slopes",
    "overlapping",
    "require_identifiable",
    "spot_radii",
    "tolerance_of",
    "visible_beads",
]
