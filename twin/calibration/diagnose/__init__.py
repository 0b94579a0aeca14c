"""Faults of calibration data: a code for programs and a sentence for people."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Severity(enum.Enum):
    """Whether the numbers may be used."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True)
class Finding:
    """Something about the data, with a code for programs and a sentence for people."""

    code: str
    severity: Severity
    text: str

    @property
    def forbids(self) -> bool:
        """The numbers must not be used."""
        return self.severity is Severity.ERROR


def error(code: str, text: str) -> Finding:
    """Make a finding with which the numbers must not be used."""
    return Finding(code, Severity.ERROR, text)


def warning(code: str, text: str) -> Finding:
    """Make a finding with which the numbers may be used."""
    return Finding(code, Severity.WARNING, text)


def listed(finding: Finding | None) -> list[Finding]:
    """Make a list of one finding; empty for `None`."""
    return [] if finding is None else [finding]
