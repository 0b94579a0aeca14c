"""`python -m flexdt.server.gateway_main`: the scanner software's socket interface as a process.

Prints one JSON `ready` line on standard output once programs may connect; the twin may come later
or go and come back. SIGTERM and SIGINT end it cleanly. It refuses to print anything else there.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import ssl as tls
import sys
from collections.abc import Sequence
from pathlib import Path

from flexdt.server.access import AccessError, read_token
from flexdt.server.gateway.lab import Lab
from flexdt.server.log import set_up
from flexdt.server.supervisor import Address
from flexdt.server.viewer.link import TwinLink, Way
from flexdt.server.viewer_main import address, machine_of, profile_of
from flexdt.twin.errors import TwinError

INVALID = 1
USAGE = 2
REFUSED = 4

DEFAULT_PORT = 50000


def parser() -> argparse.ArgumentParser:
    """The process's options."""
    p = argparse.ArgumentParser(prog="flexdt gateway", description=__doc__)
    p.add_argument("--bind", "--host", dest="host", default="127.0.0.1",
                   help="loopback only; from elsewhere through a tunnel")  # fmt: skip
    p.add_argument("--port", type=int, default=DEFAULT_PORT, help="events go out; 0: any free")
    p.add_argument("--inbound-port", type=int, help="events come in; the next port if left out")
    p.add_argument("--server", type=address, default=Address("127.0.0.1", 55000),
                   metavar="HOST:PORT")  # fmt: skip
    p.add_argument("--data", type=Path, default=Path("data"), help="where images are saved")
    p.add_argument("--machine", type=Path, help="the twin's, where it is a file")
    p.add_argument("--profile", type=Path, help="the twin's, where it is a file")
    p.add_argument("--token-file", type=Path, help="shown to the twin")
    p.add_argument("--twin-cert", type=Path, help="certificate that the twin's TLS is checked with")
    return p


async def run(options: argparse.Namespace) -> None:
    """Serve until SIGTERM or SIGINT."""
    from flexdt.server.gateway.shell import Gateway

    token = read_token(options.token_file)
    ssl = None
    if options.twin_cert is not None:
        # The certificate itself is trusted, by whatever name the twin is reached.
        ssl = tls.create_default_context(cafile=str(options.twin_cert))
        ssl.check_hostname = False
    way = Way(options.server.host, options.server.port, token, ssl)
    link = TwinLink(way, "flexdt gateway")
    machine, profile = machine_of(options.machine), profile_of(options.profile)
    lab = Lab(link, options.data.absolute(), machine, profile)
    gateway = Gateway(lab, options.host, options.port, options.inbound_port)
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    tasks = [asyncio.create_task(work) for work in (link.run(), gateway.run(), stop.wait())]
    ready = {
        "ready": "gateway", "host": options.host, "port": gateway.port,
        "inbound": gateway.inbound, "twin": str(options.server), "pid": os.getpid(),
    }  # fmt: skip
    print(json.dumps(ready), flush=True)
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in reversed(tasks):
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task


def main(argv: Sequence[str] | None = None) -> int:
    """Run the process; returns its exit code."""
    options = parser().parse_args(argv)
    set_up()
    try:
        import zmq
    except ImportError:
        print("flexdt gateway: pyzmq is missing: pip install 'flexdt[gateway]'", file=sys.stderr)
        return INVALID
    try:
        asyncio.run(run(options))
    except AccessError as error:
        print(f"flexdt gateway: {error}", file=sys.stderr)
        return USAGE
    except TwinError as error:
        print(f"flexdt gateway: {error}", file=sys.stderr)
        return INVALID
    except zmq.ZMQError as error:
        where = f"{options.host}:{options.port}"
        print(f"flexdt gateway: cannot listen on {where}: {error.strerror}", file=sys.stderr)
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main())
