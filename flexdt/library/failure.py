"""The error of a command that fails: lines for the user and an exit code."""

from __future__ import annotations

from collections.abc import Iterable


class CommandError(Exception):
    """A command fails.

    Attributes:
        lines: to be printed, at least one.
        exit_code: of the table in docs/command-line.md; 1 is invalid input.
    """

    def __init__(self, lines: str | Iterable[str], exit_code: int = 1) -> None:
        self.lines = (lines,) if isinstance(lines, str) else tuple(lines)
        self.exit_code = exit_code
        super().__init__("\n".join(self.lines))
