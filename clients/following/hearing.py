"""From the bytes of the scanner's interface to a follower's messages: no socket, no
clock."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from flexdt.clients.gateway.vocabulary import Question, Refusal, read_command
from flexdt.protocol.acquila import AcquilaError, AcquilaEvent, parse_event
from flexdt.twin.following.mirror import Heard, What
from flexdt.twin.script import commands as c
from flexdt.twin.script.grammar import own_name


def heard(data: bytes, axes: Collection[str], stamp: str, late_s: float = 0.0) -> Heard:
    """Decode one message of the scanner to a follower's message, with its command or
    question.

    A prefix before the first "{" is skipped; bytes that are no event in UTF-8 are tried
    as Latin-1. Components get the axis's own spelling; no reply type becomes "SEND".
    `stamp`: time of day, hh:mm:ss.mmm; `late_s`: it may have come so much earlier [s].
    Raises AcquilaError: no event.
    """
    data = data[max(0, data.find(b"{")) :]
    try:
        event = parse_event(data)
    except AcquilaError:
        event = parse_event(data.decode("latin-1"))
    event = replace(event, component=own_name(event.component, axes))
    command, asks = _read(event, axes)
    words = (event.component, event.command, event.arg1, event.arg2)
    what: What = event.reply_type.value or "SEND"  # type: ignore[assignment]
    tick = event.tick_count
    reply = event.reply
    return Heard(event.key, what, words, command, reply, asks, stamp, tick, late_s)


def _read(event: AcquilaEvent, axes: Collection[str]) -> tuple[c.Command | None, str]:
    """Read the typed command, or the name of a question: (command, ""), (None, name).

    (None, "") for any other or refused command.
    """
    try:
        command = read_command(event, axes)
    except Refusal:
        return None, ""
    if isinstance(command, Question):
        return None, command.path[-1]
    return (command if type(command).__module__ == c.__name__ else None), ""
