"""A volume stands in its own visitor's scenes; pictures of the sample cost a second's one."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
from lab import fly_script
from looking import begun, changed, drawn, settled, still, until

from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
SIZE = (900, 560)
MANY_PX = 400
"""A volume on the stage, close up, changes more pixels than that; noise fewer than a tenth."""
ALONE = dict.fromkeys(
    ("names", "machine", "panel", "beam", "axis", "orbit", "sample"), False
)
EMIT = "name => import('/link.js').then(({ emit }) => emit('reconstruct', name))"


def close_up(page: Any) -> Any:
    """The view at the sample's place, where a volume would be all that is drawn."""
    box = page.locator(".view[data-view=iso]")
    settled(box, drawn)
    page.add_style_tag(content=".inset, #said { visibility: hidden }")
    box.locator(".look").click()
    page.evaluate("v => flexdt.call('viewer.layers', v)", ALONE)
    return box


def put(twin: TwinClient, sample: str) -> None:
    twin.control("force")
    twin.set_sample(sample)
    twin.control("release")


@pytest.mark.slow
@pytest.mark.campaign
def test_a_volume_of_one_visitor_does_not_stand_in_the_scene_of_the_other(
    open_page: Callable[..., Any], twin: TwinClient
) -> None:
    """On the stage, off it under another sample, and as a ghost: the other sees none of it."""
    put(twin, "gear")
    ada, emmy = (open_page("iso", SIZE, gap=400) for _ in range(2))
    ada.evaluate("flexdt.call('session.control', {action: 'force'})")
    ada.click("#tabs [data-tab=scan]")
    ada.fill("#script", fly_script(frames=91, roi="32 8 1943 1527"))
    ada.select_option("#speed-up", "max")
    job = begun(ada, twin)
    until(lambda: twin.job_status(job).state == "done", "the scan is made")
    name = str(twin.job_status(job).dataset).rpartition("/")[2]
    boxes = close_up(ada), close_up(emmy)
    bare = still(boxes[1])
    settled(boxes[0], lambda now: changed(now, bare) < MANY_PX / 10)
    ada.evaluate(EMIT, name)
    stands = ada.locator("#volume-stands")
    until(lambda: stands.inner_text() == "stands on the stage", "the volume stands there")
    settled(boxes[0], lambda now: changed(now, bare) > MANY_PX)
    assert changed(still(boxes[1]), bare) < MANY_PX / 10
    assert not emmy.is_visible("#volume-stage")
    put(twin, "square")  # both cameras stand elsewhere for it
    apart = lambda now: changed(now, still(boxes[1]))  # noqa: E731
    settled(boxes[0], lambda now: apart(now) < MANY_PX / 10)
    assert stands.inner_text() != "stands on the stage"
    ada.check("#volume-ghost")
    settled(boxes[0], lambda now: apart(now) > MANY_PX)
    put(twin, "gear")
    settled(boxes[1], lambda now: changed(now, bare) < MANY_PX / 10)
    settled(boxes[0], lambda now: changed(now, bare) > MANY_PX)
    for page in (ada, emmy):
        page.close()


@pytest.mark.slow
def test_pictures_of_the_sample_are_asked_for_once_a_second_at_most(
    open_page: Callable[..., Any], twin: TwinClient
) -> None:
    """While the stage turns; none is given up half way."""
    page = open_page("iso", SIZE)
    settled(page.locator(".view[data-view=iso]"), drawn)
    asked: list[str] = []
    failed: list[str] = []
    page.on("request", lambda r: asked.append(r.url) if "still.jpg" in r.url else None)
    page.on(
        "requestfailed", lambda r: failed.append(r.url) if "still.jpg" in r.url else None
    )
    before = twin.state().axes["rot_obj"].position
    page.evaluate("flexdt.call('session.control', {action: 'force'})")
    page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 900}, relative: true})")
    since = time.monotonic()
    page.wait_for_timeout(8000)
    seconds = time.monotonic() - since
    assert twin.state().axes["rot_obj"].position > before + 10
    print(f"{len(asked)} pictures in {seconds:.1f} s, {len(failed)} given up")
    assert 1 <= len(asked) <= seconds + 1
    assert failed == []
    page.evaluate("flexdt.call('axes.stop')")
    page.close()


@pytest.mark.slow
def test_a_picture_of_the_sample_that_a_busy_viewer_had_not_is_asked_for_again(
    open_page: Callable[..., Any],
) -> None:
    """Nothing moves any more; meanwhile there is no empty box."""
    page = open_page("iso", SIZE)
    inset = page.locator(".view .inset")
    page.wait_for_function("document.querySelector('.inset img').naturalWidth > 0")
    answers: list[bool] = []

    def busy(route: Any) -> None:
        answers.append(over)
        if over:
            route.continue_()
        else:
            route.fulfill(status=204)

    over = False

    page.route("**/still.jpg?*view=sample*", busy)
    page.evaluate("document.documentElement.dataset.theme = 'dark'")
    inset.wait_for(state="hidden")
    over = True
    inset.wait_for()
    assert answers[0] is False
    assert answers[-1] is True
    page.close()
