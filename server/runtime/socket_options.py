"""Socket options of both servers: no delay of small messages, dead peers noticed in a minute."""

from __future__ import annotations

import socket
from typing import Final

IDLE_S: Final = 30
INTERVAL_S: Final = 10
PROBES: Final = 3


def tune(sock: socket.socket) -> None:
    """No Nagle delay; keep-alive probes after 30 s of silence, given up after three of them.

    A peer whose machine or network has died is thus gone after a minute instead of two hours, and
    with it whatever it held (control of the twin, memory of an upload). Harmless on sockets that
    are not TCP, and where the platform lacks an option.
    """
    if sock.family not in (socket.AF_INET, socket.AF_INET6):
        return
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (
        ("TCP_KEEPIDLE", IDLE_S),
        ("TCP_KEEPINTVL", INTERVAL_S),
        ("TCP_KEEPCNT", PROBES),
        ("TCP_USER_TIMEOUT", 1000 * (IDLE_S + PROBES * INTERVAL_S)),
    ):
        option = getattr(socket, name, None)
        if option is not None:
            sock.setsockopt(socket.IPPROTO_TCP, option, value)
