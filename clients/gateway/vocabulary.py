"""The commands of the socket interface: the script's vocabulary and a few more.

`read_command` turns an event into a typed command, or raises an error
that lists the allowed ones.
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


class StopAll(c.Command):
    """`AXIS stop` and `scanner stop`: all axes brake, as everywhere in the twin."""


class AbortScript(c.Command):
    """`scanner abort script`: the sequence that runs."""


class Question(c.Command):
    """`status_..._get`; `path` is where the answer is in the twin's state."""

    path: tuple[str, ...]


Extra = Callable[[AcquilaEvent], c.Command]


def _question(*path: str) -> Extra:
    return lambda event: Question(path=path)


_EXTRA: Final[Mapping[str, Mapping[str, Extra]]] = {
    "tube": {"status_XReady_get": _question("tube", "ready")},
    "camera": {},
    "scanner": {
        "stop": lambda event: StopAll(),
        "abort script": lambda event: AbortScript(),
        "status_time_get": _question("time"),
    },
    "": {
        "stop": lambda event: StopAll(),
        "status_position_get": lambda event: Question(
            path=("axes", event.component, "position")
        ),
    },
}
"""Commands in addition to the script's vocabulary; only status_XReady_get is in any
public text."""

_FIXED: Final[dict[str, ComponentType]] = {
    "tube": "tube",
    "camera": "camera",
    "scanner": "other",
}


def component_type(component: str, axes: Collection[str]) -> ComponentType | None:
    """Return the type of `component`: a fixed one, "motor" for axes and reserved names,
    "other" for "sc"; None if neither scanner nor twin has it.
    """
    name = grammar.own_name(component, axes)
    if name in _FIXED:
        return _FIXED[name]
    if name in axes or grammar.is_reserved(name):
        return "motor"
    if name.lower() == "sc":
        return "other"
    return None


def known_commands(component: str) -> tuple[str, ...]:
    """List every command of `component`."""
    own = _EXTRA.get(component.lower(), _EXTRA[""])
    return (*grammar.vocabulary(component), *own)


def read_command(event: AcquilaEvent, axes: Collection[str]) -> c.Command:
    """Read the command of an event, also one of the interface alone, such as stop.

    The axis name is read in any letter case. Arguments beyond those of a
    script's command have to be empty; the interface's own take none and ignore them.

    Args:
        event: from a client.
        axes: motors and virtual axes of the twin.

    Raises:
        Refusal: no such component or command, with those allowed, or arguments that are
            wrong, or in excess for a script's command.
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
    """Read a command that the grammar of scripts does not have, case and blanks aside.

    A component without a table of its own (an axis) takes the general one. Raises
    Refusal, listing known commands.
    """
    table = _EXTRA.get(name, _EXTRA[""])
    asked = " ".join(event.command.lower().split())
    for command, make in table.items():
        if command.lower() == asked:
            return make(event)
    allowed = ", ".join(known_commands(name))
    raise Refusal(
        f"{event.component} does not know {shown(event.command)}; it knows: {allowed}"
    )


def shown(text: str) -> str:
    """Quote a text, short enough for a message."""
    return repr(grammar.shorten(text, MAX_SHOWN))
