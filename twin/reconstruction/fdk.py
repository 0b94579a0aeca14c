"""Filtered backprojection for cone beams on a circle (Feldkamp, Davis and Kress 1984).

The panel may be moved to any side and turned about the vertical: distances and angles come from
each row of the geometry. Tilted panels are resampled upright first. Views may come in parts, so
neither all images nor, slab by slab, the whole volume need fit into memory. It refuses what is
no circle.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.conventions import Float32Array, FloatArray
from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry import ConeVec
from flexdt.twin.projection import Volume
from flexdt.twin.projection.operators import as_cone_vec, check_projections
from flexdt.twin.reconstruction.backprojectors import backprojector
from flexdt.twin.reconstruction.filtering import filtered, ramp
from flexdt.twin.reconstruction.grid import of_rows, rows_needed
from flexdt.twin.reconstruction.rectify import is_upright, on_its_side, rectified, swapped, upright
from flexdt.twin.reconstruction.trajectory import Circle, circle_of, redundancy

Progress = Callable[[float], None]
"""Told the part done, from 0 to 1."""

CHUNK = 32
"""Views worked on at a time."""


def fdk(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume,
    *,
    window: str = "ram-lak",
    progress: Progress | None = None,
) -> Volume:
    """Reconstruct attenuation from line integrals of a circular scan.

    Args:
        projections: (n, rows, cols) line integrals.
        cone_vec: ConeVec or (n, 12) [mm].
        like: the grid; its values are not used.
        window: of the ramp filter: ram-lak, shepp-logan, cosine, hamming, hann.
        progress: told the part done.

    Returns:
        Volume [1/mm]; its data is a (nz, ny, nx) view with z contiguous.

    Raises:
        GeometryError: no circle, too short a scan, or shapes that do not fit.
        UnknownNameError: no such window.
    """
    geometry = as_cone_vec(cone_vec)
    values = np.asarray(projections)
    if values.ndim != 3:
        values = check_projections(values, len(geometry))

    def parts() -> Iterable[Float32Array]:
        for start in range(0, len(values), CHUNK):
            yield np.asarray(values[start : start + CHUNK], dtype=np.float32)

    return fdk_parts(parts(), geometry, (values.shape[1], values.shape[2]), like, window, progress)


def fdk_parts(
    parts: Iterable[Float32Array],
    cone_vec: ConeVec,
    shape: tuple[int, int],
    like: Volume,
    window: str = "ram-lak",
    progress: Progress | None = None,
) -> Volume:
    """As `fdk`, with the views coming in parts, in order.

    Args:
        parts: float32 (k, rows, cols) arrays of line integrals; together one image a view.
        cone_vec: of all views.
        shape: detector (rows, cols).
        like: the grid.
        window: of the ramp filter.
        progress: told the part done.
    """
    circle = circle_of(cone_vec)
    if on_its_side(cone_vec):
        parts = (part.transpose(0, 2, 1) for part in parts)
        cone_vec, shape = swapped(cone_vec), (shape[1], shape[0])
    tilted = not is_upright(cone_vec)
    level = panels = upright(cone_vec) if tilted else cone_vec
    weights = redundancy(circle, level, shape[1])
    # Only rows in the grid's shadow matter: the filter runs along rows.
    first, last = rows_needed(level, shape, like)
    level = of_rows(level, shape, first, last)
    table = view_table(level, (last - first, shape[1]))
    target = backprojector(like)
    responses: dict[float, Float32Array] = {}
    done = 0
    for part in parts:
        views = slice(done, done + len(part))
        if part.shape[1:] != shape or views.stop > len(cone_vec):
            raise GeometryError(
                f"projections of shape {part.shape} after {done} views; allowed: "
                f"{len(cone_vec)} views of {shape}",
                {"asked": list(part.shape), "allowed": [len(cone_vec), *shape]},
            )
        images = rectified(part, cone_vec[views], panels[views]) if tilted else part
        images = images[:, first:last]
        pitch = float(np.linalg.norm(level.u[views.start]))
        if pitch not in responses:
            responses[pitch] = ramp(shape[1], pitch, window)
        ready = _weighted(images, level[views], circle, views, weights[views])
        ready = filtered(ready, responses[pitch])
        columns = np.ascontiguousarray(ready.transpose(0, 2, 1))
        target.add(columns, table[views])
        done = views.stop
        if progress is not None:
            progress(done / len(cone_vec))
    if done != len(cone_vec):
        raise GeometryError(
            f"{done} projections for {len(cone_vec)} views",
            {"asked": done, "allowed": len(cone_vec)},
        )
    return replace(like, data=target.volume().transpose(2, 0, 1))


def _weighted(
    images: Float32Array, cone_vec: ConeVec, circle: Circle, views: slice, weights: FloatArray
) -> Float32Array:
    """Images times everything that stands before the filter.

    The cosine is that of the ray with the line from source to axis. Exact fan-beam inversion for a
    panel at any angle to that line then needs the distance along the panel's normal only.
    """
    rows, cols = images.shape[1:]
    out = np.empty(images.shape, np.float32)
    r = np.arange(rows) - (rows - 1) / 2
    c = np.arange(cols) - (cols - 1) / 2
    for i, row in enumerate(cone_vec.rows):
        source, centre, u, v = row[0:3], row[3:6], row[6:9], row[9:12]
        inward = np.zeros(3)
        inward[:2] = (circle.centre - source[:2]) / np.linalg.norm(circle.centre - source[:2])
        normal = np.cross(u, v)
        depth = abs(float((centre - source) @ normal)) / float(np.linalg.norm(normal))
        x = (centre - source)[:2] + c[:, None] * u[:2]
        z = (centre - source)[2] + r * v[2]
        length = np.sqrt((x * x).sum(axis=1)[None, :] + (z * z)[:, None])
        along = x @ inward[:2]
        radius = float(np.linalg.norm(circle.centre - source[:2]))
        factor = weights[i] * along * (circle.step[views.start + i] * depth * radius)
        np.multiply(images[i], (factor[None, :] / length).astype(np.float32), out=out[i])
    return out


def view_table(cone_vec: ConeVec, shape: tuple[int, int]) -> FloatArray:
    """What the kernel needs of upright views, (n, 11); see `fdk_kernels.backproject`."""
    rows, cols = shape
    pitch_u = np.linalg.norm(cone_vec.u, axis=1)
    pitch_v = np.linalg.norm(cone_vec.v, axis=1)
    u = cone_vec.u[:, :2] / pitch_u[:, None]
    offset = cone_vec.detector - cone_vec.source
    normal = np.column_stack([-u[:, 1], u[:, 0]])
    depth = (offset[:, :2] * normal).sum(axis=1)
    normal *= np.sign(depth)[:, None]
    depth = np.abs(depth)
    foot_c = (cols - 1) / 2 - (offset[:, :2] * u).sum(axis=1) / pitch_u
    foot_r = (rows - 1) / 2 + offset[:, 2] / pitch_v
    return np.ascontiguousarray(
        np.column_stack(
            [cone_vec.source, normal, u, depth / pitch_u, foot_c, depth / pitch_v, foot_r]
        )
    )
