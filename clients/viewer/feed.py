"""The image feed: radiographs from the twin to the panel in the scene and to the pages.

There is one feed for each kind of image; it subscribes only while a page shows that kind. During
motion pages get the mean over 2 x 2 pixels, and the full image at rest. Pixels are processed in a
thread, and only the newest image is kept.

For the scene line integrals and counts become 8-bit grey by window and level. A page applies its
own window: it gets 16-bit integers with a scale, deflated, or, while things move, a JPEG.
"""

from __future__ import annotations

import asyncio
import json
import logging
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.clients.client.events import Event, Projection
from flexdt.clients.client.kept_connection import KeptConnection, TwinAddress
from flexdt.clients.viewer.page import watched
from flexdt.runtime.log import log
from flexdt.twin.geometry.conventions import Float32Array

MAGIC = b"FXI2"
AIR: Final = 0.05
"""Line integral below which a pixel counts as air."""
TOP = 65535
JPEG_QUALITY = 85
"""Of images in motion; 20 to 50 kB each."""
DEFLATE_LEVEL = 1


@dataclass(frozen=True, eq=False)
class ShownImage:
    """An image as it came from the twin.

    Attributes:
        pixels: (rows, cols), float32 line integrals or uint16 counts.
        kind: line_integral or counts.
        cone_vec: its geometry, twelve numbers.
        time: of the pose [s of the twin's clock].
        seq: the event's number.
        flags: what the twin says of it; None of a recorded one.
        virtual: to compare it with, of the same shape and kind; None for none.
    """

    pixels: npt.NDArray[np.generic]
    kind: str
    cone_vec: tuple[float, ...]
    time: float
    seq: int
    flags: object = None
    virtual: npt.NDArray[np.generic] | None = None


def window_of(image: ShownImage) -> tuple[float, float]:
    """A window [low, high] of all but the densest 2 % of what is not air: beads do not set it."""
    pixels = np.asarray(image.pixels[::4, ::4], dtype=np.float32)
    if pixels.size == 0:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(pixels, (0.2, 99.8)))
    if image.kind == "line_integral":
        low = min(low, 0.0)
        if (matter := pixels[pixels > AIR]).size:
            high = float(np.percentile(matter, 98.0))
    return (low, high) if high - low > 1e-6 else (low, low + 1.0)


def grey(image: ShownImage, window: tuple[float, float]) -> npt.NDArray[np.uint8]:
    """8-bit RGB (rows, cols, 3); line integrals are drawn as a film: matter bright on black."""
    return np.repeat(_byte(image.pixels, window)[:, :, None], 3, axis=2)


def _byte(pixels: npt.NDArray[np.generic], window: tuple[float, float]) -> npt.NDArray[np.uint8]:
    low, high = window
    scaled = (np.asarray(pixels, dtype=np.float32) - low) * (255.0 / (high - low))
    return np.asarray(np.nan_to_num(np.clip(scaled, 0.0, 255.0)), dtype=np.uint8)


def halved(pixels: npt.NDArray[np.generic]) -> Float32Array:
    """The mean over 2 x 2 pixels; an odd last row or column is cut off."""
    rows, cols = pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2
    p = np.asarray(pixels[:rows, :cols], dtype=np.float32)
    mean: Float32Array = 0.25 * (p[::2, ::2] + p[1::2, ::2] + p[::2, 1::2] + p[1::2, 1::2])
    return mean


def packed(
    image: ShownImage,
    *,
    coarse: bool,
    beads: Sequence[Sequence[float]],
    facts: Mapping[str, object],
) -> bytes:
    """An image for a page: magic, length of the header, header (JSON), pixels.

    Pixels are uint16 with a scale. Exact ones are the differences from column to column (mod 2^16),
    first the low bytes of all, then the high ones, deflated (zlib). Coarse ones are a grey JPEG of
    their high bytes. The rows of a virtual image follow those of an exact one.

    Args:
        image: what to send.
        coarse: send the mean over 2 x 2 pixels instead, as a JPEG.
        beads: predicted bead centres (column, row) in pixels of the full image.
        facts: more entries of the header.
    """
    full, pair = image.pixels.shape, image.virtual is not None
    if image.virtual is not None:
        image = replace(image, pixels=np.concatenate([image.pixels, image.virtual]))
    values = np.asarray(halved(image.pixels) if coarse else image.pixels, dtype=np.float32)
    low, scale = 0.0, 1.0
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


IMAGE_HZ: Final = 12.0
SETTLE_S: Final = 0.3
"""An image that no other follows within this time is shown in full."""

Take = Callable[[ShownImage, bool], None]
"""Called in a worker thread with an image and whether to send it coarse."""


class ImageFeed:
    """The newest image of one kind.

    Args:
        address: of the twin.
        kind: line_integral or counts.
        take: what to do with an image.
        died: called when it cannot go on.
    """

    def __init__(
        self, address: TwinAddress, kind: str, take: Take, died: Callable[[], None] = lambda: None
    ) -> None:
        self.kind = kind
        self.newest: ShownImage | None = None
        self._take, self._died = take, died
        self._raw: Mapping[str, object] | None = None
        self._due = asyncio.Event()
        self._address = address
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Listen from now on."""
        if not self._tasks:
            wish = {"topics": ["projection"], "max_rate_hz": IMAGE_HZ, "projection_kind": self.kind}
            name = f"flexdt viewer ({self.kind})"
            link = KeptConnection(self._address, name, self._arrived, subscription=wish)
            what = f"the feed of {self.kind} images"
            self._tasks = [watched(w, what, self._died) for w in (link.run(), self._work())]

    def stop(self) -> asyncio.Future[Any]:
        """Listen no longer, from now on; done once the connection has ended."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        return asyncio.gather(*tasks, return_exceptions=True)

    @property
    def running(self) -> bool:
        """Whether the feed is subscribed."""
        return bool(self._tasks)

    def again(self) -> None:
        """Show the newest image once more, for a new page or in another window."""
        if self._raw is not None:
            self._due.set()

    def _arrived(self, topic: str, params: Mapping[str, object]) -> None:
        if topic == "projection":
            self._raw = params
            self._due.set()

    async def _work(self) -> None:
        shown_coarse, sound = False, True
        while True:
            try:
                async with asyncio.timeout(SETTLE_S if shown_coarse else None):
                    await self._due.wait()
                coarse = True
            except TimeoutError:
                coarse = False
            shown_coarse = coarse
            try:
                if coarse:
                    self._due.clear()
                    if self._raw is None:
                        continue
                    self.newest = radiograph(self._raw)
                if self.newest is not None:
                    await asyncio.to_thread(self._take, self.newest, coarse)
                sound = True
            except Exception:  # the next one may be better
                if sound:  # once, not for each of twelve a second
                    log("an image could not be shown", logging.ERROR, error=True, kind=self.kind)
                sound = False


def radiograph(params: Mapping[str, object]) -> ShownImage:
    """The image of a `projection` event.

    Raises:
        RpcError: the event holds no image.
    """
    event = Event.from_wire(params)
    shot = event.data
    assert isinstance(shot, Projection)
    time = event.time if shot.time is None else shot.time
    flags = None if shot.flags is None else shot.flags.model_dump()
    return ShownImage(shot.image, shot.kind, shot.cone_vec, time, event.seq, flags)
