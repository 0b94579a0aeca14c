"""Measure the messages to a browser: rates, latency, memory (docs/evidence/viewer.json).

    python tests/studies/viewer_study.py                   # rates and latency, about a minute
    python tests/studies/viewer_study.py --minutes 30      # and memory under half an hour of motion

Starts its own servers on free ports. The browser parts need Debian's chromium and playwright
and are left out, with a word, where either is missing.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.asyncio.client import ClientConnection, connect

CHROMIUM = "/usr/bin/chromium"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic",
         "--enable-precise-memory-info"]  # fmt: skip
SECONDS = 10.0
PAGES = 3


@contextlib.contextmanager
def servers() -> Iterator[dict[str, Any]]:
    """Run `flexdt up` on free ports with a temporary data directory within the context,
    and yield its ready line.
    """
    with tempfile.TemporaryDirectory() as folder:
        words = [
            "--port",
            "0",
            "--projector-port",
            "0",
            "--viewer-port",
            "0",
            "--data",
            folder,
        ]
        process = subprocess.Popen(
            [sys.executable, "-m", "flexdt.clients.launch.up", *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(30)


class Page:
    """A page of the viewer without a browser: counts and confirms messages as one does."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket, self.states, self.images, self.bytes = socket, 0, 0, 0

    async def listen(self, seconds: float) -> None:
        """Count the states, images and bytes that come within `seconds`, and confirm each
        as a page does.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                async for message in self.socket:
                    self.bytes += len(message)
                    if isinstance(message, bytes):
                        self.images += message[0]  # 1: an image's last part
                        await self.socket.send('{"took":"image"}')
                    elif message.startswith('{"type": "state"'):
                        self.states += 1
                        await self.socket.send('{"took":"state"}')


async def rates(viewer: str) -> list[dict[str, float]]:
    """Measure the states, images and MB a second that each of PAGES pages gets while the
    stage turns, for SECONDS.

    It begins 2 s after the motion, which is stopped at the end.

    Args:
        viewer: HOST:PORT.

    Returns:
        The figures of each page.
    """
    async with contextlib.AsyncExitStack() as stack:
        pages = [
            Page(
                await stack.enter_async_context(
                    connect(
                        f"ws://{viewer}/ws/{os.urandom(8).hex()}",
                        max_size=None,
                        proxy=None,
                    )
                )
            )
            for _ in range(PAGES)
        ]
        await asyncio.gather(*(p.listen(2.0) for p in pages))
        move = {
            "id": 1,
            "method": "axes.move",
            "params": {"targets": {"rot_obj": 1000.0}},
        }
        await pages[0].socket.send(json.dumps(move))
        await asyncio.gather(*(p.listen(2.0) for p in pages))
        for page in pages:
            page.states = page.images = page.bytes = 0
        await asyncio.gather(*(p.listen(SECONDS) for p in pages))
        stop = {"id": 2, "method": "axes.stop"}
        await pages[0].socket.send(json.dumps(stop))
        return [
            {
                "states_per_s": round(p.states / SECONDS, 1),
                "images_per_s": round(p.images / SECONDS, 1),
                "MB_per_s": round(p.bytes / SECONDS / 1e6, 2),
            }
            for p in pages
        ]


LATENCY = """async (n) => {
  const out = [];
  const film = () => document.querySelector('#film-note').dataset.seq;
  for (let i = 0; i < n; i++) {
    await new Promise((r) => setTimeout(r, 900));
    const before = Number(film()), start = performance.now();
    flexdt.call('axes.move', { targets: { rot_obj: 2 }, relative: true });
    while (!(Number(film()) > before)) await new Promise((r) => requestAnimationFrame(r));
    out.push(performance.now() - start);
  }
  return out;
}"""


def browser(url: str, view: str, minutes: float, pid: int) -> dict[str, Any]:
    """Measure latency, displayed rate and memory of the page in headless Chromium with
    software rendering.

    Latency is that from a move by 2 deg to the next image shown, 40 times; rates are over
    SECONDS while the stage turns.

    Args:
        url: of the page.
        view: that it shows.
        minutes: of motion for the memory; 0 measures none.
        pid: of the viewer's process.

    Returns:
        Latency [ms] (median, 95 % and number), images displayed and images and states
        received a second, the viewer's share of a core, and, if measured, the samples of
        `memory`.
    """
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=CHROMIUM, headless=True, args=FLAGS
        )
        page = chromium.new_page(viewport={"width": 1280, "height": 800})
        page.goto(f"{url}?view={view}&theme=light")
        page.wait_for_function("window.flexdt?.store.image", timeout=120_000)
        page.wait_for_timeout(10_000)
        page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 0}})")
        page.wait_for_function("!flexdt.store.state.axes.rot_obj.moving", timeout=120_000)
        latency = sorted(page.evaluate(LATENCY, 40))
        page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 2000}})")
        page.wait_for_timeout(2000)
        counts = "[flexdt.film.count, flexdt.store.received.image, flexdt.store.received.state]"
        before, begun, used = page.evaluate(counts), time.monotonic(), cpu_s(pid)
        page.wait_for_timeout(int(SECONDS * 1000))
        after, took = page.evaluate(counts), time.monotonic() - begun
        used = cpu_s(pid) - used
        shown, images, states = (
            (b - a) / took for a, b in zip(before, after, strict=True)
        )
        result: dict[str, Any] = {
            "view": view,
            "latency_ms": {
                "median": round(statistics.median(latency), 1),
                "p95": round(latency[int(0.95 * len(latency))], 1),
                "n": len(latency),
            },
            "displayed_images_per_s": round(shown, 1),
            "received_images_per_s": round(images, 1),
            "received_states_per_s": round(states, 1),
            "viewer_share_of_a_core": round(used / took, 3),
        }
        if minutes > 0:
            result["memory"] = memory(page, minutes, pid)
        chromium.close()
    return result


def cpu_s(pid: int) -> float:
    """Processor time that a process has used so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def memory(page: Any, minutes: float, pid: int) -> list[dict[str, float]]:
    """Measure the viewer's resident memory and the page's heap in use, after a garbage
    collection, [MB] at intervals of at most 30 s, while the stage turns to and fro.

    Args:
        page: of the browser.
        minutes: to measure.
        pid: of the viewer's process.

    Returns:
        Samples of minute, viewer_MB and page_heap_MB.
    """
    samples, end = [], time.monotonic() + 60.0 * minutes
    session = page.context.new_cdp_session(page)
    begun = time.monotonic()
    while time.monotonic() < end:
        page.evaluate(
            "(() => { const a = flexdt.store.state.axes.rot_obj; if (!a.moving)"
            " flexdt.call('axes.move', {targets: {rot_obj: a.position > 0 ? -7000 : "
            "7000}}); })()"
        )
        page.wait_for_timeout(min(30_000, int(60_000 * minutes / 4)))
        resident = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf(
            "SC_PAGE_SIZE"
        )
        session.send("HeapProfiler.collectGarbage")  # memory in use, without garbage
        heap = session.send("Runtime.getHeapUsage")["usedSize"]
        samples.append(
            {
                "minute": round((time.monotonic() - begun) / 60.0, 2),
                "viewer_MB": round(resident / 1e6, 1),
                "page_heap_MB": round(heap / 1e6, 1),
            }
        )
    return samples


def viewer_pid(port: int) -> int:
    """Find the viewer's process that listens on a port of this machine.

    Raises:
        LookupError: there is none.
    """
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            words = (entry / "cmdline").read_bytes().split(b"\0")
            if (
                b"flexdt.clients.viewer.main" in words
                and int(entry.name)
                and _owns(entry, port)
            ):
                return int(entry.name)
    raise LookupError("the viewer's process is not to be found")


def _owns(entry: Path, port: int) -> bool:
    """Return whether a process, by its folder in /proc, has the socket of a TCP port
    (IPv4).
    """
    sockets = {os.readlink(f) for f in (entry / "fd").iterdir()}
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        fields = line.split()
        if (
            int(fields[1].rsplit(":", 1)[1], 16) == port
            and f"socket:[{fields[9]}]" in sockets
        ):
            return True
    return False


def main() -> int:
    """Measure the viewer at its socket and, where playwright is installed, in a browser;
    print one JSON document.

    Returns:
        0.
    """
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument(
        "--minutes", type=float, default=0.0, help="of motion, for memory"
    )
    options.add_argument(
        "--view", default="iso", help="what the page shows: iso, four, none, ..."
    )
    chosen = options.parse_args()
    with servers() as ready:
        at = ready["viewer"]
        report: dict[str, Any] = {
            "cores": os.cpu_count(),
            "load": os.getloadavg()[0],
            "at_the_socket": asyncio.run(rates(f"{at['host']}:{at['port']}")),
        }
        try:
            pid = viewer_pid(int(at["port"]))
            report["browser"] = browser(str(at["url"]), chosen.view, chosen.minutes, pid)
        except ImportError:
            print("playwright is not installed: no browser figures", file=sys.stderr)
        print(json.dumps(report, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
