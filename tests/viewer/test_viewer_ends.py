"""The viewer ends whenever it is asked to."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import pytest

from flexdt.clients.viewer.viewer import Viewer


@pytest.mark.parametrize("steps", range(6))
def test_drawing_ends_though_somebody_begins_to_look_at_that_moment(steps: int) -> None:
    """Its pause ended by itself then, and the cancellation was taken for that: the viewer
    waited for its drawing for ever."""

    async def ended() -> bool:
        viewer: Any = SimpleNamespace(
            _due=asyncio.Event(), _looked=asyncio.Event(), _raw=None, pages={}
        )
        viewer._due.set()
        drawing = asyncio.ensure_future(Viewer._draw(cast("Viewer", viewer)))
        for _ in range(8):
            await asyncio.sleep(0)
        viewer._looked.set()
        for _ in range(steps):
            await asyncio.sleep(0)
        drawing.cancel()
        done, _ = await asyncio.wait([drawing], timeout=5.0)
        return bool(done)

    assert asyncio.run(asyncio.wait_for(ended(), 30))
