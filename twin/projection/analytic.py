"""Projection of analytic scenes: exact chords, no voxels.

A solid costs only the pixels its shadow can reach. Results are line integrals, or path lengths for
each material.

`warm_up` compiles (or loads from the disk cache) the kernels that programs usually run. A server
calls `warm_up_forward` before it prints `ready`. The kernels of meshes, of FDK and of `back` into
given memory compile at their first use.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import cpu
from flexdt.twin.projection.analytic_solids import Box, Cylinder, Scene, Solid, Sphere
from flexdt.twin.projection.convex import encode, shadows
from flexdt.twin.projection.operators import (
    Shape2,
    as_cone_vec,
    back,
    box_of,
    check_out,
    forward,
    layout_data,
    voxel_rays,
)
from flexdt.twin.projection.volume import Volume, blank_layout, bring_over


def project_scene(
    scene: Scene,
    cone_vec: ConeVec | npt.ArrayLike,
    shape: Shape2 | None = None,
    out: Float32Array | None = None,
) -> Float32Array:
    """Line integrals of a scene: sum over its solids of chord [mm] times mu [1/mm].

    Args:
        scene: solids, object frame.
        cone_vec: ConeVec or (n, 12) [mm].
        shape: detector (rows, cols); default: the geometry's own.
        out: float32 (n, rows, cols), C order, filled and returned if given.

    Returns:
        float32 (n, rows, cols), dimensionless.

    Raises:
        GeometryError: cone_vec, shape, out or a solid does not hold.

    Example:
        >>> from flexdt.twin.projection.analytic_solids import Solid, Sphere
        >>> ball = Scene((Solid(Sphere((0.0, 0.0, 0.0), 2.0), "water", 0.02),))
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> round(float(project_scene(ball, view, (1, 1))[0, 0, 0]), 4)  # 4 mm of 0.02 / mm
        0.08
    """
    geometry = as_cone_vec(cone_vec)
    shape = geometry.of_shape(shape)
    result = check_out(out, (len(geometry), *shape))
    weight = np.array([solid.mu_per_mm for solid in scene.solids], np.float64)
    _project(scene.solids, geometry, shape, weight, np.zeros(len(weight), np.int64), result[None])
    return result


def project_materials(
    scene: Scene, cone_vec: ConeVec | npt.ArrayLike, shape: Shape2 | None = None
) -> dict[str, Float32Array]:
    """Path length through each material of a scene.

    A solid of negative mu_per_mm removes its material, so a bead in a brick is three solids: the
    brick, a hole of the brick's material with minus its mu, and the bead with its own mu. (One
    bead carrying the difference of two materials gives the right line integral, but cannot be
    taken apart again.)

    Args:
        scene: solids, object frame.
        cone_vec: ConeVec or (n, 12) [mm].
        shape: detector (rows, cols); default: the geometry's own.

    Returns:
        For each material name, in order of first appearance, float32 (n, rows, cols) [mm].

    Raises:
        GeometryError: cone_vec, shape or a solid does not hold.

    Example:
        >>> from flexdt.twin.projection.analytic_solids import Solid, Sphere
        >>> ball = Scene((Solid(Sphere((0.0, 0.0, 0.0), 2.0), "water", 0.02),))
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> round(float(project_materials(ball, view, (1, 1))["water"][0, 0, 0]), 4)  # mm
        4.0
    """
    geometry = as_cone_vec(cone_vec)
    names = list(dict.fromkeys(solid.material for solid in scene.solids))
    shape = geometry.of_shape(shape)
    result = np.empty((len(names), len(geometry), *shape), np.float32)
    weight = np.array([-1.0 if solid.mu_per_mm < 0 else 1.0 for solid in scene.solids])
    channel = np.array([names.index(solid.material) for solid in scene.solids], np.int64)
    _project(scene.solids, geometry, shape, weight, channel, result)
    return dict(zip(names, result, strict=True))


def _project(
    solids: tuple[Solid, ...],
    geometry: ConeVec,
    shape: Shape2,
    weight: FloatArray,
    channel: npt.NDArray[np.int64],
    out: Float32Array,
) -> None:
    from flexdt.twin.projection.kernels import analytic_kernels

    if not solids or out.size == 0:
        out.fill(0)
        return
    table = encode([solid.shape for solid in solids])
    rays = geometry.rays(shape)
    analytic_kernels.project_convex(
        table.quadric,
        table.slabs,
        table.slab_range,
        shadows(table, rays, shape),
        rays,
        weight,
        channel,
        out,
    )


def warm_up() -> None:
    """Run what `project_scene`, `forward` and `back` into new memory do, on tiny problems."""
    warm_up_forward()
    warm_up_back()


def warm_up_forward() -> None:
    """Run `project_scene`, and `forward` with rays in fans and alone."""
    shapes = (Sphere((0, 0, 0), 1.0), Box((0, 0, 0), (1, 1, 1)), Cylinder((0, 0, 0), 1.0, 1.0))
    project_scene(Scene(tuple(Solid(s, "water", 0.02) for s in shapes)), LEVEL, (5, 6))
    for volume in _tiny_volumes():
        forward(volume, END_ON, (5, 6))
        layout = volume.layout  # so small a problem would not be walked in fans
        images = np.empty((1, 5, 6), np.float32)
        cpu.project(box_of(layout), voxel_rays(LEVEL, layout, (5, 6)), images)


def warm_up_back() -> None:
    """Run `back` into new memory, with rays in fans and alone."""
    images = np.ones((1, 5, 6), np.float32)
    for volume in _tiny_volumes():
        back(images, END_ON, volume)
        target = blank_layout(volume)
        cpu.spread(box_of(target), voxel_rays(LEVEL, target, (5, 6)), images)
        bring_over(layout_data(target), target.flat, target.stride_x, target.stride_y, adding=True)


LEVEL = ConeVec.from_vectors((0, -10, 0), (0, 10, 0), (1, 0, 0), (0, 0, -1))
END_ON = ConeVec.from_vectors((0, 0, -10), (0, 0, 10), (1, 0, 0), (0, 1, 0))


def _tiny_volumes() -> tuple[Volume, Volume]:
    """In C order, and with z contiguous."""
    data = np.ones((4, 3, 2), np.float32)
    turned = np.ascontiguousarray(data.transpose(1, 2, 0)).transpose(2, 0, 1)
    return Volume(data, 0.5), Volume(turned, 0.5)
