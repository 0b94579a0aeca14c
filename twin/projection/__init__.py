"""X-ray projection: exact path lengths through voxels, analytic solids and closed meshes.

Importing this package is light: the compiled kernels load at the first projection, or all at
once with `warm_up`.
"""

from flexdt.twin.projection.analytic import (
    Body,
    TriangleMesh,
    project_body,
    project_materials,
    project_mesh,
    project_scene,
    warm_up,
)
from flexdt.twin.projection.analytic_solids import Box, Ellipsoid, Scene, Solid, Sphere
from flexdt.twin.projection.linear_operator import Operator
from flexdt.twin.projection.operators import (
    back,
    forward,
    geometry_change,
    geometry_gradient,
)
from flexdt.twin.projection.pixel_areas import Within, paths_within, rays_needed
from flexdt.twin.projection.volume import Grid, Volume, as_volume, room_like

__all__ = [
    "Body",
    "Box",
    "Ellipsoid",
    "Grid",
    "Operator",
    "Scene",
    "Solid",
    "Sphere",
    "TriangleMesh",
    "Volume",
    "Within",
    "as_volume",
    "back",
    "forward",
    "geometry_change",
    "geometry_gradient",
    "paths_within",
    "project_body",
    "project_materials",
    "project_mesh",
    "project_scene",
    "rays_needed",
    "room_like",
    "warm_up",
]
