"""X-ray projection: exact path lengths through voxels, analytic solids and closed meshes.

Importing this package is light: the compiled kernels load when the first projection is asked for,
or all at once with `warm_up`.
"""

from flexdt.twin.projection.analytic import project_materials, project_scene
from flexdt.twin.projection.mesh import TriangleMesh, project_mesh
from flexdt.twin.projection.operators import back, forward
from flexdt.twin.projection.volume import Volume, room_like
from flexdt.twin.projection.warm import warm_up

__all__ = [
    "TriangleMesh",
    "Volume",
    "back",
    "forward",
    "project_materials",
    "project_mesh",
    "project_scene",
    "room_like",
    "warm_up",
]
