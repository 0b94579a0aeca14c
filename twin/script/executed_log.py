"""Executed scripts: logs that the scanner's software writes after it ran one.

A line has ten TAB separated columns: the seven of the script, then the command's own time
[ms], its reply, which may be binary and hold TABs and line ends, and the moment it was
sent (hh:mm:ss.mmm). So a line ends at its stamp. The form is known from one published log
(`docs/commission.md`).
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, replace
from typing import Final

from flexdt.twin.findings import Finding, Findings, Place, error, warning
from flexdt.twin.script import commands as c
from flexdt.twin.script import grammar
from flexdt.twin.script.grammar import ArgumentError, shorten
from flexdt.twin.script.parse import LOG_STAMP, read_row, rows
from flexdt.twin.script.problems import ScriptCode

_WAIT = re.compile(rb"\t(?:ACK|no[ ]wait|POS|RCV)(?=\t)", re.IGNORECASE)
COLUMNS: Final = (
    "an executed script has ten: component, command, argument 1, argument 2, wait, timeout, "
    "expected, own time [ms], reply, moment (hh:mm:ss.mmm)"
)
MAX_OWN_S: Final = 7 * 86_400.0
"""Longest own time of a command that is believed [s]; a greater one is a slip."""
_REPLY_DOUBLES: Final = 17
"""Number of doubles at the start of a motor's reply."""
_LIMITS_COPY_BYTE: Final = 143
"""Byte offset at which a motor's reply repeats its two limits."""
_REPLY_BYTES: Final = 267
"""Length of a motor's reply [bytes]."""


@dataclass(frozen=True)
class MotorReply:
    """A motor's answer to a move [mm or deg, s], in the axis's own sign.

    Decoded by agreement with the settings file of the same scan; there is no
    documentation.
    """

    position: float
    target: float
    speed: float
    acceleration: float
    lower: float
    upper: float
    max_speed: float
    max_acceleration: float


@dataclass(frozen=True)
class Executed:
    """One line of a log: the command, its duration and its answer.

    Attributes:
        command: as a script has it; its line counts the lines of the script.
        own_s: column 8.
        sent_s: moment at which it was sent, since midnight.
        reply: column 9.
        motor: the reply to a move that waits, decoded.
    """

    command: c.Command
    own_s: float
    sent_s: float
    reply: bytes = b""
    motor: MotorReply | None = None

    @property
    def line(self) -> int:
        """Line of the script."""
        return self.command.line


def read_log(data: bytes) -> tuple[tuple[Executed, ...], Findings]:
    r"""Read the lines of an executed script.

    Args:
        data: the file's bytes, since replies are binary.

    Returns:
        Lines in order, and problems in the order of lines: an error for each line that
        cannot be read (it is left out), a warning for a last line that is cut off and for
        a motor's reply that is not as expected.

    Example:
        >>> (line,), found = read_log(b"tube\txrayoff\t\t\tACK\t\t\t501\t\t09:36:31.952")
        >>> line.own_s, type(line.command).__name__, len(found)
        (0.501, 'XrayOff', 0)
    """
    executed: list[Executed] = []
    problems: list[Finding] = []
    number = 0
    start = 0
    for number, stamp in enumerate(LOG_STAMP.finditer(data), 1):
        try:
            executed.append(_line(data[start : stamp.start()], stamp, number, problems))
        except ArgumentError as wrong:
            problems.append(error(wrong.code, str(wrong), place=Place(number)))
        start = stamp.end()
    if data[start:].strip(b"\0 \t\r\n\x1a"):
        message = f"the last line is cut off before its moment and left out; {COLUMNS}"
        problems.append(warning(ScriptCode.CUT_OFF, message, place=Place(number + 1)))
    return tuple(executed), Findings(problems).by_place()


def _line(
    record: bytes, stamp: re.Match[bytes], number: int, problems: list[Finding]
) -> Executed:
    """Read one line of a log; add a warning `reply` if a motor's reply does not fit its
    move.

    Only a move that waits (ACK) has its reply decoded.

    Args:
        record: the line without its moment.
        stamp: match of `LOG_STAMP` that ends the line.
        number: of the line, from 1.
        problems: list to which problems are added.

    Returns:
        The command with its own time [s], moment of the day [s], reply and, for a move,
        the decoded reply or None.

    Raises:
        ArgumentError: the line cannot be read, its own time is above `MAX_OWN_S`, or its
            moment is no time of day.
    """
    wait = _WAIT.search(record)
    if wait is not None:
        tail = record[wait.end() + 1 :].split(b"\t", 3)
    else:
        tail = []
    if wait is None or len(tail) < 3:
        columns = record.count(b"\t") + 2
        raise ArgumentError(
            f"{columns} columns, or no wait (ACK, no wait, POS, RCV); {COLUMNS}"
        )
    script = record[: wait.end()] + b"\t" + b"\t".join(tail[:2])
    row = next(rows(script), None)
    if row is None:
        raise ArgumentError(f"no command; {COLUMNS}")
    command = read_row(replace(row, line=number), problems)
    if command is None:
        raise ArgumentError("the command does not hold")
    own_s = (
        grammar.not_negative(
            tail[2].decode("latin-1").strip(), "own time [ms] (column 8)"
        )
        / 1e3
    )
    if own_s > MAX_OWN_S:
        raise ArgumentError(
            f"own time (column 8) is {own_s:g} s; at most {MAX_OWN_S:g} s"
        )
    hour, minute, second = (float(x) for x in stamp.groups())
    if not (hour < 24 and minute < 60 and second < 60):
        raise ArgumentError(
            f"moment {stamp[0].strip().decode()} (column 10) is no time of day"
        )
    reply = tail[3] if len(tail) > 3 else b""
    motor = None
    if isinstance(command, c.MoveAbsolute) and command.wait is c.Wait.ACK:
        motor = motor_reply(reply)
        if motor is None or not _arrived(motor, command.target):
            motor = None
            message = (
                f"the reply of {shorten(command.component)} ({len(reply)} bytes) is left "
                f"out: it must begin with {_REPLY_DOUBLES} big-endian doubles (position "
                "near the target, limits twice)"
            )
            problems.append(warning(ScriptCode.REPLY, message, place=Place(number)))
    return Executed(command, own_s, 3600 * hour + 60 * minute + second, reply, motor)


def _arrived(motor: MotorReply, target: float) -> bool:
    """Return whether a reply is about a move to `target`, or to the motor's limit before
    it.

    The motor's target must agree within 1e-3 (1 + its size), its position with that
    within 1 more.
    """
    allowed = min(max(target, motor.lower), motor.upper)
    near = 1e-3 * (1.0 + abs(allowed))
    return (
        abs(motor.target - allowed) <= near
        and abs(motor.position - motor.target) <= 1.0 + near
    )


def log_line(
    words: tuple[str, ...], wait: str, own_s: float, reply: bytes, stamp: str
) -> bytes:
    """Format one line of a log, as `read_log` reads it.

    Blanks within the words become single spaces, unless a word has a NUL; own time is
    written in whole ms.

    Args:
        words: component, command, argument 1, argument 2.
        wait: ACK, no wait, POS or RCV.
        own_s: how long the command took [s].
        reply: as it came.
        stamp: time of day at which it was sent, hh:mm:ss.mmm.

    Returns:
        The line with CRLF.

    Example:
        >>> made = log_line(("tube", "xrayoff", "", ""), "ACK", 0.5, b"", "09:36:31.952")
        >>> read_log(made)[0][0].own_s
        0.5
    """
    plain = [" ".join(word.split()) if "\0" not in word else word for word in words]
    head = "\t".join([*plain, wait, "", "", f"{1000.0 * own_s:.0f}", ""])
    return reply_bytes(head) + reply + f"\t{stamp}\r\n".encode()


def reply_bytes(text: str) -> bytes:
    """Encode a text as Latin-1, or if it does not fit, as UTF-8.

    In UTF-8 lone surrogates become "?".
    """
    try:
        return text.encode("latin-1")
    except UnicodeEncodeError:
        return text.encode("utf-8", "replace")


def motor_cluster(motor: MotorReply) -> bytes:
    """Encode a motor's reply in `_REPLY_BYTES`; unknown bytes are zero.

    Example:
        >>> axis = MotorReply(90.0, 90.0, 45.0, 45.0, -360.0, 360.0, 200.0, 300.0)
        >>> motor_reply(motor_cluster(axis)) == axis, len(motor_cluster(axis))
        (True, 267)
    """
    m = motor
    cluster = bytearray(_REPLY_BYTES)
    head = (
        m.position,
        m.target,
        m.speed,
        0.0,
        m.acceleration,
        m.upper,
        m.lower,
        0.0,
        m.max_speed,
        0.0,
        m.max_acceleration,
    )
    struct.pack_into(f">{len(head)}d", cluster, 0, *head)
    struct.pack_into(">2d", cluster, _LIMITS_COPY_BYTE, m.upper, m.lower)
    return bytes(cluster)


def motor_reply(reply: bytes) -> MotorReply | None:
    """Decode a motor's reply; None if it is not one.

    None if it is too short, has been saved as plain text (no byte from 0x80 on), or its
    numbers are not a motor's: limits that are not repeated or in order, speed or
    acceleration not above 0 or above their maxima, maxima above 1e6, a number beyond 1e9
    or NaN, a position more than 1 outside the limits.

    Args:
        reply: column 9: 17 big-endian doubles (0 position, 1 target, 2 speed, 4
            acceleration, 5 upper and 6 lower limit, 8 greatest speed, 10 greatest
            acceleration), then others, which repeat the two limits.
    """
    if len(reply) < _LIMITS_COPY_BYTE + 16:
        return None
    if (
        max(reply[: _LIMITS_COPY_BYTE + 16]) < 0x80
    ):  # saved as plain text: every high byte became another one
        return None
    v = struct.unpack_from(f">{_REPLY_DOUBLES}d", reply)
    motor = MotorReply(v[0], v[1], v[2], v[4], v[6], v[5], v[8], v[10])
    copy = struct.unpack_from(">2d", reply, _LIMITS_COPY_BYTE)
    sound = all(abs(x) <= 1e9 for x in vars(motor).values())
    rates = (
        0 < motor.speed <= motor.max_speed
        and 0 < motor.acceleration <= motor.max_acceleration
    )
    if not sound or not rates or motor.max_speed > 1e6 or motor.max_acceleration > 1e6:
        return None
    if copy != (motor.upper, motor.lower) or not motor.lower < motor.upper:
        return None
    if motor.lower - 1 <= motor.position <= motor.upper + 1:
        return motor
    return None
