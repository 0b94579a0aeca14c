"""Checks of geometry, images, volumes and files for contradictions and impossible values.

Every entry point of the library calls `examine`; the severity of its findings decides
whether the entry point raises an error, warns or does nothing.
"""

from flexdt.twin.plausibility.examination import Operation, examine
from flexdt.twin.plausibility.findings import (
    KINDS,
    Finding,
    PlausibilityWarning,
    Severity,
    settled,
    warn_of,
)

__all__ = [
    "KINDS",
    "Finding",
    "Operation",
    "PlausibilityWarning",
    "Severity",
    "examine",
    "settled",
    "warn_of",
]
