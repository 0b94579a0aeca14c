"""Codes of the contradictions in input, and how an entry point reacts to them."""

from __future__ import annotations

from collections.abc import Iterable

from flexdt.twin.caller_warnings import warn_caller
from flexdt.twin.errors import TwinError
from flexdt.twin.findings import ERROR, WARNING, Finding, FindingCode


class PlausibilityCode(FindingCode):
    """Kinds of contradictions between two parts of the input."""

    UNITS = (
        "units",
        WARNING,
        "lengths of one argument are in another unit than those of another",
    )
    SOURCE_IN_THE_SAMPLE = (
        "source in the sample",
        WARNING,
        "the focal spot lies in the box around the sample",
    )
    PANEL_IN_THE_SAMPLE = (
        "panel in the sample",
        WARNING,
        "the panel of an exposure stands before or in the sample",
    )
    SAMPLE_NOT_SEEN = (
        "sample not seen",
        WARNING,
        "no ray that reaches the panel meets the sample",
    )
    IMPOSSIBLE_DISTANCES = (
        "impossible distances",
        ERROR,
        "distances or pixels that no scanner has",
    )
    ANGLES_IN_RADIANS = "angles in radians", WARNING, "radians where degrees belong"
    ANGLES_IN_DEGREES = "angles in degrees", WARNING, "degrees where radians belong"
    LIMITED_ARC = "limited arc", WARNING, "planes that no ray of the scan runs along"
    LAMINOGRAPHY = (
        "laminography",
        ERROR,
        "a beam inclined to the plane of rotation, given to FDK",
    )
    NOT_FINITE = "not finite", WARNING, "values that are no numbers"
    HOUNSFIELD = (
        "Hounsfield",
        ERROR,
        "Hounsfield units or gray values where attenuation belongs",
    )
    COUNTS = "counts", ERROR, "counts of a detector where line integrals belong"
    TRANSMISSION = "transmission", WARNING, "transmission where line integrals belong"
    WHOLE_NUMBERS = "whole numbers", WARNING, "line integrals whose fractions are cut off"
    NEGATIVE = "negative", WARNING, "line integrals or attenuation of the other sign"
    SCALED = "scaled", ERROR, "line integrals that no panel can measure"
    FLATS_DISAGREE = "flats disagree", WARNING, "flat images of different beams"
    DARKS_DISAGREE = "darks disagree", WARNING, "dark images of different signals"
    DARK_NOT_DARK = (
        "dark not dark",
        WARNING,
        "projections that are darker than the dark image",
    )
    GRID_NOT_SEEN = "grid not seen", ERROR, "voxels beside the field of view"
    VOXEL_SIZE = "voxel size", ERROR, "voxels too large for the field of view"
    ANGLES_DISAGREE = (
        "angles disagree",
        WARNING,
        "the angles of a file and those of the geometry",
    )
    ORDER = "order", WARNING, "the file's angles are the geometry's in another order"
    PIXEL_SIZE_DISAGREES = (
        "pixel size disagrees",
        WARNING,
        "the pixel of a file and that of the geometry",
    )
    UNKNOWN_UNIT = (
        "unknown unit",
        WARNING,
        "a figure of a file in a unit that is not known",
    )
    DUPLICATE = "duplicate", ERROR, "two files with one number"
    GAP = "gap", WARNING, "a number missing between those of other files"
    DENSITY = (
        "density",
        WARNING,
        "a solid as thin as a gas, or a gas as dense as a liquid",
    )
    OTHER_NAME = "other name", WARNING, "a file named otherwise than the other images"


class PlausibilityWarning(UserWarning):
    """A warning about a finding of `examine`."""


def warn_of(
    findings: Iterable[Finding],
    error: type[TwinError] = TwinError,
) -> None:
    """Raise the first error as `settled`, else warn of each warning."""
    for doubt in settled(findings, error):
        warn_caller(doubt, PlausibilityWarning)


def settled(
    findings: Iterable[Finding], error: type[TwinError] = TwinError, where: str = ""
) -> list[str]:
    """Raise an error for the first error, or return the texts of all warnings.

    Notes are ignored; what follows an error is not asked for. Nothing is printed or warned;
    see `warn_of`.

    Args:
        findings: of one entry point.
        error: type of error to raise.
        where: prefix of each sentence, such as a path; none if empty.

    Returns:
        Texts "message; remedy" of the warnings, in order.

    Raises:
        TwinError: of the type `error`, with the facts `check` (code), `asked` (figure)
            and `allowed` (remedy).

    Example:
        >>> from flexdt.twin.findings import warning
        >>> doubt = warning(PlausibilityCode.GAP, "no image 17", "give 359 views")
        >>> settled([doubt], where="scans")
        ['scans: no image 17; give 359 views']
    """
    before = f"{where}: " if where else ""
    texts = []
    for one in findings:
        if one.severity is ERROR:
            facts = {"check": one.code.value, "asked": one.figure, "allowed": one.remedy}
            raise error(before + one.text, facts)
        if one.severity is WARNING:
            texts.append(before + one.text)
    return texts
