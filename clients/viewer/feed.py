"""The image feed: radiographs from the twin to the panel in the scene and to the pages.

There is one feed for each kind of image; it subscribes only while a page shows that kind. During
motion pages get the mean over 2 x 2 pixels, and the full image at rest. Pixels are processed in a
thread, and only the newest image is kept.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from flexdt.clients.client.kept_connection import KeptConnection, TwinAddress
from flexdt.clients.viewer.radiographs import Radiograph
from flexdt.clients.viewer.watched_tasks import watched
from flexdt.protocol import image as wire_image
from flexdt.server.runtime.log import log

IMAGE_HZ: Final = 12.0
SETTLE_S: Final = 0.3
"""An image that nothing follows for so long is shown in full."""

Take = Callable[[Radiograph, bool], None]
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
        self.newest: Radiograph | None = None
        self._take, self._died = take, died
        self._raw: Mapping[str, object] | None = None
        self._due = asyncio.Event()
        self._link = KeptConnection(
            address,
            f"flexdt viewer ({kind})",
            self._arrived,
            subscription={
                "topics": ["projection"],
                "max_rate_hz": IMAGE_HZ,
                "projection_kind": kind,
            },
        )
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Listen from now on."""
        if not self._tasks:
            what = f"the feed of {self.kind} images"
            self._tasks = [watched(w, what, self._died) for w in (self._link.run(), self._work())]

    async def stop(self) -> None:
        """Listen no longer."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

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


def radiograph(params: Mapping[str, object]) -> Radiograph:
    """The image of a `projection` event.

    Raises:
        RpcError, KeyError, TypeError, ValueError: it is none.
    """
    data, seq, time = params["data"], params["seq"], params["time"]
    if not isinstance(data, Mapping):
        raise TypeError("an image is an object with pixels")
    pixels = np.asarray(wire_image.decode(data))
    if pixels.ndim != 2:
        raise ValueError("an image has rows and columns")
    cone = tuple(float(v) for v in data["cone_vec"])
    stamp = data.get("time")
    return Radiograph(
        pixels,
        str(data["kind"]),
        cone,
        float(time if stamp is None else stamp),  # type: ignore[arg-type]
        int(seq),  # type: ignore[call-overload]
    )
