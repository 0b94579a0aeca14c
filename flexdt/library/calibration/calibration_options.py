"""The options of a calibration: one declaration, which `flexdt.calibrate`,
`DataSet.calibrate`, `flexdt calibrate` and `calibration.fit` have in common.

`CalibrationOptions` says what they are, `RULES` with what each has an effect. Names are there
without an import of what computes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, Final, Literal, TypedDict


class CalibrationOptions(TypedDict, total=False):
    """Options of a calibration; one that is left out or None has its default.

    Args:
        free: the parameters to estimate; default: the thesis's six, for unknown markers dO_x.
        per_scan: those of them with a value of their own in every data set.
        per_frame: parameters that may also move during the scan (dO_x, dO_y, dO_z, alpha, dS_x,
            dS_y, dD_x, dD_y, dD_z). The motion is in the geometry of the result's `datasets`,
            not in its `correction`: `found.datasets[0].with_correction(found.correction)` has
            both.
        reading: how the thesis's equation 5.4 is read: with the axis at O + tau ("axis", the
            default), or as R (b - tau) + O ("mount").
        bead_tolerance: beads' places are estimated, too, known to this standard deviation [mm];
            0: they are exact; default: estimated where the residuals require it.
        priors: how well other offsets and told lengths are known, parameter -> standard
            deviation [mm, deg, 1], in place of the machine's and the profile's; 0 is exactly,
            "none" is all exactly. Of a cause (`exclude`) its largest one.
        exclude: causes of residuals that cannot be: gap (the panel is in one piece),
            distortion, shape, beads, arc, rows, angles, motion, spots.
        start: offsets to begin with [mm, deg, 1], about which priors are centered.
        bound: sigma [mm, deg] above which the result is not identifiable; default: 5.
        markers: CSV or NumPy file with the pixels at which markers were seen, or such marks
            themselves: (frame, marker, column, row, sigma), sigma None where it is not known;
            default: they are detected in the images.
        scale: distance of two unknown markers, "A-B=MM" or "A-B=MM+-SIGMA".
        radius: of the spots of beads [px]; default: the phantom's, or any.
    """

    free: Sequence[str] | None
    per_scan: Sequence[str] | None
    per_frame: Sequence[str] | None
    reading: Literal["axis", "mount"] | None
    bead_tolerance: float | None
    priors: Mapping[str, float] | Literal["none"] | None
    exclude: Sequence[str] | None
    start: Mapping[str, float] | None
    bound: float | None
    markers: str | PathLike[str] | Sequence[Any] | None
    scale: str | None
    radius: float | None


ON_THE_WIRE: Final = (
    "free",
    "priors",
    "exclude",
    "bead_tolerance",
    "per_frame",
    "markers",
    "scale",
)
"""Options that `calibration.fit` takes, under these names."""

Condition = Literal["known", "unknown", "images", "one", "several", "geometry", "joint"]

CONDITIONS: Final[Mapping[Condition, str]] = {
    "known": "a phantom that states its beads",
    "unknown": "{phantom} unknown",
    "images": "beads that are found in images, without {markers}",
    "one": "one data set",
    "several": "several data sets",
    "geometry": "{geometry}",
    "joint": "one geometry for all data sets, without {per_scan}",
}
"""With what an option has an effect; in braces names of options, as the door spells them."""


@dataclass(frozen=True)
class Rule:
    """When an option of a calibration has an effect.

    Attributes:
        option: its name in Python, or at the command line alone; "unknown" is the phantom.
        meaning: what it states.
        needs: the condition without which it would have none.
    """

    option: str
    meaning: str
    needs: Condition


RULES: Final = (
    Rule("unknown", "markers of unknown positions are looked for in one scan", "one"),
    Rule("markers", "where beads were seen in a scan", "one"),
    Rule(
        "scale",
        "the distance of two markers; a known phantom states its own size",
        "unknown",
    ),
    Rule("radius", "the size of spots in images", "images"),
    Rule("bead_tolerance", "how well the stated places of beads are known", "known"),
    Rule("per_scan", "values that differ from scan to scan", "several"),
    Rule("shape", "the detector shape that a file of geometry lacks", "geometry"),
    Rule("pixel", "the pixel pitch that a file of geometry lacks", "geometry"),
    Rule("push", "puts one geometry in force", "joint"),
)
"""Every option that does not go with everything else. Python, the command line and the wire
refuse by this table what would have no effect."""


def conditions(
    phantom: object,
    count: int,
    *,
    marked: bool,
    geometry: bool = True,
    joint: bool = True,
) -> set[Condition]:
    """Return which conditions of an option hold.

    Args:
        phantom: as of `flexdt.calibrate`.
        count: number of data sets.
        marked: whether markers are given.
        geometry: whether a file of geometry is.
        joint: whether all data sets have one geometry.
    """
    holds: dict[Condition, bool] = {
        "known": phantom != "unknown",
        "unknown": phantom == "unknown",
        "images": not marked,
        "one": count <= 1,
        "several": count > 1,
        "geometry": geometry,
        "joint": joint,
    }
    return {name for name, held in holds.items() if held}


def misfit(
    given: Collection[str],
    holding: Collection[Condition],
    spelled: Callable[[str], str] = str,
) -> tuple[str, str] | None:
    """Say which option of a calibration would have no effect.

    Args:
        given: names of the options that the user states.
        holding: of `conditions`.
        spelled: how the user's door writes an option.

    Returns:
        The first such option of `RULES`, and the sentence that refuses it; None if all have
        an effect.

    Example:
        >>> misfit({"scale"}, conditions("lego", 1, marked=False))[0]
        'scale'
    """
    for rule in RULES:
        if rule.option in given and rule.needs not in holding:
            words = {
                name: spelled(name)
                for name in ("phantom", "markers", "geometry", "per_scan")
            }
            if rule.option == "unknown":
                said = f"{words['phantom']} unknown"
            else:
                said = spelled(rule.option)
            allowed = CONDITIONS[rule.needs].format(**words)
            return (
                rule.option,
                f"{said}: has no effect ({rule.meaning}); allowed with: {allowed}",
            )
    return None
