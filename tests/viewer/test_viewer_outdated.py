"""What the page has found out, and says no longer once it is no longer true."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from lab import fly_script
from looking import begun, seen

from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
STALE = "The machine has changed since"


@pytest.fixture(autouse=True)
def as_it_was(page: Any) -> Iterator[None]:
    yield
    page.evaluate("flexdt.data.open(null)")
    page.evaluate("flexdt.call('sample.set', {name: 'lego'})")


def emitted(page: Any, *events: tuple[Any, ...], then: str) -> Any:
    """Listeners of the page told, and what it shows in the same moment."""
    return page.evaluate(
        "async ([events, then]) => { const { emit } = await import('/link.js');"
        " for (const event of events) emit(...event); return eval(then); }",
        [[list(event) for event in events], then],
    )


def test_a_checked_script_is_to_be_checked_again(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 0}, wait: true})")
    seen(page, twin)
    page.click("#tabs [data-tab=scan]")
    page.fill("#script", fly_script(frames=9))
    for change, back in (
        ("flexdt.call('sample.set', {name: 'empty'})", "flexdt.call('sample.set', {name: 'lego'})"),
        ("flexdt.call('axes.move', {targets: {rot_obj: 3}})", "flexdt.call('axes.move', "
         "{targets: {rot_obj: 0}})"),
        ("flexdt.call('calibration.apply', {parameters: {dD_x: 0.1}})",
         "flexdt.call('calibration.revert')"),
    ):  # fmt: skip
        page.click("#check")
        page.locator("#report .verdict").wait_for()
        seen(page, twin)
        assert page.locator("#stale").count() == 0
        page.evaluate(f"{change}.then(() => null)")
        page.locator("#stale", has_text=STALE).wait_for()
        page.evaluate(f"{back}.then(() => null)")
        page.locator("#stale").wait_for(state="detached")
    page.fill("#script", "")


def test_a_prediction_goes_with_what_it_was_made_for(page: Any, wait: Wait) -> None:
    page.click("#tabs [data-tab=setup]")
    page.click("#predict")
    wait(lambda: "contrast to noise of" in page.inner_text("#predicted"), "a prediction")
    page.evaluate("flexdt.call('sample.set', {name: 'empty'})")
    page.locator("#predicted", has_text="predict again").wait_for()


def test_an_open_data_set_is_complete_when_its_scan_is(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    page.click("#tabs [data-tab=scan]")
    page.fill("#script", fly_script(frames=60))
    page.select_option("#speed-up", "10")
    page.evaluate("flexdt.call('session.control', {action: 'release'})")
    job = begun(page, twin)
    wait(lambda: (twin.job_status(job).frames_done or 0) > 0, "a first image")
    name = str(twin.job_status(job).dataset).split("/")[-1]
    page.evaluate("name => flexdt.data.open(name)", name)
    assert "running" in page.inner_text("#record-state")
    wait(lambda: twin.job_status(job).state == "done", "the scan")
    whole = "complete · 60 projections"
    wait(lambda: page.inner_text("#record-state").startswith(whole), "all of it")
    assert page.evaluate("Number(document.querySelector('#record-frame').max)") >= 59
    page.fill("#script", "")


def test_a_scan_that_waits_takes_no_other_ones_place(page: Any) -> None:
    job = {
        "time": 1e9,
        "frames_done": 3,
        "frames_total": 9,
        "elapsed_s": 1.0,
        "speed_up": 1,
        "what": "",
    }
    first = {**job, "job": "job-a", "state": "running", "dataset": "/data/a"}
    later = {**job, "job": "job-b", "state": "queued", "dataset": "/data/b"}
    name = "document.querySelector('#job-name').textContent"
    assert emitted(page, ("job", first), ("job", later), then=name) == "job-a"
    over, turn = {**first, "state": "done"}, {**later, "state": "running"}
    assert emitted(page, ("job", over), ("job", turn), then=name) == "job-b"


def test_slices_of_another_page_and_answers_that_come_late(page: Any) -> None:
    job = {"job": "x", "state": "running", "dataset": "/data/none", "time": 1e9, "speed_up": 1,
           "frames_done": 3, "frames_total": 9, "elapsed_s": 1.0, "what": ""}  # fmt: skip
    choose = """
    const size = document.querySelector('#volume-side');
    const note = document.querySelector('#volume-note');
    const choose = (v) => { size.value = v; size.dispatchEvent(new Event('change')); };
    """
    told = {
        "name": "none",
        "past": False,
        "views": 5,
        "of": 9,
        "voxel_mm": 0.1,
        "size": [9, 9, 9],
    }
    own, other = (("volume", {**told, "side": side}) for side in (128, 256))
    emitted(page, ("job", job), then=f"{choose} choose('128'); 0")
    assert "another page" not in emitted(page, own, then=f"{choose} note.textContent")
    said = emitted(page, other, then=f"{choose} note.textContent")
    assert "256 voxels a side, as another page chose" in said
    # What was refused after another choice says nothing: there is no such data set.
    said = page.evaluate(
        f"async () => {{ {choose} choose('192'); choose('');"
        " await flexdt.call('viewer.live', {}); return note.textContent; }"
    )
    assert said == ""
    page.evaluate("flexdt.store.job = null")


def test_no_difference_is_said(page: Any, wait: Wait) -> None:
    page.wait_for_function("flexdt.store.image?.kind === 'line_integral'")
    page.click("#keep-reference")
    page.check("#difference")
    wait(lambda: "difference from" in page.inner_text("#transmission"), "the difference")
    assert "no difference" not in page.inner_text("#film-note")
    page.select_option("#kind", "counts")
    page.locator("#film-note", has_text="of another kind or size").wait_for()
    page.select_option("#kind", "line_integral")
    wait(
        lambda: "no difference" not in page.inner_text("#film-note"),
        "the difference again",
    )
    page.uncheck("#difference")


def test_a_confirmed_stop_is_not_called_unconfirmed(page: Any, wait: Wait) -> None:
    emitted(
        page,
        ("note", "error", "E-stop not confirmed", "no answer for 5 s", "safety.estop"),
        then="0",
    )
    assert page.locator("#notes .note", has_text="E-stop not confirmed").count() == 1
    page.evaluate("flexdt.call('safety.estop').then(() => null)")
    page.locator("#reset").wait_for()
    assert page.locator("#notes .note", has_text="E-stop not confirmed").count() == 0
    page.evaluate("flexdt.call('safety.reset').then(() => null)")


def test_a_picture_of_no_view(page: Any) -> None:
    page.click("#tabs [data-tab=share]")
    page.click("#shot")
    page.locator("#notes .note", has_text="open a view first").wait_for()
    page.click("#tabs [data-tab=move]")
