"""How many connections a process may hold, so that descriptors are left for what matters.

A connection that cannot be accepted is no refusal that a client could read: it waits, and so
does its E-stop. So places are counted at the start against the system's limit, and some
descriptors are kept for files, worker processes and the reserved places.
"""

from __future__ import annotations

from typing import Final

KEPT: Final = 128
"""Descriptors for files, workers, the projector and the loop; a twin at work has about 60."""
WAITING_SHARE: Final = 4
"""Where descriptors are few, one in so many is for connections without a place."""


def limit() -> int | None:
    """Return how many descriptors this process may have open; None where there is no
    such limit.
    """
    try:
        import resource
    except ImportError:  # Windows
        return None
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return None if soft == resource.RLIM_INFINITY else soft


def fitted(
    clients: int, waiting: int, reserved: int, most: int | None
) -> tuple[int, int]:
    """Return how many clients and waiting connections leave `KEPT` descriptors of `most`.

    `reserved`: places for urgent requests. At least one each: `fitted(512, 512, 16, 256)`
    is (84, 28).
    """
    if most is None or clients + waiting + reserved + KEPT <= most:
        return clients, waiting
    room = max(most - KEPT - reserved, 2)
    waiting = min(waiting, max(room // WAITING_SHARE, 1))
    return min(clients, room - waiting), waiting
