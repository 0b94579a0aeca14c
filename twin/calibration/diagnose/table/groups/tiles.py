"""Tiles: a part of the panel is shifted against the rest.

On which side of a border a spot lies is said by its predicted place: measured ones would divide
spots that stay in a row by their noise, and such a border explains it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.diagnose.table.group import (
    LOG_CHANCE,
    Acts,
    Family,
    Found,
    Known,
)
from flexdt.twin.calibration.diagnose.table.linearised import Linearised, image_shape
from flexdt.twin.findings import Finding
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.panel import Border

NAME: Final = "tiles"
WORDS: Final = "a panel whose tiles are apart"
LEAST_TILE: Final = 1 / 8
"""Least part of the panel on each side of a border."""
LEAST_SIDE: Final = 4
"""Positions on each side of a border that tell it."""
NEAR: Final = 6
"""Gaps between spots, about a border of the last table, that are tried, too."""
BORDERS: Final = 80
"""Places of a border along an axis that are tried, one in each gap between spots at most."""
LOG_CHANCE_OF_MORE: Final = math.log(0.5)
"""Logarithm of the probability that a panel with a border has one across it, too; assumed."""


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make tiles that begin at places along columns and rows, each shifted by two numbers;
    places between which no spot lies are one, as likely as they are many.
    """
    shape = image_shape(table.problem)
    if shape is None:
        return
    counted = table.weight > 0
    known_borders = sorted(_borders_of(table.state.found), key=lambda b: b.at)
    for axis in (0, 1):
        place = table.places[..., axis]
        found = [b.at for b in known_borders if b.axis == axis]
        across = any(b.axis != axis for b in known_borders)
        places, shares = _borders(place[counted], shape[1 - axis], found)
        if len(places):
            yield _family(
                table,
                [Border(axis, at) for at in places.tolist()],
                [np.where(place >= at, 1.0, 0.0) for at in places.tolist()],
                (LOG_CHANCE_OF_MORE if across else LOG_CHANCE) + np.log(shares),
            )
    # Four tiles are two borders, and a quarter that is neither.
    quarters = {
        (one, other): np.where((table.places >= (one.at, other.at)).all(axis=2), 1.0, 0.0)
        for one in known_borders
        for other in known_borders
        if one.axis == 0 and other.axis == 1
    }
    quarters = {b: q for b, q in quarters.items() if q[counted].sum() >= LEAST_SIDE}
    if quarters:
        yield _family(
            table, list(quarters), list(quarters.values()), np.zeros(len(quarters))
        )


def _borders_of(found: Iterable[object]) -> set[Border]:
    """Collect the borders of tiles and of quarters."""
    out: set[Border] = set()
    for one in found:
        if isinstance(one, Border):
            out.add(one)
        elif isinstance(one, tuple):
            out |= {b for b in one if isinstance(b, Border)}
    return out


def torn(table: Linearised, found: Iterable[object]) -> npt.NDArray[np.bool_] | None:
    """Find the positions of spots that lie across a border: half of such a spot is shifted.

    `table`: of the fit; `found`: what groups are about that are there.
    Returns (n, k); None where there are none.
    """
    per_mm = np.broadcast_to(table.problem.poses.pixels_per_mm, table.n)
    radii = np.outer(per_mm, np.asarray(table.problem.model.bead_radius_mm))
    out = np.zeros(table.problem.seen.shape, dtype=bool)
    for one in _borders_of(found):
        out |= np.abs(table.places[..., one.axis] - one.at) < radii
    return out if out.any() else None


def _borders(
    places: FloatArray, size: int, found: Sequence[float]
) -> tuple[FloatArray, FloatArray]:
    """Choose places of a border along an axis [px], each in the middle between two spots:
    `BORDERS` at most, and all near those that were found in the last table.

    Args:
        places: (m,) of the spots that count.
        size: of the panel.
        found: borders.

    Returns:
        The places, and the part of all possible places that each stands for.
    """
    here = np.sort(places)
    own = slice(LEAST_SIDE - 1, len(here) - LEAST_SIDE)
    middles = ((here[1:] + here[:-1]) / 2)[own]
    gaps = np.diff(here)[own]
    inside = (middles >= LEAST_TILE * size) & (middles <= (1 - LEAST_TILE) * size)
    middles, gaps = middles[inside & (gaps > 0)], gaps[inside & (gaps > 0)]
    if not len(middles):
        return middles, gaps
    # Evenly among the spots, and in the widest gaps: of beads that stay in their rows.
    chosen = np.linspace(0, len(middles) - 1, min(len(middles), BORDERS // 2)).round()
    some = {*chosen.astype(int).tolist(), *np.argsort(-gaps)[: BORDERS // 2].tolist()}
    for at in found:
        nearest = int(np.searchsorted(middles, at))
        step = len(middles) // BORDERS + NEAR
        some |= set(range(max(nearest - step, 0), min(nearest + step + 1, len(middles))))
    chosen_middles = middles[np.array(sorted(some))]
    ends = (chosen_middles[1:] + chosen_middles[:-1]) / 2
    possible = (1 - 2 * LEAST_TILE) * size
    return chosen_middles, np.bincount(np.searchsorted(ends, middles), gaps) / possible


def _family(
    table: Linearised,
    places: Sequence[Border | tuple[Border, ...]],
    beyond: Sequence[FloatArray],
    chance: FloatArray,
) -> Family:
    """Make groups that shift the spots in a part of the panel, each by two numbers.

    Args:
        table: of the fit.
        places: of the parts: borders, or the two of a quarter.
        beyond: of each part (n, k), 1 where a spot is in it.
        chance: of each.
    """
    rows = []
    for part in beyond:
        shift = np.zeros((*part.shape, 2, 2))
        shift[..., 0, 0] = shift[..., 1, 1] = part
        rows.append(table.rows_of(shift))
    names = tuple(
        "tile from "
        + " and ".join(
            f"{('column', 'row')[b.axis]} {b.at:.2f}"
            for b in ((p,) if isinstance(p, Border) else p)
        )
        for p in places
    )
    return Family(NAME, names, Acts.IMAGE, tuple(places), chance, np.array(rows))


def told(found: Found) -> list[Finding]:
    """Tell nothing: tiles are told with the panel."""
    return []
