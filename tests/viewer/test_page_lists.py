"""Lists of the page: scans that wait, presets of tube and camera; and the notice of an end."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from lab import fly_script
from looking import until

from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser


def test_scans_that_wait_stand_above_those_that_are_made(
    page: Any, twin: TwinClient
) -> None:
    """In the twin's order; one is taken off, and the others move up."""
    with twin:
        twin.control("force")
        twin.set_clock(1.0)
        text = fly_script(frames=181)
        jobs = [twin.submit_script(text, name=f"queue-{k}").job for k in range(3)]
        twin.control("release")
        page.evaluate("flexdt.call('session.control', {action: 'force'})")
        page.click("#tabs [data-tab=data]")
        rows = page.locator("#data-queue .queued b")
        until(lambda: rows.all_inner_texts() == ["queue-1", "queue-2"], "two wait")
        words = page.locator("#data-queue .state").all_inner_texts()
        assert words == ["comes next", "waits for 1 before it"]
        page.click("#data-queue .queued:first-child button")
        until(lambda: rows.all_inner_texts() == ["queue-2"], "one is off")
        assert twin.job_status(jobs[1]).state == "aborted"
        assert page.locator(".data-set[data-name=queue-0]").count() == 1
        page.evaluate("flexdt.call('session.control', {action: 'release'})")
        twin.abort_job(jobs[2])
        until(lambda: not rows.count(), "none waits")
        assert page.inner_text("#job-name") == "queue-0"
        twin.abort_job(jobs[0])
        for _ in "first", "loaded again":  # queue-2 is aborted, too, but never began
            page.wait_for_function(
                "flexdt.store.job?.state === 'aborted' && flexdt.store.job.name === 'queue-0'"
            )
            page.reload()


def test_presets_set_tube_and_camera_and_stay_in_this_browser(
    open_page: Callable[..., Any], twin: TwinClient
) -> None:
    page = open_page()
    page.click("#tabs [data-tab=setup]")
    page.evaluate("flexdt.call('session.control', {action: 'force'})")
    before = twin.state()
    page.fill("#preset-name", "mine")
    page.click("#preset-keep")
    page.select_option("#preset", "Quick look")
    assert not page.is_visible("#preset-delete")
    page.click("#preset-use")
    until(lambda: twin.state().camera.exposure_ms == 50.0, "the camera is set")
    assert twin.state().tube == before.tube
    page.evaluate("flexdt.call('tube.set', {kV: 55, power_W: 11})")
    until(lambda: twin.state().tube.kV == 55.0, "another voltage")
    page.reload()
    page.wait_for_function("window.flexdt?.store.state && flexdt.store.session")
    page.evaluate("flexdt.call('session.control', {action: 'force'})")
    page.select_option("#preset", "mine")
    page.click("#preset-use")
    until(lambda: twin.state().camera == before.camera, "the camera is as before")
    assert (twin.state().tube.kV, twin.state().tube.power_W) == (
        before.tube.kV,
        before.tube.power_W,
    )
    page.click("#preset-delete")
    assert "mine" not in page.locator("#preset option").all_inner_texts()
    page.close()


AWAY = """
window.told = [];
window.Notification = class {
  constructor(words) { window.told.push(words); }
  static requestPermission() { return Promise.resolve('granted'); }
};
document.hasFocus = () => false;
"""
"""A browser that may tell, on a page that nobody looks at."""


def test_the_end_of_a_scan_is_in_the_title_and_told_where_that_was_asked_for(
    open_page: Callable[..., Any], twin: TwinClient
) -> None:
    page = open_page(script=AWAY)
    usual = page.title()
    for name, ends in (("ended", "aborted"), ("made", "done")):
        twin.control("force")
        pace = 1.0 if ends == "aborted" else "max"
        job = twin.submit_script(fly_script(frames=41), name, pace).job
        twin.control("release")
        if ends == "aborted":
            page.click("#job-notify")
            page.locator("#job-notify[aria-pressed=true]").wait_for()
            until(lambda: re.fullmatch(rf"\d+ % · {re.escape(usual)}", page.title()), "%")
            twin.control("force")
            twin.abort_job(job)
            twin.control("release")
        until(lambda ends=ends: page.title() == f"scan {ends} · {usual}", "the title")
    assert page.evaluate("window.told") == ["ended: scan aborted", "made: scan done"]
    page.evaluate("window.dispatchEvent(new Event('focus'))")
    assert page.title() == usual
    page.close()
