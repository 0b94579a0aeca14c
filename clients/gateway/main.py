"""`python -m flexdt.clients.gateway.main`: the scanner software's socket interface as a
process.

Prints one JSON `ready` line on standard output once programs may connect; the twin may come
later or go and come back. SIGTERM and SIGINT end it cleanly. Nothing else is printed there.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import Sequence

from flexdt.clients.client.kept_connection import KeptConnection, TwinAddress
from flexdt.clients.gateway.connected_twin import ConnectedTwin
from flexdt.library import machines
from flexdt.library.optional.extras import lacking
from flexdt.message_words import reason_of
from flexdt.runtime.access import client_tls, read_token
from flexdt.runtime.log import set_up
from flexdt.runtime.process import (
    INVALID,
    OK,
    announce,
    read_if_there,
    run_process,
    stop_signal,
)
from flexdt.runtime.process_settings import GatewaySettings
from flexdt.runtime.settings import parse
from flexdt.twin.machine.description import parse_profile

EVENTS_HZ = 20.0


async def run(options: GatewaySettings) -> int:
    """Serve until SIGTERM or SIGINT.

    Token, certificate, machine and profile are read first, from files where the options
    name them, and raise their errors. The ports, once open, are announced in a line on
    standard output. It subscribes to state and jobs at `EVENTS_HZ`. The first task that
    ends, with its error, if any, ends all.

    Args:
        options: addresses, token, certificate, folders and files of the process.

    Returns:
        The exit code, OK.

    Raises:
        OSError: a port is taken.
    """
    from zmq import ZMQError

    from flexdt.clients.gateway.event_server import Gateway

    token = read_token(options.token_file)
    ssl = client_tls(options.twin_cert, any_name=True)
    twin_address = TwinAddress(options.server.host, options.server.port, token, ssl)
    heard: list[ConnectedTwin] = []
    link = KeptConnection(
        twin_address,
        "flexdt gateway",
        lambda topic, params: heard[0].heard(topic, params),
        subscription={"topics": ["state", "job"], "max_rate_hz": EVENTS_HZ},
    )
    machine = read_if_there(options.machine, machines.parsed)
    profile = read_if_there(options.profile, parse_profile)
    twin = ConnectedTwin(link, options.data.absolute(), machine, profile)
    heard.append(twin)
    try:
        gateway = Gateway(twin, options.host, options.port, options.inbound_port)
    except ZMQError as error:
        raise OSError(error.errno, reason_of(error)) from None
    stop = stop_signal()
    tasks = [
        asyncio.create_task(work) for work in (link.run(), gateway.run(), stop.wait())
    ]
    announce(
        "gateway",
        {
            "host": options.host,
            "port": gateway.port,
            "inbound": gateway.inbound,
            "twin": str(options.server),
        },
    )
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
    """Run the gateway with the options of `argv` (default: the command line) until it is
    ended; return the exit code.

    Without pyzmq, INVALID, with a line on standard error, before anything is opened.
    """
    options = parse(GatewaySettings, argv)
    set_up()
    if (missing := lacking("zmq", "pyzmq", "gateway")) is not None:
        print(f"flexdt gateway: {missing}", file=sys.stderr)
        return INVALID
    return run_process(options, run)


if __name__ == "__main__":
    sys.exit(main())
