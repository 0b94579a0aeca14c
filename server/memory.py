"""What a twin server must know again after it was killed: DATA/state.json.

Positions, settings, tube, camera, sample, an E-stop in force and the list of jobs; corrections have
files of their own. The file is written as things change, whole or not at all, at most a few times
a second, and last of all when the server stops. On restart X-rays are off, motors stand where they
were last seen, and scans that were cut off say so and can be resumed. It refuses to keep a server
from starting: what cannot be read is set aside and said.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from flexdt.protocol.errors import RpcError
from flexdt.protocol.scene import Scene
from flexdt.protocol.state import JobPhase
from flexdt.server.files import put_file
from flexdt.server.log import log
from flexdt.server.scene import apply_settings, require_fit, sample_of, save_scene
from flexdt.twin.dataset.errors import DatasetError
from flexdt.twin.errors import TwinError
from flexdt.twin.machine import Machine
from flexdt.twin.scanner import ScannerTwin
from flexdt.twin.state import Sample

FILE = "state.json"
UNREADABLE = "state.unreadable.json"
INTERVAL_S = 0.25
"""Real seconds between two writes, at least."""
FAR_S = 60.0
"""After a write that failed (a full disk), the next one waits so long [s]."""

Number = Annotated[float, Field(allow_inf_nan=False)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class JobMemory(_Part):
    """One job as it was."""

    id: str
    name: str
    folder: str
    phase: JobPhase
    frames_total: int
    frames_done: int
    duration_s: Number
    elapsed_s: Number = 0.0
    speed_up: Number | Literal["max"] | None = None
    warnings: list[str] = Field(default_factory=list)
    error: dict[str, object] | None = None


class Memory(_Part):
    """The document."""

    schema_version: Literal[1] = Field(alias="schema")
    saved: str
    ended: bool = False
    scene: Scene
    estop: bool = False
    jobs: list[JobMemory] = Field(default_factory=list)
    jobs_made: int = 0


def remember(
    scanner: ScannerTwin, now: float, jobs: list[JobMemory], made: int, *, ended: bool = False
) -> Memory:
    """The scanner at twin time `now`: where its motors are, not where they are bound."""
    scene = save_scene(scanner, now).model_copy(update={"positions": scanner.positions(now)})
    return Memory(
        schema=1,
        saved=datetime.now(UTC).isoformat(timespec="milliseconds"),
        ended=ended,
        scene=scene,
        estop=scanner.safety.state == "estopped",
        jobs=jobs,
        jobs_made=made,
    )


def read_memory(root: Path) -> Memory | None:
    """What was remembered in data directory `root`; None where there is nothing to read."""
    file = root / FILE
    try:
        return Memory.model_validate_json(file.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError, ValueError) as error:
        log("the last state cannot be read; starting anew", logging.ERROR,
            file=str(file), reason=str(error)[:500])  # fmt: skip
        _set_aside(root)
        return None


def restore(memory: Memory, scanner: ScannerTwin, now: float) -> Sample | None:
    """Put the scanner where `memory` has it, X-rays off; returns the sample, to be put on.

    None, and nothing done, where the memory is of another machine or no longer allowed.
    """
    known, spec = memory.scene, scanner.machine.tube
    if not spec.min_kV <= known.tube.kV <= spec.max_kV:  # the physics may be another one
        log("the tube starts anew: its last voltage is outside what it has now", logging.WARNING,
            kV=known.tube.kV, allowed=[spec.min_kV, spec.max_kV])  # fmt: skip
        tube = known.tube.model_copy(update={"kV": scanner.tube.kV})
        known = known.model_copy(update={"tube": tube})
    try:
        require_fit(known, scanner)
        scanner.place(_within(scanner.machine, known.positions), now)
        apply_settings(known, scanner)
    except (TwinError, RpcError) as error:
        log("the last state does not fit this machine; starting anew", logging.WARNING,
            reason=str(error))  # fmt: skip
        return None
    if memory.estop:
        scanner.estop(now)
    return sample_of(known)


class Keeper:
    """Writes the memory while the server runs.

    Args:
        root: the data directory.
        make: makes the document.
    """

    def __init__(self, root: Path, make: Callable[[bool], Memory]) -> None:
        self._root, self._make = root, make
        self._changed = asyncio.Event()
        self._writing = asyncio.Lock()
        self._file = threading.Lock()
        self._ended = False

    def changed(self) -> None:
        """Something worth remembering has changed."""
        self._changed.set()

    async def run(self, moving: Callable[[], bool]) -> None:
        """Write until cancelled; `moving` tells whether positions change by themselves."""
        while True:
            if not moving():
                await self._changed.wait()
            self._changed.clear()
            pause = INTERVAL_S
            try:
                await self.flush()
            except (OSError, DatasetError) as error:
                log("the state was not written", logging.ERROR, reason=str(error))
                pause = FAR_S
            await asyncio.sleep(pause)

    async def flush(self) -> None:
        """Write now: what is answered after this is known after a kill.

        Raises:
            DatasetWriteError: the system refuses.
        """
        async with self._writing:
            await asyncio.to_thread(self._put, self._make(False))

    def end(self) -> None:
        """Write for the last time; a write that is still on its way does not undo it."""
        try:
            self._put(self._make(True))
        except (OSError, DatasetError) as error:
            log("the state was not written", logging.ERROR, reason=str(error))

    def _put(self, memory: Memory) -> None:
        # Ending cancels who waits for a worker thread, but not the thread.
        with self._file:
            if self._ended and not memory.ended:
                return
            self._ended = memory.ended
            put_file(self._root, FILE, memory.model_dump_json(by_alias=True).encode("utf-8"))


def _within(machine: Machine, positions: Mapping[str, float]) -> dict[str, float]:
    """Positions without the rounding errors of a motion seen in mid-flight."""
    axes = machine.axes
    return {name: min(max(x, axes[name].lower), axes[name].upper) for name, x in positions.items()}


def _set_aside(root: Path) -> None:
    try:
        (root / FILE).replace(root / UNREADABLE)
    except OSError as error:
        log("it could not be set aside", logging.ERROR, reason=str(error))
