"""No statement of the page contradicts the wire, over drawn histories of two people, kills, and
changes of sample, tube, camera and correction.

`CAMPAIGNS=tests/viewer/test_page_statements.py make campaigns` runs 500 histories; `make page`
runs one, and the rare moments.
"""

from __future__ import annotations

import random
import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from lab import fly_script
from looking import until
from page_statements import (
    UNENDED,
    Checked,
    asked,
    begun_with,
    contradictions,
    of_old_picture,
    pictured_of,
)

from flexdt.clients.client.client import TwinClient
from flexdt.protocol import RpcError
from tests.viewer.conftest import Lab, Process, at_rest

pytestmark = pytest.mark.browser
SEEDS = 500
ACTIONS = 8
SMALL: dict[str, Any] = {"mode": "HW4SW1High", "roi": (700, 500, 1212, 1012)}
"""A camera whose images cost little."""
NO_SCRIPT = """
() => {
  const script = document.querySelector('#script');
  script.value = '';
  script.dispatchEvent(new Event('input'));
}
"""
"""Empties the script, whichever tab is shown."""
SAMPLES = ("gear", "lego", "square", "empty", "normal")


class History:
    """A page, another person, and the servers."""

    def __init__(self, lab: Lab, page: Any, seed: int) -> None:
        self.lab, self.page, self.rng = lab, page, random.Random(seed)
        self.checked, self.projector = Checked(), True
        self.pictured: tuple[object, object] | None = None
        """What the newest image shows, by the wire."""
        self.told: list[str] = []

    def call(self, method: str, **params: object) -> Any:
        """As the page's person; a refusal is an answer, too."""
        ask = "([m, p]) => flexdt.call(m, p).then((a) => a, (e) => ({ refused: e.message }))"
        return self.page.evaluate(ask, [method, params])

    def other(self) -> TwinClient:
        return TwinClient(
            port=self.lab.twin.port, name="Bert", wait_s=60.0, timeout_s=120.0
        )

    def act(self) -> None:
        """One thing that somebody does, or that happens."""
        acts = [
            self.change_sample, self.change_sample, self.switch, self.set_camera, self.move,
            self.correct, self.scan, self.end_scan, self.check, self.open_data, self.kill_twin,
            self.kill_projector, self.hang_projector,
        ]  # fmt: skip
        act = self.rng.choice(acts)
        self.told.append(act.__name__)
        act()

    def either(
        self, method: str, params: dict[str, Any], theirs: Callable[[TwinClient], Any]
    ) -> None:
        """One of the two people does it; whoever is refused leaves it."""
        if self.rng.random() < 0.5:
            self.call("session.control", action="force")
            self.call(method, **params)
            return
        with self.other() as bert:
            try:
                bert.control("force")
                theirs(bert)
            except RpcError as error:
                self.told.append(f"refused: {error.message[:60]}")

    def change_sample(self) -> None:
        name = self.rng.choice(SAMPLES)
        self.either("sample.set", {"name": name}, lambda bert: bert.set_sample(name))

    def switch(self) -> None:
        on, kV = self.rng.random() < 0.5, self.rng.choice((60.0, 80.0, 90.0))
        self.either(
            "tube.set", {"on": on, "kV": kV}, lambda bert: bert.set_tube(on=on, kV=kV)
        )

    def set_camera(self) -> None:
        ms = self.rng.choice((50.0, 100.0, 150.0))
        self.either(
            "camera.set",
            {"exposure_ms": ms},
            lambda bert: bert.set_camera(exposure_ms=ms),
        )

    def move(self) -> None:
        to = {
            "rot_obj": float(self.rng.randint(-90, 90)),
            "mag_obj": float(self.rng.randint(450, 650)),
        }
        self.either("axes.move", {"targets": to}, lambda bert: bert.move(to))

    def correct(self) -> None:
        by = {"dD_x": self.rng.choice((0.1, 0.2))}
        if self.rng.random() < 0.4:
            self.either("calibration.revert", {}, lambda bert: bert.revert_calibration())
        else:
            apply = lambda bert: bert.apply_calibration(by)  # noqa: E731
            self.either("calibration.apply", {"parameters": by}, apply)

    def scan(self) -> None:
        text = fly_script(frames=self.rng.choice((9, 60)))
        speed = self.rng.choice(("max", 10.0))
        submit = lambda bert: bert.submit_script(text, None, speed)  # noqa: E731
        self.either("script.submit", {"text": text, "speed_up": speed}, submit)
        if self.rng.random() < 0.5:
            with self.other() as bert:
                until(
                    lambda: bert.jobs().jobs[-1].state not in UNENDED,
                    "the scan ends",
                    300,
                )

    def end_scan(self) -> None:
        self.either("job.abort", {}, lambda bert: bert.abort_job())

    def check(self) -> None:
        with self.other() as bert:
            self.rest(bert)
        self.page.click("#tabs [data-tab=scan]")
        self.page.fill("#script", fly_script(frames=5))
        self.page.click("#check")
        self.page.locator("#report .verdict").wait_for()
        with self.other() as bert:
            self.checked = Checked(begun_with(bert.state()), True)

    def open_data(self) -> None:
        names = self.call("viewer.datasets").get("datasets", [])
        chosen = self.rng.choice([None, *(d["name"] for d in names if d["present"])])
        self.page.evaluate("name => flexdt.data.open(name).then(() => null)", chosen)

    def kill_twin(self) -> None:
        self.lab.restart_twin()
        self.checked = Checked()
        self.page.evaluate(NO_SCRIPT)

    def kill_projector(self) -> None:
        port = self.lab.projector.port
        self.lab.projector.stop(signal.SIGKILL)
        self.projector = False
        self.without_images()
        words = ("--port", str(port), "--threads", "1")
        self.lab.projector = Process(
            "flexdt.server.projector.main", *words, log=self.lab.log
        )
        self.projector = True

    def hang_projector(self, *acts: Callable[[], Any]) -> None:
        process = self.lab.projector.process
        process.send_signal(signal.SIGSTOP)
        self.projector = False
        try:
            self.without_images(*acts)
        finally:
            process.send_signal(signal.SIGCONT)
        self.projector = True

    def without_images(self, *acts: Callable[[], Any]) -> None:
        """What somebody does while no image can be made; drawn where nothing is given."""
        drawn = self.rng.sample([self.change_sample, self.move, self.switch], 2)
        for act in acts or drawn:
            self.told.append(getattr(act, "__name__", "act"))
            act()
            self.agree()

    def rest(self, twin: TwinClient) -> None:
        """Until no scan runs and nothing moves; one that is paused stays so."""
        until(lambda: twin.jobs().jobs[-1:] == [] or not running(twin), "the scan", 300)
        until(lambda: at_rest(twin), "the motors rest")

    def agree(self) -> None:
        """The page says what the wire says; asked again while either changes."""
        with self.other() as bert:
            if self.projector:
                self.rest(bert)
            else:
                until(lambda: at_rest(bert), "the motors rest")
            last: list[str] = []

            def agreed() -> bool:
                now = asked(bert, self.projector)
                found = contradictions(self.page, now, self.projector, self.checked)
                if self.projector and now.image is not None:
                    self.pictured = pictured_of(now.state)
                elif not self.projector and self.pictured is not None:
                    found += of_old_picture(self.page, self.pictured, now.state)
                last[:] = found
                return not found

            try:
                until(agreed, "the page agrees with the wire", 60)
            except AssertionError:
                raise AssertionError(f"after {self.told}: {last}") from None


def running(twin: TwinClient) -> bool:
    return any(job.state in ("queued", "running") for job in twin.jobs().jobs)


@pytest.fixture
def small(lab: Lab, twin: TwinClient) -> Iterator[None]:
    twin.control("force")
    twin.set_camera(**SMALL)
    twin.control("release")
    yield
    if lab.projector.process.poll() is not None:
        words = ("--port", str(lab.projector.port), "--threads", "1")
        lab.projector = Process("flexdt.server.projector.main", *words, log=lab.log)


@pytest.mark.slow
@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(SEEDS))
def test_no_statement_of_the_page_contradicts_the_wire(
    page: Any, lab: Lab, small: None, seed: int
) -> None:
    history = History(lab, page, seed)
    history.agree()
    for _ in range(ACTIONS):
        history.act()
        history.agree()
    page.evaluate("flexdt.data.open(null)")
    page.evaluate(NO_SCRIPT)


@pytest.mark.slow
@pytest.mark.campaign
def test_an_abort_of_somebody_else_and_a_hung_projector(
    page: Any, lab: Lab, small: None, twin: TwinClient
) -> None:
    history = History(lab, page, 1)
    with history.other() as bert:
        bert.control("force")
        bert.submit_script(fly_script(frames=600), None, 1.0)
        until(lambda: bert.job_status().frames_done > 0, "a first image")
        bert.abort_job()
        until(lambda: not running(bert), "its end")
    history.agree()
    assert "Bert" in page.inner_text("#job-state")
    assert page.locator("#job-back").is_visible()
    page.click("#job-back")
    history.agree()
    assert not page.locator("#job-back").is_visible()
    assert "everything stands where it began" in page.inner_text("#job-what")
    history.call("session.control", action="force")
    history.call("sample.set", name="lego")
    history.agree()
    history.hang_projector(
        lambda: history.call("sample.set", name="square"), history.move
    )
    history.agree()
