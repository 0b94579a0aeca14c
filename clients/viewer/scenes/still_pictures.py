"""Still pictures of a viewer's pages: computed one at a time, the newest kept."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from flexdt.clients.viewer.scenes.still import Shape, drawn, jpeg
from flexdt.clients.viewer.scenes.views import Fitted

LEAST_PX = 32
MOST_PX = 1200
MOST_BYTES: Final = 60_000
MAX_PICTURES: Final = 16


class Stills:
    """Pictures, each until the scene is another one."""

    def __init__(self) -> None:
        self._turn = asyncio.Lock()
        self._kept: OrderedDict[object, bytes] = OrderedDict()

    async def picture(
        self,
        camera: Fitted,
        asked: Mapping[str, str],
        stamp: tuple[object, ...],
        shapes: Callable[[], Sequence[Shape]],
    ) -> bytes:
        """Return a JPEG of at most MOST_BYTES, computed at its first use.

        At most MAX_PICTURES are kept, the oldest goes first; one is computed at a time.
        Sizes are limited to `LEAST_PX` to `MOST_PX`; missing ones are the least. If the
        lowest quality is larger than MOST_BYTES it is sent all the same.

        Args:
            camera: of the view.
            asked: `w` and `h` [px], and `dark` where it is "1": the page's query.
            stamp: key of the scene's state.
            shapes: makes the visible shapes, in a thread.
        """
        width, height = (_side(asked.get(name, "")) for name in ("w", "h"))
        dark = asked.get("dark") == "1"
        seen = camera.at(width / height)
        key = seen, width, height, dark, *stamp
        async with self._turn:
            if key not in self._kept:
                self._kept[key] = await asyncio.to_thread(
                    lambda: jpeg(drawn(shapes(), seen, (width, height), dark), MOST_BYTES)
                )
                while len(self._kept) > MAX_PICTURES:
                    self._kept.popitem(last=False)
            return self._kept[key]


def _side(text: str) -> int:
    """Read the pixels of a query's words."""
    return min(MOST_PX, max(LEAST_PX, int(text[:5]) if text.isdecimal() else 0))
