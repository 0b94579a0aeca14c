"""`python -m flexdt.server.viewer_main`: the lab in the browser as a process.

Prints one JSON `ready` line on standard output once browsers may come; the twin may come later or
go and come back. SIGTERM and SIGINT end it cleanly. It refuses to print anything else there.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import ssl as tls
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TextIO

from flexdt.server.access import AccessError, read_token, server_tls
from flexdt.server.log import set_up
from flexdt.server.supervisor import Address
from flexdt.server.viewer.link import Way
from flexdt.twin.errors import TwinError
from flexdt.twin.machine import Machine, Profile, parse_machine, parse_profile

INVALID = 1
USAGE = 2
REFUSED = 4


def parser() -> argparse.ArgumentParser:
    """The process's options."""
    p = argparse.ArgumentParser(prog="flexdt viewer", description=__doc__)
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
    return p


def address(text: str) -> Address:
    """HOST:PORT, [IPv6]:PORT.

    Raises:
        ValueError: it is none.
    """
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit():
        raise ValueError(f"{text!r} is not HOST:PORT")
    return Address(host.strip("[]"), int(port))


def machine_of(file: Path | None) -> Machine | None:
    """The machine of a TOML file; None (the twin names it) where there is none."""
    return None if file is None or not file.exists() else parse_machine(file.read_text(), str(file))


def profile_of(file: Path | None) -> Profile | None:
    """The profile of a TOML file; None where there is none."""
    return None if file is None or not file.exists() else parse_profile(file.read_text(), str(file))


async def run(options: argparse.Namespace, out: TextIO) -> None:
    """Serve until SIGTERM or SIGINT; the ready line goes to `out`."""
    from flexdt.server.viewer.app import Viewer

    token = read_token(options.token_file)
    ssl = None
    if options.twin_cert is not None:
        # The certificate itself is trusted, by whatever name the twin is reached.
        ssl = tls.create_default_context(cafile=str(options.twin_cert))
        ssl.check_hostname = False
    twin = options.twin
    way = Way(twin.host, twin.port, token, ssl)
    viewer = Viewer(way, machine_of(options.machine), profile_of(options.profile), token,
                    options.data)  # fmt: skip
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    context = server_tls(options.tls_cert, options.tls_key)
    await viewer.start(options.host, options.port, context)
    assert viewer.front is not None
    at = Address(options.host, viewer.front.port)
    url = f"{'http' if context is None else 'https'}://{at}/"
    ready = {
        "ready": "viewer", "host": at.host, "port": at.port, "url": url, "twin": str(twin),
        "pid": os.getpid(),
    }  # fmt: skip
    print(json.dumps(ready), file=out, flush=True)
    try:
        await stop.wait()
    finally:
        await viewer.stop()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the process; returns its exit code."""
    options = parser().parse_args(argv)
    set_up()
    out = sys.stdout
    try:
        with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere):
            asyncio.run(run(options, out))  # viser's chatter goes nowhere
    except AccessError as error:
        print(f"flexdt viewer: {error}", file=sys.stderr)
        return USAGE
    except TwinError as error:
        print(f"flexdt viewer: {error}", file=sys.stderr)
        return INVALID
    except OSError as error:
        where = f"{options.host}:{options.port}"
        print(f"flexdt viewer: cannot listen on {where}: {error.strerror}", file=sys.stderr)
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main())
