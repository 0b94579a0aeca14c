"""The pictures of the page in docs/images, from the page as it is: Chromium, software
rendering.

    python docs/tools/page_pictures.py [--out docs/images] [--url http://127.0.0.1:8080/]

Starts a lab of its own, unless it is given the address of one whose machine stands at home.
Writes viewer-first.png, viewer-four-views.png, viewer-scan-it.png, viewer-scan.png,
viewer-design.png and viewer-virtual.png, in COLORS colors, and viewer-turning.gif; `--only`
writes those of one function. Needs Debian's chromium, playwright and Pillow.
"""

from __future__ import annotations

import argparse
import io
import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from PIL import Image

CHROMIUM = "/usr/bin/chromium"
FLAGS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
]
SIZE = {"width": 1440, "height": 810}
FADED_MS = 6000
"""A scene fades in once its parts have come."""
COLORS = 256
PATIENCE_MS = 300_000
TURNING_DEG = 36.0
"""Angle between two teeth of the gear."""
TURNING_FRAMES = 12
TURNING_PX = 720
TURNING_COLORS = 128
TURNING_BELOW_PX = 110
"""Of the scene, below the radiograph's lower edge."""
TURNING_MS = 110
SETTLED_MS = 2500
"""From a motor's rest to a picture that shows it."""
TURNED = """
(angle) => {
  const { position, moving } = flexdt.store.state.axes.rot_obj;
  return !moving && Math.abs(position - angle) < 1e-3;
}
"""
WRONG = "flexdt.call('calibration.apply', {parameters: {dO_x: 0.3, dO_z: -0.4}, comment: 'wrong'})"
"""A correction by which the beads stand beside where they are seen, until a fit puts it
right."""


@contextmanager
def lab() -> Iterator[str]:
    """Start `flexdt up` on free ports with a temporary data folder, yield the address of
    its page, and end it, which may take 30 s.
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
            yield str(json.loads(process.stdout.readline())["viewer"]["url"])
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(30)


def opened(browser: Any, url: str, view: str, tab: str) -> Any:
    """Open the page in a new tab, and wait until it has an image and a session, and its
    notes have faded.

    Args:
        browser: of playwright.
        url: of the page.
        view: of the scene.
        tab: that is open.

    Returns:
        The tab.
    """
    page = browser.new_page(viewport=SIZE)
    page.set_default_timeout(PATIENCE_MS)
    page.goto(f"{url}?view={view}&tab={tab}&theme=light&light=fine&patience=60")
    page.wait_for_function("window.flexdt?.store.image && flexdt.store.session")
    page.wait_for_timeout(FADED_MS)
    return page


def taken(page: Any, path: Path) -> None:
    """Save a picture of the page as PNG of `COLORS` colors, once two pictures of its
    scenes are equal and none is marked as old.
    """
    last = b""
    while (now := page.locator("#views").screenshot()) != last:
        page.wait_for_timeout(FADED_MS)
        page.locator("#veil").wait_for(state="hidden")
        last = now
    raw = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    few = raw.quantize(
        COLORS, Image.Quantize.MAXCOVERAGE, kmeans=3, dither=Image.Dither.NONE
    )
    few.save(path, optimize=True)


def first(browser: Any, url: str, to: Path) -> None:
    """Picture the page with X-rays on, as `viewer-first.png`; switches them off again."""
    page = opened(browser, url, "iso", "move")
    page.evaluate("flexdt.call('tube.set', {on: true})")
    page.locator("#beam", has_text="ON").wait_for()
    taken(page, to / "viewer-first.png")
    page.evaluate("flexdt.call('tube.set', {on: false})")
    page.close()


def four_views(browser: Any, url: str, to: Path) -> None:
    page = opened(browser, url, "four", "move")
    taken(page, to / "viewer-four-views.png")
    page.close()


def scan_it(browser: Any, url: str, to: Path) -> None:
    """Scan and reconstruct the gear by one click, and picture its volume in the scene and
    beside its truth, as `viewer-scan-it.png`; the stage stays nearer.
    """
    page = opened(browser, url, "iso", "move")
    page.locator("#scan-it-sample option[value=gear]").wait_for(state="attached")
    page.select_option("#scan-it-sample", "gear")
    page.click("#scan-it")
    page.locator("#volume-beside").wait_for()
    taken(page, to / "viewer-scan-it.png")
    page.close()


def scan(browser: Any, url: str, to: Path) -> None:
    """Picture a plan's timeline and the scan designer, as `viewer-scan.png` and
    `viewer-design.png`, and run the scan, with a wrong correction in force, for
    `virtual`.
    """
    page = opened(browser, url, "iso", "scan")
    page.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    page.select_option("#wish-kind", "step")
    page.fill("#wish-frames", "13")
    page.click("#compose")
    page.locator("#report .verdict.ok").wait_for()
    page.click("#plan")
    page.locator("#timeline").click(position={"x": 150, "y": 20})
    taken(page, to / "viewer-scan.png")
    page.evaluate(WRONG)
    page.select_option("#speed-up", "max")
    page.click("#run")
    page.locator("#job-state", has_text="done").wait_for()
    page.get_by_text("Design a scan").click()
    page.locator("#design-quality").wait_for()
    page.locator("#design-best").scroll_into_view_if_needed()
    taken(page, to / "viewer-design.png")
    page.close()


def virtual(browser: Any, url: str, to: Path) -> None:
    """Calibrate the newest data set, and picture its recorded less virtual image with the
    fit's beads, as `viewer-virtual.png`; reverts the correction.
    """
    page = opened(browser, url, "iso", "data")
    page.locator(".data-set").first.click()
    page.get_by_role("button", name="Calibrate", exact=True).click()
    page.get_by_role("button", name="Compare over a radiograph").click()
    page.locator("#compare-all-after", has_text="px").wait_for()
    page.select_option("#compare-mode", "difference")
    page.locator("#record-at", has_text="scan_").wait_for()
    page.click("#tab-of-data")
    taken(page, to / "viewer-virtual.png")
    page.evaluate("flexdt.call('calibration.revert')")
    page.close()


def turning(browser: Any, url: str, to: Path) -> None:
    """Film the gear while it turns by the angle after which it looks the same: the scene,
    near the sample, and its radiograph, as `viewer-turning.gif` of `TURNING_FRAMES`
    frames. Takes control, and turns the stage back to 0.
    """
    page = opened(browser, url, "iso", "move")
    page.evaluate("flexdt.call('session.control', {action: 'force'})")
    page.evaluate("flexdt.call('sample.set', {name: 'gear'})")
    page.locator(".view .look").click()
    page.wait_for_timeout(FADED_MS)
    page.add_style_tag(
        content=".view button, .view .tag, #notes, #film ~ * { visibility: hidden }"
    )
    box = page.locator("#views").bounding_box()
    film = page.locator("#film").bounding_box()
    part = {
        "x": box["x"],
        "y": film["y"],
        "width": SIZE["width"] - box["x"],
        "height": film["height"] + TURNING_BELOW_PX,
    }
    frames = []
    for k in range(TURNING_FRAMES):
        angle = TURNING_DEG * k / TURNING_FRAMES
        page.evaluate(
            "angle => flexdt.call('axes.move', {targets: {rot_obj: angle}})", angle
        )
        page.wait_for_function(TURNED, arg=angle)
        page.wait_for_timeout(SETTLED_MS)
        raw = Image.open(io.BytesIO(page.screenshot(clip=part))).convert("RGB")
        high = round(raw.height * TURNING_PX / raw.width)
        frames.append(raw.resize((TURNING_PX, high), Image.Resampling.LANCZOS))
    palette = frames[-1].quantize(TURNING_COLORS, Image.Quantize.MAXCOVERAGE, kmeans=3)
    few = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in frames]
    film_of = {"save_all": True, "append_images": few[1:], "duration": TURNING_MS}
    few[0].save(to / "viewer-turning.gif", loop=0, optimize=True, **film_of)
    page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 0}})")
    page.close()


PICTURES = (first, four_views, turning, scan, virtual, scan_it)


def main() -> None:
    """Make all pictures, or the one of --only, in the folder --out, of the page at --url
    or of a lab of its own.
    """
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    parser.add_argument("--url", help="of a page that is served already")
    parser.add_argument("--only", choices=[one.__name__ for one in PICTURES])
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    with (
        nullcontext(chosen.url) if chosen.url else lab() as url,
        sync_playwright() as play,
    ):
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        for picture in PICTURES:
            if chosen.only in (None, picture.__name__):
                picture(browser, url, chosen.out)
        browser.close()


if __name__ == "__main__":
    main()
