"""A session of `flexdt follow`: messages in; alarms, a record and a mirror in the twin out.

It decides nothing: `flexdt.twin.following` says what a message changes. Time is this machine's
monotonic clock when a message came.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Final

from flexdt.clients.following.frames import FramesBeside, newest_frame
from flexdt.clients.following.scanner_link import listen
from flexdt.clients.gateway.vocabulary import MoveRelative, Question, Refusal, read_command
from flexdt.protocol.acquila import AcquilaError, AcquilaEvent, parse_event
from flexdt.twin.errors import TwinError
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Alarm, Heard, Mirror
from flexdt.twin.script import commands as c
from flexdt.twin.script.grammar import own_name

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
    return Heard(event.key, what, words, command, event.reply, asks, stamp)  # type: ignore[arg-type]


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
