"""What the page measures in a radiograph, beside NumPy on the twin's own image; how large it
is."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from looking import film, point_at, seen

from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
DRAWN = random.Random(7)
BOXES = [
    tuple(DRAWN.randrange(n) for n in (956, 760, 956, 760)) for _ in range(6)
] + [(400, 300, 400, 300)]  # fmt: skip

TAGS_APART = """() => {
  const tags = [...document.querySelectorAll('#film-tags > div')];
  const before = tags.map((tag) => tag.hidden);
  tags.forEach((tag) => { tag.hidden = false; tag.textContent ||= 'of another pose'; });
  const boxes = tags.map((tag) => tag.getBoundingClientRect());
  tags.forEach((tag, k) => { tag.hidden = before[k]; });
  const meet = (a, b) => a.left < b.right && b.left < a.right
    && a.top < b.bottom && b.top < a.bottom;
  return boxes.length === 3 && boxes.every((a, k) => a.width > 0
    && boxes.slice(k + 1).every((b) => !meet(a, b)));
}"""
"""All that can be said of an image at once lies beside one another."""
WAY_BACK = """async () => {
  const bar = document.getElementById('scan-bar');
  const button = document.getElementById('volume-large');
  const hidden = [bar.hidden, button.hidden];
  bar.hidden = button.hidden = false;
  document.body.classList.add('whole');
  await new Promise((done) => setTimeout(done, 300));
  const { x, y, width, height } = button.getBoundingClientRect();
  const top = document.elementFromPoint(x + width / 2, y + height / 2);
  document.body.classList.remove('whole');
  [bar.hidden, button.hidden] = hidden;
  return top === button;
}"""
"""Nothing covers the button that ends an enlarged volume, a scan's line on top neither."""


@pytest.fixture(autouse=True)
def at_rest(page: Any, twin: TwinClient) -> Iterator[None]:
    """The page shows the image as it is on the wire, every pixel of it, whole and unmarked."""
    page.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    page.evaluate(
        "flexdt.call('camera.set', {roi: [32, 8, 1943, 1527], mode: 'HW2SW1High'})"
    )
    if abs(twin.state().axes["mag_det"].position - 1000) > 1e-6:
        middle = {
            "mag_obj": 600,
            "mag_det": 1000,
            "ver_tube": 26.29,
            "ver_det": 20,
            "tra_obj": 0,
        }
        page.evaluate(
            "t => flexdt.call('axes.move', {targets: t, plan: true, wait: true})", middle
        )
    seen(page, twin)
    shape = list(np.asarray(twin.projection().image).shape)
    page.wait_for_function(
        "s => flexdt.store.image?.shape.join() === s.join()"
        " && flexdt.store.image.code === 'deflate'",
        arg=shape,
    )
    yield
    if page.is_enabled("#difference"):
        page.uncheck("#difference")
    page.select_option("#tool", "pan")
    page.mouse.move(1, 1)


def mark(page: Any, tool: str, ends: tuple[int, ...]) -> None:
    page.select_option("#tool", tool)
    page.fill("#measure-at", " ".join(map(str, ends)))
    page.press("#measure-at", "Enter")


def alike(told: list[float], wanted: list[float], apart: float) -> bool:
    return len(told) >= len(wanted) and bool(
        np.allclose(told[: len(wanted)], wanted, rtol=0.0, atol=apart)
    )


def numbers(text: str) -> list[float]:
    return [
        float(w) for w in text.replace("·", " ").split() if w.lstrip("-")[:1].isdigit()
    ]


@pytest.mark.parametrize("box", BOXES)
def test_statistics_of_a_box(
    page: Any, twin: TwinClient, wait: Wait, box: tuple[int, int, int, int]
) -> None:
    image = np.asarray(twin.projection().image, dtype=float)
    (left, right), (top, bottom) = sorted(box[::2]), sorted(box[1::2])
    part = image[top : bottom + 1, left : right + 1]
    mark(page, "region", box)
    spread = [part.std(ddof=1)] if part.size > 1 else []
    wanted = [part.mean(), *spread, part.min(), part.max(), part.size]
    wait(
        lambda: alike(numbers(page.inner_text("#measured")), wanted, 2e-4),
        f"{wanted} of {box}",
    )


@pytest.mark.parametrize("along", ["row", "column"])
def test_profile_along_a_line(
    page: Any, twin: TwinClient, wait: Wait, along: str
) -> None:
    image = np.asarray(twin.projection().image, dtype=float)
    first, last = sorted(DRAWN.sample(range(700), 2))
    at = DRAWN.randrange(300, 500)
    # Longer lines than the plot has samples may leave pixels out.
    last = min(last, first + 400)
    line = image[at, first : last + 1] if along == "row" else image[first : last + 1, at]
    mark(
        page,
        "profile",
        (first, at, last, at) if along == "row" else (at, first, at, last),
    )
    wanted = [line.min(), line.max(), last - first]
    told = lambda: numbers(page.inner_text("#measured"))  # noqa: E731
    wait(lambda: alike(told(), wanted, 2e-3), f"{wanted}")
    assert page.is_visible("#profile")


def test_a_box_is_dragged(page: Any, wait: Wait) -> None:
    page.select_option("#tool", "region")
    point_at(page, 0.25, 0.25)
    page.mouse.down()
    point_at(page, 0.5, 0.5)
    page.mouse.up()
    ends = lambda: [float(v) for v in page.input_value("#measure-at").split()]  # noqa: E731
    wait(lambda: alike(ends(), [239, 190, 478, 380], 3), "its corners")
    page.fill("#measure-at", "1 2 three 4")
    page.press("#measure-at", "Enter")
    wait(lambda: "four numbers" in page.inner_text("#measured"))
    page.press("#measure-at", "Escape")


def test_the_loupe_enlarges_what_is_under_the_pointer(page: Any, wait: Wait) -> None:
    plain = film(page)
    page.select_option("#tool", "loupe")

    def enlarged() -> bool:
        point_at(page, 0.5, 0.5)
        now, (rows, cols) = film(page), plain.shape[:2]
        changed = np.abs(now - plain).max(axis=2) > 2
        far = changed[: rows // 2 - 80].any() or changed[:, : cols // 2 - 80].any()
        return bool(changed.sum() > 200 and not far)

    wait(enlarged, "a disc of 72 pixels about the middle")


def test_the_windows_end_is_pulled_on_the_histogram(page: Any, wait: Wait) -> None:
    box = page.locator("#histogram .u-over").bounding_box()
    high = float(page.input_value("#high")) / 1000
    page.mouse.move(box["x"] + high * box["width"], box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.2 * box["width"], box["y"] + 20, steps=4)
    page.mouse.up()
    assert abs(float(page.input_value("#high")) - 200) <= 3
    assert not page.is_checked("#auto-window")
    page.check("#auto-window")
    wait(lambda: abs(float(page.input_value("#high")) - 1000 * high) < 3, "auto again")


def test_the_transmission_of_dark_pixels_and_all(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    through = np.exp(-np.asarray(twin.projection().image, dtype=float))
    wanted = [100 * np.percentile(through, 1), 1.0, 100 * through.mean()]
    told = lambda: numbers(page.inner_text("#transmission"))  # noqa: E731
    wait(lambda: alike(told(), wanted, 0.4), f"{wanted}")


def test_an_image_without_beam_says_so(page: Any, twin: TwinClient, wait: Wait) -> None:
    assert page.inner_text("#film-beam") == "X-rays off: drawn as though on"
    page.evaluate("flexdt.call('tube.set', {on: true})")
    wait(
        lambda: twin.state().tube.ready and not page.is_visible("#film-beam"),
        "no word of it",
    )
    page.evaluate("flexdt.call('tube.set', {on: false})")
    wait(lambda: page.is_visible("#film-beam"))
    assert page.evaluate(TAGS_APART)


def test_the_difference_from_a_frame_that_was_kept(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    before = np.asarray(twin.projection().image, dtype=float)
    page.click("#keep-reference")
    page.check("#difference")
    page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 30}, relative: true})")
    wait(lambda: not twin.state().axes["rot_obj"].moving)
    seen(page, twin)
    apart = np.asarray(twin.projection().image, dtype=float) - before
    # In flat places, where no pixel beside it differs: the pointer may be a pixel off.
    flat = [
        (r, c) for r, c in DRAWN.choices([(r, c) for r in range(40, 720) for c in range(60, 890)],
                                         k=4000)
        if np.ptp(apart[r - 1 : r + 2, c - 1 : c + 2]) < 1e-3 and abs(apart[r, c]) > 0.02
    ]  # fmt: skip
    for r, c in flat[:3]:

        def told(r: int = r, c: int = c) -> bool:
            point_at(page, (c + 0.5) / 956, (r + 0.5) / 760)
            words = page.inner_text("#pixel").split()
            return len(words) > 2 and abs(float(words[2]) - apart[r, c]) < 3e-3

        wait(told, f"{apart[r, c]} at {c}, {r}")
    assert flat
    colours = film(page)
    assert (colours[..., 0] - colours[..., 2]).max() > 60, "more is orange"
    assert (colours[..., 2] - colours[..., 0]).max() > 60, "less is blue"


def test_the_radiograph_grows_and_the_stop_stays(page: Any, wait: Wait) -> None:
    # Its column: the film keeps the image's shape and is at most 58 % as high as the page.
    width = lambda: page.locator("#right").bounding_box()["width"]  # noqa: E731
    first = width()
    assert first > 0.34 * page.viewport_size["width"]
    page.focus("#splitter")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    wait(lambda: abs(width() - first - 64) < 2, "two steps of 32")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    page.click("#film-large")
    wait(lambda: width() > 0.9 * page.viewport_size["width"], "nearly all of the page")
    assert page.is_visible("#estop")
    page.keyboard.press("Escape")
    wait(lambda: abs(width() - first) < 2, "as before")
    page.locator("#splitter").dblclick()
    assert page.evaluate(WAY_BACK)


def test_keys_pan_and_zoom_the_radiograph(page: Any, wait: Wait) -> None:
    page.focus("#film-canvas")
    zoom = lambda: page.inner_text("#film-note").split("·")[-1].strip()  # noqa: E731
    page.keyboard.press("+")
    page.keyboard.press("+")
    wait(lambda: zoom() == "1.6×")
    page.keyboard.press("0")
    wait(lambda: "×" not in zoom())


def test_setup_names_the_physics_and_draws_the_spectrum(page: Any, wait: Wait) -> None:
    page.click("#tabs [data-tab=setup]")
    wait(lambda: "mean" in page.inner_text("#spectrum-note"), "the spectrum")
    assert page.inner_text("#physics") == "ideal"
    assert "Voltage does not change line integrals" in page.inner_text("#physics-note")
    assert page.inner_text("#filters") == "0.50 mm Al"
    for kV in (40, 90):
        told = page.evaluate("kV => flexdt.call('viewer.spectrum', {kV})", kV)
        highest = max(
            e for e, n in zip(told["energy_keV"], told["photons"], strict=True) if n > 0
        )
        assert kV - 2 < highest <= kV + 1, "no photon has more than the electrons"
        assert 0.3 * kV < told["mean_keV"] < 0.7 * kV
    page.click("#predict")
    wait(lambda: "contrast to noise of" in page.inner_text("#predicted"), "a prediction")
    refused = page.evaluate(
        "flexdt.call('viewer.spectrum', {kV: 900}).catch((e) => e.message)"
    )
    assert "the voltage of a spectrum is 900;" in refused
    page.click("#tabs [data-tab=move]")
