"""Names in a picture: none covers another, and leaders do not cross."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from looking import drawn, settled, until

from flexdt.clients.client.client import TwinClient
from flexdt.clients.viewer.scenes.name_tags import laid_out, leader_end
from tests.viewer.test_page_parts import corners_m
from tests.viewer.test_viewer_scenes import _on_screen, preset

AREA = (520.0, 700.0)
GRID_PX = 7
OVER = """step => {
  const view = document.querySelector('.view[data-view=iso]'), at = view.getBoundingClientRect();
  const found = [];
  for (let y = step / 2; y < at.height; y += step)
    for (let x = step / 2; x < at.width; x += step) {
      const top = document.elementsFromPoint(at.left + x, at.top + y)
        .find((e) => (view.contains(e) && e !== view) || e.closest('.warning, .note'));
      found.push([x, y, top !== undefined && top.tagName !== 'IFRAME']);
    }
  return found;
}"""
"""Whether something of the page lies over the view's picture, at places [px]."""
LISTEN = """
const send = WebSocket.prototype.send;
WebSocket.prototype.send = function (words) {
  const asked = typeof words === 'string' ? JSON.parse(words) : {};
  if (asked.method === 'viewer.covered') window.covered = asked.params;
  return send.call(this, words);
};
"""

NOTES = """() => [...document.querySelectorAll('#notes .note')]
  .filter((note) => getComputedStyle(note).visibility === 'visible')
  .map((note) => [note.textContent, ...Object.values(note.getBoundingClientRect().toJSON())])"""
SAY = """count => import('/link.js').then(({ emit }) => {
  for (let k = 0; k < count; k++)
    emit('note', 'error', `note ${k}`, 'the holder would be too near to the source: '.repeat(2));
})"""


def crossing(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> bool:
    """By linear algebra: where the two straight lines meet, within both."""
    matrix = np.column_stack([b - a, c - d])
    if abs(np.linalg.det(matrix)) < 1e-9:
        return False
    s, t = np.linalg.solve(matrix, c - a)
    return bool(1e-9 < s < 1 - 1e-9 and 1e-9 < t < 1 - 1e-9)


@pytest.mark.parametrize("seed", range(25))
def test_no_name_covers_another_or_leaves_the_picture(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 16))
    middle, spread = rng.uniform(100, 420, 2), rng.uniform(5, 250)
    anchors = np.clip(rng.normal(middle, spread, (count, 2)), 1, np.array(AREA) - 1)
    sizes = np.column_stack([rng.uniform(30, 150, count), np.full(count, 22.0)])
    taken = rng.uniform(0, 500, (3, 1)) + [0.0, 0.0, 120.0, 40.0]
    corners = laid_out(anchors, sizes, AREA, taken)
    assert not np.isnan(corners).any()
    for (p, s), box in itertools.product(zip(corners, sizes, strict=True), taken):
        assert (np.minimum(p + s, box[2:]) - np.maximum(p, box[:2])).min() <= 0.0
    for (p, s), (q, t) in itertools.combinations(zip(corners, sizes, strict=True), 2):
        over = np.minimum(p + s, q + t) - np.maximum(p, q)
        assert over.min() <= 0.0
    assert (corners >= 0).all()
    assert (corners + sizes <= AREA).all()


@pytest.mark.parametrize("seed", range(25))
@pytest.mark.daily(15)
def test_leaders_of_names_of_one_size_never_cross(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    count = int(rng.integers(2, 14))
    anchors = rng.uniform(150, 370, 2) + rng.uniform(-90, 90, (count, 2))
    sizes = np.tile([90.0, 20.0], (count, 1))
    corners = laid_out(anchors, sizes, AREA)
    ends = corners + 0.5 * sizes
    for i, j in itertools.combinations(range(count), 2):
        assert not crossing(ends[i], anchors[i], ends[j], anchors[j])


def test_what_is_out_of_sight_has_no_name_and_a_full_picture_fewer() -> None:
    anchors = np.array([[np.nan, 5.0], [-3.0, 40.0], [50.0, 40.0]])
    sizes = np.tile([60.0, 20.0], (3, 1))
    there = ~np.isnan(laid_out(anchors, sizes, (200.0, 120.0))[:, 0])
    assert there.tolist() == [False, False, True]
    crowd = np.tile([60.0, 40.0], (30, 1)) + np.arange(30)[:, None] * 0.1
    placed = laid_out(crowd, np.tile([70.0, 22.0], (30, 1)), (200.0, 120.0))
    assert 2 <= (~np.isnan(placed[:, 0])).sum() < 30


@pytest.mark.browser
@pytest.mark.parametrize("size", [(390, 844), (820, 1180), (1366, 768)])
def test_what_a_page_lays_over_a_view_is_where_no_name_is_put(
    open_page: Callable[..., Any], size: tuple[int, int]
) -> None:
    """As the browser finds it, point by point; also once the camera has gone to the sample."""
    page = open_page("iso", size, script=LISTEN)
    page.add_style_tag(
        content=":is(.tag, .warning, .note) { pointer-events: auto !important }"
    )

    def told_all() -> bool:
        boxes = np.array(page.evaluate("window.covered?.boxes ?? []")).reshape(-1, 4)
        for x, y, over in page.evaluate(OVER, GRID_PX):
            apart = np.maximum(boxes[:, :2] - [x, y], [x, y] - boxes[:, 2:]).max(axis=1)
            rounded = (np.abs(apart) < 8.0).any()  # corners are round
            if not rounded and bool((apart < 0.0).any()) != over:
                return False
        return len(boxes) > 0

    page.wait_for_function("document.querySelector('.inset img').naturalWidth > 0")
    page.evaluate(SAY, 1)
    until(told_all, "what lies over the view is told")
    count = page.evaluate("window.covered.boxes.length")
    assert page.evaluate("flexdt.call('viewer.covered', window.covered)") is not None
    page.click(".view[data-view=iso] .look")
    until(
        lambda: page.evaluate("window.covered.boxes.length") == count - 1, "no close-up"
    )
    until(told_all, "what lies over the view then")
    page.close()


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.parametrize("size", [(820, 1180), (1366, 768)])
def test_no_note_but_the_newest_stands_over_source_or_turntable(
    open_page: Callable[..., Any], twin: TwinClient, size: tuple[int, int]
) -> None:
    """Where these are is computed from the machine's boxes and the view's preset."""
    page = open_page("iso", size)
    box = page.locator(".view[data-view=iso]")
    settled(box, drawn)
    page.wait_for_function("document.querySelector('.inset img').naturalWidth > 0")
    frame = box.bounding_box()
    camera, corners = preset(page, "iso", frame), corners_m(twin.state())
    subject = {
        name: np.array([_on_screen(frame, camera, at) for at in points])
        for name, points in (
            ("source", corners["xray_source"].mean(axis=0, keepdims=True)),
            ("turntable", corners["sample_holder"]),
        )
    }
    page.evaluate(SAY, 5)
    until(lambda: len(page.evaluate(NOTES)) < 5, "notes yield")
    seen = page.evaluate(NOTES)
    assert seen[-1][0].startswith("note 4")
    for words, *_, top, right, bottom, left in seen[:-1]:
        for name, at in subject.items():
            low, high = at.min(axis=0) + 2.0, at.max(axis=0) - 2.0  # the page rounds
            apart = np.maximum(low - [right, bottom], [left, top] - high).max()
            assert apart >= 0.0, (words, name)
    page.close()


def test_a_leader_ends_at_its_box() -> None:
    corner, size = np.array([10.0, 20.0]), np.array([40.0, 10.0])
    for anchor, end in (([0, 0], [10, 20]), ([30, 90], [30, 30]), ([99, 25], [50, 25])):
        assert leader_end(np.array(anchor, dtype=float), corner, size).tolist() == end


def test_three_names_take_a_few_milliseconds() -> None:
    anchors, sizes = (
        np.array([[80.0, 400], [250, 300], [420, 200]]),
        np.tile([90.0, 22.0], (3, 1)),
    )
    begun = time.process_time()
    for _ in range(5):
        laid_out(anchors, sizes, AREA)
    assert (time.process_time() - begun) / 5 < 0.2
