"""An image as a picture to look at: windowed to 8 bit and encoded as PNG.

It refuses to be exact: percentiles become black and white, what lies beyond is clipped.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

PERCENTILES: Final = (0.5, 99.5)
"""Grey values of a picture: these percentiles of the image become black and white."""


def windowed(image: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """8-bit view of an image: percentiles to black and white, clipped beyond."""
    low, high = np.percentile(image, PERCENTILES)
    if high <= low:
        return np.zeros(image.shape, dtype=np.uint8)
    scaled = (image.astype(np.float64) - low) * (255.0 / (high - low))
    return np.asarray(np.clip(np.rint(scaled), 0, 255), dtype=np.uint8)


def png(image: npt.NDArray[Any], *, dark_is_dense: bool = False) -> bytes:
    """The image windowed, as a PNG file's bytes; its negative where asked.

    Raises:
        ValueError: it has no pixels, or is no image.
    """
    import cv2

    if image.ndim != 2 or image.size == 0:
        raise ValueError(f"an image has rows and columns, got shape {image.shape}")
    shown = windowed(image)
    ok, encoded = cv2.imencode(".png", 255 - shown if dark_is_dense else shown)
    if not ok:
        raise ValueError(f"an image of shape {image.shape} could not be encoded as PNG")
    return bytes(encoded.tobytes())
