"""Images as the panel and the pages get them.

For the scene line integrals and counts become 8-bit gray by window and level. A page applies
its own window: it gets 16-bit integers with a scale, deflated, or, while things move, a JPEG.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.dataset.normalise import binned_mean

MAGIC: Final = b"FXI2"
AIR: Final = 0.05
"""Line integral below which a pixel counts as air."""
TOP: Final = 65535
JPEG_QUALITY: Final = 85
"""Quality of images in motion; 20 to 50 kB each."""
DEFLATE_LEVEL: Final = 1


@dataclass(frozen=True, eq=False)
class ShownImage:
    """An image as it came from the twin.

    Attributes:
        pixels: (rows, cols), float32 line integrals or uint16 counts.
        kind: line_integral or counts.
        cone_vec: its geometry, twelve numbers.
        time: of the pose [s of the twin's clock].
        seq: the event's number.
        flags: the twin's marks of it; None of a recorded one.
        virtual: to compare it with, of the same shape and kind; None for none.
        origin: how the twin made it (`ImageOrigin` of the wire); None of a recorded one.
        twin: run of the twin that made it; "" where that is not known.
    """

    pixels: npt.NDArray[np.generic]
    kind: str
    cone_vec: tuple[float, ...]
    time: float
    seq: int
    flags: object = None
    virtual: npt.NDArray[np.generic] | None = None
    origin: Mapping[str, object] | None = None
    twin: str = ""


def window_of(image: ShownImage) -> tuple[float, float]:
    """Choose the values (low, high) of black and white, so that beads do not set them.

    Of line integrals low is 0 at most and high the 98th percentile of matter (above
    `AIR`); other images use the percentiles 0.2 and 99.8. high is low + 1 where all are
    equal; (0, 1) without pixels.
    """
    pixels = np.asarray(image.pixels[::4, ::4], dtype=np.float32)
    if pixels.size == 0:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(pixels, (0.2, 99.8)))
    if image.kind == "line_integral":
        low = min(low, 0.0)
        if (matter := pixels[pixels > AIR]).size:
            high = float(np.percentile(matter, 98.0))
    if high - low > 1e-6:
        return (low, high)
    return (low, low + 1.0)


def grey(image: ShownImage, window: tuple[float, float]) -> npt.NDArray[np.uint8]:
    """Convert to 8-bit RGB (rows, cols, 3); line integrals as a film: matter bright on
    black. Values beyond the window are cut; NaN is black. `image`: that is drawn;
    `window`: values of black and white, not equal.
    """
    low, high = window
    scaled = (np.asarray(image.pixels, dtype=np.float32) - low) * (255.0 / (high - low))
    byte = np.nan_to_num(np.clip(scaled, 0.0, 255.0)).astype(np.uint8)
    return np.repeat(byte[:, :, None], 3, axis=2)


def packed(
    image: ShownImage,
    *,
    coarse: bool,
    beads: Sequence[Sequence[float]],
    facts: Mapping[str, object],
) -> bytes:
    """Encode an image for a page: magic, length of the header, header (JSON), pixels.

    Pixels are uint16 with a scale. Exact ones are the differences from column to column
    (mod 2^16), first the low bytes of all, then the high ones, deflated (zlib). Coarse
    ones are a gray JPEG of their high bytes. The rows of a virtual image follow those of
    an exact one. Line integrals and coarse images are scaled between their least and
    greatest values; exact counts keep scale 1. The window is chosen from the image, with
    its virtual one below.

    Args:
        image: to send.
        coarse: send the mean over 2 x 2 pixels instead, as a JPEG.
        beads: predicted bead centers (column, row) in pixels of the full image.
        facts: more entries of the header.
    """
    full = image.pixels.shape
    pair = image.virtual is not None
    if image.virtual is not None:
        image = replace(image, pixels=np.concatenate([image.pixels, image.virtual]))
    values = np.asarray(
        binned_mean(image.pixels, 2) if coarse else image.pixels, dtype=np.float32
    )
    low = 0.0
    scale = 1.0
    if image.kind == "line_integral" or coarse:
        low = float(values.min(initial=0.0))
        scale = max(float(values.max(initial=0.0)) - low, 1e-6) / TOP
    raw = np.rint((values - low) / scale).astype("<u2")
    header = {
        "kind": image.kind,
        "code": "jpeg" if coarse else "deflate",
        "shape": [raw.shape[0] // (1 + pair), raw.shape[1]],
        "pair": pair,
        "full": list(full),
        "low": low,
        "scale": scale,
        "time": image.time,
        "cone_vec": list(image.cone_vec),
        "seq": image.seq,
        "flags": image.flags,
        "origin": image.origin,
        "twin": image.twin,
        "window": list(window_of(image)),
        "beads": [[round(float(c), 3), round(float(r), 3)] for c, r in beads],
        **facts,
    }
    text = json.dumps(header).encode()
    body = _jpeg(raw) if coarse else _deflated(raw)
    return b"".join((MAGIC, struct.pack("<I", len(text)), text, body))


def _jpeg(raw: npt.NDArray[np.uint16]) -> bytes:
    """Encode a gray image (rows, cols) as JPEG.

    Sixteen bits are reduced to eight. The quality is `JPEG_QUALITY`.

    Raises ValueError: OpenCV cannot encode it.
    """
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
