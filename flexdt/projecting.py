"""`flexdt.project`: line integrals of anything that can be scanned, by the exact projectors."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy.typing as npt

from flexdt.phantoms.channels import line_integrals
from flexdt.phantoms.samples import as_phantom
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.plausibility import geometry_doubts
from flexdt.twin.projection import Volume, forward
from flexdt.twin.projection.analytic_solids import Vector
from flexdt.twin.projection.operators import as_cone_vec
from flexdt.twin.signatures import public


@public
def project(
    sample: object,
    geometry: ConeVec | npt.ArrayLike,
    *,
    shape: tuple[int, int] | None = None,
    material: str | Mapping[int, str] | None = None,
    voxel_mm: float | Vector | None = None,
) -> Float32Array:
    """Line integrals of attenuation, without tube, noise and detector; see `flexdt.simulate`.

    Solids and meshes are exact path lengths times their attenuation at its effective energy, voxels
    exact lengths through each voxel (Siddon). Bodies of one mesh that overlap count once.

    Args:
        sample: a Volume, a phantom or its name, a file, a mesh, an array with `voxel_mm`, or a list
            of them, which add up.
        geometry: of the views, in the sample's frame.
        shape: detector (rows, cols), where the geometry does not say.
        material: of a mesh or an array; {1: "pmma", 2: "steel"} for an array of labels.
        voxel_mm: edge of an array's voxels [mm].

    Returns:
        float32 (n, rows, cols), dimensionless.

    Warns:
        UserWarning: a geometry that fits no scan of the sample: the source inside it, ...

    Raises:
        TwinError: a sample or a geometry that does not hold; says what is allowed.

    Example:
        >>> import numpy as np
        >>> scan = ConeVec.circular(sod=600, sdd=1000, angles=4, shape=(5, 5), pixel=2)
        >>> images = project(Volume(np.full((8, 8, 8), 0.02), 1.0), scan)
        >>> images.shape, round(float(images[0, 2, 2]), 3)
        ((4, 5, 5), 0.16)
    """
    cone = as_cone_vec(geometry)
    size = cone.of_shape(shape)
    plain = isinstance(sample, Volume) and material is None
    body: Any = sample if plain else as_phantom(sample, material=material, voxel_mm=voxel_mm)
    for doubt in geometry_doubts(cone, size, body.boxes):
        warnings.warn(doubt, stacklevel=3)
    return (forward if plain else line_integrals)(body, cone, size)
