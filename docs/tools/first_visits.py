"""What first visitors see: 32 pictures of the page, as contact sheets.

    python docs/tools/first_visits.py --out DIR [--sizes 1366x768 390x844] [--theme dark]
        [--url http://127.0.0.1:8080/]

Four desktop sizes, unless others are given, and eight states. Four are of a lab without data: just
opened, four views with X-rays on, the beam's eye beside the Setup tab, a script in the Scan tab.
Four are of a lab with a scan: its volume beside its truth, its images, the designer, the
story of the Calibrate tab. A browser that has never been there opens the page anew for each size;
the window of the visit with a scan is brought to each size. One sheet a size; the pictures lie
beside the sheets. Starts a lab of its own, unless it is given the address of one. Needs Debian's
chromium, playwright and Pillow.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[2]))
from docs.tools.page_pictures import CHROMIUM, FADED_MS, FLAGS, PATIENCE_MS, lab

Size = tuple[int, int]
Reach = Callable[[Any], None]

SIZES: tuple[Size, ...] = ((1280, 800), (1366, 768), (1440, 900), (1920, 1080))
"""Width and height of the window in pixels."""
THEMES = ("light", "dark")
SHEET_PX = 640
"""Width of a picture on its sheet."""
SHEET_COLUMNS = 4
SETTLING_MS = 2500
"""From a click to what it leads to."""


DRAWN = "!document.querySelector('.view:not(.live)')"
"""Each pane shows its scene."""


def as_opened(page: Any) -> None:
    """Leave the page as it opens."""


def four_views(page: Any) -> None:
    """Switch X-rays on, show four views, and wait until the page's notes have faded."""
    page.evaluate("flexdt.call('tube.set', {on: true})")
    page.locator("#beam", has_text="ON").wait_for()
    page.get_by_role("button", name="Four views").click()
    page.wait_for_timeout(FADED_MS)


def beams_eye(page: Any) -> None:
    """Show the beam's eye beside the Setup tab."""
    page.get_by_role("button", name="Beam’s eye").click()
    page.click("#tabs [data-tab=setup]")
    page.wait_for_timeout(FADED_MS)


def script_written(page: Any) -> None:
    """Switch X-rays off, show the isometric view, compose a script in the Scan tab, and
    wait for its verdict.
    """
    page.evaluate("flexdt.call('tube.set', {on: false})")
    page.get_by_role("button", name="Isometric").click()
    page.click("#tabs [data-tab=scan]")
    page.click("#compose")
    page.locator("#report .verdict").wait_for()


def volume(page: Any) -> None:
    """Show what stands on the stage, scanned by one button, beside its truth."""
    if not page.locator("#volume-beside").is_visible():
        page.click("#scan-it")
        page.locator("#volume-beside").wait_for()


def images(page: Any) -> None:
    """Open the newest data set in the Data tab."""
    page.click("#tabs [data-tab=data]")
    page.locator(".data-set").first.click()
    page.locator("#record-at", has_text="image").wait_for()


def story_open(page: Any) -> None:
    """Close the page's data set, and open the story of the Calibrate tab unless it is
    open.
    """
    page.evaluate("flexdt.data.open(null).then(() => null)")
    page.click("#tabs [data-tab=calibrate]")
    if page.get_attribute("#story", "open") is None:
        page.click("#story summary")


def designed(page: Any) -> None:
    """Open the designer of the Scan tab unless it is open, and wait for its quality."""
    page.click("#tabs [data-tab=scan]")
    if page.get_attribute("#designer", "open") is None:
        page.click("#designer summary")
    page.locator("#design-quality").wait_for()


FRESH: dict[str, Reach] = {
    "opened": as_opened,
    "four-views": four_views,
    "beams-eye": beams_eye,
    "script": script_written,
}
WITH_DATA: dict[str, Reach] = {
    "volume": volume,
    "images": images,
    "story": story_open,
    "designer": designed,
}


def opened(browser: Any, url: str, size: Size, theme: str) -> Any:
    """Open the page by a browser that has never been there, and wait until it has an
    image, a session and a live view, and then `FADED_MS` more, in which notes fade.

    Args:
        browser: of playwright.
        url: of the page.
        size: of the window (width, height) [px].
        theme: of the page.

    Returns:
        The page, in a context of its own, which the caller closes.
    """
    width, height = size
    context = browser.new_context(viewport={"width": width, "height": height})
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.goto(f"{url}?theme={theme}&patience=60")
    page.wait_for_function("window.flexdt?.store.image && flexdt.store.session")
    page.locator(".view.live").first.wait_for()
    page.wait_for_timeout(FADED_MS)
    return page


def pictured(page: Any) -> Image.Image:
    """Take a picture of the page, without transparency, once what was asked for is drawn
    and nothing is marked as old.
    """
    page.wait_for_timeout(SETTLING_MS)
    page.wait_for_function(DRAWN)
    page.locator("#veil").wait_for(state="hidden")
    raw = io.BytesIO(page.screenshot())
    return Image.open(raw).convert("RGB")


def fresh(page: Any) -> dict[str, Image.Image]:
    """Make a picture of each state of `FRESH`, those without data, in one visit.

    Args:
        page: just `opened`; it is closed with its context.

    Returns:
        State -> picture.
    """
    pictures = {}
    for state, reach in FRESH.items():
        reach(page)
        pictures[state] = pictured(page)
    page.context.close()
    return pictures


def with_data(page: Any, sizes: list[Size]) -> dict[Size, dict[str, Image.Image]]:
    """Make a picture of each state of `WITH_DATA` at each size, in one visit: all sizes
    of a state before the next one.

    Args:
        page: just `opened`; it is closed with its context.
        sizes: of the window (width, height) [px].

    Returns:
        Size -> state -> picture.
    """
    pictures: dict[Size, dict[str, Image.Image]] = {size: {} for size in sizes}
    for state, reach in WITH_DATA.items():
        for width, height in sizes:
            page.set_viewport_size({"width": width, "height": height})
            reach(page)
            page.wait_for_timeout(FADED_MS)
            pictures[width, height][state] = pictured(page)
    page.context.close()
    return pictures


def sheet(pictures: list[Image.Image]) -> Image.Image:
    """Put pictures of one size side by side, `SHEET_COLUMNS` a row and each `SHEET_PX`
    wide; places left over in the last row are black.
    """
    width, height = pictures[0].size
    small = (SHEET_PX, round(SHEET_PX * height / width))
    rows = -(-len(pictures) // SHEET_COLUMNS)
    whole = Image.new("RGB", (small[0] * SHEET_COLUMNS, small[1] * rows))
    for place, picture in enumerate(pictures):
        row, column = divmod(place, SHEET_COLUMNS)
        whole.paste(picture.resize(small), (column * small[0], row * small[1]))
    return whole


def size_of(text: str) -> Size:
    """Parse a size, 1366x768."""
    width, height = text.split("x")
    return int(width), int(height)


def main() -> None:
    """Save a picture of each size, theme and state, and a sheet of each size, in the
    folder --out; starts a lab of its own without --url.
    """
    from playwright.sync_api import sync_playwright

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures")
    parser.add_argument("--sizes", type=size_of, nargs="+", default=list(SIZES))
    parser.add_argument("--theme", choices=THEMES, default=THEMES[0])
    parser.add_argument("--url", help="of a page that is served already")
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    with (
        nullcontext(chosen.url) if chosen.url else lab() as url,
        sync_playwright() as play,
    ):
        browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        visit = partial(opened, browser, url, theme=chosen.theme)
        first = {size: fresh(visit(size)) for size in chosen.sizes}
        later = with_data(visit(chosen.sizes[0]), chosen.sizes)
        for size in chosen.sizes:
            name = f"{size[0]}x{size[1]}"
            pictures = {**first[size], **later[size]}
            for state, picture in pictures.items():
                picture.save(chosen.out / f"{name}-{state}.png")
            sheet(list(pictures.values())).save(chosen.out / f"sheet-{name}.png")
        browser.close()


if __name__ == "__main__":
    main()
