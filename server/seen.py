"""What is wrong with an image at first sight: too bright, too dark, cut off.

All three are judged on the image without noise and as though X-rays were on, so that watchers are
warned before a scan. It refuses to judge sharpness and geometry.
"""

from __future__ import annotations

import numpy as np

from flexdt.protocol.state import ImageFlags
from flexdt.server.radiography import Radiograph, Radiography
from flexdt.twin.camera import CameraSettings
from flexdt.twin.exposure import ExposureSettings

EVERY = 3
"""Pixels are judged on a grid with this step, edges on all their pixels."""
FEW_COUNTS = 10.0
"""Signal above dark below which a pixel counts as starved: its logarithm is mostly noise."""
SHADOW = 0.05
"""Line integral on an edge of the image from which the sample counts as cut off."""


def flags_of(
    radiography: Radiography,
    radiograph: Radiograph,
    camera: CameraSettings,
    exposure: ExposureSettings,
    time: float | None = None,
) -> ImageFlags:
    """Saturated and starved parts of an image, and the edges at which the sample is cut off.

    Args:
        radiography: how images are made.
        radiograph: the image.
        camera, exposure: its settings.
        time: of its pose [s].
    """
    lines = radiograph.shown
    signal = radiography.signal(radiograph, camera, exposure)[::EVERY, ::EVERY]
    top = radiography.full_scale - radiography.offset
    edges = {
        "left": lines[:, 0],
        "right": lines[:, -1],
        "top": lines[0],
        "bottom": lines[-1],
    }
    return ImageFlags(
        time=time,
        saturated=float(np.mean(signal >= top)),
        starved=float(np.mean(signal < FEW_COUNTS)),
        truncated=[name for name, edge in edges.items() if float(edge.max()) > SHADOW],  # type: ignore[misc]
    )
