"""Look at geometry, images, volumes and files for what contradicts itself or cannot be.

Every door of the library asks `examine`; the severity of what it finds decides whether the door
refuses, warns or says nothing.
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
