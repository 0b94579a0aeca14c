"""Does the panel distort its picture? Models of the residuals are compared by what they explain.

Each model has its evidence: the squared residuals that it leaves, and what so many coefficients
would explain of white noise once in ten thousand fits. The model with the best evidence is taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from flexdt.twin.calibration.diagnose import Finding, warning
from flexdt.twin.calibration.fit.fit import RAYLEIGH_MEDIAN, FitResult
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.panel import Border, PanelModel

FIRST_PX = 1.0
"""Standard deviation of the coefficients with which the search for their size begins."""
OUTLIER = 5.0
"""Residuals beyond so many robust standard deviations count as so many."""
SAID_PX, GAP_SAID_PX = 0.015, 0.3
"""Root mean square of the residuals explained, and gap, from which a distortion is said."""
EXPLAINED = 0.5
"""Part of the residuals that a distortion may leave where something seems to move, too."""
LOOSE_BEADS_MM = 0.3
"""Prior of bead positions with which they are compared with a distortion."""
CHANCE = 1e-4
"""Probability with which a model may be taken where there is only noise."""
CUTS = 48
"""Places in each direction at which a border is tried."""

Refit = Callable[..., FitResult]
"""Fit again with something else free: options of `fits_of_scans.refit_scans`."""


def evidence(fit: FitResult, noise: float) -> float:
    """How badly a fit explains its data, in units of their variance.

    Args:
        fit: whose residuals are judged.
        noise: robust spread of the whitened residuals of the best fit among those compared.
    """
    norms = fit.problem.residuals(fit.solution.x)[1][fit.problem.seen]
    bounded = np.minimum(norms, OUTLIER * noise)
    count = 2 * norms.size
    layout = fit.problem.layout
    beads = layout.panel_column - layout.parameter_count
    chance = _by_chance(fit.problem.panel) + (float(chdtri(beads, CHANCE)) if beads else 0.0)
    return count * math.log(float(np.sum(bounded**2))) + chance


def spread(fit: FitResult) -> float:
    """Robust standard deviation of the whitened residuals of every seen position."""
    norms = fit.problem.residuals(fit.solution.x)[1][fit.problem.seen]
    return float(np.median(norms)) / RAYLEIGH_MEDIAN


def better_panel(
    fit: FitResult, refit: Refit, loose: Callable[[], FitResult], misfit_px: float
) -> FitResult:
    """The fit with a distorted panel where nothing else explains the residuals better, else `fit`.

    Args:
        fit: to be improved.
        refit: fits again with another `panel`.
        loose: fits again with loosened priors.
        misfit_px: residual above which a fit explains nothing.
    """
    shape = _shape(fit)
    if shape is None or not spread(fit) > 0:
        return fit
    bent, best = PanelModel(FIRST_PX, shape), fit
    for _ in range(3):
        has = best.problem.panel
        wider = [bent] if has is None else []
        has = has or bent
        if len(has.borders) < 2:
            wider.append(replace(has, borders=(*has.borders, _border(best))))
        trials = [_sized(m, refit) for m in wider if _hinted(best, m)]
        better = min((t for t in trials if t.identifiable), key=partial(_among, [best, *trials]),
                     default=best)  # fmt: skip
        if better is best or _among([best, better], best) <= _among([best, better], better):
            break
        best = better
    left = best.certificate
    # What moves during a scan looks like a distortion in part, and most stays in the residuals.
    moves = (left.shared or left.drifts) and left.rms_px > EXPLAINED * fit.certificate.rms_px
    if best is fit or left.rms_px >= misfit_px or moves:
        return fit
    for rival in (loose, partial(refit, bead_tolerance_mm=LOOSE_BEADS_MM)):
        other = rival()
        if _among([best, other], other) <= _among([best, other], best):
            return fit
    return best


def distorted(fit: FitResult, flat: FitResult) -> Finding | None:
    """What is said of a distortion that was estimated, beside the fit of a flat panel.

    What explains less than detection may err by is in the sigmas and no finding.
    """
    panel, left = fit.panel, fit.certificate.rms_px
    if panel is None:
        return None
    gaps = panel.coefficients[len(panel.coefficients) - 2 * len(panel.model.borders) :]
    explained = math.sqrt(max(flat.certificate.rms_px**2 - left**2, 0.0))
    if explained < SAID_PX and not max(map(abs, gaps), default=0.0) > GAP_SAID_PX:
        return None
    rows, cols = panel.model.shape
    row, column = np.mgrid[0 : rows - 1 : 9j, 0 : cols - 1 : 9j]
    size = float(np.abs(panel.shift(np.stack([column, row], axis=-1))).max())
    tiles = "".join(
        f"; a tile begins at {('column', 'row')[b.axis]} {b.at:.0f}" for b in panel.model.borders
    )
    return warning(
        "panel_distorted",
        f"the panel distorts its picture by up to {size:.2f} px{tiles}: this was estimated along "
        "with the geometry, its uncertainty is in every sigma, and reconstruct undoes it with the "
        "correction",
    )


def _shape(fit: FitResult) -> tuple[int, int] | None:
    """Of the images, if all have the same and there is enough to tell a distortion."""
    sizes = np.unique(2 * fit.problem.origin + 1, axis=0)
    if len(sizes) != 1 or 2 * fit.certificate.used.sum() < 4 * len(PanelModel(1.0, (1, 1)).names):
        return None
    return int(sizes[0, 1]), int(sizes[0, 0])


def _by_chance(panel: PanelModel | None) -> float:
    """What a distortion explains of white noise once in ten thousand fits."""
    if panel is None:
        return 0.0
    # The place of a border is chosen, too, among all columns and rows.
    places = 2 * len(panel.borders) * math.log(sum(panel.shape))
    return float(chdtri(len(panel.names), CHANCE)) + places


def _among(fits: Sequence[FitResult], fit: FitResult) -> float:
    """The evidence of one of some fits."""
    return evidence(fit, min(spread(f) for f in fits))


def _left(fit: FitResult) -> tuple[FloatArray, FloatArray]:
    """Residuals in units of their noise, outliers bounded, and their places; (m, 2) both."""
    problem, noise = fit.problem, spread(fit)
    left = problem.whitened(fit.solution.x)[problem.seen] / noise
    left *= np.minimum(1.0, OUTLIER / np.maximum(np.linalg.norm(left, axis=1), 1e-12))[:, None]
    return left, problem.pixels[problem.seen]


def _hinted(fit: FitResult, model: PanelModel) -> bool:
    """Whether the terms would, to first order, explain more of the residuals than they cost."""
    left, places = _left(fit)
    basis = _basis(fit)
    push, grown = _beyond(basis, left, _rows(fit, model.terms(places)))
    found = np.linalg.lstsq(grown, push, rcond=1e-10)[0]
    rest = float(np.sum((push - grown @ found) ** 2) / np.sum(push**2))
    more = _by_chance(model) - _by_chance(fit.problem.panel)
    return -left.size * math.log(max(rest, 1e-300)) > more


def _border(fit: FitResult) -> Border:
    """Where the border of a tile explains most of the residuals, to first order.

    The order of the positions is the predicted one: a border through measured positions of a bead
    that keeps its row would part them by their noise, and explain that.
    """
    left, places = _left(fit)
    basis = _basis(fit)
    predicted = fit.problem.residuals(fit.solution.x)[0][fit.problem.seen]

    def gain(order: npt.NDArray[np.intp], first: int) -> float:
        beyond = np.zeros(len(order))
        beyond[order[first:]] = 1.0
        push, grown = _beyond(basis, left, _rows(fit, beyond[:, None, None] * np.eye(2)))
        gram = grown.T @ grown
        return float((c := grown.T @ push) @ np.linalg.pinv(gram, rcond=1e-6) @ c)

    best, most = Border(0, 0.0), -1.0
    for axis in (0, 1):
        order = np.argsort(predicted[:, axis], kind="stable")
        low, high = 1, len(order) - 1
        while high - low > 1:  # few are tried, then few between the best one's neighbours
            tried = np.unique(np.linspace(low, high, CUTS).astype(int))
            gains = [gain(order, first) for first in tried]
            k = int(np.argmax(gains))
            if gains[k] > most:
                at = places[order[tried[k] - 1 : tried[k] + 1], axis].mean()
                best, most = Border(axis, float(at)), gains[k]
            if high - low < CUTS:
                break
            low, high = int(tried[max(k - 1, 0)]), int(tried[min(k + 1, len(tried) - 1)])
    return best


def _rows(fit: FitResult, terms: FloatArray) -> FloatArray:
    """Whitened rows (2 m, terms) of shifts (m, 2, terms) at the seen positions."""
    w = fit.problem.whiten[fit.problem.seen]
    across = w[:, :1] * terms[:, 0] + w[:, 1:2] * terms[:, 1]
    return np.stack([across, w[:, 2:] * terms[:, 1]], axis=1).reshape(2 * len(w), -1)


def _basis(fit: FitResult) -> FloatArray:
    """Orthonormal columns of what the fit can take up of the residuals, its priors below."""
    problem = fit.problem
    jacobian = problem.jacobian(fit.solution.x, problem.seen)
    prior = np.diag(np.sqrt(problem.prior_weight(spread(fit))))
    table = np.concatenate(
        [jacobian[np.repeat(problem.seen.ravel(), 2)], prior[np.isfinite(problem.prior_sigma)]]
    )
    size = np.maximum(np.linalg.norm(table, axis=0), 1e-12)
    basis: FloatArray = np.linalg.qr(table / size)[0]
    return basis


def _beyond(basis: FloatArray, left: FloatArray, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals and rows without what the fit takes up of them."""
    held = len(basis) - len(rows)
    table = np.column_stack([left.ravel(), rows])
    table = np.concatenate([table, np.zeros((held, table.shape[1]))])
    table -= basis @ (basis.T @ table)
    return table[:, 0], table[:, 1:]


def _sized(model: PanelModel, refit: Refit) -> FitResult:
    """The fit with coefficients as large as the data show them to be."""
    m = len(model.names) - 2 * len(model.borders)
    for _ in range(6):
        fit = refit(panel=model)
        first = fit.problem.layout.panel_column
        value = fit.solution.x[first : first + m]
        unit = np.diag(fit.certificate.spectrum.unit_covariance)[first : first + m]
        variance = np.minimum(fit.certificate.noise**2 * unit, model.width_px**2)
        fresh = math.sqrt(float(np.mean(value**2 + variance)))
        if not abs(fresh - model.width_px) > 0.1 * model.width_px:
            break
        model = replace(model, width_px=max(fresh, 1e-4))
    # A size estimated from few coefficients may be larger: the intervals have to hold then.
    return refit(panel=replace(model, width_px=model.width_px * math.sqrt(m / chdtri(m, 0.95))))
