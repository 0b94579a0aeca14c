"""X-rays never hide the sample: its pixels are counted with the beam and without it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from looking import Picture, arrived, frames, picture

from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
VIEWS = ("iso", "side", "free", "beam")
DISTANCES_MM = (300.0, 200.0, 250.0, 350.0, 450.0, 550.0, 650.0, 800.0)
"""Of the sample from the source; the first is drawn in CI, the others in the campaign."""
LEAST_KEPT = 0.9
"""Share of the sample's pixels that are still the sample's with X-rays on."""
LEAST_PX = 15
"""Pixels of the sample in every view, without which a share means nothing: viser draws with
fewer pixels where pictures are slow (65 or 26 in the side view)."""


@pytest.fixture(scope="module")
def four(open_page: Callable[..., Any]) -> Iterator[Any]:
    page = open_page("four", (1440, 900), notes_stay=False)
    page.evaluate("document.querySelector('main').style.setProperty('--right', '274px')")
    page.add_style_tag(content=".inset { visibility: hidden }")
    page.evaluate("flexdt.call('session.control', {action: 'force'})")
    page.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    page.evaluate("flexdt.call('viewer.layers', {opacity: 0.8})")
    yield page
    page.evaluate("flexdt.call('tube.set', {on: false})")
    page.close()


def sample_px(view: Picture) -> int:
    """Pixels as red as LEGO: more than amber light makes of grey."""
    red, green, blue = np.moveaxis(view[..., :3], 2, 0)
    return int(
        ((red - np.maximum(green, blue) > 40.0) & (np.abs(green - blue) < 40.0)).sum()
    )


def counted(four: Any, distance_mm: float, on: bool) -> dict[str, int]:
    """The sample's pixels by view, once two pictures say the same."""
    boxes = {view: four.locator(f".view[data-view={view}]") for view in VIEWS}
    for box in boxes.values():
        arrived(box)
    last: dict[str, int] = {}
    for _ in range(40):
        frames(boxes["beam"], 3)
        now = {view: sample_px(picture(box)) for view, box in boxes.items()}
        if now == last:
            return now
        last = now
    raise AssertionError(f"the views never rest at {distance_mm} mm, X-rays {on}")


@pytest.mark.parametrize("distance_mm", DISTANCES_MM)
@pytest.mark.campaign
def test_x_rays_never_hide_the_sample(
    four: Any, twin: TwinClient, wait: Wait, distance_mm: float
) -> None:
    """The sample's pixels stay its own in all four views, at any distance."""
    four.evaluate("d => flexdt.call('axes.move', {targets: {mag_obj: d}})", distance_mm)
    wait(
        lambda: not any(axis.moving for axis in twin.state().axes.values()),
        "the stage rests",
    )
    seen: dict[bool, dict[str, int]] = {}
    for on in (False, True):
        four.evaluate("on => flexdt.call('tube.set', {on})", on)
        four.wait_for_function("on => flexdt.store.state.tube.on === on", arg=on)
        seen[on] = counted(four, distance_mm, on)
    assert all(count > LEAST_PX for count in seen[False].values()), seen
    for view in VIEWS:
        assert seen[True][view] >= LEAST_KEPT * seen[False][view], (view, seen)
