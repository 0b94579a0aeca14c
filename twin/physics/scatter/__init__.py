"""Scattered X-rays in a radiograph: Monte Carlo, and a first-order preview."""

from flexdt.twin.physics.scatter.scan import ScanScatter, Scattered, scan_scatter
from flexdt.twin.physics.scatter.simulation import (
    Beam,
    Object,
    ScatterImage,
    ScatterSettings,
    scatter_image,
)

__all__ = [
    "Beam",
    "Object",
    "ScanScatter",
    "ScatterImage",
    "ScatterSettings",
    "Scattered",
    "scan_scatter",
    "scatter_image",
]
