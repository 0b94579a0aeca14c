"""What people do to the page's fields and keys, mistakes included, and what comes of it."""

from __future__ import annotations

import base64
import io
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from looking import answered, point_at, released, seen
from PIL import Image

from flexdt.clients.client.client import TwinClient
from flexdt.twin.machine.description import builtin_machine

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]


@contextmanager
def motion(page: Any, twin: TwinClient, wait: Wait) -> Iterator[None]:
    """mag_obj on a way that takes minutes; back where it was afterwards."""
    start = twin.state().axes["mag_obj"].position
    page.evaluate("flexdt.call('clock.set', {speed_up: 0.05})")
    page.evaluate("v => flexdt.call('axes.move', {targets: {mag_obj: v}})", start - 200.0)
    wait(lambda: twin.state().axes["mag_obj"].moving)
    try:
        yield
    finally:
        page.evaluate("flexdt.call('safety.reset')")
        page.evaluate("flexdt.call('clock.set', {speed_up: 8})")
        page.evaluate("v => flexdt.call('axes.move', {targets: {mag_obj: v}})", start)
        wait(lambda: not twin.state().axes["mag_obj"].moving)
        wait(lambda: abs(twin.state().axes["mag_obj"].position - start) < 1e-6)


def number(page: Any, axis: str) -> Any:
    return page.locator(f'[aria-label="{axis} value"]')


@pytest.fixture
def asked(page: Any) -> Iterator[Callable[[], list[str]]]:
    """The methods that the page has asked for so far."""
    page.evaluate(
        "(() => { const send = WebSocket.prototype.send; window.asked = []; "
        "WebSocket.prototype.send = function (t) { const { method } = JSON.parse(t); "
        "if (method) window.asked.push(method); "
        "send.call(this, t); }; window.unspy = () => { WebSocket.prototype.send = send; }; })()"
    )
    yield lambda: list(page.evaluate("window.asked"))
    page.evaluate("window.unspy()")


@pytest.fixture(autouse=True)
def on_move_tab(page: Any) -> None:
    page.click("#tabs [data-tab=move]")


@pytest.mark.parametrize("text", ["", "-", "fifty", "1.2.3", "12 5"])
def test_what_is_no_number_moves_nothing(
    page: Any, twin: TwinClient, asked: Callable[[], list[str]], text: str
) -> None:
    before = twin.state().axes["mag_obj"].position
    field = number(page, "mag_obj")
    field.fill(text)
    field.press("Enter")
    page.locator(".note.error", has_text=f"“{text}” is not a number").first.wait_for()
    assert field.input_value() == f"{before:.3f}"
    assert "axes.move" not in asked()
    assert twin.state().axes["mag_obj"].target == before


def test_a_decimal_comma_is_a_point(page: Any, twin: TwinClient, wait: Wait) -> None:
    field = number(page, "tra_obj")
    field.fill("")
    field.press_sequentially("12,5")
    field.press("Enter")
    wait(lambda: abs(twin.state().axes["tra_obj"].position - 12.5) < 1e-6)


@pytest.mark.parametrize("where", ["#theme", "#estop", "#take", "[data-jog='tra_obj:1']",
                                   "[aria-label='tra_obj slider']",
                                   "[aria-label='tra_obj value']"])  # fmt: skip
def test_space_stops_wherever_the_focus_is(
    page: Any, twin: TwinClient, wait: Wait, asked: Callable[[], list[str]], where: str
) -> None:
    with motion(page, twin, wait):
        page.focus(where)
        before = asked()
        page.keyboard.press("Space")
        wait(lambda: not twin.state().axes["mag_obj"].moving, "stopped")
        page.evaluate(
            "new Promise((done) => setTimeout(done))"
        )  # all that the key has set off
        assert asked()[len(before) :] == ["axes.stop"], "and nothing is pressed"
        assert page.evaluate("document.documentElement.dataset.theme") == "light"


@pytest.mark.parametrize("tab", ["move", "scan"])
def test_emergency_stop_by_key_while_typing(
    page: Any, twin: TwinClient, wait: Wait, tab: str
) -> None:
    page.click(f"#tabs [data-tab={tab}]")
    page.focus("#script" if tab == "scan" else "[aria-label='mag_obj value']")
    page.keyboard.press("Shift+Space")
    wait(lambda: twin.state().safety.estop)
    assert page.input_value("#script") == ""
    page.evaluate("flexdt.call('safety.reset')")


def test_space_ticks_a_box_and_stops_nothing(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    with motion(page, twin, wait):
        page.focus("#around")
        for on in (True, False):
            page.keyboard.press("Space")
            assert page.is_checked("#around") is on
        assert twin.state().axes["mag_obj"].moving


def test_enter_held_on_a_jog_button(page: Any, twin: TwinClient, wait: Wait) -> None:
    before = twin.state().axes["tra_obj"].position
    # A busy machine lets go late: by a slow clock the sample does not go far meanwhile.
    page.evaluate("flexdt.call('clock.set', {speed_up: 1})")
    seen(page, twin)
    page.focus("[data-jog='tra_obj:-1']")
    try:
        page.keyboard.down("Enter")
        wait(lambda: twin.state().axes["tra_obj"].position < before - 0.05)
        page.keyboard.up("Enter")
        wait(lambda: not twin.state().axes["tra_obj"].moving, "letting go stops")
        page.keyboard.down("Enter")
        wait(lambda: twin.state().axes["tra_obj"].moving)
        page.focus("#theme")
        wait(
            lambda: not twin.state().axes["tra_obj"].moving, "and so does going elsewhere"
        )
    finally:
        page.keyboard.up("Enter")
        page.evaluate("flexdt.call('clock.set', {speed_up: 8})")
        page.evaluate(
            "x => flexdt.call('axes.move', {targets: {tra_obj: x}, wait: true})", before
        )


def test_a_hurried_emergency_stop_does_not_reset_itself(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    page.locator("#estop").dblclick(delay=400)
    wait(lambda: twin.state().safety.estop)
    answered(page)
    seen(page, twin)
    released(page)
    wait(lambda: twin.state().safety.state == "ok")
    page.focus("#estop")
    page.keyboard.down("Enter")
    page.locator("#reset").wait_for()
    for _ in range(3):
        page.keyboard.down("Enter")  # as a key repeats that is held
    page.keyboard.up("Enter")
    answered(page)
    stopped = twin.state().safety.estop
    page.evaluate("flexdt.call('safety.reset')")
    assert stopped


@pytest.mark.parametrize("width", [360, 390, 700, 768, 800, 900, 1000, 1181, 1280])
def test_emergency_stop_is_in_view(page: Any, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 600})
    page.wait_for_function("width => innerWidth === width", arg=width)
    at = page.evaluate(
        "(() => { document.querySelector('#holder').textContent = 'held "
        "by a-rather-long-name-indeed'; const e = document.querySelector('#estop'), b "
        "= e.getBoundingClientRect(); const hit = (x, y) => document.elementFromPoint(x, y) === e; "
        "return [b.left, b.right, hit(b.left + 9, b.top + 9), hit(b.right - 9, b.bottom - 9)]; })()"
    )
    page.set_viewport_size({"width": 1280, "height": 800})
    assert at[0] > 0
    assert at[1] <= width
    assert at[2:] == [True, True]


def test_a_slider_under_anothers_control_stays(page: Any, twin: TwinClient) -> None:
    twin.control("force")
    try:
        page.locator("#move-down").wait_for()
        at = twin.state().axes["tra_obj"].position
        slider = page.locator("[aria-label='tra_obj slider']")
        slider.scroll_into_view_if_needed()
        box = slider.bounding_box()
        page.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + box["height"] / 2)
        answered(page)
        assert abs(float(slider.input_value()) - at) <= 0.051
        assert number(page, "tra_obj").input_value() == f"{at:.3f}"
        assert twin.state().axes["tra_obj"].target == at
    finally:
        twin.control("release")


def test_a_number_that_was_not_applied_goes_back(page: Any, twin: TwinClient) -> None:
    at = twin.state().axes["tra_obj"].position
    field = number(page, "tra_obj")
    field.fill("7")
    assert "typed" in field.get_attribute("class")
    field.press("Tab")
    assert field.input_value() == f"{at:.3f}"
    assert "typed" not in field.get_attribute("class")
    field.focus()
    field.press("ArrowUp")
    assert float(field.input_value()) == pytest.approx(at + 1.0, abs=1e-3)
    field.press("Escape")
    assert field.input_value() == f"{at:.3f}"
    assert twin.state().axes["tra_obj"].target == at


def test_a_turn_on_the_slider(page: Any, twin: TwinClient, wait: Wait) -> None:
    slider, field = page.locator("[aria-label='rot_obj slider']"), number(page, "rot_obj")
    field.fill("725")
    field.press("Enter")
    wait(lambda: abs(twin.state().axes["rot_obj"].position - 725.0) < 1e-6, "all turns")
    wait(lambda: slider.get_attribute("min") == "540")
    assert slider.get_attribute("max") == "900"
    field.fill("0")
    field.press("Enter")
    wait(lambda: abs(twin.state().axes["rot_obj"].position) < 1e-6, "back")
    wait(lambda: slider.get_attribute("min") == "-180")


def test_what_the_tube_refuses_goes_back(page: Any, twin: TwinClient, wait: Wait) -> None:
    page.click("#tabs [data-tab=setup]")
    before = twin.state().tube.kV
    page.fill("#kV", "5000")
    assert "typed" in page.get_attribute("#kV", "class")
    page.press("#kV", "Enter")
    page.locator(".note.error", has_text="The tube refuses").first.wait_for()
    wait(lambda: float(page.input_value("#kV")) == before, "back")
    assert "typed" not in page.get_attribute("#kV", "class")
    panel = builtin_machine("flexray").detector
    page.fill("#exposure", "-3")
    page.press("#exposure", "Enter")
    least, most = panel.min_exposure_ms, panel.max_exposure_ms
    said = f"exposure -3 ms is outside {least:g} to {most:g} ms"
    page.locator(".note.error", has_text=said).first.wait_for()
    page.fill("#kV", "61,5")
    page.press("#kV", "Escape")
    assert float(page.input_value("#kV")) == before
    page.fill("#kV", "61,5")
    page.press("#kV", "Enter")
    wait(lambda: twin.state().tube.kV == 61.5)
    wait(lambda: "typed" not in page.get_attribute("#kV", "class"))
    page.evaluate("kV => flexdt.call('tube.set', {kV})", before)
    wait(lambda: twin.state().tube.kV == before)


def test_an_empty_edge_of_the_region_is_not_0(
    page: Any, twin: TwinClient, asked: Callable[[], list[str]]
) -> None:
    page.click("#tabs [data-tab=setup]")
    left = twin.state().camera.roi[0]
    page.fill("#roi-l", "")
    page.press("#roi-l", "Enter")
    page.locator(".note.error", has_text="left edge").first.wait_for()
    assert page.input_value("#roi-l") == str(left)
    assert "camera.set" not in asked()


def test_a_refused_sample_goes_back(page: Any, twin: TwinClient, wait: Wait) -> None:
    page.click("#tabs [data-tab=setup]")
    before = twin.state().sample.name
    page.wait_for_function("document.querySelector('#sample').options.length > 3")
    twin.control("force")
    try:
        page.select_option("#sample", "normal")
        assert "typed" in page.get_attribute("#sample", "class")
        page.click("#sample-apply")
        page.locator(".note.error", has_text="The sample stays").first.wait_for()
        wait(lambda: page.input_value("#sample") == before)
    finally:
        twin.control("release")


def test_what_another_does_shows_in_fields_that_nobody_types_in(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    page.click("#tabs [data-tab=setup]")
    before = twin.state().camera.exposure_ms
    page.fill("#averages", "4")
    page.evaluate("v => flexdt.call('camera.set', {exposure_ms: v})", before + 11.0)
    wait(lambda: float(page.input_value("#exposure")) == before + 11.0)
    assert page.input_value("#averages") == "4"
    assert f"the twin has {twin.state().camera.averages}" in page.get_attribute(
        "#averages", "title"
    )
    assert "typed" in page.get_attribute("#averages", "class")
    page.press("#averages", "Escape")
    assert page.input_value("#averages") == str(twin.state().camera.averages)
    page.evaluate("v => flexdt.call('camera.set', {exposure_ms: v})", before)


def test_an_empty_mesh_is_refused(
    page: Any, twin: TwinClient, tmp_path: Path, asked: Callable[[], list[str]]
) -> None:
    page.click("#tabs [data-tab=setup]")
    before = twin.state().sample.name
    path = tmp_path / "normal.stl"
    path.write_bytes(b"")
    page.set_input_files("#mesh-file", path)
    page.click("#mesh-upload")
    page.locator(".note.error", has_text="normal.stl is empty").first.wait_for()
    assert "sample.set" not in asked()
    assert page.inner_text("#mesh-note") == ""
    assert twin.state().sample.name == before


def test_clock_and_rates_at_rest(page: Any, twin: TwinClient, wait: Wait) -> None:
    shown = lambda: float(page.inner_text("#clock").split()[2])  # noqa: E731
    page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 5}, wait: true})")
    wait(lambda: not twin.state().axes["rot_obj"].moving)
    seen(page, twin)
    first = shown()
    wait(lambda: shown() > first + 16.0, "the clock goes on at 8 times the pace")
    assert shown() <= twin.state().clock.time_s + 0.1
    # Achieved, over the last seconds; a pause between two looks at the clock is in it for a
    # while.
    wait(lambda: page.inner_text("#clock").endswith(("8.00×", "8×")), "its pace")
    wait(lambda: page.inner_text("#film-rate") == "", "no images, no rate")
    page.evaluate("flexdt.call('clock.set', {speed_up: 'max'})")
    wait(lambda: page.inner_text("#clock").endswith(("max", "0.00×")), "it stands still")
    page.evaluate("flexdt.call('clock.set', {speed_up: 8})")


def test_the_value_under_a_resting_pointer(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    before = twin.state().sample.name
    page.evaluate("flexdt.call('sample.set', {name: 'normal'})")
    wait(lambda: twin.state().sample.name == "normal")
    image = np.asarray(twin.projection().image)
    row, column = np.unravel_index(image.argmax(), image.shape)
    assert image[row, column] > 0.1
    share = (column + 0.5) / image.shape[1], (row + 0.5) / image.shape[0]
    attenuation = lambda: (page.inner_text("#pixel").split() + ["", "", ""])[2]  # noqa: E731

    def on_the_shadow() -> bool:
        point_at(page, *share)
        return attenuation() not in ("", "0.000", "image")

    wait(on_the_shadow, "the sample's shadow")
    page.evaluate("flexdt.call('sample.set', {name: 'empty'})")
    wait(lambda: attenuation() == "0.000", "nothing is left there")
    page.evaluate("name => flexdt.call('sample.set', {name})", before)
    wait(lambda: twin.state().sample.name == before)
    page.mouse.move(1, 1)


@pytest.mark.parametrize("roi", [(32, 8, 231, 1527), (32, 8, 1943, 127)])
def test_a_slim_or_flat_region_keeps_the_film_in_bounds(
    page: Any, twin: TwinClient, wait: Wait, roi: tuple[int, ...]
) -> None:
    before = twin.state().camera.roi
    page.evaluate("roi => flexdt.call('camera.set', {roi})", list(roi))
    full = [(roi[3] - roi[1] + 1) // 2, (roi[2] - roi[0] + 1) // 2]
    page.wait_for_function("f => flexdt.store.image.full.join() === f.join()", arg=full)
    try:
        wait(lambda: 80 < page.locator("#film").bounding_box()["height"] < 480)
        middle = f"({full[1] // 2}, {full[0] // 2})"

        def says(text: str, *place: float) -> bool:
            point_at(page, *place)
            return bool(page.inner_text("#pixel").startswith(text))

        wait(lambda: says(middle, 0.5, 0.5), middle)
        wait(
            lambda: says("–", 0.0, 0.0, 4.0), "outside the image"
        )  # within its round corner
    finally:
        page.mouse.move(1, 1)
        page.evaluate("roi => flexdt.call('camera.set', {roi})", list(before))
        full = [(before[3] - before[1] + 1) // 2, (before[2] - before[0] + 1) // 2]
        page.wait_for_function(
            "f => flexdt.store.image.full.join() === f.join()", arg=full
        )


def test_zoom_to_pixels_and_a_window_in_order(page: Any, wait: Wait) -> None:
    page.click("#film-actual")

    def forty_aside() -> bool:
        columns = []
        for aside in (100.5, 140.5):
            point_at(page, 0.0, 0.0, aside)
            text = page.inner_text("#pixel")
            columns.append(int(text[1 : text.index(",")]) if text.startswith("(") else 0)
        return columns[1] - columns[0] == 40

    wait(forty_aside, "a pixel of the image is one of the screen")
    page.click("#film-reset")
    page.locator("#film-note", has_text="window").wait_for()
    wait(lambda: page.inner_text("#film-note").count("×") == 1, "the whole image again")
    page.locator("#high").fill("300")
    page.locator("#low").fill("900")
    assert page.input_value("#low") == "299"
    page.check("#auto-window")
    page.mouse.move(1, 1)


def test_the_picture_has_every_pixel_and_nothing_over_it(
    page: Any, twin: TwinClient
) -> None:
    shape = list(np.asarray(twin.projection().image).shape)
    page.wait_for_function(
        "s => flexdt.store.image?.shape.join() === s.join()", arg=shape
    )
    assert page.is_checked("#show-beads")
    content = base64.b64decode(page.evaluate("flexdt.picture()").split(",")[1])
    saved = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), dtype=int)
    assert list(saved.shape[:2]) == shape
    assert (saved.max(axis=2) == saved.min(axis=2)).all(), "grey alone"
    assert saved.std() > 2.0


def test_every_control_has_a_name_and_tabs_go_by_arrow(page: Any) -> None:
    nameless = page.evaluate(
        "[...document.querySelectorAll('#bar, #tab-move, #tab-setup, #right')].flatMap((box) =>"
        " [...box.querySelectorAll('input:not([hidden]), select, textarea, button')])"
        ".filter((e) => !e.labels?.length && !e.getAttribute('aria-label')"
        " && !e.textContent.trim()).map((e) => e.id || e.outerHTML)"
    )
    lists = page.evaluate(
        "[...document.querySelectorAll('#tab-move select, #tab-setup select, #right select')]"
        ".filter((e) => !e.labels.length && !e.getAttribute('aria-label')).map((e) => e.id)"
    )
    assert nameless == lists == []
    page.focus("#tabs [data-tab=move]")
    for key, shown in (("ArrowRight", "setup"), ("End", "share"), ("ArrowRight", "move")):
        page.keyboard.press(key)
        assert page.locator(f"#tab-{shown}").is_visible()
        assert page.evaluate("document.activeElement.dataset.tab") == shown
        assert (
            page.get_attribute("#tabs [aria-selected=true]", "aria-controls")
            == f"tab-{shown}"
        )
    assert page.locator("#tabs [tabindex='0']").count() == 1


def test_a_page_too_many_is_told_why_and_comes_in_when_there_is_room(
    chromium: Any, lab: Any
) -> None:
    viewer = lab.another_viewer("--limit", "max_pages=1")
    pages = [chromium.new_page() for _ in range(2)]
    try:
        for page in pages:
            page.set_default_timeout(120_000)
            page.goto(f"{viewer.ready['url']}?view=none")
            if page is pages[0]:
                page.locator("#connection", has_text="connected").wait_for()
        pages[1].locator("#veil", has_text="1 pages at most").wait_for()
        pages[0].close()
        pages[1].locator("#connection", has_text="connected").wait_for()
        pages[1].locator("#veil").wait_for(state="hidden")
    finally:
        for page in pages:
            page.close()
        viewer.stop()


def test_a_page_without_its_viewer_says_so(
    open_page: Callable[..., Any], lab: Any, wait: Wait
) -> None:
    alone = open_page()
    lab.viewer.stop(signal.SIGKILL)
    try:
        alone.locator("#veil", has_text="The viewer is away").wait_for()
        assert alone.inner_text("#holder") == "control unknown"
        assert alone.is_disabled("#take")
    finally:
        lab.restart_viewer()
    alone.locator("#connection", has_text="connected").wait_for()
    assert alone.is_enabled("#take")
    alone.close()


def test_no_quantity_has_two_fields(page: Any) -> None:
    fields = page.evaluate(
        "[...document.querySelectorAll(':is(#tab-scan, "
        "#tab-setup) :is(input, select, textarea)')].map((e) => [e.id, e.dataset.quantity ?? "
        "(e.dataset.layer && `layer.${e.dataset.layer}`)])"
    )
    assert [id for id, quantity in fields if not quantity] == []
    quantities = [quantity for _, quantity in fields]
    assert sorted({q for q in quantities if quantities.count(q) > 1}) == []
    assert {"scan.frames", "scan.exposure_ms", "scan.kV", "scan.voxel_um"} <= set(
        quantities
    )


SENT = """
window.sent = [];
const send = WebSocket.prototype.send;
WebSocket.prototype.send = function (data) {
  if (typeof data === 'string' && data.includes('"method"')) window.sent.push(JSON.parse(data));
  return send.call(this, data);
};
"""


def test_designer_and_script_wish_the_same_scan(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    """Whatever the camera is set to: one quantity in two fields was two scans."""
    page.evaluate(f"(() => {{ {SENT} }})()")
    page.click("#tabs [data-tab=scan]")
    page.fill("#script", "")
    page.evaluate("flexdt.call('sample.set', {name: 'lego'}).then(() => null)")
    page.click("#designer summary")
    newest = "name => window.sent.filter((r) => r.method === name).at(-1)?.params"
    for ms, frames, typed in ((150, 19, None), (400, 9, None), (400, 12, 80)):
        page.evaluate(
            "ms => flexdt.call('camera.set', {exposure_ms: ms}).then(() => null)", ms
        )
        seen(page, twin)
        if typed is not None:
            page.fill("#wish-exposure", str(typed))
        page.fill("#wish-frames", str(frames))
        page.click("#compose")
        wanted = {"frames": frames, "exposure_ms": typed or ms}
        for name in ("viewer.compose", "exposure.predict"):
            asked = lambda n=name: page.evaluate(newest, n) or {}  # noqa: E731
            wait(lambda a=asked, w=wanted: a() | w == a(), f"{name} of {wanted}")
        predicted, composed = (
            page.evaluate(newest, name) for name in ("exposure.predict", "viewer.compose")
        )
        for key in ("kind", "kV", "power_W"):
            assert predicted[key] == composed[key]
    page.press("#wish-exposure", "Escape")
    wait(lambda: page.input_value("#wish-exposure") == "400", "the camera's again")
    page.click("#designer summary")
    page.fill("#script", "")
    page.evaluate("flexdt.call('camera.set', {exposure_ms: 100}).then(() => null)")
