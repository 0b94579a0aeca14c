"""A session of `flexdt follow`: messages in; alarms, a record and a mirror in the twin out.

It decides nothing: `flexdt.twin.following` says what a message changes. Time is this machine's
monotonic clock when a message came, or that of a recording, which takes the same way.

With a folder of frames, the last real one is written beside the twin's radiograph of the mirrored
machine: its positions and camera when the frame appeared, the profile's offsets and the phantom on
the stage. Their distance comes from the peak of their cross-correlation, whitened (phase
correlation; Kuglin and Hines 1975).

Raw messages of a scanner with the times of day at which they came: written and read.

One message after the other, each behind its time: `[hh:mm:ss.ffffff LATE] MESSAGE`, where LATE is
how many seconds earlier it may have come. Messages are kept byte for byte and may hold line ends;
that the link came up or was lost is a message that begins with `--`. The form is that of the public
`monitor_zmq.py`, whose times are whole seconds without LATE: they may be anywhere in their second.
"""

from __future__ import annotations

import asyncio
import json
import re
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Final

import cv2
import numpy as np

from flexdt.clients.gateway.vocabulary import Question, Refusal, read_command
from flexdt.library.datasets.pictures import png
from flexdt.phantoms import Phantom
from flexdt.phantoms.channels import line_integrals as projected
from flexdt.protocol.acquila import AcquilaError, AcquilaEvent, parse_event
from flexdt.runtime.files.dataset_folder import list_folder, mean_image, read_image
from flexdt.runtime.files.whole_files import write_whole
from flexdt.twin.dataset.normalise import LineIntegrals
from flexdt.twin.errors import TwinError
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Alarm, Heard, Mirror, What
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.description import ZERO, Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.script import commands as c
from flexdt.twin.script.grammar import own_name


def newest_frame(folder: Path) -> tuple[Path, float] | None:
    """The TIFF that was written last, and when; None if there is none.

    Darks and flats are none.
    """
    found = []
    for path in folder.glob("*.tif*"):
        with suppress(OSError):  # it has gone meanwhile
            if not path.name.startswith(("di", "io")):
                found.append((path.stat().st_mtime, path))
    written, newest = max(found, default=(0.0, None))
    return None if newest is None else (newest, written)


@dataclass(frozen=True)
class FramesBeside:
    """Writes `beside.png` (real, virtual) and `beside.json` into a folder.

    Args:
        follower: its machine and profile.
        phantom: what stands on the stage.
        out: where to.
    """

    follower: Follower
    phantom: Phantom
    out: Path

    def write(self, path: Path, mirror: Mirror, age_s: float) -> dict[str, object]:
        """One frame beside its radiograph.

        Args:
            path: of the frame.
            mirror: the machine when it appeared.
            age_s: of the frame.

        Raises:
            TwinError: no readable image, or of another shape than the camera's.
        """
        shape = mirror.camera.shape
        real, white = line_integrals(path, shape)
        machine, profile = self.follower.machine, self.follower.profile
        poses = motor_poses(machine, profile, mirror.camera, mirror.positions)
        virtual = projected(self.phantom, poses.cone_vec(), shape)[0]
        columns, rows = shift(virtual, real)
        told = {
            "file": path.name,
            "age_s": round(age_s, 3),
            "positions": mirror.positions,
            "assumed": list(mirror.assumed),
            "white": white,
            "shift_px": {"columns": columns, "rows": rows},
        }
        picture = png(np.concatenate([real, virtual], axis=1), dark_is_dense=True)
        self.out.mkdir(parents=True, exist_ok=True)
        for name, data in (("png", picture), ("json", json.dumps(told, indent=2).encode())):
            write_whole(self.out / f"beside.{name}", data)
        return told


def line_integrals(path: Path, shape: tuple[int, int]) -> tuple[Float32Array, str]:
    """A frame's line integrals (rows, cols), and what they take for white.

    With a dark and a flat beside it these are used; else white is a percentile of the frame.

    Raises:
        TwinError: no readable image, or of another shape.
    """
    counts = read_image(path, shape).astype(np.float32)
    folder = list_folder(path.parent)
    dark, white = np.zeros_like(counts), np.full_like(counts, np.percentile(counts, 99.5))
    what = "99.5 % of the frame"
    if folder.darks and folder.flats:
        dark = mean_image(folder.paths(folder.darks), shape)
        white = mean_image(folder.paths(folder.flats), shape)
        what = "dark and flat of the folder"
    return LineIntegrals.of(dark, white)(counts), what


def shift(virtual: Float32Array, real: Float32Array) -> tuple[float, float]:
    """By how much the real image lies aside of the virtual one [px], (columns, rows).

    Example:
        >>> image = np.zeros((32, 48), np.float32)
        >>> image[10:20, 15:25] = 1.0
        >>> columns, rows = shift(image, np.roll(image, (2, -3), axis=(0, 1)))
        >>> round(columns, 1), round(rows, 1)
        (-3.0, 2.0)
    """
    (columns, rows), _ = cv2.phaseCorrelate(virtual.astype(np.float64), real.astype(np.float64))
    return float(columns), float(rows)


# Bytes of the scanner's interface to what a follower hears: no socket, no clock.


def heard(data: bytes, axes: Collection[str], stamp: str, late_s: float = 0.0) -> Heard:
    """One message.

    Args:
        data: as it came; UTF-8, or one byte for each character where a cluster makes it none. What
            stands before the object, such as a topic, is left out.
        axes: motors and virtual axes of the machine.
        stamp: time of day, hh:mm:ss.mmm.
        late_s: by how much earlier it may have come than it was read [s].

    Raises:
        AcquilaError: the bytes are no event.
    """
    data = data[max(0, data.find(b"{")) :]
    try:
        event = parse_event(data)
    except AcquilaError:
        event = parse_event(data.decode("latin-1"))
    event = replace(event, component=own_name(event.component, axes))
    command, asks = _read(event, axes)
    words = (event.component, event.command, event.arg1, event.arg2)
    what: What = event.reply_type.value or "SEND"  # type: ignore[assignment]
    tick, reply = event.tick_count, event.reply
    return Heard(event.key, what, words, command, reply, asks, stamp, tick, late_s)


def _read(event: AcquilaEvent, axes: Collection[str]) -> tuple[c.Command | None, str]:
    """The typed command, and what a question asks for; neither of what the scripts do not know."""
    try:
        command = read_command(event, axes)
    except Refusal:
        return None, ""
    if isinstance(command, Question):
        return None, command.path[-1]
    return (command if type(command).__module__ == c.__name__ else None), ""


TICK_S: Final = 0.1
FRAMES_S: Final = 0.5

Tell = Callable[[Alarm], None]


@dataclass
class FollowSession:
    """What one `flexdt follow` knows.

    Args:
        follower: compares.
        tell: called with each new alarm.
        record: gets the raw messages; None for none.
        changed: called whenever the mirror has changed, a message came or time has passed.
        clock: monotonic [s].
        executed: called with the lines of the executed script.

    Attributes:
        mirror: the machine as it is known now.
        unread: messages that were no events, and `unread_example` the first of them.
    """

    follower: Follower
    tell: Tell = lambda alarm: None
    record: BinaryIO | None = None
    changed: Callable[[Mirror], None] = lambda mirror: None
    clock: Callable[[], float] = time.monotonic
    executed: Callable[[bytes], None] = lambda line: None
    mirror: Mirror = field(init=False)
    unread: int = 0
    unread_example: str = ""

    def __post_init__(self) -> None:
        machine, now = self.follower.machine, datetime.now()
        self.mirror = Mirror.of(machine)
        self._axes = (*machine.axes, *machine.virtual_axes)
        self._looked: object = None
        midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
        self._midnight = self.clock() - (now - midnight).total_seconds()

    def message(self, data: bytes, at: float | None = None, late_s: float = 0.0) -> None:
        """One message has come, between `late_s` before `at` and `at`, or now."""
        at = self.clock() if at is None else at
        self._keep(data, at, late_s)
        try:
            said = heard(data, self._axes, self.time_of_day(at), late_s)
        except AcquilaError as error:
            self.unread += 1
            self.unread_example = self.unread_example or f"{error}: {data[:200].decode('latin-1')}"
            return
        self._take(self.follower.hear(self.mirror, said, at))
        for line in self.mirror.lines:
            self.executed(line)

    def link(self, connected: bool, why: str) -> None:
        """The connection has come up or gone down."""
        now = self.clock()
        self._keep(UP if connected else LINK + why.encode(), now, 0.0)
        self._take(self.follower.linked(self.mirror, connected, now, why))

    def tick(self, now: float) -> None:
        """Time has passed up to `now`, and every message until then was told."""
        self._take(self.follower.tick(self.mirror, now))

    def time_of_day(self, at: float) -> str:
        """hh:mm:ss.mmm of a time of the clock."""
        return time_of_day(at - self._midnight)

    def _keep(self, data: bytes, at: float, late_s: float) -> None:
        if self.record is not None:
            self.record.write(format_recorded(Recorded(at - self._midnight, late_s, data)))
            self.record.flush()

    def _take(self, mirror: Mirror) -> None:
        new, self.mirror = mirror.raised - self.mirror.raised, mirror
        for alarm in mirror.alarms[len(mirror.alarms) - new :] if new else ():
            self.tell(alarm)
        self.changed(mirror)

    async def run(self, address: str) -> None:
        """Listen until cancelled.

        Raises:
            ValueError, zmq.ZMQError: no address that can be connected to.
        """
        from flexdt.clients.following.listening import listen  # pyzmq is an extra

        async with asyncio.TaskGroup() as tasks:
            hear = listen(address, self.message, self.tick, self.link, self.clock)
            tasks.create_task(hear)
            tasks.create_task(self._look_ahead())

    def replay(self, recording: bytes, ahead: bool = True) -> None:
        """Hear a recording as if it came now; the clock is the recording's.

        Args:
            recording: see `flexdt.clients.following.session`.
            ahead: whether what is under way, and the rest of the script, are checked as well.
        """
        now = self._midnight = 0.0
        self.clock = lambda: now
        for message in read_recording(recording):
            now = now or message.at_s
            while now + TICK_S < message.at_s:
                idle = not self.mirror.waiting and self.mirror.due_s is None
                now = message.at_s if idle else now + TICK_S
                self.tick(now)
            now = max(now, message.at_s)
            if message.data.startswith(LINK):
                self.link(message.data == UP, message.data.removeprefix(LINK).decode())
            else:
                self.message(message.data, message.at_s, message.late_s)
            if ahead and self._is_new():
                self._take(self.follower.told(self.mirror, self.follower.ahead(self.mirror, now)))

    async def show_frames(self, folder: Path, beside: FramesBeside) -> None:
        """Write each new frame of a folder beside its radiograph, until cancelled."""
        done = seen = newest_frame(folder)
        while True:
            await asyncio.sleep(FRAMES_S)
            before, seen = seen, await asyncio.to_thread(newest_frame, folder)
            if seen is None or seen == done or seen != before:  # it may still be written
                continue
            done, mirror = seen, self.mirror
            path, written = seen
            try:
                await asyncio.to_thread(beside.write, path, mirror, time.time() - written)
                self.mirror = self.mirror.cleared("frames")
            except (TwinError, OSError) as error:
                alarm = Alarm(self.clock(), "warning", "frame", "frames", f"{path.name}: {error}")
                self._take(self.mirror.alarmed(alarm))

    async def _look_ahead(self) -> None:
        """Check what is under way and the rest of the script, again whenever either changes."""
        while True:
            await asyncio.sleep(TICK_S)
            if self._is_new():
                found = await asyncio.to_thread(self.follower.ahead, self.mirror, self.clock())
                self._take(self.follower.told(self.mirror, found))

    def _is_new(self) -> bool:
        """Whether what lies ahead has changed since this was asked last."""
        key = (self.mirror.next_line, tuple(a.target for a in self.mirror.axes.values()))
        before, self._looked = self._looked, key if self.mirror.heard_s is not None else None
        return self._looked not in (None, before)


def executed_script(recording: bytes, machine: Machine) -> bytes:
    """The executed script in a recording of raw messages, as the scanner would have written it."""
    lines: list[bytes] = []
    follower = Follower(machine, Profile(name=ZERO, machine=machine.name, source="no offsets"))
    FollowSession(follower, executed=lines.append).replay(recording, ahead=False)
    return b"".join(lines)


STAMP: Final = re.compile(rb"^\[(\d\d):(\d\d):(\d\d(?:\.\d+)?)(?: (\d+\.\d+))?\] ", re.MULTILINE)
LINK: Final = b"-- "
UP: Final = b"-- connected"
DAY_S: Final = 86400.0


@dataclass(frozen=True)
class Recorded:
    """One message.

    Attributes:
        at_s: when it was read, since the midnight before the first [s].
        late_s: by how much earlier it may have come [s].
        data: as it came.
    """

    at_s: float
    late_s: float
    data: bytes


def time_of_day(seconds: float, digits: int = 3) -> str:
    """hh:mm:ss.mmm of a time since a midnight.

    Example:
        >>> time_of_day(86400.0 + 3723.5)
        '01:02:03.500'
    """
    unit = 10**digits
    whole, part = divmod(round(seconds * unit) % round(DAY_S * unit), unit)
    hour, minute = divmod(whole // 60, 60)
    return f"{hour:02d}:{minute:02d}:{whole % 60:02d}.{part:0{digits}d}"


def format_recorded(message: Recorded) -> bytes:
    """A message as a recording holds it."""
    head = f"[{time_of_day(message.at_s, 6)} {message.late_s:.6f}] "
    return head.encode() + message.data + b"\n"


def read_recording(data: bytes) -> Iterator[Recorded]:
    """The messages of a recording; times go on after midnight.

    Example:
        >>> recording = b"[23:59:59] {}\\n[00:00:01.5 0.002] {}\\n"
        >>> [(m.at_s, m.late_s) for m in read_recording(recording)]
        [(86400.0, 1.0), (86401.5, 0.002)]
    """
    stamps, last = list(STAMP.finditer(data)), 0.0
    for stamp, end in zip(stamps, [*(s.start() for s in stamps[1:]), len(data)], strict=True):
        hour, minute, second = (float(x) for x in stamp.groups()[:3])
        late = float(stamp[4] or (0.0 if b"." in stamp[3] else 1.0))
        at = 3600.0 * hour + 60.0 * minute + second + (0.0 if b"." in stamp[3] else 1.0)
        at += DAY_S * round((last - at) / DAY_S)
        last = at
        yield Recorded(at, late, data[stamp.end() : end].removesuffix(b"\n"))
