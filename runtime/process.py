"""Event loop, sockets, signals, `ready` line, exit codes and processor time
of server processes.

Every request, an E-stop too, waits for the turn of the loop under way. The time from
where the loop wakes up to where it polls its sockets again is therefore measured for
every turn. It includes the time that another thread holds the interpreter while the loop
has work to do. asyncio's complaints go to the log.

How servers listen and the options of their sockets are here, too: no delay of small
messages, and dead peers noticed in a minute. The `main` modules of the processes declare
their services and options.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import logging
import os
import selectors
import signal
import socket
import ssl as tls
import sys
from collections.abc import Callable, Coroutine, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Final, TextIO, TypeVar

from flexdt.message_words import reason_of
from flexdt.runtime.access import AccessError, AccessFileError
from flexdt.runtime.log import Sparing
from flexdt.runtime.process_settings import ProcessSettings
from flexdt.twin.errors import TwinError

if TYPE_CHECKING:
    from prometheus_client import Histogram

BACKLOG = 1024
"""Number of connections that the system keeps until they are accepted.

Beyond them it drops a client's first packet, which is sent again after a whole second:
six seconds of 10 000 connections a minute fit.
"""
TLS_HANDSHAKE_S = 10.0
"""Time limit of a TLS handshake [s]."""


MAX_DESCRIPTORS: Final = 1 << 16
"""Number of descriptors that a server requests, if so many are allowed."""
BUCKETS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 1.0, 5.0)
"""Upper bounds of the histograms' bins [s]."""


def durations(name: str, help: str, labels: Sequence[str] = ()) -> Histogram:
    """Make a histogram of durations [s] with the limits `BUCKETS_S`, which is not registered.

    The "created" series of all metrics of the process are switched off."""
    from prometheus_client import Histogram, disable_created_metrics

    disable_created_metrics()  # type: ignore[no-untyped-call]
    return Histogram(name, help, labels, registry=None, buckets=BUCKETS_S)


class Holds:
    """Durations of the loop's turns [s]."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Reset histogram and longest turn; the turn that is under way will not be
        counted.
        """
        what = "How long each turn held the event loop."
        self.turns = durations("flexdt_loop_hold_seconds", what)
        self._worst = 0.0
        self._begun = False

    def observe(self, seconds: float) -> None:
        """Count a turn of `seconds` that has ended, and note the longest; the first turn
        after `begin` is not counted.
        """
        if not self._begun:
            self._begun = True
            return
        self.turns.observe(seconds)
        self._worst = max(self._worst, seconds)

    def worst(self) -> float:
        """Return the longest turn since the last call."""
        worst = self._worst
        self._worst = 0.0
        return worst


class _Watched(selectors.DefaultSelector):
    """Measures the time between two polls of the sockets."""

    def __init__(self, holds: Holds) -> None:
        """Make a selector that reports turns of the loop to `holds`; none has begun."""
        super().__init__()
        self._holds = holds
        self._woke: float | None = None

    def select(self, timeout: float | None = None) -> Any:
        """Poll as the base class does, after counting the time since the last poll
        returned as a turn of the loop.

        After a poll that does not wait the turn begins before the poll.
        """
        now = perf_counter()
        if self._woke is not None:
            self._holds.observe(now - self._woke)
        events = super().select(timeout)
        # A look that does not wait takes no time, unless another thread has the interpreter.
        if timeout is not None and timeout <= 0.0:
            self._woke = now
        else:
            self._woke = perf_counter()
        return events


class ServerLoop(asyncio.SelectorEventLoop):
    """asyncio's loop with its turns measured; its complaints go to the log at a limited rate.

    Without the limit a process that has run out of descriptors would flood its log, since
    every connection that cannot be accepted is an error.
    """

    def __init__(self) -> None:
        """Make a loop that measures its turns, and writes errors that asyncio reports to
        the log at a limited rate.
        """
        self.holds = Holds()
        super().__init__(_Watched(self.holds))
        lines = Sparing(burst=1)

        def complain(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
            """Log reports of asyncio, at most one line of each kind and then one at
            intervals.

            A report without an error, or of an OSError, is a warning; others are errors
            with traceback.
            """
            what = str(context.get("message"))
            error = context.get("exception")
            kind = f"{what} {type(error).__name__}"
            if error is None or isinstance(error, OSError):
                lines.log(
                    "event loop",
                    logging.WARNING,
                    kind=kind,
                    message=what,
                    reason=str(error),
                )
                return
            try:
                raise error
            except BaseException:
                lines.log(
                    "event loop", logging.ERROR, kind=kind, error=True, message=what
                )

        self.set_exception_handler(complain)


class ListeningServer:
    """A server that listens; `port` is valid once it does."""

    server: asyncio.Server | None = None

    @property
    def port(self) -> int:
        """Port it listens on, the system's choice for 0; `listen` must have been called."""
        assert self.server is not None
        return int(self.server.sockets[0].getsockname()[1])

    async def listen(
        self,
        made: Callable[[], asyncio.BaseProtocol],
        host: str,
        port: int,
        ssl: tls.SSLContext | None = None,
        *,
        serving: bool = True,
    ) -> None:
        """Take an address and accept connections on it.

        At most one connection is accepted in a turn of the loop.

        `made`: makes the protocol of a connection. `host` and `port`: address to take; port 0 is
        any free one. `ssl`: for TLS, whose handshake may take `TLS_HANDSHAKE_S`; None: none.
        `serving`: False lets connections wait until `serve`.
        Raises OSError: the address is taken or not ours.
        """
        self.server = await asyncio.get_running_loop().create_server(
            made,
            host,
            port,
            ssl=ssl,
            backlog=1,
            ssl_handshake_timeout=None if ssl is None else TLS_HANDSHAKE_S,
            start_serving=serving,
        )
        one_at_a_time(self.server)

    async def serve(self) -> None:
        """Accept the connections that `listen` let wait."""
        assert self.server is not None
        await self.server.start_serving()
        one_at_a_time(self.server)


def one_at_a_time(server: asyncio.Server) -> None:
    """Set the system's usual backlog for a server made with `backlog=1`.

    asyncio tries to accept `backlog` connections in one go, and when descriptors run out
    it schedules a new attempt for each that failed, so that attempts multiply a
    hundredfold every second. With one at a time there is a single attempt. New
    connections also alternate with requests that way."""
    for listening in server.sockets:
        with listening.dup() as same:
            same.listen(BACKLOG)


KEEP_ALIVE_AFTER_S: Final = 30
"""Silence before the first keep-alive probe [s]."""


def tune(sock: socket.socket | None) -> None:
    """Disable Nagle's delay, and send keep-alive probes after `KEEP_ALIVE_AFTER_S` of
    silence.

    A peer whose machine or network has died is thus gone after a minute instead of two
    hours, and with it whatever it held (control of the twin, memory of an upload).
    Options that the platform lacks are skipped.

    Args:
        sock: of a connection; None or another one than TCP has no effect.
    """
    if sock is None or sock.family not in (socket.AF_INET, socket.AF_INET6):
        return
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (
        ("TCP_KEEPIDLE", KEEP_ALIVE_AFTER_S),
        ("TCP_KEEPINTVL", KEEP_ALIVE_AFTER_S // 3),
        ("TCP_KEEPCNT", 3),
        ("TCP_USER_TIMEOUT", 2000 * KEEP_ALIVE_AFTER_S),
    ):
        option = getattr(socket, name, None)
        if option is not None:
            sock.setsockopt(socket.IPPROTO_TCP, option, value)


OK = 0
INVALID = 1
FAILED = 1
USAGE = 2
REFUSED = 4
INTERRUPTED = 130
INTERRUPTED_LINE = b"flexdt: interrupted\n"
SUPERVISED = "FLEXDT_SUPERVISED"
"""Environment variable of a supervisor's processes."""
SIGNALS = (signal.SIGTERM, signal.SIGINT)

S = TypeVar("S", bound=ProcessSettings)
T = TypeVar("T")


def stop_signal() -> asyncio.Event:
    """Return an event that SIGTERM or SIGINT sets from now on, in place of earlier
    handlers; it needs a running loop.

    Further signals do not interrupt the stopping. A console script that watches for
    signals by the wake-up descriptor is notified, so that it can end a stopping that gets
    stuck.
    """
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    watch = signal.set_wakeup_fd(-1)

    def begin_to_stop() -> None:
        """Set the event, and wake the earlier wake-up descriptor's reader."""
        stop.set()
        if watch != -1:
            with contextlib.suppress(OSError):
                os.write(watch, b"\0")

    for number in SIGNALS:
        loop.add_signal_handler(number, begin_to_stop)
    return stop


def leave(*_: object) -> None:
    """End the process now, with `INTERRUPTED` and a line."""
    try:
        os.write(2, INTERRUPTED_LINE)
    finally:
        os._exit(INTERRUPTED)


async def first_of(*events: asyncio.Event) -> None:
    """Wait until one of the events is set; return at once if one is."""
    waits = [asyncio.create_task(event.wait()) for event in events]
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()


def announce(server: str, facts: Mapping[str, object], out: TextIO | None = None) -> None:
    """Print the JSON line of a ready server: its kind, `facts`, process id.

    A `ServerLoop` freezes what garbage collection left, and measures its turns anew.
    `out`: None: standard output.
    """
    loop = asyncio.get_running_loop()
    if isinstance(loop, ServerLoop):
        # These objects stay: a pass of the garbage collector over them takes 0.1 s.
        gc.collect()
        gc.freeze()
        loop.holds.begin()  # no client has waited for it yet
    print(
        json.dumps({"ready": server, **facts, "pid": os.getpid()}), file=out, flush=True
    )


def announce_bound(server: str, host: str, port: int) -> None:
    """Print the address before `ready`, for a supervisor, which starts others meanwhile."""
    if SUPERVISED in os.environ:
        print(json.dumps({"bound": server, "host": host, "port": port}), flush=True)


def run_process(settings: S, run: Callable[[S], Coroutine[None, None, int]]) -> int:
    """Run the work of a process to its end in an event loop; return its exit code.

    An error is printed: USAGE after an AccessError (INVALID for its file), INVALID after
    a TwinError, ValueError or an OSError of a file, REFUSED after another; others are
    raised.

    Until the work calls `stop_signal`, before it is ready, SIGINT (unless ignored) ends
    the process at once: an exception within asyncio's loop can lose the turn of a task.
    """
    _allow_descriptors()
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        signal.signal(signal.SIGINT, leave)
    try:
        with asyncio.Runner(loop_factory=ServerLoop) as runner:
            return runner.run(run(settings))
    except AccessError as error:
        problem = str(error)
        code = USAGE
        if isinstance(error, AccessFileError):
            code = INVALID
    except (TwinError, ValueError) as error:
        problem = str(error)
        code = INVALID
    except OSError as error:
        if error.filename is None:
            problem = (
                f"cannot listen on {settings.host}:{settings.port}: {reason_of(error)}"
            )
            code = REFUSED
        else:
            problem = f"{error.filename}: {reason_of(error)}"
            code = INVALID
    print(f"flexdt {settings.command}: {problem}", file=sys.stderr)
    return code


def _allow_descriptors() -> None:
    """Raise the process's limit on open descriptors to `MAX_DESCRIPTORS` or the hard
    limit; it is never lowered.

    Nothing happens on Windows, or if the system refuses.
    """
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = MAX_DESCRIPTORS
    if hard != resource.RLIM_INFINITY:
        limit = min(hard, MAX_DESCRIPTORS)
    with contextlib.suppress(OSError, ValueError):  # macOS allows fewer than it reports
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, limit), hard))


def read_if_there(file: Path | None, parse: Callable[[str, str], T]) -> T | None:
    """Read and parse a machine's or profile's file; None if there is no such file.

    `file`: to read; `parse`: takes the text and the file's name for its errors."""
    if file is None or not file.exists():
        return None
    return parse(file.read_text(encoding="utf-8"), str(file))


def process_seconds(pid: int) -> float | None:
    """Return the processor time of a process so far, with its children that have ended [s].

    A busy machine gives a process less of its processors, not less to do: the limit of
    work is the time that the work itself has used. None if the system does not report it."""
    words = _words(str(pid))
    return _seconds(words) if words else None


def session_seconds(session: int) -> float | None:
    """Sum up the processor time of the running processes of a session so far [s].

    Args:
        session: its number, which is the process id of its first process.

    Returns:
        The sum; None where the system has no /proc or no process of that session runs.
    """
    try:
        names = [name for name in os.listdir("/proc") if name.isdigit()]
    except OSError:
        return None
    found = [words for words in map(_words, names) if words and int(words[3]) == session]
    if found:
        return sum(map(_seconds, found))
    return None


def _words(pid: str) -> list[str]:
    """Return the fields of a process's `stat` line from the state on; [] for one that has
    ended.
    """
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
            return file.read().rpartition(")")[2].split()
    except OSError:
        return []


def _seconds(words: list[str]) -> float:
    """Sum up the processor times of a process's fields [s]."""
    return sum(int(word) for word in words[11:15]) / os.sysconf("SC_CLK_TCK")
