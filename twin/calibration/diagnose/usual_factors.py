"""Factors by which lengths are usually wrong, and why."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

SAME_SCALE: Final = math.log(1.25)
"""Logarithm of the ratio of two lengths that may be the same in a nominal geometry, whose SOD may
be off by centimeters."""
LIKELY_SCALE: Final = 0.5 * SAME_SCALE
"""The same, of two that are likely to be: at half of what may be. So 1.6 is no 2."""
OF_LENGTHS: Final[Mapping[float, str]] = {
    10.0: "lengths of the phantom's file are in cm, not in mm",
    25.4: "lengths of the phantom's file are in inches, not in mm",
    1000.0: "lengths of the phantom's file are in m, not in mm",
    0.1: "lengths of the phantom's file were taken for cm but are in mm",
    1 / 25.4: "lengths of the phantom's file were taken for inches but are in mm",
    0.5: "the camera joined 2 x 2 pixels (binning), so they are twice as large as stated",
    0.25: "the camera joined 4 x 4 pixels (binning), so they are four times as large as stated",
    2.0: "the pixels are half as large as stated (a binning that was stated but not used)",
}
"""Length seen over length stated -> its usual reason."""
OF_RADII: Final[Mapping[float, str]] = {
    0.5: "the phantom's file has diameters where it asks for radii",
    2.0: "the phantom's file has half the radii",
}
"""Radius seen over radius stated, where the places are right -> its usual reason."""


def usual_reason(
    ratio: float, reasons: Mapping[float, str], within: float = SAME_SCALE
) -> str:
    """Return the reason whose factor is nearest to a ratio; "" if none is near.

    `within`: difference of logarithms that is near.

    Example:
        >>> usual_reason(0.52, OF_RADII)
        "the phantom's file has diameters where it asks for radii"
    """
    off = {factor: abs(math.log(ratio / factor)) for factor in reasons}
    factor = min(off, key=off.__getitem__)
    return reasons[factor] if off[factor] < within else ""
