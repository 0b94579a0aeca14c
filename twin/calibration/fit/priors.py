"""What is known of a scanner before a scan: a standard deviation for each offset.

An offset that is not estimated is not known exactly. Its prior enters the estimate and every sigma
(`docs/calibration.md`, "Priors"). The widths here are for a scanner of which nothing better is
known; machine files and profiles have their own in a table `priors`.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping
from typing import Final

from flexdt.twin.calibration.fit.problem import SIX, require_names
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.offsets import UNITS
from flexdt.twin.machine.description import Machine, Profile

ASSUMED: Final[Mapping[str, float]] = {
    "dD_x": 2.0, "dD_y": 2.0, "dD_z": 1.0, "det_roll": 0.3, "det_pitch": 0.3, "det_yaw": 0.3,
    "axis_tilt_x": 0.1, "axis_tilt_z": 0.1,
}  # fmt: skip
"""Widths [mm, deg] for a scanner that states none of its own, assumed. Left out, so exactly known,
are dS_x and dS_y (the source is the origin of the frame) and angle_scale (a turn of the stage
closes on itself; wrong steps are looked for by themselves)."""
FIXED: Final[Mapping[str, float]] = dict.fromkeys(SIX, 0.3)
"""The same for what the operator chooses, where it is not to be estimated: read from motors and a
mount, it is not exact either."""


def exact(free: Container[str] = SIX) -> dict[str, float]:
    """Priors that say: everything that is not in `free` is exactly where it is said to be."""
    return {name: 0.0 for name in (*SIX, *ASSUMED) if name not in free}


def prior_widths(
    machine: Machine | None = None, profile: Profile | None = None
) -> dict[str, float]:
    """Standard deviation of each offset of a scanner [mm, deg, 1].

    It is the profile's where that states one, else the machine's, else the assumed one.

    >>> prior_widths()["dD_z"]
    1.0
    """
    out = dict(ASSUMED)
    for stated in (machine, profile):
        out |= {} if stated is None else stated.priors
    return out


def require_widths(priors: Mapping[str, float]) -> Mapping[str, float]:
    """Return `priors` if each is the standard deviation of a parameter.

    Raises:
        UnknownNameError: a name that is no parameter.
        TwinError: negative, infinite or not a number.
    """
    require_names(priors)
    for name, width in priors.items():
        if not 0.0 <= width < math.inf:
            unit = UNITS[name]
            raise TwinError(
                f"prior of {name}: {width:g} {unit}; allowed: 0 (exactly known) or more",
                {"asked": width, "allowed": ">= 0"},
            )
    return priors
