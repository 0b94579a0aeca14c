"""Raw messages of a scanner with the times of day at which they came: written and read.

One message after the other, each behind its time: `[hh:mm:ss.ffffff LATE] MESSAGE`, where LATE
is how many seconds earlier it may have come. Messages are kept byte for byte and may hold line
ends; that the link came up or was lost is a message that begins with `--`. The form is that of
the public `monitor_zmq.py`, whose times are whole seconds without LATE: they may be anywhere in
their second.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

STAMP: Final = re.compile(
    rb"^\[(\d\d):(\d\d):(\d\d(?:\.\d+)?)(?: (\d+\.\d+))?\] ", re.MULTILINE
)
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
    """Format a time since a midnight as hh:mm:ss.mmm; it begins again at 0 each day.

    Args:
        seconds: since the midnight [s].
        digits: number of decimals.

    Example:
        >>> time_of_day(86400.0 + 3723.5)
        '01:02:03.500'
    """
    unit = 10**digits
    whole, part = divmod(round(seconds * unit) % round(DAY_S * unit), unit)
    hour, minute = divmod(whole // 60, 60)
    return f"{hour:02d}:{minute:02d}:{whole % 60:02d}.{part:0{digits}d}"


def format_recorded(message: Recorded) -> bytes:
    """Encode a message as `[hh:mm:ss.ffffff LATE] DATA` and a line end (bytes), LATE in
    seconds; the day is lost."""
    head = f"[{time_of_day(message.at_s, 6)} {message.late_s:.6f}] "
    return head.encode() + message.data + b"\n"


def read_recording(data: bytes) -> Iterator[Recorded]:
    r"""Yield the messages of a recording; times [s] go on after midnight.

    They count from the midnight nearest to the first message; each is on the day nearest
    to the one before. A time in whole seconds is the end of its second, 1 s late. Bytes
    before the first stamp are skipped.

    Example:
        >>> recording = b"[23:59:59] {}\n[00:00:01.5 0.002] {}\n"
        >>> [(m.at_s, m.late_s) for m in read_recording(recording)]
        [(0.0, 1.0), (1.5, 0.002)]
    """
    stamps = list(STAMP.finditer(data))
    last = 0.0
    for stamp, end in zip(
        stamps, [*(s.start() for s in stamps[1:]), len(data)], strict=True
    ):
        hour, minute, second = (float(x) for x in stamp.groups()[:3])
        late = float(stamp[4] or (0.0 if b"." in stamp[3] else 1.0))
        at = 3600.0 * hour + 60.0 * minute + second + (0.0 if b"." in stamp[3] else 1.0)
        at += DAY_S * round((last - at) / DAY_S)
        last = at
        yield Recorded(at, late, data[stamp.end() : end].removesuffix(b"\n"))
