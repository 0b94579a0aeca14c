"""What people do to the page's fields and keys, mistakes included, and what comes of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from flexdt.clients.client import TwinClient

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
        "(() => { const send = WebSocket.prototype.send; window.asked = [];"
        " WebSocket.prototype.send = function (t) { window.asked.push(JSON.parse(t).method);"
        " send.call(this, t); }; window.unspy = () => { WebSocket.prototype.send = send; }; })()"
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
        page.wait_for_timeout(100)
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


def test_space_ticks_a_box_and_stops_nothing(page: Any, twin: TwinClient, wait: Wait) -> None:
    with motion(page, twin, wait):
        page.focus("#around")
        for on in (True, False):
            page.keyboard.press("Space")
            assert page.is_checked("#around") is on
        assert twin.state().axes["mag_obj"].moving


def test_enter_held_on_a_jog_button(page: Any, twin: TwinClient, wait: Wait) -> None:
    before = twin.state().axes["tra_obj"].position
    page.focus("[data-jog='tra_obj:-1']")
    page.keyboard.down("Enter")
    wait(lambda: twin.state().axes["tra_obj"].position < before - 0.05)
    page.keyboard.up("Enter")
    wait(lambda: not twin.state().axes["tra_obj"].moving, "letting go stops")
    page.keyboard.down("Enter")
    wait(lambda: twin.state().axes["tra_obj"].moving)
    page.focus("#theme")
    wait(lambda: not twin.state().axes["tra_obj"].moving, "and so does going elsewhere")
    page.keyboard.up("Enter")


def test_a_hurried_emergency_stop_does_not_reset_itself(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    page.locator("#estop").dblclick(delay=400)
    wait(lambda: twin.state().safety.estop)
    page.locator("#estop", has_text="RESET").wait_for()
    page.click("#estop")
    wait(lambda: twin.state().safety.state == "ok")
    page.locator("#estop", has_text="E-STOP").wait_for()
    page.focus("#estop")
    page.keyboard.down("Enter")
    page.locator("#estop", has_text="RESET").wait_for()
    for _ in range(3):
        page.keyboard.down("Enter")  # as a key repeats that is held
    page.wait_for_timeout(300)
    page.keyboard.up("Enter")
    stopped = twin.state().safety.estop
    page.evaluate("flexdt.call('safety.reset')")
    assert stopped


@pytest.mark.parametrize("width", [700, 800, 900, 1000, 1181, 1280])
def test_emergency_stop_is_in_view(page: Any, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 600})
    page.evaluate(
        "document.querySelector('#holder').lastChild.data = 'held by a-rather-long-name-indeed'"
    )
    seen = page.evaluate(
        "(() => { const e = document.querySelector('#estop'), b = e.getBoundingClientRect();"
        " const hit = (x, y) => document.elementFromPoint(x, y) === e;"
        " return [b.left, b.right, hit(b.left + 9, b.top + 9), hit(b.right - 9, b.bottom - 9)];"
        " })()"
    )
    page.set_viewport_size({"width": 1280, "height": 800})
    assert seen[0] > 0
    assert seen[1] <= width
    assert seen[2:] == [True, True]


def test_a_refused_slider_goes_back(page: Any, twin: TwinClient, wait: Wait) -> None:
    twin.control("force")
    try:
        at = twin.state().axes["tra_obj"].position
        slider = page.locator("[aria-label='tra_obj slider']")
        box = slider.bounding_box()
        page.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + box["height"] / 2)
        page.locator(".note.error", has_text="tra_obj").first.wait_for()
        wait(lambda: abs(float(slider.input_value()) - at) <= 0.051)
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
    wait(lambda: abs(twin.state().axes["rot_obj"].position - 725.0) < 1e-6, "all turns", 60)
    wait(lambda: slider.get_attribute("min") == "540")
    assert slider.get_attribute("max") == "900"
    field.fill("0")
    field.press("Enter")
    wait(lambda: abs(twin.state().axes["rot_obj"].position) < 1e-6, "back", 60)
    wait(lambda: slider.get_attribute("min") == "-180")
