"""TIGRE's cone geometry: the attributes of its `Geometry`, with an offset a view where it
varies, and the angles (compared with the source of version 3.1.3, commit e702473).

TIGRE's frame is ours. At angle a its source stands at DSO (cos a, sin a, 0), a panel
without offset opposite; u points to +y and the rows grow upwards at a = 0. So its angle
is ours less 90 deg, and the rows of a panel that grow downwards are a pitch of 180 deg.
`offOrigin` moves source and panel together, `offDetector` the panel in its plane before
it turns, and `rotDetector` (about x, y and z, the turn about z last) turns it about its
center. The angle is that of the panel's normal, so that DSD and DSO are those along it,
by which TIGRE's FDK weighs; it reads offsets of a panel aside where one holds for all
views, so an attribute that is the same in all views is written once.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.exchange.geometry import (
    ScanGeometry,
    require_each,
    require_panel,
)
from flexdt.twin.exchange.geometry_tables import TIGRE
from flexdt.twin.exchange.number_tables import cone_vec_of
from flexdt.twin.exchange.view_arrays import (
    SPACE,
    Arrays,
    counts_of,
    numbers_of,
    require_names,
    require_shape,
    sizes_of,
    stated,
    views_of,
)
from flexdt.twin.geometry.conventions import FloatArray, rotation_z

CONSTANT_TOLERANCE: Final = 1e-11
"""Largest change of an attribute between views [mm, rad] that is written once: a
hundredth of an exchange format's largest error."""
MIN_LEVEL_PART: Final = 1e-6
"""Least horizontal part of the panel's normal from which its angle is computed."""
PER_VIEW: Final = {"DSO": 0, "DSD": 0, "offOrigin": 3, "offDetector": 2, "rotDetector": 3}
"""Attributes with a value a view -> length of a value; 0: a number. Lengths [mm],
turns [rad]."""
PANEL: Final = ("nDetector", "dDetector", "sDetector")
"""Counts and sizes; the direction of rows (v) comes first, as z does in offOrigin."""
ANGLES: Final = "angles"
SAME_SIZE: Final = 1e-6
"""Relative difference of two statements of the panel's size that is none."""


def tigre_arrays(geometry: ScanGeometry) -> dict[str, npt.NDArray[np.generic]]:
    """Convert a geometry to the attributes of TIGRE's `Geometry`, with `angles` [rad].

    Arrays of two are (rows, columns), of three (z, y, x); angles are unwrapped, one a
    view.

    Args:
        geometry: with the detector's shape.

    Returns:
        Name -> array; an attribute that is the same in all views has one value, else one
        a view.

    Raises:
        ExchangeError: skew pixels, several pixel sizes, an unknown shape, a horizontal
            panel, a source that is not before the object's origin, or a panel that is not
            behind the source.
    """
    rows, columns = require_shape(geometry, "TIGRE")
    pitch_u, pitch_v = require_panel(geometry.cone_vec, "TIGRE")
    c = geometry.cone_vec
    u, v = c.u / pitch_u, c.v / pitch_v
    right_handed = np.cross(u, v)
    apart = c.source - c.detector
    normal = right_handed * np.sign(np.einsum("ni,ni->n", right_handed, apart))[:, None]
    level = np.hypot(normal[:, 0], normal[:, 1])
    message = "TIGRE knows panels that do not lie flat; the sine of their normal to the xy plane"
    require_each(message, np.sqrt(np.maximum(1.0 - level**2, 0.0)), 1.0 - MIN_LEVEL_PART)
    angles = np.unwrap(np.arctan2(normal[:, 1], normal[:, 0]))
    back = rotation_z(-angles)
    source, apart, u, v = (
        np.einsum("nij,nj->ni", back, p) for p in (c.source, apart, u, v)
    )
    message = "TIGRE knows sources before the object's origin; the distance [mm] that it is behind"
    require_each(message, -source[:, 0], 0.0)
    message = "TIGRE knows panels behind the source; the distance [mm] before it"
    require_each(message, -apart[:, 0], 0.0)
    aside = np.column_stack([np.zeros(len(c)), source[:, 1], source[:, 2]])
    moved = -np.einsum("nij,nj->ni", rotation_z(angles), aside)
    per_view = {
        "DSO": source[:, 0],
        "DSD": apart[:, 0],
        "offOrigin": moved[:, ::-1],
        "offDetector": -apart[:, :0:-1],
        "rotDetector": _turns(np.stack([np.cross(u, v), u, v], axis=2)),
    }
    counts = np.array([rows, columns])
    pitch = np.array([pitch_v, pitch_u])
    panel = dict(zip(PANEL, (counts, pitch, counts * pitch), strict=True))
    return {**{name: _once(x) for name, x in per_view.items()}, **panel, ANGLES: angles}


def _once(values: FloatArray) -> FloatArray:
    """Return one value, (1,) or (k,), if all views agree to `CONSTANT_TOLERANCE`.

    Else (n,) or (n, k) values of all views. Negative zeros become 0.
    """
    still = np.ptp(values, axis=0).max() <= CONSTANT_TOLERANCE
    if values.ndim == 1:
        one: FloatArray = values[:1]
    else:
        one = values[0]
    return np.ascontiguousarray(one if still else values) + 0.0


def _turns(axes: FloatArray) -> FloatArray:
    """Find the turns about x, y and z [rad] whose product, Rz Ry Rx, is `axes`.

    Two triples give the same product; the one whose turns about x and z are smaller is
    taken. Each turn is above -pi and at most pi.

    Args:
        axes: (n, 3, 3) rotations.

    Returns:
        (n, 3) [rad].
    """
    pitch = np.arcsin(np.clip(-axes[:, 2, 0], -1.0, 1.0))
    yaw = np.arctan2(axes[:, 2, 1], axes[:, 2, 2])
    roll = np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
    first = np.column_stack([yaw, pitch, roll])
    other = np.column_stack([yaw + np.pi, np.pi - pitch, roll + np.pi])
    both = np.stack([first, other])
    whole = both - 2.0 * np.pi * np.round(both / (2.0 * np.pi))
    nearer = np.abs(whole[:, :, [0, 2]]).sum(axis=2).argmin(axis=0)
    turns: FloatArray = whole[nearer, np.arange(len(axes))]
    # Half a turn either way is one pose; all views of a scan have the same sign.
    return np.where(
        np.isclose(turns, -np.pi, rtol=0.0, atol=CONSTANT_TOLERANCE),
        turns + 2.0 * np.pi,
        turns,
    )


def read_tigre(arrays: Arrays, file: str = "<npz>") -> ScanGeometry:
    """Convert TIGRE's attributes and angles to a geometry.

    A COR of zeros is allowed.

    Args:
        arrays: name -> array, as from `tigre_arrays`.
        file: for messages.

    Raises:
        ExchangeError: an attribute is missing or not valid, or there is a center of
            rotation (COR).
    """
    require_names(arrays, (*PER_VIEW, "nDetector", "dDetector", ANGLES), file)
    said = stated(TIGRE, arrays, file)
    views = views_of(arrays, ANGLES, file)
    angles = numbers_of(arrays, ANGLES, file, (views,))
    dso, dsd, off_origin, off_detector, turned = (
        _each(arrays, name, size, file, views) for name, size in PER_VIEW.items()
    )
    rows, columns = counts_of(arrays, "nDetector", file, (2,))
    pitch_v, pitch_u = sizes_of(arrays, "dDetector", file, (2,))
    axes = _axes(turned)
    source = np.column_stack([dso, np.zeros(views), np.zeros(views)])
    detector = np.column_stack([dso - dsd, off_detector[:, ::-1]])
    turn = rotation_z(angles)
    placed = [source, detector, pitch_u * axes[:, :, 1], pitch_v * axes[:, :, 2]]
    parts = [np.einsum("nij,nj->ni", turn, part) for part in placed]
    for place in parts[:2]:
        place -= off_origin[:, ::-1]
    cone = cone_vec_of(np.concatenate(parts, axis=1), file)
    said.use_all()
    _compare_sizes(said, arrays, (rows * pitch_v, columns * pitch_u))
    return ScanGeometry(cone, (rows, columns)).accounted(said)


def _compare_sizes(said: Ledger, arrays: Arrays, sizes: tuple[float, float]) -> None:
    """Set the panel's stated size aside where it is not that of its pixels [mm]."""
    if "sDetector" not in arrays:
        return
    stated_mm = np.ravel(arrays["sDetector"])
    fits = stated_mm.dtype.kind in "iuf" and stated_mm.shape == (len(sizes),)
    if not fits or not np.allclose(stated_mm, sizes, rtol=SAME_SIZE):
        shown = " x ".join(f"{one:.6g}" if fits else str(one) for one in stated_mm)
        pixels = " x ".join(f"{one:.6g}" for one in sizes)
        why = (
            f"sDetector is {shown} mm, nDetector x dDetector {pixels} mm, which is taken"
        )
        said.set_aside("sDetector", why)


def _each(arrays: Arrays, name: str, size: int, file: str, views: int) -> FloatArray:
    """Return each view's value from an array with one, or one for each view.

    (views, size); (views,) for a size of 0, a single number. Raises ExchangeError:
    another shape, or not finite.
    """
    form: tuple[int, ...] = (size,) if size else ()
    single: tuple[int, ...] = (size,) if size else (1,)
    if np.shape(arrays[name]) == single:
        return np.broadcast_to(numbers_of(arrays, name, file, single), (views, *form))
    return numbers_of(arrays, name, file, (views, *form))


def _axes(turns: FloatArray) -> FloatArray:
    """Compute the rotations Rz Ry Rx of turns; the inverse of `_turns`.

    Rotations about fixed axes: x first, then y, then z.

    Args:
        turns: about x, y and z (n, 3) [rad].

    Returns:
        (n, 3, 3).
    """
    yaw, pitch, roll = turns.T
    one = np.ones_like(yaw)
    zero = np.zeros_like(yaw)
    about_x = _stacked(
        one, zero, zero, zero, np.cos(yaw), -np.sin(yaw), zero, np.sin(yaw), np.cos(yaw)
    )
    about_y = _stacked(
        np.cos(pitch),
        zero,
        np.sin(pitch),
        zero,
        one,
        zero,
        -np.sin(pitch),
        zero,
        np.cos(pitch),
    )
    product: FloatArray = rotation_z(roll) @ about_y @ about_x
    return product


def _stacked(*entries: FloatArray) -> FloatArray:
    """Stack nine entries (n,) to matrices (n, 3, 3), row by row."""
    return np.stack(entries, axis=1).reshape(-1, SPACE, SPACE)
