"""What first visitors see: 32 pictures of the page, as contact sheets.

    python docs/tools/first_visits.py --out DIR [--url http://127.0.0.1:8080/]

Four sizes of screen, two themes and four states of the page: just opened, X-rays on beside the
Setup tab, a script in the Scan tab, and the story of the Calibrate tab. One sheet a size, with a
row for each theme; the pictures lie beside the sheets. The page is opened anew, by a browser
that has never been there, for each size and theme. Starts a lab of its own, unless it is given
the address of one. Needs Debian's chromium, playwright and Pillow.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2]))
from docs.tools.page_pictures import CHROMIUM, FADED_MS, FLAGS, PATIENCE_MS, lab

SIZES = ((1440, 900), (1366, 768), (820, 1180), (390, 844))
THEMES = ("light", "dark")
SHEET_PX = 640
"""Width of a picture on its sheet."""
SETTLING_MS = 2000
"""From a click to what it leads to."""


def as_opened(page: Any) -> None:
    """Leave the page as it opens."""


def x_rays_on(page: Any) -> None:
    """Switch X-rays on, beside the Setup tab."""
    page.click("#tabs [data-tab=setup]")
    page.evaluate("flexdt.call('tube.set', {on: true})")
    page.locator("#beam", has_text="ON").wait_for()


def script_written(page: Any) -> None:
    """Switch X-rays off, compose a script in the Scan tab, and wait for its verdict."""
    page.evaluate("flexdt.call('tube.set', {on: false})")
    page.click("#tabs [data-tab=scan]")
    page.click("#compose")
    page.locator("#report .verdict").wait_for()


def story_open(page: Any) -> None:
    """Open the story of the Calibrate tab."""
    page.click("#tabs [data-tab=calibrate]")
    page.click("#story summary")


STATES: dict[str, Callable[[Any], None]] = {
    "opened": as_opened,
    "x-rays": x_rays_on,
    "script": script_written,
    "story": story_open,
}


def visit(browser: Any, url: str, size: tuple[int, int], theme: str) -> list[Image.Image]:
    """Return a picture of each of `STATES`, in order, from one visit by a browser that
    has never been there.

    Args:
        browser: of playwright.
        url: of the page.
        size: of the window, (width, height) [px].
        theme: of `THEMES`.
    """
    width, height = size
    context = browser.new_context(viewport={"width": width, "height": height})
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.goto(f"{url}?theme={theme}&patience=60")
    page.wait_for_function("window.flexdt?.store.image && flexdt.store.session")
    page.locator(".view.live").first.wait_for()
    page.wait_for_timeout(FADED_MS)
    pictures = []
    for reach in STATES.values():
        reach(page)
        page.wait_for_timeout(SETTLING_MS)
        raw = io.BytesIO(page.screenshot())
        pictures.append(Image.open(raw).convert("RGB"))
    context.close()
    return pictures


def sheet(rows: list[list[Image.Image]]) -> Image.Image:
    """Put pictures of one size side by side, a row each, scaled to a width of `SHEET_PX`."""
    width, height = rows[0][0].size
    small = (SHEET_PX, round(SHEET_PX * height / width))
    whole = Image.new("RGB", (small[0] * len(rows[0]), small[1] * len(rows)))
    for row, pictures in enumerate(rows):
        for column, picture in enumerate(pictures):
            whole.paste(picture.resize(small), (column * small[0], row * small[1]))
    return whole


def main() -> None:
    """Save a picture of each size, theme and state, and a sheet of each size, in the
    folder --out; starts a lab of its own without --url.
    """
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures")
    parser.add_argument("--url", help="of a page that is served already")
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    with (
        nullcontext(chosen.url) if chosen.url else lab() as url,
        sync_playwright() as play,
    ):
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        for size in SIZES:
            rows = [visit(browser, url, size, theme) for theme in THEMES]
            name = f"{size[0]}x{size[1]}"
            for theme, pictures in zip(THEMES, rows, strict=True):
                for state, picture in zip(STATES, pictures, strict=True):
                    picture.save(chosen.out / f"{name}-{theme}-{state}.png")
            sheet(rows).save(chosen.out / f"sheet-{name}.png")
            print(name, flush=True)
        browser.close()


if __name__ == "__main__":
    main()
