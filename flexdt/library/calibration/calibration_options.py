"""The options of a calibration: one declaration, which `flexdt.calibrate`,
`DataSet.calibrate` and `flexdt calibrate` have in common.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, Literal, TypedDict


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
        start: offsets to begin with [mm, deg, 1], about which priors are centred.
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
