"""Real servers on free ports, a real browser, and plain helpers to look at both."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from browsers import CHROMIUM, FLAGS, kept_port, need_browser
from looking import KNOWN_HERE, USUAL, seen, until

from flexdt.clients.client.client import TwinClient
from flexdt.protocol.state_model import State

BUSY = ("running", "paused", "queued")
SPEED_UP = 8
"""Of the twin's clock, unless a test sets another for itself."""
PATIENCE_S = 100
"""How long the pages here wait for an answer: a machine that stands still fails no test."""
NOTES_STAY = """
const later = window.setTimeout;
window.setTimeout = (f, ms, ...more) => later(f, ms > 5000 ? 2 ** 31 - 1 : ms, ...more);
"""
"""Notes stay until the test ends: a slow machine may look for one later than people do."""
TOOLS_OPEN = """
if (!localStorage.getItem('flexdt-tools')) localStorage.setItem('flexdt-tools', 'open');
"""
"""As `KNOWN_HERE`, for window and tools of the radiograph."""
HARMLESS = ("ERR_FILE_NOT_FOUND", "favicon")


class Process:
    """A server process that says `ready` on standard output."""

    def __init__(self, module: str, *words: str, log: Path) -> None:
        self._log = log.open("ab")
        self.process = subprocess.Popen(
            [sys.executable, "-m", module, *words],
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, log.read_text(errors="replace")[-2000:]
        self.ready: dict[str, Any] = json.loads(line)

    @property
    def port(self) -> int:
        return int(self.ready["port"])

    def stop(self, number: int = signal.SIGTERM) -> None:
        if self.process.poll() is None:
            self.process.send_signal(number)
        self.process.wait(120)
        assert self.process.stdout is not None
        self.process.stdout.close()
        self._log.close()


class Lab:
    """Projector, twin and viewer; each may be ended and started again on its port."""

    def __init__(self, folder: Path, speed_up: str, sample: str = "lego") -> None:
        """Start the processes.

        Args:
            folder: for logs and data.
            speed_up: of the twin's clock.
            sample: on the stage at the first start; "" for the twin's own.
        """
        self.folder, self.log, self.module = folder, folder / "log", ""
        self.first: State | None = None
        """The twin's state before any test has touched it."""
        self.data = folder / "data"
        self.projector = Process(
            "flexdt.server.projector.main",
            "--port",
            str(kept_port()),
            "--threads",
            "1",
            log=self.log,
        )
        self.twin_words = (
            "--data", str(self.data), "--speed-up", speed_up,
            "--projector", f"127.0.0.1:{self.projector.port}",
        )  # fmt: skip
        first = ("--sample", sample) if sample else ()
        self.twin = Process(
            "flexdt.server.twin.main",
            "--port",
            str(kept_port()),
            *self.twin_words,
            *first,
            log=self.log,
        )
        self.viewer_words = (
            "--twin",
            f"127.0.0.1:{self.twin.port}",
            "--data",
            str(self.data),
        )
        self.viewer = Process(
            "flexdt.clients.viewer.main",
            "--port",
            str(kept_port()),
            *self.viewer_words,
            log=self.log,
        )

    @property
    def url(self) -> str:
        return str(self.viewer.ready["url"])

    def restart_twin(self) -> None:
        port = self.twin.port
        self.twin.stop(signal.SIGKILL)
        words = ("--port", str(port), *self.twin_words)
        self.twin = Process("flexdt.server.twin.main", *words, log=self.log)

    def restart_viewer(self) -> None:
        port = self.viewer.port
        self.viewer.stop(signal.SIGKILL)
        words = ("--port", str(port), *self.viewer_words)
        self.viewer = Process("flexdt.clients.viewer.main", *words, log=self.log)

    def another_viewer(self, *words: str) -> Process:
        """A second viewer of the same twin; its caller stops it."""
        words = ("--port", "0", *self.viewer_words, *words)
        return Process("flexdt.clients.viewer.main", *words, log=self.log)

    def client(self) -> TwinClient:
        return TwinClient(port=self.twin.port, wait_s=60.0, timeout_s=120.0)

    def stop(self) -> None:
        for process in (self.viewer, self.twin, self.projector):
            process.stop()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A page in a browser is waited for longer than anything else."""
    for item in items:
        if item.get_closest_marker("browser") is not None:
            item.add_marker(pytest.mark.timeout(900))


@pytest.fixture(scope="session")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    running = Lab(tmp_path_factory.mktemp("lab"), str(SPEED_UP))
    with running.client() as client:
        running.first = client.state()
    yield running
    running.stop()


@pytest.fixture
def twin(lab: Lab) -> Iterator[TwinClient]:
    """A bystander that looks at the twin's state."""
    with lab.client() as client:
        yield client


# Of a module, not the session: playwright keeps an event loop running, which others must not
# meet.
@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with need_browser()() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, headless=True, args=FLAGS
        )
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def console() -> list[str]:
    """What the module's pages have said as an error and no test has answered for yet."""
    return []


@pytest.fixture(autouse=True)
def no_errors_on_the_console(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    if "console" in request.fixturenames:
        said: list[str] = request.getfixturevalue("console")
        errors = said[:]
        said.clear()
        assert not errors


@pytest.fixture(scope="module")
def open_page(
    chromium: Any, lab: Lab, console: list[str]
) -> Iterator[Callable[..., Any]]:
    """Opens the viewer's page; whatever it says on the console as an error fails the test.

    Nobody is in control when a module's own fixtures begin: a page of the module before may
    have left just now.
    """
    made: list[Any] = []
    with lab.client() as client:
        client.control("force")
        client.control("release")

    def new(
        view: str = "none",
        size: tuple[int, int] = (1280, 800),
        notes_stay: bool = True,
        fresh: bool = False,
        script: str = "",
        **query: object,
    ) -> Any:
        page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
        page.set_default_timeout(120_000)
        page.on("pageerror", lambda error: console.append(str(error)))
        page.on("console", lambda m: console.append(m.text) if _matters(m) else None)
        if not fresh:
            page.add_init_script(KNOWN_HERE)
            page.add_init_script(TOOLS_OPEN)
        if script:
            page.add_init_script(script)
        if notes_stay:
            page.add_init_script(NOTES_STAY)
        given = {"view": view, "theme": "light", "patience": PATIENCE_S, **query}
        words = "&".join(f"{k}={v}" for k, v in given.items())
        page.goto(f"{lab.url}?{words}")
        page.wait_for_function(
            "window.flexdt?.store.state && window.flexdt.store.session"
        )
        made.append(page)
        return page

    yield new
    for page in made:
        if not page.is_closed():
            page.close()
    assert not console


def _matters(message: Any) -> bool:
    gone = (
        "ERR_CONNECTION_REFUSED",
        "ERR_CONNECTION_RESET",
        "WebSocket connection to",
        "WebSocket is closed",
    )
    return message.type == "error" and not any(
        h in message.text for h in (*HARMLESS, *gone)
    )


@pytest.fixture(scope="module")
def page(open_page: Callable[..., Any]) -> Iterator[Any]:
    """A page without scenes, shared by a module's tests."""
    opened = open_page()
    yield opened
    opened.close()


@pytest.fixture(scope="session")
def wait() -> Callable[..., Any]:
    return until


@pytest.fixture(autouse=True)
def at_peace(request: pytest.FixtureRequest) -> None:
    """Whatever the test before left behind, the servers run, no scan does, nothing moves, no
    key is held, no note is left and no correction in force when a test begins; and the page
    knows it. A module begins with the machine as it was before the first one."""
    if "lab" not in request.fixturenames:
        return
    lab: Lab = request.getfixturevalue("lab")
    for process, again in (
        (lab.twin, lab.restart_twin),
        (lab.viewer, lab.restart_viewer),
    ):
        if process.process.poll() is not None:
            again()
    names = [name for name in ("page", "scene") if name in request.fixturenames]
    pages = [request.getfixturevalue(name) for name in names]
    for page in pages:
        page.evaluate("window.dispatchEvent(new Event('blur'))")
    with lab.client() as client:
        for job in client.jobs().jobs:
            if job.state in BUSY:
                client.abort_job(job.job)
        until(
            lambda: all(job.state not in BUSY for job in client.jobs().jobs), "scans end"
        )
        state = client.state()
        usual = state.clock.speed_up == SPEED_UP and state.correction is None
        usual = usual and lab.module == request.module.__name__
        holders = [None, *(page.evaluate("flexdt.store.session") for page in pages)]
        # A page that has just been closed may still hold control.
        if not usual or state.safety.state != "ok" or state.controller not in holders:
            client.control("force")
            client.set_clock(SPEED_UP)
            until(lambda: at_rest(client), "the motors rest")
            client.reset()
            if lab.module != request.module.__name__:
                as_at_first(lab, client)
                lab.module = request.module.__name__
            while client.state().correction is not None:
                client.revert_calibration()
            client.control("release")
        until(lambda: at_rest(client), "the motors rest")
        for page in pages:
            seen(page, client)
            page.locator("#notes").evaluate("e => e.replaceChildren()")


def as_at_first(lab: Lab, client: TwinClient) -> None:
    """Give the twin the camera, tube, sample, places and speeds of before the first test.

    A module's tests pass or fail whichever module ran before them on the same servers.
    """
    assert lab.first is not None
    camera, tube = lab.first.camera, lab.first.tube
    exposed = {"exposure_ms": camera.exposure_ms, "averages": camera.averages}
    client.set_camera(**USUAL, **exposed, frames=camera.frames)
    client.set_tube(kV=tube.kV, power_W=tube.power_W, on=False)
    client.set_sample(lab.first.sample.name)
    motors = {n: a for n, a in lab.first.axes.items() if not a.virtual}
    client.move({n: a.position for n, a in motors.items()}, plan=True, wait=True)
    for name, axis in motors.items():
        client.set_axis(name, speed=axis.speed, acceleration=axis.acceleration)


def at_rest(twin: TwinClient) -> bool:
    return not any(axis.moving for axis in twin.state().axes.values())
