"""The process of `live_volume`: one at a time, with requests of pages for their
volumes."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from flexdt.clients.viewer.watched_tasks import watched
from flexdt.runtime.workers import ENVIRONMENT

PROGRAM: Final = "flexdt.clients.viewer.volumes.live_volume"
LINE_BYTES: Final = 4 << 20
SINGLE: Final = {
    name: ones for name, ones in ENVIRONMENT.items() if not name.startswith("NUMBA")
}
"""Environment of the process, which sets the number of threads of its kernels itself."""
Answer = tuple[dict[str, Any], bytes]
Wish = tuple[str, ...]
"""First line of the process: folder, side and perhaps `past`."""


def wish(folder: Path, side: int, past: bool) -> Wish:
    """Request a volume of so many voxels; past scans' are complete."""
    return str(folder.absolute()), str(side), *(["past"] if past else [])


class LiveReconstruction:
    """The one process of a viewer, for the data set requested last.

    Args:
        tell: called with its lines.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        """Prepare without a process or a requested volume; `tell` gets each line (str) of
        later ones.
        """
        self._tell = tell
        self.newest = ""
        self._asked: Wish = ()
        self._task: asyncio.Task[None] | None = None
        self._ending: asyncio.Task[None] | None = None
        self._spare: asyncio.Task[asyncio.subprocess.Process] | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._wanted: deque[asyncio.Future[Answer]] = deque()

    def warm(self) -> None:
        """Start a spare process, which loads its libraries ahead; nothing if one is there."""
        if self._spare is None and self._task is None:
            self._spare = asyncio.create_task(_started())

    def grow(self, folder: Path, side: int, past: bool = False) -> None:
        """Start the volume of a data set, `side` voxels a side, and end any other.

        The same request only gets its newest line again. `past`: the scan is complete.
        """
        asked = wish(folder, side, past)
        if asked == self._asked:
            if self.newest:
                self._tell(self.newest)
            return
        self.stop()
        self._asked = asked
        self._task = watched(self._follow(*asked), "a live reconstruction")

    def stop(self) -> None:
        """End the running reconstruction, not waiting for it, and forget the request.

        Open requests give None.
        """
        if self._task is not None:
            self._task.cancel()
            self._ending = self._task
        self._task = None
        self._asked = ()
        self.newest = ""
        self._hang_up()

    async def close(self) -> None:
        """End the running reconstruction and the spare process, and wait until both have
        ended.

        The spare process is killed; nothing is raised if neither exists.
        """
        self.stop()
        if self._ending is not None:
            await asyncio.wait([self._ending])
        if self._spare is not None:
            process = await self._spare
            process.kill()
            await process.wait()

    def _hang_up(self) -> None:
        self._writer = None
        while self._wanted:
            self._wanted.popleft().cancel()

    async def ask(self, asked: Wish, *words: str) -> Answer | None:
        """Send a request to the process and wait for its answer.

        None also if another volume is requested before the answer. Answers come in the order of
        the requests; the words are joined by tabs.

        `asked`: the volume that it must have; `words`: of the request.
        Returns the answer, and its bytes; None without a process, or if it has another volume.
        """
        if self._writer is None or asked != self._asked:
            return None
        wanted: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._wanted.append(wanted)
        self._writer.write("\t".join(words).encode() + b"\n")
        with suppress(asyncio.CancelledError):  # another volume was requested meanwhile
            return await wanted
        return None

    async def _follow(self, *asked: str) -> None:
        """Run a process for a volume: pass its lines on, and its answers to their
        requests.

        The newest line is kept in `newest`. However this ends, the process is killed. The
        spare process is used if there is one, else one is started. An answer to a
        canceled request is dropped; lines other than answers go to `tell`. After a
        normal end open requests are canceled.

        Args:
            asked: the words of its first line.
        """
        spare = self._spare
        self._spare = None
        process = await (spare or _started())
        assert process.stdout is not None
        assert process.stdin is not None
        self._writer = process.stdin
        self._writer.write("\t".join(asked).encode() + b"\n")
        try:
            async for line in process.stdout:
                kind, _, content = line.decode().partition("\t")
                if kind == "answer":
                    size, _, told = content.partition("\t")
                    answer = json.loads(told), await process.stdout.readexactly(int(size))
                    if not (wanted := self._wanted.popleft()).done():
                        wanted.set_result(answer)
                else:
                    self.newest = line.decode()
                    self._tell(self.newest)
            self._hang_up()
            await process.wait()  # killing an ended process would lose its exit code
        finally:
            if process.returncode is None:
                process.kill()
            await process.wait()


async def _started() -> asyncio.subprocess.Process:
    """Start a Python process that reconstructs, with one thread a library; input and
    output are pipes, its errors are discarded.

    Its threads are limited by `SINGLE`, except those of numba; the longest line is
    `LINE_BYTES`.
    """
    return await asyncio.create_subprocess_exec(
        sys.executable,
        "-P",
        "-m",
        PROGRAM,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
        env={**os.environ, **SINGLE},
        limit=LINE_BYTES,
    )
