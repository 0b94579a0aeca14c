"""Scattered X-rays in a radiograph: Monte Carlo, and a first-order preview."""

from flexdt.twin.physics.scatter.simulation import (
    Beam,
    Object,
    ScanScatter,
    Scattered,
    ScatterImage,
    ScatterSettings,
    scan_scatter,
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
