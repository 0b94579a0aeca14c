"""The controls of a task: distances, magnification, voxel and height by their names, what terms
mean, the film's gamma, and one click to a volume."""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from looking import begun, picture, seen, until
from PIL import Image

from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]


def rests(twin: TwinClient) -> bool:
    return not any(axis.moving for axis in twin.state().axes.values())


@pytest.mark.parametrize(
    ("label", "value", "told"),
    [
        ("Source to sample", 480.0, lambda g: g.SOD_mm),
        ("Source to detector", 1010.0, lambda g: g.SDD_mm),
        ("Magnification", 2.1, lambda g: g.SDD_mm / g.SOD_mm),
        ("Voxel size", 70.0, lambda g: 1000.0 * g.voxel_size_mm),
    ],
)
def test_a_scan_is_set_by_what_it_is_planned_by(
    page: Any, twin: TwinClient, label: str, value: float, told: Callable[[Any], float]
) -> None:
    page.click("#tabs [data-tab=move]")
    field = page.get_by_label(label, exact=True)
    field.fill(f"{value:g}")
    field.press("Enter")
    until(lambda: abs(told(twin.state().geometry) - value) < 1e-3 * value, label)
    until(lambda: rests(twin), "the motors rest")
    assert told(twin.state().geometry) == pytest.approx(value, rel=2e-6)
    until(
        lambda: float(field.input_value()) == pytest.approx(value, abs=0.005),
        "the field follows",
    )


def test_the_height_moves_source_and_detector_together(
    page: Any, twin: TwinClient
) -> None:
    page.click("#tabs [data-tab=move]")
    before = twin.state().axes
    field = page.get_by_label("Sample above beam", exact=True)
    wanted = float(field.input_value()) - 4.0
    field.fill(f"{wanted:.2f}")
    field.press("Enter")
    up = lambda axis: twin.state().axes[axis].position - before[axis].position  # noqa: E731
    until(
        lambda: up("ver_tube") == pytest.approx(4.0, abs=0.006) and rests(twin),
        "the source",
    )
    assert up("ver_det") == pytest.approx(up("ver_tube"), abs=1e-6)
    seen = "flexdt.store.framing.sample_height_mm"
    until(lambda: page.evaluate(seen) == pytest.approx(wanted, abs=1e-6), "the height")
    field.fill("high")
    field.press("Enter")
    page.locator(".note.error", has_text="Sample above beam stays").wait_for()
    page.evaluate("t => flexdt.call('axes.move', {targets: t})",
                  {a: before[a].position for a in ("ver_tube", "ver_det")})  # fmt: skip
    until(lambda: rests(twin) and abs(up("ver_tube")) < 1e-6, "back")


def test_terms_explain_themselves_to_pointer_and_keyboard(page: Any) -> None:
    page.click("#tabs [data-tab=move]")
    shown = "e => getComputedStyle(e, '::after').content"
    terms = page.locator(".term:visible").all()
    assert len(terms) >= 12
    for term in terms:
        page.mouse.move(1, 1)
        page.evaluate("document.activeElement.blur()")
        assert term.evaluate(shown) == "none"
        term.focus()
        tip = term.evaluate(shown).strip('"')
        assert tip == term.get_attribute("aria-description")
        assert len(tip) > 8
    terms[0].hover()
    page.evaluate("document.activeElement.blur()")
    assert terms[0].evaluate(shown) != "none"


def test_an_empty_script_says_why_it_does_not_run(page: Any) -> None:
    page.click("#tabs [data-tab=scan]")
    page.fill("#script", "")
    for button in ("#check", "#run"):
        assert page.locator(button).is_disabled()
        why = page.locator(f"#{page.locator(button).get_attribute('aria-describedby')}")
        assert why.is_visible()
        assert "Write" in why.inner_text()
    page.fill("#script", "x")
    assert page.locator("#run").is_enabled()
    assert not page.locator("#empty-note").is_visible()
    page.fill("#script", "")


def test_what_is_not_ready_does_not_run_and_what_runs_has_one_after_it(
    page: Any, twin: TwinClient
) -> None:
    page.click("#tabs [data-tab=scan]")
    page.fill("#script", "nonsense\tdo\t3\n")
    page.click("#check")
    page.locator("#report .verdict.bad").wait_for()
    run = page.locator("#run")
    assert run.is_disabled()
    assert "not ready" in run.get_attribute("title")
    page.fill("#script", "scanner\tpause\t30\n")
    assert run.is_enabled()
    assert run.inner_text() == "Run"
    job = begun(page, twin)
    page.locator("#run", has_text="Run next").wait_for()
    assert "primary" not in run.get_attribute("class")
    twin.abort_job(job)
    page.locator("#run.primary", has_text=re.compile("^Run$")).wait_for()
    page.fill("#script", "")


def test_the_scan_proposes_the_images_that_the_sample_needs(
    page: Any, twin: TwinClient
) -> None:
    """Steps at the sample's rim of a voxel of 256 across, an odd number of 91 to 151; the least
    for beads."""
    page.click("#tabs [data-tab=scan]")
    field = page.locator("#wish-frames")
    page.select_option("#wish-kind", "fly")
    field.press("Escape")
    counts = []
    twin.control("force")
    before = twin.state()
    for name, sod in (("gear", 350.0), ("lego", 450.0), ("lego", 900.0)):
        twin.set_sample(name)
        twin.move({"mag_obj": sod}, wait=True)
        state = twin.state()
        seen(page, twin)
        across_mm = page.evaluate("flexdt.store.across_mm")
        voxel_mm = state.geometry.voxel_size_mm * state.camera.shape[1] / 256
        steps = math.ceil(math.pi / 2 * across_mm / voxel_mm)
        counts.append(min(151, max(91, steps)) | 1)
        page.wait_for_function(
            "n => document.querySelector('#wish-frames').value === String(n)",
            arg=counts[-1],
        )
    assert len(set(counts)) > 1, counts
    field.fill("45")
    twin.move({"mag_obj": 350.0}, wait=True)
    seen(page, twin)
    assert field.input_value() == "45"
    field.press("Escape")
    page.select_option("#wish-kind", "calibration")
    page.wait_for_function("document.querySelector('#wish-frames').value === '91'")
    page.select_option("#wish-kind", "fly")
    twin.move({"mag_obj": before.axes["mag_obj"].position}, wait=True)
    twin.set_sample(before.sample.name)
    twin.control("release")


def test_gamma_brightens_what_is_thin_and_keeps_black_and_white(page: Any) -> None:
    def set_to(value: float) -> np.ndarray:
        page.locator("#gamma").evaluate(
            "(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", value
        )
        url = page.evaluate("flexdt.picture()")  # pixel by pixel, nothing drawn over it
        return np.asarray(
            Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2])))
        )[..., 0]

    page.wait_for_function("flexdt.store.image && flexdt.store.image.code === 'deflate'")
    plain, bright = set_to(1.0), set_to(2.0)
    np.testing.assert_allclose(bright, 255.0 * np.sqrt(plain / 255.0), atol=0.51)
    assert bright.mean() > plain.mean() + 1.0
    np.testing.assert_array_equal(set_to(1.0), plain)


def test_a_telephone_shows_the_tabs_at_once(open_page: Callable[..., Any]) -> None:
    page = open_page(size=(390, 844), fresh=True)
    box = page.locator("#tabs").bounding_box()
    assert box["y"] + box["height"] < 844
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.close()


@pytest.mark.parametrize("size", [(320, 568), (390, 844), (800, 600)])
def test_a_small_screen_shows_the_button_and_its_sample_beside_each_other(
    open_page: Callable[..., Any], size: tuple[int, int]
) -> None:
    page = open_page(size=size, fresh=True)
    page.locator("#scan-it").scroll_into_view_if_needed()
    boxes = [
        page.locator(name).bounding_box() for name in ("#scan-it", "#scan-it-sample")
    ]
    for k, a in enumerate(boxes):
        assert a["x"] >= 0.0
        assert a["x"] + a["width"] <= size[0]
        for b in boxes[k + 1 :]:
            beside = a["x"] + a["width"] <= b["x"] or b["x"] + b["width"] <= a["x"]
            assert beside or a["y"] + a["height"] <= b["y"]
    page.close()


@pytest.mark.parametrize("size", [(1280, 800), (1366, 768), (1440, 900), (1920, 1080)])
@pytest.mark.campaign(1)
def test_the_close_up_is_a_quarter_of_each_pane_and_the_bar_is_whole(
    open_page: Callable[..., Any], size: tuple[int, int]
) -> None:
    """Four fifths of it are the gear (`test_viewer_world.py`), a fifth of the pane's height."""
    page = open_page(view="iso", size=size, fresh=True)
    for views in ("Isometric", "Four views"):
        page.get_by_role("button", name=views, exact=True).click()
        for view in page.locator(".view:has(.inset)").all():
            pane, inset = view.bounding_box(), view.locator(".inset").bounding_box()
            if pane["width"] <= 240.0:  # it would hide what it is of
                assert inset is None
                continue
            assert inset["height"] > 0.25 * pane["height"]
            assert view.locator(".inset").is_visible()
    cut = page.locator("#bar > .pill, #view-switch").evaluate_all(
        "all => all.filter((e) => e.scrollWidth > e.clientWidth + 1).map((e) => e.id)"
    )
    assert cut == []
    page.close()


def test_the_sample_beside_scan_it_is_what_stands_on_the_stage(
    page: Any, twin: TwinClient
) -> None:
    """One quantity in two lists: whoever changes it, both say what the twin says."""
    shown = lambda: {  # noqa: E731
        page.input_value("#scan-it-sample"), page.input_value("#sample")
    }  # fmt: skip
    for name in ("square", "gear"):
        page.select_option("#scan-it-sample", name)
        until(lambda name=name: twin.state().sample.name == name, "it is put there")
        until(lambda name=name: shown() == {name}, "both lists say so")
    twin.control("force")
    twin.set_sample("small")
    until(lambda: shown() == {"small"}, "another's change")
    page.select_option("#scan-it-sample", "gear")
    page.locator("#notes", has_text="The sample stays").wait_for()
    until(lambda: shown() == {"small"}, "a refused choice goes back")
    assert twin.state().sample.name == "small"
    twin.control("release")


def test_a_plot_follows_the_width_of_its_column(page: Any) -> None:
    """Without a new image: the machine stands still meanwhile."""
    plot, drawn = page.locator("#histogram"), page.locator("#histogram .u-wrap")
    before = plot.bounding_box()["width"]
    until(lambda: drawn.bounding_box()["width"] == pytest.approx(before), "as wide")
    page.set_viewport_size({"width": 1700, "height": 800})
    until(lambda: plot.bounding_box()["width"] > 1.1 * before, "a wider column")
    after = plot.bounding_box()["width"]
    until(lambda: drawn.bounding_box()["width"] == pytest.approx(after), "as wide again")
    page.set_viewport_size({"width": 1280, "height": 800})


def test_what_is_typed_into_a_number_field_replaces_its_number(page: Any) -> None:
    page.click("#tabs [data-tab=scan]")
    field = page.locator("#wish-frames")
    field.fill("73")
    page.locator("#script").click()
    field.click()
    page.keyboard.type("13")
    assert field.input_value() == "13"
    field.click()
    page.keyboard.press("End")
    page.keyboard.type("7")
    assert field.input_value() == "137"
    field.fill("73")


def test_a_script_of_another_wish_is_called_so(page: Any) -> None:
    """A turn of 13 images without a stop is too fast: nothing is written, and the page says
    that the script beside the fields is another one."""
    page.click("#tabs [data-tab=scan]")
    page.select_option("#wish-kind", "fly")
    page.fill("#wish-frames", "73")
    page.click("#compose")
    page.locator("#report .verdict").wait_for()
    note = page.locator("#wish-note")
    assert not note.is_visible()
    page.fill("#wish-frames", "13")
    note.get_by_text("of 73 frames of").wait_for()
    page.click("#compose")
    note.get_by_text("step scan").wait_for()
    assert "Not written: 13 frames" in note.inner_text()
    assert "the one of before: it does not run" in note.inner_text()
    assert page.is_disabled("#run")
    page.select_option("#wish-kind", "step")
    page.click("#compose")
    note.wait_for(state="hidden")
    page.locator("#report", has_text="13 frames").wait_for()
    page.select_option("#wish-kind", "fly")
    page.fill("#wish-frames", "73")
    page.fill("#script", "")


@pytest.mark.campaign
def test_one_click_ends_with_a_volume_beside_its_truth(
    open_page: Callable[..., Any], twin: TwinClient
) -> None:
    """Of what stands on the stage, and nothing else is put there."""
    twin.control("force")
    twin.set_camera(mode="HW4SW1High")
    twin.set_sample("small-3")
    twin.control("release")
    page = open_page(fresh=True)
    page.wait_for_function(
        "document.querySelector('#scan-it-sample').value === 'small-3'"
    )
    assert page.locator("button.primary:visible", has_text="Scan").count() == 1
    page.click("#scan-it")
    page.locator("#volume-beside").wait_for(timeout=600_000)
    assert twin.state().sample.name == "small-3"
    top = page.locator("#slice-top")
    page.evaluate("flexdt.volume().three.go([0, 0, 20])")
    seen = {}
    for share in (0, 1000):
        page.evaluate(
            "v => { const s = document.querySelector('#volume-split'); s.value = v;"
            " s.dispatchEvent(new Event('input')); }",
            share,
        )
        page.wait_for_timeout(300)
        seen[share] = picture(top)
    noise = {share: float(np.abs(np.diff(one[8:40, 8:90, 0], axis=1)).mean())
             for share, one in seen.items()}  # fmt: skip
    assert noise[0] < 0.2 < noise[1000], "the truth has no noise in air, the scan has"
    # What is said of its volume ends where another one takes its place, or none.
    page.click("#scan-it")
    page.locator("#scan-it-note", has_text="Reconstructing the whole scan").wait_for()
    page.select_option("#volume-side", "")
    page.locator("#scan-it-note", has_text="One turn of").wait_for()
    page.close()


REFUSED = """
(all) => {
  const send = WebSocket.prototype.send;
  WebSocket.prototype.send = function (text) {
    const asked = JSON.parse(text);
    const compose = asked.method === 'viewer.compose';
    if (compose && (all || 'voxel_um' in asked.params)) asked.params.voxel_um = 0.02;
    send.call(this, JSON.stringify(asked));
  };
}
"""
"""Asks for a voxel that no place of the stage has: where one is asked for, or always."""


@pytest.mark.parametrize("all", [False, True])
def test_a_scan_that_is_not_as_it_should_be_says_why(
    open_page: Callable[..., Any], twin: TwinClient, all: bool
) -> None:
    jobs = len(twin.jobs().jobs)
    twin.control("force")
    twin.set_sample("small-3")
    twin.move({"mag_obj": 650.0}, wait=True)
    twin.control("release")
    page = open_page(fresh=True)
    page.wait_for_function("flexdt.store.state?.sample.name === 'small-3'")
    page.evaluate(REFUSED, all)
    page.click("#scan-it")
    title = "No scan" if all else "Scanned where it stands"
    note = page.locator(".note", has_text=title)
    note.wait_for()
    assert "outside [70, 996] mm" in note.inner_text()
    if not all:
        page.locator(".note", has_text="begins").wait_for()
        twin.control("force")
        twin.abort_job()
        twin.control("release")
    assert len(twin.jobs().jobs) == jobs + (not all)
    page.close()
