"""A twin of one's own on this machine, from Python: servers on free ports, ended for certain."""

from __future__ import annotations

import atexit
import tempfile
from contextlib import ExitStack
from os import PathLike
from pathlib import Path
from typing import Literal

from flexdt.clients.client.client import TwinClient
from flexdt.clients.launch.processes import Servers
from flexdt.twin.signatures import public

LOG = "servers.log"


@public
class LocalTwin:
    """Projector and twin server as processes of this machine, as a context manager.

    Entering starts them on free ports and gives a connected `TwinClient`; leaving ends them, also
    after an exception, and they end with this process however it ends. In a notebook, where a
    `with` block cannot span cells, `start()` gives the client and `stop()` ends the servers.

    Args:
        data: folder for all that the twin writes; None for a temporary one, deleted at the end.
        sample: on the stage at start; None for the twin's own (lego, or the one it had).
        machine: description of the scanner, a shipped name or a file; None for the FleX-ray.
        profile: calibration profile; None for the machine's default.
        physics: how images are made: ideal, mono or poly.
        scatter: what the sample scatters onto the panel, of mono and poly: off or mc.
        speed_up: the twin's seconds for each of yours, or "max".
        truth: file with a hidden misalignment.
        viewer: whether to start the viewer as well; see `viewer_url`.

    Raises:
        ServersError: on entering, they did not start; carries the end of their log.

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
        physics: Literal["ideal", "mono", "poly"] = "ideal",
        scatter: Literal["off", "mc"] = "off",
        speed_up: float | Literal["max"] = "max",
        truth: str | PathLike[str] | None = None,
        viewer: bool = False,
    ) -> None:
        options = {
            "sample": sample, "machine": machine, "profile": profile, "physics": physics,
            "scatter": scatter, "speed-up": speed_up, "truth": truth,
        }  # fmt: skip
        self._options = {name: value for name, value in options.items() if value is not None}
        self._viewer, self._folder = viewer, None if data is None else Path(data)
        self._running: tuple[ExitStack, Servers, TwinClient, Path] | None = None

    def __enter__(self) -> TwinClient:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> TwinClient:
        """Start the servers, unless they run already; they run until `stop` or Python's end.

        Raises:
            ServersError: they did not start; carries the end of their log.
        """
        if self._running is None:
            with ExitStack() as stack:
                own = stack.enter_context(tempfile.TemporaryDirectory(prefix="flexdt-twin-"))
                data = Path(own) / "data" if self._folder is None else self._folder
                options = {**self._options, "data": data}
                log = Path(own) / LOG
                servers = stack.enter_context(Servers(options, log, viewer=self._viewer))
                client = stack.enter_context(TwinClient(*servers.address))
                atexit.register(self.stop)
                self._running = stack.pop_all(), servers, client, data
        return self._running[2]

    def stop(self) -> None:
        """End the client and the servers, and delete a temporary data folder."""
        running, self._running = self._running, None
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

    def _now(self) -> tuple[ExitStack, Servers, TwinClient, Path]:
        if self._running is None:
            raise RuntimeError("this LocalTwin is not running; use `with` or `start()`")
        return self._running
