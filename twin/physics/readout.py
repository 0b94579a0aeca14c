"""The panel's read-out: expected electrons to the counts that are saved.

Adds lag, noise, blur, fixed pattern and conversion. Random numbers are an argument.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.physics.blur import blurred
from flexdt.twin.physics.detector import Detector, pattern
from flexdt.twin.physics.exposure import Counts, ExposureSettings
from flexdt.twin.physics.panel_noise import Exposed, drawn

Signal = TypeVar("Signal", float, Float32Array)


@dataclass(frozen=True, eq=False)
class Expected:
    """Average content of one read-out: electrons and their variance, float32 (rows, cols)."""

    mean_e: Float32Array
    variance_e: Float32Array


def expected_counts(panel: Detector, camera: CameraSettings, electrons: Signal) -> Signal:
    """Convert electrons of one read-out to counts above dark, not clipped.

    Args:
        panel: the detector.
        camera: its mode decides the electrons in each count.
        electrons: a number, or float32 of any shape.
    """
    counts: Signal = electrons / float(panel.gain(camera))
    return counts


def saturating_counts(panel: Detector) -> float:
    """Return the counts above dark from which a pixel is saturated."""
    return panel.full_scale - panel.offset_counts


def read_out(
    panel: Detector,
    expected: Expected,
    camera: CameraSettings,
    exposure: ExposureSettings,
    rng: np.random.Generator | None = None,
    before: Sequence[tuple[Float32Array, float]] = (),
    trapped: Float32Array | None = None,
) -> Counts:
    """Read an image out: add lag, noise, blur, fixed pattern, dark charge, and clip to
    counts from 0 to full scale; dead pixels are 0.

    Args:
        panel: the detector.
        expected: from `expected_signal`.
        camera: mode and region of interest.
        exposure: time and averages.
        rng: generator of this frame's noise; None for the expectation.
        before: noise-free electrons of earlier frames, each with the time [s] from its
            end to this frame's start: the charge that they leave behind is added.
        trapped: electrons in traps at the frame's start, from `trapped_after`; None
            without long lag. The charge that they release meanwhile is added, the charge
            that they take is lost.

    Returns:
        uint16 (rows, cols).

    Raises:
        LimitError: the signal has not the camera's shape, as one of another panel has
            not.
    """
    shape = (int(expected.mean_e.shape[0]), int(expected.mean_e.shape[1]))
    if shape != camera.shape:
        message = "signal and camera of different panels or modes: pixels (rows, columns)"
        raise LimitError.of_shape(message, shape, camera.shape)
    charge = expected.mean_e.copy()
    for earlier, gap_s in before:
        left = panel.lag_fraction * np.exp(-max(gap_s, 0.0) / panel.lag_s)
        charge += np.float32(left) * earlier
    averages = exposure.averages
    if trapped is not None:
        given = -np.expm1(-exposure.duration_s / panel.long_lag_s) / averages
        charge += np.float32(given) * trapped
        charge -= np.float32(panel.long_lag_fraction) * expected.mean_e
    blur = panel.blur_px(camera)
    exposed = Exposed(charge, expected.variance_e, averages, panel, camera)
    if rng is None:
        spread = []
    else:
        spread = list(drawn(exposed, rng, spreads=True))
    charge = blurred(charge, *blur)
    for noise in spread:
        charge = charge + noise
    fixed = pattern(panel, camera.binning, camera.roi.edges)
    charge = charge * fixed.gain
    charge += np.float32(panel.dark_charge(camera) * exposure.exposure_ms / 1000.0)
    if rng is not None:
        for noise in drawn(exposed, rng, spreads=False):
            charge += noise
    counts = charge * np.float32(1.0 / panel.gain(camera))
    counts += fixed.offset + np.float32(panel.offset_counts)
    np.rint(counts, out=counts)
    np.clip(counts, 0.0, panel.full_scale, out=counts)
    counts[fixed.dead] = 0.0
    return counts.astype(np.uint16)


def trapped_after(
    panel: Detector,
    trapped: Float32Array,
    expected: Expected | None,
    exposure: ExposureSettings,
    gap_s: float,
) -> Float32Array:
    """Compute the electrons in traps when the next frame starts, (rows, cols).

    Earlier ones decay, and the frame adds the panel's long-lag part of its charge
    (`expected`; None: dark). `gap_s`: between the two frames.
    """
    left = trapped * np.float32(np.exp(-(exposure.duration_s + gap_s) / panel.long_lag_s))
    if expected is not None:
        taken = (
            panel.long_lag_fraction
            * exposure.averages
            * np.exp(-gap_s / panel.long_lag_s)
        )
        left += np.float32(taken) * expected.mean_e
    return left
