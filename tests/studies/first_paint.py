"""Seconds to a page's first paint, to the viewer's picture of the scene and to the live one;
bytes.

    python tests/studies/first_paint.py [--url http://127.0.0.1:8080/]

Starts a lab of its own, unless it is given the address of one. Cold is a browser that has never
been here, warm the same one again. Bytes are those of the page, of its views and of their
WebSockets until the live scene has been drawn.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from docs.tools.page_pictures import CHROMIUM, FLAGS, lab

SIZE = {"width": 1366, "height": 768}
PATIENCE_S = 240.0
SEEN = "(() => { const i = document.querySelector('#still'); return i?.naturalWidth > 0; })()"
LIVE = "document.querySelector('.view.live') !== null"
PAINT = "performance.getEntriesByName('first-contentful-paint')[0].startTime"


def opened(context: Any, url: str) -> tuple[float, float, float, float]:
    """Open the page and wait for its live scene.

    Returns:
        Seconds to first paint, picture and live scene, and MB received.

    Raises:
        AssertionError: there is no scene in PATIENCE_S.
    """
    page, size = context.new_page(), [0.0]
    network = context.new_cdp_session(page)
    network.send("Network.enable")

    def add(count: float) -> None:
        size[0] += count

    network.on("Network.loadingFinished", lambda e: add(e["encodedDataLength"]))
    network.on(
        "Network.webSocketFrameReceived",
        lambda e: add(
            len(e["response"]["payloadData"])
            * (0.75 if e["response"]["opcode"] == 2 else 1.0)
        ),
    )
    begun, times = time.monotonic(), {}
    page.goto(f"{url}?theme=light&view=iso&patience=100", wait_until="commit")
    while LIVE not in times:
        for what in (SEEN, LIVE):
            if what not in times and page.evaluate(what):
                times[what] = time.monotonic() - begun
        assert time.monotonic() - begun < PATIENCE_S, "no scene"
        page.wait_for_timeout(20)
    paint = page.evaluate(PAINT) / 1000.0
    page.close()
    return paint, times[SEEN], times[LIVE], size[0] / 1e6


def main() -> None:
    """Open the page once cold and twice warm, and print when it shows what."""
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--url", help="of a page that is served already")
    given = parser.parse_args().url
    with nullcontext(given) if given else lab() as url, sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        context = browser.new_context(viewport=SIZE)
        for what in ("cold", "warm", "warm"):
            paint, picture, live, mb = opened(context, url)
            print(
                f"{what}: first paint {paint:.2f} s, picture {picture:.2f} s, "
                f"live {live:.2f} s, {mb:.2f} MB; load average {os.getloadavg()[0]:.1f}",
                flush=True,
            )
        browser.close()


if __name__ == "__main__":
    main()
