"""Causes of residuals that a scanner, a phantom or a user may exclude, or state the size of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

from flexdt.twin.errors import UnknownNameError

CAUSES: Final[Mapping[str, str]] = {
    "gap": "px",
    "distortion": "px",
    "shape": "1",
    "beads": "mm",
    "arc": "1",
    "rows": "1",
    "angles": "deg",
    "motion": "mm",
    "spots": "px",
}
"""Name of a cause -> unit of its size."""
TOLD_RIVALS: Final = "told"
"""Name of the cause that a told length is quite another, which is stated by its prior."""
CAUSE_MEANINGS: Final[Mapping[str, str]] = {
    "gap": "gaps between tiles of the panel (0: it is in one piece)",
    "distortion": "a panel that distorts its picture smoothly",
    "shape": "a phantom that is stretched or sheared",
    "beads": "beads that are not in their places",
    "arc": "a stage that turns while a frame is exposed, as a part of a step",
    "rows": "a stage that turns while a frame's rows are read, as a part of a step",
    "angles": "a stage whose angles are not as told (an encoder's error)",
    "motion": "a source, sample or panel that moves during the scan",
    "spots": "errors of spots that repeat with the turn",
}
"""Meaning of each in words."""


def require_causes(names: Iterable[str]) -> tuple[str, ...]:
    """Check that every name is a cause, and return them.

    Raises:
        UnknownNameError: the first that is not; lists the allowed names.
    """
    listed = tuple(names)
    for name in listed:
        if name not in CAUSES:
            raise UnknownNameError.among(f"unknown cause {name!r}; allowed", name, CAUSES)
    return listed


def limits_of(
    scanners: Iterable[Mapping[str, float]], given: Mapping[str, float]
) -> dict[str, float]:
    """Return the largest standard deviation that each cause may have, 0: none.

    A cause is limited if all `scanners` limit it, to the widest; a user's `given` counts
    instead.
    """
    every = list(scanners)
    out = {
        name: max(one[name] for one in every)
        for name in CAUSES
        if every and all(name in one for one in every)
    }
    return out | {name: width for name, width in given.items() if name in CAUSES}
