"""Faults of calibration data: a code for programs and a sentence for people."""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass


class Severity(enum.Enum):
    """Whether the numbers may be used."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True)
class Finding:
    """Something about the data, with a code for programs and a sentence for people.

    Attributes:
        code: for programs.
        severity: whether the numbers may be used.
        text: for people.
        free: parameters that the text advises to free.
        per_frame: parameters that it advises to give a value in each frame.
    """

    code: str
    severity: Severity
    text: str
    free: tuple[str, ...] = ()
    per_frame: tuple[str, ...] = ()

    @property
    def forbids(self) -> bool:
        """The numbers must not be used."""
        return self.severity is Severity.ERROR


def error(
    code: str, text: str, *, free: Sequence[str] = (), per_frame: Sequence[str] = ()
) -> Finding:
    """Make a finding with which the numbers must not be used."""
    return Finding(code, Severity.ERROR, text, tuple(free), tuple(per_frame))


def warning(code: str, text: str, *, per_frame: Sequence[str] = ()) -> Finding:
    """Make a finding with which the numbers may be used."""
    return Finding(code, Severity.WARNING, text, per_frame=tuple(per_frame))


def listed(finding: Finding | None) -> list[Finding]:
    """Make a list of one finding; empty for `None`."""
    return [] if finding is None else [finding]
