"""Four balls of unlike size, which lie where no mirror image or turn of them is the same.

Their radiographs are their chords, in closed form. A volume that is mirrored, turned the other
way or shifted does not have them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import flexdt as fx
from flexdt.twin.geometry.conventions import FloatArray

BALLS = np.array([[3.0, 1.0, 1.5, 1.6], [-2.0, 3.5, -1.0, 1.2], [-1.5, -3.0, 2.0, 1.0],
                  [2.5, -2.5, -2.2, 0.8]])  # fmt: skip
"""x, y, z, radius in the object's frame [mm]."""
MU, VIEWS, ROWS, COLS, PIXEL, SOD, SDD, WHITE = (
    0.15,
    180,
    60,
    72,
    0.5,
    120.0,
    260.0,
    50_000.0,
)


def images(
    aside: float,
    start: float,
    sense: float = 1.0,
    roll: float = 0.0,
    moved: npt.ArrayLike = (0.0, 0.0),
) -> FloatArray:
    """Transmission (n, rows, cols) of a stage that turns clockwise, seen from the source.

    The axis stands `aside` to the left of the line from the source to the panel's middle, and
    its upper end leans by `roll` [rad] to the right. The panel is `moved` to the right and up
    [pixels], in each view (n, 2) or in all.

    Args:
        aside: see above [mm].
        start: angle of the stage in the first view [rad].
        sense: 1 for clockwise seen from above, -1 for the other way.
        roll, moved: see above.
    """
    out = np.empty((VIEWS, ROWS, COLS))
    x, z = (
        (np.arange(COLS) - (COLS - 1) / 2) * PIXEL,
        ((ROWS - 1) / 2 - np.arange(ROWS)) * PIXEL,
    )
    moved = np.broadcast_to(moved, (VIEWS, 2)) * PIXEL
    for view, (right, up) in enumerate(moved):
        ray = np.stack(np.broadcast_arrays(x + right, SDD, z[:, None] + up), axis=-1)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        a = -sense * (
            start + 2.0 * np.pi * view / VIEWS
        )  # anticlockwise is positive here
        places = BALLS[:, :3] @ [
            [np.cos(a), np.sin(a), 0],
            [-np.sin(a), np.cos(a), 0],
            [0, 0, 1],
        ]
        places = places @ [
            [np.cos(roll), 0, -np.sin(roll)],
            [0, 1, 0],
            [np.sin(roll), 0, np.cos(roll)],
        ]
        length = np.zeros((ROWS, COLS))
        for place, radius in zip(places + [-aside, SOD, 0.0], BALLS[:, 3], strict=True):
            near = place @ place - (ray @ place) ** 2
            length += 2.0 * np.sqrt(np.maximum(radius**2 - near, 0.0))
        out[view] = np.exp(-MU * length)
    return out


def found(volume: fx.Volume) -> FloatArray:
    """Mean within half the radius of each ball, of the attenuation that it has."""
    x, y, z = volume.centers()
    at = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1)
    means = []
    for *place, radius in BALLS.tolist():
        means.append(
            volume.data[np.linalg.norm(at - place, axis=-1) < 0.5 * radius].mean()
        )
    return np.array(means) / MU
