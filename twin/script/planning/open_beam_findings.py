"""Warn of images of a plan whose open beam saturates or starves the panel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final, get_args

import numpy as np

from flexdt.twin.findings import Finding, Findings, Place, warning
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.predicted_beam import (
    OpenBeam,
    Physics,
    open_beam_doubt,
    open_beam_of,
)
from flexdt.twin.script.commands import ImageKind
from flexdt.twin.script.planning.plan import ScanPlan
from flexdt.twin.script.problems import ScriptCode

SAMPLED_IMAGES = 5
"""Images of one setting whose distances are examined."""
OPEN_BEAM_CODES: Final = (
    ScriptCode.SATURATED_OPEN_BEAM,
    ScriptCode.STARVED_OPEN_BEAM,
)
"""Codes of the warnings of `open_beam_problems`."""
Setting = tuple[ExposureSettings, CameraSettings]


def open_beam_problems(plan: ScanPlan, physics: Physics = "poly") -> Findings:
    """Warn of each setting of tube and camera whose open beam is saturated or starved.

    At the first line that uses it, with an exposure that would do. Settings whose beam is
    not predicted, or with X-rays off, get no warning.
    """
    problems: list[Finding] = []
    for (exposure, camera), (line, indices) in lit_settings(plan).items():
        beam = brightest_beam(plan, exposure, camera, indices, physics)
        if beam is None:
            continue
        doubt = open_beam_doubt(plan.machine, exposure, beam)
        if doubt is not None:
            code = OPEN_BEAM_CODES[0 if beam.saturated else 1]
            problems.append(warning(code, doubt, place=Place(line)))
    return Findings(problems)


def lit_settings(
    plan: ScanPlan, kinds: Sequence[ImageKind] = get_args(ImageKind)
) -> dict[Setting, tuple[int, list[int]]]:
    """List the settings of tube and camera of a plan's saved images with X-rays on.

    Frames and averages make no other setting. Images with an empty region are left out.

    Args:
        plan: with its groups of images.
        kinds: of the images that are listed; default: all.

    Returns (exposure, camera) -> the line that first uses it, and the indices of its images
    among all of the plan; in the order of first use.
    """
    settings: dict[Setting, tuple[int, list[int]]] = {}
    first = 0
    for group in plan.groups:
        saved = group.kind in kinds and group.files
        if saved and group.xrays_on and min(group.camera.shape) > 0:
            camera = replace(group.camera, frames=1, averages=1)
            exposure = ExposureSettings(group.kV, group.power_W, camera.exposure_ms)
            _, indices = settings.setdefault((exposure, camera), (group.line, []))
            indices.extend(range(first, first + len(group)))
        first += len(group)
    return settings


def brightest_beam(
    plan: ScanPlan,
    exposure: ExposureSettings,
    camera: CameraSettings,
    indices: list[int],
    physics: Physics,
) -> OpenBeam | None:
    """Predict the open beam of most counts among images of a setting, None if none is.

    `indices`: of the images; `SAMPLED_IMAGES` of them are tried.
    """
    beams = [
        beam
        for view in _views(plan, camera, indices)
        if (beam := open_beam_of(plan.machine, camera, exposure, view, physics))
        is not None
    ]
    return max(beams, key=lambda beam: beam.counts, default=None)


def _views(
    plan: ScanPlan, camera: CameraSettings, indices: list[int]
) -> Iterator[FloatArray]:
    """Yield cone_vec rows (12,) of at most `SAMPLED_IMAGES` images, evenly spread over
    `indices`.
    """
    chosen = np.unique(np.linspace(0, len(indices) - 1, SAMPLED_IMAGES).astype(int))
    index = [indices[i] for i in chosen]
    positions = {name: x[index] for name, x in plan.image_positions.items()}
    yield from motor_poses(plan.machine, plan.profile, camera, positions).cone_vec().rows
