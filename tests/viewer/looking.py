"""Pictures of what a browser shows, and what can be said of them."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

Picture = npt.NDArray[np.float32]


def picture(target: Any) -> Picture:
    raw = target.screenshot(timeout=180_000)
    return np.asarray(Image.open(io.BytesIO(raw)).convert("RGB"), dtype=np.float32)


def point_at(page: Any, across: float, down: float, aside: float = 0.0) -> None:
    """Puts the pointer on the radiograph as it lies now, at shares of its width and height and
    `aside` CSS pixels from there."""
    box = page.locator("#film-canvas").bounding_box()
    page.mouse.move(
        box["x"] + box["width"] * across + aside, box["y"] + box["height"] * down + aside
    )


def film(page: Any) -> Picture:
    """The radiograph as it is drawn, (rows, cols, 4)."""
    url = page.evaluate("document.querySelector('#film-canvas').toDataURL('image/png')")
    raw = base64.b64decode(url.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(raw)).convert("RGBA"), dtype=np.float32)


def still(target: Any) -> Picture:
    """A picture once it no longer changes (scenes fade in)."""
    last = picture(target)
    for _ in range(60):
        target.page.wait_for_timeout(400)
        now = picture(target)
        if now.shape == last.shape and np.abs(now - last).max() < 3.0 and now.std() > 2.0:
            return now
        last = now
    raise AssertionError("the picture never comes to rest")


def settled(target: Any, reached: Callable[[Picture], Any]) -> Picture:
    """A picture at rest of which `reached` holds: what was asked may take a while to be drawn."""
    for _ in range(40):
        now = still(target)
        if reached(now):
            return now
    raise AssertionError("the picture never shows what was asked for")


def drawn(view: Picture) -> bool:
    """Something with edges stands between the labels above and below: an empty scene has none."""
    rows = view.shape[0]
    middle = view[rows // 8 : 6 * rows // 8].mean(axis=2)
    return bool((np.abs(np.diff(middle, axis=1)) > 30.0).sum() > 100)


def changed(now: Picture, before: Picture) -> int:
    """Pixels that differ; a frame that is opened again may differ in a few along edges."""
    return int((np.abs(now - before).max(axis=2) > 25.0).sum())
