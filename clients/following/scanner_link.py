"""The scanner's outgoing events over ZeroMQ: a subscription that comes back by itself.

The only socket is a SUB socket, which cannot send a message. ZeroMQ's own heartbeats tell within a
second that a cable is out; a scanner that ends is told by its connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import Callable
from typing import Final

import zmq
import zmq.asyncio
from zmq.utils.monitor import parse_monitor_message

from flexdt.protocol.acquila import MAX_BYTES

PORT: Final = 50000
HEARTBEAT_MS: Final = 200
SILENT_MS: Final = 500
"""A scanner whose ZeroMQ does not answer a heartbeat for so long is not there."""
RETRY_MS: Final = 100
MOST_RETRY_MS: Final = 1000
MAX_HELD: Final = 10_000
_ADDRESS: Final = re.compile(r"(?:tcp://)?(\[[0-9a-fA-F:.]+\]|[^\s:/\[\]]+)(?::(\d{1,5}))?/?")


def endpoint(address: str) -> str:
    """ZeroMQ's name of `tcp://HOST[:PORT]`.

    Raises:
        ValueError: it is none.

    Example:
        >>> endpoint("tcp://scanner"), endpoint("10.0.0.7:5555")
        ('tcp://scanner:50000', 'tcp://10.0.0.7:5555')
    """
    match = _ADDRESS.fullmatch(address.strip())
    port = PORT if match is None or match[2] is None else int(match[2])
    if match is None or not 0 < port < 65536:
        raise ValueError(f"{address!r} is no address; allowed: tcp://HOST[:PORT], PORT 1 to 65535")
    return f"tcp://{match[1]}:{port}"


async def listen(
    address: str, message: Callable[[bytes], None], link: Callable[[bool, str], None]
) -> None:
    """Listen until cancelled.

    Args:
        address: see `endpoint`.
        message: called with every message.
        link: called with whether there is a connection, and why not, when that changes.

    Raises:
        ValueError, zmq.ZMQError: no address that can be connected to.
    """
    with zmq.asyncio.Context() as context, context.socket(zmq.SUB) as socket:
        for option, value in (
            (zmq.LINGER, 0), (zmq.RCVHWM, MAX_HELD), (zmq.MAXMSGSIZE, MAX_BYTES),
            (zmq.HEARTBEAT_IVL, HEARTBEAT_MS), (zmq.HEARTBEAT_TIMEOUT, SILENT_MS),
            (zmq.RECONNECT_IVL, RETRY_MS), (zmq.RECONNECT_IVL_MAX, MOST_RETRY_MS),
            (zmq.IPV6, int("[" in address)),
        ):  # fmt: skip
            socket.setsockopt(option, value)
        socket.subscribe(b"")
        events = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED
        monitor = socket.get_monitor_socket(events)
        watching = asyncio.create_task(_watch(monitor, link))
        try:
            socket.connect(endpoint(address))
            while True:
                frames = await socket.recv_multipart()
                message(frames[0] if len(frames) == 1 else b"")
        finally:
            watching.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await watching
            socket.disable_monitor()
            monitor.close(linger=0)


async def _watch(monitor: zmq.asyncio.Socket, link: Callable[[bool, str], None]) -> None:
    while True:
        event = parse_monitor_message(await monitor.recv_multipart())
        if event["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            link(True, "")
        else:
            link(False, "the scanner has ended the connection, or does not answer")
