"""How a projector is, for machines that watch: the pages `/healthz` and `/metrics`.

It refuses to name volumes: they may be somebody's samples.
"""

from __future__ import annotations

import json
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
from flexdt.server.projector.service import ProjectorServer


def projector_pages(server: ProjectorServer, requests: Requests) -> Pages:
    """The pages of a projector that runs."""
    started, context = since_1970(), server.context

    def healthz() -> Page:
        document = {"status": "ok", "server": f"flexdt projector {version('flexdt')}"}
        return Page(json.dumps(document) + "\n")

    def metrics() -> Page:
        store = context.store
        figures = [
            gauge("flexdt_connections", "Clients connected.", len(context.clients)),
            counter("flexdt_views_total", "Views projected.", context.views),
            counter("flexdt_superseded_total", "Requests overtaken.", context.superseded),
            gauge("flexdt_waiting", "Pieces of work that wait.", len(context.compute.queue)),
            gauge("flexdt_volumes", "Volumes and scenes held.", len(store)),
            gauge("flexdt_volume_bytes", "Memory they take.", store.used),
            gauge("flexdt_volume_limit_bytes", "Memory they may take.", store.limit),
            counter("flexdt_log_dropped_total", "Log lines nobody took in time.", dropped()),
            *process_figures(started),
        ]
        return Page(render(requests, figures), content_type=CONTENT_TYPE)

    return {"/healthz": healthz, "/metrics": metrics}
