"""Told: a told length (a way, a place, the phantom's scale, the pixel pitch) is quite another.

Positions in pixels hang on the distance of the panel over the pitch, so a distance that is freed
takes up a wrong pitch at no cost. The pitch is as uncertain, then, as what the distance may hide:
the panel is where the machine says, it is elsewhere, or it is there and the pitch is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import softmax

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.table.group import (
    LOG_CHANCE,
    Acts,
    Family,
    Found,
    Known,
    Pitch,
)
from flexdt.twin.calibration.diagnose.table.groups import growth, moving, wobble
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import FitProblem
from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.told_lengths import PANEL_TRAVEL, PHANTOM, PIXEL, TRAVEL

NAME: Final = "told"
WORDS: Final = "a told length that is quite another"
WIDEST: Final = 5e-2
"""Largest standard deviation of a told length over the told one; of a place over the SOD, of the
panel's distance over the SDD."""
DISTANCE: Final = "dD_z"
"""The parameter that takes up a wrong pitch."""
WRONG_CHANCE: Final = 0.1
"""Probability that the distance is so wrong, and that the pitch is, before the scan is seen;
assumed."""
TOLD_SHARE: Final = 0.1
"""Probability of a wrong pitch from which it is told."""


def told_columns(table: Linearised) -> list[str]:
    """List the columns of told lengths that may be quite others: ways, the places of three or
    more scans, the pixel pitch beside a way of the panel, and the phantom's scale beside one
    of them.

    Without a way nothing in the images tells the phantom's scale.
    """
    names = table.problem.layout.names[: table.parameters]
    lengths = [n for n in names if n in (*TRAVEL, *PANEL_TRAVEL)]
    if len(table.scans) > 2:
        lengths += [n for n in names if n.split("@")[0] == "place_z"]
    # Panels at two distances tell the pitch.
    if PIXEL in names and not set(PANEL_TRAVEL).isdisjoint(lengths):
        lengths.append(PIXEL)
    if lengths and PHANTOM in names:
        lengths.append(PHANTOM)
    return lengths


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make each told length once more, with a width of its own."""
    sod = float(np.median(table.problem.poses.sod))
    for name in told_columns(table):
        column = np.array([table.problem.layout.names.index(name)])
        widest = WIDEST * (sod if name.startswith("place") else 1.0)
        yield Family(
            NAME, (f"told {name}",), Acts.COLUMNS, (column,), LOG_CHANCE,
            table.columns[None][:, :, column], widest=widest,
        )  # fmt: skip


def pitch_beside(fit: FitResult, distance_mm: float) -> Pitch | None:
    """Return what a freed distance of the panel leaves open of the pixel pitch.

    Compared are the distance within the scanners' prior, a distance that is off by `WIDEST`
    of the SDD, and a pitch that is off by as much, by how likely each makes the fitted distances.

    Args:
        fit: with distances of the panel free, or with a wider prior than the scanners'.
        distance_mm: standard deviation of the distance by the scanners.

    Returns:
        None where no distance is free or known, or the pitch is exact, or told by a way of the
        panel (`told_columns`).
    """
    problem = fit.problem
    names = problem.layout.names[: problem.layout.parameter_count]
    at = [i for i, name in enumerate(names) if name.split("@")[0] == DISTANCE]
    free = [i for i in at if problem.prior_sigma[i] > distance_mm]
    open_ = PIXEL in names and set(PANEL_TRAVEL).isdisjoint(names)
    if not fit.determined or not free or not distance_mm > 0.0 or not open_:
        return None
    sdd = float(np.median(problem.poses.sdd))
    found = fit.solution.x[free]
    seen = fit.covariance[np.ix_(free, free)]
    widths = np.array([distance_mm, WIDEST * sdd, WIDEST * sdd])
    likely = np.array(
        [_log_normal(found, seen + w**2 * np.eye(len(free))) for w in widths]
    )
    chances = np.log([1.0 - 2.0 * WRONG_CHANCE, WRONG_CHANCE, WRONG_CHANCE])
    share = float(softmax(likely + chances)[2])
    hidden = math.sqrt(float(np.mean(found**2)) + distance_mm**2) / sdd
    return Pitch(share, math.sqrt(share) * hidden, distance_mm)


def _log_normal(x: FloatArray, covariance: FloatArray) -> float:
    """Return the logarithm of a normal density about 0, but for a constant."""
    square = float(x @ np.linalg.solve(covariance, x))
    return -0.5 * (square + float(np.linalg.slogdet(covariance)[1]))


def with_pitch(problem: FitProblem, pitch: Pitch | None) -> FitProblem:
    """Return a problem in which the pixel pitch is as uncertain as what the distance hides."""
    if pitch is None:
        return problem
    widths = problem.prior_sigma.copy()
    at = problem.layout.names.index(PIXEL)
    widths[at] = math.hypot(widths[at], pitch.sigma)
    return replace(problem, prior_sigma=widths)


def at_told_pitch(
    covariance: FloatArray, problem: FitProblem, known: Known
) -> FloatArray:
    """Return the covariance of the geometry's columns (p, p) at the told pitch, where a distance
    hides another: that is open, and nothing that the images show.
    """
    if known.pitch is None:
        return covariance
    at = problem.layout.names.index(PIXEL)
    beside = covariance[at]
    return np.asarray(covariance - np.outer(beside, beside) / covariance[at, at])


def told(found: Found) -> list[Finding]:
    """Tell a pixel pitch that looks like the distance of the panel; other told lengths are
    compared with the images elsewhere, and what moves looks like other pixels in part.
    """
    pitch = found.known.pitch
    moves = any(s.cause in (moving.NAME, growth.NAME, wobble.NAME) for s in found.seen)
    if pitch is None or pitch.share < TOLD_SHARE or moves:
        return []
    poses = found.fit.problem.poses
    pixel = float(np.median(np.linalg.norm(poses.u, axis=1)))
    sdd = float(np.median(poses.sdd))
    estimates = {
        n: e
        for n, e in found.fit.certificate.estimates.items()
        if n.split("@")[0] == DISTANCE
    }
    listed = ", ".join(f"{n} {e.value:.4g} mm" for n, e in estimates.items())
    off = float(np.mean([e.value for e in estimates.values()]))
    return [
        warning(
            CalibrationCode.PIXEL_PITCH,
            f"{listed} is further off than the scanner's +- {pitch.distance_mm:g} mm; pixels "
            f"{pixel * sdd / (sdd + off):.4g} mm wide instead of {pixel:.4g} mm look alike, so "
            "the intervals contain both: measure the panel's distance, or correct the pixel size",
        )
    ]
