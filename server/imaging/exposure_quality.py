"""What is wrong with an image at first sight, and how good the images of a scan will be.

Too bright, too dark, cut off: all three are judged on the image without noise and as though X-rays
were on, so that users are warned before a scan. The forecast is made in a worker process with
limits.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms import Phantom
from flexdt.phantoms.exposure_forecast import expose
from flexdt.protocol import Codec
from flexdt.protocol.connection import encoded
from flexdt.protocol.methods.image_messages import PREDICTION_LIMITS, ExposurePrediction
from flexdt.protocol.state_model import ImageFlags
from flexdt.runtime.workers import Workers
from flexdt.server.imaging.radiography import Radiography
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine
from flexdt.twin.physics.chain import Radiograph
from flexdt.twin.physics.exposure import FEW_COUNTS, ExposureSettings

BEST: Final = 10
"""Settings that are proposed."""
EVERY = 3
"""Pixels are judged on a grid with this step, edges on all their pixels."""
SHADOW = 0.05
"""Line integral on an edge of the image from which the sample counts as cut off."""
SATURATED, STARVED, CUT_OFF = 1, 2, 4
"""What a pixel's mark is the sum of."""


def marks_of(
    radiography: Radiography,
    radiograph: Radiograph,
    camera: CameraSettings,
    exposure: ExposureSettings,
    binning: int = 1,
) -> npt.NDArray[np.uint8]:
    """The same for every pixel: sums of SATURATED, STARVED and CUT_OFF, uint8 (rows, cols).

    Args:
        radiography, radiograph, camera, exposure: as in `flags_of`.
        binning: pixels a side; what holds for any of them holds for their mean.
    """
    lines = radiograph.shown
    signal = radiography.signal(radiograph, camera, exposure)
    marks = np.where(signal >= radiography.full_scale - radiography.offset, SATURATED, 0)
    marks += np.where(signal < FEW_COUNTS, STARVED, 0)
    edge = np.ones(lines.shape, np.bool_)
    edge[1:-1, 1:-1] = False
    marks += np.where(edge & (lines > SHADOW), CUT_OFF, 0)
    rows, cols = (n // binning for n in lines.shape)
    # Surplus rows and columns are cut off, as `binned_mean` does: their marks go to the last kept.
    small = marks[: rows * binning, : cols * binning].astype(np.uint8)
    height, width = small.shape
    small[-1] |= np.bitwise_or.reduce(marks[height - 1 :, :width]).astype(np.uint8)
    small[:, -1] |= np.bitwise_or.reduce(marks[:height, width - 1 :], axis=1).astype(np.uint8)
    blocks = small.reshape(rows, binning, cols, binning)
    return np.asarray(np.bitwise_or.reduce(blocks, axis=(1, 3)), dtype=np.uint8)


def flags_of(
    radiography: Radiography,
    radiograph: Radiograph,
    camera: CameraSettings,
    exposure: ExposureSettings,
    time: float | None = None,
) -> ImageFlags:
    """Saturated and starved parts of an image, where they begin, and edges that cut the sample off.

    Args:
        radiography: how images are made.
        radiograph: the image.
        camera, exposure: its settings.
        time: of its pose [s].
    """
    lines = radiograph.shown
    signal = radiography.signal(radiograph, camera, exposure)[::EVERY, ::EVERY]
    top = radiography.full_scale - radiography.offset
    # The signal of an open beam, as a logarithm. Two digits: with more, poly would tell distances.
    beam = float(np.median(lines[::EVERY, ::EVERY] + np.log(np.maximum(signal, 1e-30))))
    edges = {"left": lines[:, 0], "right": lines[:, -1], "top": lines[0], "bottom": lines[-1]}
    return ImageFlags(
        time=time,
        saturated=float(np.mean(signal >= top)),
        starved=float(np.mean(signal < FEW_COUNTS)),
        truncated=[name for name, edge in edges.items() if float(edge.max()) > SHADOW],  # type: ignore[misc]
        good_counts=(radiography.offset + FEW_COUNTS, radiography.full_scale),
        good_lines=(round(beam - math.log(top), 2), round(beam - math.log(FEW_COUNTS), 2)),
    )


def predictors() -> Workers:
    """The process that predicts; to be closed in the end."""
    limits = PREDICTION_LIMITS
    return Workers(1, int(limits["memory_bytes"]), float(limits["seconds"]))


def predict(
    phantom: Phantom, machine: Machine, settings: dict[str, Any], codec: Codec
) -> list[bytes]:
    """In the worker: the answer to `exposure.predict`, encoded; `settings` are `expose`'s.

    Raises:
        RpcError: an argument that the machine does not allow.
    """
    told = asdict(expose(phantom, machine=machine, **settings))
    told["transmission"]["edges"] = told["transmission"]["edges"][:-1]  # no infinity in JSON
    told |= {"sample": phantom.name, "best": told["best"][:BEST], "frames": told.pop("images")}
    result = ExposurePrediction.model_validate(told, strict=False)
    return list(encoded(result, codec).pieces)
