"""Bytes of the scanner's interface to what a follower hears: no socket, no clock."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from flexdt.clients.gateway.vocabulary import MoveRelative, Question, Refusal, read_command
from flexdt.protocol.acquila import AcquilaError, Event, parse_event
from flexdt.twin.following.mirror import Heard, Mirror
from flexdt.twin.script import commands as c
from flexdt.twin.script.grammar import own_name


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


def _read(event: Event, axes: Collection[str], mirror: Mirror) -> tuple[c.Command | None, str]:
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
