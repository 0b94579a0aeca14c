"""Check a scan that no script describes, as `flexdt check` checks one that a script does."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms import Phantom
from flexdt.twin.findings import ERROR
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine, profile_of
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.predicted_beam import Physics, open_beam_doubt, open_beam_of
from flexdt.twin.plausibility import PlausibilityCode, settled
from flexdt.twin.plausibility.examination import Operation, examine
from flexdt.twin.scanner.state import TubeSettings, changed_tube
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.scan_request import ScanRequest

__all__ = ["check_distances", "check_placement", "check_tube", "open_beam_doubts"]

USELESS_PLACEMENTS: Final = (
    PlausibilityCode.SOURCE_IN_THE_SAMPLE,
    PlausibilityCode.PANEL_IN_THE_SAMPLE,
    PlausibilityCode.SAMPLE_NOT_SEEN,
)
"""Codes of placements whose images are useless."""


def check_tube(machine: Machine, exposure: ExposureSettings) -> None:
    """Check that the machine's tube has a voltage and power.

    Raises LimitError: names value and allowed ones.
    """
    tube = machine.tube
    changed_tube(tube, TubeSettings(tube.kV, tube.power_W), exposure.kV, exposure.power_W)


def check_distances(
    machine: Machine,
    camera: CameraSettings,
    exposure: ExposureSettings,
    sod_mm: float,
    sdd_mm: float,
) -> None:
    """Check that the machine has an exposure and distances, by composing a script.

    The camera's region is not checked. Zero offsets are the machine's.

    Raises:
        LimitError: names the value and the allowed ones.
    """
    request = ScanRequest(
        "step",
        sod_mm,
        sdd_mm,
        frames=2,
        exposure_ms=exposure.exposure_ms,
        averages=exposure.averages,
        mode=camera.mode,
        kV=exposure.kV,
        power_W=exposure.power_W,
    )
    compose_script(request, machine, profile_of(machine))


def check_placement(phantom: Phantom, cone_vec: ConeVec, shape: tuple[int, int]) -> None:
    """Check that source and panel are outside the sample, and that some ray meets it.

    Raises TwinError: the first such finding.
    """
    half = np.array(phantom.size_mm) / 2.0
    findings = examine(Operation.SIMULATE, cone_vec, shape, boxes=[[-half, half]])
    settled(replace(one, severity=ERROR) for one in findings.of(*USELESS_PLACEMENTS))


def open_beam_doubts(
    machine: Machine,
    camera: CameraSettings,
    exposure: ExposureSettings,
    view: npt.ArrayLike,
    physics: Physics = "poly",
) -> list[str]:
    """Warn if the open beam saturates or starves the panel.

    `view`: cone_vec row. Returns one sentence with an exposure that would do; [] if in
    range, or not known.
    """
    beam = open_beam_of(machine, camera, exposure, view, physics)
    doubt = None
    if beam is not None:
        doubt = open_beam_doubt(machine, exposure, beam)
    return [] if doubt is None else [doubt]
