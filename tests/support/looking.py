"""What a browser shows, waited for; pictures, and what can be said of them."""

from __future__ import annotations

import base64
import io
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from flexdt.clients.client.client import TwinClient
from flexdt.protocol.state_model import State

Picture = npt.NDArray[np.float32]
KNOWN_HERE = """
if (!localStorage.getItem('flexdt-motors')) localStorage.setItem('flexdt-motors', 'open');
"""
"""A browser that has been here before: motors open."""

SAID_HIDDEN = "#warnings, #notes { visibility: hidden }"
"""What the page says to people lies over its views, and comes and goes by itself."""

USUAL = {"mode": "HW2SW1High", "roi": (32, 8, 1943, 1527)}
"""The camera that most tests expect."""


def until(condition: Callable[[], Any], what: str = "", seconds: float = 120.0) -> Any:
    """The first true value of `condition`, asked for less often the longer it takes: a look into
    a page costs four processes some milliseconds."""
    begun = time.monotonic()
    while True:
        value = condition()
        if value:
            return value
        waited = time.monotonic() - begun
        assert waited < seconds, f"not within {seconds:g} s: {what or condition}"
        time.sleep(min(0.3, max(0.03, 0.05 * waited)))


def seen(page: Any, twin: TwinClient) -> None:
    """Waits until the page shows a state from now on, or one that says what the twin says
    now."""

    def facts(state: State) -> object:
        return state.model_dump(exclude={"time", "clock"}), state.clock.speed_up

    now = twin.state()
    wanted = facts(now)

    def shown() -> bool:
        state = State.model_validate(page.evaluate("flexdt.store.state"))
        return state.time > now.time or facts(state) == wanted

    until(shown, "the page shows the twin's state")


def released(page: Any) -> None:
    """Resets as a person does: RESET once it is armed, then the answer to its question."""
    page.click("#reset")
    page.click("#reset-yes")
    page.locator("#reset").wait_for(state="hidden")


def answered(page: Any) -> None:
    """Waits until the twin has answered all that the page has asked for so far."""
    page.evaluate("flexdt.call('state.get').then(() => null)")


def begun(page: Any, twin: TwinClient) -> str:
    """Runs the script of the page; the scan's name in the twin."""
    before = {job.job for job in twin.jobs().jobs}
    page.click("#run")
    new = lambda: [job.job for job in twin.jobs().jobs if job.job not in before]  # noqa: E731
    return str(until(new, "the scan")[0])


def picture(target: Any) -> Picture:
    """A picture of a view, (rows, cols, 3), without the notes and warnings over it."""
    raw = target.screenshot(timeout=180_000, style=SAID_HIDDEN)
    return np.asarray(Image.open(io.BytesIO(raw)).convert("RGB"), dtype=np.float32)


def point_at(page: Any, across: float, down: float, aside: float = 0.0) -> None:
    """Puts the pointer on the radiograph as it lies now, at shares of its width and height and
    `aside` CSS pixels from there."""
    page.locator(
        "#film-canvas"
    ).scroll_into_view_if_needed()  # buttons below it may have been used
    box = page.locator("#film-canvas").bounding_box()
    page.mouse.move(
        box["x"] + box["width"] * across + aside, box["y"] + box["height"] * down + aside
    )


def film(page: Any) -> Picture:
    """The radiograph as it is drawn once what is due has been drawn, (rows, cols, 4)."""
    url = page.evaluate(
        "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
        ".then(() => document.querySelector('#film-canvas').toDataURL('image/png'))"
    )
    raw = base64.b64decode(url.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(raw)).convert("RGBA"), dtype=np.float32)


def arrived(target: Any) -> None:
    """Waits until a view has drawn what its viewer has told it so far: viser answers for a
    picture of its own only after that."""
    page, view = target.page, target.evaluate("e => e.closest('.view').dataset.view")
    ask = (
        "view => flexdt.call('viewer.screenshot', { view, width: 64, height: 48 })"
        ".then(() => true, () => false)"  # it may not be open yet
    )
    until(lambda: page.evaluate(ask, view), f"the view {view}")


def frames(target: Any, count: int = 2) -> None:
    """Waits until a view has drawn so many pictures."""
    inside = target.locator("iframe").element_handle().content_frame()
    inside.evaluate(
        "count => new Promise((done) => { const next = () =>"
        " (count-- > 0 ? requestAnimationFrame(next) : done()); next(); })",
        count,
    )


def still(target: Any) -> Picture:
    """A picture of a view once it no longer changes (scenes fade in)."""
    arrived(target)
    last = picture(target)
    for _ in looks():
        frames(target)
        now = picture(target)
        if now.shape == last.shape and np.abs(now - last).max() < 3.0 and now.std() > 2.0:
            return now
        last = now
    raise AssertionError("the picture never comes to rest")


def settled(target: Any, reached: Callable[[Picture], Any]) -> Picture:
    """A picture at rest of which `reached` holds: what was asked may take a while to be
    drawn."""
    for _ in looks():
        now = still(target)
        if reached(now):
            return now
    raise AssertionError("the picture never shows what was asked for")


def looks(least: int = 40, seconds: float = 120.0) -> Iterator[None]:
    """Looks at something that may take a while: at least so many, over at least so long.

    A slow machine has as many as a quick one, a quick one as much time as a slow one.
    """
    begun, seen = time.monotonic(), 0
    while seen < least or time.monotonic() - begun < seconds:
        yield
        seen += 1


def drawn(view: Picture) -> bool:
    """Something with edges stands between the labels above and below: an empty scene has
    none."""
    rows = view.shape[0]
    middle = view[rows // 8 : 6 * rows // 8].mean(axis=2)
    return bool((np.abs(np.diff(middle, axis=1)) > 30.0).sum() > 100)


def changed(now: Picture, before: Picture) -> int:
    """Pixels that differ; a frame that is opened again may differ in a few along edges."""
    return int((np.abs(now - before).max(axis=2) > 25.0).sum())
