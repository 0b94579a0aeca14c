"""Scattered X-rays in a radiograph: Monte Carlo, and a first-order preview."""

from flexdt.twin.physics.scatter.simulation import ScatterSettings

__all__ = ["ScatterSettings"]
