"""Named objects to scan: bead cuboids, the LEGO phantom, Shepp-Logan, meshes.

Example:
    >>> load_phantom("normal-7").beads.shape
    (7, 3)
"""

from flexdt.phantoms.beads import (
    bead_phantom,
    chiral_phantom,
    cuboid_with_beads,
    loop_positions,
    spiral_positions,
)
from flexdt.phantoms.beads import bead_phantom as beads
from flexdt.phantoms.bricks import lego_phantom
from flexdt.phantoms.bricks import lego_phantom as lego
from flexdt.phantoms.checked_reading import PhantomError, scene_from_dict, scene_to_dict
from flexdt.phantoms.files.mesh_files import mesh_phantom, voxel_phantom
from flexdt.phantoms.files.mesh_files import mesh_phantom as from_mesh
from flexdt.phantoms.files.phantom_files import load_phantom_file
from flexdt.phantoms.phantom import Phantom
from flexdt.phantoms.pieces import Surface, Voxels
from flexdt.phantoms.samples import (
    as_phantom,
    is_shipped,
    load_phantom,
    phantom_names,
    shepp_logan,
)
from flexdt.phantoms.standard import ball_bar, ball_helix, ball_plate, two_rings
from flexdt.twin.attenuation.materials import Material, material, materials, stated_keV

__all__ = [
    "Material",
    "Phantom",
    "PhantomError",
    "Surface",
    "Voxels",
    "as_phantom",
    "ball_bar",
    "ball_helix",
    "ball_plate",
    "bead_phantom",
    "beads",
    "chiral_phantom",
    "cuboid_with_beads",
    "from_mesh",
    "is_shipped",
    "lego",
    "lego_phantom",
    "load_phantom",
    "load_phantom_file",
    "loop_positions",
    "material",
    "materials",
    "mesh_phantom",
    "phantom_names",
    "scene_from_dict",
    "scene_to_dict",
    "shepp_logan",
    "spiral_positions",
    "stated_keV",
    "two_rings",
    "voxel_phantom",
]


def __dir__() -> list[str]:
    return __all__
