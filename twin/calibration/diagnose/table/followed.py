"""Motion frame by frame: what the explanations of a table's posterior make of each frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.table.explained import Explained
from flexdt.twin.calibration.diagnose.table.group import Acts
from flexdt.twin.calibration.diagnose.table.groups import moving
from flexdt.twin.calibration.diagnose.table.posterior import Group
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.motion import Motion

LEAST_PART: Final = 1e-3
"""Probability of an explanation from which its frames count."""


def frame_motions(what: Explained, asked: tuple[str, ...]) -> tuple[Motion, ...]:
    """Return the deviations of the frames of each scan from the geometry of their mean.

    Values are those of the most probable explanation. The variances are of the mixture: of
    each explanation, and the squares of their differences.

    Args:
        what: was found.
        asked: parameters that are listed even where they do not move; others are listed if
            they do.

    Returns:
        A motion for each scan; the sigma of what does not move is nan.
    """
    best = what.posterior.best
    values = dict(what.state.frames)
    moves = [n for n, v in values.items() if v.any()]
    names = tuple(dict.fromkeys((*asked, *moves)))
    n = what.table.n
    square = {name: np.zeros(n) for name in names}
    total = 0.0
    for part in what.posterior.parts:
        if part.weight < LEAST_PART:
            continue
        solved = what.search.solve(part.widths, best.noise2, best.factor)
        slopes = dict(_slopes(what, part.widths, len(solved.mean)))
        total += part.weight
        for name in names:
            rows = slopes.get(name, np.zeros((n, 1)))
            some = np.flatnonzero(rows.any(axis=0))
            rows = rows[:, some]
            off = rows @ solved.mean[some] - values.get(name, 0.0)
            spread = rows @ solved.covariance[np.ix_(some, some)]
            variance = np.einsum("nc,nc->n", spread, rows)
            square[name] += part.weight * (variance + off**2)
    sigma = {
        name: np.sqrt(square[name] / total) if name in moves else np.full(n, math.nan)
        for name in names
    }
    evidence = tuple(
        max(what.posterior.odds(_groups_of(what, name)), 0.0) if name in moves else 0.0
        for name in names
    )
    return tuple(
        Motion(
            names,
            np.stack([values.get(name, np.zeros(n))[own] for name in names], axis=1),
            np.stack([sigma[name][own] for name in names], axis=1),
            evidence,
        )
        for own in what.table.scans
    )


def sets_of_movers(what: Explained) -> dict[frozenset[str], float]:
    """Return the probability of each set of what moves, of `moving.MOVERS`."""
    out: dict[frozenset[str], float] = {}
    for part in what.posterior.parts:
        movers = frozenset(
            mover
            for f, g in part.widths
            if (mover := moving.mover(what.posterior.families[f].places[g]))
        )
        out[movers] = out.get(movers, 0.0) + part.weight
    return out


def _groups_of(what: Explained, name: str) -> list[Group]:
    """List the groups of all explanations in which a parameter of frames moves."""
    families = what.posterior.families
    return list(
        {
            (f, g): None
            for part in what.posterior.parts
            for f, g in part.widths
            if families[f].acts is Acts.FRAMES and name in _names(what, (f, g))
        }
    )


def _names(what: Explained, group: Group) -> tuple[str, ...]:
    place = what.posterior.families[group[0]].places[group[1]]
    assert isinstance(place, tuple)
    return tuple(place[0])


def _slopes(
    what: Explained, widths: Mapping[Group, float], count: int
) -> Iterator[tuple[str, FloatArray]]:
    """Yield what the weights of a model make of each parameter of frames, (n, count)."""
    search = what.search
    parts = [((f, 0), own, 1.0) for f, own in search.always]
    at = search.base_count
    for f, g in widths:
        columns = search.products.own(f).shape[1]
        unit = float(search.products.units[f][g])
        parts.append(((f, g), slice(at, at + columns), 1.0 / unit))
        at += columns
    out: dict[str, FloatArray] = {}
    for (f, g), own, scale in parts:
        family = search.products.families[f]
        if family.acts is not Acts.FRAMES:
            continue
        assert family.courses is not None
        assert family.slopes is not None
        courses = family.courses[g // len(family.slopes)]
        for name, course in zip(_names(what, (f, g)), courses, strict=True):
            rows = out.setdefault(name, np.zeros((what.table.n, count)))
            rows[:, own] += scale * course
    yield from out.items()
