"""The console script `flexdt`: Ctrl-C ends it within a second at any time.

Installed as the module `flexdt_command` outside the package (`src/flexdt_command.py` is a
link to this file): an import of any module of the package imports the package itself
first.

From the start of `main` on SIGINT ends the process with exit code 130 and one line:

- while a module is imported, at once: libraries do not expect an exception there, and
some swallow
  it;
- where the main thread runs Python, as KeyboardInterrupt, which commands clean up after;
at once
  where no code would get it, as in a finaliser;
- where the main thread has been in compiled code for `STUCK_S` (a kernel, the compiler),
at once.
"""

from __future__ import annotations

import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    import signal
else:
    import _signal as signal  # in memory since Python began: nothing is searched for meanwhile

INTERRUPTED = 130
LINE = b"flexdt: interrupted\n"
STUCK_S = 0.4
"""Time from the signal to the end of a process whose main thread has not reacted [s]."""
IMPORT_FILE = "<frozen importlib._bootstrap>"

_heard = 0
"""Number of signals that the main thread has handled."""


def leave(*_: object) -> None:
    """End the process now; printed lines stay."""
    try:
        os.write(2, LINE)
    finally:
        os._exit(INTERRUPTED)


def _interrupt(number: int, frame: object) -> None:
    """Handle SIGINT in the main thread."""
    global _heard
    _heard += 1
    while frame is not None:
        if frame.f_code.co_filename == IMPORT_FILE:  # type: ignore[attr-defined]
            leave()
        frame = frame.f_back  # type: ignore[attr-defined]
    raise KeyboardInterrupt


def _watch() -> None:
    """Have a thread end the process where the main thread does not hear of a signal."""
    import threading

    heard_of, arrives = os.pipe()
    os.set_blocking(arrives, False)
    signal.set_wakeup_fd(arrives, warn_on_full_buffer=False)
    threading.Thread(
        target=_end_if_stuck, args=(heard_of,), name="interrupts", daemon=True
    ).start()


def _end_if_stuck(arrivals: int) -> None:
    import time

    while True:
        before = _heard
        if signal.SIGINT in os.read(arrivals, 1):
            time.sleep(STUCK_S)
            if _heard == before:
                leave()


def _not_lost(unraisable: object) -> None:
    """End the process at a KeyboardInterrupt that no code gets, as in a finaliser."""
    if unraisable.exc_type is KeyboardInterrupt:  # type: ignore[attr-defined]
        leave()
    sys.__unraisablehook__(unraisable)  # type: ignore[arg-type]


def main() -> None:
    """Run the command line of this process."""
    if (
        signal.getsignal(signal.SIGINT) != signal.default_int_handler
    ):  # a shell's `&` ignores it
        _command()
        return
    signal.signal(signal.SIGINT, _interrupt)
    import atexit

    # Registered first it is called last, when all is done: Python itself takes its handlers
    # away before it has ended, and the signal would kill it.
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    try:
        if sys.platform != "win32":
            _watch()
        sys.unraisablehook = _not_lost
        _command()
    except KeyboardInterrupt:
        leave()
    except SystemExit as ended:
        if ended.code == INTERRUPTED:
            _end_without_teardown()
        raise
    finally:
        signal.signal(signal.SIGINT, leave)


def _end_without_teardown() -> None:
    """End the process after its exit functions, without freeing its objects.

    An interruption in the compiler leaves objects half made, and freeing them can crash.
    """
    import atexit

    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(INTERRUPTED)


def _command() -> None:
    from flexdt.clients.cli import main as command

    command()
