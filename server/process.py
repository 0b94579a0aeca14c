"""What every server process does around its work: signals, ready line, exit codes.

The four `*_main` modules say what they serve and with which options; how a process announces
itself, ends, and tells what kept it from serving stands here once. It refuses to know the work.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import os
import signal
import sys
from collections.abc import Callable, Coroutine, Mapping
from typing import TextIO

from flexdt.server.access import AccessError, AccessFileError
from flexdt.server.loop import ServerLoop
from flexdt.twin.errors import TwinError

OK = 0
INVALID = 1
USAGE = 2
REFUSED = 4
SIGNALS = (signal.SIGTERM, signal.SIGINT)


def stop_signal() -> asyncio.Event:
    """Set by SIGTERM or SIGINT; a second signal does not interrupt the stopping."""
    stop = asyncio.Event()
    for number in SIGNALS:
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    return stop


def announce(server: str, facts: Mapping[str, object], out: TextIO | None = None) -> None:
    """Print the one JSON line that says the server is ready, with its process's id."""
    loop = asyncio.get_running_loop()
    if isinstance(loop, ServerLoop):
        # What is there now stays: looking through it for garbage would take 0.1 s each time.
        gc.collect()
        gc.freeze()
        loop.holds.begin()  # until here nobody has waited for it
    print(json.dumps({"ready": server, **facts, "pid": os.getpid()}), file=out, flush=True)


def run_process(
    name: str,
    options: argparse.Namespace,
    run: Callable[[argparse.Namespace], Coroutine[None, None, int]],
) -> int:
    """Run the work to its end; returns the exit code, what kept it from serving on stderr.

    Args:
        name: of the command, as in `flexdt NAME`.
        options: the command's; `host` and `port` are where it listens.
        run: the work; returns its own exit code.
    """
    try:
        with asyncio.Runner(loop_factory=ServerLoop) as runner:
            return runner.run(run(options))
    except AccessError as error:
        problem, code = str(error), INVALID if isinstance(error, AccessFileError) else USAGE
    except (TwinError, ValueError) as error:
        problem, code = str(error), INVALID
    except OSError as error:
        problem = f"cannot listen on {options.host}:{options.port}: {error.strerror}"
        code = REFUSED
    print(f"flexdt {name}: {problem}", file=sys.stderr)
    return code
