"""The one statement of frames, signs and units; everything else converts at the edge.

World frame, right-handed: +x to the right as seen from the source (traversal), +y from
source to detector (magnification), +z up. Origin: the lowest central point of the source
(thesis 4.3.1).

Object frame: centered on the rotation axis at the sample's reference height. It coincides
with the world's directions at rot_obj = 0 and turns with the stage; growing rot_obj turns
the object CLOCKWISE seen from above. cone_vec rows are always in this frame, so a turn by
phi is ASTRA's `cone` angle +phi.

Detector: u = +x is the step to the next column, v = -z the step to the next row, so
frame[0, 0] is the top left pixel seen from the source. The normal u x v is +y, away from
the source. Integer pixel coordinates (column, row) are pixel centers, counted from (0,
0).

Unity's frame of the thesis is left-handed with (x traversal, y vertical, z
magnification); here that is (x, z, y), a swap without any sign change. The swap has
determinant -1, which is exactly the change of handedness. The thesis's equation 4.1 has
determinant +1 and does not change handedness (it mirrors the volume top to bottom unless
that is stored upside down as well), so it is not used. Unity's R_y(a) of eq. 5.5 becomes
R_z(-a): clockwise from above.

Inside the package: mm, rad, s. Degrees, kV, W and ms appear only at the edges, with a
suffix in the name. `T_a_b` takes coordinates in b to a.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
NEXT_AXIS: Final = np.array([1, 2, 0])
LAST_AXIS: Final = np.array([2, 0, 1])
"""For each axis the next and the last one, in a circle."""

COORDINATES = ("x", "y", "z")
RIGHT = (1.0, 0.0, 0.0)
"""Unit vector of traversal, +x."""
BEAM = (0.0, 1.0, 0.0)
"""Unit vector of magnification, +y, from source to detector."""
UP = (0.0, 0.0, 1.0)
"""Unit vector of height, +z."""

COLUMN_DIRECTION = (1.0, 0.0, 0.0)
"""Direction of u, the step to the next column, for an untilted detector."""
ROW_DIRECTION = (0.0, 0.0, -1.0)
"""Direction of v, the step to the next row, for an untilted detector."""


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Compute the cross products of the rows of two arrays (n, 3), bit by bit as `np.cross`
    does, which takes several times as long for the few rows of a geometry.

    Example:
        >>> cross(np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])).tolist()
        [[0.0, 0.0, 1.0]]"""
    first = a.take(NEXT_AXIS, axis=1) * b.take(LAST_AXIS, axis=1)
    return np.asarray(first - a.take(LAST_AXIS, axis=1) * b.take(NEXT_AXIS, axis=1))


def as_numbers(
    what: str, value: object, dtype: npt.DTypeLike = np.float64
) -> npt.NDArray[Any]:
    """Convert to an array of real numbers.

    An array of that type is returned itself, without a copy; finiteness and shape are not
    checked.

    Args:
        what: name of the value, for the message.
        value: to convert.
        dtype: of the result.

    Raises:
        GeometryError: `value` contains something that is no real number.

    Example:
        >>> as_numbers("distances", [1, 2]).tolist()
        [1.0, 2.0]
    """
    try:
        values = np.asarray(value)
        if values.dtype.kind == "c":
            raise TypeError
        return values.astype(dtype, copy=False)
    except (TypeError, ValueError):
        kind = type(value).__name__
        raise GeometryError(
            f"{what}: {'an' if kind[0] in 'aeiou' else 'a'} {kind}; "
            "allowed: an array of numbers",
            {"asked": kind, "allowed": "numbers"},
        ) from None


def rotation_x(angle: float) -> FloatArray:
    """Compute the right-handed rotation by `angle` [rad] about +x, shape (3, 3).

    Example:
        >>> (rotation_x(np.pi / 2) @ [0, 1, 0]).round(9).tolist()
        [0.0, 0.0, 1.0]"""
    c = math.cos(angle)
    s = math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_y(angle: float) -> FloatArray:
    """Compute the right-handed rotation by `angle` [rad] about +y, shape (3, 3).

    Example:
        >>> (rotation_y(np.pi / 2) @ [0, 0, 1]).round(9).tolist()
        [1.0, 0.0, 0.0]"""
    c = math.cos(angle)
    s = math.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rotation_z(angle: float | FloatArray) -> FloatArray:
    """Compute right-handed rotations by `angle` [rad] about +z, one matrix for each
    angle: (...) -> (..., 3, 3).

    Example:
        >>> (rotation_z(np.pi / 2) @ [1, 0, 0]).round(9).tolist()
        [0.0, 1.0, 0.0]
    """
    a = np.asarray(angle, dtype=np.float64)
    c = np.cos(a)
    s = np.sin(a)
    out = np.zeros((*a.shape, 3, 3))
    out[..., 0, 0] = c
    out[..., 0, 1] = -s
    out[..., 1, 0] = s
    out[..., 1, 1] = c
    out[..., 2, 2] = 1.0
    return out


def rotation_about(axis: npt.ArrayLike, angle: float) -> FloatArray:
    """Compute right-handed rotations (..., 3, 3) by `angle` [rad] about directions (...,
    3) (Rodrigues).

    Directions are normalized; one of length 0 gives NaN. All are turned by the one angle.

    Example:
        >>> bool(np.allclose(rotation_about([0, 0, 2], 0.3), rotation_z(0.3)))
        True"""
    k = np.asarray(axis, dtype=np.float64)
    k = k / np.linalg.norm(k, axis=-1, keepdims=True)
    cross = np.swapaxes(np.cross(k[..., None, :], np.eye(3)), -1, -2)
    turned: FloatArray = (
        np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    )
    return turned


def stage_rotation(angle: float | FloatArray) -> FloatArray:
    """Compute T_world_object (rotation part) at stage angle `angle` [rad]:
    clockwise from above.

    Example:
        >>> (stage_rotation(np.pi / 2) @ [1, 0, 0]).round(9).tolist()  # clockwise from above
        [0.0, -1.0, 0.0]"""
    return rotation_z(-np.asarray(angle, dtype=np.float64))


def from_unity(vector: npt.ArrayLike) -> FloatArray:
    """Convert Unity's (x, y, z) of the thesis, shape (..., 3), to the world's (x, z, y);
    its own inverse.

    Example:
        >>> from_unity([1.0, 2.0, 3.0]).tolist()
        [1.0, 3.0, 2.0]"""
    swapped: FloatArray = np.asarray(vector, dtype=np.float64)[..., [0, 2, 1]]
    return swapped


def turn_detector(
    u: npt.ArrayLike, v: npt.ArrayLike, yaw: float, pitch: float, roll: float
) -> tuple[FloatArray, FloatArray]:
    """Turn pixel steps by yaw about v, pitch about the turned u, roll about the turned
    normal.

    In that order, for each pair of steps. The steps keep their lengths and the angle
    between them.

    Args:
        u: steps to the next column, (..., 3) [mm].
        v: steps to the next row, (..., 3) [mm].
        yaw: [rad], right-handed like the other two.
        pitch: [rad].
        roll: [rad], about u x v.

    Returns:
        Turned u and v, (..., 3) [mm].

    Example:
        >>> u, v = turn_detector([1, 0, 0], [0, 0, -1], yaw=0.0, pitch=0.0, roll=np.pi / 2)
        >>> u.round(9).tolist()  # seen from the source, columns now grow downwards
        [0.0, 0.0, -1.0]
    """
    u1, v1 = (np.asarray(step, dtype=np.float64)[..., None] for step in (u, v))
    u1 = rotation_about(v, yaw) @ u1
    v1 = rotation_about(u1[..., 0], pitch) @ v1
    r = rotation_about(np.cross(u1[..., 0], v1[..., 0]), roll)
    return (r @ u1)[..., 0], (r @ v1)[..., 0]
