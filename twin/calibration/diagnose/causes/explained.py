"""Causes of the residuals: the most likely ones are fitted, the others widen the sigmas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.causes.candidates import Candidates
from flexdt.twin.calibration.diagnose.causes.cause import (
    MOTION_OF,
    RIVALS,
    SHAPES,
    Choice,
    Found,
    Known,
    Refit,
    border_name,
)
from flexdt.twin.calibration.diagnose.causes.columns import image_shape
from flexdt.twin.calibration.diagnose.causes.left_open import widened_by_causes
from flexdt.twin.calibration.fit.evidence import NAMED_LOG_ODDS, OPEN_LOG_ODDS
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.geometry.panel import Border, PanelModel

LEAST_BEADS: Final = 3
"""Number of beads that a calibration needs."""
MOST_ROUNDS: Final = 4
MOST_BORDERS: Final = 2
NO_PANEL_PX: Final = 1e-4
"""Width of the polynomials at a tile's border without other distortion [px]."""
REPEATING_FRAMES: Final = 16
"""Least number of frames in which errors that repeat with the turn are told from others."""
MAX_REST_SHARE: Final = 0.5
"""Part of the residuals that other causes may leave where something seems to move, too."""


def explained_by_causes(
    fit: FitResult, known: Known, refit: Refit, left_out: Sequence[int] = ()
) -> tuple[FitResult, Found]:
    """Fit with the most likely causes as columns, and average sigmas over those left
    open.

    Causes, up to `MOST_BORDERS` borders between panel tiles among them, are searched
    again after each new fit, until they stay the same or for `MOST_ROUNDS`. Residuals that
    a fit, and what moves, leave correlated from frame to frame count by their correlation
    length, so that slow errors are no evidence of slow causes.

    Args:
        fit: of the geometry, the phantom's strain with its prior.
        known: statements on the phantom and the positions.
        refit: fits again with `strain`, `arc`, `rows`, `bead_tolerance_mm` and `panel`.
        left_out: beads that are elsewhere; where some turn out to be, the causes of the
            other beads' residuals are searched anew.

    Returns:
        The new fit and the causes that were found; as `_undetermined` says if a fit with
        them is not determined; `fit` with the odds, and `Found.beside_motion`, if the
        object moves and more than `MAX_REST_SHARE` of the residuals is left.
    """
    first = fit
    borders: tuple[Border, ...] = ()
    applied: tuple[object, ...] = ()
    before: Mapping[str, float] = {}
    # Before a cause is fitted, it correlates the residuals itself.
    alike = 1.0
    for _ in range(MOST_ROUNDS):
        candidates, choice = _searched(fit, known, borders, alike, before, left_out)
        before = candidates.widths(choice)
        borders = candidates.chosen_borders(choice)
        options = _options(candidates, choice, borders)
        chosen = tuple(options.values())
        settled = chosen == applied or not (applied or any(chosen))
        # What moves is no column of the fit, and correlates its residuals itself.
        moves = _moves(before)
        beside = candidates.correlated(choice) if moves else None
        if settled and alike == (beside or fit.certificate.enlargement):
            break
        if not settled:
            applied = chosen
            better = refit(**options)
            if not better.determined:
                return _undetermined(first, better, candidates, choice, refit)
            fit = better
        alike = beside or fit.certificate.enlargement
    odds = candidates.odds()
    # What moves looks like other causes in part, and most of it stays in the residuals.
    if moves and fit.certificate.rms_px > MAX_REST_SHARE * first.certificate.rms_px:
        return _beside_motion(first, fit, candidates, choice, refit)
    names = _applied(candidates, choice)
    if "beads" in names and not left_out:
        lost = lost_beads(first)
        left = len(first.problem.model) - len(lost)
        if lost and left >= LEAST_BEADS and candidates.elsewhere(choice, lost):
            return explained_by_causes(first, known, refit, lost)
    found = Found(odds, names, _open(odds), candidates.strain(choice))
    return _stated(fit, candidates, choice, borders, refit), found


def _moves(widths: Mapping[str, float]) -> bool:
    """Return whether something moves among the widths of causes by name."""
    return any(pick for name, pick in widths.items() if name.startswith(MOTION_OF))


def _open(odds: Mapping[str, float]) -> tuple[str, ...]:
    """Name the causes that are neither named nor excluded by their logarithmic odds; not
    rivals.
    """
    return tuple(
        name
        for name, log_odds in odds.items()
        if -OPEN_LOG_ODDS < log_odds < NAMED_LOG_ODDS and not name.startswith(RIVALS)
    )


def _beside_motion(
    first: FitResult,
    fit: FitResult,
    candidates: Candidates,
    choice: Choice,
    refit: Refit,
) -> tuple[FitResult, Found]:
    """State the fit without causes, wider by what moves, and keep the fit with the others.

    Args:
        first: fit without causes.
        fit: with those of `choice`.
        candidates: all causes, judged.
        choice: the most likely one.
        refit: as of `explained_by_causes`.
    """
    odds = candidates.odds()
    likely = None
    if names := _applied(candidates, choice):
        likely = (fit, Found(odds, names, (), candidates.strain(choice)))
    alone = motions_alone(candidates, choice)
    stated = _stated(first, candidates, alone, (), refit)
    return stated, Found(odds, beside_motion=likely)


def _stated(
    fit: FitResult,
    candidates: Candidates,
    choice: Choice,
    borders: Sequence[Border],
    refit: Refit,
) -> FitResult:
    """Fit with the places of beads that a choice leaves open as columns, too, and add what
    likely choices differ by to the covariance.

    Args:
        fit: with the causes of `choice`.
        candidates: all causes, judged.
        choice: the most likely one, or what moves in it.
        borders: of tiles, in the fit.
        refit: as of `explained_by_causes`.

    Returns:
        The fit with a wider certificate; not determined if beads that are so far off
        determine too little.
    """
    whole = candidates.with_open_places(choice)
    if whole != choice:
        fit = refit(**_options(candidates, whole, borders))
        if not fit.determined:
            return fit
    return widened_by_causes(fit, candidates, choice)


def _searched(
    fit: FitResult,
    known: Known,
    borders: tuple[Border, ...],
    alike: float,
    before: Mapping[str, float],
    left_out: Sequence[int],
) -> tuple[Candidates, Choice]:
    """Find the most likely causes, borders of the panel's tiles among them.

    A border is looked for in what the most likely causes leave of the residuals, and in
    what they leave without one of them: places of beads that keep their rows in all
    frames explain a border along rows completely, and step by step the border does not
    take their place. The search ends with the first border
    that is not chosen. That border stays in the table if it is open.

    Args:
        fit: of the geometry.
        known: statements on the phantom and the positions.
        borders: found before.
        alike: number of neighbouring frames whose residuals count as one.
        before: width of each cause of the fit, from which the search starts, too.
        left_out: beads that are elsewhere.

    Returns:
        The table, with at most `MOST_BORDERS` borders, and its most likely choice.
    """
    problem = fit.problem
    x = fit.solution.x
    candidates = Candidates(problem, x, known, borders, alike, left_out)
    choice = candidates.best([candidates.choice(before)])
    # Only what is taken for another cause has to be told from errors of the spots.
    if _applied(candidates, choice) and len(problem.group) >= REPEATING_FRAMES:
        widths = candidates.widths(choice)
        candidates = Candidates(problem, x, known, borders, alike, left_out, True)
        choice = candidates.best([candidates.choice(widths)])
    while len(candidates.borders) < MOST_BORDERS:
        found: dict[Border, list[Choice]] = {}
        for part in candidates.parts(choice):
            border = candidates.border(part)
            if border is not None:
                found.setdefault(border, []).append(part)
        some = []
        for border, parts in found.items():
            every = (*candidates.borders, border)
            table = Candidates(
                problem, x, known, every, alike, left_out, candidates.repeating
            )
            more = [
                other
                for part in parts
                for other in table.with_last_border(candidates.widths(part))
            ]
            some.append((table, table.best(more)))
        if not some:
            break
        wider, chosen = max(some, key=lambda one: one[0].rank(one[1]))
        name = border_name(wider.borders[-1])
        if wider.width(chosen, name) or wider.odds()[name] > -OPEN_LOG_ODDS:
            candidates = wider
            choice = chosen
        if not wider.width(chosen, name):
            break
    return candidates, choice


def motions_alone(candidates: Candidates, choice: Choice) -> Choice:
    """Return a choice without its other causes, if something moves in it."""
    alone = tuple(
        pick if c.name.startswith(MOTION_OF) else 0.0
        for c, pick in zip(candidates.causes, choice, strict=True)
    )
    return alone if any(alone) else choice


def _applied(candidates: Candidates, choice: Choice) -> tuple[str, ...]:
    """Name the causes of a choice that are columns of its fit."""
    return tuple(
        c.name
        for c, pick in zip(candidates.causes, choice, strict=True)
        if pick and not c.name.startswith(RIVALS)
    )


def _undetermined(
    first: FitResult,
    better: FitResult,
    candidates: Candidates,
    choice: Choice,
    refit: Refit,
) -> tuple[FitResult, Found]:
    """Choose what is stated where the images do not determine the geometry beside the most
    likely causes.

    Args:
        first: fit without causes.
        better: fit with those of `choice`, not determined.
        candidates: all causes, judged.
        choice: the most likely one.
        refit: as of `explained_by_causes`.

    Returns:
        `better` with its causes if they are beyond doubt: no geometry can be offered then.
        Else `first`, wider by what the causes leave open, and the odds.
    """
    nothing = (0.0,) * len(choice)
    odds = candidates.odds()
    if candidates.evidence(choice) - candidates.evidence(nothing) > NAMED_LOG_ODDS:
        return better, Found(
            odds, _applied(candidates, choice), (), candidates.strain(choice)
        )
    return _stated(first, candidates, nothing, (), refit), Found(odds)


def _options(
    candidates: Candidates, choice: Choice, borders: Sequence[Border]
) -> dict[str, object]:
    """Make the options of the refit for a choice; falsy where nothing changes.

    Args:
        candidates: the table.
        choice: width of each cause.
        borders: of tiles.

    Returns:
        `strain` (None if it is as stated before), `arc` and `rows` (bool),
        `bead_tolerance_mm` (None if not chosen) and `panel` (None without bends and borders,
        or where images differ in shape).
    """
    stated = candidates.known.strain
    strain = tuple(
        candidates.width(choice, n) or w for n, w in zip(SHAPES, stated, strict=True)
    )
    beads = candidates.width(choice, "beads")
    bent = candidates.width(choice, "panel")
    shape = image_shape(candidates.problem)
    panel = None
    if shape is not None and (bent or borders):
        panel = PanelModel(bent or NO_PANEL_PX, shape, tuple(borders))
    return {
        "strain": None if strain == stated else strain,
        "arc": bool(candidates.width(choice, "arc")),
        "rows": bool(candidates.width(choice, "rows")),
        "bead_tolerance_mm": beads or None,
        "panel": panel,
    }


def lost_beads(fit: FitResult) -> list[int]:
    """List the beads that are seen in three frames at least and that a fit left out of more
    than half of them.
    """
    seen = fit.problem.seen.sum(axis=0)
    used = fit.certificate.used.sum(axis=0)
    return np.flatnonzero((seen >= 3) & (used < 0.5 * seen)).tolist()
