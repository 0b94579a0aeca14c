"""Zero offsets of a machine from many scans, and how they drift over the scans' dates.

`align` tells the column in which the rotation axis is seen, and texts where the motors stood. A
sideways shift of the axis moves the column in proportion to the magnification, one of the panel
does not: axs_tan, det_tan and axs_tan's drift follow from one weighted least squares, into which
det_tan enters as the texts have it, with its prior. Roll and the source's height get a weighted
line each. Where residuals are larger than their sigmas say, all sigmas grow in proportion (Birge
1932, doi:10.1103/PhysRev.40.207).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from flexdt.twin.calibration.fit.image_quantities import axis_in_image
from flexdt.twin.calibration.fit.priors import prior_widths
from flexdt.twin.commissioning.past_scan import Finding, PastScan, Question, Stand
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses

YEAR_S: Final = 365.25 * 86400.0
FOR_A_LINE: Final = 3
"""Dates that a drift needs: with two there is nothing to check it by."""
FAR_OFF: Final = 4.0
"""Sigmas from which on a scan contradicts the others."""
TOLD: Final = 0.5
"""Share of the prior's width below which scans tell det_tan themselves."""
STEP_MM: Final = 0.01
"""Of the slopes; the column is all but linear in both offsets."""


@dataclass(frozen=True)
class Line:
    """An offset at the last date and its drift, with sigmas [mm or deg, and per year].

    Attributes:
        scans: how many tell it; 0: the texts alone, whose value has no sigma.
        per_year, drift_sigma: None with fewer than three dates.
    """

    value: float
    sigma: float | None = None
    per_year: float | None = None
    drift_sigma: float | None = None
    scans: int = 0


@dataclass(frozen=True)
class ZeroOffsets:
    """The profile that past scans give.

    Attributes:
        profile: at the last date.
        lines: offset -> its value and drift.
        columns: scan -> (measured, fitted, sigma of the fitted) column of the axis [px].
        findings: scans that contradict the others.
        questions: what the scans leave open.
    """

    profile: Profile
    lines: Mapping[str, Line]
    columns: Mapping[str, tuple[float, float, float]]
    findings: tuple[Finding, ...]
    questions: tuple[Question, ...]


def zero_offsets(
    scans: Sequence[tuple[PastScan, Stand]], machine: Machine, usual: Profile
) -> ZeroOffsets:
    """Zero offsets and drift.

    Args:
        scans: the oldest first, those without a date last.
        machine: whose.
        usual: offsets where no text states any.
    """
    stated = [(scan, s) for scan, s in scans if s.stated]
    base = stated[-1][1].profile if stated else usual
    names = ("det_tan", "src_ort", "axs_tan", "c_obj", "c_det", "det_roll_deg")
    lines = {name: Line(getattr(base, name)) for name in names}
    findings, questions = list[Finding](), list[Question]()
    dates = [scan.date for scan, _ in scans if scan.date is not None]
    last = max(dates) if dates else None

    def year(scan: PastScan) -> float | None:
        if scan.date is None or last is None:
            return None
        return (scan.date - last).total_seconds() / YEAR_S

    def fitted(name: str, told: Sequence[tuple[PastScan, float, float]]) -> None:
        """A weighted line through (scan, value, sigma)."""
        sides = [[1.0, t] for t in _times([year(scan) for scan, _, _ in told])]
        values, sigmas = (np.array([each[i] for each in told]) for i in (1, 2))
        fit = _Fit(np.array(sides), values, sigmas, len(told))
        lines[name] = fit.line(0, 1, len(told))
        for (scan, value, _), pull in zip(told, fit.pulls, strict=True):
            if abs(pull) > FAR_OFF:
                findings.append(_far(name, scan.name, value, pull))

    with_axis = [(scan, s, a) for scan, s in scans
                 if (a := scan.aligned) is not None and a.offsets is not None]  # fmt: skip
    dated = [each for each in with_axis if each[0].date is not None]
    if len({scan.date for scan, _, _ in dated}) >= FOR_A_LINE:
        with_axis = dated
    columns = dict[str, tuple[float, float, float]]()
    if with_axis:
        rolls = [(scan, a.parameters["det_roll"]) for scan, _, a in with_axis]
        fitted("det_roll_deg", [(scan, r.value, r.sigma) for scan, r in rolls])
        rows = [
            (scan, s.profile.src_ort - a.offsets.dD_y,
             a.parameters["source_row_px"].sigma * s.camera.pixel_mm(machine.detector.pixels))
            for scan, s, a in with_axis if a.offsets and "source_row_px" in a.parameters
        ]  # fmt: skip
        if rows:
            fitted("src_ort", rows)
        width = prior_widths(machine, usual)["dD_x"]
        seen = [_axis(machine, s, a.parameters["det_roll"].value, base) for _, s, a in with_axis]
        told = [a.parameters["axis_column_px"] for _, _, a in with_axis]
        times = _times([year(scan) for scan, _, _ in with_axis])
        sides = np.array([[d[1], d[1] * t, d[2]] for d, t in zip(seen, times, strict=True)])
        measured = np.array([p.value for p in told])
        rest = measured - np.array([d[0] for d in seen])
        fit = _Fit(np.vstack([sides, [0.0, 0.0, 1.0]]), np.append(rest, 0.0),
                   np.array([*(p.sigma for p in told), width]), len(told))  # fmt: skip
        lines["axs_tan"] = fit.line(0, 1, len(with_axis), base.axs_tan)
        lines["det_tan"] = fit.line(2, None, len(with_axis), base.det_tan)
        sigmas = np.sqrt(np.einsum("ij,jk,ik->i", sides, fit.covariance, sides))
        for i, (scan, _, _) in enumerate(with_axis):
            at = float(measured[i] - rest[i] + sides[i] @ fit.values)
            columns[scan.name] = (float(measured[i]), at, float(sigmas[i]))
            if abs(fit.pulls[i]) > FAR_OFF:
                column = f"axis column {measured[i]:.2f} px, not {at:.2f},"
                findings.append(_far(column, scan.name, None, fit.pulls[i]))
        if (lines["det_tan"].sigma or 0.0) > TOLD * width:
            why = "all scans that tell the axis have about one magnification"
            questions.append(Question("det_tan apart from axs_tan", why, "magnified"))
    else:
        why = "no scan's images tell the axis"
        questions += [Question(name, why, "ordinary") for name in ("axs_tan", "det_roll")]
    if lines["src_ort"].scans == 0:
        questions.append(Question("src_ort", "no scan's images tell the source's row", "beads"))
    for name in ("c_obj", "c_det"):
        why = "an ordinary scan does not tell distances; the texts' value is used"
        questions.append(Question(name, why, "beads"))
    if lines["axs_tan"].per_year is None:
        why = f"it takes scans of {FOR_A_LINE} dates whose images tell the axis"
        questions.append(Question("drift", why, "later"))
    day = "undated" if last is None else f"{last:%Y-%m-%d}"
    told_by = {n: f"{line.scans} scans" if line.scans else "texts" for n, line in lines.items()}
    widths = {"dD_x": "det_tan", "dD_y": "src_ort", "det_roll": "det_roll_deg"}
    made = Profile(
        name=f"commissioned-{day}", machine=machine.name, date="" if last is None else day,
        source="; ".join(f"{n}: {by}" for n, by in told_by.items()),
        priors={p: lines[n].sigma for p, n in widths.items() if lines[n].sigma is not None},
        **{n: round(line.value, 6) for n, line in lines.items()},
    )  # fmt: skip
    return ZeroOffsets(made, lines, columns, tuple(findings), tuple(questions))


def _far(what: str, scan: str, value: float | None, pull: float) -> Finding:
    told = what if value is None else f"{what} {value:.4g}"
    return Finding(what.split()[0], f"{scan} and the other scans",
                   f"{told} is {abs(pull):.1f} sigma from the line of all scans")  # fmt: skip


def _times(years: Sequence[float | None]) -> list[float]:
    """Times for a line; all 0, which makes it a mean, where there are too few dates."""
    enough = len({t for t in years if t is not None}) >= FOR_A_LINE
    return [t if enough and t is not None else 0.0 for t in years]


def _axis(machine: Machine, at: Stand, roll: float, base: Profile) -> tuple[float, float, float]:
    """The axis's column [px] with the offsets of `base`, and its slopes with axs_tan, det_tan."""
    rows, cols = at.camera.shape
    middle = np.array([(cols - 1) / 2, (rows - 1) / 2])

    def column(axs: float, det: float) -> float:
        moved = {"axs_tan": base.axs_tan + axs, "det_tan": base.det_tan + det, "det_roll_deg": roll}
        poses = motor_poses(machine, at.profile.model_copy(update=moved), at.camera, at.positions)
        return float(axis_in_image(poses, NOMINAL, middle)[0])

    here = column(0.0, 0.0)
    return here, (column(STEP_MM, 0.0) - here) / STEP_MM, (column(0.0, STEP_MM) - here) / STEP_MM


class _Fit:
    """Weighted least squares of rows, of which the first `scans` belong to a scan each.

    The scan that contradicts the others most is left out while it does so by `FAR_OFF` sigmas and
    enough remain. `pulls` are the scans' residuals in sigmas, of those left out too; directions of
    which no row says anything stay at 0.
    """

    def __init__(
        self, sides: FloatArray, values: FloatArray, sigmas: FloatArray, scans: int
    ) -> None:
        a, b = sides / sigmas[:, None], values / sigmas
        self.free = np.abs(a).max(axis=0) > 0.0
        a = a[:, self.free]
        kept = np.ones(len(b), dtype=bool)
        while True:
            inverse = np.linalg.inv(a[kept].T @ a[kept])
            rest = b - a @ (inverse @ (a[kept].T @ b[kept]))
            leverage = np.einsum("ij,jk,ik->i", a, inverse, a)
            spread = np.sqrt(np.maximum(np.where(kept, 1.0 - leverage, 1.0 + leverage), 1e-9))
            self.pulls = (rest / spread)[:scans]
            freedom = int(kept.sum()) - a.shape[1]
            far = np.where(kept[:scans], np.abs(self.pulls), 0.0)
            if freedom < 2 or far.max() <= FAR_OFF:
                break
            kept[int(far.argmax())] = False
        birge = max(1.0, float(rest[kept] @ rest[kept]) / freedom) if freedom > 0 else 1.0
        self.values = np.zeros(len(self.free))
        self.values[self.free] = inverse @ (a[kept].T @ b[kept])
        self.covariance = np.zeros((len(self.free),) * 2)
        self.covariance[np.ix_(self.free, self.free)] = birge * inverse

    def line(self, at: int, drift: int | None, scans: int, base: float = 0.0) -> Line:
        """The offset that is column `at`, and its drift."""
        sigma = [float(s) for s in np.sqrt(np.diag(self.covariance))]
        value = base + float(self.values[at])
        if drift is None or not self.free[drift]:
            return Line(value, sigma[at], scans=scans)
        return Line(value, sigma[at], float(self.values[drift]), sigma[drift], scans)
