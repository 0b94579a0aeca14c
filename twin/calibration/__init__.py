"""Geometric calibration from a bead phantom: detect, identify, fit, certify, predict."""

from flexdt.twin.calibration.beads import BeadModel, BeadPhantom, bead_model
from flexdt.twin.calibration.certificate import Certificate, Estimate
from flexdt.twin.calibration.detect import Detections, Detector, detect_beads
from flexdt.twin.calibration.directions import Direction
from flexdt.twin.calibration.fit import (
    FitResult,
    estimate_geometry,
    fit_geometry,
    require_identifiable,
)
from flexdt.twin.calibration.identifiability import Prediction, identifiability, visible_beads
from flexdt.twin.calibration.identify import Identification, Search, identify_beads
from flexdt.twin.calibration.model import EIGHT, SIX, Centre, Reading
from flexdt.twin.calibration.solver import LEAST_SQUARES, Solver

__all__ = [
    "EIGHT",
    "LEAST_SQUARES",
    "SIX",
    "BeadModel",
    "BeadPhantom",
    "Centre",
    "Certificate",
    "Detections",
    "Detector",
    "Direction",
    "Estimate",
    "FitResult",
    "Identification",
    "Prediction",
    "Reading",
    "Search",
    "Solver",
    "bead_model",
    "detect_beads",
    "estimate_geometry",
    "fit_geometry",
    "identifiability",
    "identify_beads",
    "require_identifiable",
    "visible_beads",
]
