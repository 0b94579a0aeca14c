"""`python -m flexdt.server.gateway_main`: the scanner software's socket interface as a process.

Prints one JSON `ready` line on standard output once programs may connect; the twin may come later
or go and come back. SIGTERM and SIGINT end it cleanly. It refuses to print anything else there.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from flexdt.server.access import client_tls, read_token
from flexdt.server.gateway.lab import Lab
from flexdt.server.log import set_up
from flexdt.server.options import OneLine, address, machine_of, profile_of
from flexdt.server.process import INVALID, OK, announce, run_process, stop_signal
from flexdt.server.supervisor import Address
from flexdt.server.viewer.link import TwinLink, Way

DEFAULT_PORT = 50000


def parser() -> argparse.ArgumentParser:
    """The process's options."""
    p = OneLine(prog="flexdt gateway", description=__doc__)
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


async def run(options: argparse.Namespace) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit code."""
    from zmq import ZMQError

    from flexdt.server.gateway.shell import Gateway

    token = read_token(options.token_file)
    ssl = client_tls(options.twin_cert, any_name=True)
    way = Way(options.server.host, options.server.port, token, ssl)
    link = TwinLink(way, "flexdt gateway")
    machine, profile = machine_of(options.machine), profile_of(options.profile)
    lab = Lab(link, options.data.absolute(), machine, profile)
    try:
        gateway = Gateway(lab, options.host, options.port, options.inbound_port)
    except ZMQError as error:
        raise OSError(error.errno, error.strerror) from None
    stop = stop_signal()
    tasks = [asyncio.create_task(work) for work in (link.run(), gateway.run(), stop.wait())]
    announce("gateway", {
        "host": options.host, "port": gateway.port, "inbound": gateway.inbound,
        "twin": str(options.server),
    })  # fmt: skip
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in reversed(tasks):
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
    return OK


def main(argv: Sequence[str] | None = None) -> int:
    """Run the process; returns its exit code."""
    options = parser().parse_args(argv)
    set_up()
    if find_spec("zmq") is None:
        print("flexdt gateway: pyzmq is missing: pip install 'flexdt[gateway]'", file=sys.stderr)
        return INVALID
    return run_process("gateway", options, run)


if __name__ == "__main__":
    sys.exit(main())
