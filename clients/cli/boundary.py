"""The single error boundary of the command line: every error becomes lines and an exit code.

Exit codes: 0 done, 1 invalid input, 2 usage, 3 collision or limit, 4 no connection or refused,
5 not identifiable; 130 after Ctrl-C, as shells have it. Never a traceback, unless
FLEXDT_TRACEBACK is set in the environment, which is for developers. Types are looked up only
once something has gone wrong, so the boundary costs no imports.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from flexdt.library.failure import CommandError
from flexdt.message_words import SUGGESTION, nearest_name, problem_words, reason_of

if TYPE_CHECKING:
    import typer

    from flexdt.protocol.rpc_errors import RpcError

DONE: Final = 0
INVALID: Final = 1
USAGE: Final = 2
LIMIT: Final = 3
REFUSED: Final = 4
NOT_IDENTIFIABLE: Final = 5
INTERRUPTED: Final = 130

WIRE_EXIT_CODES: Final[Mapping[object, int]] = {
    -32001: LIMIT,
    -32002: LIMIT,
    -32003: REFUSED,
    -32004: REFUSED,
    -32006: REFUSED,
    -32007: NOT_IDENTIFIABLE,
}
"""Error codes of the wire that have an exit code of their own; all others are invalid input."""

UNREACHABLE: Final = (errno.EADDRINUSE, errno.EADDRNOTAVAIL, errno.ENETUNREACH)


def describe(error: Exception, words: Sequence[str] = ()) -> tuple[tuple[str, ...], int]:
    """Return the lines to print for an error, and its exit code.

    Usage errors exit with USAGE, limits and collisions with LIMIT, refusals of safety and
    lost connections with REFUSED, a calibration that is not identifiable with
    NOT_IDENTIFIABLE, a CommandError with its own code, the rest with INVALID; errors of
    the twin's wire as `wire_code` has it. Connections that fail, time-outs and addresses
    in use count as lost. A file's temporary name is replaced by the named one.

    Args:
        error: of any kind; one that is not expected is called a defect of flexdt.
        words: of the command line; an option that is among them is not suggested.

    Returns:
        Lines that begin with `flexdt:`, and the exit code.
    """
    from flexdt.protocol.rpc_errors import RpcError
    from flexdt.twin import errors as twin

    if callable(
        getattr(error, "format_message", None)
    ):  # typer's usage errors, any version
        return _usage(error, words), USAGE
    if isinstance(error, RpcError):
        return _wire_error(error), wire_code(error)
    lines: Sequence[str] = str(error).splitlines()
    code = INVALID
    match error:
        case CommandError():
            lines = error.lines
            code = error.exit_code
        case twin.LimitError() | twin.CollisionError():
            code = LIMIT
        case ConnectionError() | TimeoutError():
            lines = [_first_line(error)]
            code = REFUSED
        case twin.SafetyError():
            code = REFUSED
        case twin.NotIdentifiableError():
            code = NOT_IDENTIFIABLE
        case twin.TwinError():
            pass
        case OSError() if error.errno in UNREACHABLE:
            lines = [reason_of(error)]
            code = REFUSED
        case OSError():
            where = f"{_named_file(error.filename)}: " if error.filename else ""
            lines = [f"{where}{reason_of(error)}"]
        case UnicodeDecodeError():
            lines = [f"not valid {error.encoding} text: {error.reason}"]
        case _:
            lines = [
                f"internal error: {type(error).__name__}: {_first_line(error)}",
                "this is a defect in flexdt; FLEXDT_TRACEBACK=1 shows where it happened",
            ]
    return tuple(f"flexdt: {line}" for line in lines), code


def _usage(error: Exception, words: Sequence[str]) -> tuple[str, ...]:
    """Return the lines on a wrong use of the command line: the error, and where help is;
    the help page itself if no command was given.

    For an unknown option that may be set elsewhere, this place is added. Two lines: the
    command with the message, and "Try ... --help".
    """
    message = str(error.format_message())  # type: ignore[attr-defined]
    if message.startswith("Usage:"):  # no command was given: the message is the help page
        return tuple(message.splitlines())
    context = getattr(error, "ctx", None)
    if context is not None:
        command = context.command_path
    else:
        command = "flexdt"
    flag = getattr(error, "option_name", None)
    if flag is not None and message.startswith("No such option"):
        message = _unknown_option(command, flag, context, words)
    elif (found := getattr(error.__cause__, "errors", None)) is not None:
        # Newer versions of typer read values by pydantic.
        said = str(getattr(error, "message", ""))
        first = found(include_url=False)[0]
        clause = problem_words(first)
        if first["type"] != "value_error":  # those say what was given
            clause = f"{first['input']!r}; {clause}"
        message = message.replace(said, clause) if said else clause
    return (f"{command}: {message}", f"Try '{command} --help'.")


def _unknown_option(
    command: str, flag: str, context: typer.Context | None, words: Sequence[str]
) -> str:
    """Say that a command has no such option: where it is set instead, or which one is
    meant, of those that were not given.
    """
    from flexdt.clients.cli.settings_file import home_of

    message = f"No such option: {flag}"
    if (home := home_of(command, flag)) is not None:
        return f"{message}; set {home}"
    if context is None:
        return message
    known = [
        name.lstrip("-")
        for parameter in context.command.params
        for name in parameter.opts
        if name.startswith("--")
    ]
    given = {word.partition("=")[0].lstrip("-") for word in words}
    near = nearest_name(flag.lstrip("-"), known, given - {flag.lstrip("-")})
    return message if near is None else f"{message}; {SUGGESTION} --{near}?"


def _wire_error(error: RpcError) -> tuple[str, ...]:
    """Return the lines of a server's error reply: its message, the problems after the
    first (which the message states), and their positions in a script.

    Lines begin with "flexdt: ", but for the positions.
    """
    lines = [error.message]
    if isinstance(
        error.data, Mapping
    ):  # the message states the first parameter's problem
        found = error.data.get("problems", ())
        lines += [f"{p['path']}: {p['message']}" for p in found[1:] if "path" in p]
    return (*(f"flexdt: {line}" for line in lines), *positions(error.data))


def wire_code(error: RpcError) -> int:
    """Return an error reply's exit code: by the problems of a rejected script (-32005).

    Without errors in it, or for an unknown kind, it is INVALID.
    """
    if error.code == -32005 and isinstance(error.data, Sequence):
        wrong = [p for p in error.data if p.get("severity", "error") == "error"]
        return verdict(str(p.get("code")) for p in wrong) or INVALID
    return WIRE_EXIT_CODES.get(error.code, INVALID)


def verdict(errors: Iterable[str]) -> int:
    """Determine the exit code of a script with errors of these codes: invalid wins
    over collision and limit.

    No errors give 0. Collision and limit alone give LIMIT.
    """
    from flexdt.twin.script.problems import ScriptCode

    codes = set(errors)
    if codes - {ScriptCode.LIMIT, ScriptCode.COLLISION}:
        return INVALID
    return LIMIT if codes else DONE


def _named_file(file: object) -> str:
    """Return the file that the user named, where the error names its temporary file."""
    plain = re.sub(r"\.part$", "", str(file))
    return re.sub(r"(^|.*/)\.([^/]+)\.part\.[^./]+$", r"\1\2", plain)


def positions(data: object, file: str = "") -> list[str]:
    """List `file:line:column: severity: message` for the problems in an error's data;
    empty without any. Without a file it is "script".

    Line 0 and column 0 are left out; problems without a line are skipped. `data` is a
    list, or a mapping with `problems` or `errors`.
    """
    if isinstance(data, Mapping):
        data = data.get("problems", data.get("errors"))
    if not isinstance(data, Sequence) or isinstance(data, str):
        return []
    out = []
    for problem in data:
        if isinstance(problem, Mapping) and "message" in problem and "line" in problem:
            place = [str(problem[key]) for key in ("line", "column") if problem.get(key)]
            prefix = ":".join([file or "script", *place])
            if "severity" in problem:
                severity = f"{problem['severity']}: "
            else:
                severity = ""
            out.append(f"{prefix}: {severity}{problem['message']}")
    return out


def _first_line(error: Exception) -> str:
    """Return the first line of an error's message; else its type's name."""
    text = str(error).strip()
    if text:
        return text.splitlines()[0]
    return type(error).__name__
