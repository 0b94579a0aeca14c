"""Images of a session over the socket interface: one folder per output path, as on the
scanner.

Images appear under the bare names of the commands' paths, never partly written. With them
are the two settings texts, `flexdt.json` with the pose of every image, and `script.txt`
with the commands so far. Frames of a sequence come from the data set that the twin made
of it. Nothing is written outside the data directory or over an existing file.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.protocol.state_model import State
from flexdt.runtime.files.dataset_folder import (
    free_name,
    put_texts,
    read_document,
    tiff_bytes,
)
from flexdt.runtime.files.directory import Directory, open_data
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.dataset.file_names import SCRIPT
from flexdt.twin.dataset.flexdt_json import FrameBlock, FrameEntry, FrameKind, ScanRecord
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.scanner.state import NamedCorrection
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
        """Store the folder's name and texts' facts; nothing is written before the first
        image.

        Without a usable last part of the path the name is "gateway".

        Args:
            root: folder of recordings.
            path: output path of the client; its last part names the folder.
            machine: for the texts; none are written without.
            profile: for the texts.
            started: when.
            version: of the twin.
        """
        self.root = root
        self.name = bare_name(path.rstrip("\\/ ")) or UNNAMED
        self.transcript: list[str] = []
        self._machine = machine
        self._profile = profile
        self._started = started
        self._version = version
        self._blocks: list[FrameBlock] = []
        self._states: list[State] = []
        self._settings: State | None = None
        self._began: float | None = None
        self._folder: Directory | None = None
        self._closed = False
        self._turn = threading.Lock()
        """Lock: images are saved in threads, while another output path may be set."""

    @property
    def folder(self) -> Path | None:
        """Where the files are; None before the first one."""
        if self._folder is None:
            return None
        return self._folder.path

    def suggest(self, path: str) -> None:
        """Name the folder after the last folder in a file's path, while no output path was set
        and no image saved. A path without a usable folder changes nothing; slashes and
        backslashes separate."""
        parts = [part for part in re.split(r"[\\/]", path)[:-1] if bare_name(part)]
        if self._folder is None and self.name == UNNAMED and parts:
            self.name = bare_name(parts[-1])

    def save(self, file: str, image: Image) -> Path:
        """Write an image as TIFF under a plain file name, add it to the record and
        rewrite the texts.

        Its kind comes from the name; its time counts from the first image [s].

        Returns:
            The file's path.

        Raises:
            DatasetError: the name is not plain or is taken, the file cannot be written,
                or another output path has been set meanwhile.
        """
        with self._turn:
            files = self._files([file])
            files.put(file, tiff_bytes(image.counts))
            state = image.state
            positions = {n: np.array([v]) for n, v in _positions(state).items()}
            time = np.array([self._time(state.time)])
            block = FrameBlock(
                kind_of_file(file),
                (file,),
                time,
                camera_of(state),
                positions,
                state.tube.ready,
            )
            self._add([block], state)
            return files.path / file

    def adopt(self, folder: Path, state: State) -> int:
        """Add the images of the twin's data set, flat and dark ones too; return their
        number.

        Files are linked or copied under their own names. Blocks begin at the time of
        `state`, after the set was made, less its duration. Raises DatasetError, OSError:
        it cannot be read, a name is taken, no room, or the recording is closed.
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
        """Store a state, and rewrite the settings texts if there are images."""
        with self._turn:
            self._settings = state
            if self._folder is not None and self._blocks:
                self._write_texts()

    def close(self) -> None:
        """Close the folder, once a saving has ended.

        A later one raises DatasetError.
        """
        with self._turn:
            self._closed = True
            if self._folder is not None:
                self._folder.close()
                self._folder = None

    def _files(self, names: Sequence[str]) -> Directory:
        """Open the recording's folder, made at the first use, and check that names are
        free.

        If the folder's name is taken in the data directory, a number is added to it.

        Args:
            names: of files to be written.

        Returns:
            The open folder.

        Raises:
            DatasetError: the recording is closed, or files of those names exist; the
                message names the first.
        """
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
                f"{self._folder.path} has {taken[0]} already; "
                "allowed: another name, or another output path",
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
        """Write the transcript into the folder, and the settings texts if machine and
        profile are known.

        Lines end with CR LF; existing texts are replaced. There must be a folder.
        """
        assert self._folder is not None
        text = "\r\n".join([*self.transcript, ""])
        self._folder.put(SCRIPT, text.encode("utf-8", "surrogateescape"))
        record = self._record()
        if record is not None:
            put_texts(self._folder, record)

    def _record(self) -> ScanRecord | None:
        """Build the record of the images so far: blocks, settings, times and correction.

        Without a projection the record is incomplete, with that reason. Positions, speeds
        and tube are those of `write_settings`, else of the last image. `smooth` is
        whether any motor moved within a block of projections; an unknown speed is 0.

        Returns:
            The record; None where machine or profile is unknown.
        """
        if self._machine is None or self._profile is None:
            return None
        last = self._states[-1]
        if self._settings is None:
            at = last
        else:
            at = self._settings
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
    """Return the camera's settings in a state: mode, region of interest, exposure [ms],
    averages and frames.
    """
    c = state.camera
    left, top, right, bottom = c.roi
    roi = Roi(left, top, right, bottom)
    return CameraSettings(c.mode, roi, c.exposure_ms, c.averages, c.frames)


def kind_of_file(file: str) -> FrameKind:
    """Determine the kind of an image by its file name; a preview is a projection."""
    kind = kind_of(file)
    if kind == "preview":
        return "projection"
    return kind


def _same_file(name: str, source: Directory, files: Directory, *, linked: bool) -> None:
    """Link an image file into another folder if `linked`, or else copy its bytes."""
    with suppress(OSError, NotImplementedError):
        if linked:
            source.link(name, name, files)
            return
    files.put(name, source.read(name))


def _positions(state: State) -> Mapping[str, float]:
    return {n: a.position for n, a in state.axes.items() if not a.virtual}


def _correction(state: State) -> NamedCorrection | None:
    """Return the twin's correction as offsets with name, date and comment; None without
    one.

    Parameters are converted from the wire's units to offsets.
    """
    c = state.correction
    if c is None:
        return None
    return NamedCorrection.from_edge(
        c.name, c.date, c.parameters, c.comment, sides_known=c.sides_known
    )


def _blocks(frames: Sequence[FrameEntry], start: float) -> list[FrameBlock]:
    """Split a document's frames into runs of equal kind, camera setting and X-rays; times
    count from `start` [s].

    The order is kept; frames are only joined to neighbors. A change of mode, region,
    exposure or averages, too, begins a new block.
    """

    def settings(f: FrameEntry) -> tuple[object, ...]:
        return (f.kind, f.mode, f.roi, f.exposure_ms, f.averages, f.xrays_on)

    def block(run: Sequence[FrameEntry]) -> FrameBlock:
        """Make the block of a run of frames with one kind and camera setting, taken from
        the first; times are `start` plus the frames' own [s].

        Motors are those of the first frame.
        """
        first = run[0]
        camera = CameraSettings(
            first.mode, Roi(*first.roi), first.exposure_ms, first.averages
        )
        positions = {n: np.array([f.positions[n] for f in run]) for n in first.positions}
        times = np.array([start + f.time_s for f in run])
        files = tuple(f.file for f in run)
        return FrameBlock(first.kind, files, times, camera, positions, first.xrays_on)

    return [block(tuple(run)) for _, run in groupby(frames, settings)]
