"""Radiographs as pictures: for the panel in the scene, and for the pages.

Line integrals and counts become 8-bit grey by window and level for the scene. A page applies its
own window: it gets 16-bit integers with a scale, deflated, or, while things move, a JPEG.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array

MAGIC = b"FXI2"
TOP = 65535
JPEG_QUALITY = 85
"""Of images in motion; 20 to 50 kB each."""
DEFLATE_LEVEL = 1


@dataclass(frozen=True, eq=False)
class Radiograph:
    """An image as it came from the twin.

    Attributes:
        pixels: (rows, cols), float32 line integrals or uint16 counts.
        kind: line_integral or counts.
        cone_vec: its geometry, twelve numbers.
        time: of the pose [s of the twin's clock].
        seq: the event's number.
    """

    pixels: npt.NDArray[np.generic]
    kind: str
    cone_vec: tuple[float, ...]
    time: float
    seq: int


def window_of(image: Radiograph) -> tuple[float, float]:
    """A window [low, high] in which everything of the image can be seen."""
    pixels = np.asarray(image.pixels[::4, ::4], dtype=np.float32)
    if pixels.size == 0:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(pixels, (0.2, 99.8)))
    if image.kind == "line_integral":
        low = min(low, 0.0)
    return (low, high) if high - low > 1e-6 else (low, low + 1.0)


def grey(image: Radiograph, window: tuple[float, float]) -> npt.NDArray[np.uint8]:
    """8-bit RGB (rows, cols, 3); line integrals are drawn as a film: matter bright on black."""
    low, high = window
    scaled = (np.asarray(image.pixels, dtype=np.float32) - low) * (255.0 / (high - low))
    byte = np.clip(scaled, 0.0, 255.0).astype(np.uint8)
    return np.repeat(byte[:, :, None], 3, axis=2)


def halved(pixels: npt.NDArray[np.generic]) -> Float32Array:
    """The mean over 2 x 2 pixels; an odd last row or column is cut off."""
    rows, cols = pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2
    p = np.asarray(pixels[:rows, :cols], dtype=np.float32)
    mean: Float32Array = 0.25 * (p[::2, ::2] + p[1::2, ::2] + p[::2, 1::2] + p[1::2, 1::2])
    return mean


def packed(
    image: Radiograph,
    *,
    coarse: bool,
    beads: Sequence[Sequence[float]],
    facts: Mapping[str, object],
) -> bytes:
    """An image for a page: magic, length of the header, header (JSON), pixels.

    Pixels are uint16 with a scale. Exact ones are the differences from column to column (mod 2^16),
    first the low bytes of all, then the high ones, deflated (zlib). Coarse ones are a grey JPEG of
    their high bytes.

    Args:
        image: what to send.
        coarse: send the mean over 2 x 2 pixels instead, as a JPEG.
        beads: predicted bead centres (column, row) in pixels of the full image.
        facts: more entries of the header.
    """
    values = np.asarray(halved(image.pixels) if coarse else image.pixels, dtype=np.float32)
    low, scale = 0.0, 1.0
    if image.kind == "line_integral" or coarse:
        low = float(values.min(initial=0.0))
        scale = max(float(values.max(initial=0.0)) - low, 1e-6) / TOP
    raw = np.rint((values - low) / scale).astype("<u2")
    header = {
        "kind": image.kind,
        "code": "jpeg" if coarse else "deflate",
        "shape": list(raw.shape),
        "full": list(image.pixels.shape),
        "low": low,
        "scale": scale,
        "time": image.time,
        "cone_vec": list(image.cone_vec),
        "seq": image.seq,
        "window": list(window_of(image)),
        "beads": [[round(float(c), 3), round(float(r), 3)] for c, r in beads],
        **facts,
    }
    text = json.dumps(header).encode()
    body = _jpeg(raw) if coarse else _deflated(raw)
    return b"".join((MAGIC, struct.pack("<I", len(text)), text, body))


def _jpeg(raw: npt.NDArray[np.uint16]) -> bytes:
    import cv2

    grey8 = np.rint(raw / 257.0).astype(np.uint8)
    done, content = cv2.imencode(".jpg", grey8, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"no JPEG of an image of {raw.shape}")
    return content.tobytes()


def _deflated(raw: npt.NDArray[np.uint16]) -> bytes:
    steps = np.diff(raw, axis=1, prepend=np.zeros((len(raw), 1), raw.dtype))
    planes = steps.view(np.uint8).reshape(-1, 2).T
    return zlib.compress(planes.tobytes(), DEFLATE_LEVEL)
