"""Geometric calibration from a bead phantom: detect, identify, fit, certify, predict."""

from flexdt.twin.calibration.bead_model import BeadModel, BeadPhantom, bead_model
from flexdt.twin.calibration.detect.detection import Detections, SpotFinder, detect_beads
from flexdt.twin.calibration.fit.certificate import Certificate, Estimate
from flexdt.twin.calibration.fit.fit import (
    FitResult,
    estimate_geometry,
    fit_geometry,
    require_identifiable,
)
from flexdt.twin.calibration.fit.identifiability import Prediction, identifiability, visible_beads
from flexdt.twin.calibration.fit.problem import EIGHT, SIX, Centre, Reading
from flexdt.twin.calibration.fit.solver import LEAST_SQUARES, Solver
from flexdt.twin.calibration.fit.weak_directions import Direction
from flexdt.twin.calibration.identify import Identification, Search, identify_beads

__all__ = [
    "EIGHT",
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
    "bead_model",
    "detect_beads",
    "estimate_geometry",
    "fit_geometry",
    "identifiability",
    "identify_beads",
    "require_identifiable",
    "visible_beads",
]
