"""The viewer's health report for monitoring."""

from __future__ import annotations

from importlib.metadata import version

from flexdt.clients.viewer.viewer import Viewer
from flexdt.server.runtime.http_pages import Pages, watching_pages
from flexdt.server.runtime.metrics import Figure, counter, gauge


def viewer_pages(viewer: Viewer) -> Pages:
    """The pages of a viewer that runs."""

    def health() -> dict[str, object]:
        return {
            "server": f"flexdt viewer {version('flexdt')}",
            "twin": "connected" if viewer.link.connected else "not connected",
        }

    def figures() -> list[Figure]:
        front = viewer.front
        return [
            gauge("flexdt_pages", "Pages open.", len(viewer.open_pages)),
            counter("flexdt_pages_total", "Pages that ever opened.", viewer.opened),
            counter("flexdt_scene_messages_dropped_total", "Messages of pages kept from viser.",
                    0 if front is None else front.doorkeeper.dropped),
            gauge("flexdt_scenes", "Views open.", 0 if front is None else front.scenes),
            counter("flexdt_states_drawn_total", "States drawn.", viewer.drawn),
            gauge("flexdt_twin_connected", "Whether there is one.", float(viewer.link.connected)),
            counter("flexdt_wrong_tokens_total", "Wrong tokens shown.",
                    0 if front is None else front.wrong_tokens),
        ]  # fmt: skip

    return watching_pages(health, figures, failed=viewer.failed.is_set)
