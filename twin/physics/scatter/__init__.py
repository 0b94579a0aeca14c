"""Scattered X-rays in a radiograph, by Monte Carlo."""

from flexdt.twin.physics.scatter.simulation import ScatterSettings

__all__ = ["ScatterSettings"]
