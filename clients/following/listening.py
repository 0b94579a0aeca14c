"""The one socket of `flexdt follow`: it listens to a scanner and cannot send.

A thread of its own does nothing but read the socket and its clock: a message has come
between the last moment at which there was none and the moment at which it was read, and
time passes only as far as was listened to. So a busy computer makes times less certain,
but no machine slow or fast. The socket is a SUB socket, which cannot send a message;
ZeroMQ's own heartbeats detect within a second that a cable is out.
"""

from __future__ import annotations

import asyncio
import re
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Final

import zmq
from zmq.utils.monitor import parse_monitor_message

from flexdt.protocol.acquila import MAX_BYTES

TICK_S: Final = 0.1
PORT: Final = 50000
LOST_MESSAGE: Final = "the scanner has ended the connection, or does not answer"
POLL_S: Final = 0.02
HEARTBEAT_MS: Final = 200
SILENT_MS: Final = 500
"""Longest time without an answer to a heartbeat before the scanner counts as lost
[ms]."""
RETRY_MS: Final = 100
MAX_RETRY_MS: Final = 1000
MAX_HELD: Final = 10_000
_ADDRESS: Final = re.compile(
    r"(?:tcp://)?(\[[0-9a-fA-F:.]+\]|[^\s:/\[\]]+)(?::(\d{1,5}))?/?"
)


def endpoint(address: str) -> str:
    """Convert `[tcp://]HOST[:PORT][/]` to ZeroMQ's `tcp://HOST:PORT`; the default port is
    50000.

    Blanks around it are dropped; an IPv6 address has to be in brackets. The port is from
    1 to 65535.

    Raises:
        ValueError: it is none.

    Example:
        >>> endpoint("tcp://scanner"), endpoint("10.0.0.7:5555")
        ('tcp://scanner:50000', 'tcp://10.0.0.7:5555')
    """
    match = _ADDRESS.fullmatch(address.strip())
    if match is None or match[2] is None:
        port = PORT
    else:
        port = int(match[2])
    if match is None or not 0 < port < 65536:
        raise ValueError(
            f"{address!r} is no address; allowed: tcp://HOST[:PORT], PORT 1 to 65535"
        )
    return f"tcp://{match[1]}:{port}"


async def listen(
    address: str,
    message: Callable[[bytes, float, float], None],
    passed: Callable[[float], None],
    link: Callable[[bool, str], None],
    clock: Callable[[], float],
) -> None:
    """Listen to the scanner's messages in a thread until canceled, and call the
    callbacks in the event loop.

    The thread is waited for before the call ends. A lost connection is made again by the
    socket and only reported by `link`; it raises nothing.

    Args:
        address: see `endpoint`.
        message: called with every message, the time of reading, and how much earlier it
            may have come.
        passed: called ten times a second with the time up to which all messages were
            passed on.
        link: called with whether there is a connection, and why not, when that changes.
        clock: monotonic [s].

    Raises:
        ValueError, zmq.ZMQError: no address that can be connected to.
    """
    tell = asyncio.get_running_loop().call_soon_threadsafe
    ended = threading.Event()

    def read(socket: zmq.Socket[bytes], monitor: zmq.Socket[bytes]) -> None:
        """Read messages and changes of the connection, and pass them to the event loop,
        until `ended`.

        `passed` is called every `TICK_S` seconds with a time before which all has been
        read, `link` with up or down, `message` with data, time and delay [s]. Waits at
        most `POLL_S` for a message, so it ends that soon. All messages at hand are read
        without waiting; of a multipart message only the last part is used. The delay is
        the time since the socket was last known to be empty, before the wait.

        Args:
            socket: of messages.
            monitor: of the connection's events.
        """
        told = clock()
        while not ended.is_set():
            none_before = clock()  # whatever is found from here on was not there before
            if none_before - told >= TICK_S:
                told = none_before
                tell(passed, told)
            found = zmq.select([socket, monitor], [], [], POLL_S)[0]
            if monitor in found:
                happened = parse_monitor_message(monitor.recv_multipart())["event"]
                up = happened == zmq.EVENT_HANDSHAKE_SUCCEEDED
                tell(link, up, "" if up else LOST_MESSAGE)
            with suppress(zmq.Again):
                while True:
                    data = socket.recv_multipart(zmq.NOBLOCK)[-1]
                    now = clock()
                    tell(message, data, now, now - none_before)

    def work() -> None:
        """Open the SUB socket and its monitor, subscribe to everything, read until the
        end, and close both.

        The socket reconnects by itself, sends heartbeats, and holds at most `MAX_HELD`
        messages of `MAX_BYTES`. IPv6 is allowed only if the address holds "[". Nothing is
        sent: the socket and monitor are closed without lingering.
        """
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            for option, value in (
                (zmq.LINGER, 0),
                (zmq.RCVHWM, MAX_HELD),
                (zmq.MAXMSGSIZE, MAX_BYTES),
                (zmq.HEARTBEAT_IVL, HEARTBEAT_MS),
                (zmq.HEARTBEAT_TIMEOUT, SILENT_MS),
                (zmq.RECONNECT_IVL, RETRY_MS),
                (zmq.RECONNECT_IVL_MAX, MAX_RETRY_MS),
                (zmq.IPV6, int("[" in address)),
            ):
                socket.setsockopt(option, value)
            socket.subscribe(b"")
            events = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED
            monitor = socket.get_monitor_socket(events)
            try:
                socket.connect(endpoint(address))
                read(socket, monitor)
            finally:
                socket.disable_monitor()
                monitor.close(linger=0)

    reading = asyncio.create_task(asyncio.to_thread(work))
    try:
        await asyncio.shield(reading)
    finally:
        ended.set()
        await asyncio.wait({reading})
