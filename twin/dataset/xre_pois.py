"""The `[POIs]` of `data settings XRE.txt`: places in the scanner's world, as it prints them.

The scanner's world has x across, y along the beam and z up, with the origin at the focal spot's
foot: the same directions as here. A detector's entry is its top left corner with pixels per mm
along rows and columns. Hardware that the twin does not model has no entry.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from flexdt.twin.dataset.record import ScanRecord
from flexdt.twin.geometry.conventions import BEAM, RIGHT, UP, FloatArray, stage_rotation
from flexdt.twin.geometry.poses import Poses

_NOWHERE: Final = (0.0, 0.0, 0.0)


def points_of_interest(record: ScanRecord) -> Mapping[str, str]:
    """Name -> entry: axis, piercing point, image, sample, source at the settings file's moment."""
    pose = record.settings_pose()
    source, axis = pose.source[0], pose.axis[0]
    rows, cols = record.camera.shape
    corner, right, down = _panel(pose, rows, cols)
    at_source_height = np.array([axis[0], axis[1], source[2]])
    towards_source = np.cross(down, right) / float(right @ right)
    foot = np.array([source[0], pose.detector[0, 1], source[2]])
    stretch = float(pose.sdd[0] / pose.sod[0])
    projected = source + (at_source_height - source) * stretch
    object_x, object_y, _ = stage_rotation(float(pose.angle[0])).T
    return {
        "COT": _entry(at_source_height, object_x, -object_y, UP),
        "HCVC": _entry(foot, _NOWHERE, _NOWHERE, _NOWHERE),
        "image": _entry(corner, right, down, towards_source),
        "object": _entry(axis, object_x, object_y, UP),
        "projCOT": _entry(projected, _NOWHERE, _NOWHERE, _NOWHERE),
        "world": _entry(_NOWHERE, RIGHT, BEAM, UP),
        record.machine.tube.name: _entry(source, RIGHT, BEAM, UP),
    }


def _panel(pose: Poses, rows: int, cols: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Top left corner [mm] and directions of columns and rows [pixels per mm] of the image."""
    u, v = pose.u[0], pose.v[0]
    corner = pose.detector[0] - u * cols / 2.0 - v * rows / 2.0
    return corner, u / float(u @ u), v / float(v @ v)


def _entry(
    place: Sequence[float] | FloatArray,
    x: Sequence[float] | FloatArray,
    y: Sequence[float] | FloatArray,
    z: Sequence[float] | FloatArray,
) -> str:
    return (
        f"WC{_triple(place)}dirX{_triple(x)}dirY{_triple(y)}dirZ{_triple(z)}radius[0.000000]"
        "height[-1.000000]track[FALSE]safe range?[TRUE]minimal[-Inf;-Inf;-Inf]maximal[Inf;Inf;Inf]"
    )


def _triple(vector: Sequence[float] | FloatArray) -> str:
    return "[" + ";".join(_short(float(v)) for v in vector) + "]"


def _short(value: float) -> str:
    """Four decimals at most, without trailing zeros and minus zero."""
    text = f"{value:.4f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
