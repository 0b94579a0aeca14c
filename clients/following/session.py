"""A session of `flexdt follow`: messages in; alarms, a record and a mirror in the twin out.

It decides nothing: `flexdt.twin.following` says what a message changes. Time is this machine's
monotonic clock when a message came. The only socket is a SUB socket, which cannot send a message;
ZeroMQ's own heartbeats tell within a second that a cable is out.

With a folder of frames, the last real one is written beside the twin's radiograph of the mirrored
machine: its positions and camera when the frame appeared, the profile's offsets and the phantom on
the stage. Their distance comes from the peak of their cross-correlation, whitened (phase
correlation; Kuglin and Hines 1975).
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Final

import cv2
import numpy as np
import zmq
import zmq.asyncio
from zmq.utils.monitor import parse_monitor_message

from flexdt.clients.datasets.pictures import png
from flexdt.clients.gateway.vocabulary import MoveRelative, Question, Refusal, read_command
from flexdt.clients.whole_files import write_whole
from flexdt.phantoms import Phantom
from flexdt.phantoms.channels import line_integrals as projected
from flexdt.protocol.acquila import MAX_BYTES, AcquilaError, AcquilaEvent, parse_event
from flexdt.runtime.files.dataset_folder import list_folder, mean_image, read_image
from flexdt.twin.dataset.normalise import LineIntegrals
from flexdt.twin.errors import TwinError
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Alarm, Heard, Mirror
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.script import commands as c
from flexdt.twin.script.grammar import own_name

PORT: Final = 50000
HEARTBEAT_MS: Final = 200
SILENT_MS: Final = 500
"""A scanner whose ZeroMQ does not answer a heartbeat for so long is not there."""
RETRY_MS: Final = 100
MOST_RETRY_MS: Final = 1000
MAX_HELD: Final = 10_000
_ADDRESS: Final = re.compile(r"(?:tcp://)?(\[[0-9a-fA-F:.]+\]|[^\s:/\[\]]+)(?::(\d{1,5}))?/?")


def endpoint(address: str) -> str:
    """ZeroMQ's name of `tcp://HOST[:PORT]`.

    Raises:
        ValueError: it is none.

    Example:
        >>> endpoint("tcp://scanner"), endpoint("10.0.0.7:5555")
        ('tcp://scanner:50000', 'tcp://10.0.0.7:5555')
    """
    match = _ADDRESS.fullmatch(address.strip())
    port = PORT if match is None or match[2] is None else int(match[2])
    if match is None or not 0 < port < 65536:
        raise ValueError(f"{address!r} is no address; allowed: tcp://HOST[:PORT], PORT 1 to 65535")
    return f"tcp://{match[1]}:{port}"


async def listen(
    address: str, message: Callable[[bytes], None], link: Callable[[bool, str], None]
) -> None:
    """Listen until cancelled.

    Args:
        address: see `endpoint`.
        message: called with every message.
        link: called with whether there is a connection, and why not, when that changes.

    Raises:
        ValueError, zmq.ZMQError: no address that can be connected to.
    """
    with zmq.asyncio.Context() as context, context.socket(zmq.SUB) as socket:
        for option, value in (
            (zmq.LINGER, 0), (zmq.RCVHWM, MAX_HELD), (zmq.MAXMSGSIZE, MAX_BYTES),
            (zmq.HEARTBEAT_IVL, HEARTBEAT_MS), (zmq.HEARTBEAT_TIMEOUT, SILENT_MS),
            (zmq.RECONNECT_IVL, RETRY_MS), (zmq.RECONNECT_IVL_MAX, MOST_RETRY_MS),
            (zmq.IPV6, int("[" in address)),
        ):  # fmt: skip
            socket.setsockopt(option, value)
        socket.subscribe(b"")
        events = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED
        monitor = socket.get_monitor_socket(events)
        watching = asyncio.create_task(_watch(monitor, link))
        try:
            socket.connect(endpoint(address))
            while True:
                frames = await socket.recv_multipart()
                message(frames[0] if len(frames) == 1 else b"")
        finally:
            watching.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await watching
            socket.disable_monitor()
            monitor.close(linger=0)


async def _watch(monitor: zmq.asyncio.Socket, link: Callable[[bool, str], None]) -> None:
    while True:
        event = parse_monitor_message(await monitor.recv_multipart())
        if event["event"] == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            link(True, "")
        else:
            link(False, "the scanner has ended the connection, or does not answer")


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


def heard(data: bytes, axes: Collection[str], mirror: Mirror, stamp: str) -> Heard:
    """One message.

    Args:
        data: as it came; UTF-8, or one byte for each character where a cluster makes it none.
        axes: motors and virtual axes of the machine.
        mirror: says where a relative move begins.
        stamp: time of day, hh:mm:ss.mmm.

    Raises:
        AcquilaError: the bytes are no event.
    """
    try:
        event = parse_event(data)
    except AcquilaError:
        event = parse_event(data.decode("latin-1"))
    event = replace(event, component=own_name(event.component, axes))
    command, asks = _read(event, axes, mirror)
    words = (event.component, event.command, event.arg1, event.arg2)
    what = event.reply_type.value or "SEND"
    return Heard(  # type: ignore[arg-type]
        event.key, what, words, command, event.reply, asks, stamp, event.tick_count
    )


def _read(
    event: AcquilaEvent, axes: Collection[str], mirror: Mirror
) -> tuple[c.Command | None, str]:
    """The typed command, and what a question asks for; neither of what the scripts do not know."""
    try:
        command = read_command(event, axes)
    except Refusal:
        return None, ""
    match command:
        case Question():
            return None, command.path[-1]
        case MoveRelative() if command.component in mirror.axes:
            at = mirror.axes[command.component].position
            return c.MoveAbsolute(component=command.component, target=at + command.step), ""
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
        record: gets the executed script's lines; None for none.
        changed: called whenever the mirror has changed, a message came or time has passed.
        clock: monotonic [s].

    Attributes:
        mirror: the machine as it is known now.
        unread: messages that were no events.
    """

    follower: Follower
    tell: Tell = lambda alarm: None
    record: BinaryIO | None = None
    changed: Callable[[Mirror], None] = lambda mirror: None
    clock: Callable[[], float] = time.monotonic
    mirror: Mirror = field(init=False)
    unread: int = 0

    def __post_init__(self) -> None:
        machine = self.follower.machine
        self.mirror = Mirror.of(machine)
        self._axes = (*machine.axes, *machine.virtual_axes)
        self._looked: object = None

    def message(self, data: bytes) -> None:
        """One message has come."""
        stamp = datetime.now().strftime("%H:%M:%S.%f")[:-3]
        try:
            said = heard(data, self._axes, self.mirror, stamp)
        except AcquilaError:
            self.unread += 1
            return
        self._take(self.follower.hear(self.mirror, said, self.clock()))
        if self.record is not None and self.mirror.lines:
            self.record.writelines(self.mirror.lines)
            self.record.flush()

    def link(self, connected: bool, why: str) -> None:
        """The connection has come up or gone down."""
        self._take(self.follower.linked(self.mirror, connected, self.clock(), why))

    def tick(self) -> None:
        """Time has passed."""
        self._take(self.follower.tick(self.mirror, self.clock()))

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
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(listen(address, self.message, self.link))
            tasks.create_task(self._ticks())
            tasks.create_task(self._look_ahead())

    async def _ticks(self) -> None:
        while True:
            await asyncio.sleep(TICK_S)
            self.tick()

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
            mirror = self.mirror
            key = (mirror.next_line, tuple(a.target for a in mirror.axes.values()))
            if key == self._looked or mirror.heard_s is None:
                continue
            self._looked = key
            found = await asyncio.to_thread(self.follower.ahead, mirror, self.clock())
            self._take(self.follower.told(self.mirror, found))
