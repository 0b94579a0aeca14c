"""Which flips, senses and signs of a geometry fit the images of a scan.

Programs differ in which column is the first, which row is up, which way the stage turns and to
which side an offset counts. On a coarse copy each second image is predicted from the volume of the
others, as of each combination; residuals in arcs of views say by how many standard errors one fits
better than another. Combinations that differ by a mirror image of the object alone fit equally.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.acquisition.trajectory import circle_of
from flexdt.twin.reconstruction.coarse_scan import FINE_NODES, NODES, CoarseScan
from flexdt.twin.reconstruction.consistency.reprojection import (
    Reprojection,
    layers_off,
)
from flexdt.twin.reconstruction.consistency.suspects import moved
from flexdt.twin.reconstruction.white_noise import noise_of

CHANGES: Final = {
    "columns": "columns are counted the other way",
    "rows": "rows are counted the other way",
    "direction": "the stage turns the other way",
    "sign": "the panel's offset along rows has the other sign",
    "height": "the panel's offset along columns has the other sign",
}
"""Change of a geometry -> its description."""
MAX_MISFIT: Final = 2.5
"""Largest residual of a right combination, over that of the volume's second reconstruction: of
127 right scans half had 1.4 and more, 1 % 2.25, and one 2.52."""
MAX_RELIABLE_RESIDUAL: Final = 0.3
"""Residual of the second reconstruction, over the images, below which it is reliable."""
MIN_SIGNAL_SHARE: Final = 0.01
"""Share of a residual that is never attributed to noise."""
MIN_VIEWS: Final = 12
"""Least number of views and coarse columns; with fewer a volume fits anything."""
MIN_SEEN_SHARE: Final = 0.1
"""Least share of a helix's rows that are compared, of an object that goes on beyond it."""
MAX_WRONG: Final = 0.01
"""Largest probability that a combination is named and another one is right."""
SAME: Final = 1e-6
"""Largest relative difference of equal geometries."""
MIRRORS: Final = tuple(np.diag([x, 1.0, z]) for x in (1.0, -1.0) for z in (1.0, -1.0))
"""Mirror images of an object, which no images of it tell apart."""
Image = Callable[[int], npt.NDArray[np.generic]]


@dataclass(frozen=True, eq=False)
class Fit:
    """Combinations that fit equally, with how well they do.

    Attributes:
        combinations: of `CHANGES`, the fewest changes first.
        arcs: mean squares of the residual in arcs of views, for each measure that tells,
            (m, arcs); None where none does, or FDK cannot use the geometry.
        misfit: residual over that of a second reconstruction; infinite where FDK cannot
            use the geometry.
        odds: probability that it fits so much worse than the best by chance; 1 for the
            best.
    """

    combinations: tuple[frozenset[str], ...]
    arcs: FloatArray | None
    misfit: float = np.inf
    odds: float = 1.0


def changed(cone_vec: ConeVec, changes: frozenset[str], rest: FloatArray) -> ConeVec:
    """Change a geometry, which turns about an axis along z.

    Args:
        cone_vec: n views.
        changes: of `CHANGES`.
        rest: rows and columns at the panel's end that the geometry does not have, (2,).
    """
    circle = circle_of(cone_vec)
    centre = np.append(circle.centre, 0.0)
    if "direction" in changes:
        turn = 2.0 * (circle.angle[0] - circle.angle)
        cos, sin, zero, one = np.cos(turn), np.sin(turn), 0.0 * turn, 0.0 * turn + 1.0
        matrices = np.array([[cos, -sin, zero], [sin, cos, zero], [zero, zero, one]])
        parts = [cone_vec.source - centre, cone_vec.detector - centre]
        parts = [np.einsum("ijn,nj->ni", matrices, part) + centre for part in parts]
        steps = [np.einsum("ijn,nj->ni", matrices, s) for s in (cone_vec.u, cone_vec.v)]
        cone_vec = ConeVec.from_vectors(*parts, *steps)
    along, down = _foot(cone_vec, centre, rest)
    if "sign" in changes:
        cone_vec = moved(cone_vec, 2.0 * along)
    if "height" in changes:
        cone_vec = moved(cone_vec, 0.0, 2.0 * down)
    if "columns" in changes:
        cone_vec = moved(cone_vec, float(rest[1]))
        cone_vec = ConeVec.from_vectors(
            cone_vec.source, cone_vec.detector, -cone_vec.u, cone_vec.v
        )
    if "rows" in changes:
        cone_vec = moved(cone_vec, 0.0, float(rest[0]))
        cone_vec = ConeVec.from_vectors(
            cone_vec.source, cone_vec.detector, cone_vec.u, -cone_vec.v
        )
    return cone_vec


def _foot(
    cone_vec: ConeVec, centre: FloatArray, rest: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Compute where the source's foot on the axis falls in each view, from the middle of
    the whole panel [pixels], (n,) along rows and down columns.
    """
    foot = cone_vec.source.copy()
    foot[:, :2] = centre[:2]
    rays = foot - cone_vec.source
    sides = np.stack([cone_vec.u, cone_vec.v, -rays], axis=-1)
    at = np.linalg.solve(sides, (cone_vec.source - cone_vec.detector)[:, :, None])[..., 0]
    return at[:, 0] - 0.5 * rest[1], at[:, 1] - 0.5 * rest[0]


def classes(cone_vec: ConeVec, rest: FloatArray) -> list[list[frozenset[str]]]:
    """Group all combinations of changes by the images that they predict, up to mirror
    images of the object; the fewest changes first.

    Args:
        cone_vec: n views.
        rest: as for `changed`.
    """
    found: list[tuple[FloatArray, list[frozenset[str]]]] = []
    for count in range(len(CHANGES) + 1):
        for names in combinations(CHANGES, count):
            changes = frozenset(names)
            views = changed(cone_vec, changes, rest)
            forms = [_plain(views, mirror) for mirror in MIRRORS]
            size = float(np.abs(forms[0]).max())
            for known, members in found:
                if any(np.abs(form - known).max() <= SAME * size for form in forms):
                    members.append(changes)
                    break
            else:
                found.append((forms[0], [changes]))
    return [members for _, members in found]


def _plain(cone_vec: ConeVec, mirror: FloatArray) -> FloatArray:
    """Return the rows of a mirrored geometry (n, 4, 3) from its axis and first source on,
    whatever the object's turn and place along the axis.
    """
    circle = circle_of(cone_vec)
    origin = np.append(circle.centre, cone_vec.source[0, 2])
    rows = cone_vec.rows.reshape(-1, 4, 3).copy()
    rows[:, :2] -= origin
    rows = rows @ mirror
    x, y = rows[0, 0, :2] / np.linalg.norm(rows[0, 0, :2])
    return np.asarray(rows @ np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]]))


def fits(image: Image, cone_vec: ConeVec, shape: tuple[int, int]) -> list[Fit]:
    """Compare the images of a scan with every combination of conventions, the best first.

    A coarse and a finer copy, whose errors differ, are compared: a combination has its
    larger odds. `image` gives line integrals by number.
    Returns a fit a class; [] for too few views or columns, or no object. Raises
    GeometryError: neither a circle nor a helix.
    """
    odds: dict[frozenset[str], float] = {}
    found: list[Fit] = []
    for nodes in (NODES, FINE_NODES):
        scan = CoarseScan.of(image, cone_vec, shape, None, nodes).thinned()
        if too_few(scan) or not np.abs(scan.images).max() > 0.0:
            return []
        found = _compared(scan)
        for fit in found:
            for changes in fit.combinations:
                odds[changes] = max(odds.get(changes, 0.0), fit.odds)
    return [replace(fit, odds=max(odds[c] for c in fit.combinations)) for fit in found]


def _compared(scan: CoarseScan) -> list[Fit]:
    """Compare the images of a coarse copy with every class of combinations, the best
    first; measures that do not tell are left out.
    """
    rest = np.array(scan.rest)
    shown: list[_Shown] = []
    unusable: list[Fit] = []
    for members in classes(scan.cone_vec, rest):
        views = changed(scan.cone_vec, members[0], rest)
        seen = _shown(scan, scan.images, views)
        if seen is None:
            unusable.append(Fit(tuple(members), None, odds=0.0))
        else:
            shown.append(_Shown(scan, tuple(members), views, seen))
    shown.sort(key=lambda one: float(np.log(one.shown.arcs).mean()))
    if not shown:
        return unusable
    best = shown[0]
    again = None if best.whole is None else _shown(scan, best.whole, best.cone_vec)
    expected = np.full(2, np.inf) if again is None else again.misfit()
    telling = expected < MAX_RELIABLE_RESIDUAL
    if not telling.any():
        return [*(Fit(one.combinations, None) for one in shown), *unusable]
    rest_of_best = scan.images - best.shown.again
    own = best.right(rest_of_best)
    seen_right = None if own is None else _shown(scan, own, best.cone_vec)
    made = []
    for one in shown:
        misfit = one.shown.misfit(MIN_SIGNAL_SHARE) / expected
        size = float(misfit[1 if telling[1] else 0])
        odds = 1.0
        if one is not best:
            said = _ratio(best.shown, one.shown, telling)
            usual: FloatArray | None = np.zeros_like(said)
            if size <= MAX_MISFIT:
                usual = _expected(best, one, seen_right, rest_of_best, telling)
            odds = 1.0 if usual is None else _chance(said - usual)
        made.append(Fit(one.combinations, one.shown.arcs[telling], size, odds))
    return [*made, *unusable]


@dataclass(frozen=True, eq=False)
class _Shown:
    """A class of combinations with its geometry, and the images as of it.

    Attributes:
        scan: the coarse copy.
        combinations: of `CHANGES`.
        cone_vec: of the copy, so changed.
        shown: the images, and what the others predict of them.
    """

    scan: CoarseScan
    combinations: tuple[frozenset[str], ...]
    cone_vec: ConeVec
    shown: Reprojection

    @cached_property
    def whole(self) -> Float32Array | None:
        """Projections of the volume of all images; None where FDK cannot use them."""
        made = Reprojection.of(self.scan, self.scan.images, self.cone_vec, None)
        return None if made is None else made.again

    def right(self, rest: Float32Array) -> Float32Array | None:
        """Return images of which this class is right, with other views' residuals as
        noise.

        None where FDK fails.
        """
        if self.whole is None:
            return None
        elsewhere = np.roll(rest, len(rest) // 2, axis=0)
        return np.asarray(self.whole + elsewhere, np.float32)


def _shown(
    scan: CoarseScan, images: Float32Array, cone_vec: ConeVec
) -> Reprojection | None:
    """Predict each second image from the volume of the others, as of a geometry; None
    where FDK cannot use it.

    A volume explains noise of its own images as of any geometry, but not of others.
    """
    layers = layers_off(scan, cone_vec)
    if layers:  # the object is raised so that rows fall on the grid's layers
        up_mm = [0.0, 0.0, layers * scan.grid.voxel_xyz[2]]
        cone_vec = cone_vec.moved(np.eye(3), up_mm)
    again = np.empty_like(images)
    shape = (images.shape[1], images.shape[2])
    values = images
    for half in (0, 1):
        seen, left = slice(half, None, 2), slice(1 - half, None, 2)
        try:
            values = scan.fdk(np.ascontiguousarray(images[seen]), cone_vec[seen], None)
        except GeometryError:
            return None
        known = np.nan_to_num(values)
        again[left] = scan.projected(known, cone_vec[left], shape, fine=False)
    noise = scan.noise if images is scan.images else noise_of(images)
    return Reprojection(images, values, again, noise)


def _chance(each: FloatArray) -> float:
    """Return the probability of so large a mean, where it is 0: Student's distribution."""
    from scipy.stats import t

    spread = max(float(each.std(ddof=1)), float(np.finfo(np.float32).tiny))
    sigmas = float(each.mean()) * np.sqrt(len(each)) / spread
    return float(t.sf(sigmas, len(each) - 1))


def _expected(
    best: _Shown,
    rival: _Shown,
    seen: Reprojection | None,
    rest: Float32Array,
    telling: npt.NDArray[np.bool_],
) -> FloatArray | None:
    """Compute, in each arc, the middle of what the comparison says if best or rival is
    right.

    Images speak for the best as far as they are beyond it. `seen`: images of which the
    best is right; `rest`: its residual, (n, rows, cols); `telling`: measures that count,
    (2,). Returns None where it says no more if the best is right, or FDK fails.
    """
    theirs = rival.right(rest)
    if seen is None or theirs is None:
        return None
    scan = best.scan
    other = _shown(scan, seen.images, rival.cone_vec)
    both = [_shown(scan, theirs, one.cone_vec) for one in (best, rival)]
    if other is None or both[0] is None or both[1] is None:
        return None
    of_best = _ratio(seen, other, telling)
    of_rival = _ratio(both[0], both[1], telling)
    if of_best.mean() <= of_rival.mean():
        return None
    return np.asarray(0.5 * (of_best + of_rival))


def _ratio(
    best: Reprojection, rival: Reprojection, telling: npt.NDArray[np.bool_]
) -> FloatArray:
    """Return the logarithm of a rival's residual over the best's in each arc."""
    ratio = np.log(rival.arcs[telling] / best.arcs[telling])
    return np.asarray(0.5 * ratio.mean(axis=0))


def level_of(found: list[Fit]) -> float:
    """Return the probability below which one of all rivals is excluded (`MAX_WRONG`)."""
    return MAX_WRONG / max(len(found) - 1, 1)


def remaining(found: list[Fit]) -> Iterator[Fit]:
    """Yield the fits that the images do not exclude; none if the best does not fit
    (`MAX_MISFIT`).
    """
    if not found or found[0].arcs is None or found[0].misfit > MAX_MISFIT:
        return
    yield from (fit for fit in found if fit.odds >= level_of(found))


def too_few(scan: CoarseScan) -> bool:
    """Return whether a scan has fewer than `MIN_VIEWS` views or columns, or a helix too few
    rows that see only what is reconstructed (`MIN_SEEN_SHARE`).
    """
    rows = scan.seen_rows
    if rows is not None and float(rows.mean()) < MIN_SEEN_SHARE:
        return True
    return bool(min(len(scan.circle.step), scan.images.shape[2]) < MIN_VIEWS)
