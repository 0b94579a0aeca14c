"""Geometric calibration from a bead phantom: detect, identify, fit, certify, predict."""

from flexdt.twin.calibration.beads import BeadModel, BeadPhantom, bead_model
from flexdt.twin.calibration.certificate import Certificate, Estimate
from flexdt.twin.calibration.directions import Direction
from flexdt.twin.calibration.fit import (
    FitResult,
    estimate_geometry,
    fit_geometry,
    require_identifiable,
)
from flexdt.twin.calibration.identifiability import Prediction, identifiability, visible_beads
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
    "Direction",
    "Estimate",
    "FitResult",
    "Prediction",
    "Reading",
    "Solver",
    "bead_model",
    "estimate_geometry",
    "fit_geometry",
    "identifiability",
    "require_identifiable",
    "visible_beads",
]
