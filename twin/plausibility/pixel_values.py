"""Values of images and volumes: line integrals, counts, transmission, attenuation,
Hounsfield."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.findings import Finding, error, warning
from flexdt.twin.plausibility.contradictions import PlausibilityCode

EDGE_PART: Final = 0.06
"""Share of an image's columns, or rows, that count as its edges."""
OPEN: Final = (0.95, 1.05)
"""Range of transmission of the open beam."""
MIN_BEAM_SHARE: Final = 0.05
"""Least share of pixels that show the open beam."""
MAX_OBJECT_TRANSMISSION: Final = 0.85
"""Largest transmission behind an object, relative to the open beam."""
MAX_BRIGHT_SHARE: Final = 0.02
"""Largest share of pixels that noise makes a fifth brighter than the open beam."""
MAX_LINE_INTEGRAL: Final = 25.0
"""Line integral above which no photon passes: fewer than 1e-10."""
MAX_GIVEN_INTEGRAL: Final = 4 * MAX_LINE_INTEGRAL
"""Line integral above which a scale is doubted; simulations without noise have large ones."""
MAX_COMPUTED_INTEGRAL: Final = 1e9
"""Line integral above which single precision cannot hold products of four of them."""
MIN_NEGATIVE_INTEGRAL: Final = -0.1
"""Line integral below which a beam that is brighter than the flat image explains no sign."""
MAX_POSITIVE_SHARE: Final = 0.1
"""Largest value of negative attenuation, relative to the most negative one."""
TAIL: Final = 1e-3
"""Share of the pixels at either end that single bad ones may be."""
MAX_PER_MM: Final = 200.0
"""Largest attenuation of any element at energies of tubes [1/mm]."""
MIN_ATTENUATION: Final = -200.0
"""Value below which a volume is in Hounsfield units: artifacts never bring attenuation
so low."""


def integral_findings(images: npt.NDArray[Any]) -> Iterator[Finding]:
    """Find images given as line integrals that are none.

    Yields at most one finding, from type and values. Integers: counts above
    `MAX_LINE_INTEGRAL` (refusal), smaller but not all zero "whole numbers" (warning).
    Floats: above `MAX_COMPUTED_INTEGRAL` (refusal), else an open beam at the images' edges
    above `MAX_LINE_INTEGRAL` (counts, refusal) or near 1 with a darker object
    (transmission, warning); else line integrals of the other sign, or above
    `MAX_GIVEN_INTEGRAL` (warnings). Nothing without pixels, and nothing of floats that are
    not finite, which whoever computes with them refuses.

    Args:
        images: some of the scan's, (k, rows, cols).
    """
    values = np.asarray(images)
    if not values.size:
        return
    if values.dtype.kind in "ui" and int(values.max()) > MAX_LINE_INTEGRAL:
        cause = f"line integrals of {values.dtype} up to {values.max()}, as counts have"
        yield error(
            PlausibilityCode.COUNTS, cause, _FROM_COUNTS, figure=float(values.max())
        )
        return
    if values.dtype.kind in "bui" and values.any():
        cause = f"line integrals of {values.dtype} have no fractions"
        remedy = "give floating-point numbers"
        yield warning(
            PlausibilityCode.WHOLE_NUMBERS, cause, remedy, figure=float(values.max())
        )
        return
    largest = float(np.abs(values).max())
    if not np.isfinite(largest):
        return
    if largest > MAX_COMPUTED_INTEGRAL:
        cause = f"line integrals of up to {largest:.4g}, at which no photon passes"
        remedy = (
            "line integrals are -np.log of the transmission; allowed: up to "
            f"{MAX_COMPUTED_INTEGRAL:g}"
        )
        yield error(PlausibilityCode.SCALED, cause, remedy, figure=largest)
        return
    beam = _beam(values)
    if beam is None or not beam > OPEN[0]:
        yield from _range_findings(values)
        return
    darker = float((values < MAX_OBJECT_TRANSMISSION * beam).mean())
    brighter = float((values > 1.2 * beam).mean())
    if beam > MAX_LINE_INTEGRAL and brighter < MAX_BRIGHT_SHARE:
        cause = (
            f"line integrals of {beam:.4g} at the images' edges, less behind the object"
        )
        yield error(PlausibilityCode.COUNTS, cause, _FROM_COUNTS, figure=beam)
    elif beam >= OPEN[1] and float(np.quantile(values, TAIL)) < MIN_NEGATIVE_INTEGRAL:
        lowest = float(np.quantile(values, TAIL))
        cause = (
            f"line integrals of {beam:.3g} at the images' edges and down to {lowest:.3g} between "
            "them, where the beam would be brighter than the open one"
        )
        remedy = "was the log taken twice? they are -np.log of the transmission, once"
        yield warning(PlausibilityCode.NEGATIVE, cause, remedy, figure=lowest)
    elif beam < OPEN[1] and darker > TAIL and brighter < MAX_BRIGHT_SHARE:
        open_share = float(((values > OPEN[0] * beam) & (values < OPEN[1] * beam)).mean())
        lowest = float(np.quantile(values, TAIL))
        if open_share > MIN_BEAM_SHARE and lowest > MIN_NEGATIVE_INTEGRAL:
            cause = (
                f"values are {beam:.3g} at the images' edges and less behind the object, as "
                "transmission is"
            )
            remedy = "line integrals are -np.log of it"
            yield warning(PlausibilityCode.TRANSMISSION, cause, remedy, figure=beam)
    else:
        yield from _range_findings(values)


def _range_findings(values: npt.NDArray[Any]) -> Iterator[Finding]:
    """Find line integrals of the other sign, and those that no panel can measure.

    Yields at most one warning; `TAIL` of the pixels at either end are left out.

    Args:
        values: line integrals, any shape, not empty; nothing is found if one is NaN.
    """
    low, high = (float(x) for x in np.quantile(values, (TAIL, 1.0 - TAIL)))
    if low < MIN_NEGATIVE_INTEGRAL and high < MAX_POSITIVE_SHARE * -low:
        cause = f"line integrals from {low:.4g} to {high:.4g} are negative"
        remedy = "line integrals are -np.log of the transmission, from 0 on"
        yield warning(PlausibilityCode.NEGATIVE, cause, remedy, figure=low)
    elif high > MAX_GIVEN_INTEGRAL:
        cause = f"line integrals of up to {high:.4g}, at which no photon passes"
        remedy = "are they gray values, or scaled?"
        yield warning(PlausibilityCode.SCALED, cause, remedy, figure=high)


_FROM_COUNTS: Final = (
    "give counts with their flat image, as DataSet.from_arrays(counts, flat=)"
)


def _beam(images: npt.NDArray[Any]) -> float | None:
    """Return the mean of the median values at the images' left and right edges (`EDGE_PART` of
    the columns each) if both differ by at most 10 %, else None, also for NaN.

    Args:
        images: (k, rows, cols).
    """
    wide = max(1, int(EDGE_PART * images.shape[2]))
    edges = images[:, :, :wide], images[:, :, -wide:]
    left, right = (float(np.median(edge)) for edge in edges)
    if not abs(left - right) <= 0.1 * max(abs(left), abs(right)):
        return None
    return 0.5 * (left + right)


def volume_findings(values: npt.NDArray[Any]) -> Iterator[Finding]:
    """Find volumes given as attenuation that are none.

    Yields a warning if values are NaN or infinite; then, of the finite ones, a refusal
    below `MIN_ATTENUATION` (Hounsfield units), else a warning above `MAX_PER_MM`, more
    than any element has, or of the other sign throughout. Nothing for types other than
    float or integer, or without voxels.

    Args:
        values: of the voxels (nz, ny, nx) [1/mm].
    """
    data = np.asarray(values)
    if not data.size or data.dtype.kind not in "fiu":
        return
    with np.errstate(invalid="ignore"):
        total = float(data.sum(dtype=np.float64))
    if not np.isfinite(total):
        bad = ~np.isfinite(data)
        if bad.any():
            share = float(bad.mean())
            cause = (
                f"{100 * share:.3g} % of the voxels are no numbers, as beside the field "
                "of view: neither are line integrals through them"
            )
            remedy = "give them a value first, such as np.nan_to_num(volume.data)"
            yield warning(PlausibilityCode.NOT_FINITE, cause, remedy, figure=share)
        if not bad.all():
            low = float(np.nanmin(np.where(bad, np.nan, data)))
        else:
            low = 0.0
        if not bad.all():
            high = float(np.nanmax(np.where(bad, np.nan, data)))
        else:
            high = 0.0
    else:
        low = float(data.min())
        high = float(data.max())
    if low < MIN_ATTENUATION:
        cause = f"attenuation from {low:.5g} to {high:.5g} /mm, as Hounsfield units are"
        remedy = "attenuation is mu_water * (1 + HU / 1000), some 0.02 /mm of water"
        yield error(PlausibilityCode.HOUNSFIELD, cause, remedy, figure=low)
    elif high > MAX_PER_MM:
        cause = f"attenuation of up to {high:.5g} /mm, more than any element has"
        remedy = "gray values need a scale to 1/mm, labels material={1: NAME}"
        yield warning(PlausibilityCode.HOUNSFIELD, cause, remedy, figure=high)
    elif low < 0.0 and high <= MAX_POSITIVE_SHARE * -low:
        cause = f"attenuation from {low:.5g} to {high:.5g} /mm is negative"
        remedy = (
            "is its sign right? of Hounsfield units / 1000 it is mu_water * (1 + value)"
        )
        yield warning(PlausibilityCode.NEGATIVE, cause, remedy, figure=low)
