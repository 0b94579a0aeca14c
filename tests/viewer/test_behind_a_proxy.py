"""The page behind a hub's proxy, below a path: all of it works, and strangers stay out."""

from __future__ import annotations

import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from browsers import CHROMIUM, FLAGS, kept_port, need_browser
from lab import fly_script
from looking import KNOWN_HERE
from prefix_proxy import proxied

from flexdt.clients import TwinClient

PREFIX = "/user/ann/proxy/8080/"
HUB = "hub.example"

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with need_browser()() as playwright:
        rules = f"--host-resolver-rules=MAP {HUB} 127.0.0.1"
        running = playwright.chromium.launch(
            executable_path=CHROMIUM, headless=True, args=[*FLAGS, rules]
        )
        yield running
        running.close()


@contextmanager
def hub(lab: Any, *words: str, **how: bool) -> Iterator[tuple[str, int, list[str]]]:
    """A viewer behind a proxy: its public URL, its own port, and requests that went astray."""
    port = kept_port()
    with proxied(port, PREFIX, **how) as (outer, astray):
        url = f"http://{HUB}:{outer}{PREFIX}"
        viewer = lab.another_viewer("--port", str(port), "--public-url", url, *words)
        try:
            yield url, port, astray
        finally:
            viewer.stop()


@contextmanager
def opened(browser: Any, url: str) -> Iterator[Any]:
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.set_default_timeout(120_000)
    said: list[str] = []
    page.on("pageerror", lambda error: said.append(str(error)))
    page.add_init_script(KNOWN_HERE)
    page.goto(url)
    page.wait_for_function("window.flexdt?.store.state && window.flexdt.store.session")
    yield page
    page.close()
    assert not said


@pytest.mark.timeout(900)
@pytest.mark.campaign(1)
@pytest.mark.parametrize(
    ("host_kept", "stripped"),
    [(True, True), (True, False), (False, False), (False, True)],
)
def test_the_page_works_below_a_path(
    browser: Any, lab: Any, twin: TwinClient, host_kept: bool, stripped: bool
) -> None:
    with (
        hub(lab, host_kept=host_kept, stripped=stripped) as (url, _, astray),
        opened(browser, f"{url}?view=iso&patience=60") as page,
    ):
        page.wait_for_selector(
            ".view[data-view=iso][data-drawn], .view[data-view=iso] iframe"
        )
        page.wait_for_function("flexdt.store.image")
        page.click("#take")
        page.wait_for_function("flexdt.store.state.controller === flexdt.store.session")
        page.evaluate("flexdt.call('axes.move', {targets: {mag_det: 1000}, wait: true})")
        assert twin.state().axes["mag_det"].position == pytest.approx(1000.0)
        page.click("#estop")
        page.wait_for_function("flexdt.store.state.safety.estop")
        assert twin.state().safety.estop
        twin.control("force")
        twin.reset()
        twin.control("release")
        assert page.evaluate("fetch('still.jpg?view=iso&w=80&h=60').then(r => r.ok)")
        assert astray == []


@pytest.mark.timeout(900)
@pytest.mark.campaign
def test_a_scan_is_reconstructed_below_a_path(
    browser: Any, lab: Any, twin: TwinClient
) -> None:
    twin.submit_script(fly_script(frames=61, exposure_ms=500.0), "below a path", "max")
    assert twin.wait_job().state == "done"
    twin.control("release")
    with hub(lab) as (url, _, astray), opened(browser, f"{url}?view=none") as page:
        page.click("#tabs [data-tab=data]")
        page.locator(".data-set[data-name='below a path']").click()
        page.click("#record-volume")
        page.wait_for_function(
            "flexdt.volume().three?.block && flexdt.volume().solid", timeout=400_000
        )
        assert astray == []


def answer(port: int, **headers: str) -> int:
    asked = urllib.request.Request(f"http://127.0.0.1:{port}/", headers=headers)
    try:
        with urllib.request.urlopen(asked) as got:
            return int(got.status)
    except urllib.error.HTTPError as error:
        return error.code


FOREIGN = [
    f"{name}{port}"
    for name in (
        "evil.example",
        f"{HUB}.evil.example",
        f"x.{HUB}",
        "hub.exampl",
        "1.2.3.4",
    )
    for port in ("", ":1", ":8080", ":80")
]


def test_foreign_hosts_and_origins_are_refused(lab: Any) -> None:
    with hub(lab) as (url, port, _):
        host = url.split("/")[2]
        assert answer(port, Host=host, Origin=f"http://{host}") == 200
        assert answer(port, Origin=f"http://{host}") == 200
        for foreign in FOREIGN:
            assert answer(port, Host=foreign) == 403, foreign
            assert answer(port, Origin=f"http://{foreign}") == 403, foreign
            assert answer(port, Host=host, Origin=f"http://{foreign}") == 403, foreign


def test_a_cookie_is_sent_to_its_own_viewer_only(
    browser: Any, lab: Any, tmp_path: Any, wait: Callable[..., Any]
) -> None:
    """Two viewers behind one hub: each has a cookie of its own name and path."""
    token = tmp_path / "token"
    token.write_text("a-token-of-sixteen-or-more\n")
    token.chmod(0o600)
    with hub(lab, "--token-file", str(token)) as (url, _, astray):
        page = browser.new_page()
        assert page.goto(url).status == 401
        page.fill("#token", token.read_text().strip())
        page.click("button")
        page.wait_for_url(url)
        (cookie,) = page.context.cookies()
        assert cookie["path"] == PREFIX.rstrip("/")
        assert cookie["name"] != "flexdt_viewer"
        assert page.locator("#estop").is_visible()
        page.close()
        assert astray == []


def test_without_a_connection_the_page_says_what_is_missing(
    browser: Any, open_blocked: Callable[..., Any]
) -> None:
    page = open_blocked(browser)
    page.locator("#veil-text", has_text="--public-url").wait_for()
    assert page.get_attribute("#estop", "data-dead") is not None
    page.close()


@pytest.fixture
def open_blocked(lab: Any) -> Callable[..., Any]:
    def new(browser: Any) -> Any:
        page = browser.new_page()
        page.set_default_timeout(60_000)
        page.route_web_socket("**/ws/**", lambda socket: socket.close())
        page.goto(lab.url)
        return page

    return new
