"""Samples whose contents a test changes, and images of them through a real projector."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from flexdt.phantoms import Phantom, voxel_phantom
from flexdt.server.imaging.projections import Imaging, TrueGeometry
from flexdt.twin.machine.camera import Roi
from flexdt.twin.machine.description import builtin_machine, profile_of
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import Sample

M = builtin_machine()
SCANNER = ScannerTwin(M, profile_of(M))
CAMERA = replace(SCANNER.camera, roi=Roi(900, 700, 1027, 795))
POSES = SCANNER.poses_at(SCANNER.positions(0.0), CAMERA)


def block(value: float, size: int = 8) -> Phantom:
    """A cube of one attenuation [1/mm], wider than the image."""
    return voxel_phantom(
        np.full((size,) * 3, value, np.float32), 24.0 / size, name="thing"
    )


class Shelf:
    """Samples whose contents a test changes."""

    def __init__(self, **contents: Phantom) -> None:
        self.contents = contents

    def load(self, name: str, material: str | None = None) -> Phantom:
        return self.contents[name]


def imaging_of(projector: Any, shelf: Shelf) -> Imaging:
    return Imaging(projector, TrueGeometry(), shelf, M.detector.pixels)  # type: ignore[arg-type]


async def brightest(imaging: Imaging, name: str = "thing") -> float:
    images = await imaging.line_integrals(Sample(name), POSES, CAMERA)
    return float(images.max())
