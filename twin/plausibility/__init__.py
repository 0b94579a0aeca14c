"""Checks of geometry, images, volumes and files for contradictions and impossible values.

Every entry point of the library calls `examine`; the severity of its findings decides
whether the entry point raises an error, warns or does nothing.
"""

from flexdt.twin.plausibility.contradictions import (
    PlausibilityCode,
    PlausibilityWarning,
    settled,
    warn_of,
)
from flexdt.twin.plausibility.examination import Operation, examine

__all__ = [
    "Operation",
    "PlausibilityCode",
    "PlausibilityWarning",
    "examine",
    "settled",
    "warn_of",
]
