"""Volumes back from projections."""

from flexdt.twin.reconstruction.correct import Hardening, hardening, ring_errors
from flexdt.twin.reconstruction.fdk import fdk, fdk_parts
from flexdt.twin.reconstruction.grid import Grid, field_of_view
from flexdt.twin.reconstruction.iterative import Step, cgls, em, sart, sirt

__all__ = [
    "Grid",
    "Hardening",
    "Step",
    "cgls",
    "em",
    "fdk",
    "fdk_parts",
    "field_of_view",
    "hardening",
    "ring_errors",
    "sart",
    "sirt",
]
