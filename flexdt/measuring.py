"""What a benchmark measures below the public functions: devices, threads, the kernels themselves.

Kernels change with every version; a program that imports them is written for one.
"""

from flexdt.twin.projection import gpu
from flexdt.twin.projection.cpu import threads
from flexdt.twin.projection.kernels import siddon_kernels
from flexdt.twin.projection.operators import box_of, voxel_rays
from flexdt.twin.reconstruction import gpu_reconstruction_kernels as gpu_fdk_kernels
from flexdt.twin.reconstruction.views import view_table

__all__ = [
    "box_of",
    "gpu",
    "gpu_fdk_kernels",
    "siddon_kernels",
    "threads",
    "view_table",
    "voxel_rays",
]
