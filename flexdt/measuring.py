"""Kernels, threads and devices for benchmarks and kernels of other distributions.

`parallel` compiles a function with `prange` like our own kernels: it survives a fork, and
its threads sleep while they wait.

Kernels change with every version; a program that imports them is written for one.
"""

from flexdt.twin.projection import gpu
from flexdt.twin.projection.cpu import threads
from flexdt.twin.projection.kernels import siddon_kernels
from flexdt.twin.projection.kernels.compiling import parallel
from flexdt.twin.projection.operators import box_of, voxel_rays
from flexdt.twin.reconstruction.feldkamp.fdk_views import view_table
from flexdt.twin.reconstruction.kernels import (
    gpu_reconstruction_kernels as gpu_fdk_kernels,
)

__all__ = [
    "box_of",
    "gpu",
    "gpu_fdk_kernels",
    "parallel",
    "siddon_kernels",
    "threads",
    "view_table",
    "voxel_rays",
]
