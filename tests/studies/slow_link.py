"""How far behind a page is on a slow link: `python tests/studies/slow_link.py`.

A whole lab on this machine, a browser, and between the two a proxy that lets so many bytes a
second through in all, with a delay each way and small buffers, as a bad wireless link does.
While the stage turns, the page's state is compared with the twin's own, at the same moment;
then E-stop is pressed on the page. Needs Debian's chromium and playwright.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any

from flexdt.clients.client.client import TwinClient

CHROMIUM = "/usr/bin/chromium"
FLAGS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
]
BUFFER = 32_768
CHUNK = 4096

PRESS = """async () => {
  const begun = performance.now();
  document.querySelector('#estop').click();
  while (document.querySelector('#reset').hidden) await new Promise((r) => setTimeout(r, 5));
  return performance.now() - begun;
}"""
"""Presses E-stop; milliseconds until the page shows that it is in force."""


class SlowLink:
    """A proxy to a port of this machine, in a thread of its own.

    Args:
        port: of the server.
        rate: bytes a second in each direction, for all connections together.
        delay_s: each way.
    """

    def __init__(self, port: int, rate: float, delay_s: float) -> None:
        """Start the proxy and wait until it listens; `port` is then its own."""
        self._port, self._rate, self._delay = port, rate, delay_s
        self._free = {"down": 0.0, "up": 0.0}
        self._ready = threading.Event()
        self.port = 0
        threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True).start()
        self._ready.wait()

    async def _run(self) -> None:
        """Listen and serve for ever."""
        # A browser that leaves cuts its connections; nothing is to be said of that.
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)
        listening = socket.create_server(("127.0.0.1", 0))
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
        self.port = listening.getsockname()[1]
        server = await asyncio.start_server(self._serve, sock=listening, limit=CHUNK)
        self._ready.set()
        await server.serve_forever()

    async def _serve(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Connect to the server for one client, and pass bytes both ways until both ends
        have closed.
        """
        end = socket.socket()
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        end.setblocking(False)
        await asyncio.get_running_loop().sock_connect(end, ("127.0.0.1", self._port))
        far_reader, far_writer = await asyncio.open_connection(sock=end, limit=CHUNK)
        await asyncio.gather(
            self._pump(reader, far_writer, "up"), self._pump(far_reader, writer, "down")
        )

    async def _pump(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, way: str
    ) -> None:
        """Bytes go on at the link's rate, and then take their delay; what waits is little."""
        line: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(
            maxsize=max(1, int(self._rate * self._delay / CHUNK) + 2)
        )

        async def deliver() -> None:
            """Write what comes at its time; empty data close the connection and end this."""
            while True:
                due, data = await line.get()
                await asyncio.sleep(max(0.0, due - time.monotonic()))
                if not data:
                    writer.close()
                    return
                writer.write(data)
                await writer.drain()

        delivering = asyncio.create_task(deliver())
        try:
            while True:
                data = await reader.read(CHUNK)
                now = time.monotonic()
                self._free[way] = max(self._free[way], now) + len(data) / self._rate
                await asyncio.sleep(max(0.0, self._free[way] - now))
                await line.put((time.monotonic() + self._delay, data))
                if not data:
                    break
            await delivering
        except OSError:
            delivering.cancel()


def behind(page: Any, twin: TwinClient, count: int) -> list[float]:
    """Seconds by which the page's state is older than the twin's, at so many moments."""
    out = []
    for _ in range(count):
        page.wait_for_timeout(250)
        ours = float(page.evaluate("flexdt.store.state.time"))
        out.append(twin.state().time - ours)
    return out


def study(rate: float, delay_s: float, seconds: float) -> dict[str, float]:
    """The figures, in seconds."""
    from playwright.sync_api import sync_playwright

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
        lab = subprocess.Popen(
            [sys.executable, "-m", "flexdt.clients.launch.up", *words],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        try:
            assert lab.stdout is not None
            ready: dict[str, Any] = json.loads(lab.stdout.readline())
            ports = {name: int(ready[name]["port"]) for name in ("viewer", "twin")}
            link = SlowLink(ports["viewer"], rate, delay_s)
            with sync_playwright() as play, TwinClient(port=ports["twin"]) as twin:
                browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
                page = browser.new_page(viewport={"width": 1280, "height": 800})
                page.set_default_timeout(120_000)
                page.goto(f"http://127.0.0.1:{link.port}?view=none&theme=light")
                page.wait_for_function(
                    "window.flexdt?.store.image && flexdt.store.session"
                )
                rest = behind(page, twin, 8)
                page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 3000}})")
                page.wait_for_timeout(2000)
                images = int(page.evaluate("flexdt.store.received.image"))
                moving = behind(page, twin, int(seconds / 0.25))
                images = int(page.evaluate("flexdt.store.received.image")) - images
                stopped = float(page.evaluate(PRESS)) / 1000.0
                browser.close()
        finally:
            lab.send_signal(signal.SIGTERM)
            lab.wait(30)
    return {
        "behind at rest, worst": max(rest),
        "behind while turning, median": statistics.median(moving),
        "behind while turning, worst": max(moving),
        "E-stop shows after": stopped,
        "images a second": images / seconds,
    }


def main() -> None:
    """Measure the page over a slow link, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=float, default=250e3, help="bytes a second")
    parser.add_argument("--delay", type=float, default=0.025, help="each way [s]")
    parser.add_argument("--seconds", type=float, default=20.0, help="of turning")
    options = parser.parse_args()
    for name, value in study(options.rate, options.delay, options.seconds).items():
        print(f"{name:32s} {value:8.2f}")


if __name__ == "__main__":
    main()
