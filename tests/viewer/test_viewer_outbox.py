"""What waits for a slow page, and in which order it goes."""

from __future__ import annotations

import asyncio
import itertools
import json
from collections import deque
from typing import Any, cast

from flexdt.clients.client.kept_connection import TwinAddress
from flexdt.clients.viewer.feed import ImageFeed
from flexdt.clients.viewer.page import ON_THE_WAY, Page


class Browser:
    """The other end of a page's connection: keeps what came, and answers when it is told to."""

    def __init__(self) -> None:
        self.came: list[str | bytes] = []
        self.says: asyncio.Queue[str] = asyncio.Queue()

    async def send(self, content: str | bytes) -> None:
        self.came.append(bytes(content) if not isinstance(content, str) else content)

    def __aiter__(self) -> Browser:
        return self

    async def __anext__(self) -> str:
        return await self.says.get()


async def settled() -> None:
    for _ in range(50):
        await asyncio.sleep(0)


def test_few_states_and_parts_of_images_are_on_their_way() -> None:
    """A browser that acknowledges now and then gets the newest state each time, and whole
    images, of which none is cut off by a newer one; answers wait for neither."""

    async def run() -> None:
        browser = Browser()
        page = Page("a" * 12, cast(Any, browser), TwinAddress("127.0.0.1", 1), {})
        serving = asyncio.create_task(page.run())
        images: deque[bytes] = deque()
        whole, got, unacknowledged = b"", [], dict.fromkeys(ON_THE_WAY, 0)
        for number in itertools.count():
            page.show("state", json.dumps({"type": "state", "n": number}))
            page.show("image", bytes([number % 251]) * 100_001)
            page.show("volume", json.dumps({"type": "volume", "n": number}))
            if number == 5:
                page.say("note", n=number)
            await settled()
            for content in browser.came:
                if isinstance(content, bytes):
                    unacknowledged["image"] += 1
                    whole += content[1:]
                    if content[0]:
                        images.append(whole)
                        whole = b""
                elif (told := json.loads(content))["type"] == "volume":
                    unacknowledged["volume"] += 1
                    assert number - told["n"] <= 1, "the newest slices are sent"
                elif told["type"] == "state":
                    unacknowledged["state"] += 1
                    got.append((told["n"], number))
                elif told["type"] == "note":
                    assert told["n"] == number
            browser.came.clear()
            assert all(unacknowledged[slot] <= most for slot, most in ON_THE_WAY.items())
            if number == 400:
                break
            for slot in ("image", "state", "volume") if number % 3 else ("image",):
                if unacknowledged[slot]:
                    unacknowledged[slot] -= 1
                    browser.says.put_nowait(
                        json.dumps({"took": slot}, separators=(",", ":"))
                    )
            if number % 7 == 0:
                await asyncio.sleep(
                    0.03
                )  # a slow acknowledgement makes parts small again
        assert all(shown - told <= 1 for told, shown in got), "the newest state is sent"
        assert len(got) > 200
        assert len(images) > 5
        assert all(len(i) == 100_001 and len(set(i)) == 1 for i in images)
        serving.cancel()

    asyncio.run(run())


def test_a_page_that_comes_as_the_last_one_leaves_gets_images() -> None:
    """The feed stops and starts before its connection has ended."""
    pixels = {"dtype": "uint16", "shape": [2, 2], "data": bytes(8)}
    data = {**pixels, "kind": "counts", "cone_vec": [0.0] * 12}
    event = {"topic": "projection", "seq": 7, "time": 0.0, "data": data}

    async def run() -> None:
        shown = asyncio.Queue[int]()
        loop = asyncio.get_running_loop()
        feed = ImageFeed(
            TwinAddress("127.0.0.1", 9), "counts",
            lambda image, coarse: loop.call_soon_threadsafe(shown.put_nowait, image.seq),
        )  # fmt: skip
        feed.start()
        await settled()
        ended = feed.stop()
        feed.start()
        await ended
        await settled()
        feed._arrived("projection", event)
        assert await shown.get() == 7
        await feed.stop()

    asyncio.run(run())
