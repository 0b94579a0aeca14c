"""The vocabulary of Acquila scripts: the commands of each component, and their arguments.

One table serves all components; each command has one function that turns argument text
into the command's own fields or raises `ArgumentError`. `describe` gives each command one
readable line.

A path in a script names a file inside the data set's folder and nothing else: drives,
folders and characters that some file system does not allow are dropped, and the file's
name is left.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from flexdt.twin.machine.camera import Roi
from flexdt.twin.script import commands as c
from flexdt.twin.script.commands import ImageKind
from flexdt.twin.script.problems import ScriptCode

MAX_FRAMES: Final = 1_000_000
MAX_AVERAGES: Final = 100_000
MAX_NUMBER: Final = 1e9
"""Greatest absolute value of an argument; it keeps arithmetic from overflowing."""

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_RESERVED = re.compile(
    r"(?:mag|rot|tra|ver).*|.*(?:obj|tube|det)", re.IGNORECASE | re.DOTALL
)

WAITS: Final[Mapping[str, c.Wait]] = {w.value.lower(): w for w in c.Wait}
Read = Callable[[str, str], dict[str, object]]
_UNSAFE = re.compile(r"[\x00-\x1f\x7f<>:\"|?*\ud800-\udfff]")
_DEVICE = re.compile(r"(?:con|prn|aux|nul|com\d|lpt\d)(?:\..*)?", re.IGNORECASE)
_SUFFIX = re.compile(r".*\.tiff?", re.IGNORECASE | re.DOTALL)
_DARK = re.compile(r"di[_-]?\d*(?:\.tiff?)?", re.IGNORECASE)
_FLAT = re.compile(r"io[_-]?\d*(?:\.tiff?)?", re.IGNORECASE)
MAX_NAME_CHARS = 120
"""Longest file name [characters]."""
_GOES_ON: Final[Mapping[c.Wait, str]] = {
    c.Wait.NO_WAIT: ", goes on at once",
    c.Wait.RCV: ", goes on when received",
}


class ArgumentError(ValueError):
    """An argument that does not read; `code` names the problem and `index` (0
    or 1) the argument."""

    def __init__(
        self, message: str, code: ScriptCode = ScriptCode.VALUE, index: int = 0
    ) -> None:
        """Make the error of the argument at `index` (0 or 1)."""
        super().__init__(message)
        self.code = code
        self.index = index


@dataclass(frozen=True)
class Spec:
    """How a command is read: its type, its reader, and how many arguments it takes at most.

    `free` marks a first argument that may hold spaces, so that in the space-padded form
    it takes all words but a number that belongs to a second argument.
    """

    type: type[c.Command]
    read: Read
    arguments: int
    free: bool = False


def encode(text: str) -> bytes:
    """Encode a script's text as UTF-8; the inverse of `decode` of `parse`.

    Bytes that were not UTF-8 come back; surrogates that never were bytes become "?".
    """
    try:
        return text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:  # a str with lone surrogates that never came from bytes
        return text.encode("utf-8", "replace")


def number(text: str, what: str, index: int = 0) -> float:
    """Read a finite decimal number with a point, such as -1.5 or 2e3.

    Args:
        text: of the argument.
        what: name of the argument, for the message.
        index: place of the argument, 0 or 1.

    Raises:
        ArgumentError: missing, no number, or beyond `MAX_NUMBER`; code VALUE.
    """
    if _NUMBER.fullmatch(text):
        value = float(text)
    else:
        value = math.nan
    if not math.isfinite(value):
        hint = ""
        if "," in text:
            hint = "; decimals are written with a point"
        problem = "it is missing"
        if text:
            problem = f"{shorten(text)!r} is not a number"
        raise ArgumentError(f"{what} must be a number: {problem}{hint}", index=index)
    if abs(value) > MAX_NUMBER:
        raise ArgumentError(
            f"{what} {shorten(text)} is beyond {MAX_NUMBER:g}", index=index
        )
    return value


def positive(text: str, what: str) -> float:
    """Read a number above zero, of argument `what`.

    Raises ArgumentError: another number, or none.
    """
    value = number(text, what)
    if value <= 0.0:
        raise ArgumentError(f"{what} is {shorten(text)}; it must be above 0")
    return value


def not_negative(text: str, what: str) -> float:
    """Read a number from zero up.

    `what`: name of the argument. Raises ArgumentError: a negative number, or none.
    """
    value = number(text, what)
    if value < 0:
        raise ArgumentError(f"{what} is {shorten(text)}; it must not be negative")
    return value


def whole(text: str, what: str, low: int, high: int, index: int = 0) -> int:
    """Read a whole number from `low` to `high`; `1440.000000` is one too.

    Raises ArgumentError for argument `what`, at place `index` (0 or 1).
    """
    value = number(text, what, index)
    if not value.is_integer() or not low <= value <= high:
        raise ArgumentError(
            f"{what} is {shorten(text)}; it must be a whole number from {low} to {high}",
            index=index,
        )
    return int(value)


def shorten(text: str, length: int = 60) -> str:
    """Shorten a text to `length` characters, the last three dots."""
    if len(text) <= length:
        return text
    return text[: length - 3] + "..."


def is_reserved(component: str) -> bool:
    """Return whether the name follows the scanner's naming of motors (mag*, *obj, ...)."""
    return _RESERVED.fullmatch(component) is not None


def own_name(component: str, axes: Iterable[str]) -> str:
    """Return the name of a component as the scanner itself writes it; scripts do not
    distinguish case.

    An unknown one is returned unchanged.

    Args:
        axes: names of the machine's axes.

    Example:
        >>> own_name("CAMERA", ()), own_name("rot", ("X", "Rot")), own_name("Pump", ())
        ('camera', 'Rot', 'Pump')
    """
    known = (*FIXED, *axes)
    return next((name for name in known if name.lower() == component.lower()), component)


def _nothing(_a: str, _b: str) -> dict[str, object]:
    """Read a command without arguments."""
    return {}


def _text(field: str, what: str) -> Read:
    """Make the reader of one required text, as the keyword argument `field`; the second
    argument is ignored.

    The reader raises ArgumentError for an empty text; `what` is its name in the message.
    """

    def read(a: str, _b: str) -> dict[str, object]:
        """Read the first argument as the field; raise ArgumentError if it is empty."""
        if not a:
            raise ArgumentError(f"{what} is missing")
        return {field: a}

    return read


def _keep(a: str, _b: str) -> dict[str, object]:
    """Read TRUE or FALSE, in any case, as the keyword argument `keep`.

    Raises ArgumentError: any other word."""
    if a.upper() not in ("TRUE", "FALSE"):
        raise ArgumentError(f"keep xrayon is {shorten(a)!r}; allowed: TRUE, FALSE")
    return {"keep": a.upper() == "TRUE"}


def _roi(a: str, _b: str) -> dict[str, object]:
    """Read the four edges of a ROI from argument 1, as the keyword argument `roi`.

    They are whole numbers from 0 to 1 000 000, separated by blanks, commas or semicolons;
    their order is not checked.

    Raises:
        ArgumentError: another number of them, or one that is none of these; code ROI.
    """
    parts = a.replace(",", " ").replace(";", " ").split()
    if len(parts) != 4:
        raise ArgumentError(
            f"ROI {shorten(a)!r} has {len(parts)} numbers; allowed: left top right bottom",
            ScriptCode.ROI,
        )
    try:
        return {"roi": Roi(*(whole(p, "ROI edge", 0, 1_000_000) for p in parts))}
    except ArgumentError as error:
        raise ArgumentError(str(error), ScriptCode.ROI) from None


def _sequence(a: str, b: str) -> dict[str, object]:
    """Read prefix (may be empty) and first number (0 to 999 999; 0 if empty) of a
    sequence, as keyword arguments.
    """
    first = 0
    if b:
        first = whole(b, "first number of the sequence", 0, 999_999, 1)
    return {"prefix": a, "first": first}


def _move(a: str, b: str) -> dict[str, object]:
    """Read the target and the trigger position (None if empty) of a move, as keyword
    arguments; ArgumentError for others.
    """
    trigger = None
    if b:
        trigger = number(b, "trigger position", 1)
    return {"target": number(a, "target"), "trigger": trigger}


_path = _text("path", "a path")

_SCANNER: Final[Mapping[str, Spec]] = {
    "pause": Spec(
        c.Pause, lambda a, _: {"duration_ms": not_negative(a, "pause [ms]")}, 1
    ),
    "set output path": Spec(c.SetOutputPath, _path, 1, free=True),
    "set sample info": Spec(
        c.SetSampleInfo, lambda a, _: {"data": encode(a)}, 1, free=True
    ),
    "keep xrayon": Spec(c.KeepXrayOn, _keep, 1),
    "write settings file": Spec(c.WriteSettingsFile, _nothing, 0),
}
_TUBE: Final[Mapping[str, Spec]] = {
    "xrayon": Spec(c.XrayOn, _nothing, 0),
    "xrayoff": Spec(c.XrayOff, _nothing, 0),
    "set kV": Spec(c.SetVoltage, lambda a, _: {"kV": not_negative(a, "kV")}, 1),
    "set power": Spec(
        c.SetPower, lambda a, _: {"power_W": not_negative(a, "power [W]")}, 1
    ),
    "REPEAT UNTIL TRUE status_XReady_get": Spec(c.WaitXrayReady, _nothing, 0),
}
_CAMERA: Final[Mapping[str, Spec]] = {
    "set mode": Spec(c.SetMode, _text("mode", "the camera mode"), 1),
    "set exposure": Spec(
        c.SetExposure, lambda a, _: {"exposure_ms": positive(a, "exposure [ms]")}, 1
    ),
    "set number of frames": Spec(
        c.SetFrames,
        lambda a, _: {"frames": whole(a, "number of frames", 1, MAX_FRAMES)},
        1,
    ),
    "set number of averages": Spec(
        c.SetAverages,
        lambda a, _: {"averages": whole(a, "number of averages", 1, MAX_AVERAGES)},
        1,
    ),
    "set ROI": Spec(c.SetRoi, _roi, 1, free=True),
    "take image": Spec(c.TakeImage, _nothing, 0),
    "save image": Spec(c.SaveImage, _path, 1, free=True),
    "take and save image sequence": Spec(c.TakeSequence, _sequence, 2, free=True),
}
_MOTOR: Final[Mapping[str, Spec]] = {
    "move absolute": Spec(c.MoveAbsolute, _move, 2),
    "set speed": Spec(c.SetSpeed, lambda a, _: {"speed": positive(a, "speed")}, 1),
    "set acceleration": Spec(
        c.SetAcceleration, lambda a, _: {"acceleration": positive(a, "acceleration")}, 1
    ),
}

FIXED: Final[Mapping[str, Mapping[str, Spec]]] = {
    "scanner": _SCANNER,
    "tube": _TUBE,
    "camera": _CAMERA,
}
"""The components that every scanner has, with their commands."""

_BY_KEY = {
    name: {command.lower(): spec for command, spec in table.items()}
    for name, table in {**FIXED, "": _MOTOR}.items()
}


def vocabulary(component: str) -> tuple[str, ...]:
    """List a component's commands, as written."""
    return tuple(FIXED.get(component.lower(), _MOTOR))


def find(component: str, command: str) -> Spec | None:
    """Look up a component's command, case and blanks aside; None if there is none.

    Unknown components are motors, which share one vocabulary.
    """
    table = _BY_KEY.get(component.lower()) or _BY_KEY[""]
    spec = table.get(command.lower())
    if spec is not None:
        return spec
    return table.get(" ".join(command.lower().split()))


def match(component: str, words: list[str]) -> tuple[Spec, int] | None:
    """Find the longest command of `component`, of at most five words, that `words` begin with.

    Returns the command and its number of words, or None.
    """
    for count in range(min(len(words), 5), 0, -1):
        spec = find(component, " ".join(words[:count]))
        if spec is not None:
            return spec, count
    return None


def bare_name(path: str) -> str:
    r"""Return the last part of `path` as a safe file name; may be empty.

    Disallowed characters become `_`; a device's name (con ...) gets one before it.
    """
    name = re.split(r"[\\/]", path)[-1]
    name = _UNSAFE.sub("_", name).strip(" .")[:MAX_NAME_CHARS]
    if _DEVICE.fullmatch(name):
        return f"_{name}"
    return name


def image_name(path: str) -> str | None:
    """Return an image's file name without folder, `.tif` added where missing.

    Made safe by `bare_name`; None without a name.
    """
    name = bare_name(path)
    if not name or name.lower() in ("tif", "tiff"):
        return None
    if _SUFFIX.fullmatch(name):
        return name
    return f"{name}.tif"


def sequence_names(prefix: str, first: int, count: int) -> tuple[str, ...]:
    """List `count` file names from number `first`: prefix, six digits, `.tif`.

    A prefix that ends with a slash is only a folder.
    """
    name = ""
    if not prefix.endswith(("\\", "/")):
        name = bare_name(prefix)
    return tuple([f"{name}{i:06d}.tif" for i in range(first, first + count)])


def kind_of(name: str) -> ImageKind:
    """Return an image's kind by its name: "di" and digits dark, "io" flat."""
    if _DARK.fullmatch(name):
        return "dark"
    if _FLAT.fullmatch(name):
        return "flat"
    return "projection"


def _move_line(k: c.MoveAbsolute) -> str:
    """Describe a move: axis, target, and the trigger position if it waits for that."""
    until = ""
    if k.wait is c.Wait.POS and k.trigger is not None:
        until = f", goes on at {k.trigger:g}"
    return f"{k.component} to {k.target:.10g}{until}"


_LINES: Final[Mapping[type[c.Command], Callable[[Any], str]]] = {
    c.Pause: lambda k: f"pause {k.duration_ms / 1000:g} s",
    c.SetOutputPath: lambda k: (
        f"output path {shorten(k.path)} (the twin chooses the folder)"
    ),
    c.SetSampleInfo: lambda k: "sample info",
    c.KeepXrayOn: lambda k: f"keep X-rays on: {'yes' if k.keep else 'no'}",
    c.WriteSettingsFile: lambda k: "write settings file",
    c.XrayOn: lambda k: "X-rays on",
    c.XrayOff: lambda k: "X-rays off",
    c.SetVoltage: lambda k: f"tube voltage {k.kV:g} kV",
    c.SetPower: lambda k: f"tube power {k.power_W:g} W",
    c.WaitXrayReady: lambda k: "wait until X-rays are ready",
    c.SetMode: lambda k: f"camera mode {shorten(k.mode)}",
    c.SetExposure: lambda k: f"exposure {k.exposure_ms:g} ms",
    c.SetFrames: lambda k: f"number of frames {k.frames}",
    c.SetAverages: lambda k: f"number of averages {k.averages}",
    c.SetRoi: lambda k: f"ROI {k.roi}",
    c.TakeImage: lambda k: "take image",
    c.SaveImage: lambda k: f"save image {bare_name(k.path)}",
    c.TakeSequence: lambda k: f"take and save sequence {bare_name(k.prefix)}",
    c.MoveAbsolute: _move_line,
    c.SetSpeed: lambda k: f"{k.component} speed {k.speed:.10g}",
    c.SetAcceleration: lambda k: f"{k.component} acceleration {k.acceleration:.10g}",
    c.Custom: lambda k: shorten(" ".join((k.component, *k.words))),
}


def describe(command: c.Command) -> str:
    """Describe `command` in one readable line, for reports and progress."""
    return _LINES[type(command)](command) + _GOES_ON.get(command.wait, "")
