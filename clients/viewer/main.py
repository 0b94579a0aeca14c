"""`python -m flexdt.clients.viewer.main`: the lab in the browser as a process.

Prints one JSON `ready` line on standard output once browsers may come; the twin may come later
or go and come back. SIGTERM and SIGINT end it cleanly. Nothing else is printed there.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from importlib.metadata import version
from typing import TYPE_CHECKING, TextIO

from prometheus_client import Metric

from flexdt.clients.client.kept_connection import TwinAddress
from flexdt.library import machines
from flexdt.runtime.access import (
    ViewerLimits,
    client_tls,
    read_token,
    server_tls,
    with_limits,
)
from flexdt.runtime.http_pages import Pages, counter, gauge, served_pages, watching_pages
from flexdt.runtime.log import LEVELS, set_up
from flexdt.runtime.process import (
    FAILED,
    OK,
    announce,
    first_of,
    read_if_there,
    run_process,
    stop_signal,
)
from flexdt.runtime.process_settings import Address, ViewerSettings
from flexdt.runtime.settings import parse
from flexdt.twin.machine.description import parse_profile

if TYPE_CHECKING:
    from flexdt.clients.viewer.viewer import Viewer


async def run(options: ViewerSettings, out: TextIO) -> int:
    """Serve until SIGTERM or SIGINT, or until an essential part has failed.

    Token, certificates and files are read first, and raise their errors; the parts' own
    meshes are used only for a machine from a file. The viewer is stopped in any case.

    Args:
        options: addresses, token, certificates, limits and files of the process.
        out: receives the ready line.

    Returns:
        The exit code: `FAILED` if such a part has failed, else `OK`.
    """
    from flexdt.clients.viewer.page_methods import ANSWERS
    from flexdt.clients.viewer.scenes.meshes.part_looks import own_looks
    from flexdt.clients.viewer.viewer import Viewer

    token = read_token(options.token_file)
    ssl = client_tls(options.twin_cert, any_name=True)
    twin = options.twin
    twin_address = TwinAddress(twin.host, twin.port, token, ssl)
    limits = with_limits(options.limit, ViewerLimits())
    machine = read_if_there(options.machine, machines.parsed)
    profile = read_if_there(options.profile, parse_profile)
    if machine and options.machine:
        looks = own_looks(machine, options.machine.parent)
    else:
        looks = None
    viewer = Viewer(
        twin_address,
        ANSWERS,
        machine,
        profile,
        token,
        options.data,
        limits,
        looks,
        public=options.public_url,
    )
    context = server_tls(options.tls_cert, options.tls_key)
    try:
        await viewer.start(options.host, options.port, context)
        assert viewer.front is not None
        at = Address(options.host, viewer.front.port)
        url = str(
            options.public_url or f"{'http' if context is None else 'https'}://{at}/"
        )
        async with served_pages(viewer_pages(viewer), options) as pages:
            stop = stop_signal()
            announce(
                "viewer",
                {
                    "host": at.host,
                    "port": at.port,
                    "url": url,
                    "twin": str(twin),
                    **pages,
                },
                out,
            )
            await first_of(stop, viewer.failed)
    finally:
        await viewer.stop()
    return FAILED if viewer.failed.is_set() else OK


def viewer_pages(viewer: Viewer) -> Pages:
    """Make the pages for monitoring of a running viewer: health, failed once an essential
    part of it has, and metrics.

    Args:
        viewer: started.
    """

    def health() -> dict[str, object]:
        """Return name and version of this server, and whether the twin is connected."""
        return {
            "server": f"flexdt viewer {version('flexdt')}",
            "twin": "connected" if viewer.link.connected else "not connected",
        }

    def figures() -> list[Metric]:
        """List the metrics: open pages and views, pages ever opened, dropped messages,
        drawn states, connection to the twin, wrong tokens; 0 for counts of the front
        while there is none.

        Counters only grow.
        """
        front = viewer.front
        return [
            gauge("flexdt_pages", "Pages open.", len(viewer.open_pages)),
            counter("flexdt_pages_total", "Pages that ever opened.", viewer.opened),
            counter(
                "flexdt_scene_messages_dropped_total",
                "Messages of pages kept from viser.",
                0 if front is None else front.doorkeeper.dropped,
            ),
            gauge("flexdt_scenes", "Views open.", 0 if front is None else front.scenes),
            counter("flexdt_states_drawn_total", "States drawn.", viewer.drawn),
            gauge(
                "flexdt_twin_connected",
                "Whether there is one.",
                float(viewer.link.connected),
            ),
            counter(
                "flexdt_wrong_tokens_total",
                "Wrong tokens shown.",
                0 if front is None else front.wrong_tokens,
            ),
        ]

    return watching_pages(health, figures, failed=viewer.failed.is_set)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the viewer with the options of `argv` (default: the command line) until it is
    ended; return the exit code.

    Standard output gets only the ready line; viser's own output is dropped.
    """
    options = parse(ViewerSettings, argv)
    set_up(level=LEVELS[options.log_level], apart=True)
    out = sys.stdout
    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere):
        # viser's chatter goes nowhere
        return run_process(options, lambda chosen: run(chosen, out))


if __name__ == "__main__":
    sys.exit(main())
