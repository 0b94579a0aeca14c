"""The console script `flexdt`: Ctrl-C ends it within a second at any time.

Installed as the module `flexdt_command` outside the package (`src/flexdt_command.py` is a
link to this file): an import of any module of the package imports the package itself
first.

From the start of `main` on SIGINT ends the process with exit code 130 and one line:

- while a module is imported, at once: libraries do not expect an exception there, and
  some swallow it;
- where the main thread runs Python, as KeyboardInterrupt, which commands clean up after;
  at once where no code would get it, as in a finaliser;
- where the main thread has been in compiled code for `STUCK_S` (a kernel, the compiler),
  at once;
- after `SILENCE_S` in which the process, its descendants and their disks have had nothing
  to do: an exception that a library swallowed, a lock that is never released, an orderly
  end that waits for something that does not come. Servers, whose event loop hears of
  signals itself, report the beginning of their end by `runtime.process.stop_signal`.
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
SILENCE_S = 20.0
"""Time without work after which an end that has begun is taken for stuck [s]; supervised
processes have 15 s to stop."""
CHECK_S = 1.0
"""Interval at which the work of an ending process is measured [s]."""
MIN_WORKING_SHARE = 0.5
"""Least share of the time for which a process that works has a processor or waits for one;
a process that only runs timers has less."""
IMPORT_FILE = "<frozen importlib._bootstrap>"

_heard = 0
"""Number of signals that the main thread has handled."""


def leave(*_: object) -> None:
    """End the process at once, with INTERRUPTED and a line."""
    try:
        os.write(2, LINE)
    finally:
        os._exit(INTERRUPTED)


def _interrupt(number: int, frame: object) -> None:
    """Handle SIGINT in the main thread: count it, and raise KeyboardInterrupt.

    During an import, which must not be interrupted, end the process.
    """
    global _heard
    _heard += 1
    while frame is not None:
        if frame.f_code.co_filename == IMPORT_FILE:  # type: ignore[attr-defined]
            leave()
        frame = frame.f_back  # type: ignore[attr-defined]
    raise KeyboardInterrupt


def _watch() -> None:
    """Start a daemon thread that ends the process if the main thread does not react to
    SIGINT.

    Signals reach it through a pipe that is set as the process's wake-up descriptor.
    """
    import threading

    heard_of, arrives = os.pipe()
    os.set_blocking(arrives, False)
    signal.set_wakeup_fd(arrives, warn_on_full_buffer=False)
    threading.Thread(
        target=_end_if_stuck, args=(heard_of,), name="interrupts", daemon=True
    ).start()


def _end_if_stuck(arrivals: int) -> None:
    """End the process where the main thread does not react, or nothing works after.

    It never returns. After SIGINT there are STUCK_S to react; silence is watched for from
    the first one on. `arrivals`: descriptor of signals' numbers, 0 for an orderly end.
    """
    import threading
    import time

    watched = False
    while True:
        before = _heard
        number = os.read(arrivals, 1)[0]
        if number == signal.SIGINT:
            time.sleep(STUCK_S)
            if _heard == before:
                leave()
        if not watched and number in (signal.SIGINT, 0):
            watched = True
            threading.Thread(target=_end_if_silent, name="silence", daemon=True).start()


def _end_if_silent() -> None:
    """End the process once it has used almost no processor time for `SILENCE_S` seconds.

    With FLEXDT_TRACEBACK in the environment, dumps the stacks of all threads first.
    Almost none is less than `MIN_WORKING_SHARE` of the time, measured every `CHECK_S`
    seconds. It ends by `leave`, with exit code 130.
    """
    import time

    last_s = _wanted_s()
    since = seen = time.monotonic()
    while seen - since < SILENCE_S:
        time.sleep(CHECK_S)
        now_s = _wanted_s()
        now = time.monotonic()
        if now_s - last_s >= MIN_WORKING_SHARE * (now - seen):
            since = now
        last_s = now_s
        seen = now
    if "FLEXDT_TRACEBACK" in os.environ:
        import faulthandler

        faulthandler.dump_traceback()
    leave()


def _wanted_s() -> float:
    """Sum up for how long the threads of this process and its descendants have had a
    processor, or have waited for one or for a disk [s]; without /proc only those of this
    process, and only while they had one.

    Waiting counts as work: a busy machine gives a process less, and never ends it. The
    figure grows from call to call only as a difference; a thread waiting for a disk adds
    the present time.
    """
    import time

    try:
        tasks = [task for pid in _family() for task in _entries(f"/proc/{pid}/task")]
        times = [_text(f"{task}/schedstat").split()[:2] for task in tasks]
        states = [_text(f"{task}/stat").rpartition(")")[2].split()[:1] for task in tasks]
    except OSError:  # no /proc
        times = []
    if not any(times):
        return time.process_time()
    at_disk = time.monotonic() if ["D"] in states else 0.0
    return at_disk + sum(int(each) for pair in times for each in pair) / 1e9


def _family() -> list[str]:
    """List the process ids of this process and all its descendants, read from /proc.

    This process is first; processes that end meanwhile may be missing. Raises
    FileNotFoundError without /proc.
    """
    parents = {}
    for entry in _entries("/proc"):
        pid = entry.rpartition("/")[2]
        if pid.isdigit():
            words = _text(f"{entry}/stat").rpartition(")")[2].split()
            parents[pid] = words[1] if words else ""
    family = [str(os.getpid())]
    for pid in family:
        family += [child for child, parent in parents.items() if parent == pid]
    return family


def _entries(folder: str) -> list[str]:
    """List complete paths in a folder; empty if its process has ended (not /proc)."""
    try:
        return [f"{folder}/{name}" for name in os.listdir(folder)]
    except FileNotFoundError:
        if folder == "/proc":
            raise
        return []


def _text(file: str) -> str:
    """Read a small text file; "" if it is missing or its process has ended."""
    try:
        with open(file, encoding="ascii", errors="replace") as opened:
            return opened.read()
    except (FileNotFoundError, ProcessLookupError):
        return ""


def _not_lost(unraisable: object) -> None:
    """End the process at a KeyboardInterrupt that no code gets, as in a finaliser.

    Other exceptions are reported by Python's own hook."""
    if unraisable.exc_type is KeyboardInterrupt:  # type: ignore[attr-defined]
        leave()
    sys.__unraisablehook__(unraisable)  # type: ignore[arg-type]


def main() -> None:
    """Run the command line of this process; an interrupt ends it without a traceback,
    even while it is stuck.

    Where interrupts are ignored (as after a shell's `&`), they stay ignored. Never
    returns after an interrupt: exit code 130, after a line on standard error. During its
    last part a further signal ends the process at once.
    """
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
    """End the process after its exit functions, without freeing half made objects."""
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


if __name__ == "__main__":
    main()
