"""One linear table: differences that are zero in a right scan, and what each error adds to them.

Rows are the pairs of numbers of `view_pairs` and `opposed_rays`, weighted by their measured
noise and error of sampling. Columns are derivatives by the errors of `causes`. Errors are taken
in, the one that explains most first, while they are significant. Standard errors are those of
clusters: differences that share an arc of views are not taken as independent (Cameron, Gelbach and
Miller, J. Bus. Econ. Stat. 29 (2011) 238), so that they hold whatever the object's shape does to
sampling. What sampling does to all arcs alike shows in a table of half as many pixels: by how much
its estimates differ is part of their standard error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.acquisition.rectify import window
from flexdt.twin.reconstruction.acquisition.trajectory import Circle
from flexdt.twin.reconstruction.consistency.causes import (
    Cause,
    Course,
    causes_of,
    courses,
)
from flexdt.twin.reconstruction.consistency.opposed_rays import OpposedRays
from flexdt.twin.reconstruction.consistency.view_pairs import Condition, ViewPairs
from flexdt.twin.reconstruction.white_noise import noise_of

ARCS: Final = 12
"""Arcs of the scan whose differences are taken as one observation."""
FALSE_ALARMS: Final = 0.01
"""Share of right scans in which some error may be told."""
MOST_ERRORS: Final = 3
"""Errors that are told of one scan (assumed: more are rarely told apart)."""
BLURS: Final = (3.0, 1.0)
"""Smoothing of the images [pixels]: large errors are found in smooth ones."""
FINE_BLUR: Final = BLURS[-1]
MOST_STEPS: Final = 4
"""Corrections in images of one smoothing."""
TRIED: Final = 8
"""Errors that are tried in a table, those that explain most."""
SHARED_OF_PIXELS: Final = 1.0
"""Least share of the sampling's and noise's standard deviation that errors of the images, which all
views have alike, may show: so has the error of sampling a shadow, and all of it may look like
them, whatever the pixels."""
FREEDOM: Final = 4.0
"""Degrees of freedom of Student's distribution of a difference over its standard deviation: an edge
that is parallel to a ray differs by far more than usual."""


@dataclass(frozen=True, eq=False)
class CauseTable:
    """The rows and columns of a scan.

    Attributes:
        images: (n, rows, cols) line integrals.
        cone_vec: n views.
        circle: of them.
        share: (n,) of the scan before each view.
        rows: of `ViewPairs` and `OpposedRays`, with their conditions.
        blur: standard deviation of the images' smoothing [pixels].
        sharp: the images before it.
        whole: the panel sees the whole object from side to side; else opposed rays alone
            compare.
    """

    images: Float32Array
    cone_vec: ConeVec
    circle: Circle
    share: FloatArray
    rows: list[tuple[ViewPairs | OpposedRays, Condition]]
    blur: float
    sharp: Float32Array
    whole: bool = True

    @classmethod
    def of(
        cls,
        images: Float32Array,
        cone_vec: ConeVec,
        circle: Circle,
        share: FloatArray,
        blur: float = FINE_BLUR,
        whole: bool = True,
    ) -> CauseTable | None:
        """Make the table; None where no two views see the object so that they compare.

        Args:
            images: (n, rows, cols) line integrals.
            cone_vec: n views.
            circle: of them.
            share: (n,) of the scan before each view, 0 to 1.
            blur: standard deviation of the images' smoothing [pixels]: noise that
                interpolation reduces would show as an error that moves rays between pixels.
            whole: see the class.
        """
        from scipy.ndimage import gaussian_filter

        along = min(blur, 0.25 * (images.shape[1] - 1))
        sampled = gaussian_filter(images, (0.0, along, 0.0), mode="nearest")
        smooth = gaussian_filter(sampled, (0.0, 0.0, blur), mode="nearest")
        noise = noise_of(images)
        # Squares of the kernel's values sum to 1 / (2 sqrt(pi) blur), along a line or each way.
        kept = min(1.0, 0.28 / max(along, 0.28))
        rows: list[tuple[ViewPairs | OpposedRays, Condition]] = []
        pairs = ViewPairs.of(smooth, cone_vec, circle, along) if whole else None
        if pairs is not None:
            rows.append((pairs, pairs.condition(smooth, cone_vec, noise * kept, sampled)))
        rays = OpposedRays.of(smooth, cone_vec, circle, blur)
        if rays is not None:
            kept *= min(1.0, 0.28 / blur)
            rows.append((rays, rays.condition(smooth, cone_vec, noise * kept)))
        made = cls(smooth, cone_vec, circle, share, rows, blur, images, whole)
        return made if rows else None

    @cached_property
    def _binned(self) -> tuple[int, int]:
        """Rows and columns of a pixel of the `_coarser` table."""
        return min(2, self.sharp.shape[1]), 2

    @cached_property
    def _coarser(self) -> CauseTable | None:
        """The table of half as many rows and columns, by the same smoothing; None without."""
        _, rows, cols = self.sharp.shape
        down, across = self._binned
        rows, cols = rows - rows % down, cols - cols % across
        part = window(self.cone_vec, self.sharp.shape[1:], (0, rows), (0, cols))
        views = ConeVec.from_vectors(
            part.source, part.detector, across * part.u, down * part.v
        )
        images = binned_mean(self.sharp[:, :rows, :cols], self._binned)
        images = np.ascontiguousarray(images, np.float32)
        blur = 0.5 * self.blur
        return CauseTable.of(images, views, self.circle, self.share, blur, self.whole)

    @cached_property
    def differences(self) -> FloatArray:
        """(m,)."""
        return np.concatenate([one.first - one.second for _, one in self.rows])

    @cached_property
    def variance(self) -> FloatArray:
        """(m,)."""
        return np.concatenate([one.variance for _, one in self.rows])

    @cached_property
    def arcs(self) -> npt.NDArray[np.intp]:
        """Arcs of each difference's two views, (m, 2)."""
        views = np.concatenate([one.views for _, one in self.rows])
        return np.asarray(views * ARCS // len(self.cone_vec), np.intp)

    def _by_arcs(self, values: FloatArray) -> dict[str, FloatArray]:
        """Average values (m,) over each kind of rows, by the first view's arc, (ARCS,); NaN in
        arcs without rows: a short scan has opposed rays at its ends alone."""
        found: dict[str, FloatArray] = {}
        first = 0
        for kind, one in self.rows:
            some = slice(first, first + len(one.first))
            arc = self.arcs[some, 0]
            count = np.bincount(arc, minlength=ARCS)
            total = np.where(count, np.bincount(arc, values[some], ARCS), np.nan)
            found[type(kind).__name__] = total / np.maximum(count, 1)
            first += len(one.first)
        return found

    @property
    def counts(self) -> dict[str, int]:
        """Number of differences of each kind of rows."""
        return {type(kind).__name__: len(one.first) for kind, one in self.rows}

    def surprise(self, left: FloatArray | None = None) -> dict[str, FloatArray]:
        """Compute minus the log likelihood of differences by kind of rows, (ARCS,).

        `left`: of them; None: all.
        """
        ratio = np.square(self.differences if left is None else left) / self.variance
        return self._by_arcs(0.5 * (FREEDOM + 1.0) * np.log1p(ratio / FREEDOM))

    @property
    def surprises(self) -> float:
        """Mean of the `surprise`."""
        return self.surprises_without([], [])

    def surprises_without(self, errors: list[Error], sizes: list[float]) -> float:
        """Compute the mean of the `surprise` without errors of some sizes, as if the
        differences were linear in them."""
        left = self.differences
        for error, size in zip(errors, sizes, strict=True):
            left = left - size * self.columns[error]
        return float(np.mean([np.nanmean(one) for one in self.surprise(left).values()]))

    @cached_property
    def doubtful(self) -> bool:
        """True if differences of some kind are larger than noise and sampling explain:
        their mean squares in the arcs, over the variance, are above 1 by the scatter of their
        logarithms.
        """
        from scipy.special import stdtrit

        ratio = self._by_arcs(np.square(self.differences) / self.variance)
        for one in ratio.values():
            logs = np.log(one[one > 0.0])  # not of arcs without rows
            if len(logs) < 2:
                continue
            bar = float(stdtrit(len(logs) - 1.0, 1.0 - FALSE_ALARMS))
            if logs.mean() > bar * logs.std(ddof=1) / np.sqrt(len(logs)):
                return True
        return False

    def unexplained(self) -> float:
        """Compute by how much the numbers differ that should agree, beyond noise and sampling,
        relative to them: the largest of the kinds of rows.
        """
        beyond = self._by_arcs(np.square(self.differences) - self.variance)
        parts = zip(beyond.values(), self.rows, strict=True)
        return max(
            float(np.sqrt(max(float(np.nanmean(one)), 0.0))) / max(row.scale, 1e-30)
            for one, (_, row) in parts
        )

    def most_telling(self, told: list[Error]) -> Error | None:
        """Find the error that explains most besides those told, beyond the arcs' scatter.

        Doubtful differences leave out sampling: estimates then differ as a large error is
        not linear.
        """
        for error in self._by_gain(told):
            sampling = not self.doubtful
            size, sigma = self.fit([error, *told], sampling=sampling)[0]
            if self.bar * sigma < abs(size) <= error[0].most:
                return error
        return None

    @cached_property
    def bar(self) -> float:
        """Size from which an estimate is told [standard errors]."""
        return quantile(FALSE_ALARMS / max(len(self.columns), 1))

    def fit(
        self, errors: list[Error], *, sampling: bool = True
    ) -> list[tuple[float, float]]:
        """Fit errors together, beside those that are nuisances: size and standard error of
        each, with or without what sampling does to all arcs alike."""
        if not errors:
            return []
        nuisances = [one for one in self.columns if one[0].nuisance and one not in errors]
        listed = [self.columns[one] for one in (*errors, *nuisances)]
        sizes, covariance = self._fit(listed)
        own, part = np.zeros(len(errors)), 0.0
        if sampling:
            own, part = self._of_sampling(errors)
        found = []
        for place in range(len(errors)):
            spread = max(float(covariance[place, place]), 0.0)
            cause, course = errors[place]
            share = part
            if sampling and cause.images is not None and course.kind == "constant":
                share = max(part, SHARED_OF_PIXELS)
            alike = np.hypot(own[place], share * self._products.shared[errors[place]])
            found.append((float(sizes[place]), float(np.hypot(np.sqrt(spread), alike))))
        return found

    @cached_property
    def _products(self) -> Products:
        """What the columns have in common, weighted."""
        matrix = np.array([*self.columns.values()]).reshape(-1, len(self.differences))
        normal = (matrix * self.weights) @ matrix.T
        power = matrix @ (self.weights * self.differences)
        alike = np.abs(matrix) @ (self.weights * np.sqrt(self.variance))
        alike /= np.maximum(np.diag(normal), 1e-300)
        place = {one: k for k, one in enumerate(self.columns)}
        shared = {one: float(alike[k]) for one, k in place.items()}
        return Products(normal, power, place, shared)

    def _of_sampling(self, errors: list[Error]) -> tuple[FloatArray, float]:
        """Compare estimates with those of half as many pixels.

        Returns:
            By how much those of the errors differ, (k,); and the median of errors of all
            kinds, fitted beside these, over `Products.shared`. 0 and 1 without a coarser table.
        """
        half = self._coarser
        told = [] if half is None else _again(half, {_key(one): 0.0 for one in errors})
        if half is None or len(told) < len(errors):
            return np.zeros(len(errors)), 1.0
        usual = {_key(one): one for one in half.columns if _is_usual(one)}
        both = [one for one in self.columns if _is_usual(one) and _key(one) in usual]
        both = [one for one in both if _key(one) not in map(_key, errors)]
        fine = self._beside(errors, both)
        coarse = half._beside(told, [usual[_key(one)] for one in both])
        off = np.abs(fine - coarse)
        if not both:
            return off[: len(errors)], 1.0
        shared = np.array([self._products.shared[one] for one in both])
        return off[: len(errors)], float(np.median(off[len(errors) :] / shared))

    def _beside(self, errors: list[Error], others: list[Error]) -> FloatArray:
        """Fit errors together, and each of the others beside them, all of them beside the
        nuisances: sizes, (k,)."""
        base = [*errors]
        base += [one for one in self.columns if one[0].nuisance and one not in errors]
        sizes = self._products.fitted(base)
        found = [*sizes[: len(errors)]]
        for one in others:
            if one in base:
                found.append(sizes[base.index(one)])
            else:
                found.append(self._products.fitted([*base, one])[-1])
        return np.array(found)

    def _by_gain(self, told: list[Error]) -> list[Error]:
        """Order the errors that are not told by how much they explain beside the others."""
        root = np.sqrt(self.weights)
        base = [one for one in self.columns if one[0].nuisance or one in told]
        rest = self.differences * root
        coarse = self.blur > FINE_BLUR
        listed = [
            one
            for one in self.columns
            if one not in base and not (coarse and one[0].fine)
        ]
        matrix = (
            np.array([self.columns[one] for one in listed]).reshape(-1, len(rest)) * root
        )
        power = np.square(matrix).sum(axis=1)
        if base:
            known, _ = np.linalg.qr(
                np.array([self.columns[one] * root for one in base]).T
            )
            matrix -= (matrix @ known) @ known.T
            rest = rest - known @ (known.T @ rest)
        own = np.square(matrix).sum(axis=1)
        gain = np.square(matrix @ rest) / np.maximum(own, 1e-6 * power + 1e-300)
        return [listed[k] for k in np.argsort(-gain)[:TRIED]]

    @cached_property
    def weights(self) -> FloatArray:
        """Weights of the differences, (m,), by Student's distribution, of a scale that lets
        those of an error of some views count, too."""
        ratio = np.square(self.differences) / self.variance
        usual = max(float(ratio.mean()), 1e-12)
        return np.asarray(
            (FREEDOM + 1.0) / (FREEDOM + ratio / usual) / (self.variance * usual)
        )

    def _fit(self, columns: list[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Fit columns: sizes (k,), and their covariance by clusters, (k, k)."""
        weights = self.weights
        matrix = np.array(columns).T
        normal = (matrix.T * weights) @ matrix
        size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scaled = normal / np.outer(size, size)
        inverse = np.linalg.pinv(scaled, 1e-9, hermitian=True) / np.outer(size, size)
        sizes = inverse @ (matrix.T @ (weights * self.differences))
        left = self.differences - matrix @ sizes
        scores = matrix * (weights * left)[:, None]
        one, other = self.arcs.T
        arcs = np.zeros((ARCS, len(columns)))
        np.add.at(arcs, one, scores)
        apart = one != other
        np.add.at(arcs, other[apart], scores[apart])
        cells = np.zeros((ARCS * ARCS, len(columns)))
        np.add.at(cells, np.minimum(one, other) * ARCS + np.maximum(one, other), scores)
        both = inverse @ (arcs.T @ arcs) @ inverse
        spread = both - inverse @ (cells.T @ cells) @ inverse
        # Sums over arcs count each pair twice; where that cannot be taken off, half is.
        few = np.diag(spread) < 0.25 * np.diag(both)
        spread[few, few] = 0.25 * np.diag(both)[few]
        return sizes, spread * ARCS / (ARCS - 1.0)

    @cached_property
    def columns(self) -> dict[Error, FloatArray]:
        """Errors that change the differences, with their columns (m,)."""
        found: dict[Error, FloatArray] = {}
        size = float(np.sqrt(np.square(self.differences).sum() + self.variance.sum()))
        views = np.concatenate([one.views for _, one in self.rows])
        for cause in causes_of(self.cone_vec, self.circle.centre, self.share):
            parts = [self._derivative(cause, kind, one) for kind, one in self.rows]
            first, second = (
                np.concatenate([one[side] for one in parts]) for side in (0, 1)
            )
            if cause.turns and self.circle.rise:
                continue  # of a helix views rise, too
            for course in courses(cause):
                share = course(self.share)
                column = share[views[:, 0]] * first + share[views[:, 1]] * second
                if np.linalg.norm(column) > 1e-7 * size:
                    found[cause, course] = column
        return found

    def _derivative(
        self, cause: Cause, kind: ViewPairs | OpposedRays, condition: Condition
    ) -> tuple[FloatArray, FloatArray]:
        """Compute what an error of 1 in the first, and in the second view, adds to the
        differences, (m,) each."""
        sizes = np.full(len(self.cone_vec), cause.step)
        if cause.images is not None:
            if cause.of_integral and isinstance(kind, OpposedRays):
                return np.zeros(len(condition.first)), np.zeros(len(condition.first))
            added = cause.images(self.images, sizes / cause.step)
            first, second = kind.sides(added, self.cone_vec, self.cone_vec)
            return first, -second
        assert cause.views is not None
        other = cause.views(self.cone_vec, sizes)
        stated = condition.first - condition.second
        found = []
        for pair in ((other, self.cone_vec), (self.cone_vec, other)):
            one, two = kind.sides(self.images, *pair)
            found.append((stated - (one - two)) / cause.step)
        return found[0], found[1]


@dataclass(frozen=True, eq=False)
class Products:
    """Weighted products of a table's k columns, from which sizes follow without its rows.

    Attributes:
        normal: of two columns, (k, k).
        power: of a column and the differences, (k,).
        places: error -> its place.
        shared: error -> its size that all differences would show together, each by its
            standard deviation and as the column has it.
    """

    normal: FloatArray
    power: FloatArray
    places: dict[Error, int]
    shared: dict[Error, float]

    def fitted(self, errors: list[Error]) -> FloatArray:
        """Fit errors together: sizes, (k,)."""
        at = [self.places[one] for one in errors]
        normal = self.normal[np.ix_(at, at)]
        size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.linalg.pinv(normal / np.outer(size, size), 1e-9, hermitian=True)
        return np.asarray(inverse @ (self.power[at] / size) / size)


@dataclass(frozen=True, eq=False)
class Finding:
    """An error, or the range in which it may be.

    Attributes:
        cause: of `causes`.
        course: through the scan.
        size: estimate [unit of the cause].
        sigma: its standard error.
        told: it is significant.
    """

    cause: Cause
    course: Course
    size: float
    sigma: float
    told: bool

    @property
    def level(self) -> float:
        """Share of all values that stays open: of a gain that changes any part of the scan
        may be the right one.
        """
        if self.cause.name != "gain":
            return 0.0
        course = self.course(np.linspace(0.0, 1.0, 201))
        return 0.01 * abs(self.size) * float(np.abs(course).max())

    @property
    def figure(self) -> str:
        """Its size with the standard error, in words."""
        where = ""
        if self.course.kind in ("line", "wave", "sine"):
            where = " in the course of the scan"
        if self.course.kind == "step":
            where = f" from {100.0 * self.course.number:.0f} % of the scan on"
        size, sigma = rounded(self.size, self.sigma)
        return f"{size} ± {sigma} {self.cause.unit}{where}"


@dataclass(frozen=True, eq=False)
class Corrected:
    """A scan, corrected by errors of some sizes.

    Attributes:
        table: of the corrected images and geometry, smoothed.
        images: corrected, (n, rows, cols).
        cone_vec: likewise.
        sizes: that were taken off.
    """

    table: CauseTable
    images: Float32Array
    cone_vec: ConeVec
    sizes: dict[Key, float]

    def without(self, errors: list[Error], least: float = 0.5) -> Corrected | None:
        """Correct by errors as they are fitted; None where that explains less than a share of
        what it would if the differences were linear, or a size is not believed.

        `least`: the share."""
        table = self.table
        steps = [size for size, _ in table.fit(errors, sampling=False)]
        sizes = dict(self.sizes)
        images, cone_vec = self.images, self.cone_vec
        for (cause, course), step in zip(errors, steps, strict=True):
            key = cause.name, course
            sizes[key] = sizes.get(key, 0.0) + step
            if abs(sizes[key]) > cause.most:
                return None
            images, cone_vec = cause.corrected(
                images, cone_vec, step * course(table.share)
            )
        closer = CauseTable.of(
            images, cone_vec, table.circle, table.share, table.blur, table.whole
        )
        hoped = table.surprises_without(errors, steps)
        most = table.surprises - least * (table.surprises - hoped)
        if closer is None or closer.surprises > most:
            return None
        return Corrected(closer, images, cone_vec, sizes)

    def settled(self) -> Corrected:
        """Correct by what is known already until it changes by less than a standard error
        (Gauss and Newton); where it does not settle, do nothing."""
        scan = self
        for _ in range(MOST_STEPS):
            known = _again(scan.table, scan.sizes)
            steps = scan.table.fit(known, sampling=False)
            if all(abs(step) <= sigma for step, sigma in steps):
                return scan
            closer = scan.without(known, 0.0)
            if closer is None:
                break
            scan = closer
        return self


def rounded(size: float, sigma: float) -> tuple[str, str]:
    """Write a size, with its sign, and its sigma: two digits of the latter.

    Example:
        >>> rounded(-0.98712, 0.0123)
        ('-0.987', '0.012')
    """
    decimals = max(0, 1 - math.floor(math.log10(sigma))) if sigma > 0.0 else 6
    return f"{size:+.{decimals}f}", f"{sigma:.{decimals}f}"


def findings(
    images: Float32Array, cone_vec: ConeVec, circle: Circle, share: FloatArray
) -> tuple[list[Finding], CauseTable] | None:
    """Find the errors of a scan, one after the other, and the ranges of the others.

    The images, or the geometry, are corrected by each error before the next is looked for:
    first in smooth images (`BLURS`), unless the differences are as noise and sampling make them.

    Args:
        images, cone_vec, circle, share: see `CauseTable.of`.

    Returns:
        Told errors, the first found first, then the others; and the table of the corrected
        scan. None where no two views compare.
    """
    table = CauseTable.of(images, cone_vec, circle, share, FINE_BLUR)
    if table is None:
        return None
    scan = Corrected(table, images, cone_vec, {})
    for blur in BLURS:
        if blur != FINE_BLUR and not scan.table.doubtful:
            continue  # no large error
        if scan.table.blur != blur:
            table = CauseTable.of(scan.images, scan.cone_vec, circle, share, blur)
            if table is None:
                return None
            scan = replace(scan, table=table)
        for _ in range(MOST_STEPS):
            scan = scan.settled()
            known = _again(scan.table, scan.sizes)
            error = scan.table.most_telling(known)
            if error is None or len(scan.sizes) >= MOST_ERRORS:
                break
            # What is known already is fitted anew: errors are not quite linear.
            closer = scan.without([error, *known])
            if closer is None:
                break  # far from linear
            scan = closer
    return _findings(scan.table, scan.sizes), scan.table


def _findings(table: CauseTable, sizes: dict[Key, float]) -> list[Finding]:
    """List told errors that are significant in the corrected scan, then one of each other
    cause."""
    told = _again(table, sizes)
    found = []
    for error, (size, sigma) in zip(told, table.fit(told), strict=True):
        whole = sizes[_key(error)] + size
        clear = table.bar * sigma < abs(whole) <= error[0].most
        # What is taken off the scan, and may be nothing, is open.
        spread = sigma if clear else float(np.hypot(sigma, whole))
        found.append(Finding(*error, whole, spread, told=clear))
    named = {one.cause.name for one in found}
    for error in table.columns:
        cause, course = error
        if course.kind in ("constant", "line") and cause.name not in named:
            named.add(cause.name)
            size, sigma = table.fit([error, *told])[0]
            found.append(Finding(cause, course, size, sigma, told=False))
    return found


def _is_usual(error: Error) -> bool:
    """Return whether an error is one of the geometry, the same in all views."""
    return error[0].views is not None and error[1].kind == "constant"


def _key(error: Error) -> Key:
    return error[0].name, error[1]


def _again(table: CauseTable, sizes: dict[Key, float]) -> list[Error]:
    """Return the errors of a table that are known by name, in the order of `sizes`."""
    known = {_key(one): one for one in table.columns}
    return [known[key] for key in sizes if key in known]


Error = tuple[Cause, Course]
"""An error and its course through the scan."""
Key = tuple[str, Course]
"""Name of an error's cause, and its course."""


def quantile(share: float) -> float:
    """Compute the size that `share` of the estimates of nothing exceed, in standard errors of
    `ARCS` clusters."""
    from scipy.special import stdtrit

    return float(stdtrit(ARCS - 1.0, 1.0 - 0.5 * share))
