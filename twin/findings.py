"""What a check found, for all rooms alike: a code for programs, a sentence for people.

Each room lists its codes in one enum (a `FindingCode`), and makes its findings with them. What
distinguishes rooms is data of a finding (place, figure, advice), so that none has a type of its
own. Readers choose findings by members of these enums, never by the text of a code.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Self


class Severity(StrEnum):
    """What a finding forbids."""

    NOTE = "note"
    """Nothing; it explains other findings."""
    WARNING = "warning"
    """Nothing; but a person should know it."""
    ERROR = "error"
    """The use of the input, or of the result."""


ERROR: Final = Severity.ERROR
WARNING: Final = Severity.WARNING


class FindingCode(StrEnum):
    """Base of a room's codes; a member is its text, which files and the wire contain.

    A member is declared as (text, gravest severity, meaning), and then the members that it
    explains, if there are any; those stand above it.

    Attributes:
        gravest: greatest severity of its findings.
        meaning: of the code, in a few words.
        explains: codes whose findings at the same place it makes superfluous.

    Example:
        >>> class Weather(FindingCode):
        ...     WET = "wet", WARNING, "the street is wet"
        ...     RAIN = "rain", WARNING, "it rains", WET
        >>> Weather.RAIN.explains, Weather("wet").meaning
        (frozenset({<Weather.WET: 'wet'>}), 'the street is wet')
    """

    gravest: Severity
    meaning: str
    explains: frozenset[Self]

    def __new__(
        cls, text: str, gravest: Severity, meaning: str, *explains: object
    ) -> Self:
        """Make a member; in the body of an enum, others are the tuples that declare them."""
        member = str.__new__(cls, text)
        member._value_ = text
        member.gravest = gravest
        member.meaning = meaning
        texts = {other[0] for other in explains if isinstance(other, tuple)}
        member.explains = frozenset(above for above in cls if above.value in texts)
        return member


@dataclass(frozen=True, order=True)
class Place:
    """The part of the input that a finding is about.

    Attributes:
        line: of a script, from 1; 0 is the entire script.
        column: of the line, from 1.
        name: of a file, a scan or a quantity, where there are no lines.
    """

    line: int = 0
    column: int = 1
    name: str = ""

    def __str__(self) -> str:
        """Return the name, or "line L, column C"."""
        return self.name or f"line {self.line}, column {self.column}"


@dataclass(frozen=True)
class Advice:
    """Arguments of a calibration that would settle a finding.

    Attributes:
        free: parameters to estimate, too.
        per_frame: parameters to give a value in each frame.
        priors: standard deviations of which one settles it, (parameter, value).
    """

    free: tuple[str, ...] = ()
    per_frame: tuple[str, ...] = ()
    priors: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Finding:
    """Something that a check found.

    Attributes:
        code: of the room's enum.
        severity: what it forbids.
        message: the fact, with its figure and unit.
        remedy: what the user may do; empty where `message` says it, or nothing helps.
        place: where it is; None for all of the input.
        figure: by which it was found, in the unit given in `message`.
        advice: arguments that would settle it.
    """

    code: FindingCode
    severity: Severity
    message: str
    remedy: str = ""
    place: Place | None = None
    figure: float = 0.0
    advice: Advice = Advice()

    def __post_init__(self) -> None:
        """Check that the code is a member of an enum: the wrong text would match nothing."""
        if not isinstance(self.code, FindingCode):
            raise TypeError(f"code is {self.code!r}; allowed: members of a FindingCode")

    @property
    def text(self) -> str:
        """Message and remedy in one sentence."""
        return f"{self.message}; {self.remedy}" if self.remedy else self.message

    @property
    def forbids(self) -> bool:
        """It is an error."""
        return self.severity is ERROR

    @property
    def line(self) -> int:
        """Line of the script, from 1; 0 for all."""
        return self.place.line if self.place else 0

    @property
    def column(self) -> int:
        """Column of the line, from 1."""
        return self.place.column if self.place else 1

    @property
    def placed_text(self) -> str:
        """The place, if there is one, and the text."""
        return f"{self.place}: {self.text}" if self.place else self.text

    def to_dict(self) -> dict[str, object]:
        """Return the JSON form of files and of the wire: of a finding with a place that of
        `flexdt check` (severity, code, line, column, message), else that of `flexdt calibrate`
        (code, severity, text).
        """
        code, severity = self.code.value, self.severity.value
        if self.place is None:
            return {"code": code, "severity": severity, "text": self.text}
        return {
            "severity": severity,
            "code": code,
            "line": self.line,
            "column": self.column,
            "message": self.text,
        }

    def __str__(self) -> str:
        """Format as "place: severity: text"."""
        where = f"{self.place}: " if self.place else ""
        return f"{where}{self.severity}: {self.text}"


def error(
    code: FindingCode,
    message: str,
    remedy: str = "",
    *,
    place: Place | None = None,
    figure: float = 0.0,
    free: Iterable[str] = (),
    per_frame: Iterable[str] = (),
    priors: Iterable[tuple[str, float]] = (),
) -> Finding:
    """Make an error; arguments as those of `Finding` and `Advice`."""
    advice = Advice(tuple(free), tuple(per_frame), tuple(priors))
    return Finding(code, ERROR, message, remedy, place, figure, advice)


def warning(
    code: FindingCode,
    message: str,
    remedy: str = "",
    *,
    place: Place | None = None,
    figure: float = 0.0,
    free: Iterable[str] = (),
    per_frame: Iterable[str] = (),
) -> Finding:
    """Make a warning; arguments as those of `Finding` and `Advice`."""
    advice = Advice(tuple(free), tuple(per_frame))
    return Finding(code, WARNING, message, remedy, place, figure, advice)


class Findings(tuple[Finding, ...]):
    """Findings in order, unchangeable; a tuple with names for its parts.

    Example:
        >>> class Street(FindingCode):
        ...     WET = "wet", WARNING, "the street is wet"
        ...     RAIN = "rain", WARNING, "it rains", WET
        >>> found = Findings(Finding(c, c.gravest, c.meaning) for c in Street)
        >>> found
        <Findings: 0 errors, 2 warnings: wet, rain>
        >>> found.reduced(), found.without(Street.RAIN).texts
        (<Findings: 0 errors, 1 warnings: rain>, ['the street is wet'])
    """

    __slots__ = ()

    @property
    def errors(self) -> Findings:
        """Those that forbid something."""
        return self._of_severity(ERROR)

    @property
    def warnings(self) -> Findings:
        """Those that a person should know, and that forbid nothing."""
        return self._of_severity(WARNING)

    @property
    def notes(self) -> Findings:
        """Those that only explain others."""
        return self._of_severity(Severity.NOTE)

    @property
    def texts(self) -> list[str]:
        """The text of each."""
        return [one.text for one in self]

    def of(self, *codes: FindingCode) -> Findings:
        """Keep the findings of some codes."""
        return Findings(one for one in self if one.code in codes)

    def without(self, *codes: FindingCode) -> Findings:
        """Leave out the findings of some codes."""
        return Findings(one for one in self if one.code not in codes)

    def unexplained_by(self, others: Iterable[Finding]) -> Findings:
        """Leave out the findings that one of `others` at the same place explains (`explains`
        of its code)."""
        known = {(code, one.place) for one in others for code in one.code.explains}
        return Findings(one for one in self if (one.code, one.place) not in known)

    def reduced(self) -> Findings:
        """Leave out the findings that another one of them explains."""
        return self.unexplained_by(self)

    def and_also(self, more: Iterable[Finding]) -> Findings:
        """Append findings."""
        return Findings((*self, *more))

    def by_place(self) -> Findings:
        """Sort by line and column; those of one place keep their order."""
        return Findings(sorted(self, key=lambda one: (one.line, one.column)))

    def worst_first(self) -> Findings:
        """Sort errors before all others; each part keeps its order."""
        return Findings(sorted(self, key=lambda one: not one.forbids))

    def _of_severity(self, severity: Severity) -> Findings:
        """Keep the findings of a severity."""
        return Findings(one for one in self if one.severity is severity)

    def __repr__(self) -> str:
        """Format as one line: numbers of errors and warnings, and the codes in order."""
        codes = ", ".join(one.code for one in self)
        counts = f"{len(self.errors)} errors, {len(self.warnings)} warnings"
        return f"<Findings: {counts}{codes and f': {codes}'}>"
