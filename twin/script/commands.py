"""The commands of an Acquila script as frozen values, one type for each.

A command holds its arguments and its place in the text; it does not depend on a machine.
Units are the script's: mm, deg, ms, kV, W. `parse` reads commands, `simulated_script`
simulates them.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from typing import Annotated, Any, Literal, dataclass_transform

from pydantic import BeforeValidator, PlainSerializer, PlainValidator

from flexdt.twin.findings import Findings
from flexdt.twin.machine.camera import Roi
from flexdt.twin.values import adapter_of

Binary = Annotated[
    bytes,
    BeforeValidator(
        lambda value: base64.b64decode(value) if isinstance(value, str) else value
    ),
    PlainSerializer(lambda value: base64.b64encode(value).decode(), when_used="json"),
]
"""Bytes; base64 in JSON."""
ImageKind = Literal["dark", "flat", "projection", "preview"]
"""Purpose of an image."""


class Wait(Enum):
    """When the script goes on after a command."""

    ACK = "ACK"
    """When the command is complete."""
    NO_WAIT = "no wait"
    """At once."""
    POS = "POS"
    """When the motor passes the trigger position."""
    RCV = "RCV"
    """When the command has been received: at once, on the twin's clock."""


@dataclass_transform(frozen_default=True, kw_only_default=True)
@dataclass(frozen=True, kw_only=True)
class Command:
    """Fields of all commands: place in the text (from 1), wait, and the two optional times.

    Each class below it is a frozen dataclass too, whose fields are given by name.
    """

    line: int = 0
    column: int = 1
    wait: Wait = Wait.ACK
    timeout_ms: float | None = None
    expected_ms: float | None = None
    """How long the scanner's software expects the command to take."""

    def __init_subclass__(cls) -> None:
        """Make each subclass a frozen dataclass with keyword arguments only."""
        dataclass(frozen=True, kw_only=True)(cls)

    @property
    def arguments(self) -> dict[str, Any]:
        """Fields of the command's own type, name -> value, without those of `Command`."""
        return {
            f.name: getattr(self, f.name) for f in fields(self)[len(fields(Command)) :]
        }


class Pause(Command):
    """`scanner pause`."""

    duration_ms: float


class SetOutputPath(Command):
    """`scanner set output path`; only a remark here, the twin chooses the folder."""

    path: str


class SetSampleInfo(Command):
    """`scanner set sample info`; `data` are the argument's bytes as in the file."""

    data: Binary


class KeepXrayOn(Command):
    """`scanner keep xrayon TRUE|FALSE`."""

    keep: bool


class WriteSettingsFile(Command):
    """`scanner write settings file`: motor readings of this moment go
    to `scan settings.txt`."""


class XrayOn(Command):
    """`tube xrayon`."""


class XrayOff(Command):
    """`tube xrayoff`."""


class TubeSetting(Command):
    """A setting of the tube, by the name it has everywhere."""


class SetVoltage(TubeSetting):
    """`tube set kV`."""

    kV: float


class SetPower(TubeSetting):
    """`tube set power`."""

    power_W: float


class WaitXrayReady(Command):
    """`tube REPEAT UNTIL TRUE status_XReady_get`."""


class CameraSetting(Command):
    """A setting of the camera, by the name it has everywhere."""


class SetMode(CameraSetting):
    """`camera set mode`."""

    mode: str


class SetExposure(CameraSetting):
    """`camera set exposure`."""

    exposure_ms: float


class SetFrames(CameraSetting):
    """`camera set number of frames`."""

    frames: int


class SetAverages(CameraSetting):
    """`camera set number of averages`."""

    averages: int


class SetRoi(CameraSetting):
    """`camera set ROI`: left, top, right, bottom, inclusive, unbinned."""

    roi: Roi


class TakeImage(Command):
    """`camera take image`: one image of exposure x averages, kept in the camera."""


class SaveImage(Command):
    """`camera save image PATH`: the image taken last."""

    path: str


class TakeSequence(Command):
    """`camera take and save image sequence PREFIX FIRST`: as many images as frames are set."""

    prefix: str
    first: int = 0


class MotorCommand(Command):
    """A command to one motor (or virtual axis) called `component`."""

    component: str


class MoveAbsolute(MotorCommand):
    """`AXIS move absolute TARGET [TRIGGER]`; the trigger belongs to the wait POS."""

    target: float
    trigger: float | None = None


class SetSpeed(MotorCommand):
    """`AXIS set speed`, for the moves to come."""

    speed: float


class SetAcceleration(MotorCommand):
    """`AXIS set acceleration`, for the moves to come."""

    acceleration: float


class Custom(Command):
    """A command to a component that is not the scanner's own: allowed, without effect here."""

    component: str
    words: tuple[str, ...]


def _all_commands(cls: type[Command] = Command) -> dict[str, type[Command]]:
    """Map class names to the command types that a script can hold: those without
    subclasses."""
    kinds = cls.__subclasses__()
    if not kinds:
        return {cls.__name__: cls}
    return {name: one for kind in kinds for name, one in _all_commands(kind).items()}


def _to_json(command: Command) -> dict[str, Any]:
    """Serialise a command to a dict of its fields in JSON types, and `command`, the name
    of its type."""
    fields = adapter_of(type(command)).dump_python(command, mode="json")
    return {"command": type(command).__name__, **fields}


def _from_json(value: Any) -> Command:
    """Read a command back from the mapping of `_to_json`; a Command passes unchanged.

    `value` is not changed. Fields that do not fit raise pydantic's ValidationError, a
    ValueError.

    Raises:
        ValueError: no object, or no or an unknown `command`.
    """
    if isinstance(value, Command):
        return value
    if not isinstance(value, Mapping):
        raise ValueError("a command must be an object with its name as 'command'")
    fields = dict(value)
    name = fields.pop("command", None)
    cls = _all_commands().get(name) if isinstance(name, str) else None
    if cls is None:
        raise ValueError("unknown command")
    command: Command = adapter_of(cls).validate_json(json.dumps(fields))
    return command


AnyCommand = Annotated[
    Command, PlainValidator(_from_json), PlainSerializer(_to_json, when_used="json")
]
"""A command of any type; in JSON its fields beside `command`, the name of its type."""


@dataclass(frozen=True)
class Script:
    """A script that has been read.

    Attributes:
        commands: in the order of the text.
        warnings: findings that are not errors; errors are never in here.
        lines: number of lines of the text.
    """

    commands: tuple[Command, ...]
    warnings: Findings = field(default_factory=Findings)
    lines: int = 0

    @classmethod
    def of(cls, commands: Iterable[Command]) -> Script:
        """Make a script from commands in memory, without warnings; `lines` is the
        greatest line of a command, 0 without any."""
        made = tuple(commands)
        return cls(made, Findings(), max((c.line for c in made), default=0))
