"""What makes the machine quiet is kept until the twin has answered it, connection or not."""

from __future__ import annotations

import signal
from typing import Any

import pytest
from looking import until

from flexdt.clients import TwinClient

pytestmark = pytest.mark.browser


@pytest.fixture(autouse=True)
def released(twin: TwinClient) -> Any:
    yield
    twin.control("force")
    twin.reset()
    twin.control("release")


@pytest.mark.parametrize("number", range(4))
def test_estop_reaches_the_twin_right_after_a_name_was_typed(
    page: Any, twin: TwinClient, number: int
) -> None:
    """The field changes by the very press; at first that closed the connection."""
    page.fill("#person", f"Ada {number}")
    page.click("#estop")
    until(lambda: twin.state().safety.estop, "the emergency stop")
    until(
        lambda: f"Ada {number} #" in (page.evaluate("flexdt.store.session") or ""),
        "the name",
    )


STANDS_STILL = """
async () => {
  const until = (ms) => { const end = performance.now() + ms; while (performance.now() < end); };
  const said = [];
  const notes = document.querySelector('#notes');
  const look = () => said.push(...[...notes.querySelectorAll('.error')].map((n) => n.innerText));
  new MutationObserver(look).observe(notes, { childList: true });
  until(700);
  document.querySelector('#estop').click();
  until(3500);
  await new Promise((done) => setTimeout(done, 2500));
  return said;
}
"""
"""A state waits unread when the button is pressed, and the answer for as long; what errors say."""


def test_a_page_that_stands_still_never_says_that_a_stop_came_to_nothing(
    page: Any, twin: TwinClient
) -> None:
    assert not twin.state().safety.estop
    said = page.evaluate(STANDS_STILL)
    page.locator("#emergency").wait_for()
    assert twin.state().safety.estop
    assert said == []


def test_control_stays_with_who_takes_another_name(page: Any, twin: TwinClient) -> None:
    page.fill("#person", "Emmy")
    page.click("#take")
    until(lambda: (twin.state().controller or "").startswith("Emmy #"), "control")
    page.fill("#person", "Noether")
    page.press("#person", "Enter")
    until(lambda: (twin.state().controller or "").startswith("Noether #"), "control")
    page.evaluate("flexdt.call('session.control', {action: 'release'})")


PRESSES = {
    "E-STOP": ("#estop", lambda state: state.safety.estop),
    "Stop": (
        "#stop",
        lambda state: not any(axis.moving for axis in state.axes.values()),
    ),
}


@pytest.mark.parametrize("press", PRESSES)
@pytest.mark.parametrize("away", ["viewer", "twin"])
def test_a_press_while_a_server_is_away_is_sent_when_it_is_back(
    page: Any, lab: Any, twin: TwinClient, press: str, away: str
) -> None:
    """It is told in red meanwhile, with the words about the machine's own button."""
    button, holds = PRESSES[press]
    server = getattr(lab, away)
    server.stop(signal.SIGKILL)
    page.wait_for_function(f"!flexdt.store.{away}")
    page.evaluate(f"document.querySelector('{button}').click()")
    page.locator("#veil-title", has_text="not confirmed").wait_for()
    assert page.get_attribute("#veil", "data-urgent") == "true"
    assert "own emergency stop button" in page.inner_text("#veil-text")
    getattr(lab, f"restart_{away}")()
    page.wait_for_function("flexdt.store.session")
    with lab.client() as again:
        until(lambda: holds(again.state()), press)
    page.wait_for_function("document.querySelector('#veil').dataset.urgent === 'false'")
    page.locator(".note", has_text="is sent now").wait_for()
