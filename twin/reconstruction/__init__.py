"""Volumes back from projections."""

from flexdt.twin.projection.volume import Grid
from flexdt.twin.reconstruction.correct import Hardening, hardening, ring_errors
from flexdt.twin.reconstruction.fdk import beyond_panel, fdk, fdk_parts, sample_of
from flexdt.twin.reconstruction.grid import field_of_view
from flexdt.twin.reconstruction.iterative import cgls, em, sart, sirt
from flexdt.twin.reconstruction.problem import Step
from flexdt.twin.reconstruction.truncation import DOUBT, Beyond
from flexdt.twin.reconstruction.tv import Minimised, minimise_tv, tv

__all__ = [
    "DOUBT",
    "Beyond",
    "Grid",
    "Hardening",
    "Minimised",
    "Step",
    "beyond_panel",
    "cgls",
    "em",
    "fdk",
    "fdk_parts",
    "field_of_view",
    "hardening",
    "minimise_tv",
    "ring_errors",
    "sample_of",
    "sart",
    "sirt",
    "tv",
]
