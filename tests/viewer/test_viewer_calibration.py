"""A calibration from the page alone: scan, fit, comparison over a radiograph, apply, undo."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from looking import begun, film, point_at

from flexdt.clients.client.client import TwinClient
from flexdt.library.reading.folders import load_dataset
from flexdt.phantoms import load_phantom
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import builtin_machine, profile_of
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.scan_request import ScanRequest

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
WRONG = {"dO_x": 0.6, "dO_z": -0.8}


def residue(page: Any) -> float:
    """Rms of what the page got: recorded less virtual line integrals."""
    told = page.evaluate(
        "(({scale, pixels, virtual}) => ({scale, pixels: [...pixels], virtual: [...virtual]}))"
        "(flexdt.store.image)"
    )
    return float(told["scale"] * np.subtract(told["pixels"], told["virtual"]).std())


def number(page: Any, id: str) -> float:
    return float(page.inner_text(f"#{id}").removesuffix(" px"))


def coloured(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    """Pixels that are near `colour`."""
    return int((np.abs(picture[..., :3] - np.array(colour)).max(axis=2) < 40).sum())


def on_top(page: Any, selector: str) -> bool:
    """Whether an element is what one sees at its middle."""
    return bool(page.locator(selector).evaluate(
        "(e) => { e.style.pointerEvents = 'auto'; const b = e.getBoundingClientRect();"
        " const hit = document.elementFromPoint((b.left + b.right) / 2, (b.top + "
        "b.bottom) / 2);"
        " e.style.pointerEvents = ''; return e.contains(hit); }"
    ))  # fmt: skip


AMBER, GREEN, PINK = (255, 180, 84), (54, 226, 143), (255, 60, 160)


def scanned(page: Any, twin: TwinClient, wait: Wait, frames: int) -> str:
    """Runs a scan of so many frames to its end; the job's name in the twin."""
    page.click("#tabs [data-tab=scan]")
    page.select_option("#wish-kind", "step")
    page.fill("#wish-frames", str(frames))
    page.click("#compose")
    page.locator("#report .verdict.ok").wait_for()
    page.select_option("#speed-up", "max")
    job = begun(page, twin)
    wait(lambda: twin.job_status(job).state == "done", "the scan", 300)
    return job


@pytest.mark.campaign
def test_from_scan_to_correction_and_back(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    # A wrong correction in force is to the fit what a misalignment is: it has to find it out.
    page.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    camera = "flexdt.call('camera.set', {roi: [32, 8, 1943, 1527], mode: 'HW2SW1High'})"
    page.evaluate(camera)
    page.evaluate(
        "p => flexdt.call('calibration.apply', {parameters: p, name: 'wrong'})", WRONG
    )
    job = twin.job_status(scanned(page, twin, wait, 13))
    name, folder = str(job.name), str(job.dataset)

    page.click("#tabs [data-tab=calibrate]")
    page.locator("#in-force", has_text="wrong").wait_for()
    page.locator(f"#datasets input[value='{name}']").check()
    page.fill("#fit-phantom", "lego")
    page.click("#fit")
    page.locator("#fit-report .verdict.ok").wait_for(timeout=600_000)
    report = page.inner_text("#fit-report")
    assert "13 frames" in report
    verdict = re.match(
        r"Safe to reconstruct: the rotation axis is known to ([0-9.e-]+) px", report
    )
    assert verdict, report
    assert "Write the scan that tells more" in report
    assert "flexdt " not in report, "commands are for shells, folded away"
    column = estimates(page)["axis_column"]
    assert abs(column[0] - (956 - 1) / 2) < 20
    assert float(verdict[1]) == pytest.approx(column[1], rel=0.5)
    sigmas = {name: sigma for name, (_, sigma) in estimates(page).items()}

    page.click("#fit-compare")
    page.locator("#film-recorded", has_text="scan_000000").wait_for()
    assert number(page, "compare-all-before") > 1.0
    assert number(page, "compare-all-after") < 0.2
    assert number(page, "compare-frame-before") > 10 * number(page, "compare-frame-after")
    assert page.locator("#estop").is_visible()
    both = film(page)
    assert coloured(both, AMBER) > 50
    assert coloured(both, GREEN) > 50
    page.uncheck("#compare-before")
    assert coloured(film(page), AMBER) == 0
    page.uncheck("#compare-after")
    assert coloured(film(page), GREEN) == 0
    page.check("#compare-before")
    page.check("#compare-after")
    page.select_option("#compare-times", "10")
    assert coloured(film(page), AMBER) > coloured(
        both, AMBER
    )  # longer lines to the circles
    # What is wrong with the machine is seen over it.
    page.evaluate("flexdt.call('safety.estop')")
    page.locator("#emergency", has_text="Emergency stop").wait_for()
    assert on_top(page, "#emergency-what")
    assert on_top(page, "#record-close")
    page.evaluate("flexdt.call('safety.reset')")
    for way in ("measured", "before", "after"):
        page.uncheck(f"#compare-{way}")

    # The virtual image is that of the wrong correction, which the recorded one was not taken
    # with.
    page.select_option("#compare-mode", "difference")
    page.wait_for_function("flexdt.store.image?.virtual")
    apart = residue(page)
    page.click("#fit-apply")
    wait(
        lambda: (
            twin.state().correction is not None
            and twin.state().correction.name != "wrong"
        )
    )
    applied = twin.state().correction
    assert applied is not None
    wait(
        lambda: residue(page) < 0.2 * apart, "the virtual image goes with the correction"
    )
    page.select_option("#compare-mode", "recorded")
    page.keyboard.press("Escape")
    page.locator("#record").wait_for(state="hidden")
    for parameter in WRONG:
        assert abs(applied.parameters[parameter]) < 4 * sigmas[parameter], (
            applied.parameters
        )
    # dO_z is told no better than the panel's height is known; what the images see of it is.
    dataset = load_dataset(folder)
    place = np.array(list(itertools.product((-15.0, 15.0), (-15.0, 15.0), (-25.0, 25.0))))
    seen = [
        dataset.poses.cone_vec(Offsets.from_edge(each)).project_points(
            place, dataset.shape
        )
        for each in (applied.parameters, {})
    ]
    assert np.abs(seen[0] - seen[1]).max() < 0.1
    page.locator("#in-force", has_text=applied.name).wait_for()
    page.click("#revert")
    wait(
        lambda: (
            twin.state().correction is not None
            and twin.state().correction.name == "wrong"
        )
    )
    page.locator("#in-force", has_text="wrong").wait_for()
    page.click("#revert")
    wait(lambda: twin.state().correction is None)


def test_what_cannot_be_fitted_is_told(page: Any, twin: TwinClient, wait: Wait) -> None:
    if not page.evaluate("flexdt.call('viewer.datasets')")["datasets"]:
        scanned(page, twin, wait, 2)
    page.click("#tabs [data-tab=calibrate]")
    page.locator("#datasets input").first.check()
    page.fill("#fit-phantom", "no-such-phantom")
    page.click("#fit")
    page.locator(".note.error", has_text="no-such-phantom").first.wait_for(
        timeout=600_000
    )
    assert page.locator("#fit:not([disabled])").count() == 1


def told_place(page: Any) -> tuple[float, float]:
    """Column and row of the last mark, as the page says them."""
    column, row = page.inner_text("#mark-row [aria-live]").split(" at ")[1].split(", ")
    return float(column), float(row)


def estimates(page: Any) -> dict[str, tuple[float, float]]:
    """Values and sigmas of the report that is shown, by the name behind each meaning."""
    cells = [row.split("\t") for row in page.locator("#fit-report tr").all_inner_texts()]
    return {
        named.split()[-1]: (float(value), float(sigma.removeprefix("± ")))
        for named, value, sigma, _ in cells
        if sigma.strip()
    }


def test_beads_marked_by_clicking_are_what_is_fitted(page: Any, twin: TwinClient) -> None:
    """Clicked are places that sines and cosines put 2 mm aside and 1 mm up: the fit says so."""
    machine, aside, up = builtin_machine(), 2.0, 1.0
    wish = ScanRequest("step", frames=13, mode="HW4SW1High")
    twin.control("force")
    twin.set_sample("lego")
    twin.submit_script(
        compose_script(wish, machine, profile_of(machine)), "marked", "max"
    )
    assert twin.wait_job().state == "done"
    folder = str(twin.job_status().dataset)
    twin.control("release")
    angles = load_dataset(folder).positions["rot_obj"]
    page.click("#tabs [data-tab=data]")
    page.get_by_role("button", name=re.compile("^marked")).click()
    page.locator("#record-at", has_text="scan_000000").wait_for()
    first = int(page.locator("#record").get_attribute("data-index"))
    page.get_by_role("button", name="Mark beads").click()
    for view in (0, 3, 6, 9):
        page.get_by_label("Image", exact=True).fill(str(first + view))
        page.locator("#record-at", has_text=f"scan_{view:06d}").wait_for()
        page.get_by_label("bead", exact=True).fill("0")
        turn = math.radians(float(angles[view]))
        for x, y, z in load_phantom("lego").beads.tolist():
            scale = 1059.0 / (600.0 - x * math.sin(turn) + y * math.cos(turn)) / 0.2992
            column = 238.5 + scale * (x * math.cos(turn) + y * math.sin(turn) + aside)
            row = 189.5 - scale * (z + up)
            point_at(page, (column + 0.5) / 478, (row + 0.5) / 380)
            page.mouse.down()
            page.mouse.up()
    page.get_by_text("20 marks in 4 images").wait_for()
    # One too many, and it goes again.
    point_at(page, 0.1, 0.1)
    page.mouse.down()
    page.mouse.up()
    page.get_by_text("21 marks in 4 images · 5 at").wait_for()
    # A drag moves it, arrows by a tenth of a pixel; Enter marks the middle.
    page.mouse.down()
    point_at(page, 0.2, 0.15)
    page.mouse.up()
    column, row = told_place(page)
    assert (column, row) == pytest.approx((0.2 * 478 - 0.5, 0.15 * 380 - 0.5), abs=1.0)
    page.locator("#film-canvas").focus()
    for key in ("ArrowRight", "ArrowRight", "ArrowUp", "Shift+ArrowDown"):
        page.keyboard.press(key)
    assert told_place(page) == pytest.approx((column + 0.2, row + 4.9), abs=0.11)
    page.keyboard.press("Enter")
    page.get_by_text("22 marks in 4 images · 6 at 238.5, 189.5").wait_for()
    page.get_by_role("button", name="6 ×").click()
    page.get_by_text("21 marks in 4 images").wait_for()
    drawn = coloured(film(page), PINK)
    page.get_by_role("button", name="5 ×").click()
    page.get_by_text("20 marks in 4 images").wait_for()
    assert 40 < coloured(film(page), PINK) < drawn
    page.get_by_role("button", name="Calibrate from these").click()
    page.locator("#fit-report .verdict.ok").wait_for(timeout=600_000)
    assert "4 frames" in page.inner_text("#fit-report")
    told = estimates(page)
    for name, true in (("dO_x", aside), ("dO_y", up)):
        value, sigma = told[name]
        assert abs(value - true) < 4 * sigma
        assert sigma < 0.3
    # The same marks of beads that nobody has measured, but for the distance of two of them.
    beads = load_phantom("lego").beads
    page.fill("#fit-phantom", "unknown")
    page.fill("#fit-scale", f"0-1={np.linalg.norm(beads[1] - beads[0]):.3f}")
    page.get_by_role("button", name="Calibrate from these").click()
    page.locator("#fit-note", has_text="running").wait_for()
    page.locator("#fit-report .verdict.ok").wait_for(timeout=600_000)
    value, sigma = estimates(page)["dO_x"]
    assert abs(value - aside) < 4 * sigma
    assert sigma < 0.3
    page.keyboard.press("Escape")


def test_a_page_comes_back_under_any_correction_by_hand(
    open_page: Callable[..., Any], twin: TwinClient
) -> None:
    """Also one with parameters for which the story has no slider: of a script, say."""
    page = open_page(tab="calibrate")
    twin.control("force")
    twin.apply_calibration({"dO_y": 0.2, "dO_x": 0.3}, comment="misaligned by hand")
    page.locator("#by-hand").wait_for()
    page.wait_for_function("sessionStorage.getItem('flexdt-story') !== null")
    page.reload()
    page.wait_for_function("window.flexdt?.store.state && flexdt.store.session")
    page.locator("#by-hand").wait_for()
    assert float(page.input_value("#story-dO_x")) == pytest.approx(0.3, abs=0.02)
    page.close()
    twin.revert_calibration()
    twin.control("release")
