"""The pages `/healthz` and `/metrics` of a server, for machines that watch.

Twin, projector and viewer say what to tell; how it is told is here, once. It refuses to know what
any figure means.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from http import HTTPStatus

from flexdt.server.http import Page, Pages
from flexdt.server.log import dropped
from flexdt.server.metrics import (
    CONTENT_TYPE,
    Figure,
    Requests,
    counter,
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
        health: what `/healthz` says beside its status.
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
        return Page(render(requests or Requests(), all_figures), content_type=CONTENT_TYPE)

    return {"/healthz": healthz, "/metrics": metrics}
