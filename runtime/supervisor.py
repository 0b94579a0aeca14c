"""Start several server processes in order, keep them alive, stop them all: no orphans.

Each service prints one JSON `ready` line with its address on standard output; later
services get the addresses of earlier ones. One whose start takes long prints the same as
`bound` before, so that later ones start meanwhile. A service that ends, or is killed at
any moment, is started again for ever on the address it had, with pauses that grow up to
half a minute; it never ends the others. Only one that leaves by itself at its very first
start ends them all: its options need attention. A start may take as long as it works
(compiling takes minutes on a busy machine): only one that uses no processor time for
`STALLED_S` is ended. Services run in sessions of their own, so Ctrl-C reaches only the
supervisor, which stops them in reverse order; should the supervisor itself be killed,
their standard input closes and they stop (see `child`).
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from asyncio import FIRST_COMPLETED
from asyncio.subprocess import PIPE, Process
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from flexdt.message_words import reason_of
from flexdt.runtime.process import SUPERVISED, session_seconds, stop_signal
from flexdt.runtime.process_settings import Address
from flexdt.twin.long_work import Rhythm

STALLED_S = 300.0
"""Time without processor use after which a service that is not ready is ended [s]."""
STOP_GRACE_S = 10.0
FIRST_PAUSE_S = 0.5
"""Pause between the second end in a row and the next start [s]; it doubles from there."""
LONGEST_PAUSE_S = 30.0
"""Longest such pause [s]."""
CHECK_INTERVAL_S = 0.2
"""Interval at which processes are checked [s]."""
STEADY_S = 10.0
"""Time ready after which an end begins a new row: the service starts again at once [s]."""
MAX_SINGLE_REPORTS = 5
"""Number of ends in a row that are each reported; after that, those that double it."""


Addresses = Mapping[str, Address]


@dataclass(frozen=True)
class Service:
    """One process to look after.

    Attributes:
        name: as in its `ready` line.
        command: addresses known so far (its own too, after a first start) -> module and
            arguments.
        slow: reason for a slow start, for the user.
    """

    name: str
    command: Callable[[Addresses], Sequence[str]]
    slow: str = ""


class ServiceError(Exception):
    """A service left by itself at its first start; the message names it and its exit.

    Attributes:
        exit_code: the service's own, where it is not 0, else 1.
    """

    def __init__(self, message: str, returncode: int = 1) -> None:
        """Make the error; its exit code is that of the service, 1 for one that is not above 0."""
        super().__init__(message)
        self.exit_code = returncode if returncode > 0 else 1


@dataclass
class Ends:
    """The ends of one service, in a row; steady work between two begins a new row."""

    row: int = 0

    def after(self, steady_s: float) -> float:
        """Count an end; return the pause before the next start [s].

        The first end in a row has no pause; then it doubles from `FIRST_PAUSE_S` to
        `LONGEST_PAUSE_S`. A service ready for `STEADY_S` begins a new row.

        `steady_s`: for how long the service had been ready.
        """
        if steady_s >= STEADY_S:
            self.row = 1
        else:
            self.row = self.row + 1
        if self.row == 1:
            return 0.0
        # The exponent has a limit, because a float overflows after a thousand ends in a row.
        return min(FIRST_PAUSE_S * 2.0 ** min(self.row - 2, 60), LONGEST_PAUSE_S)

    @property
    def reported(self) -> bool:
        """Whether the last end is reported."""
        # A power of two has a single bit.
        return self.row <= MAX_SINGLE_REPORTS or self.row & (self.row - 1) == 0


@dataclass
class Supervisor:
    """Runs `services` until stopped. One instance, one run.

    Attributes:
        services: in starting order.
        announce: called once with all addresses when everything has been ready.
        note: called with one line about a restart or a slow start.
    """

    services: Sequence[Service]
    announce: Callable[[Addresses], None]
    note: Callable[[str], None]
    addresses: dict[str, Address] = field(default_factory=dict)
    _running: dict[str, Process] = field(default_factory=dict)

    async def run(self, stop: asyncio.Event) -> None:
        """Start all services, restart those that end until `stop` is set, then stop all
        in reverse order.

        They are stopped after errors and cancellation, too.

        Args:
            stop: set from outside.

        Raises:
            ServiceError: a service left by itself at its first start.
        """
        work = asyncio.create_task(self._look_after())
        stopping = asyncio.create_task(stop.wait())
        try:
            await asyncio.wait({work, stopping}, return_when=FIRST_COMPLETED)
            if work.done():
                work.result()
        finally:
            # First the keepers: they would start again what is stopped after this.
            for task in (work, stopping):
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, ServiceError):
                    await task
            await self._stop_all()

    async def _look_after(self) -> None:
        """Start the services one after the other, each once the one before has its
        address; announce all addresses when all are ready.

        Then they are kept alive until one is given up or this is canceled; their
        processes go on.

        Raises:
            ServiceError: a service left by itself at its first start.
        """
        keepers: list[asyncio.Task[None]] = []
        try:
            starts = [_Start(service) for service in self.services]
            for start in starts:
                keepers.append(asyncio.create_task(self._keep_alive(start)))
                # The next service needs no more than this address, and compiles at the same
                # time.
                await _unless_one_ends(start.bound, keepers)
            for start in starts:
                await _unless_one_ends(start.ready, keepers)
            self.announce(dict(self.addresses))
            await asyncio.gather(*keepers)
        finally:
            for keeper in keepers:
                keeper.cancel()
            await asyncio.gather(*keepers, return_exceptions=True)

    async def _keep_alive(self, start: _Start) -> None:
        """Start a service, and again whenever it ends, after a growing pause; end only by
        cancellation or at a failed first start.

        Remaining processes of it are killed before each new start. Ends are noted in
        words as `Ends.reported` allows. A first start that a signal ends is tried again.

        Args:
            start: the service and the events of its start.

        Raises:
            ServiceError: it exited with a code of 0 or more before it was ready for the
                first time.
        """
        clock = asyncio.get_running_loop().time
        ends = Ends()
        first = True
        service = start.service
        while True:
            begun = None
            try:
                process = await self._spawn(service)
                await self._wait_until_ready(process, start)
                begun = clock()
                start.ready.set()
                how = _how(await _drained(process))
            except _Ended as end:
                # Below 0 a signal has ended it: that was not its own decision, and says nothing
                # of its options.
                if first and end.returncode is not None and end.returncode >= 0:
                    raise ServiceError(
                        f"the {service.name} did not start ({end})", end.returncode
                    ) from None
                how = f"{end}, while starting"
            first = False
            # Before the next start, because one of its children may hold the port.
            self._forget(service)
            pause = ends.after(0.0 if begun is None else clock() - begun)
            if ends.reported:
                times = ""
                if ends.row > MAX_SINGLE_REPORTS:
                    times = f" for the {ends.row}th time in a row"
                later = f" in {pause:g} s" if pause else ""
                self.note(
                    f"the {service.name} ended ({how}){times}; starting it again{later}"
                )
            await asyncio.sleep(pause)

    async def _spawn(self, service: Service) -> Process:
        """Start and record a service's process, which ends with its parent.

        It runs `flexdt.runtime.child` in a session of its own, with pipes for input and
        output.

        Args:
            service: with its command.

        Raises:
            _Ended: the system cannot start a process.
        """
        try:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-P",  # the installed package, not a folder of that name
                "-m",
                "flexdt.runtime.child",
                *service.command(dict(self.addresses)),
                # Open as long as we live: `child` takes its end for ours.
                stdin=PIPE,
                stdout=PIPE,
                # A terminal sends Ctrl-C to its whole session; only the supervisor is to get
                # it.
                start_new_session=True,
                env=os.environ | {SUPERVISED: "1"},
            )
        except OSError as error:
            raise _Ended(f"no process: {reason_of(error)}") from None
        self._running[service.name] = process
        return process

    async def _wait_until_ready(self, process: Process, start: _Start) -> None:
        """Wait until a service is ready; note the wait ever more rarely
        (`Rhythm`), with the processor time so far.

        It is given up after `STALLED_S` without processor time; where that cannot be
        measured it is never given up.

        Args:
            process: of the service.
            start: the service and the events of its start.

        Raises:
            _Ended: it ended before it was ready, or it no longer does anything.
        """
        clock = asyncio.get_running_loop().time
        service = start.service
        ready = asyncio.create_task(self._read_addresses(process, start))
        end = asyncio.create_task(_ended(process))
        # Of the whole session: a compiler that it starts counts as its work.
        used_s = session_seconds(process.pid)
        since = clock()
        rhythm = Rhythm.begun(clock())
        note = f"waiting for the {service.name}" + (service.slow and f": {service.slow}")
        try:
            while not (ready.done() or end.done()):
                now_s = session_seconds(process.pid)
                if now_s is None or now_s != used_s:
                    used_s = now_s
                    since = clock()
                if clock() - since >= STALLED_S:
                    raise _Ended(f"it did nothing for {STALLED_S:g} s")
                if (note or used_s is not None) and rhythm.write(clock()):
                    work = (
                        f"the {service.name} is still starting: {used_s or 0:.0f} s of "
                        "work so far"
                    )
                    self.note(note or work)
                    note = ""
                await asyncio.wait(
                    {ready, end}, timeout=CHECK_INTERVAL_S, return_when=FIRST_COMPLETED
                )
            if ready.done():
                return ready.result()
            raise _Ended(_how(end.result()), end.result())
        finally:
            for task in (ready, end):
                task.cancel()
            await asyncio.gather(ready, end, return_exceptions=True)

    async def _read_addresses(self, process: Process, start: _Start) -> None:
        """Read a service's output up to `ready`: record the address of `bound` and
        `ready` lines, skip others.

        It returns after `ready`. At the end of the output it waits for ever: the caller
        sees that the process has ended.

        Args:
            process: of the service.
            start: the service and the events of its start; `bound` is set here.
        """
        assert process.stdout is not None
        name = start.service.name
        while True:
            # A ValueError, too, is a line longer than the reader keeps.
            with contextlib.suppress(
                ValueError, KeyError, TypeError, AttributeError, RecursionError
            ):
                if not (line := await process.stdout.readline()):
                    await (
                        asyncio.Event().wait()
                    )  # it prints no more, and may live: others look
                message = json.loads(line)
                if name in (message.get("bound"), message.get("ready")):
                    self.addresses[name] = Address(
                        str(message["host"]), int(message["port"])
                    )
                    start.bound.set()
                    if "ready" in message:
                        return

    def _forget(self, service: Service) -> None:
        """Kill the remaining processes of a service's group, which may hold its port or
        its files, and forget its process.

        Nothing happens if none is recorded."""
        # It led its session, so that its number is the group's, also after its own end.
        process = self._running.pop(service.name, None)
        if process is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)

    async def _stop_all(self) -> None:
        """Stop all services in reverse order, one by one, and kill the rest of their
        process groups.

        One that takes over `STOP_GRACE_S` is killed, which is noted.
        """
        # Clients end before the servers that they ask.
        for service in reversed(self.services):
            process = self._running.get(service.name)
            if process is not None and process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    # The process alone: it ends its children in order, and the group is killed
                    # after that.
                    process.terminate()
                try:
                    async with asyncio.timeout(STOP_GRACE_S):
                        await _drained(process)
                except TimeoutError:
                    self.note(f"the {service.name} did not stop; killing it")
                    with contextlib.suppress(ProcessLookupError):
                        process.kill()
                    await _ended(process)
            self._forget(service)


class _Ended(Exception):
    """A process ended, or never began; the message names the exit, `returncode` its code
    if there is one."""

    def __init__(self, how: str, returncode: int | None = None) -> None:
        """Make the exception with how a service ended; the return code is None if it did not
        exit."""
        super().__init__(how)
        self.returncode = returncode


@dataclass(frozen=True)
class _Start:
    """A service, and how far its first start has come."""

    service: Service
    bound: asyncio.Event = field(default_factory=asyncio.Event)
    ready: asyncio.Event = field(default_factory=asyncio.Event)


async def _unless_one_ends(
    event: asyncio.Event, keepers: Sequence[asyncio.Task[None]]
) -> None:
    """Wait until an event is set or a keeper ends.

    Raises:
        Exception: the error of the keeper that has ended.
    """
    waiting = asyncio.create_task(event.wait())
    await asyncio.wait({waiting, *keepers}, return_when=FIRST_COMPLETED)
    waiting.cancel()
    for keeper in keepers:
        if keeper.done():
            keeper.result()


async def _drained(process: Process) -> int:
    """Read and drop a process's output until it ends, so that its printing never blocks;
    return its exit code.
    """
    drain = asyncio.create_task(_drain(process))
    try:
        return await _ended(process)
    finally:
        drain.cancel()
        await asyncio.gather(drain, return_exceptions=True)


async def _drain(process: Process) -> None:
    """Read and discard a process's standard output until it ends."""
    assert process.stdout is not None
    while await process.stdout.read(65536):
        pass


async def _ended(process: Process) -> int:
    """Wait for the end of a process, whatever its children do with the same pipes, and
    return its exit code.

    It is looked at every `CHECK_INTERVAL_S`.
    """
    # In some versions of Python `wait` also waits until the pipes are closed, which a child of
    # the process may hold open.
    end = asyncio.create_task(process.wait())
    try:
        while process.returncode is None:
            await asyncio.wait({end}, timeout=CHECK_INTERVAL_S)
    finally:
        end.cancel()
    return process.returncode


def _how(code: int) -> str:
    """Describe an exit code as "exit code N", a negative one as the signal that killed
    the process.
    """
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"


async def until_signalled(supervisor: Supervisor) -> None:
    """Run until SIGINT or SIGTERM; a second signal does not interrupt the stopping.

    Raises:
        ServiceError: see `Supervisor.run`.
    """
    await supervisor.run(stop_signal())
