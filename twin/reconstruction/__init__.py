"""Volumes back from projections."""

from flexdt.twin.projection.volume import Accuracy, Grid
from flexdt.twin.reconstruction.acquisition.coverage import LostVoxels
from flexdt.twin.reconstruction.acquisition.rectify import field_of_view
from flexdt.twin.reconstruction.acquisition.truncation import Truncation, truncation_of
from flexdt.twin.reconstruction.bias import Bias, bias_of
from flexdt.twin.reconstruction.checked_fdk import bias_warnings, checked_fdk, fdk
from flexdt.twin.reconstruction.consistency.ring_pattern import ring_errors
from flexdt.twin.reconstruction.feldkamp.fdk import fdk_parts
from flexdt.twin.reconstruction.iterative import cgls, em, sart, sirt
from flexdt.twin.reconstruction.linear_system import Step
from flexdt.twin.reconstruction.scatter_correction import (
    Hardening,
    Polychromatic,
    hardening,
    without_scatter,
)
from flexdt.twin.reconstruction.tv import Minimised, minimise_tv, tv
from flexdt.twin.reconstruction.volume_errors import with_errors

__all__ = [
    "Accuracy",
    "Bias",
    "Grid",
    "Hardening",
    "LostVoxels",
    "Minimised",
    "Polychromatic",
    "Step",
    "Truncation",
    "bias_of",
    "bias_warnings",
    "cgls",
    "checked_fdk",
    "em",
    "fdk",
    "fdk_parts",
    "field_of_view",
    "hardening",
    "minimise_tv",
    "ring_errors",
    "sart",
    "sirt",
    "truncation_of",
    "tv",
    "with_errors",
    "without_scatter",
]
