"""A data set of the LEGO phantom, as a twin writes it, without servers."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from flexdt.runtime.files.directory import open_data
from flexdt.server.imaging.projections import Imaging, TrueGeometry
from flexdt.server.imaging.radiography import Radiography
from flexdt.server.scans.acquisition import Acquisition
from flexdt.server.storage.dataset_writer import DatasetWriter
from flexdt.server.storage.stored_samples import SampleStore
from flexdt.testing.in_process import DirectProjector
from flexdt.twin.dataset.flexdt_json import NoiseRecord, SampleRecord, ScanRecord
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import Machine, builtin_machine, profile_of
from flexdt.twin.physics.predicted_beam import Physics
from flexdt.twin.projection import Volume
from flexdt.twin.scanner.state import Sample
from flexdt.twin.script import ScanPlan, parse_script, plan_script
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.scan_request import ScanRequest

Floats = npt.NDArray[np.float64]


def bead_scan(root: Path, truth: Mapping[str, float], frames: int) -> Path:
    """A turn of so many images (the last repeats the first), `truth` hidden; its folder."""
    request = ScanRequest("fly", frames=frames, averages=2, mode="HW4SW1High")
    return bead_scan_on(builtin_machine(), request, root, truth)[0]


def bead_scan_on(
    machine: Machine,
    request: ScanRequest,
    root: Path,
    truth: Mapping[str, float],
    physics: Physics = "ideal",
) -> tuple[Path, ScanPlan]:
    """Scan the LEGO phantom on any machine, `truth` hidden.

    Args:
        machine: with its own profile.
        request: the scan; its script has to be free of errors.
        root: where the data set, "lego", is written.
        truth: hidden offsets by name, as corrections give them [mm, deg].
        physics: of the images; their noise is always the same.

    Returns:
        The data set's folder, and the plan.
    """
    profile = profile_of(machine)
    script = compose_script(request, machine, profile).encode()
    plan = plan_script(parse_script(script), machine, profile)
    assert not plan.errors
    imaging = Imaging(
        DirectProjector(), TrueGeometry(Offsets.from_edge(truth)),
        SampleStore(open_data(root / "s")),
        machine.detector.pixels,
    )  # fmt: skip
    record = ScanRecord.from_plan(
        plan, name="lego", started=datetime(2026, 1, 2), sample=SampleRecord(name="lego"),
        noise=NoiseRecord(3, {}),
    )  # fmt: skip
    writer = DatasetWriter(open_data(root), record, script=script, sync=False)
    way = Radiography.of(imaging, machine, physics)
    acquisition = Acquisition(plan, way, Sample("lego"), 3, writer.put)
    for exposure in plan.exposures:
        asyncio.run(acquisition.produce([exposure]))
    writer.finish()
    return root / "lego", plan


def bead_in_volume(volume: Volume, bead: Floats, reach: int) -> tuple[Floats, float]:
    """Find a bead near where it belongs: its centre of gravity [mm], and its largest value.

    Args:
        volume: of cubic voxels.
        bead: where it belongs, (3,) [mm].
        reach: voxels to each side of that place that are looked at.
    """
    voxel_mm = volume.voxel_xyz[0]
    low = np.array(volume.center_mm) - (np.array(volume.shape[::-1]) - 1) / 2 * voxel_mm
    nearest = np.rint((bead - low) / voxel_mm).astype(int)
    x, y, z = (slice(a - reach, a + reach + 1) for a in nearest)
    part = np.asarray(volume.data[z, y, x], dtype=float)
    weight = np.clip(part - 0.4 * part.max(), 0.0, None)
    span = slice(-reach, reach + 1)
    at = np.array([(g * weight).sum() / weight.sum() for g in np.mgrid[span, span, span]])
    return low + voxel_mm * (nearest + at[::-1]), float(part.max())
