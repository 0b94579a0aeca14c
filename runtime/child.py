"""`python -m flexdt.runtime.child MODULE ARGS...`: a module that ends with its parent.

The parent keeps the child's standard input open as a pipe. When the parent goes away, for
whatever reason, even killed outright, the pipe closes and the child receives SIGTERM, its
normal way to stop; if it has not stopped after a grace period it is killed. This works
wherever pipes do and needs no support in the module.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading
import time

STOP_GRACE_S = 15.0
"""Time that the module may take to stop after its parent has gone [s]."""


def main() -> None:
    """Run the module named on the command line as `__main__`, with the arguments after
    it, and watch standard input in a thread.

    When standard input closes, as at the end of the parent, the process ends. Without a
    module it exits with a usage line.
    """
    if len(sys.argv) < 2:
        sys.exit("usage: python -m flexdt.runtime.child MODULE [ARGUMENT...]")
    threading.Thread(target=_watch, name="parent-watch", daemon=True).start()
    module = sys.argv[1]
    sys.argv = [module, *sys.argv[2:]]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def _watch() -> None:
    """Read standard input until it closes, then end: SIGTERM, later at once."""
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(STOP_GRACE_S)
    os._exit(1)


if __name__ == "__main__":
    main()
