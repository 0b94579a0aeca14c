"""What comes to the pages beside states: images from the twin, and volumes of `live_volume`.

There is one feed for each kind of image; it subscribes only while a page shows that kind. During
motion pages get the mean over 2 x 2 pixels, and the full image at rest. Pixels are processed in a
thread, and only the newest image is kept.

For the scene line integrals and counts become 8-bit grey by window and level. A page applies its
own window: it gets 16-bit integers with a scale, deflated, or, while things move, a JPEG.

The process of `live_volume` is one at a time; pages ask it for what they draw.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import struct
import sys
import zlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.clients.client.events import Event, Projection
from flexdt.clients.client.kept_connection import KeptConnection, TwinAddress
from flexdt.clients.viewer.watched_tasks import watched
from flexdt.runtime.log import log
from flexdt.runtime.workers import ENVIRONMENT
from flexdt.twin.dataset.normalise import binned_mean

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
    values = np.asarray(binned_mean(image.pixels, 2) if coarse else image.pixels, dtype=np.float32)
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


PROGRAM: Final = "flexdt.clients.viewer.live_volume"
LINE_BYTES: Final = 4 << 20
SINGLE: Final = {name: ones for name, ones in ENVIRONMENT.items() if not name.startswith("NUMBA")}
"""The process itself says how many threads its kernels have."""
Answer = tuple[dict[str, Any], bytes]
Wish = tuple[str, ...]
"""What the process reads first."""


def wish(folder: Path, side: int, past: bool) -> Wish:
    """The volume of a data set, with so many voxels a side; the whole one of a past scan."""
    return str(folder.absolute()), str(side), *(["past"] if past else [])


class LiveReconstruction:
    """The one process of a viewer, for the data set that was asked for last.

    Args:
        tell: gets its lines.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell, self.newest = tell, ""
        self._asked: Wish = ()
        self._task: asyncio.Task[None] | None = None
        self._ending: asyncio.Task[None] | None = None
        self._spare: asyncio.Task[asyncio.subprocess.Process] | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._wanted: deque[asyncio.Future[Answer]] = deque()

    def warm(self) -> None:
        """Have a process ready that has loaded what it needs: that takes longer than a slice."""
        if self._spare is None and self._task is None:
            self._spare = asyncio.create_task(_started())

    def grow(self, folder: Path, side: int, past: bool = False) -> None:
        """Grow the volume of a data set, unless that is being done; the last line comes again."""
        asked = wish(folder, side, past)
        if asked == self._asked:
            if self.newest:
                self._tell(self.newest)
            return
        self.stop()
        self._asked = asked
        self._task = watched(self._follow(*asked), "a live reconstruction")

    def stop(self) -> None:
        """End what is under way."""
        if self._task is not None:
            self._task.cancel()
            self._ending = self._task
        self._task, self._asked, self.newest = None, (), ""
        self._hang_up()

    async def close(self) -> None:
        """End all there is."""
        self.stop()
        if self._ending is not None:
            await asyncio.wait([self._ending])
        if self._spare is not None:
            process = await self._spare
            process.kill()
            await process.wait()

    def _hang_up(self) -> None:
        """Nobody answers any more who has been asked for a slice."""
        self._writer = None
        while self._wanted:
            self._wanted.popleft().cancel()

    async def ask(self, asked: Wish, *words: str) -> Answer | None:
        """What the process answers, and bytes behind it; None while there is none, or once it
        has another volume than the one `asked` for."""
        if self._writer is None or asked != self._asked:
            return None
        wanted: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._wanted.append(wanted)
        self._writer.write("\t".join(words).encode() + b"\n")
        with suppress(asyncio.CancelledError):  # somebody has asked for another volume
            return await wanted
        return None

    async def _follow(self, *asked: str) -> None:
        spare, self._spare = self._spare, None
        process = await (spare or _started())
        assert process.stdout is not None
        assert process.stdin is not None
        self._writer = process.stdin
        self._writer.write("\t".join(asked).encode() + b"\n")
        try:
            async for line in process.stdout:
                kind, _, content = line.decode().partition("\t")
                if kind == "answer":
                    size, _, told = content.partition("\t")
                    answer = json.loads(told), await process.stdout.readexactly(int(size))
                    if not (wanted := self._wanted.popleft()).done():
                        wanted.set_result(answer)
                else:
                    self.newest = line.decode()
                    self._tell(self.newest)
            self._hang_up()
            await process.wait()  # to kill what has just ended would take its code from the loop
        finally:
            if process.returncode is None:
                process.kill()
            await process.wait()


async def _started() -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, "-P", "-m", PROGRAM,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL, env={**os.environ, **SINGLE}, limit=LINE_BYTES,
    )  # fmt: skip
