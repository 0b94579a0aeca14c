"""`python -m flexdt.runtime.worker SOCKET MEMORY`: heavy work, in a process of its own.

Requests and answers are lists of byte strings over a socket that the parent handed down.
The process has a limit on memory, one on processor time for each request, a low priority,
and ends when its parent does. A request is a pickled call of a module-level function, and
its raw arguments.
"""

from __future__ import annotations

import json
import os
import pickle
import resource
import select
import socket
import struct
import sys
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

Parts = Sequence[bytes | bytearray | memoryview]

Work = Callable[..., list[bytes]]
"""A piece of work: a function of a module."""
NICENESS = 5
"""Niceness of a worker process."""


def send_parts(channel: socket.socket, parts: Parts) -> None:
    """Send a list of byte strings: their number and sizes, then each; blocks."""
    channel.sendall(struct.pack(f"<I{len(parts)}Q", len(parts), *map(len, parts)))
    for part in parts:
        channel.sendall(part)


def receive_parts(channel: socket.socket) -> list[bytes]:
    """Receive a list sent by `send_parts`.

    Raises EOFError: the other end is gone; TimeoutError: of the socket."""
    (count,) = struct.unpack("<I", _receive_exactly(channel, 4))
    sizes = struct.unpack(f"<{count}Q", _receive_exactly(channel, 8 * count))
    return [bytes(_receive_exactly(channel, size)) for size in sizes]


def _receive_exactly(channel: socket.socket, size: int) -> bytearray:
    """Read exactly `size` bytes from a socket, in pieces of at most 1 MiB.

    Raises:
        EOFError: the other end closes before.
    """
    data = bytearray(size)
    view = memoryview(data)
    at = 0
    while at < size:
        got = channel.recv_into(view[at : at + (1 << 20)])
        if not got:
            raise EOFError("the other end is gone")
        at += got
    return data


def limit(what: str, most: int) -> None:
    """Set the soft limit of one resource of this process to `most`, or to the hard limit if that
    is lower.

    `what`: name of the resource, such as RLIMIT_CPU; `most`: in the resource's unit.
    """
    number = getattr(resource, what)
    hard = resource.getrlimit(number)[1]
    value = most
    if hard != resource.RLIM_INFINITY:
        value = min(most, hard)
    resource.setrlimit(number, (value, hard))


def peak_bytes() -> int:
    """Return the largest memory this process has taken so far [bytes].

    It is Linux's figure of this process alone; elsewhere `ru_maxrss`, which begins with
    the memory of the parent.
    """
    try:
        with open("/proc/self/status", encoding="ascii") as status:
            return 1024 * int(
                next(x for x in status if x.startswith("VmHWM:")).split()[1]
            )
    except (OSError, StopIteration):
        return 1024 * int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def answer(request: Sequence[bytes]) -> list[bytes]:
    """Do one piece of work and return its result or its error as parts; nothing is
    raised.

    It may take the allowed processor time and 2 s more; beyond that the system ends the
    process.

    Args:
        request: processor seconds allowed, the pickled pair of function and arguments,
            and its binary arguments.

    Returns:
        b"done" with the function's parts; b"refused" with JSON of code, message and data
        of an error that users can cause; b"memory"; or b"failed" with the traceback.
    """
    seconds, call, *raw = request
    # Before the call is unpickled, which imports modules.
    limit("RLIMIT_CPU", int(sum(os.times()[:2]) + float(seconds) + 2.0))
    try:
        work, arguments = pickle.loads(call)
        return [b"done", *work(*arguments, *raw)]
    except MemoryError:
        return [b"memory"]
    except Exception as error:
        from flexdt.runtime.wire_errors import explain, is_user_error

        if is_user_error(error):
            e = explain(error)
            return [
                b"refused",
                json.dumps([e.code, e.message, e.data], default=repr).encode(),
            ]
        return [b"failed", traceback.format_exc().encode("utf-8", "replace")]


def document(read: Callable[..., Any], how: Mapping[str, str], raw: bytes) -> list[bytes]:
    """Read untrusted bytes by `read` in the worker, and return JSON; no file may be written.

    Here, and not beside the server's store, so that the process loads only the modules of
    `read`."""
    limit("RLIMIT_FSIZE", 0)
    return [json.dumps(read(raw, **how).to_dict()).encode()]


def main() -> int:
    """Limit this process's memory and priority, then answer requests until the parent is
    gone.

    The command line has the descriptor of the socket and the memory limit [bytes]. Each
    answer has the peak memory [bytes] as its second part.

    Returns:
        The exit code, 0.
    """
    channel = socket.socket(fileno=int(sys.argv[1]))
    limit("RLIMIT_AS", int(sys.argv[2]))
    limit("RLIMIT_CORE", 0)
    with suppress(OSError, AttributeError):
        os.nice(NICENESS)
    threading.Thread(
        target=_end_with_parent, args=[channel.fileno()], daemon=True
    ).start()
    with suppress(EOFError, ConnectionError):
        while True:
            out = answer(receive_parts(channel))
            send_parts(channel, [out[0], str(peak_bytes()).encode(), *out[1:]])
    return 0


def _end_with_parent(number: int) -> None:
    """Wait until the parent closes its socket, then exit with code 0.

    Return at once if that cannot be polled.
    """
    if not hasattr(select, "POLLRDHUP"):
        return
    watch = select.poll()
    watch.register(number, select.POLLRDHUP)
    watch.poll()
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
