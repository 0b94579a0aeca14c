"""`python -m flexdt.server.viewer_main`: the lab in the browser as a process.

Prints one JSON `ready` line on standard output once browsers may come; the twin may come later or
go and come back. SIGTERM and SIGINT end it cleanly. It refuses to print anything else there.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TextIO

from flexdt.server.access import (
    ViewerLimits,
    client_tls,
    read_token,
    server_tls,
    with_limits,
)
from flexdt.server.log import LEVELS, set_up
from flexdt.server.options import OneLine, address, machine_of, profile_of, watching_options
from flexdt.server.process import OK, announce, run_process, stop_signal
from flexdt.server.supervisor import Address
from flexdt.server.viewer.link import Way

FAILED = 1


def parser() -> argparse.ArgumentParser:
    """The process's options."""
    p = OneLine(prog="flexdt viewer", description=__doc__)
    p.add_argument("--host", default="127.0.0.1")
    p.add_argument("--port", type=int, default=8080, help="0: any free port")
    p.add_argument("--twin", type=address, default=Address("127.0.0.1", 55000),
                   metavar="HOST:PORT")  # fmt: skip
    p.add_argument("--machine", type=Path, help="the twin's, where it is a file")
    p.add_argument("--profile", type=Path, help="the twin's, where it is a file")
    p.add_argument("--data", type=Path, help="the twin's data directory, to calibrate from")
    p.add_argument("--token-file", type=Path, help="shown to the twin, and asked of browsers")
    p.add_argument("--twin-cert", type=Path, help="certificate that the twin's TLS is checked with")
    p.add_argument("--tls-cert", type=Path, help="serve browsers over HTTPS")
    p.add_argument("--tls-key", type=Path)
    p.add_argument("--limit", action="append", default=[], metavar="NAME=VALUE",
                   help="of pages; may be given several times")  # fmt: skip
    watching_options(p)
    return p


async def run(options: argparse.Namespace, out: TextIO) -> int:
    """Serve until SIGTERM or SIGINT, or until a part has died that nothing is shown without.

    The ready line goes to `out`; returns the exit code.
    """
    from flexdt.server.http import serve_http
    from flexdt.server.viewer.app import Viewer
    from flexdt.server.viewer.health import viewer_pages

    token = read_token(options.token_file)
    ssl = client_tls(options.twin_cert, any_name=True)
    twin = options.twin
    way = Way(twin.host, twin.port, token, ssl)
    limits = with_limits(options.limit, ViewerLimits())
    viewer = Viewer(way, machine_of(options.machine), profile_of(options.profile), token,
                    options.data, limits)  # fmt: skip
    stop = stop_signal()
    context = server_tls(options.tls_cert, options.tls_key)
    await viewer.start(options.host, options.port, context)
    assert viewer.front is not None
    pages = None
    if options.http_port is not None:
        pages = await serve_http(
            viewer_pages(viewer), options.http_host, options.http_port, token=token
        )
    at = Address(options.host, viewer.front.port)
    url = f"{'http' if context is None else 'https'}://{at}/"
    announce("viewer", {
        "host": at.host, "port": at.port, "url": url, "twin": str(twin),
        **({} if pages is None else {"http_port": pages.port}),
    }, out)  # fmt: skip
    waits = [asyncio.create_task(e.wait()) for e in (stop, viewer.failed)]
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()
        if pages is not None:
            await pages.close()
        await viewer.stop()
    return FAILED if viewer.failed.is_set() else OK


def main(argv: Sequence[str] | None = None) -> int:
    """Run the process; returns its exit code."""
    options = parser().parse_args(argv)
    set_up(level=LEVELS[options.log_level], apart=True)
    out = sys.stdout
    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere):
        # viser's chatter goes nowhere
        return run_process("viewer", options, lambda chosen: run(chosen, out))


if __name__ == "__main__":
    sys.exit(main())
