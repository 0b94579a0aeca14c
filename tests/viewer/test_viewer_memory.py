"""A minute of motion leaves no memory behind, in the viewer's process and in the page.

The long form is `python tests/studies/viewer_study.py --minutes 30`. What is compared are the
medians of two halves after a warm-up, the page's heap after a collection, so that a pause or a
cache that fills once decides nothing.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.browser, pytest.mark.slow]

WARM_UP_S, MEASURED_S, EVERY_S = 15.0, 45.0, 1.5
PAGE_MB, VIEWER_MB = 2.0, 10.0
"""Growth allowed between the halves, whose middles lie 22 s apart. Images that are kept would
be some MB a second in either place, states that are kept more than 2 MB between the page's
halves."""


def resident_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def heap_mb(page: Any, session: Any) -> float:
    session.send("HeapProfiler.collectGarbage")
    return float(session.send("Runtime.getHeapUsage")["usedSize"]) / 1e6


def growth(values: list[float]) -> float:
    half = len(values) // 2
    return statistics.median(values[half:]) - statistics.median(values[:half])


@pytest.mark.campaign
def test_memory_is_flat_over_a_minute_of_motion(
    open_page: Callable[..., Any], lab: Any
) -> None:
    page = open_page("side", (900, 600))
    session = page.context.new_cdp_session(page)
    page.evaluate("flexdt.call('session.control', {action: 'force'})")
    page.evaluate("flexdt.call('clock.set', {speed_up: 1})")
    here = page.evaluate("flexdt.store.state.axes.rot_obj.position")
    away = 7000 if here < 0 else -7000
    page.evaluate("v => flexdt.call('axes.move', {targets: {rot_obj: v}})", away)
    received = "[flexdt.store.received.state, flexdt.store.received.image]"
    before = page.evaluate(received)
    begun = time.monotonic()
    heap, resident = [], []
    while (at := time.monotonic() - begun) < WARM_UP_S + MEASURED_S:
        page.wait_for_timeout(1000 * EVERY_S)
        if at > WARM_UP_S:
            heap.append(heap_mb(page, session))
            resident.append(resident_mb(lab.viewer.process.pid))
    states, images = (b - a for a, b in zip(before, page.evaluate(received), strict=True))
    page.evaluate("flexdt.call('axes.stop')")
    page.evaluate("flexdt.call('clock.set', {speed_up: 8})")
    page.close()
    # It was under way all the time, also on a machine that is busy with other things.
    assert states > 100
    assert images > 30
    assert len(heap) >= 8
    assert growth(heap) < PAGE_MB, heap
    assert growth(resident) < VIEWER_MB, resident
