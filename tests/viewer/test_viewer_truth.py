"""What the page says of its own age: servers that hang, images of another pose, what is
refused."""

from __future__ import annotations

import base64
import io
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from looking import released, seen
from PIL import Image
from websockets.sync.client import connect

from flexdt.clients.client.client import TwinClient

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
SHOWN_S = 2.0
"""What hangs is seen so soon [s]."""
TOLD_S = 4.0
"""And a stop that nobody confirms is told so soon [s]."""
ORANGE, RED = (255, 176, 48), (255, 64, 48)
HEARD_S = 0.8
"""What another client hears so late, at most, is no silence that a page is to tell of [s]."""
TRIES = 6
"""Of which a busy machine may spoil all but one."""


@contextmanager
def hung(process: Any) -> Iterator[float]:
    """A process that does nothing meanwhile; the time at which it was halted."""
    process.process.send_signal(signal.SIGSTOP)
    try:
        yield time.time()
    finally:
        process.process.send_signal(signal.SIGCONT)


@contextmanager
def heard_elsewhere(lab: Any) -> Iterator[list[float]]:
    """How late another client of the viewer hears each of its beats, and of the twin [s]."""
    late_s, ended = [0.0], threading.Event()
    address = f"ws://127.0.0.1:{lab.viewer.port}/ws/{'b' * 12}"

    def listen() -> None:
        with connect(address, max_size=None, proxy=None) as socket:
            last = time.monotonic()
            while not ended.is_set():
                message = socket.recv()
                if isinstance(message, str) and '"beat"' in message[:20]:
                    now, told = time.monotonic(), json.loads(message)
                    late_s.append(now - last + told["silent_s"])
                    last = now

    listener = threading.Thread(target=listen)
    listener.start()
    try:
        yield late_s
    finally:
        ended.set()
        listener.join()


def watch(page: Any, selector: str, words: str) -> None:
    """The page notes itself when an element says `words`: asking it takes a busy machine
    long."""
    page.evaluate(
        "([selector, words]) => { window.watcher?.disconnect(); window.shownAt = null;"
        " const node = document.querySelector(selector);"
        " const look = () => { if (!node.hidden && node.innerText.includes(words))"
        " window.shownAt ??= Date.now() / 1000; };"
        " window.watcher = new MutationObserver(look); window.watcher.observe(node,"
        " { attributes: true, childList: true, subtree: true, characterData: true }); }",
        [selector, words],
    )


def noted(page: Any, wait: Wait) -> float:
    """When it did [s since 1970]."""
    return float(wait(lambda: page.evaluate("window.shownAt"), "what was waited for"))


def tell(shown: list[float]) -> None:
    """What `pytest -s` prints: how many seconds it took, in each try."""
    print(f"seen after {', '.join(f'{s:.2f}' for s in shown)} s")


def veil(page: Any) -> str:
    return str(
        page.evaluate("document.querySelector('#veil:not([hidden])')?.innerText ?? ''")
    )


def age(page: Any) -> float:
    """How old the veil says that the state is [s]."""
    return float(veil(page).split(" s old")[0].split()[-1])


@pytest.mark.parametrize("name", ["twin", "viewer"])
def test_a_hung_server_is_seen(page: Any, lab: Any, wait: Wait, name: str) -> None:
    shown = []
    while not shown or (min(shown) >= SHOWN_S and len(shown) < TRIES):
        wait(lambda: not veil(page))
        watch(page, "#veil", "s old")
        known = time.time() - page.evaluate("flexdt.store.age")
        with hung(getattr(lab, name)) as begun:
            shown.append(noted(page, wait) - begun)
            assert "s old" in page.inner_text("#connection")
            wait(lambda: age(page) >= 3.0, "the age grows")
            assert age(page) <= time.time() - known + 1.2
        wait(lambda: not veil(page), "the veil goes")
        assert page.inner_text("#connection") == "connected"
    tell(shown)
    assert min(shown) < SHOWN_S


@pytest.mark.parametrize("name", ["twin", "viewer"])
@pytest.mark.campaign(1)
def test_a_killed_server_is_seen(page: Any, lab: Any, wait: Wait, name: str) -> None:
    shown = []
    while not shown or (min(shown) >= SHOWN_S and len(shown) < TRIES):
        watch(page, "#veil", f"The {name} is away")
        begun = time.time()
        getattr(lab, name).stop(signal.SIGKILL)
        shown.append(noted(page, wait) - begun)
        getattr(lab, f"restart_{name}")()
        wait(lambda: not veil(page), "the veil goes")
    tell(shown)
    assert min(shown) < SHOWN_S


STALLS = """
([length, times]) => new Promise((done) => {
  const veil = document.querySelector('#veil'), said = [];
  const watch = new MutationObserver(() => { if (!veil.hidden) said.push(veil.textContent); });
  watch.observe(veil, { attributes: true, childList: true, subtree: true });
  const stall = (left) => {
    const end = performance.now() + length;
    while (performance.now() < end);
    if (left > 1) setTimeout(() => stall(left - 1), 150);
    else setTimeout(() => { watch.disconnect(); done(said); }, 2000);
  };
  setTimeout(() => stall(times), 100);
})
"""
"""The page's main thread is blocked for so many ms, so often; what the veil says meanwhile."""


@pytest.mark.parametrize(("length_ms", "times"), [(4000, 1), (900, 5)])
def test_a_page_that_stood_still_itself_blames_nobody(
    page: Any, lab: Any, length_ms: int, times: int
) -> None:
    """Its own main thread was blocked: viewer and twin have answered all along.

    A try in which another client heard nothing for a while is no such case, and is repeated.
    """
    for _ in range(TRIES):
        with heard_elsewhere(lab) as late_s:
            said = page.evaluate(STALLS, [length_ms, times])
        if max(late_s) < HEARD_S:
            assert said == []
            return
    pytest.fail(
        f"viewer or twin were silent in each try, at last for {max(late_s):.1f} s"
    )


def test_an_emergency_stop_that_nobody_confirms_is_said(
    page: Any, lab: Any, wait: Wait
) -> None:
    shown = []
    while not shown or (min(shown) >= TOLD_S and len(shown) < TRIES):
        watch(page, "#veil", "E-stop not confirmed")
        page.locator("#estop").evaluate(
            "e => e.addEventListener('click', () => { window.clickedAt = Date.now() / 1000; },"
            " { once: true, capture: true })"
        )
        with hung(lab.twin):
            page.click("#estop")
            shown.append(noted(page, wait) - page.evaluate("window.clickedAt"))
            assert "the machine's own emergency stop button" in veil(page)
        wait(lambda: not veil(page), "the veil goes")
        released(page)
    tell(shown)
    assert min(shown) < TOLD_S


def test_requests_to_a_hung_twin_end(open_page: Callable[..., Any], lab: Any) -> None:
    alone = open_page(patience=5)
    with hung(lab.twin):
        words = alone.evaluate("flexdt.call('state.get').catch((e) => e.message)")
    alone.close()
    assert "no answer for 5 s" in words
    assert "it may still take effect" in words


def test_a_radiograph_of_another_pose_is_said_to_be_old(
    page: Any, lab: Any, twin: TwinClient, wait: Wait
) -> None:
    wait(
        lambda: page.evaluate(
            "flexdt.store.image !== null && flexdt.store.imageAge === 0"
        )
    )
    shown = []
    while not shown or (min(shown) >= SHOWN_S and len(shown) < TRIES):
        watch(page, "#film-old", "of another pose")
        with hung(lab.projector) as begun:
            page.evaluate(
                "flexdt.call('axes.move', {targets: {rot_obj: 40}, relative: true})"
            )
            shown.append(noted(page, wait) - begun)
            assert page.is_visible("#film-old")
            wait(lambda: not veil(page), "states are as new as ever")
        wait(lambda: not page.is_visible("#film-old"), "the mark goes")
    tell(shown)
    assert min(shown) < SHOWN_S


def test_saturation_is_said(page: Any, twin: TwinClient, wait: Wait) -> None:
    before = twin.state()
    page.evaluate("flexdt.call('tube.set', {kV: 90, power_W: 70})")
    page.evaluate("flexdt.call('camera.set', {exposure_ms: 500})")
    try:
        page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 1}, relative: true})")
        wait(lambda: "saturated" in page.inner_text("#warnings"), "the warning")
    finally:
        tube, camera = before.tube, before.camera
        page.evaluate(
            "([kV, power_W]) => flexdt.call('tube.set', {kV, power_W})",
            [tube.kV, tube.power_W],
        )
        page.evaluate(
            "t => flexdt.call('camera.set', {exposure_ms: t})", camera.exposure_ms
        )
        page.evaluate("flexdt.call('axes.move', {targets: {rot_obj: 1}, relative: true})")
    wait(lambda: "saturated" not in page.inner_text("#warnings"), "the warning goes")


BINS = 128
BARS_DRAWN = """
bins => {
  const canvas = document.querySelector('#histogram canvas');
  const box = canvas.getBoundingClientRect();
  const area = document.querySelector('#histogram .u-over').getBoundingClientRect();
  const unit = canvas.width / box.width, image = flexdt.store.image;
  const rows = Math.round(area.height * unit), top = Math.round((area.top - box.top) * unit);
  const blue = column => {
    const d = canvas.getContext('2d').getImageData(column, top, 1, rows).data;
    return d.filter((v, k) => k % 4 == 2 && v > d[k - 2] + 60 && d[k + 1] > 60).length;
  };
  const column = k => Math.round((area.left - box.left + area.width * (k + .5) / bins) * unit);
  const ends = [Math.min(0, image.low), Math.max(image.low + image.scale * 65535, .1)];
  const [low, high] = ['#low', '#high'].map(
    id => ends[0] + (ends[1] - ends[0]) * document.querySelector(id).valueAsNumber / 1000);
  return [[...Array(bins).keys()].map(k => blue(column(k))), ends, [low, high]];
}
"""
"""Height in pixels of each bar of the histogram, its ends and those of the window."""


def test_the_histogram_counts_what_the_image_holds(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    # Rows and columns of the film are those of the wire; the page looks at every seventh pixel.
    values = np.asarray(twin.projection().image, dtype=np.float64).ravel()[::7]

    def counts_it() -> bool:
        # Whatever coarse or earlier image is still on its way, at rest the page has this one.
        ask = (
            "import('/film.js').then((m) => [...m.histogram(flexdt.store.image, [0, 1])])"
        )
        bins = np.array(page.evaluate(ask))
        right, _ = np.histogram(np.clip(values, 0.0, 1.0 - 1e-9), bins.size, (0.0, 1.0))
        # A value on the edge of a bin may fall on either side of it.
        near = np.abs(np.cumsum(bins - right)).max() <= 0.002 * values.size
        return bool(bins.sum() == values.size and near)

    wait(lambda: page.evaluate("flexdt.store.image?.code === 'deflate'"))
    wait(counts_it, "the image's histogram")

    def draws_it() -> bool:
        # Bars are drawn after the image has come, with its ends.
        heights, ends, window = page.evaluate(BARS_DRAWN, BINS)
        shares, edges = np.histogram(values, BINS, ends)
        percent = 100.0 * shares / shares.sum()
        middles = (edges[1:] + edges[:-1]) / 2
        apart = np.abs(np.subtract.outer(middles, window)).min(axis=1)
        free = apart > 2 * np.diff(edges)[0]
        rising = np.log1p(percent[free] / 0.01)
        alike = np.corrcoef(rising, np.array(heights)[free])[0, 1] > 0.99
        return bool(alike and free.sum() > BINS / 2)

    wait(draws_it, "the histogram's bars")
    flags = twin.state().image
    assert flags is not None
    seen(page, twin)
    assert page.inner_text("#starved").startswith(f"starved {100 * flags.starved:.0f}")


DRAWN_WITH_FLAGS = """
image => {
  const store = flexdt.store, before = [store.image, store.state];
  const box = document.querySelector('#show-flags'), was = box.checked;
  store.state = { ...store.state, tube: { ...store.state.tube, on: true, ready: true } };
  store.image = { ...image, pixels: Uint16Array.from(image.pixels) };
  box.checked = true;
  const drawn = flexdt.picture();
  [store.image, store.state] = before; box.checked = was;
  return drawn;
}
"""


@pytest.mark.parametrize("bits", [14, 16])
@pytest.mark.parametrize("code", ["deflate", "jpeg"])
@pytest.mark.parametrize("kind", ["counts", "line_integral"])
def test_flags_are_drawn_by_the_cameras_limits(
    page: Any, bits: int, code: str, kind: str
) -> None:
    """As the page gets images at rest and in motion, of cameras of any depth."""
    rng, full = np.random.default_rng([bits, len(code), len(kind)]), 2.0**bits - 1.0
    for most in (0.7, 0.99, 1.0, 1.0):
        if kind == "counts":
            good, values = (110.0, full), rng.uniform(0.0, most * full, (24, 31))
            values[0, :9], values[-1, :5] = most * full, (0, 50, 99, 100, 105)
            low_flag, high_flag = ORANGE, RED
        else:
            good, values = (0.2, 6.0), rng.uniform(0.0, 8.0 * most, (24, 31))
            low_flag, high_flag = RED, ORANGE
        low, scale = 0.0, 1.0
        if code == "jpeg" or kind == "line_integral":
            low, scale = values.min(), np.ptp(values) / 65535.0
        pixels = np.rint((values - low) / scale)
        if code == "jpeg":
            pixels = 257.0 * np.rint(pixels / 257.0)
        image = {
            "kind": kind, "code": code, "shape": [24, 31], "full": [24, 31], "low": low,
            "scale": scale, "window": [0.0, 1.0], "beads": [], "pixels": pixels.ravel().tolist(),
            "cone_vec": [0.0] * 12, "seq": 1,
            "flags": {"good_counts": good, "good_lines": good, "saturated": 0, "starved": 0},
        }  # fmt: skip
        url = page.evaluate(DRAWN_WITH_FLAGS, image)
        raw = base64.b64decode(url.partition(",")[2])
        drawn = np.asarray(Image.open(io.BytesIO(raw)).convert("RGB"), dtype=int)
        step = 0.51 * scale * (257.0 if code == "jpeg" else 1.0)
        for flag, wanted, edge in (
            (low_flag, values < good[0], good[0]),
            (high_flag, values >= good[1], good[1]),
        ):
            clear = (np.abs(values - edge) > 2 * step) | (values == full)
            found = np.abs(drawn - flag).max(axis=2) < 3
            np.testing.assert_array_equal(found[clear], wanted[clear])


def test_a_move_that_halts_early_is_not_called_standing(
    page: Any, twin: TwinClient, wait: Wait
) -> None:
    """The motion that the note speaks of is the one that takes place, in what was typed."""
    home = {"mag_obj": 600.0, "mag_det": 1000.0}
    page.evaluate("t => flexdt.call('axes.move', {targets: t, plan: true})", home)

    def rest() -> bool:
        return not any(a.moving for a in twin.state().axes.values())

    wait(lambda: rest() and abs(twin.state().axes["mag_det"].position - 1000.0) < 1e-6)
    page.evaluate(
        "for (const s of document.querySelectorAll('[data-axis=mag_det] input[type=range]'))"
        "{ s.value = s.min; s.dispatchEvent(new Event('change')); }"
    )
    words = wait(
        lambda: page.evaluate("document.querySelector('#notes .error b')?.textContent")
    )
    wait(rest)
    reached = twin.state().axes["mag_det"].position
    page.evaluate("t => flexdt.call('axes.move', {targets: t, plan: true})", home)
    if reached == 1000.0:
        assert words == "mag_det does not move"
    else:
        assert words == f"mag_det goes to {reached:.2f} and halts there"
    wait(lambda: rest() and abs(twin.state().axes["mag_det"].position - 1000.0) < 1e-6)
    page.locator("#notes").evaluate("e => e.replaceChildren()")
    page.get_by_label("Source to detector").fill("260")
    page.keyboard.press("Enter")
    words = wait(
        lambda: page.evaluate("document.querySelector('#notes .error b')?.textContent")
    )
    wait(rest)
    geometry = twin.state().geometry
    page.evaluate("t => flexdt.call('axes.move', {targets: t, plan: true})", home)
    assert geometry is not None
    assert words == f"Source to detector halts at {geometry.SDD_mm:.2f} mm"
