"""Angle scale: the frames' angles are off by a factor."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.table.group import Acts, Family, Found, Known
from flexdt.twin.calibration.diagnose.table.linearised import PER_FRAME, Linearised
from flexdt.twin.findings import Finding, error

NAME: Final = "angle scale"
WORDS: Final = "angles that are off by a factor"
CHANCE: Final = math.log(0.01)
"""Logarithm of its odds before the scan is seen; assumed."""


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make a turn that grows with the angle; none where the fit has such a factor."""
    if any(n.split("@")[0] == "angle_scale" for n in table.problem.layout.names):
        return
    turn = table.problem.poses.angle.copy()
    for frames in table.scans:
        turn[frames] -= turn[frames].mean()
    yield Family(
        NAME,
        (NAME,),
        Acts.FRAMES,
        ((("alpha",), None),),
        CHANCE,
        slopes=np.array([[PER_FRAME.index("alpha")]]),
        courses=turn[None, None, :, None],
    )


def told(found: Found) -> list[Finding]:
    """Tell the factor on the angles, as an endpoint error if it is n / (n - 1) or (n - 1) / n:
    an error.
    """
    seen = found.of(NAME)
    if not seen:
        return []
    factor = 1.0 + float(seen[0].weights[0])
    n = len(found.fit.problem.poses)
    known = ""
    for what, text in ((n / (n - 1), f"360 / {n - 1}"), ((n - 1) / n, f"360 / {n}")):
        if abs(factor / what - 1.0) < 0.1 / n:
            known = f": the steps are {text} (endpoint error)"
    return [
        error(
            CalibrationCode.ANGLE_ENDPOINT if known else CalibrationCode.ANGLE_SCALE,
            f"the frame angles are off by a factor {factor:.5f}{known}; correct "
            "them, or free angle_scale",
            free=("angle_scale",),
        )
    ]
