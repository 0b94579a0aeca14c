"""A session of `flexdt follow`: messages in; alarms, a record and a mirror in the twin
out.

It decides nothing: `flexdt.twin.following` determines the effect of a message. Time is
this machine's monotonic clock when a message came, or that of a recording, which takes
the same way. With a folder of frames, the last real one is written with the twin's
radiograph (`frames_beside`).
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Final

from flexdt.clients.following.frames_beside import FramesBeside, newest_frame
from flexdt.clients.following.hearing import heard
from flexdt.clients.following.recording import (
    LINK,
    UP,
    Recorded,
    format_recorded,
    read_recording,
    time_of_day,
)
from flexdt.protocol.acquila import AcquilaError
from flexdt.twin.errors import TwinError
from flexdt.twin.findings import WARNING
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Alarm, Mirror
from flexdt.twin.machine.description import ZERO, Machine, Profile

TICK_S: Final = 0.1
FRAMES_S: Final = 0.5

Tell = Callable[[Alarm], None]


@dataclass
class FollowSession:
    """State of one `flexdt follow`.

    Args:
        follower: compares.
        tell: called with each new alarm.
        record: gets the raw messages; None for none.
        changed: called whenever the mirror has changed, a message came or time has
            passed.
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
        """Set the mirror to a machine whose state is unknown, and compute the clock's
        reading at the last local midnight [s].
        """
        machine = self.follower.machine
        now = datetime.now()
        self.mirror = Mirror.of(machine)
        self._axes = (*machine.axes, *machine.virtual_axes)
        self._looked: object = None
        midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
        self._midnight = self.clock() - (now - midnight).total_seconds()

    def message(self, data: bytes, at: float | None = None, late_s: float = 0.0) -> None:
        """Take one message, which came within `late_s` before `at` [s] (None: now).

        It is recorded, and updates the mirror. Messages that are no events are counted in
        `unread`, the first an example. Executed lines go to `executed`, alarms to `tell`,
        changes to `changed`.
        """
        if at is None:
            at = self.clock()
        self._keep(data, at, late_s)
        try:
            said = heard(data, self._axes, self.time_of_day(at), late_s)
        except AcquilaError as error:
            self.unread += 1
            self.unread_example = (
                self.unread_example or f"{error}: {data[:200].decode('latin-1')}"
            )
            return
        self._take(self.follower.hear(self.mirror, said, at))
        for line in self.mirror.lines:
            self.executed(line)

    def link(self, connected: bool, why: str) -> None:
        """Record that the connection was made or lost, update the mirror and report new
        alarms.

        `connected`: it was made; `why`: the reason of a loss.
        """
        now = self.clock()
        self._keep(UP if connected else LINK + why.encode(), now, 0.0)
        self._take(self.follower.linked(self.mirror, connected, now, why))

    def tick(self, now: float) -> None:
        """Let time pass up to `now`; all earlier messages have been passed on."""
        self._take(self.follower.tick(self.mirror, now))

    def time_of_day(self, at: float) -> str:
        """Format a clock's time as hh:mm:ss.mmm."""
        return time_of_day(at - self._midnight)

    def _keep(self, data: bytes, at: float, late_s: float) -> None:
        """Append a message, its time since midnight and its delay [s] to the recording
        and flush it; do nothing without a recording.
        """
        if self.record is not None:
            self.record.write(
                format_recorded(Recorded(at - self._midnight, late_s, data))
            )
            self.record.flush()

    def _take(self, mirror: Mirror) -> None:
        """Replace the mirror by the given one, call `tell` for each alarm raised since,
        oldest first, and then `changed`, always.
        """
        new = mirror.raised - self.mirror.raised
        self.mirror = mirror
        for alarm in mirror.alarms[len(mirror.alarms) - new :] if new else ():
            self.tell(alarm)
        self.changed(mirror)

    async def run(self, address: str) -> None:
        """Listen to the scanner at `address` and check ahead of its script, until canceled.

        Two tasks: listen for messages, and look ahead; an error in one ends both.
        Raises ExceptionGroup: with the error of a task, such as the ValueError or zmq.ZMQError
        of an address that cannot be connected to."""
        from flexdt.clients.following.listening import listen  # pyzmq is an extra

        async with asyncio.TaskGroup() as tasks:
            hear = listen(address, self.message, self.tick, self.link, self.clock)
            tasks.create_task(hear)
            tasks.create_task(self._look_ahead())

    def replay(self, recording: bytes, ahead: bool = True) -> None:
        """Replay a recording as if it came now; the clock is the recording's.

        While something waits or is due, the session ticks every `TICK_S` of the
        recording's time. Without anything waiting or due, time jumps to the next message
        in one tick. Times of the recording never go back; messages that begin with `LINK`
        are changes of the connection. Returns after the last message.

        Args:
            recording: see `flexdt.clients.following.recording`.
            ahead: whether current moves and the rest of the script are checked as well.
        """
        now = self._midnight = 0.0
        self.clock = lambda: now
        for message in read_recording(recording):
            now = now or message.at_s
            while now + TICK_S < message.at_s:
                idle = not self.mirror.waiting and self.mirror.due_s is None
                if idle:
                    now = message.at_s
                else:
                    now = now + TICK_S
                self.tick(now)
            now = max(now, message.at_s)
            if message.data.startswith(LINK):
                self.link(message.data == UP, message.data.removeprefix(LINK).decode())
            else:
                self.message(message.data, message.at_s, message.late_s)
            if ahead and self._is_new():
                self._take(
                    self.follower.with_ahead(
                        self.mirror, self.follower.ahead(self.mirror, now)
                    )
                )

    async def show_frames(self, folder: Path, beside: FramesBeside) -> None:
        """Write each new frame of a folder with its radiograph, until canceled.

        Looks every `FRAMES_S` seconds at the newest frame; one that is there at the
        beginning is left out. A frame is written once two looks in a row found it
        unchanged. A frame that could be written clears the alarm "frames"; TwinError and
        OSError become such a warning and the loop goes on.

        Args:
            folder: of the scanner's frames; a frame counts once it is no longer written.
            beside: writer of image pairs; its errors become alarms.
        """
        done = seen = newest_frame(folder)
        while True:
            await asyncio.sleep(FRAMES_S)
            before = seen
            seen = await asyncio.to_thread(newest_frame, folder)
            if seen is None or seen == done or seen != before:  # it may still be written
                continue
            done = seen
            mirror = self.mirror
            path, written = seen
            try:
                await asyncio.to_thread(beside.write, path, mirror, time.time() - written)
                self.mirror = self.mirror.cleared("frames")
            except (TwinError, OSError) as error:
                alarm = Alarm(
                    self.clock(), WARNING, "frame", "frames", f"{path.name}: {error}"
                )
                self._take(self.mirror.alarmed(alarm))

    async def _look_ahead(self) -> None:
        """Check current moves and the rest of the script, again whenever either changes,
        and keep the findings as alarms; until canceled.

        It looks every `TICK_S`, checks in a thread, and does nothing while neither
        targets nor the next line have changed.
        """
        while True:
            await asyncio.sleep(TICK_S)
            if self._is_new():
                found = await asyncio.to_thread(
                    self.follower.ahead, self.mirror, self.clock()
                )
                self._take(self.follower.with_ahead(self.mirror, found))

    def _is_new(self) -> bool:
        """Determine whether targets or the next line have changed since the last call;
        False while nothing was heard.

        The state of this call is stored for the next one. True also at the first call
        with something heard.
        """
        key = (self.mirror.next_line, tuple(a.target for a in self.mirror.axes.values()))
        before = self._looked
        if self.mirror.heard_s is not None:
            self._looked = key
        else:
            self._looked = None
        return self._looked not in (None, before)


def executed_script(recording: bytes, machine: Machine) -> bytes:
    """Replay a recording and return the lines of the executed script, joined (bytes);
    empty if there are none.

    Nothing is checked ahead. The profile is one without offsets.
    """
    lines: list[bytes] = []
    follower = Follower(
        machine, Profile(name=ZERO, machine=machine.name, source="no offsets")
    )
    FollowSession(follower, executed=lines.append).replay(recording, ahead=False)
    return b"".join(lines)
