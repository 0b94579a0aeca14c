"""Priors of a scanner before a scan: a standard deviation for each offset.

An offset that is not estimated is not known exactly. Its prior enters the estimate and
every sigma (`docs/calibration.md`, "Priors"). The widths here are for a scanner without
better ones; machine files and profiles have their own in a table `priors`.

`known` is the one model: calibrations, forecasts, designs of phantoms and batches use it.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping
from typing import Final, Literal

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.fit.problem import SIX, UNSTRAINED, Strain, require_names
from flexdt.twin.calibration.fit.weak_directions import unit_of
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.told_lengths import (
    PANEL_TRAVEL,
    PHANTOM,
    PIXEL,
    PLACES,
    TOLD,
    TRAVEL,
)
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.stated_causes import CAUSES

WAY: Final = 7e-4
"""Standard deviation of a way over its told length: a ball screw of grade 10 is within 210 um in
300 mm (ISO 3408-3), lead screws err by 1e-4 (precision) to 4e-4 (commercial; Dover, Motion Control
Handbook); which screw there is, is assumed."""
PLACE_MM: Final = 0.02
"""Standard deviation of a stage's place [mm]: a sine of 25 um, the periodic error of a commercial
lead screw (Dover, Motion Control Handbook), has 18 um."""
PITCH: Final = 3e-6
"""Standard deviation of the pixel pitch over the told one; assumed: panels are made by
photolithography, to 1 um in 0.3 m. A pitch that is told wrong is another cause
(`groups.told`)."""
OFFSETS: Final[Mapping[str, float]] = {
    "dD_x": 2.0,
    "dD_y": 2.0,
    "dD_z": 1.0,
    "det_roll": 0.3,
    "det_pitch": 0.3,
    "det_yaw": 0.3,
    "axis_tilt_x": 0.1,
    "axis_tilt_z": 0.1,
}
"""Assumed: widths [mm, deg] for a scanner that states none of its own. Left out, so
exactly known, are dS_x and dS_y (the source is the origin of the frame) and angle_scale
(a turn of the stage closes on itself; wrong steps are found separately)."""
ASSUMED: Final[Mapping[str, float]] = {
    **OFFSETS,
    **dict.fromkeys((*TRAVEL, *PANEL_TRAVEL), WAY),
    **dict.fromkeys(PLACES, PLACE_MM),
    PIXEL: PITCH,
}
"""The same with its told lengths (`told_lengths`), but for the phantom's (`known_scale`)."""
FIXED: Final[Mapping[str, float]] = dict.fromkeys(SIX, 0.3)
"""The same for the operator's choices, where they are not estimated: read from motors and
a mount, they are not exact either."""

STRAIN: Final = 1e-3
"""Assumed: standard deviation of the scale, the stretches and the shears of a phantom
that states no tolerance. Printing services sell sintered parts to 0.2 %, two such deviations; cured
resin shrinks by 0.1 to 0.2 % in its first two days."""
MORE_ROOM: Final = 1.5
"""Prior of a told length over the assumed one from which it says that the length may be off."""
NOISE_PX: Final = 0.1
"""Assumed: standard deviation of a detected coordinate in forecasts [px]. Images of a
good exposure determine it twenty times better, which priors hide in the offsets and which
shows in the image."""
NAMED_LOG_ODDS: Final = math.log(1e4)
"""Logarithm of the odds from which a cause is named."""
OPEN_LOG_ODDS: Final = math.log(100.0)
"""Logarithm of the odds against a cause up to which it is left open."""
LOG_CHANCE: Final = math.log(0.1)
"""Logarithm of the probability that a scan has a cause, before it is seen; assumed."""
Given = Mapping[str, float] | Literal["none"]
"""Widths that a user states in place of others [mm, deg, 1]; "none": all is exactly known."""


def known(
    free: Container[str] = SIX,
    given: Given | None = None,
    scanners: Iterable[Mapping[str, float]] = (ASSUMED,),
) -> dict[str, float]:
    """Return standard deviations of every offset before its images are seen.

    Args:
        free: estimated parameters; only a user's own width is a prior of these, not 0.
        given: widths in place of all others; None: none; "none": all else is exact.
        scanners: widths, of which (and of `FIXED`) the widest counts.

    Returns:
        Parameter -> standard deviation [mm, deg, 1]; 0 is exactly known.

    Raises:
        UnknownNameError: a name that is no parameter.
        TwinError: a width that is negative or not finite.

    Example:
        >>> known()["dD_z"], known(given={"dD_z": 0.05})["dD_z"], known(given="none")["dD_z"]
        (1.0, 0.05, 0.0)
    """
    if given == "none":
        return exact(free)
    out = {name: width for name, width in FIXED.items() if name not in free}
    for widths in scanners:
        for name, width in widths.items():
            if name not in free:
                out[name] = max(out.get(name, 0.0), width)
    own = require_widths(given or {})
    out |= {n: w for n, w in own.items() if w > 0 or n not in free}
    return {n: w for n, w in out.items() if n not in CAUSES}


def known_strain(
    model: BeadModel,
    free: Container[str] = SIX,
    given: Given | None = None,
    bead_tolerance_mm: float | None = None,
) -> Strain:
    """Compute standard deviations [1] of the phantom's stretches and shears.

    They are the lesser of `STRAIN` and the beads' tolerance over the phantom's size
    (errors within a tolerance may be alike), no more than a stated scale's.

    Args:
        given: widths that a user states; None: none.
        bead_tolerance_mm: stated in place of the phantom's; None: not stated.

    Returns:
        `UNSTRAINED` if the beads are exact or anywhere, beads and scale are stated, or
            all offsets that are not free are exact.
    """
    stated = exact(free) if given == "none" else given or {}
    if all(stated.get(name) == 0.0 for name in OFFSETS if name not in free):
        return UNSTRAINED
    reach = model.reach
    scale = stated.get(PHANTOM)
    if bead_tolerance_mm is None:
        tolerance = model.tolerance_mm or math.inf
    else:
        tolerance = bead_tolerance_mm
        if not 0.0 < tolerance < reach or scale is not None:
            return UNSTRAINED  # With a stated scale, errors are each bead's own.
    width = min(STRAIN, tolerance / reach) if reach > 0 else STRAIN
    if scale is not None:
        width = min(width, scale)
    return width, width


def known_scale(
    model: BeadModel,
    free: Container[str] = SIX,
    given: Given | None = None,
    bead_tolerance_mm: float | None = None,
) -> float:
    """Compute the standard deviation [1] of the phantom's scale.

    The stated one, else a stretch's (`known_strain`).
    """
    if isinstance(given, Mapping) and PHANTOM in given:
        return given[PHANTOM]
    return known_strain(model, free, given, bead_tolerance_mm)[0]


def gives_room(name: str, width: float) -> bool:
    """Check whether a prior gives a told length more room than is assumed: it says that this
    one may be off."""
    usual = STRAIN if name == PHANTOM else ASSUMED.get(name, math.inf)
    return name in TOLD and width > MORE_ROOM * usual


def with_tolerance(
    model: BeadModel, given: Given | None, bead_tolerance_mm: float | None
) -> tuple[Given | None, float | None]:
    """Add what a phantom's file states of its scale and beads to a user's widths.

    `bead_tolerance_mm`: a user's, which replaces both; None: not stated. Returns widths
    and tolerance, as given where the phantom says nothing.
    """
    stated = model.stated
    if stated is None or bead_tolerance_mm is not None or given == "none":
        return given, bead_tolerance_mm
    if stated.scale is not None:
        given = {PHANTOM: stated.scale, **(given or {})}
    return given, stated.typical_mm


def exact(free: Container[str] = SIX) -> dict[str, float]:
    """Return priors by which all parameters that are not in `free` are exactly known."""
    names = (*SIX, *ASSUMED, PHANTOM)
    return {name: 0.0 for name in names if name not in free}


def prior_widths(
    machine: Machine | None = None, profile: Profile | None = None
) -> dict[str, float]:
    """Return standard deviations of a scanner's offsets [mm, deg, 1].

    The profile's, else the machine's, else the assumed (`ASSUMED`):
    `prior_widths()["dD_z"]` is 1.0.
    """
    out = dict(ASSUMED)
    for stated in (machine, profile):
        out |= {} if stated is None else stated.priors
    return out


def require_widths(priors: Mapping[str, float]) -> Mapping[str, float]:
    """Check that each prior is the standard deviation of a parameter, or of a cause
    (`stated_causes`), and return them as they are.

    Raises:
        UnknownNameError: a name that is neither.
        TwinError: negative, infinite or not a number; names the first.
    """
    require_names(priors, CAUSES)
    for name, width in priors.items():
        if not 0.0 <= width < math.inf:
            unit = CAUSES.get(name) or unit_of(name)
            raise TwinError(
                f"prior of {name}: {width:g} {unit}; allowed: 0 (exactly known) or more",
                {"asked": width, "allowed": ">= 0"},
            )
    return priors
