"""The servers of a demonstration or a test: started on free ports, stopped for certain.

The servers are programs of their own (`python -m flexdt.clients.launch.up`), started under
`flexdt.runtime.child`, so that they end with this process however it ends.
"""

from __future__ import annotations

import contextlib
import json
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

from flexdt.clients.failure import CommandError
from flexdt.process_settings import words

STOP_TIMEOUT_S = 30.0


class ServersError(CommandError):
    """The servers did not start; carries the end of their log."""


class Servers:
    """Projector, twin and, if asked for, viewer (`flexdt up`) as a context manager.

    Args:
        options: name -> value for `flexdt up`, without dashes; ports default to any free one.
        viewer: start the viewer too.
        log: where the processes' standard error goes.

    Attributes:
        ready: the `ready` line's content, once entered.
    """

    def __init__(self, options: Mapping[str, object], log: Path, *, viewer: bool = False) -> None:
        ports = {"port": 0, "projector-port": 0, "viewer-port": 0}
        self._words = words({**ports, **options, "no-viewer": not viewer})
        self._log_path = log
        self._process: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None
        self.ready: dict[str, object] = {}

    @property
    def address(self) -> tuple[str, int]:
        """Where the twin listens."""
        return str(self.ready["host"]), int(str(self.ready["port"]))

    @property
    def viewer_url(self) -> str | None:
        """Where a browser finds the viewer; None without one."""
        viewer = self.ready.get("viewer")
        return str(viewer["url"]) if isinstance(viewer, dict) else None

    @property
    def pid(self) -> int:
        """Process id of the supervisor."""
        if self._process is None:
            raise ServersError("the servers are not running")
        return self._process.pid

    def __enter__(self) -> Servers:
        self._log_path.parent.mkdir(parents=True, exist_ok=True)
        self._log = self._log_path.open("ab")
        self._process = subprocess.Popen(
            [
                sys.executable,
                "-P",
                "-m",
                "flexdt.runtime.child",
                "flexdt.clients.launch.up",
                *self._words,
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            start_new_session=True,
        )
        try:
            self.ready = self._wait_ready(self._process)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> int | None:
        """Stop everything and wait for it; returns the supervisor's exit code."""
        process, self._process = self._process, None
        if process is None:
            return None
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGTERM)
        try:
            process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        for pipe in (process.stdin, process.stdout, self._log):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        return process.returncode

    def log_tail(self, lines: int = 5) -> Sequence[str]:
        """The last lines that the processes wrote to standard error."""
        try:
            text = self._log_path.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ()
        return text.splitlines()[-lines:]

    def _wait_ready(self, process: subprocess.Popen[bytes]) -> dict[str, object]:
        assert process.stdout is not None
        lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        threading.Thread(target=_pump, args=(process.stdout, lines), daemon=True).start()
        while True:
            # However long: the supervisor itself ends a service that does nothing.
            if not (line := lines.get()):
                process.wait(STOP_TIMEOUT_S)
                tail = "; ".join(self.log_tail(3))
                code = process.returncode
                raise ServersError(
                    f"the servers did not start (exit code {code}): {tail}",
                    code if 0 < code <= 5 else 1,
                )
            with contextlib.suppress(ValueError, TypeError):
                message = json.loads(line)
                if isinstance(message, dict) and message.get("ready") == "up":
                    return message


def _pump(pipe: IO[bytes], lines: queue.SimpleQueue[bytes]) -> None:
    """Keep the pipe empty; an empty line stands for its end."""
    with contextlib.suppress(ValueError, OSError):
        for line in pipe:
            lines.put(line)
    lines.put(b"")
