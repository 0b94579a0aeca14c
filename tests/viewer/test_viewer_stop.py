"""E-STOP and RESET in a browser: the one never changes, the other releases what is shown."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any

import pytest
from looking import answered, released, seen

from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
INTO = "flexdt.call('axes.move', {targets: {mag_det: 300}}).then(() => null, () => null)"
WATCH = """
() => {
  const reset = document.querySelector('#reset');
  window.armed = {};
  const look = () => {
    const stop = flexdt.store.state.safety.stop;
    if (reset.hidden) return;
    const times = window.armed[stop] ??= { seen: performance.now() };
    if (!reset.disabled) times.armed ??= performance.now();
  };
  new MutationObserver(look).observe(reset, { attributes: true });
}
"""
"""Notes when RESET is seen for each stop and when it can first be pressed [ms], as it happens: a
clock of the test's own would look late where the page is busy."""


def blocked(page: Any, twin: TwinClient, wait: Wait) -> None:
    page.evaluate(
        "flexdt.call('axes.move', {targets: {mag_det: 1000}, plan: true, wait: true})"
    )
    page.evaluate("flexdt.call('tube.set', {on: true})")
    for _ in range(3):
        page.evaluate(INTO)
    wait(lambda: twin.state().safety.state == "aborted")
    page.locator("#reset").wait_for()


def free(page: Any) -> None:
    page.evaluate("flexdt.call('axes.move', {targets: {mag_det: 1000}, wait: true})")


def the_button(page: Any) -> tuple[Any, str, str]:
    """Place, word and colour of E-STOP, which the pointer reaches in its middle."""
    button = page.locator("#estop")
    box = button.bounding_box()
    middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
    hit = "([x, y]) => document.elementFromPoint(x, y)?.id"
    assert page.evaluate(hit, middle) == "estop"
    return (
        box,
        button.inner_text(),
        button.evaluate("e => getComputedStyle(e).backgroundColor"),
    )


@pytest.mark.parametrize("size", [(1366, 768), (1000, 700), (800, 600), (360, 640)])
@pytest.mark.campaign(1)
def test_the_emergency_stop_never_changes(
    open_page: Callable[..., Any],
    lab: Any,
    twin: TwinClient,
    wait: Wait,
    size: tuple[int, int],
) -> None:
    page = open_page(size=size)
    always = the_button(page)
    assert always[1] == "E-STOP"
    asked = "m => { window.asked = []; const send = WebSocket.prototype.send; WebSocket.prototype"
    page.evaluate(
        f"{asked}.send = function (s) {{ const m = JSON.parse(s).method;"
        " if (m?.startsWith('safety.')) window.asked.push(m); return send.call(this, s); } }"
    )

    def pressed() -> None:
        """Nothing of it has changed, and each press and the key mean one thing."""
        assert the_button(page) == always
        page.evaluate("window.asked = []")
        page.locator("#estop").dblclick()
        page.keyboard.press("Shift+Space")
        assert page.evaluate("window.asked") == ["safety.estop"] * 3
        assert the_button(page) == always

    def everywhere() -> None:
        for tab in page.locator("#tabs [role=tab]").all():
            tab.evaluate("e => e.click()")
            page.evaluate("scrollTo(0, 0)")
            assert the_button(page) == always

    everywhere()
    pressed()
    wait(lambda: twin.state().safety.estop)
    page.locator("#reset").wait_for()
    everywhere()
    pressed()
    answered(page)
    seen(page, twin)  # a stop that comes later takes the question away
    page.click("#reset")
    assert the_button(page) == always
    page.click("#reset-no")
    page.locator("#reset-dialog").wait_for(state="hidden")
    assert twin.state().safety.estop
    released(page)
    blocked(page, twin, wait)
    everywhere()
    pressed()
    wait(lambda: twin.state().safety.estop)
    seen(page, twin)  # the reset of the block that it has shown so far would be refused
    released(page)
    free(page)
    lab.twin.stop(signal.SIGKILL)
    page.locator("#veil-title", has_text="The twin is away").wait_for()
    everywhere()
    pressed()
    page.locator("#veil-title", has_text="E-stop not confirmed").wait_for()
    assert the_button(page) == always
    lab.restart_twin()
    page.close()


def test_a_reset_is_armed_after_a_second_asks_and_names_who_stopped(
    open_page: Callable[..., Any], twin: TwinClient, wait: Wait
) -> None:
    a, b = open_page(), open_page()
    who = b.evaluate("flexdt.store.session")
    assert not a.is_visible("#reset")
    a.evaluate(WATCH)
    b.click("#estop")
    a.click("#reset")
    dialog = a.locator("#reset-dialog")
    named = who.rpartition(" #")[0]  # the number of a session is no person
    assert f"Emergency stop by {named}: " in dialog.inner_text()
    assert "X-rays are off and stay off" in dialog.inner_text()
    first = twin.state().safety
    assert (first.estop, first.stopped_by) == (True, who)
    b.click("#estop")  # another stop, while A has the question before it
    dialog.wait_for(state="hidden")
    wait(lambda: a.is_enabled("#reset"), "armed again")
    assert twin.state().safety.estop
    code = "n => flexdt.call('safety.reset', {stop: n}).then(() => 0, (e) => e.code)"
    assert a.evaluate(code, first.stop) == -32003
    assert twin.state().safety.estop
    released(a)
    times = a.evaluate("window.armed")
    assert set(times) == {str(first.stop), str(first.stop + 1)}
    assert min(t["armed"] - t["seen"] for t in times.values()) > 950.0
    assert twin.state().safety.state == "ok"
    assert not b.is_visible("#reset-dialog")
    for page in (a, b):
        page.close()


def test_blocked_with_x_rays_on_offers_to_switch_them_off(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    blocked(page, twin, wait)
    page.click("#reset")
    text = page.inner_text("#reset-dialog")
    assert "Blocked: motion was blocked 3 times in a row" in text
    assert "X-rays are on and stay on" in text
    page.click("#reset-yes")
    wait(lambda: twin.state().safety.state == "ok")
    assert twin.state().tube.on, "a reset leaves the tube as it is"
    blocked(page, twin, wait)
    page.click("#xrays-off")
    wait(lambda: not twin.state().tube.on)
    page.locator("#xrays-off").wait_for(state="hidden")
    released(page)
    free(page)
