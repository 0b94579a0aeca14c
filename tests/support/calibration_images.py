"""Radiographs for tests: exact projections of phantoms, counted with Poisson noise."""

from __future__ import annotations

import numpy as np
from calibration_scenarios import SHAPE

from flexdt.phantoms import Phantom
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import project_scene


def radiographs(
    phantom: Phantom, cone: ConeVec, counts: float | None = 20_000.0, seed: int = 0
) -> Float32Array:
    """Line integrals (n, rows, cols), with the noise of `counts` open-beam photons or
    without."""
    clean = project_scene(phantom.scene, cone, SHAPE)
    if counts is None:
        return clean
    rng = np.random.default_rng(seed)
    photons = rng.poisson(counts * np.exp(-clean.astype(np.float64)))
    return np.log(counts / np.maximum(photons, 0.5)).astype(np.float32)
