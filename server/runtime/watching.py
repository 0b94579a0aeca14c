"""The pages `/healthz` and `/metrics` of a server, for monitoring.

Twin, projector and viewer supply the figures; this module puts them into the pages.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterable, Mapping
from http import HTTPStatus

from flexdt.server.runtime.http_pages import Page, Pages
from flexdt.server.runtime.log import dropped
from flexdt.server.runtime.loop import Holds, ServerLoop
from flexdt.server.runtime.metrics import (
    CONTENT_TYPE,
    Figure,
    Requests,
    counter,
    gauge,
    histogram,
    process_figures,
    render,
    since_1970,
)


def watching_pages(
    health: Callable[[], Mapping[str, object]],
    figures: Callable[[], Iterable[Figure]],
    requests: Requests | None = None,
    *,
    failed: Callable[[], bool] = lambda: False,
) -> Pages:
    """The pages of a server that runs.

    Args:
        health: content of `/healthz` beside its status.
        figures: of `/metrics`, beside those that every process has.
        requests: answered so far; None where there are none to count.
        failed: whether a part of the server has died; then `/healthz` answers 503.
    """
    started = since_1970()

    def healthz() -> Page:
        dead = failed()
        document = {"status": "failed" if dead else "ok", **health()}
        status = HTTPStatus.SERVICE_UNAVAILABLE if dead else HTTPStatus.OK
        return Page(json.dumps(document) + "\n", status)

    def metrics() -> Page:
        lost = counter("flexdt_log_dropped_total", "Log lines nobody took in time.", dropped())
        all_figures = [*figures(), lost, *process_figures(started)]
        holds, more = _holds(), list[str]()
        if holds is not None:
            name, what = "flexdt_loop_hold_seconds", "How long each turn held the event loop."
            more += histogram(name, what, [({}, holds.turns)])
            worst = "The longest turn since the last scrape."
            all_figures.append(gauge("flexdt_loop_hold_worst_seconds", worst, holds.worst()))
        return Page(render(requests or Requests(), all_figures, more), content_type=CONTENT_TYPE)

    return {"/healthz": healthz, "/metrics": metrics}


def _holds() -> Holds | None:
    loop = asyncio.get_running_loop()
    return loop.holds if isinstance(loop, ServerLoop) else None
