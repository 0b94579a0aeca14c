"""A contradiction that was found: its kind, cause, figure, remedy and severity."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from flexdt.twin.caller_warnings import warn_caller
from flexdt.twin.errors import TwinError


class Severity(IntEnum):
    """Reaction of an entry point to a finding."""

    NOTE = 0
    """No reaction; the finding explains others."""
    WARNING = 1
    """Warn and continue."""
    REFUSAL = 2
    """Raise an error."""


KINDS: Final[Mapping[str, str]] = {
    "units": "lengths of one argument are in another unit than those of another",
    "source in the sample": "the focal spot lies in the box around the sample",
    "panel in the sample": "the panel of an exposure stands before or in the sample",
    "sample not seen": "no ray that reaches the panel meets the sample",
    "impossible distances": "distances or pixels that no scanner has",
    "angles in radians": "radians where degrees belong",
    "angles in degrees": "degrees where radians belong",
    "limited arc": "planes that no ray of the scan runs along",
    "laminography": "a beam inclined to the plane of rotation, given to FDK",
    "not finite": "values that are no numbers",
    "Hounsfield": "Hounsfield units or grey values where attenuation belongs",
    "counts": "counts of a detector where line integrals belong",
    "transmission": "transmission where line integrals belong",
    "whole numbers": "line integrals whose fractions are cut off",
    "negative": "line integrals or attenuation of the other sign",
    "scaled": "line integrals that no panel can measure",
    "flats disagree": "flat images of different beams",
    "grid not seen": "voxels beside the field of view",
    "voxel size": "voxels too large for the field of view",
    "angles disagree": "the angles of a file and those of the geometry",
    "order": "the file's angles are the geometry's in another order",
    "pixel size disagrees": "the pixel of a file and that of the geometry",
    "unknown unit": "a figure of a file in a unit that is not known",
    "duplicate": "two files with one number",
    "gap": "a number missing between those of other files",
    "other name": "a file named otherwise than the other images",
    "no data": "images in which nothing was recorded",
}
"""Kind of contradiction -> its meaning."""


@dataclass(frozen=True)
class Finding:
    """A contradiction between two parts of the input.

    Attributes:
        kind: one of `KINDS`.
        cause: the contradiction, with its figure and unit.
        remedy: possible action of the user.
        severity: reaction of an entry point.
        figure: the figure by which it was found, in the unit given in `cause`.
    """

    kind: str
    cause: str
    remedy: str
    severity: Severity
    figure: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise KeyError(self.kind)

    @property
    def said(self) -> str:
        """Cause and remedy in one sentence."""
        return f"{self.cause}; {self.remedy}"


class PlausibilityWarning(UserWarning):
    """A warning about a finding of `examine`."""


def warn_of(
    findings: Iterable[Finding],
    error: type[TwinError] = TwinError,
) -> None:
    """Raise an error for a refusal as `settled` does; otherwise give a Python warning
    (`PlausibilityWarning`, at the caller's line) for each finding that is a warning.

    Args:
        findings: of one entry point.
        error: type of error to raise.
    """
    for doubt in settled(findings, error):
        warn_caller(doubt, PlausibilityWarning)


def settled(
    findings: Iterable[Finding], error: type[TwinError] = TwinError, where: str = ""
) -> list[str]:
    """Raise an error for the first refusal, or return the texts of all warnings.

    Findings of severity NOTE are ignored. Nothing is printed or warned; see `warn_of`.

    Args:
        findings: of one entry point.
        error: type of error to raise.
        where: prefix of each sentence, such as a path; none if empty.

    Returns:
        Texts "cause; remedy" of the warnings, in order.

    Raises:
        TwinError: of the type `error`, with the facts `check` (kind), `asked` (figure)
            and `allowed` (remedy).

    Example:
        >>> doubt = Finding("gap", "no image 17", "give 359 views", Severity.WARNING)
        >>> settled([doubt], where="scans")
        ['scans: no image 17; give 359 views']
    """
    before = f"{where}: " if where else ""
    texts = []
    for one in findings:
        if one.severity is Severity.REFUSAL:
            facts = {"check": one.kind, "asked": one.figure, "allowed": one.remedy}
            raise error(before + one.said, facts)
        if one.severity is Severity.WARNING:
            texts.append(before + one.said)
    return texts
