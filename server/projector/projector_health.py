"""The health and metrics pages of a projector.

Volumes are counted but not named, since names may reveal a user's samples.
"""

from __future__ import annotations

from importlib.metadata import version

from flexdt.server.projector.service import ProjectorServer
from flexdt.server.runtime.http_pages import Pages
from flexdt.server.runtime.metrics import Figure, Requests, counter, gauge
from flexdt.server.runtime.watching import watching_pages


def projector_pages(server: ProjectorServer, requests: Requests) -> Pages:
    """The pages of a projector that runs."""
    context = server.context

    def health() -> dict[str, object]:
        return {"server": f"flexdt projector {version('flexdt')}"}

    def figures() -> list[Figure]:
        store = context.store
        return [
            gauge("flexdt_connections", "Clients connected.", len(context.clients)),
            counter("flexdt_views_total", "Views projected.", context.views),
            counter("flexdt_superseded_total", "Requests overtaken.", context.superseded),
            gauge("flexdt_waiting", "Pieces of work that wait.", len(context.compute.queue)),
            gauge("flexdt_volumes", "Volumes and scenes held.", len(store)),
            gauge("flexdt_volume_bytes", "Memory they take.", store.used),
            gauge("flexdt_volume_limit_bytes", "Memory they may take.", store.limit),
        ]

    return watching_pages(health, figures, requests)
