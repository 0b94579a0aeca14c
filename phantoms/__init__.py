"""Named objects to scan: bead cuboids, the LEGO phantom, Shepp-Logan, meshes."""

from flexdt.phantoms.beads import bead_phantom, chiral_phantom, spiral_positions
from flexdt.phantoms.catalog import is_shipped, load_phantom, phantom_names
from flexdt.phantoms.files import load_phantom_file
from flexdt.phantoms.lego import lego_phantom
from flexdt.phantoms.materials import Material, material, materials
from flexdt.phantoms.mesh import mesh_phantom, voxel_phantom
from flexdt.phantoms.model import Phantom
from flexdt.phantoms.pieces import PhantomError, Surface, Voxels
from flexdt.phantoms.serial import scene_from_dict, scene_to_dict
from flexdt.phantoms.shepp_logan import shepp_logan

__all__ = [
    "Material",
    "Phantom",
    "PhantomError",
    "Surface",
    "Voxels",
    "bead_phantom",
    "chiral_phantom",
    "is_shipped",
    "lego_phantom",
    "load_phantom",
    "load_phantom_file",
    "material",
    "materials",
    "mesh_phantom",
    "phantom_names",
    "scene_from_dict",
    "scene_to_dict",
    "shepp_logan",
    "spiral_positions",
    "voxel_phantom",
]
