"""How a viewer is, for machines that watch: the pages `/healthz` and `/metrics`.

It refuses to tell who looks at what.
"""

from __future__ import annotations

import json
from http import HTTPStatus
from importlib.metadata import version

from flexdt.server.http import Page, Pages
from flexdt.server.log import dropped
from flexdt.server.metrics import (
    CONTENT_TYPE,
    Requests,
    counter,
    gauge,
    process_figures,
    render,
    since_1970,
)
from flexdt.server.viewer.app import Viewer


def viewer_pages(viewer: Viewer) -> Pages:
    """The pages of a viewer that runs."""
    started = since_1970()

    def healthz() -> Page:
        failed = viewer.failed.is_set()
        document = {
            "status": "failed" if failed else "ok",
            "server": f"flexdt viewer {version('flexdt')}",
            "twin": "connected" if viewer.link.connected else "not connected",
        }
        status = HTTPStatus.SERVICE_UNAVAILABLE if failed else HTTPStatus.OK
        return Page(json.dumps(document) + "\n", status)

    def metrics() -> Page:
        front = viewer.front
        figures = [
            gauge("flexdt_pages", "Pages open.", len(viewer.open_pages)),
            counter("flexdt_pages_total", "Pages that ever opened.", viewer.opened),
            gauge("flexdt_scenes", "Views open.", 0 if front is None else front.scenes),
            counter("flexdt_states_drawn_total", "States drawn.", viewer.drawn),
            gauge("flexdt_fits", "Calibrations under way.", float(viewer.fitter.busy)),
            gauge("flexdt_twin_connected", "Whether there is one.", float(viewer.link.connected)),
            counter("flexdt_wrong_tokens_total", "Wrong tokens shown.",
                    0 if front is None else front.wrong_tokens),
            counter("flexdt_log_dropped_total", "Log lines nobody took in time.", dropped()),
            *process_figures(started),
        ]  # fmt: skip
        return Page(render(Requests(), figures), content_type=CONTENT_TYPE)

    return {"/healthz": healthz, "/metrics": metrics}
