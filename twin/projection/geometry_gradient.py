"""How projections change with the geometry: the twelve numbers of each view.

The derivatives are exact for a volume of voxels, almost everywhere: a line integral is a smooth
function of the ray as long as the ray meets the same voxels in the same order. They are what
registration, alignment and training need. Computed on the processor, ray by ray.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.cpu import TILE
from flexdt.twin.projection.operators import (
    Shape2,
    as_cone_vec,
    box_of,
    check_projections,
    voxel_rays,
)
from flexdt.twin.projection.volume import Volume


def geometry_gradient(
    volume: Volume, cone_vec: ConeVec | npt.ArrayLike, weights: npt.ArrayLike
) -> FloatArray:
    """Derivative of sum(weights * forward(volume, cone_vec)) with respect to each row's numbers.

    With `weights` the derivative of a loss with respect to the projections, the result is the
    derivative of the loss with respect to the geometry.

    Args:
        volume: attenuation [1/mm].
        cone_vec: ConeVec or (n, 12) [mm], object frame.
        weights: (n, rows, cols), dimensionless.

    Returns:
        float64 (n, 12) [1/mm]: with respect to source, detector centre, u and v of each view.

    Raises:
        GeometryError: shapes that do not fit, or a row that gives its pixels no rays of their own.

    Examples:
        A pixel that moves to the side makes the way through a cube of 2 mm longer, by
        0.02 / mm * 2 mm * tan / sqrt(1 + tan^2) / 4 mm with tan = 1 / 4:

        >>> cube = Volume(np.full((4, 4, 4), 0.02, np.float32), 0.5)
        >>> view = ConeVec.from_vectors((0, -2, 0.1), (1, 2, 0.1), (1, 0, 0), (0, 0, -1))
        >>> ones = np.ones((1, 1, 1), np.float32)
        >>> geometry_gradient(cube, view, ones)[0, 3:5].round(6).tolist()
        [0.002425, -0.000606]
    """
    from flexdt.twin.projection.kernels import gradient_kernels

    geometry = as_cone_vec(cone_vec)
    values = check_projections(weights, len(geometry))
    n, rows, cols = values.shape
    geometry.of_shape((rows, cols))
    tiles = -(-cols // TILE)
    parts = np.zeros((n * tiles, 12))
    layout = volume.layout
    if not layout.empty and n:
        views = voxel_rays(geometry, layout, (rows, cols))
        gradient_kernels.gather(box_of(layout), views, values, TILE, parts)
    return np.asarray(parts.reshape(n, tiles, 12).sum(axis=1))


def geometry_change(
    volume: Volume,
    cone_vec: ConeVec | npt.ArrayLike,
    change: npt.ArrayLike,
    shape: Shape2 | None = None,
) -> Float32Array:
    """Derivative of the projections along a change of the geometry: a column of the Jacobian.

    To first order, forward(volume, rows + step * change) = forward(volume, rows) + step * result.

    Args:
        volume: attenuation [1/mm].
        cone_vec: ConeVec or (n, 12) [mm], object frame.
        change: (n, 12) or (12,): for each unit of the parameter, what is added to each row [mm].
        shape: detector (rows, cols); by default the geometry's own.

    Returns:
        float32 (n, rows, cols), for each unit of the parameter.

    Raises:
        GeometryError: shapes that do not fit, or a row that gives its pixels no rays of their own.

    Example:
        >>> from flexdt.twin.geometry.cone_vec import ConeVec
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> volume = Volume(np.full((3, 4, 3), 0.02, np.float32), 0.5)
        >>> geometry_change(volume, view, np.ones((1, 12)), (1, 1)).shape
        (1, 1, 1)
    """
    from flexdt.twin.projection.kernels import gradient_kernels

    geometry = as_cone_vec(cone_vec)
    moved = np.asarray(change, dtype=np.float64)
    if moved.shape not in ((12,), (len(geometry), 12)):
        wanted = (len(geometry), 12)
        raise GeometryError.of_shape("the geometry's change", moved.shape, wanted, " or (12,)")
    shape = geometry.of_shape(shape)
    result = np.zeros((len(geometry), *shape), np.float32)
    layout = volume.layout
    if not layout.empty and len(geometry):
        views = voxel_rays(geometry, layout, shape)
        steps = np.ascontiguousarray(np.broadcast_to(moved, (len(geometry), 12)))
        gradient_kernels.follow(box_of(layout), views, steps, TILE, result)
    return result
