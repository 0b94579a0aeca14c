"""The ramp filter of filtered backprojection, as sampled in space, with the usual windows.

Rows are padded so far that the convolution does not wrap.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from flexdt.twin.algorithms import PLAIN, WINDOWS
from flexdt.twin.errors import UnknownNameError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

MAX_KEPT_RESPONSES: Final = 8
"""Number of responses of the filter that are remembered."""


def ramp(reach: int, pitch_mm: float, window: str = PLAIN) -> Float32Array:
    """Compute the windowed ramp's frequency response, nearly |f|: (length / 2 + 1,) [1/mm].

    `reach`: columns that act on each other; `pitch_mm`: between columns; `window`: of
    `WINDOWS`. Raises UnknownNameError: lists them.
    """
    if window not in WINDOWS:
        raise UnknownNameError.among(
            f"unknown filter {window!r}; there are", window, WINDOWS
        )
    response = _unit_ramp(_even_length(2 * reach), window)
    return np.asarray(response / pitch_mm, dtype=np.float32)


@lru_cache(MAX_KEPT_RESPONSES)
def _unit_ramp(length: int, window: str) -> FloatArray:
    """Compute the response for a pitch of 1, (length / 2 + 1,); many scans share it.

    Args:
        length: of a padded row [columns], even.
        window: of `WINDOWS`.
    """
    n = np.minimum(np.arange(length), length - np.arange(length))
    kernel = np.zeros(length)
    odd = n % 2 == 1
    kernel[odd] = -1.0 / (np.pi * n[odd]) ** 2
    kernel[0] = 0.25
    response = np.fft.rfft(kernel).real
    shape = WINDOWS[window](np.linspace(0.0, 1.0, len(response)))
    return np.asarray(response * shape)


def _even_length(least: int) -> int:
    """Find an even length, `least` or more, whose real Fourier transform is fast: the
    first even one of SciPy's fast lengths.
    """
    from scipy import fft

    length = int(fft.next_fast_len(least, real=True))
    while length % 2:
        length = int(fft.next_fast_len(length + 1, real=True))
    return length


def padded_length(response: Float32Array) -> int:
    """Compute the columns of a padded row from the filter's response."""
    return 2 * (len(response) - 1)


def filtered(rows: Float32Array, response: Float32Array) -> Float32Array:
    """Convolve rows, zero beyond their ends, with the filter of `response`, on all cores.

    Columns are right within the reach that `ramp` was given; further ones wrap around.

    `rows`: (..., cols), not changed; `response`: of `ramp`.
    Returns (..., cols), at most the padded length.
    """
    from scipy import fft

    from flexdt.twin.reconstruction.kernels import fdk_kernels

    cols = rows.shape[-1]
    length = padded_length(response)
    spectrum = fft.rfft(rows, length, axis=-1, workers=-1)
    fdk_kernels.respond(spectrum.view(np.float32).reshape(-1, len(response), 2), response)
    back: Float32Array = fft.irfft(spectrum, length, axis=-1, workers=-1)[..., :cols]
    return back


def taps(response: Float32Array, wide: int, more: int) -> FloatArray:
    """Compute the filter in space by distances of columns, then zeros, (wide + more,).

    It is 0 beyond the padded length.
    """
    values = np.fft.irfft(response.astype(np.float64), padded_length(response))[:wide]
    return np.pad(values, (0, wide - len(values) + more))


def shortened(response: Float32Array, reach: int) -> Float32Array:
    """Compute the response of the same filter for a smaller reach; see `ramp`."""
    return response_of_length(response, _even_length(2 * reach)).astype(np.float32)


def response_of_length(response: Float32Array, length: int) -> FloatArray:
    """Compute the same filter's response on rows of another even length, (length / 2 +
    1,).
    """
    half = taps(response, length // 2 + 1, 0)
    return np.asarray(np.fft.rfft(np.concatenate([half, half[-2:0:-1]])).real)
