"""Signals, `ready` line, exit codes and processor time of every server process.

The `main` modules of the processes say what they serve and with which options.
"""

from __future__ import annotations

import asyncio
import gc
import json
import os
import signal
import sys
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import TextIO, TypeVar

from flexdt.process_settings import ProcessSettings
from flexdt.runtime.access import AccessError, AccessFileError
from flexdt.runtime.loop import ServerLoop
from flexdt.twin.errors import TwinError

OK = 0
INVALID = 1
FAILED = 1
USAGE = 2
REFUSED = 4
SUPERVISED = "FLEXDT_SUPERVISED"
"""In the environment of a supervisor's processes."""
SIGNALS = (signal.SIGTERM, signal.SIGINT)

S = TypeVar("S", bound=ProcessSettings)
T = TypeVar("T")


def stop_signal() -> asyncio.Event:
    """An event set by SIGTERM or SIGINT; a second signal does not interrupt the stopping."""
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in SIGNALS:
        loop.add_signal_handler(number, stop.set)
    return stop


async def first_of(*events: asyncio.Event) -> None:
    """Wait until one of the events is set."""
    waits = [asyncio.create_task(event.wait()) for event in events]
    try:
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()


def announce(server: str, facts: Mapping[str, object], out: TextIO | None = None) -> None:
    """Print the one JSON line that says the server is ready, with its process's id."""
    loop = asyncio.get_running_loop()
    if isinstance(loop, ServerLoop):
        # What is there now stays: looking through it for garbage would take 0.1 s each time.
        gc.collect()
        gc.freeze()
        loop.holds.begin()  # until here nobody has waited for it
    print(json.dumps({"ready": server, **facts, "pid": os.getpid()}), file=out, flush=True)


def announce_bound(server: str, host: str, port: int) -> None:
    """For a supervisor, which starts others meanwhile: a line with the address before `ready`."""
    if SUPERVISED in os.environ:
        print(json.dumps({"bound": server, "host": host, "port": port}), flush=True)


def run_process(settings: S, run: Callable[[S], Coroutine[None, None, int]]) -> int:
    """Run the work to its end; returns the exit code, with the error on standard error if any.

    Args:
        settings: of the process; `host` and `port` are where it listens.
        run: the work; returns its own exit code.
    """
    try:
        with asyncio.Runner(loop_factory=ServerLoop) as runner:
            return runner.run(run(settings))
    except AccessError as error:
        problem, code = str(error), INVALID if isinstance(error, AccessFileError) else USAGE
    except (TwinError, ValueError) as error:
        problem, code = str(error), INVALID
    except OSError as error:
        if error.filename is None:
            problem = f"cannot listen on {settings.host}:{settings.port}: {error.strerror}"
            code = REFUSED
        else:
            problem, code = f"{error.filename}: {error.strerror}", INVALID
    print(f"flexdt {settings.command}: {problem}", file=sys.stderr)
    return code


def read_if_there(file: Path | None, parse: Callable[[str, str], T]) -> T | None:
    """A machine's or profile's file as `parse` reads it; None where there is no such file.

    Args:
        file: to read.
        parse: takes the text and the file's name for its errors.
    """
    if file is None or not file.exists():
        return None
    return parse(file.read_text(encoding="utf-8"), str(file))


def process_seconds(pid: int) -> float | None:
    """Processor time of a process so far, with the children that it has seen end [s].

    A busy machine gives a process less of its processors, not less to do: what bounds work is the
    time that the work itself has used. None where the system does not tell.
    """
    words = _words(str(pid))
    return _seconds(words) if words else None


def session_seconds(session: int) -> float | None:
    """Processor time of the processes of a session so far [s]; None as `process_seconds`.

    Args:
        session: its number, which is the process id of its first process.
    """
    try:
        names = [name for name in os.listdir("/proc") if name.isdigit()]
    except OSError:
        return None
    found = [words for words in map(_words, names) if words and int(words[3]) == session]
    return sum(map(_seconds, found)) if found else None


def _words(pid: str) -> list[str]:
    """The words of a process's line after its name; none of one that has ended meanwhile."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
            return file.read().rpartition(")")[2].split()
    except OSError:
        return []


def _seconds(words: list[str]) -> float:
    return sum(int(word) for word in words[11:15]) / os.sysconf("SC_CLK_TCK")
