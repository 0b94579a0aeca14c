"""The commands of the socket interface: the script's vocabulary and a few more.

`read_command` turns an event into a typed command, or raises an error that lists what is allowed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Final

from flexdt.protocol.acquila import AcquilaEvent, ComponentType
from flexdt.twin.script import commands as c
from flexdt.twin.script import grammar
from flexdt.twin.script.grammar import ArgumentError

MAX_SHOWN: Final = 60


class Refusal(ValueError):
    """A command that cannot be executed; the message becomes the reply of ERR."""


class MoveRelative(c.MotorCommand):
    """`AXIS move relative STEP`."""

    step: float


class StopAll(c.Command):
    """`AXIS stop` and `scanner stop`: all axes brake, as everywhere in the twin."""


class RunScript(c.Command):
    """`scanner run script TEXT [NAME]`."""

    text: str
    name: str


class AbortScript(c.Command):
    """`scanner abort script`."""


class Question(c.Command):
    """`status_..._get`; `path` is where the answer is in the twin's state."""

    path: tuple[str, ...]


Extra = Callable[[AcquilaEvent], c.Command]


def _question(*path: str) -> Extra:
    return lambda event: Question(path=path)


def _about(key: str) -> Extra:
    return lambda event: Question(path=("axes", event.component, key))


def _relative(event: AcquilaEvent) -> c.Command:
    step = grammar.number(event.arg1.strip(), "displacement")
    return MoveRelative(component=event.component, step=step)


def _script(event: AcquilaEvent) -> c.Command:
    if not event.arg1.strip():
        raise ArgumentError("the script's text (argument 1) is missing")
    return RunScript(text=event.arg1, name=event.arg2.strip())


_EXTRA: Final[Mapping[str, Mapping[str, Extra]]] = {
    "tube": {
        "status_XReady_get": _question("tube", "ready"),
        "status_xrayon_get": _question("tube", "on"),
        "status_kV_get": _question("tube", "kV"),
        "status_power_get": _question("tube", "power_W"),
    },
    "camera": {
        "status_mode_get": _question("camera", "mode"),
        "status_exposure_get": _question("camera", "exposure_ms"),
        "status_ROI_get": _question("camera", "roi"),
        "status_averages_get": _question("camera", "averages"),
        "status_frames_get": _question("camera", "frames"),
    },
    "scanner": {
        "stop": lambda event: StopAll(),
        "run script": _script,
        "abort script": lambda event: AbortScript(),
        "status_time_get": _question("time"),
        "status_job_get": _question("job"),
    },
    "": {
        "move relative": _relative,
        "stop": lambda event: StopAll(),
        "status_position_get": _about("position"),
        "status_speed_get": _about("speed"),
        "status_acceleration_get": _about("acceleration"),
        "status_moving_get": _about("moving"),
    },
}
"""Commands beside the script's vocabulary; only status_XReady_get is in any public text."""

_FIXED: Final[dict[str, ComponentType]] = {"tube": "tube", "camera": "camera", "scanner": "other"}


def component_type(component: str, axes: Collection[str]) -> ComponentType | None:
    """The type of `component`, or None if neither scanner nor twin has one of that name."""
    name = grammar.own_name(component, axes)
    if name in _FIXED:
        return _FIXED[name]
    if name in axes or grammar.is_reserved(name):
        return "motor"
    return "other" if name.lower() == "sc" else None


def known_commands(component: str) -> tuple[str, ...]:
    """Every command of `component`."""
    own = _EXTRA.get(component.lower(), _EXTRA[""])
    return (*grammar.vocabulary(component), *own)


def read_command(event: AcquilaEvent, axes: Collection[str]) -> c.Command:
    """The command of an event.

    Args:
        event: from a client.
        axes: motors and virtual axes of the twin.

    Raises:
        Refusal: no such command; the message lists the allowed ones.
    """
    name = grammar.own_name(event.component, axes)
    event = replace(event, component=name)
    if name not in _FIXED and name not in axes:
        allowed = ", ".join((*_FIXED, *axes))
        raise Refusal(f"no component {shown(event.component)}; the twin has: {allowed}")
    try:
        spec = grammar.find(name, event.command)
        if spec is None:
            return _extra(event, name)
        given = (event.arg1.strip(), event.arg2.strip())
        for argument in given[spec.arguments :]:
            if argument:
                raise ArgumentError(
                    f"{shown(argument)} is not expected: the command takes "
                    f"{spec.arguments or 'no'} argument{'s' if spec.arguments > 1 else ''}"
                )
        fields = spec.read(*given)
    except ArgumentError as error:
        raise Refusal(f"{event.component} {event.command}: {error}") from None
    if issubclass(spec.type, c.MotorCommand):
        fields["component"] = name
    return spec.type(**fields)  # type: ignore[arg-type]


def _extra(event: AcquilaEvent, name: str) -> c.Command:
    table = _EXTRA.get(name, _EXTRA[""])
    asked = " ".join(event.command.lower().split())
    for command, make in table.items():
        if command.lower() == asked:
            return make(event)
    allowed = ", ".join(known_commands(name))
    raise Refusal(f"{event.component} does not know {shown(event.command)}; it knows: {allowed}")


def shown(text: str) -> str:
    """Text in quotes, short enough for a message."""
    return repr(grammar.shorten(text, MAX_SHOWN))
