"""The servers of a demonstration or a test: started on free ports, stopped for certain.

The servers are programs of their own (`python -m flexdt.clients.launch.up`), started under
`flexdt.runtime.child`, so that they end with this process however it ends.

A twin of one's own on this machine, from Python: servers on free ports, ended for certain.
"""

from __future__ import annotations

import atexit
import contextlib
import html
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import IO, Any, Literal

from flexdt.clients.client.client import TwinClient
from flexdt.clients.launch.start_checks import require_startable
from flexdt.library.failure import CommandError
from flexdt.message_words import reason_of
from flexdt.runtime.process_settings import Physics, Scatter
from flexdt.runtime.settings import words
from flexdt.twin import long_work
from flexdt.twin.errors import TwinError
from flexdt.twin.long_work import Progress
from flexdt.twin.rays_a_pixel import Rays
from flexdt.twin.signatures import public

STOP_TIMEOUT_S = 30.0
UP = "flexdt.clients.launch.up"
LOG = "servers.log"


@dataclass(frozen=True)
class ViewerCell:
    """A notebook's cell that shows the viewer.

    Args:
        url: of its page.
        height_px: of the frame; None: a link in place of a frame.
    """

    url: str
    height_px: int | None = None

    def _repr_html_(self) -> str:
        """Make the frame, or the link."""
        url = html.escape(self.url, quote=True)
        if self.height_px is None:
            return f'<a href="{url}" target="_blank">{url}</a>'
        style = f"width:100%;height:{self.height_px:d}px;border:0"
        return f'<iframe src="{url}" title="flexdt" style="{style}"></iframe>'


class ServersError(CommandError):
    """The servers did not start; carries the end of their log."""


class Servers:
    """Projector, twin and, on request, viewer (`flexdt up`) as a context manager.

    Args:
        options: name -> value for `flexdt up`, without dashes; ports default to any free one.
        viewer: start the viewer too.
        log: where the processes' standard error goes.

    Attributes:
        ready: the `ready` line's content, once entered.
    """

    def __init__(
        self, options: Mapping[str, object], log: Path, *, viewer: bool = False
    ) -> None:
        """Store the servers' options; entering the context starts them.

        Ports are free ones unless `options` name them.

        `options`: of `flexdt up`; `log`: file of their log; `viewer`: start the viewer, too.
        """
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
        if isinstance(viewer, dict):
            return str(viewer["url"])
        return None

    @property
    def viewer_port(self) -> int | None:
        """Where the viewer listens; None without one."""
        viewer = self.ready.get("viewer")
        if isinstance(viewer, dict):
            return int(viewer["port"])
        return None

    @property
    def pid(self) -> int:
        """Process id of the supervisor."""
        if self._process is None:
            raise ServersError("the servers are not running")
        return self._process.pid

    def __enter__(self) -> Servers:
        """Start the processes under `flexdt.runtime.child` and wait for their `ready`
        line.

        `ready` then holds their addresses; after an error all are stopped. The processes
        end with this one.

        Raises:
            ServersError: they did not start; carries the end of their log.
        """
        self._log_path.parent.mkdir(parents=True, exist_ok=True)
        self._log = self._log_path.open("ab")
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "flexdt.runtime.child", UP, *self._words],
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
        """Stop all processes, wait for them and close the log.

        The supervisor alone gets SIGTERM, at which it ends the servers; it alone is
        killed if it has not ended after `STOP_TIMEOUT_S`. A second call returns None. The
        log's file stays; a closed pipe is ignored.

        Returns:
            The supervisor's exit code; None if it was not running.
        """
        process = self._process
        self._process = None
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
        """Read the last lines of the processes' standard error, oldest first.

        Empty if it cannot be read.
        """
        try:
            text = self._log_path.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ()
        return text.splitlines()[-lines:]

    def _wait_ready(self, process: subprocess.Popen[bytes]) -> dict[str, object]:
        """Wait for the supervisor's `ready` line, however long, and return its document.

        Other lines are left out. The error's exit code is that of the servers if from 1
        to 5, else 1. The message has the last three lines of the log.

        Raises:
            ServersError: the process ended first; with the end of its log.
            subprocess.TimeoutExpired: it printed its last line and then did not end within
                `STOP_TIMEOUT_S`.
        """
        assert process.stdout is not None
        for line in (
            process.stdout
        ):  # however long: the supervisor ends a service that does nothing
            with contextlib.suppress(ValueError, TypeError):
                message = json.loads(line)
                if isinstance(message, dict) and message.get("ready") == "up":
                    return message
        code = process.wait(STOP_TIMEOUT_S)
        tail = "; ".join(self.log_tail(3))
        raise ServersError(
            f"the servers did not start (exit code {code}): {tail}",
            code if 0 < code <= 5 else 1,
        )


@public
class LocalTwin:
    """Projector and twin server as processes of this machine, as a context manager.

    Entering starts them on free ports and gives a connected `TwinClient`; leaving ends them,
    also after an exception, and they end with this process however it ends. In a notebook,
    where a `with` block cannot span cells, `start()` gives the client and `stop()` ends the
    servers.

    Args:
        data: folder for all that the twin writes; None for a temporary one, deleted at the end.
        sample: on the stage at start; None for the twin's own (gear, or the one it had).
        machine: description of the scanner, a shipped name or a file; None for the FleX-ray.
        profile: calibration profile; None for the machine's default.
        physics: how images are made: ideal, mono or poly.
        scatter: scattered radiation, with physics mono and poly: off or mc.
        rays: along each side of a pixel that an edge of the sample reaches, 1 to 16 or
            "auto".
        speed_up: the twin's seconds for each of yours, or "max".
        truth: file with a hidden misalignment.
        viewer: whether to start the viewer as well; see `viewer_url` and `viewer`.
        public_url: admit browsers that find the viewer at this URL, such as a hub's; None for
            its own address only.
        progress: show that the servers start, after two seconds; False for silence.

    Raises:
        ServersError: on entering: an argument does not hold, which is found before a process
            starts, or they did not start; carries the end of their log.

    Example:
        >>> with LocalTwin(sample="lego") as twin:  # doctest: +SKIP
        ...     image = twin.projection("counts").image
    """

    def __init__(
        self,
        data: str | PathLike[str] | None = None,
        *,
        sample: str | None = None,
        machine: str | PathLike[str] | None = None,
        profile: str | None = None,
        physics: Physics = "ideal",
        scatter: Scatter = "off",
        rays: Rays = "auto",
        speed_up: float | Literal["max"] = "max",
        truth: str | PathLike[str] | None = None,
        viewer: bool = False,
        public_url: str | None = None,
        progress: Progress = None,
    ) -> None:
        """Take the servers' options; they start on entering. Arguments: see the class.

        Nothing is started yet. Options that are None are not passed on; without `data` a
        folder is made on entering.
        """
        self._progress = progress
        options = {
            "sample": sample,
            "machine": machine,
            "profile": profile,
            "physics": physics,
            "scatter": scatter,
            "rays": rays,
            "speed-up": speed_up,
            "truth": truth,
            "public-url": public_url,
        }
        self._options: dict[str, Any] = {
            name: value for name, value in options.items() if value is not None
        }
        self._viewer = viewer
        if data is None:
            self._folder = None
        else:
            self._folder = Path(data)
        self._running: tuple[ExitStack, Servers, TwinClient, Path] | None = None

    def __enter__(self) -> TwinClient:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> TwinClient:
        """Start the servers, unless they run already; they run until `stop` or Python's end.

        Returns the connected client. A temporary folder holds the log, and the data if no
        folder was given. A second call returns the same client and starts nothing.
        Arguments are checked first; Python's exit calls `stop`.

        Raises:
            ServersError: they did not start; carries the end of their log.
        """
        if self._running is None:
            self._check()
            with ExitStack() as stack:
                own = stack.enter_context(
                    tempfile.TemporaryDirectory(prefix="flexdt-twin-")
                )
                if self._folder is None:
                    data = Path(own) / "data"
                else:
                    data = self._folder
                options = {**self._options, "data": data}
                log = Path(own) / LOG
                with long_work.during("starting the servers", self._progress):
                    servers = stack.enter_context(
                        Servers(options, log, viewer=self._viewer)
                    )
                client = stack.enter_context(TwinClient(*servers.address))
                atexit.register(self.stop)
                self._running = stack.pop_all(), servers, client, data
        return self._running[2]

    def _check(self) -> None:
        """Check that machine, profile and sample exist and that the data folder can be
        written, before any process starts.

        Raises:
            ServersError: one of them does not hold.
        """
        given = self._options
        try:
            require_startable(
                given.get("machine"),
                given.get("profile"),
                given.get("sample"),
                self._folder,
            )
        except TwinError as error:
            raise ServersError(str(error)) from None
        except OSError as error:
            raise ServersError(f"data: {error.filename}: {reason_of(error)}") from None

    def stop(self) -> None:
        """End client and servers, and delete a temporary data folder.

        `start` may be called again.
        """
        running = self._running
        self._running = None
        if running is not None:
            atexit.unregister(self.stop)
            running[0].close()

    @property
    def data(self) -> Path:
        """The data folder; data sets appear in it."""
        return self._now()[3]

    @property
    def address(self) -> tuple[str, int]:
        """Host and port of the twin server, for other clients."""
        return self._now()[1].address

    @property
    def viewer_url(self) -> str | None:
        """Where a browser finds the viewer; None without one."""
        return self._now()[1].viewer_url

    def viewer(self, height_px: int = 800) -> ViewerCell:
        """Show the viewer in a notebook's cell: the page itself in a JupyterHub with
        jupyter-server-proxy, elsewhere a link.

        Raises:
            RuntimeError: this LocalTwin was made without `viewer=True`, or is not running.

        Example:
            >>> lab = LocalTwin(viewer=True)  # doctest: +SKIP
            >>> twin = lab.start()  # doctest: +SKIP
            >>> lab.viewer()  # doctest: +SKIP
        """
        url = self._now()[1].viewer_url
        port = self._now()[1].viewer_port
        if url is None or port is None:
            raise RuntimeError("this LocalTwin has no viewer; make it with viewer=True")
        hub = os.environ.get("JUPYTERHUB_SERVICE_PREFIX")
        if hub is not None:
            return ViewerCell(f"{hub.rstrip('/')}/proxy/{port}/", height_px)
        return ViewerCell(url, None)

    def _now(self) -> tuple[ExitStack, Servers, TwinClient, Path]:
        if self._running is None:
            raise RuntimeError("this LocalTwin is not running; use `with` or `start()`")
        return self._running
