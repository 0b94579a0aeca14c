"""The twin as the gateway's commands see it: requests, state, the last image, an armed move.

Each gateway has one `ConnectedTwin`, used from one event loop.

What a session over the socket interface saves is one folder per output path, as on the scanner.
Images appear under the bare names of the commands' paths, never partly written; beside them are the
two settings texts, `flexdt.json` with the pose of every image, and `script.txt` with the commands
so far. Frames of a sequence come from the data set that the twin made of it. Nothing is written
outside the data directory or over an existing file.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from flexdt.clients.client import twin_methods as m
from flexdt.clients.client.flows import Flow, adrive
from flexdt.clients.client.kept_connection import KeptConnection
from flexdt.clients.client.transport import ConnectionLost
from flexdt.clients.client.twin_methods import FINAL_STATES
from flexdt.clients.gateway.vocabulary import Refusal
from flexdt.protocol.rpc_errors import RpcError
from flexdt.protocol.state_model import AxisState, JobStatus, State
from flexdt.runtime.files.dataset_folder import free_name, put_texts, read_document, tiff_bytes
from flexdt.runtime.files.directory import Directory, open_data
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.dataset.file_names import SCRIPT
from flexdt.twin.dataset.flexdt_json import FrameBlock, FrameEntry, FrameKind, ScanRecord
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Machine, Profile, builtin_machine, profile_of
from flexdt.twin.scanner.state import NamedCorrection
from flexdt.twin.script.executed_log import MotorReply, motor_cluster
from flexdt.twin.script.grammar import bare_name, kind_of

UNNAMED: Final = "gateway"
"""Name of the folder until an output path is set."""


@dataclass(frozen=True)
class Image:
    """The image in the camera, uint16 (rows, cols), and the twin's state when it was taken."""

    counts: npt.NDArray[np.uint16]
    state: State


class Recording:
    """The folder of one output path; it is created with its first file.

    Args:
        root: the data directory.
        path: its last part names the folder; a number is added if that name is taken.
        machine, profile: the twin's; without them (an unknown machine) no texts are written.
        started: date of the session.
        version: of the software.
    """

    def __init__(
        self,
        root: Path,
        path: str,
        machine: Machine | None,
        profile: Profile | None,
        started: datetime,
        version: str = "",
    ) -> None:
        self.root, self.name = root, bare_name(path.rstrip("\\/ ")) or UNNAMED
        self.transcript: list[str] = []
        self._machine, self._profile = machine, profile
        self._started, self._version = started, version
        self._blocks: list[FrameBlock] = []
        self._states: list[State] = []
        self._settings: State | None = None
        self._began: float | None = None
        self._folder: Directory | None = None
        self._closed = False
        self._turn = threading.Lock()
        """Images are saved in threads, while another output path may be set."""

    @property
    def folder(self) -> Path | None:
        """Where the files are; None before the first one."""
        return None if self._folder is None else self._folder.path

    def suggest(self, path: str) -> None:
        """Without an output path, name the folder after the folder in a file's path."""
        parts = [part for part in re.split(r"[\\/]", path)[:-1] if bare_name(part)]
        if self._folder is None and self.name == UNNAMED and parts:
            self.name = bare_name(parts[-1])

    def save(self, file: str, image: Image) -> Path:
        """Write an image under a plain name.

        Raises:
            DatasetError: the name is not plain or is taken, the file cannot be written, or another
                output path has been set meanwhile.
        """
        with self._turn:
            files = self._files([file])
            files.put(file, tiff_bytes(image.counts))
            state = image.state
            positions = {n: np.array([v]) for n, v in _positions(state).items()}
            time = np.array([self._time(state.time)])
            block = FrameBlock(
                kind_of_file(file), (file,), time, camera_of(state), positions, state.tube.ready
            )
            self._add([block], state)
            return files.path / file

    def adopt(self, folder: Path, state: State) -> int:
        """Add the projections of a data set that the twin made.

        Args:
            folder: of the data set.
            state: of the twin, after the data set was made.

        Returns:
            The number of images.

        Raises:
            DatasetError, OSError: the data set cannot be read, a name is taken, or no room.
        """
        source = Directory(folder.parent).folder(folder.name)
        document = read_document(source)
        with self._turn:
            files = self._files([f.file for f in document.frames])
            there = source.names()
            for frame in document.frames:
                _same_file(frame.file, source, files, linked=frame.file in there)
            begun = self._time(state.time) - document.duration_s
            self._add(_blocks(document.frames, begun), state)
        return len(document.frames)

    def write_settings(self, state: State) -> None:
        """Use these motor positions in the settings texts (`write settings file`)."""
        with self._turn:
            self._settings = state
            if self._folder is not None and self._blocks:
                self._write_texts()

    def close(self) -> None:
        """Close the folder; nothing is saved into it any more."""
        with self._turn:
            self._closed = True
            if self._folder is not None:
                self._folder.close()
                self._folder = None

    def _files(self, names: Sequence[str]) -> Directory:
        if self._closed:
            raise DatasetError(
                "another output path has been set meanwhile; the image is still in the camera",
                {"asked": list(names)},
            )
        if self._folder is None:
            root = open_data(self.root)
            self.name = free_name(root, self.name)
            folder = root.folder(self.name, sync=False)
            folder.make()
            self._folder = folder.held()
        taken = sorted(set(names) & self._folder.names())
        if taken:
            raise DatasetError(
                f"{self._folder.path} has {taken[0]} already; allowed: another name, or another "
                "output path",
                {"asked": taken},
            )
        return self._folder

    def _time(self, now: float) -> float:
        if self._began is None:
            self._began = now
        return max(0.0, now - self._began)

    def _add(self, blocks: Sequence[FrameBlock], state: State) -> None:
        self._blocks += blocks
        self._states.append(state)
        self._write_texts()

    def _write_texts(self) -> None:
        assert self._folder is not None
        text = "\r\n".join([*self.transcript, ""])
        self._folder.put(SCRIPT, text.encode("utf-8", "surrogateescape"))
        record = self._record()
        if record is not None:
            put_texts(self._folder, record)

    def _record(self) -> ScanRecord | None:
        if self._machine is None or self._profile is None:
            return None
        last = self._states[-1]
        at = last if self._settings is None else self._settings
        modes = self._machine.detector.camera.modes
        blocks = [replace(b, camera=replace(b.camera, modes=modes)) for b in self._blocks]
        scans = [b for b in blocks if b.kind == "projection"]
        axes = {n: a for n, a in at.axes.items() if not a.virtual}
        turning = [b for b in scans if any(np.ptp(v) > 0 for v in b.positions.values())]
        return ScanRecord(
            name=self.name,
            machine=self._machine,
            profile=self._profile,
            camera=scans[0].camera if scans else replace(camera_of(at), modes=modes),
            kV=at.tube.kV,
            power_W=at.tube.power_W,
            positions={n: a.position for n, a in axes.items()},
            speeds={n: a.speed or 0.0 for n, a in axes.items()},
            accelerations={n: a.acceleration or 0.0 for n, a in axes.items()},
            blocks=tuple(blocks),
            smooth=bool(turning),
            started=self._started,
            duration_s=self._time(last.time),
            complete=bool(scans),
            reason="" if scans else "no projection yet",
            correction=_correction(last),
            operator="gateway",
            version=self._version,
        )


def camera_of(state: State) -> CameraSettings:
    """The camera's settings in a state."""
    c = state.camera
    left, top, right, bottom = c.roi
    roi = Roi(left, top, right, bottom)
    return CameraSettings(c.mode, roi, c.exposure_ms, c.averages, c.frames)


def kind_of_file(file: str) -> FrameKind:
    """The kind of an image, from its file name; a preview counts as a projection."""
    kind = kind_of(file)
    return "projection" if kind == "preview" else kind


def _same_file(name: str, source: Directory, files: Directory, *, linked: bool) -> None:
    """Link an image, which never changes, into the folder; copy it if the disk has no links."""
    with suppress(OSError, NotImplementedError):
        if linked:
            source.link(name, name, files)
            return
    files.put(name, source.read(name))


def _positions(state: State) -> Mapping[str, float]:
    return {n: a.position for n, a in state.axes.items() if not a.virtual}


def _correction(state: State) -> NamedCorrection | None:
    c = state.correction
    return None if c is None else NamedCorrection.from_edge(c.name, c.date, c.parameters, c.comment)


def _blocks(frames: Sequence[FrameEntry], start: float) -> list[FrameBlock]:
    """Frames of a document, grouped into runs of equal settings; times count from `start` [s]."""

    def settings(f: FrameEntry) -> tuple[object, ...]:
        return (f.kind, f.mode, f.roi, f.exposure_ms, f.averages, f.xrays_on)

    def block(run: Sequence[FrameEntry]) -> FrameBlock:
        first = run[0]
        camera = CameraSettings(first.mode, Roi(*first.roi), first.exposure_ms, first.averages)
        positions = {n: np.array([f.positions[n] for f in run]) for n in first.positions}
        times = np.array([start + f.time_s for f in run])
        files = tuple(f.file for f in run)
        return FrameBlock(first.kind, files, times, camera, positions, first.xrays_on)

    return [block(tuple(run)) for _, run in groupby(frames, settings)]


_R = TypeVar("_R")

MAX_SCRIPT: Final = 8 << 20
LIVELY_S: Final = 0.1
"""Real seconds between two requests for the state while something moves or a scan runs."""
POLL_S: Final = 0.05
"""Real seconds between two requests for the state while a command runs."""


@dataclass
class CommandProgress:
    """How far a command has come, as the text of FDB."""

    text: str = ""


@dataclass
class Armed:
    """A move that waits for the image sequence to be taken during it.

    Attributes:
        axis, target, trigger: of the move [mm or deg].
        taken: set when a sequence has taken the move over.
        ended: the text of the move's ACK, from then on.
    """

    axis: str
    target: float
    trigger: float
    taken: asyncio.Event = field(default_factory=asyncio.Event)
    ended: asyncio.Future[str] | None = None


class ConnectedTwin:
    """What the commands act on.

    Args:
        link: the connection to the twin.
        root: the data directory for what the gateway saves.
        machine, profile: the twin's, where they are files.
    """

    def __init__(
        self,
        link: KeptConnection,
        root: Path,
        machine: Machine | None = None,
        profile: Profile | None = None,
    ) -> None:
        self.link, self.root = link, root
        self._machine, self._profile = machine, profile
        self.image: Image | None = None
        self.armed: Armed | None = None
        self.job: str | None = None
        self.path = ""
        self.recording: Recording | None = None
        self.axes: tuple[str, ...] = ()
        self.sequence: bytes | None = None
        """Script of the sequence that a client takes now: its command has been told already."""
        self.lively = False
        """Whether something moves or a scan runs, so that the state is asked for."""
        self.jobs: dict[str, JobStatus] = {}
        """Jobs that have not ended, or whose end has not been told."""
        self._news = asyncio.Event()

    def heard(self, topic: str, params: Mapping[str, object]) -> None:
        """The twin has sent an event: something has changed."""
        if topic == "job":
            status = JobStatus.model_validate(params["data"])
            if status.state not in FINAL_STATES or status.job in self.jobs:
                self.jobs[status.job] = status
        self._news.set()

    def told_jobs(self, state: State) -> list[JobStatus]:
        """The jobs of which something may have to be told, each as it is known last."""
        now = state.job
        if now is not None and self.jobs.get(now.job, now).state not in FINAL_STATES:
            self.jobs[now.job] = now
        found = list(self.jobs.values())
        self.jobs = {s.job: s for s in found if s.state not in FINAL_STATES}
        return found

    async def news(self) -> None:
        """Wait until something may have changed."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LIVELY_S if self.lively else None):
                await self._news.wait()
        self._news.clear()
        await asyncio.sleep(POLL_S)

    def script_of(self, job: JobStatus) -> bytes | None:
        """The script of a job; None where it cannot be read, or is a client's own sequence."""
        path = Path(job.dataset or "") / SCRIPT
        if not path.is_file() or path.stat().st_size > MAX_SCRIPT:
            return None
        script = path.read_bytes()
        return None if script == self.sequence else script

    async def ask(self, method: str, params: Mapping[str, object] | None = None) -> object:
        """Send a request to the twin and return its result.

        Raises:
            Refusal: the twin answered with an error, or cannot be reached.
        """
        try:
            return await self.link.request(method, dict(params or {}))
        except RpcError as error:
            raise Refusal(_one_line(error)) from error
        except ConnectionLost as error:
            raise Refusal(f"the twin cannot be reached: {error}") from None

    async def run(self, flow: Flow[_R]) -> _R:
        """The result of one of the client's methods (`twin_methods`); raises as `ask`."""
        return await adrive(flow, lambda asked: self.ask(asked.method, asked.params))

    async def state(self) -> State:
        """The twin's present state."""
        state = await self.run(m.state())
        self.axes = tuple(state.axes)
        return state

    async def until(self, seconds: float, progress: CommandProgress, what: str) -> None:
        """Wait for `seconds` of the twin's clock; at full speed they need no waiting."""
        state = await self.state()
        end = state.time + seconds
        while state.time < end and state.clock.speed_up != "max":
            progress.text = f"{what}: {end - state.time:.1f} s left"
            left = (end - state.time) / float(state.clock.speed_up)
            await asyncio.sleep(min(max(left, 0.001), 0.2))
            state = await self.state()

    def record(self) -> Recording:
        """The recording that images go to now."""
        if self.recording is None:
            machine, profile = self._scanner()
            self.recording = Recording(
                self.root, self.path, machine, profile, datetime.now(UTC), version("flexdt")
            )
        return self.recording

    def begin_recording(self, path: str) -> None:
        """Save later images in another folder, with the commands since the last image."""
        old = self.record()
        fresh = old.folder is None
        lines = list(old.transcript) if fresh else old.transcript[-1:]
        if not fresh:
            del old.transcript[-1:]
        old.close()
        self.path, self.recording = path, None
        self.record().transcript += lines

    def motor_text(self, axis: str, at: AxisState) -> str:
        """The reply to a completed move: a motor's cluster, a character a byte, as the scanner's.

        A virtual axis, which has no motor, and a motor of a machine that the gateway does not know
        reply with their position.
        """
        machine, _ = self._scanner()
        known = None if machine is None else machine.axes.get(axis)
        if known is None or at.speed is None or at.acceleration is None:
            return f"{at.position:.10f}"
        motor = MotorReply(
            at.position, at.target, at.speed, at.acceleration, *at.limits,
            known.max_speed, known.max_acceleration,
        )  # fmt: skip
        return motor_cluster(motor).decode("latin-1")

    def _scanner(self) -> tuple[Machine | None, Profile | None]:
        hello, machine = self.link.hello, self._machine
        try:
            if machine is None and hello is not None:
                machine = builtin_machine(hello.machine)
            if machine is None:
                return None, None
            return machine, self._profile or profile_of(machine, hello.profile if hello else None)
        except TwinError:  # neither of them need ship
            return machine, None


def _one_line(error: RpcError) -> str:
    """An error of the twin as one line, with the problems of a script and their line numbers."""
    data = error.data
    if isinstance(data, Mapping):
        data = data.get("problems")
    lines = [
        f"line {p.get('line')}: {p['message']}"
        for p in (data if isinstance(data, list) else [])
        if isinstance(p, Mapping) and "message" in p and p.get("severity", "error") == "error"
    ]
    return "; ".join([error.message, *lines[:5]])
