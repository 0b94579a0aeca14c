"""Start several server processes in order, keep them alive, stop them all: no orphans.

Each service prints one JSON `ready` line with its address on standard output; later services get
the addresses of earlier ones. A service that may be restarted is, on the address it had before; the
end of any other ends them all. Services run in sessions of their own, so Ctrl-C reaches only the
supervisor, which stops them in reverse order; should the supervisor itself be killed, their
standard input closes and they stop (see `child`). It refuses to know what the services do.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
import time
from asyncio.subprocess import PIPE, Process
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from flexdt.server.process import stop_signal

READY_TIMEOUT_S = 300.0
"""A first start compiles the projector's kernels; on a slow, busy machine that takes minutes."""
SILENT_S = 5.0
"""After so long without a `ready` line, somebody who waits is told for what."""
STOP_GRACE_S = 10.0
MAX_RESTARTS = 5
RESTART_WINDOW_S = 30.0


@dataclass(frozen=True)
class Address:
    """Where a service listens."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


Addresses = Mapping[str, Address]


@dataclass(frozen=True)
class Service:
    """One process to look after.

    Attributes:
        name: as in its `ready` line.
        command: addresses known so far (its own too, after a first start) -> module and arguments.
        restart: start it again when it dies; otherwise its end ends everything.
        slow: why a start may take long, for somebody who waits.
    """

    name: str
    command: Callable[[Addresses], Sequence[str]]
    restart: bool = False
    slow: str = ""


class ServiceError(Exception):
    """A service did not start, or died for good; the message says which and how.

    Attributes:
        exit_code: the service's own, where it left with one, else 1.
    """

    def __init__(self, message: str, returncode: int = 1) -> None:
        super().__init__(message)
        self.exit_code = returncode if returncode > 0 else 1


@dataclass
class _Running:
    service: Service
    process: Process
    drain: asyncio.Task[None]


@dataclass
class Supervisor:
    """Runs `services` until stopped. One instance, one run.

    Attributes:
        services: in starting order.
        announce: called once with all addresses when everything is ready.
        note: called with one line about a restart or a slow start.
    """

    services: Sequence[Service]
    announce: Callable[[Addresses], None]
    note: Callable[[str], None]
    addresses: dict[str, Address] = field(default_factory=dict)
    _running: list[_Running] = field(default_factory=list)

    async def run(self, stop: asyncio.Event) -> None:
        """Start everything, look after it until `stop` is set, then stop everything.

        Raises:
            ServiceError: a service did not start or ended and may not be restarted.
        """
        work = asyncio.create_task(self._look_after())
        stopping = asyncio.create_task(stop.wait())
        try:
            await asyncio.wait({work, stopping}, return_when=asyncio.FIRST_COMPLETED)
            if work.done():
                work.result()
        finally:
            for task in (work, stopping):
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, ServiceError):
                    await task
            await self._stop_all()

    async def _look_after(self) -> None:
        for service in self.services:
            await self._start(service)
        self.announce(dict(self.addresses))
        watchers = [asyncio.create_task(self._watch(r)) for r in list(self._running)]
        try:
            await asyncio.gather(*watchers)
        finally:
            for watcher in watchers:
                watcher.cancel()
            await asyncio.gather(*watchers, return_exceptions=True)

    async def _watch(self, running: _Running) -> None:
        """Wait for the end of a process; restart it, within reason, or give up."""
        service, recent = running.service, deque[float](maxlen=MAX_RESTARTS)
        while True:
            code = await running.process.wait()
            self._running.remove(running)
            running.drain.cancel()
            how = _how(code)
            if not service.restart:
                raise ServiceError(f"the {service.name} ended by itself ({how})", code)
            now = time.monotonic()
            if len(recent) == MAX_RESTARTS and now - recent[0] < RESTART_WINDOW_S:
                raise ServiceError(
                    f"the {service.name} ended ({how}) for the {MAX_RESTARTS + 1}th time within "
                    f"{RESTART_WINDOW_S:.0f} s; not restarted again"
                )
            recent.append(now)
            self.note(f"the {service.name} ended ({how}); starting it again")
            running = await self._start(service)

    async def _start(self, service: Service) -> _Running:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "flexdt.server.child",
            *service.command(dict(self.addresses)),
            stdin=PIPE,
            stdout=PIPE,
            start_new_session=True,
        )
        running = _Running(service, process, asyncio.create_task(_nothing()))
        self._running.append(running)
        why = f": {service.slow}" if service.slow else ""
        loop = asyncio.get_running_loop()
        hint = loop.call_later(SILENT_S, self.note, f"waiting for the {service.name}{why}")
        try:
            async with asyncio.timeout(READY_TIMEOUT_S):
                self.addresses[service.name] = await _ready(process, service.name)
        except TimeoutError:
            raise ServiceError(
                f"the {service.name} was not ready within {READY_TIMEOUT_S:.0f} s"
            ) from None
        finally:
            hint.cancel()
        running.drain = asyncio.create_task(_drain(process))
        return running

    async def _stop_all(self) -> None:
        for running in reversed(self._running):
            process = running.process
            if process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    process.terminate()
                try:
                    async with asyncio.timeout(STOP_GRACE_S):
                        await process.wait()
                except TimeoutError:
                    self.note(f"the {running.service.name} did not stop; killing it")
                    with contextlib.suppress(ProcessLookupError):
                        process.kill()
                    await process.wait()
            running.drain.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await running.drain
        self._running.clear()


async def _ready(process: Process, name: str) -> Address:
    """The address in the `ready` line; other lines before it are passed over."""
    assert process.stdout is not None
    while line := await process.stdout.readline():
        with contextlib.suppress(ValueError, KeyError, TypeError):
            message = json.loads(line)
            if message["ready"] == name:
                return Address(str(message["host"]), int(message["port"]))
    code = await process.wait()
    raise ServiceError(f"the {name} did not start ({_how(code)})", code)


async def _drain(process: Process) -> None:
    """Keep the pipe empty, so that a service that prints can never block."""
    assert process.stdout is not None
    while await process.stdout.read(65536):
        pass


async def _nothing() -> None:
    return None


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
