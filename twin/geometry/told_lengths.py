"""Told lengths: what motors, the panel's data sheet and the phantom's file say, as parameters.

A scan's millimeters have several witnesses: the ways of the stage and of the panel (a helix's
lead, placements, steps of the SOD), the pixel pitch, and the phantom's beads. None is exact.
Each is a parameter of the fit beside the seventeen offsets, 0 where the told length is right,
with a standard deviation before the scan, so that no witness overrules another.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NAMES, Offsets
from flexdt.twin.geometry.poses import Poses

AXES: Final = {"x": 0, "y": 2, "z": 1}
"""Unity's axes, as in the names of offsets -> axis of the world."""
TRAVEL: Final = tuple(f"travel_{axis}" for axis in AXES)
PANEL_TRAVEL: Final = tuple(f"panel_travel_{axis}" for axis in AXES)
PLACES: Final = tuple(f"place_{axis}" for axis in AXES)
PIXEL: Final = "pixel"
PHANTOM: Final = "phantom"
TOLD: Final = (*TRAVEL, *PANEL_TRAVEL, *PLACES, PIXEL, PHANTOM)
"""Told lengths, in the order of the kernels."""
PARAMETERS: Final = (*NAMES, *TOLD)
"""All parameters of a fit: offsets, and told lengths."""
TOLD_UNITS: Final[Mapping[str, str]] = {n: "mm" if n in PLACES else "1" for n in TOLD}
TOLD_MEANINGS: Final[Mapping[str, str]] = {
    "travel_x": "sideways way of the sample, over the told one",
    "travel_y": "rise of the sample (a helix's lead), over the told one",
    "travel_z": "way of the sample along the beam, over the told one",
    "panel_travel_x": "sideways way of the panel, over the told one",
    "panel_travel_y": "rise of the panel, over the told one",
    "panel_travel_z": "way of the panel along the beam, over the told one",
    "place_x": "sample of one scan, to the right of its told place",
    "place_y": "sample of one scan, above its told place",
    "place_z": "sample of one scan, behind its told place",
    "pixel": "pixel pitch, over the told one",
    "phantom": "size of the phantom, over the told one",
}
"""Meaning of each in words; ratios are less 1."""
TOLD_SOURCES: Final[Mapping[str, str]] = {
    "travel_x": "the sample's way aside (travel_x)",
    "travel_y": "the sample's rise (travel_y)",
    "travel_z": "the sample's way along the beam (travel_z)",
    "panel_travel_x": "the panel's way aside (panel_travel_x)",
    "panel_travel_y": "the panel's rise (panel_travel_y)",
    "panel_travel_z": "the panel's way along the beam (panel_travel_z)",
    "place_x": "the scans' places (place_x)",
    "place_y": "the scans' places (place_y)",
    "place_z": "the scans' places (place_z)",
    "pixel": "the pixel pitch (pixel)",
    "phantom": "the phantom's scale",
}
"""Each as what limits a sigma, in words."""
LEAST_WAY: Final = 1e-3
"""Way, as a part of the source-object distance, from which it is a told length: a thousandth of
a shorter one moves no shadow by more than a millionth of its distance."""


def offsets_in(row: FloatArray) -> Offsets:
    """Return the offsets in a row of values of `PARAMETERS`, internal units."""
    return Offsets(*row[: len(NAMES)])


def ways(poses: Poses) -> tuple[FloatArray, FloatArray]:
    """Compute the ways of axis and panel, from the source, about their means over the frames.

    Returns (n, 3) each [mm], world frame."""
    axis = poses.axis - poses.source
    panel = poses.detector - poses.source
    return axis - axis.mean(axis=0), panel - panel.mean(axis=0)


def told_by(
    poses: Poses, group: npt.NDArray[np.int64], per_group: Collection[str] = ()
) -> frozenset[str]:
    """Return the told lengths that a scan rests on: the pixel pitch and the phantom always,
    ways that are there, and the places of scans that stand apart.

    Args:
        poses: n frames.
        group: (n,) scan of each.
        per_group: parameters with a value in each scan: a place of its own needs no told one.
    """
    least = LEAST_WAY * float(np.abs(np.median(poses.sod)))
    axis, panel = ways(poses)
    out = {PIXEL, PHANTOM}
    for names, way in ((TRAVEL, axis), (PANEL_TRAVEL, panel)):
        for name, along in zip(names, AXES.values(), strict=True):
            if np.ptp(way[:, along]) > least:
                out.add(name)
    count = int(group.max(initial=0)) + 1
    if count > 1:
        centres = np.array([axis[group == g].mean(axis=0) for g in range(count)])
        if np.ptp(centres, axis=0).max() > least:  # No guide is quite straight.
            out |= {f"place_{a}" for a in AXES if f"dO_{a}" not in per_group}
    return frozenset(out)


def poses_at(poses: Poses, rows: FloatArray) -> Poses:
    """Return poses as they are where told lengths are off.

    Args:
        poses: nominal, n frames.
        rows: (n, parameters) values of `PARAMETERS` in each frame; offsets are not applied.
    """
    told = dict(zip(TOLD, rows[:, len(NAMES) :].T, strict=True))
    along = list(AXES.values())
    axis_way, panel_way = ways(poses)
    moved = np.zeros((2, len(poses), 3))
    moved[0][:, along] = np.stack([told[n] for n in PLACES], axis=1)
    moved[0][:, along] += np.stack([told[n] for n in TRAVEL], axis=1) * axis_way[:, along]
    moved[1][:, along] = (
        np.stack([told[n] for n in PANEL_TRAVEL], axis=1) * panel_way[:, along]
    )
    wide = 1.0 + told[PIXEL][:, None]
    return Poses(
        poses.source,
        poses.axis + moved[0],
        poses.detector + moved[1],
        poses.u * wide,
        poses.v * wide,
        poses.angle,
        poses.mount,
    )
