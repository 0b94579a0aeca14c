"""What a calibration may be used for, in a sentence, and the commands that come next."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Final

from flexdt.twin.calibration.fit.certificate import Estimate
from flexdt.twin.calibration.pipeline import Calibration

SHARP_PX: Final = 0.25
"""Largest sigma of the axis column with which a volume is as sharp as its voxels [px]; assumed: a
column that is off by d makes an edge d pixels wider."""
ELSEWHERE: Final = 0.7
"""SOD of a second placement as part of the first's: nearer, where offsets act differently."""

_COMPARE: Final = "flexdt compare {data} --phantom {phantom} --out DIR"
NEXT: Final[Mapping[str, Sequence[str]]] = {
    "wrong_phantom": ("flexdt phantom list", "flexdt calibrate {data} --phantom NAME"),
    "bead_size": ("flexdt phantom list", "flexdt calibrate {data} --phantom NAME"),
    "misfit": ("flexdt calibrate {data} --phantom {phantom} --per-frame dO_x,dO_y,alpha",),
    "angle_scale": ("flexdt calibrate {data} --phantom {phantom} --free {free},angle_scale",),
    "held_parameter": (),  # its own sentence names the parameter to free
}
"""Code of what forbids a result -> what would settle it; else images beside the twin's."""


def verdict_of(result: Calibration, seen: Sequence[Mapping[str, Estimate]]) -> str:
    """One sentence on use, and one on what limits it.

    Args:
        result: of a calibration.
        seen: its `image_quantities`, of each group of frames; empty where it must not be used.
    """
    if not result.identifiable or result.fit is None:
        weak = () if result.fit is None else result.fit.certificate.weak
        why = [f.text for f in result.errors] or list(weak) or ["there is no fit"]
        return f"Not to be used: {why[0]}."
    column = max((q["axis_column"] for q in seen), key=lambda e: e.sigma)
    use = "Safe to reconstruct" if column.sigma <= SHARP_PX else "Too uncertain for a sharp volume"
    if result.fit.panel is not None:
        use += " with this correction, which undoes the panel's distortion"
    if any(f.code == "saturated" for f in result.findings):
        use = "Geometry to be used, images not to be reconstructed (the flat field is saturated)"
    first = f"{use}: the rotation axis is known to {rounded_up(column.sigma)} px."
    lengths = {
        n: e for n, e in result.fit.certificate.estimates.items() if e.asked and e.unit == "mm"
    }
    if not lengths:
        return first
    name, widest = max(lengths.items(), key=lambda item: item[1].sigma)
    second = f" Absolute position: to {widest.sigma:.2g} mm ({name})"
    if _by_priors(widest):
        second += f", limited by what is not known of {', '.join(widest.priors)}"
    return f"{first}{second}."


def next_commands(result: Calibration, data: Sequence[str], phantom: str) -> list[str]:
    """Commands that would tell more, or settle what forbids the result; most useful first."""
    names = " ".join(shlex.quote(one) for one in data)
    estimates = {} if result.fit is None else result.fit.certificate.estimates
    asked = [e for e in estimates.values() if e.asked]
    if result.errors:
        free = ",".join(name for name, e in estimates.items() if e.asked)
        lines = NEXT.get(result.errors[0].code, (_COMPARE,))
        return [line.format(data=names, phantom=shlex.quote(phantom), free=free) for line in lines]
    # Whatever options the calibration had: its own report is used, not another calibration.
    use = [
        "flexdt reconstruct SAMPLE --correction REPORT.json --out volume.tif"
        "  # REPORT.json: of this command with --report"
    ]
    if result.identifiable and not any(_by_priors(e) for e in asked):
        return use
    sod = float(result.scans[0].poses.sod.mean())
    places = f"--position {sod:.0f} --position {ELSEWHERE * sod:.0f}"
    closer = [
        f"flexdt script new --kind calibration {places} --out two-places.txt",
        f"flexdt calibrate PLACE-1 PLACE-2 --phantom {shlex.quote(phantom)}",
    ]
    if not result.identifiable:
        return closer
    return [
        *use,
        *(f"{line}  # for the absolute position, which volumes do not need" for line in closer),
    ]


def _by_priors(estimate: Estimate) -> bool:
    return bool(estimate.priors) and estimate.sigma**2 > 2 * estimate.images**2


def digits(value: float | None, sigma: float | None) -> str:
    """A value to the digits that its sigma leaves."""
    if value is None or sigma is None or not sigma > 0:
        return "-"
    return f"{value:.{min(max(1 - math.floor(math.log10(sigma)), 0), 9)}f}"


def rounded_up(sigma: float) -> str:
    """A sigma to one digit, never a smaller one: 0.012 is 0.02."""
    if not sigma > 0:
        return "0"
    place = math.floor(math.log10(sigma))
    return f"{math.ceil(sigma / 10.0**place) * 10.0**place:.1g}"


def ranges(numbers: Iterable[int]) -> str:
    """Growing numbers in words: 2, 5-9, 12."""
    runs = [
        [n for _, n in run]
        for _, run in groupby(enumerate(sorted(numbers)), lambda pair: pair[1] - pair[0])
    ]
    return ", ".join(str(r[0]) if len(r) == 1 else f"{r[0]}-{r[-1]}" for r in runs)
