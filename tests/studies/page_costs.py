"""What the page costs: bytes at load, its first picture, its rest, "Scan it" and the story.

    python tests/studies/page_costs.py [load] [rest] [scan] [story] [--shots DIR]

Starts a lab of its own, with what a new twin has on its stage, and a browser without graphics
hardware. Processor seconds are those of the servers and of the browser apart; wall seconds mean
something on a quiet machine alone, so the load average stands beside them. `load`: JavaScript of
page and viser, raw and as sent, all that is sent over HTTP, and the seconds to the first
radiograph and picture of the scene, cold and warm. `rest`: servers with one page open and nothing
moving. `scan`: from a browser that has never been here to a volume beside its truth. `story`:
Misalign's five steps.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexdt.clients.launch.processes import Servers

sys.path.insert(0, str(Path(__file__).parents[2]))
from docs.tools.page_pictures import CHROMIUM, FLAGS

SOFTWARE_FLAGS = [*FLAGS, "--disable-gpu-compositing"]
"""As chromium works by itself where no graphics processor is: SwiftShader draws WebGL alone,
and the page around it is put together without it."""
SIZE = {"width": 1440, "height": 900}
PATIENCE_MS = 900_000
REST_S = 60.0
"""How long a page at rest is watched."""
SETTLING_MS = 20_000
"""From the first picture to rest: scenes fade in, and pictures are compressed ahead."""
PICTURE = (
    "document.querySelector('#still')?.naturalWidth > 0 || !!window.flexdt?.store.image"
)
IMAGE = "!!(window.flexdt?.store.image && flexdt.store.session)"
LIVE = "document.querySelector('.view.live') !== null"
COMPARED = "document.querySelector('#volume-compared').childElementCount > 0"
WRONG = {"dO_x": 0.6, "det_roll": 1.5}
"""What the sliders of Misalign say [mm, deg]."""
SERVER_PARTS = {
    "live volume": "live_volume",
    "viewer": "viewer.main",
    "projector": "projector.main",
    "twin": "twin.main",
    "workers": "runtime.worker",
    "supervisor": "launch.up",
}
"""Part of the servers -> what its command line holds."""
STEPS = ("bend", "scan", "fit", "apply", "again")


@dataclass(frozen=True)
class Moment:
    """Wall seconds, and processor seconds of each part of servers and browser."""

    wall_s: float
    parts_s: dict[str, float]

    @property
    def servers_s(self) -> float:
        """Add up the servers' parts."""
        return sum(self.parts_s.get(name, 0.0) for name in SERVER_PARTS)

    @property
    def browser_s(self) -> float:
        """Add up the browser's parts."""
        return sum(self.parts_s.values()) - self.servers_s

    def since(self, other: Moment) -> str:
        """Say what has passed between two moments, the parts in parentheses."""
        parts = {
            name: used - other.parts_s.get(name, 0.0)
            for name, used in sorted(self.parts_s.items())
        }
        named = ", ".join(f"{n} {used:.1f}" for n, used in parts.items() if used >= 0.05)
        return (
            f"{self.wall_s - other.wall_s:.1f} s wall, "
            f"{self.servers_s - other.servers_s:.1f} CPU s of the servers, "
            f"{self.browser_s - other.browser_s:.1f} of the browser "
            f"({named}; load average {os.getloadavg()[0]:.1f})"
        )


def processor_s(pid: int) -> float | None:
    """Read what a process has used [s]; None where it has ended."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def part_of(pid: int, lab: set[int]) -> str:
    """Name the part of servers or browser that a process is; "" where it has ended.

    Args:
        pid: the process.
        lab: process ids of the servers.
    """
    try:
        command = Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""
    if not command:  # ended, and not yet waited for
        return ""
    if pid in lab:
        names = (name for name, module in SERVER_PARTS.items() if module in command)
        return next(names, "supervisor")
    _, _, kind = command.replace("\0", " ").partition("--type=")
    return kind.split(" ", 1)[0] or "browser"


def family(pid: int) -> set[int]:
    """List a process and all that it has started, and so on."""
    parents: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            words = path.read_text().rpartition(")")[2].split()
            parents[int(path.parent.name)] = int(words[1])
    found = {pid}
    while more := {one for one, parent in parents.items() if parent in found} - found:
        found |= more
    return found


class Meter:
    """Adds up processor seconds, those of processes that have ended included.

    Args:
        servers: process id of the supervisor.
    """

    def __init__(self, servers: int) -> None:
        self._servers = servers
        self._seen: dict[tuple[str, int], float] = {}

    def now(self) -> Moment:
        """Read the clocks of all processes."""
        lab = family(self._servers)
        for pid in family(os.getpid()) - {os.getpid()}:
            if (used := processor_s(pid)) is not None and (name := part_of(pid, lab)):
                self._seen[name, pid] = used
        total: dict[str, float] = {}
        for (name, _), seconds in self._seen.items():
            total[name] = total.get(name, 0.0) + seconds
        return Moment(time.monotonic(), total)

    def until(self, page: Any, condition: str) -> Moment:
        """Wait for a condition of the page, reading the clocks meanwhile."""
        while not page.evaluate(condition):
            self.now()
            page.wait_for_timeout(100)
        return self.now()


@contextmanager
def browsing(play: Any) -> Iterator[Any]:
    """A context of a browser that has never been here."""
    browser = play.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_FLAGS)
    context = browser.new_context(viewport=SIZE)
    context.set_default_timeout(PATIENCE_MS)
    yield context
    browser.close()


def opened(context: Any, url: str, **query: str) -> Any:
    """A page with its first radiograph."""
    page = context.new_page()
    asked = {"patience": "100", "theme": "light", **query}
    page.goto(f"{url}?" + "&".join(f"{k}={v}" for k, v in asked.items()))
    page.wait_for_function(IMAGE)
    return page


def load(play: Any, url: str, meter: Meter, shots: Path | None) -> None:
    """Print bytes of JavaScript and the seconds to the first pictures, cold and warm."""
    with browsing(play) as context:
        for visit in ("cold", "warm"):
            page = context.new_page()
            sizes: dict[str, list[float]] = {}
            network = context.new_cdp_session(page)
            network.send("Network.enable")
            scripts: dict[str, str] = {}
            network.on(
                "Network.responseReceived",
                lambda e, kept=scripts: kept.__setitem__(
                    e["requestId"],
                    e["response"]["url"] if "script" in e["response"]["mimeType"] else "",
                ),
            )
            sent: list[float] = []
            network.on(
                "Network.loadingFinished",
                lambda e, kept=sent: kept.append(e["encodedDataLength"]),
            )
            raw: dict[str, int] = {}
            network.on(
                "Network.dataReceived",
                lambda e, kept=raw: kept.__setitem__(
                    e["requestId"], kept.get(e["requestId"], 0) + e["dataLength"]
                ),
            )
            network.on(
                "Network.loadingFinished",
                lambda e, names=scripts, kept=sizes, whole=raw: kept.setdefault(
                    names.get(e["requestId"], ""),
                    [e["encodedDataLength"], whole.get(e["requestId"], 0)],
                ),
            )
            begun = meter.now()
            page.goto(f"{url}?patience=100&theme=light", wait_until="commit")
            picture = meter.until(page, PICTURE)
            image = meter.until(page, IMAGE)
            live = meter.until(page, LIVE)
            print(f"{visit}: first picture {picture.since(begun)}")
            print(f"{visit}: radiograph {image.since(begun)}")
            print(f"{visit}: live scene {live.since(begun)}")
            print(f"{visit}: {sum(sent) / 1e3:.0f} kB sent in all, without WebSockets")
            js = {name: size for name, size in sizes.items() if name.endswith(".js")}
            for what, chosen in (
                ("viser's", [v for k, v in js.items() if "/viser-" in k]),
                ("the page's", [v for k, v in js.items() if "/viser-" not in k]),
            ):
                by_wire, whole = (sum(size[k] for size in chosen) / 1e3 for k in (0, 1))
                print(
                    f"{visit}: {what} JavaScript {by_wire:.0f} kB sent, {whole:.0f} kB raw"
                )
            if shots:
                page.screenshot(path=shots / f"load-{visit}.png")
            page.close()


def rest(play: Any, url: str, meter: Meter, shots: Path | None) -> None:
    """Print what the servers and the browser take in REST_S while nothing moves."""
    with browsing(play) as context:
        page = opened(context, url)
        page.wait_for_timeout(SETTLING_MS)
        begun = meter.now()
        page.wait_for_timeout(1000 * REST_S)
        ended = meter.now()
        seconds = ended.wall_s - begun.wall_s
        servers = (ended.servers_s - begun.servers_s) / seconds
        browser = (ended.browser_s - begun.browser_s) / seconds
        print(
            f"rest: servers {100 * servers:.1f} % of a core, browser {100 * browser:.1f} % "
            f"in {seconds:.0f} s: {ended.since(begun)}"
        )
        if shots:
            page.screenshot(path=shots / "rest.png")


def scan(play: Any, url: str, meter: Meter, shots: Path | None) -> None:
    """Print what it takes from nothing to a volume beside its truth, by one click."""
    with browsing(play) as context:
        begun = meter.now()
        page = opened(context, url)
        shown = meter.now()
        page.click("#scan-it")
        page.wait_for_function("flexdt.store.job?.state === 'running'")
        for percent in (35, 70):
            meter.until(
                page, f"{AGED} >= {percent} || flexdt.store.job?.state === 'done'"
            )
            if shots:
                page.screenshot(path=shots / f"scan-{percent}.png")
        scanned = meter.until(page, "flexdt.store.job?.state === 'done'")
        whole = meter.until(
            page, "!!(flexdt.volume().told?.past && flexdt.volume().three.block)"
        )
        compared = meter.until(page, COMPARED)
        for what, moment in (
            ("page", shown),
            ("scan", scanned),
            ("volume", whole),
            ("volume beside its truth", compared),
        ):
            print(f"scan it: {what} after {moment.since(begun)}")
        if shots:
            page.wait_for_timeout(3000)
            page.screenshot(path=shots / "scan-done.png")


AGED = "100 * flexdt.store.job.frames_done / flexdt.store.job.frames_total"


def story(play: Any, url: str, meter: Meter, shots: Path | None) -> None:
    """Print what each of Misalign's steps takes."""
    with browsing(play) as context:
        page = opened(context, url, tab="calibrate")
        page.click("#story summary")
        for name, value in WRONG.items():
            page.evaluate(
                "([id, v]) => { const s = document.getElementById(id); s.value = v;"
                " s.dispatchEvent(new Event('input')); }",
                [f"story-{name}", value],
            )
        begun = last = meter.now()
        for step, follower in zip(STEPS, (*STEPS[1:], None), strict=True):
            page.locator(f"#story-{step}.primary:enabled").click()
            ready = (
                f"document.querySelector('#story-{follower}.primary:enabled')"
                if follower
                else "document.querySelector('#story-says').innerText.includes('Sharp again')"
            )
            now = meter.until(page, f"!!({ready})")
            print(f"story: {step} {now.since(last)}: {page.inner_text('#story-says')}")
            last = now
            if shots:
                page.wait_for_timeout(1500)
                page.screenshot(path=shots / f"story-{step}.png")
        print(f"story: whole {last.since(begun)}")
        print(page.inner_text("#story-found"))


PARTS = {"load": load, "rest": rest, "scan": scan, "story": story}


def main() -> None:
    """Measure the parts of the page named on the command line, or all, each with servers
    of its own.
    """
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", help="all of them")
    parser.add_argument("--shots", type=Path, help="folder for screenshots")
    given = parser.parse_args()
    if given.shots:
        given.shots.mkdir(parents=True, exist_ok=True)
    for name in given.parts or PARTS:
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / "servers.log"
            with (
                Servers({"data": Path(folder) / "data"}, log, viewer=True) as servers,
                sync_playwright() as play,
            ):
                PARTS[name](
                    play, str(servers.viewer_url), Meter(servers.pid), given.shots
                )
        sys.stdout.flush()


if __name__ == "__main__":
    main()
