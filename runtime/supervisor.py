"""Start several server processes in order, keep them alive, stop them all: no orphans.

Each service prints one JSON `ready` line with its address on standard output; later services get
the addresses of earlier ones. A service that ends, or is killed at any moment, is started again for
ever on the address it had, with pauses that grow up to half a minute; it never ends the others.
Only one that leaves by itself at its very first start ends them all: somebody has to look at its
options. A start may take as long as it works (compiling takes minutes on a busy machine): only one
that uses no processor time for `STALLED_S` is ended. Services run in sessions of their own, so
Ctrl-C reaches only the supervisor, which stops them in reverse order; should the supervisor itself
be killed, their standard input closes and they stop (see `child`).
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

from flexdt.process_settings import Address
from flexdt.runtime.process import session_seconds, stop_signal

STALLED_S = 300.0
"""A service that is not ready and has used no processor time for so long waits for something that
will not come."""
SILENT_S = 2.0
"""After so long without a `ready` line, somebody who waits is told for what."""
STILL_S = 60.0
"""How often somebody who waits is told how much work a start has done so far."""
STOP_GRACE_S = 10.0
FIRST_PAUSE_S = 0.5
"""Between the second end in a row and the next start; it doubles from there."""
LONGEST_PAUSE_S = 30.0
LOOK_S = 0.2
STEADY_S = 10.0
"""A service that was ready for so long begins anew: it is started again at once."""
TOLD_SINGLY = 5
"""Ends in a row that are told one by one; from there on, those that double their number."""


Addresses = Mapping[str, Address]


@dataclass(frozen=True)
class Service:
    """One process to look after.

    Attributes:
        name: as in its `ready` line.
        command: addresses known so far (its own too, after a first start) -> module and arguments.
        slow: why a start may take long, for somebody who waits.
    """

    name: str
    command: Callable[[Addresses], Sequence[str]]
    slow: str = ""


class ServiceError(Exception):
    """A service left by itself at its first start; the message says which and how.

    Attributes:
        exit_code: the service's own, where it is not 0, else 1.
    """

    def __init__(self, message: str, returncode: int = 1) -> None:
        super().__init__(message)
        self.exit_code = returncode if returncode > 0 else 1


@dataclass
class Ends:
    """The ends of one service, in a row; steady work between two begins a new row."""

    row: int = 0

    def after(self, steady_s: float) -> float:
        """Count an end; how long to pause before the next start [s].

        Args:
            steady_s: for how long the service had been ready.
        """
        self.row = 1 if steady_s >= STEADY_S else self.row + 1
        if self.row == 1:
            return 0.0
        return min(FIRST_PAUSE_S * 2.0 ** min(self.row - 2, 60), LONGEST_PAUSE_S)

    @property
    def told(self) -> bool:
        """Whether the last one is worth a line."""
        return self.row <= TOLD_SINGLY or self.row & (self.row - 1) == 0


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
        """Start everything, look after it until `stop` is set, then stop everything.

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
            for task in (work, stopping):
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, ServiceError):
                    await task
            await self._stop_all()

    async def _look_after(self) -> None:
        keepers: list[asyncio.Task[None]] = []
        try:
            for service in self.services:
                ready = asyncio.Event()
                keepers.append(asyncio.create_task(self._keep(service, ready)))
                first = asyncio.create_task(ready.wait())
                await asyncio.wait({first, *keepers}, return_when=FIRST_COMPLETED)
                first.cancel()
                for keeper in keepers:
                    if keeper.done():
                        keeper.result()
            self.announce(dict(self.addresses))
            await asyncio.gather(*keepers)
        finally:
            for keeper in keepers:
                keeper.cancel()
            await asyncio.gather(*keepers, return_exceptions=True)

    async def _keep(self, service: Service, ready: asyncio.Event) -> None:
        """Start a service, wait for its end, and again; `ready` is set once it has been ready.

        Raises:
            ServiceError: it left by itself at its first start.
        """
        clock, ends, first = asyncio.get_running_loop().time, Ends(), True
        while True:
            begun = None
            try:
                process = await self._spawn(service)
                self.addresses[service.name] = await self._ready(process, service)
                begun = clock()
                ready.set()
                how = _how(await _drained(process))
            except _Ended as end:
                if first and end.returncode is not None and end.returncode >= 0:
                    raise ServiceError(
                        f"the {service.name} did not start ({end})", end.returncode
                    ) from None
                how = f"{end}, while starting"
            first = False
            self._bury(service)
            pause = ends.after(0.0 if begun is None else clock() - begun)
            if ends.told:
                times = f" for the {ends.row}th time in a row" if ends.row > TOLD_SINGLY else ""
                later = f" in {pause:g} s" if pause else ""
                self.note(f"the {service.name} ended ({how}){times}; starting it again{later}")
            await asyncio.sleep(pause)

    async def _spawn(self, service: Service) -> Process:
        """Raises `_Ended` where the system has no room for another process."""
        try:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-P",  # the installed package, not what the current folder has of that name
                "-m",
                "flexdt.runtime.child",
                *service.command(dict(self.addresses)),
                stdin=PIPE,
                stdout=PIPE,
                start_new_session=True,
            )
        except OSError as error:
            raise _Ended(f"no process: {error.strerror}") from None
        self._running[service.name] = process
        return process

    async def _ready(self, process: Process, service: Service) -> Address:
        """Where it listens; says what is waited for, and later how far it has come.

        Raises:
            _Ended: before it said so, or it no longer does anything.
        """
        clock = asyncio.get_running_loop().time
        address = asyncio.create_task(_address(process, service.name))
        end = asyncio.create_task(_ended(process))
        used_s, since, note_at = session_seconds(process.pid), clock(), clock() + SILENT_S
        note = f"waiting for the {service.name}" + (service.slow and f": {service.slow}")
        try:
            while not (address.done() or end.done()):
                now_s = session_seconds(process.pid)
                if now_s is None or now_s != used_s:
                    used_s, since = now_s, clock()
                if clock() - since >= STALLED_S:
                    raise _Ended(f"it did nothing for {STALLED_S:g} s")
                if clock() >= note_at and (note or used_s is not None):
                    work = (
                        f"the {service.name} is still starting: {used_s or 0:.0f} s of work so far"
                    )
                    self.note(note or work)
                    note, note_at = "", clock() + STILL_S
                await asyncio.wait({address, end}, timeout=LOOK_S, return_when=FIRST_COMPLETED)
            if address.done():
                return address.result()
            raise _Ended(_how(end.result()), end.result())
        finally:
            for task in (address, end):
                task.cancel()
            await asyncio.gather(address, end, return_exceptions=True)

    def _bury(self, service: Service) -> None:
        """End what is left of a service: processes it started may hold its port or its files."""
        process = self._running.pop(service.name, None)
        if process is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)

    async def _stop_all(self) -> None:
        for service in reversed(self.services):
            process = self._running.get(service.name)
            if process is not None and process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    process.terminate()
                try:
                    async with asyncio.timeout(STOP_GRACE_S):
                        await _drained(process)
                except TimeoutError:
                    self.note(f"the {service.name} did not stop; killing it")
                    with contextlib.suppress(ProcessLookupError):
                        process.kill()
                    await _ended(process)
            self._bury(service)


class _Ended(Exception):
    """A process ended, or never began; the message says how, `returncode` where it has one."""

    def __init__(self, how: str, returncode: int | None = None) -> None:
        super().__init__(how)
        self.returncode = returncode


async def _address(process: Process, name: str) -> Address:
    """The address in the `ready` line; other lines before it are passed over."""
    assert process.stdout is not None
    while True:
        # A ValueError, too, is a line longer than the reader keeps.
        with contextlib.suppress(ValueError, KeyError, TypeError, RecursionError):
            if not (line := await process.stdout.readline()):
                await asyncio.Event().wait()  # it prints no more, and may live: others look
            message = json.loads(line)
            if message["ready"] == name:
                return Address(str(message["host"]), int(message["port"]))


async def _drained(process: Process) -> int:
    """Keep the pipe empty, so that a service that prints can never block; its code at its end."""
    drain = asyncio.create_task(_drain(process))
    try:
        return await _ended(process)
    finally:
        drain.cancel()
        await asyncio.gather(drain, return_exceptions=True)


async def _drain(process: Process) -> None:
    assert process.stdout is not None
    while await process.stdout.read(65536):
        pass


async def _ended(process: Process) -> int:
    """The code of a process at its end; `Process.wait` waits for all who inherited its pipes."""
    end = asyncio.create_task(process.wait())
    try:
        while process.returncode is None:
            await asyncio.wait({end}, timeout=LOOK_S)
    finally:
        end.cancel()
    return process.returncode


def _how(code: int) -> str:
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
