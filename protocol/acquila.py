"""Events of the scanner software's own socket interface: JSON objects of the types RCV,
FDB, ACK, ERR.

A command is an event whose `reply type` is empty (some programs write SEND or SENT).
The program that executes it answers with events that bear the same UUID: RCV at once, FDB while it
lasts, then one ACK or ERR. The interface's description requires the command's tick count
in replies as well, but programs renew it or leave it out. Time is an argument.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Final, Literal

ComponentType = Literal["tube", "motor", "camera", "other"]

FEEDBACK_S: Final = 0.8
"""Time between two FDB events [s of real time]; at least one a second is required."""
MAX_BYTES: Final = 1 << 20
"""Longest event that is read, and longest argument 1 (a script) [bytes]."""
MAX_CHARS: Final[Mapping[str, int]] = {
    "component": 100,
    "comp_phys": 1000,
    "command": 1000,
    "arg1": MAX_BYTES,
    "arg2": 4096,
    "reply": 1 << 16,
    "reply type": 20,
    "comp_type": 100,
    "UUID": 200,
}
"""Longest text of each field; the names of most are given by the scanner and far shorter."""
MAX_UUID: Final = 1e200
"""Greatest absolute value of a numeric UUID."""
BINARY_FIELDS: Final = ("arg1", "arg2", "reply")
"""Fields that may hold control characters: arguments may be binary."""
_SURROGATE = re.compile(r"[\ud800-\udfff]")
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
FIELDS: Final = (
    "component",
    "comp_phys",
    "command",
    "arg1",
    "arg2",
    "reply",
    "reply type",
    "comp_type",
    "tick count",
    "UUID",
)
"""Names of all fields, in the order in which an event has them."""


class ReplyType(Enum):
    """Type of an event."""

    SEND = ""
    """A command for the component that it names."""
    RCV = "RCV"
    """The command has been received."""
    FDB = "FDB"
    """How far it is."""
    ACK = "ACK"
    """It is complete."""
    ERR = "ERR"
    """It failed; `reply` has the reason."""


_REPLY_TYPES: Final[Mapping[str, ReplyType]] = {
    **{t.value: t for t in ReplyType},
    "SEND": ReplyType.SEND,
    "SENT": ReplyType.SEND,
}


class AcquilaError(ValueError):
    """Bytes that are not an event; names the problem and the allowed values."""


@dataclass(frozen=True)
class AcquilaEvent:
    """One event; texts may be empty, `uuid` is as it came (a number, or some clients' text).

    The interface's UUIDs are unsigned 64-bit numbers, but programs send negative and greater
    ones, and those whose JSON has no other numbers send floats.
    """

    component: str
    command: str
    arg1: str = ""
    arg2: str = ""
    reply: str = ""
    reply_type: ReplyType = ReplyType.SEND
    comp_phys: str = ""
    comp_type: str = "other"
    tick_count: int = 0
    uuid: int | float | str = 0

    @property
    def is_command(self) -> bool:
        """Whether it commands its component."""
        return self.reply_type is ReplyType.SEND

    @property
    def anonymous(self) -> bool:
        """Whether the event has no UUID, so that the receiver assigns one."""
        return self.uuid in (0, "", "0")

    @property
    def key(self) -> float | str:
        """Key that a command and its replies share: the UUID as a float if it is a number
        or the digits of one, else as text.

        Programs whose JSON has no integers return the UUID as a float. Without a UUID the
        key is "component command".

        Example:
            >>> a, b = (AcquilaEvent("tube", "xrayon", uuid=u) for u in (2**63 + 1, float(2**63)))
            >>> a.key == b.key, a.uuid == b.uuid
            (True, False)"""
        if self.anonymous:
            return f"{self.component} {self.command}"
        if isinstance(self.uuid, str) and re.fullmatch(r"-?\d+", self.uuid) is None:
            return self.uuid
        return float(self.uuid)

    def answer(
        self, reply_type: ReplyType, reply: str = "", comp_type: str = ""
    ) -> AcquilaEvent:
        """Make the event that replies to this one.

        `comp_type`: empty: this event's.
        """
        return replace(
            self,
            reply_type=reply_type,
            reply=reply,
            comp_type=comp_type or self.comp_type,
        )


def parse_event(data: bytes | str) -> AcquilaEvent:
    """Parse one event from JSON.

    Missing and null texts become "", numbers and truth values their text; a missing or
    unusable tick count becomes 0, a missing UUID 0. The component is stripped, and runs
    of blanks in the command become one. The reply type is read in either case; empty,
    SEND and SENT are a command. Unknown members are ignored.

    Args:
        data: one JSON object, at most `MAX_BYTES`; control characters inside the JSON's
            texts are allowed.

    Returns:
        The event, with every field checked.

    Raises:
        AcquilaError: not a JSON object with a component and a command, an unknown reply
            type, or a field that is too long or has characters that no event can carry.
    """
    if len(data) > MAX_BYTES:
        raise AcquilaError(f"an event of {len(data)} bytes; allowed: {MAX_BYTES}")
    try:
        content = json.loads(data, strict=False)  # clusters hold control characters
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        raise AcquilaError(f"not a JSON object: {error}") from None
    if not isinstance(content, dict):
        raise AcquilaError(f"not a JSON object but {type(content).__name__}")
    read: dict[str, Any] = {_attribute(name): _text(content, name) for name in FIELDS[:8]}
    read["component"] = read["component"].strip()
    read["command"] = " ".join(read["command"].split())
    if not read["component"] or not read["command"]:
        raise AcquilaError("an event needs a component and a command")
    kind = _REPLY_TYPES.get(read["reply_type"].strip().upper())
    if kind is None:
        raise AcquilaError(
            f"reply type {read['reply_type']!r}; allowed: empty (a command), RCV, FDB, ACK, ERR"
        )
    read["reply_type"] = kind
    read["tick_count"] = _whole(content.get("tick count"))
    read["uuid"] = _uuid(content.get("UUID"))
    return AcquilaEvent(**read)


def format_event(event: AcquilaEvent) -> str:
    """Encode an event as one JSON object with every field, also empty ones; characters are
    not escaped.
    """
    content = {name: getattr(event, _attribute(name)) for name in FIELDS}
    content["reply type"] = event.reply_type.value
    return json.dumps(content, ensure_ascii=False)


class Exchange:
    """Makes the replies to one command: `received` first, `feedback` while it
    lasts, then one end.

    Args:
        command: the command, with its UUID already assigned.
        comp_type: type of the component, for the replies.
        now: real time [s].
    """

    def __init__(
        self, command: AcquilaEvent, comp_type: ComponentType, now: float
    ) -> None:
        """Begin an exchange with a command sent `now`."""
        self.command = command
        self._type = comp_type
        self._last = now

    @property
    def next_feedback(self) -> float:
        """When the next FDB is due [s]."""
        return self._last + FEEDBACK_S

    def received(self, now: float) -> AcquilaEvent:
        """Make the RCV event, the first of every exchange, at time `now` [s]."""
        self._last = now
        return self.command.answer(ReplyType.RCV, "", self._type)

    def feedback(self, text: str, now: float) -> AcquilaEvent:
        """Make an FDB event at time `now` [s], whether one is due or not."""
        self._last = now
        return self.command.answer(ReplyType.FDB, text, self._type)

    def done(self, reply: str = "") -> AcquilaEvent:
        """Make the ACK event, which ends the exchange."""
        return self.command.answer(ReplyType.ACK, reply, self._type)

    def failed(self, message: str) -> AcquilaEvent:
        """Make the ERR event, which ends the exchange."""
        return self.command.answer(ReplyType.ERR, message, self._type)


def _attribute(name: str) -> str:
    return name.lower().replace(" ", "_")


def _text(content: Mapping[str, object], name: str) -> str:
    """Read one text field of an event; missing or null is "", true becomes TRUE.

    Raises AcquilaError: a list or an object, or a text that is too long or that no event
    can carry.
    """
    value = content.get(name, "")
    match value:
        case None:
            return ""
        case str():
            return _plain(name, value)
        case bool():
            return "TRUE" if value else "FALSE"
        case int() | float():
            return _plain(name, repr(value))
    raise AcquilaError(f"{name} must be text, not {type(value).__name__}")


def _plain(name: str, text: str) -> str:
    """Check a field's length and characters, and return the text unchanged.

    Args:
        name: of the field, which has its own limit in `MAX_CHARS`; those of
            `BINARY_FIELDS` may hold anything but surrogates, others no control characters
            either.
        text: the field's value.

    Raises:
        AcquilaError: too long, or characters that no event can carry.
    """
    if len(text) > MAX_CHARS[name]:
        raise AcquilaError(
            f"{name} of {len(text)} characters; allowed: {MAX_CHARS[name]}"
        )
    if (
        character := (_SURROGATE if name in BINARY_FIELDS else _UNPRINTABLE).search(text)
    ) is not None:
        but = "surrogates and control characters"
        if name in BINARY_FIELDS:
            but = "surrogates"
        raise AcquilaError(
            f"{name} holds U+{ord(character[0]):04X} at {character.start()}; "
            f"allowed: anything but {but}"
        )
    return text


def _whole(value: object) -> int:
    """Convert a tick count to an integer; return 0 for anything else than a
    number below 2^64."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value:
        return 0
    return int(value) if abs(value) < 2**64 else 0


def _uuid(value: object) -> int | float | str:
    """Check a UUID, and return it unchanged; 0 for null.

    Raises:
        AcquilaError: another type (truth values too), a number not finite or not below
            `MAX_UUID` in absolute value, or a text that no event can carry.
    """
    if isinstance(value, str):
        return _plain("UUID", value)
    if value is None:
        return 0
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not abs(value) < MAX_UUID
    ):
        raise AcquilaError(f"UUID must be a number below {MAX_UUID:g} or a text")
    return value
