"""Images that come from the twin to the pages.

There is one feed for each kind of image; it subscribes only while a page shows that kind.
During motion pages get the mean over 2 x 2 pixels, and the full image at rest. Pixels are
processed in a thread, and only the newest image is kept.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from typing import Any, Final

from flexdt.clients.client.events import Event, Projection
from flexdt.clients.client.kept_connection import KeptConnection, TwinAddress
from flexdt.clients.viewer.shown_images import ShownImage
from flexdt.clients.viewer.watched_tasks import watched
from flexdt.runtime.log import log

IMAGE_HZ: Final = 12.0
SETTLE_S: Final = 0.3
"""Time without a further image after which an image is shown in full [s]."""

Take = Callable[[ShownImage, bool], None]
"""Called in a worker thread with an image and whether to send it coarse."""


class ImageFeed:
    """The newest image of one kind.

    Args:
        address: of the twin.
        kind: line_integral or counts.
        take: called with each image.
        died: called when it cannot go on.
    """

    def __init__(
        self,
        address: TwinAddress,
        kind: str,
        take: Take,
        died: Callable[[], None] = lambda: None,
    ) -> None:
        """Prepare a feed; `start` subscribes.

        No image is there yet; `newest` is None.

        Args:
            address: of the twin.
            kind: of the images.
            take: called in a thread with each image, and whether it is to be shown coarse.
            died: called if a task fails.
        """
        self.kind = kind
        self.newest: ShownImage | None = None
        self._take = take
        self._died = died
        self._raw: Mapping[str, object] | None = None
        self._due = asyncio.Event()
        self._address = address
        self._link: KeptConnection | None = None
        self._twin = ""
        """The run of the twin that made `_raw`."""
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Subscribe to images of this kind, at most `IMAGE_HZ`, and start the tasks that
        take them; does nothing if they run.

        A failing task is logged and calls `died`.
        """
        if not self._tasks:
            wish = {
                "topics": ["projection"],
                "max_rate_hz": IMAGE_HZ,
                "projection_kind": self.kind,
            }
            name = f"flexdt viewer ({self.kind})"
            link = KeptConnection(self._address, name, self._arrived, subscription=wish)
            what = f"the feed of {self.kind} images"
            self._link = link
            self._tasks = [
                watched(w, what, self._died) for w in (link.run(), self._work())
            ]

    def stop(self) -> asyncio.Future[Any]:
        """Cancel the feed's tasks; the returned future is done once they have ended."""
        tasks = self._tasks
        self._tasks = []
        for task in tasks:
            task.cancel()
        return asyncio.gather(*tasks, return_exceptions=True)

    @property
    def running(self) -> bool:
        """Whether the feed is subscribed."""
        return bool(self._tasks)

    def again(self) -> None:
        """Show the newest image again, for a new page or in another window."""
        if self._raw is not None:
            self._due.set()

    def _arrived(self, topic: str, params: Mapping[str, object]) -> None:
        """Keep the newest image with the twin instance it is from ("" if unknown), and
        wake the task that takes it; other topics are ignored.

        An older image that has not been taken is dropped.
        """
        if topic == "projection":
            if self._link is None:
                hello = None
            else:
                hello = self._link.hello
            if hello is None:
                self._twin = ""
            else:
                self._twin = hello.instance or ""
            self._raw = params
            self._due.set()

    async def _work(self) -> None:
        """Take each new image coarse at once, and once more in full when no other follows
        within `SETTLE_S` seconds.

        Runs until canceled; an image that cannot be shown is logged, once until one can.
        `take` runs in a thread, one image at a time; images that come meanwhile are
        skipped but for the newest.
        """
        shown_coarse = False
        sound = True
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
                    self.newest = radiograph(self._raw, self._twin)
                if self.newest is not None:
                    await asyncio.to_thread(self._take, self.newest, coarse)
                sound = True
            except Exception:  # the next one may be better
                if sound:  # once, not for each of twelve a second
                    log(
                        "an image could not be shown",
                        logging.ERROR,
                        error=True,
                        kind=self.kind,
                    )
                sound = False


def radiograph(params: Mapping[str, object], twin: str = "") -> ShownImage:
    """Read the image of a `projection` event.

    The time is the event's where the image has none; flags and origin are None where
    unknown.

    Args:
        params: of the event, as decoded from the wire.
        twin: run of the twin that made it.

    Raises:
        RpcError: the event holds no image.
    """
    event = Event.from_wire(params)
    shot = event.data
    assert isinstance(shot, Projection)
    if shot.time is None:
        time = event.time
    else:
        time = shot.time
    if shot.flags is None:
        flags = None
    else:
        flags = shot.flags.model_dump()
    if shot.origin is None:
        origin = None
    else:
        origin = shot.origin.model_dump()
    return ShownImage(
        pixels=shot.image,
        kind=shot.kind,
        cone_vec=shot.cone_vec,
        time=time,
        seq=event.seq,
        flags=flags,
        origin=origin,
        twin=twin,
    )
