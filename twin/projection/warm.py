"""Compiles (or loads from the disk cache) the kernels that servers run, before the first request.

A server calls this before it prints `ready`. Meshes, FDK and `back` into given memory are not used
by servers: their kernels compile at their first use.
"""

from __future__ import annotations

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection.analytic import project_scene
from flexdt.twin.projection.analytic_solids import Box, Cylinder, Scene, Solid, Sphere
from flexdt.twin.projection.operators import back, forward
from flexdt.twin.projection.volume import Volume


def warm_up() -> None:
    """Run what `forward`, `project_scene` and `back` into new memory do, on tiny problems."""
    level = ConeVec.from_vectors((0, -10, 0), (0, 10, 0), (1, 0, 0), (0, 0, -1))
    end_on = ConeVec.from_vectors((0, 0, -10), (0, 0, 10), (1, 0, 0), (0, 1, 0))
    data = np.ones((4, 3, 2), np.float32)
    images = np.ones((1, 5, 6), np.float32)
    for source in (data, np.ascontiguousarray(data.transpose(1, 2, 0)).transpose(2, 0, 1)):
        volume = Volume(source, 0.5)
        for geometry in (level, end_on):
            forward(volume, geometry, (5, 6))
            back(images, geometry, volume)
    shapes = (Sphere((0, 0, 0), 1.0), Box((0, 0, 0), (1, 1, 1)), Cylinder((0, 0, 0), 1.0, 1.0))
    project_scene(Scene(tuple(Solid(s, "water", 0.02) for s in shapes)), level, (5, 6))
