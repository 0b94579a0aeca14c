"""Problems of a script, as values: severity, code, place, message.

Every reader of a script collects problems and continues, so that all are reported at
once. `ScriptError` carries them for callers that need a correct script.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal

from flexdt.twin.errors import TwinError

Severity = Literal["error", "warning"]


@dataclass(frozen=True)
class ScriptProblem:
    """One finding. `line` and `column` count from 1; line 0 is the entire script."""

    severity: Severity
    code: str
    line: int
    column: int
    message: str

    def to_dict(self) -> dict[str, object]:
        """Return the JSON form of `flexdt check`."""
        return asdict(self)

    @property
    def where_and_what(self) -> str:
        """Line, column and message, without the severity."""
        return f"line {self.line}, column {self.column}: {self.message}"

    def __str__(self) -> str:
        """Format as "line, column: severity: message"."""
        return f"line {self.line}, column {self.column}: {self.severity}: {self.message}"


class WithProblems:
    """Base of values that have `problems`: the errors and the warnings among them."""

    problems: tuple[ScriptProblem, ...]

    @property
    def errors(self) -> tuple[ScriptProblem, ...]:
        """Problems that forbid running the script."""
        return tuple(p for p in self.problems if p.severity == "error")

    @property
    def warnings(self) -> tuple[ScriptProblem, ...]:
        """Problems that do not forbid running the script."""
        return tuple(p for p in self.problems if p.severity == "warning")


class ScriptError(TwinError):
    """A script that does not hold; `problems` has every error and warning, in line order."""

    def __init__(self, problems: Iterable[ScriptProblem]) -> None:
        """Make the error; the message lists the errors, `data` has all problems, in line order."""
        self.problems = in_order(problems)
        errors = [p for p in self.problems if p.severity == "error"]
        count = f"{len(errors)} error{'s' if len(errors) != 1 else ''}"
        text = "\n".join(str(p) for p in errors)
        documents = [p.to_dict() for p in self.problems]
        super().__init__(f"the script has {count}:\n{text}", {"problems": documents})


class Findings:
    """Collects problems; each is about the command at `place`, its line and column."""

    def __init__(self) -> None:
        """Begin without problems, at line 0, column 1."""
        self.problems: list[ScriptProblem] = []
        self.place = (0, 1)

    def error(self, code: str, message: str) -> None:
        """Add an error."""
        self.problems.append(ScriptProblem("error", code, *self.place, message))

    def warn(self, code: str, message: str) -> None:
        """Add a warning."""
        self.problems.append(ScriptProblem("warning", code, *self.place, message))


def in_order(problems: Iterable[ScriptProblem]) -> tuple[ScriptProblem, ...]:
    """Sort problems by line and column; those of one place keep their order."""
    return tuple(sorted(problems, key=lambda p: (p.line, p.column)))
