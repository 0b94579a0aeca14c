"""From a page just opened to a volume beside its truth, and what can be done with it there.

`pytest -s -m slow tests/viewer/test_viewer_volume.py` prints clicks, seconds and frames a
second.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from looking import USUAL, picture

from flexdt.clients.client.client import TwinClient
from flexdt.phantoms import load_phantom

pytestmark = [pytest.mark.browser, pytest.mark.slow]
BLOCK = "flexdt.volume().three.block"
CORRECTION, NAME = {"dO_x": 0.4}, "wrong for a volume"
"""A wrong correction, so that the volume without it is the better one [mm]."""


@pytest.fixture
def lego(twin: TwinClient) -> Iterator[None]:
    """A phantom on the stage, and a wrong correction in force."""
    twin.control("force")
    twin.set_camera(**USUAL)
    twin.set_sample("lego")
    twin.apply_calibration(CORRECTION, NAME)
    twin.control("release")
    yield
    twin.control("force")
    twin.revert_calibration()
    twin.control("release")


def test_from_nothing_to_a_volume_beside_its_truth(
    lego: None, open_page: Callable[..., Any], tmp_path: Path
) -> None:
    """At most three clicks: a sample is chosen by two, the rest is one."""
    page = open_page(size=(1366, 768))
    begun = time.monotonic()
    clicks, at = 0, {}
    page.locator("#scan-it-sample option[value=lego]").wait_for(state="attached")
    page.select_option("#scan-it-sample", "lego")
    clicks += 2
    page.get_by_role("button", name="Scan it").click()
    clicks += 1
    page.wait_for_function(
        "flexdt.store.job?.frames_done > 0 || flexdt.store.job?.state === 'done'"
    )
    at["first frames"] = time.monotonic() - begun
    page.wait_for_function(f"{BLOCK} && flexdt.volume().told?.views > 0")
    at["first slice"] = time.monotonic() - begun
    page.wait_for_function(f"{BLOCK} && flexdt.volume().told?.past", timeout=300_000)
    at["full volume"] = time.monotonic() - begun
    page.locator("#volume-compared table").wait_for(timeout=300_000)
    page.locator("#volume-beside").wait_for(timeout=300_000)
    at["comparison"] = time.monotonic() - begun
    said = ", ".join(f"{what} {seconds:.1f} s" for what, seconds in at.items())
    print(f"\n{clicks} clicks: {said}; load average {os.getloadavg()[0]:.1f}")
    assert clicks <= 3
    told = page.evaluate("flexdt.volume().told.compared")
    wrong, nominal = told[f"correction “{NAME}”"], told["no correction"]
    # ABS at the energy at which phantoms state it, and the bricks' size.
    assert nominal["attenuation"] == pytest.approx([0.021, 0.021], rel=0.02)
    x, y, _ = load_phantom("lego").size_mm
    for axis, size in (("x_mm", x), ("y_mm", y)):
        assert nominal[axis] == pytest.approx([size, size], abs=0.25)
    assert wrong["rms"] > 1.1 * nominal["rms"]
    names = page.locator("#volume-shown option").evaluate_all(
        "all => all.map((o) => o.value)"
    )
    # The correction is wrong, and the volume says what that does to it.
    assert names == ["volume", "sigma", "bias_bound", "other", "truth", "difference"]
    doubts = page.evaluate("flexdt.volume().told.doubts")
    assert re.search("edges doubled: the axis offset", doubts[0]), doubts
    # The truth is that of the phantom, not of anything hidden: bricks as they are drawn.
    page.select_option("#volume-shown", "truth")
    page.wait_for_function(f"{BLOCK}.low === 0 && {BLOCK}.high > 0.1")
    page.select_option("#volume-shown", "difference")
    page.wait_for_function(f"{BLOCK}.signed")
    page.select_option("#volume-shown", "volume")
    page.wait_for_function(f"!{BLOCK}.signed")
    scrolls_and_turns(page)
    is_shared(page, tmp_path)
    page.close()


def scrolls_and_turns(page: Any) -> None:
    """Slices a second, and pictures of the whole in software GL, with what is cut away."""
    page.click("#volume-large")
    per_s = page.evaluate(
        "() => new Promise((done) => { const v = flexdt.volume().three, n = 20; let k = 0;"
        " const begun = performance.now(); const next = () => { v.go([k, 2 * k, k]);"
        " requestAnimationFrame(() => ++k < n ? next()"  # after the slices of this picture
        " : done(1000 * n / (performance.now() - begun))); }; next(); })"
    )
    print(f"{per_s:.0f} times all three slices a second")
    before = picture(page.locator("#volume-ray"))
    ms = page.evaluate(
        "() => new Promise((done) => { const s = flexdt.volume().solid, all = []; const next = "
        "() => { s.yaw += 0.1; s.draw(); requestAnimationFrame(() => requestAnimationFrame(() "
        "=> { all.push(s.ms); all.length < 8 ? next() : done(all); })); }; next(); })"
    )
    wide = page.evaluate("document.querySelector('#volume-ray').width")
    print(
        f"{np.median(ms):.0f} ms, {min(ms):.0f} at best, a picture of {wide} x {wide} pixels"
    )
    turned = picture(page.locator("#volume-ray"))
    assert np.abs(turned - before).max(axis=2).mean() > 2, "it is another picture"
    page.select_option("#volume-cut", "1")
    page.wait_for_timeout(500)
    cut = picture(page.locator("#volume-ray"))
    assert np.abs(cut - turned).max(axis=2).mean() > 2, "a part is cut away"
    page.keyboard.press("Escape")
    page.wait_for_function("!document.body.classList.contains('whole')")


def is_shared(page: Any, folder: Path) -> None:
    """One file below 5 MB that opens by itself, with its title, words, camera and values."""
    with page.expect_download(timeout=120_000) as told:
        page.click("#volume-share")
    file = folder / told.value.suggested_filename
    told.value.save_as(file)
    assert re.fullmatch(r"flexdt-lego-[\d-]+\.html", file.name)
    assert file.stat().st_size < 5_000_000
    said: list[str] = []
    alone = page.context.browser.new_page(viewport={"width": 1280, "height": 900})
    alone.on("pageerror", lambda error: said.append(str(error)))
    alone.on(
        "request", lambda r: said.append(r.url) if r.url.startswith("http") else None
    )
    alone.goto(file.as_uri())
    alone.wait_for_function("document.querySelector('#ray').width > 1")
    assert re.fullmatch(r"lego · \d{4}-\d\d-\d\d \d\d:\d\d · flexdt", alone.title())
    assert "axes x, y and z" in alone.inner_text("body")
    assert "flexdt reconstruct --binning" in alone.inner_text("body")
    assert "rms difference" in alone.inner_text("body")
    assert alone.locator("img[alt=radiograph]").evaluate("e => e.naturalWidth") == 956
    grey = picture(alone.locator("#ray"))
    assert (grey.mean(axis=2) > 60).mean() > 0.02, "the volume is drawn"
    alone.locator("#front").hover()
    alone.locator("#at", has_text="per mm").wait_for()
    assert said == []
    alone.close()
