"""The ramp filter along detector rows, as sampled in space, with the usual windows.

Rows are padded to twice their length, so that the convolution does not wrap.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from flexdt.twin.errors import UnknownNameError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

Window = Callable[[FloatArray], FloatArray]

WINDOWS: Final[Mapping[str, Window]] = {
    "ram-lak": lambda f: np.ones_like(f),
    "shepp-logan": lambda f: np.sinc(f / 2.0),
    "cosine": lambda f: np.cos(np.pi / 2.0 * f),
    "hamming": lambda f: 0.54 + 0.46 * np.cos(np.pi * f),
    "hann": lambda f: 0.5 + 0.5 * np.cos(np.pi * f),
}
"""Name -> factor at a frequency given as part of the highest."""


def ramp(cols: int, pitch_mm: float, window: str = "ram-lak") -> Float32Array:
    """Frequency response for rows of `cols` pixels, (padded / 2 + 1,), times the pitch [1/mm].

    Raises:
        UnknownNameError: lists the windows.
    """
    from scipy import fft

    if window not in WINDOWS:
        raise UnknownNameError(
            f"unknown filter {window!r}; there are: {', '.join(WINDOWS)}",
            {"asked": window, "allowed": list(WINDOWS)},
        )
    length = fft.next_fast_len(2 * cols, real=True)
    n = np.minimum(np.arange(length), length - np.arange(length))
    kernel = np.zeros(length)
    odd = n % 2 == 1
    kernel[odd] = -1.0 / (np.pi * n[odd] * pitch_mm) ** 2
    kernel[0] = 0.25 / pitch_mm**2
    response = np.fft.rfft(kernel).real * pitch_mm
    shape = WINDOWS[window](np.linspace(0.0, 1.0, len(response)))
    return np.asarray(response * shape, dtype=np.float32)


def filtered(rows: Float32Array, response: Float32Array) -> Float32Array:
    """Rows (..., cols), zero beyond their ends, convolved with the filter of `response`."""
    from scipy import fft

    cols = rows.shape[-1]
    length = fft.next_fast_len(2 * cols, real=True)
    spectrum = fft.rfft(rows, length, axis=-1, workers=-1)
    spectrum *= response
    back: Float32Array = fft.irfft(spectrum, length, axis=-1, workers=-1)[..., :cols]
    return back
