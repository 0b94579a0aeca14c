"""Records of small scans, made by hand: 24 x 30 pixels in the middle of the sensor."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from flexdt.twin.dataset.flexdt_json import (
    FrameBlock,
    NoiseRecord,
    SampleRecord,
    ScanRecord,
)
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.scanner.state import NamedCorrection

Image = npt.NDArray[np.uint16]
AT = {"ver_tube": 26.5, "ver_det": 21.0, "tra_tube": 1.25, "tra_det": 24.0, "tra_obj": 2.5,
      "mag_det": 1000.0, "mag_obj": 500.0, "rot_obj": -6.25}  # fmt: skip
ROI = Roi(942, 744, 1001, 791)  # 60 x 48 unbinned


def make_record(name: str = "scan", frames: int = 5, **changes: object) -> ScanRecord:
    machine = builtin_machine()
    camera = CameraSettings("HW2SW1High", ROI, 80.0, 2, frames)
    still = CameraSettings("HW2SW1High", ROI, 80.0, 10, 1)

    def block(
        kind: str, files: list[str], camera: CameraSettings, **moved: object
    ) -> FrameBlock:
        at = {**AT, **moved}
        n = len(files)
        positions = {a: np.broadcast_to(np.asarray(v, dtype=float), (n,)).copy()
                     for a, v in at.items()}  # fmt: skip
        times_s = np.arange(n) * 0.16
        return FrameBlock(kind, tuple(files), times_s, camera, positions, kind != "dark")  # type: ignore[arg-type]

    turns = np.arange(frames) * 360.0 / max(frames - 1, 1)
    values: dict[str, object] = {
        "name": name,
        "machine": machine,
        "profile": builtin_profile("cwi-2023-08-21"),
        "camera": camera,
        "kV": 80.0,
        "power_W": 40.0,
        "positions": AT,
        "speeds": dict.fromkeys(AT, 20.0),
        "accelerations": dict.fromkeys(AT, 22.5),
        "blocks": (
            block("dark", ["di000000.tif"], still, tra_obj=-100.0),
            block("flat", ["io000000.tif"], still, tra_obj=-100.0),
            block(
                "projection",
                [f"scan_{i:06d}.tif" for i in range(frames)],
                camera,
                rot_obj=turns,
            ),
            block("flat", ["io000001.tif"], still, tra_obj=-100.0),
        ),
        "smooth": True,
        "started": datetime(2026, 3, 14, 0, 5, 9),
        "duration_s": 147.4,
        "complete": True,
        "sample": SampleRecord("bricks", "Ada", diameter_mm=30.0),
        "noise": NoiseRecord(7, {"i0_counts": 12000.0}),
        "correction": NamedCorrection(
            "c1", "2026-03-13", Offsets.from_edge({"dO_x": 0.5})
        ),
        "flat_axis": "tra_obj",
        "version": "0.1",
    }
    return ScanRecord(**{**values, **changes})  # type: ignore[arg-type]


def make_images(record: ScanRecord) -> dict[str, Image]:
    """Dark 100, flats 1100 and 3100, projections 100 + 2000 exp(-k / 4) on a slope."""
    rows, cols = record.camera.shape
    slope = np.linspace(0, 50, rows * cols).reshape(rows, cols)
    out = {}
    for name in record.files:
        level = {"d": 100.0, "i": 1100.0 if name == "io000000.tif" else 3100.0}.get(
            name[0]
        )
        if level is None:
            level = 100.0 + 2000.0 * np.exp(-int(name[5:11]) / 4)
        out[name] = (level + slope).astype(np.uint16)
    return out


@pytest.fixture
def record() -> Callable[..., ScanRecord]:
    return make_record


@pytest.fixture
def images() -> Callable[[ScanRecord], dict[str, Image]]:
    return make_images


@pytest.fixture
def written(tmp_path: Path) -> Callable[..., Path]:
    """A finished data set on the disk."""

    def make(record: ScanRecord | None = None) -> Path:
        from flexdt.runtime.files.directory import open_data
        from flexdt.server.storage.dataset_writer import DatasetWriter

        chosen = record if record is not None else make_record()
        writer = DatasetWriter(open_data(tmp_path), chosen, script=b"a\tb\r\n\x00\xff")
        for name, image in make_images(chosen).items():
            writer.put(name, image)
        writer.finish()
        writer.close()
        return writer.folder

    return make


@pytest.fixture
def data() -> Path:
    return Path(__file__).parents[1] / "data" / "dataset"
