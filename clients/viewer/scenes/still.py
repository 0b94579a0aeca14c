"""A picture of the scene that the viewer computes itself, for pages that cannot draw one yet.

Triangles are shaded flat and compete for pixels by their depth, in whole arrays: triangles of
about one size are filled together. The live scene replaces it, so shadows and smooth surfaces
can wait.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from flexdt.clients.viewer.scenes.meshes.painted_meshes import PaintedMesh
from flexdt.clients.viewer.scenes.sample_looks import Skin
from flexdt.clients.viewer.scenes.views import Standpoint
from flexdt.clients.viewer.scenes.world import MM, World
from flexdt.twin.geometry.conventions import FloatArray

NEAR_M = 0.02
"""Least distance from the eye [m]; a nearer triangle is left out completely."""
LARGE_MM = 250.0
PLACES_AT_ONCE = 1 << 21
"""Number of places of the screen that are tested at a time: some 100 MB."""
SMOOTH = 2
SMALL_PX = 1 << 17
"""Computed pixels of each side of a pixel, in pictures with no more pixels: a view's
own would take three times as long, and is soon replaced."""
SKY = 0.62
KEY = (0.55, -0.6, 0.58)
"""Part of light from all sides, and the direction of the rest."""
GROUND = {False: ((248, 250, 253), (217, 225, 236)), True: ((42, 49, 64), (15, 19, 26))}
"""Dark page or not -> color of the background above and below, as the scenes have it."""
Pose = tuple[float, ...]
"""Quaternion (w, x, y, z) and place [m]."""
IMAGE_CELLS = (76, 60)
"""Number of columns and rows of the image on the panel."""


@dataclass(frozen=True, eq=False)
class Shape:
    """Triangles that are seen from their front only.

    Attributes:
        corners: (n, 3, 3) [m, world], counter-clockwise from the front.
        color: (3,) or (n, 3), 0 to 255.
        opacity: below 1 the background shows through.
        lit: whether its color depends on the light.
    """

    corners: FloatArray
    color: npt.NDArray[np.generic]
    opacity: float = 1.0
    lit: bool = True


def cut(pieces: Iterable[PaintedMesh]) -> list[Shape]:
    """Convert painted meshes [mm] to opaque shapes [m], in order.

    Large triangles (`LARGE_MM`) are divided, as they may reach behind the eye.
    """
    out = []
    for piece in pieces:
        mesh: Any = piece.mesh
        if max(mesh.extents) > LARGE_MM:
            mesh = mesh.subdivide_to_size(LARGE_MM)
        out.append(Shape(mesh.triangles * MM, np.array(piece.paint.color)))
    return out


def shape_of(skin: Skin, opacity: float) -> Shape:
    """Make the shape of a sample's mesh in its own frame, beads opaque."""
    corners = np.asarray(skin.vertices, dtype=float)[skin.faces]
    return Shape(corners, np.array(skin.color), 1.0 if skin.dense else opacity)


def placed(shapes: Iterable[Shape], pose: Pose) -> list[Shape]:
    """Move shapes of a frame to its pose."""
    turn = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix().T
    return [replace(shape, corners=shape.corners @ turn + pose[4:]) for shape in shapes]


def image_on(rgb: npt.NDArray[np.uint8], world: World) -> Shape:
    """Make the shape of the panel's image, in front of the panel.

    Reduced to the number of cells, two triangles each; not lit. It is 1 mm in front of
    the panel, towards the source.

    Args:
        rgb: (rows, cols, 3); drawn as IMAGE_CELLS.
        world: place of the panel.
    """
    import cv2

    (cols, rows) = IMAGE_CELLS
    (first, right, _, down) = world.corners - world.normal
    colors = cv2.resize(rgb, IMAGE_CELLS, interpolation=cv2.INTER_AREA).reshape(-1, 3)
    y, x = (part[..., None] for part in np.mgrid[: rows + 1, : cols + 1])
    grid = (first + (right - first) * x / cols + (down - first) * y / rows) * MM
    a = grid[:-1, :-1]
    b = grid[:-1, 1:]
    c = grid[1:, 1:]
    d = grid[1:, :-1]
    halves = [
        np.stack(three, axis=2).reshape(-1, 3, 3) for three in ((a, d, c), (a, c, b))
    ]
    return Shape(np.concatenate(halves), np.concatenate([colors, colors]), lit=False)


def cone(world: World, color: tuple[int, int, int], opacity: float) -> Shape:
    """Make the translucent shape of the beam's sides, from the focal spot to the image's
    corners [m], not lit.

    Four triangles; `color` is (r, g, b) from 0 to 255, `opacity` from 0 to 1."""
    corners = world.corners * MM
    spot = np.broadcast_to(world.source * MM, corners.shape)
    sides = np.stack([spot, np.roll(corners, -1, axis=0), corners], axis=1)
    return Shape(sides, np.array(color), opacity, lit=False)


def drawn(
    shapes: Sequence[Shape], camera: Standpoint, size: tuple[int, int], dark: bool
) -> npt.NDArray[np.uint8]:
    """Draw the picture (height, width, 3), RGB.

    Small pictures are drawn finer and averaged; the background is shaded from top to
    bottom. Opaque shapes hide by depth; a translucent one is blended where nothing opaque
    is nearer, its own nearest triangle alone. Up to `SMALL_PX` pixels are computed
    `SMOOTH` times finer a side.

    Args:
        shapes: visible ones; the translucent ones are drawn over the others in their
            order.
        camera: of the view.
        size: (width, height) [px].
        dark: the page's background.
    """
    import cv2

    if size[0] * size[1] <= SMALL_PX:
        fine = SMOOTH
    else:
        fine = 1
    width, height = (fine * side for side in size)
    above, below = (np.array(color, dtype=np.float32) for color in GROUND[dark])
    down = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
    out = (
        np.broadcast_to(above + down * (below - above), (height, width, 3))
        .reshape(-1, 3)
        .copy()
    )
    nearest = np.zeros(width * height, dtype=np.float32)
    solid = [shape for shape in shapes if shape.opacity >= 1.0]
    for group in (solid, *([shape] for shape in shapes if shape.opacity < 1.0)):
        if not group:
            continue
        corners = np.concatenate([shape.corners for shape in group])
        color = np.concatenate([_shaded(shape) for shape in group])
        depth, which = _filled(_projected(corners, camera, width, height), width, height)
        seen = np.flatnonzero((which >= 0) & (depth > nearest))
        alpha = group[0].opacity
        out[seen] += alpha * (color[which[seen]] - out[seen])
        if alpha >= 1.0:
            nearest = depth
    whole = np.clip(out.reshape(height, width, 3), 0.0, 255.0)
    small = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def jpeg(picture: npt.NDArray[np.uint8], most: int) -> bytes:
    """Encode as a JPEG of the best of four qualities that fits into `most` bytes; the
    worst, if none does.

    `picture` is RGB (height, width, 3); qualities are 85, 75, 60 and 40.
    """
    import cv2

    for quality in (85, 75, 60, 40):
        coded = cv2.imencode(
            ".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality]
        )[1]
        if coded.size <= most:
            break
    return coded.tobytes()


def _shaded(shape: Shape) -> npt.NDArray[np.float32]:
    """Compute the colors (n, 3) float32 of a shape's triangles: its color times the
    light on each triangle's normal; unchanged if it is not lit.

    Values may exceed 255. A part `SKY` of the light comes from above, the rest from
    `KEY`.
    """
    color = np.broadcast_to(shape.color, (len(shape.corners), 3)).astype(np.float32)
    if not shape.lit:
        return color
    a, b, c = np.moveaxis(shape.corners, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    facing = np.clip(normal @ KEY, 0.0, 1.0) * (1.05 - SKY) + SKY * (
        0.8 + 0.2 * normal[:, 2]
    )
    return np.asarray(color * facing[:, None], dtype=np.float32)


def _projected(
    corners: FloatArray, camera: Standpoint, width: int, height: int
) -> FloatArray:
    """Project the corners of triangles onto a picture.

    Rows grow downwards. Too near is less than `NEAR_M` ahead; the opening is the camera's
    vertical one.

    `corners`: (n, 3, 3) [m]; `camera`: where it is and looks; `width`: of the picture [px];
    `height`: of the picture [px].
    Returns (n, 3, 3) column, row [px] and inverse depth [1/m]; NaN too near the eye.
    """
    eye = np.asarray(camera.position)
    up = np.asarray(camera.up)
    ahead = np.asarray(camera.look_at) - eye
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    x, y, z = np.moveaxis((corners - eye) @ axes, 2, 0)
    inverse = 1.0 / np.where(z > NEAR_M, z, np.nan)
    scale = 0.5 * height / math.tan(0.5 * camera.fov) * inverse
    return np.stack([0.5 * width + scale * x, 0.5 * height + scale * y, inverse], axis=2)


def _filled(
    corners: FloatArray, width: int, height: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Fill the pixels with the nearest triangles.

    Triangles seen from behind, and with points that are not finite, are left out. Of
    equally near triangles the last filled one wins. At most `PLACES_AT_ONCE` pixels are
    tested at a time.

    Args:
        corners: (n, 3, 3) column, row [px] and inverse depth [1/m].
        width, height: of the picture [px].

    Returns:
        Of each pixel, row by row: the inverse depth of the nearest triangle, and its
        index; 0 and -1 where there is none.
    """
    low = np.floor(corners[:, :, :2].min(axis=1))
    high = np.minimum(np.ceil(corners[:, :, :2].max(axis=1)), [width, height])
    low = np.maximum(low, 0)
    x, y, inverse = np.moveaxis(corners, 2, 0)
    # An edge, and the inverse depth, is a plane over the screen: of each its slopes and its
    # height at the middle of the triangle's first pixel.
    to_x = np.roll(x, -1, axis=1) - x
    to_y = np.roll(y, -1, axis=1) - y
    area = to_x[:, 0] * to_y[:, 1] - to_y[:, 0] * to_x[:, 1]
    edges = np.stack([-to_y, to_x], axis=2)
    at = to_x * (low[:, 1:] + 0.5 - y) - to_y * (low[:, :1] + 0.5 - x)
    part = np.roll(inverse, 1, axis=1) / area[:, None]
    planes = np.concatenate(
        [edges, (part[:, :, None] * edges).sum(axis=1)[:, None]], axis=1
    )
    planes = planes.astype(np.float32)
    at = np.concatenate([at, (part * at).sum(axis=1)[:, None]], axis=1).astype(np.float32)
    # Rows go downwards, so a triangle that is counter-clockwise from the front has a negative
    # area.
    whole = (
        np.isfinite(corners).all(axis=(1, 2)) & (high > low).all(axis=1) & (area < 0.0)
    )
    depth = np.zeros(width * height, dtype=np.float32)
    which = np.full(width * height, -1, dtype=np.int64)
    sides = np.where(whole[:, None], np.maximum(high - low, 1.0), 1.0)
    power = np.ceil(np.log2(sides)).astype(int)
    for across, down in np.unique(power[whole], axis=0).tolist():
        of_class = np.flatnonzero(whole & (power == (across, down)).all(axis=1))
        columns = np.arange(2**across)[None, None]
        rows = np.arange(2**down)[None, :, None]
        pieces = 1 + (len(of_class) << (across + down)) // PLACES_AT_ONCE
        for some in np.array_split(of_class, pieces):
            first = low[some].astype(int)
            last = high[some].astype(int)
            inside = (columns < (last - first)[:, :1, None]) & (
                rows < (last - first)[:, 1:, None]
            )
            for k in range(4):
                a, b = (planes[some, k, n, None, None] for n in (0, 1))
                value = (at[some, k, None, None] + b * rows.astype(np.float32)) + (
                    a * columns.astype(np.float32)
                )
                if k < 3:
                    inside &= value <= 0.0
            index, row, column = np.nonzero(inside)
            place = (first[index, 1] + row) * width + first[index, 0] + column
            value = value[inside]
            np.maximum.at(depth, place, value)
            won = value >= depth[place]
            which[place[won]] = some[index[won]]
    return depth, which
