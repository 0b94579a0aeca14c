"""Whether the images of a scan and its geometry belong together.

A coarse volume is projected again and compared with the images. How large the residual is where
both are right depends on object and trajectory; the volume, projected and reconstructed a
second time, shows it. Other explanations are tried, each with a coarse reconstruction of its
own. A geometry is believed if it fits better than every explanation whose
volume would differ. All of it is done with few views and rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from flexdt.twin.errors import GeometryError
from flexdt.twin.reconstruction.coarse_scan import COMPARED_ROWS, CoarseScan
from flexdt.twin.reconstruction.consistency.suspects import KINDS, SIDES
from flexdt.twin.reconstruction.consistency.trials import (
    MAX_RELIABLE_RESIDUAL,
    MIN_EVIDENCE_SIGMAS,
    Trial,
    Tried,
)

MAX_MISFIT: Final = 2.5
"""Largest residual of fitting images, over that of the volume's second reconstruction. Of
127 right scans (`tests/studies/misfits.py --right`, seeds 7071, 8484 and 12121) half have
1.4 and more, 1 % have 2.25 and more, and one has 2.52: above this are at most 3.7 % (95 %
confidence), and a finer copy decides (`still_misfits`)."""
MAX_BETTER_MISFIT: Final = 0.92
"""Misfit of an explanation, relative to the stated geometry's, below which it is
better: right scans have 0.96 and more."""
MAX_MUCH_BETTER_MISFIT: Final = 0.7
"""The same where the panel cuts the object off, whose outer parts no volume holds, and
where the coarse volume shows no edges."""
MAX_WANDER: Final = 5.0
"""Largest distance of images' centroids from those of the volume's projections, over what
the second reconstruction and noise explain (`wandering`): above it a scan does not fit."""
MIN_DOUBTFUL_MISFIT: Final = 1.4
"""Residual over that of the second reconstruction, below which an explanation counts
only if its volume differs: more than half of right scans. Above it bounds grow in
proportion."""
MIN_DOUBTED_MISFIT: Final = 2.0
"""The same, from which on explanations are looked for at once, not only when the accuracy
is asked for: few right scans have so much (`tests/studies/misfits.py --right`)."""
MIN_CHANGE: Final = 0.01
"""Least relative change of uniform regions by an explanation that is named: a tilted
panel's images may fit mirrored rows better, whose volume is the same."""
SMOOTH_CHANGE_SHARE: Final = 1.0 / 3.0
"""Share of a volume's change by a flaw that the smooth coarse volume shows."""
MAX_UNTOLD_CHANGE: Final = 0.1
"""Largest relative change of uniform regions by an explanation as likely that a claim of
larger errors covers."""
MIN_FINE_EVIDENCE_SIGMAS: Final = 3.0
"""Least distance of two likelihoods on a finer copy, in standard errors, at which an
explanation is excluded that the first copy left undecided: the second look of the two.
From the same distance on, an explanation fits better than the stated geometry."""
MAX_STILL_WANDER: Final = 2.5
"""The same in the volume of a panel at another place, up to which nothing else moved: of 75
simulated scans with such a panel at most 1.7, of 12 that moved along rows, of which it
explains half, 2.8 and more (`tests/studies/misfits.py`, seeds 6061 and 18181)."""
ORDERS: Final = frozenset({"interlaced", "names", "listed", "span"})
"""Kinds that give images to other angles, of which some views alone may be uneven."""
PLACES: Final = frozenset({"offset", "middle", "sign", "height"})
"""Kinds of a panel at another place, which movement includes."""
FOUND_BY_TRIALS: Final = frozenset({"offset", "movement"})
"""Kinds whose figure is found by trials, which a finer copy would have to repeat."""
RIVALS_ROWS: Final = 6
"""Least rows of a scan whose images fit, in which explanations are compared with it."""
MIN_VIEWS: Final = 12
"""Least number of views and coarse columns; with fewer a volume fits anything."""
MIN_SEEN_SHARE: Final = 0.1
"""Least share of a helix's rows that are compared, of an object that goes on beyond it: at
a share of 0.05 a right one seemed to contradict its geometry, at 0.10 it fitted."""
MIN_SIGNAL_INTEGRAL: Final = 1e-9
"""Least line integral of an object: far below what any detector tells from the open beam."""
MAX_AVERAGED_COLUMNS: Final = 4
"""Largest number of coarse columns that are averaged where finer ones show only streaks
(assumed)."""
EQUAL_MISFIT_RATIO: Final = 1.05
"""Largest misfit of an equally good explanation, over the best one's."""
UNEXPLAINED: Final = (
    "No other direction, order, mirror, offset or shift of single images explains it; "
    "images in a wrong order do, and images that are not line integrals of one object"
)


@dataclass(frozen=True)
class Contradiction:
    """A contradiction between images and their geometry, or an explanation as likely.

    Attributes:
        misfit: residual over its expected value.
        kinds: of `suspects.KINDS`, the best explanation; empty without one.
        better: misfit that the best explanation leaves, over `misfit`; 1 without one.
        figures: of the kinds.
        change: relative change of uniform regions in the volume of an explanation that
            fits as well; None where the images do not fit.
        fits_better: with `change`, that the best explanation fits better than the stated
            geometry, by `MIN_FINE_EVIDENCE_SIGMAS`.
        by_misfit_alone: nothing but the size of the misfit contradicts (`MAX_MISFIT`).
    """

    misfit: float
    kinds: tuple[str, ...] = ()
    better: float = 1.0
    figures: tuple[str, ...] = ()
    change: float | None = None
    fits_better: bool = False
    by_misfit_alone: bool = False

    def __str__(self) -> str:
        """Describe the contradiction for the user as one sentence, with its figures.

        With `change`, that the images do not decide between geometries; else how much
        worse they fit than expected, and the explanations, if any.
        """
        if self.change is not None:
            how = "better" if self.fits_better else "as well"
            return (
                "no accuracy is claimed: the images do not decide between geometries; "
                f"they fit {how} if {self._explanations}; values would then differ by "
                f"{100.0 * self.change:.2g} % in a tenth of the uniform regions"
            )
        sentence = (
            "no accuracy is claimed: images and geometry contradict each other; "
            f"the volume, projected again, differs from the images {self.misfit:.2g} "
            "times as much as it should"
        )
        if not self.kinds:
            return f"{sentence}. {UNEXPLAINED}"
        return f"{sentence}, {100.0 * self.better:.0f} % of it if {self._explanations}"

    @property
    def finer_copy_decides(self) -> bool:
        """True if a finer copy may decide: the images of the coarse one do not, and no
        explanation has a figure that was found by trials on it (`FOUND_BY_TRIALS`).
        """
        return self.change is not None and not FOUND_BY_TRIALS.intersection(self.kinds)

    @property
    def _explanations(self) -> str:
        """Possible explanations, joined by ", or ", each followed by its figure unless
        that is empty.
        """
        words = [
            KINDS[kind] + (f" {figure}" if figure else "")
            for kind, figure in zip(self.kinds, self.figures, strict=True)
        ]
        return ", or ".join(words)


def _with_orders(scan: CoarseScan, comparison: Comparison) -> Comparison:
    """Try orders of the images on all views of a doubtful scan: every second image of an
    interlaced scan has uneven angles, of which the right order fits no better than the
    stated one.

    Args:
        scan: coarse.
        comparison: of some views, without a contradiction.

    Returns:
        The comparison of all views with the `ORDERS`, if it contradicts or leaves one
        open; else `comparison`.
    """
    trial = Trial(scan.thinned(all_views=True, least_rows=RIVALS_ROWS))
    if not trial.telling.any():
        return comparison
    orders = Comparison(trial, doubtful=True, kinds=ORDERS)
    found = orders.contradiction() or orders.undecided(MAX_UNTOLD_CHANGE)
    return comparison if found is None else orders


@dataclass(frozen=True)
class Undetermined:
    """Images of too few views or columns to show whether they fit their geometry.

    Attributes:
        expected: residual of the volume's second reconstruction, over the images: that of
            right geometry; infinite for fewer than `MIN_VIEWS` views or columns
            (`too_few`).
    """

    expected: float

    def __str__(self) -> str:
        """Describe for the user what no comparison tells, and why, as one sentence."""
        if np.isinf(self.expected):
            cause = (
                f"fewer than {MIN_VIEWS} views or columns fit any volume, and most rows of "
                "a short helix see more than is reconstructed"
            )
        else:
            cause = (
                "of so few views, or of a panel so far aside, the volume of a right scan, "
                f"projected again, differs from its images by {100 * self.expected:.2g} % "
                f"(a comparison needs {100 * MAX_RELIABLE_RESIDUAL:.0f} % or less)"
            )
        return (
            "no accuracy is claimed: the images do not show whether they fit their "
            f"geometry; {cause}"
        )


def first_look(scan: CoarseScan) -> Trial | None:
    """Project a scan's coarse volume again, in its stated geometry alone.

    Some views and rows are tried first; all views if the expected residual of values or
    edges is too large; averaged columns while that of both is (`_reliable`).

    Args:
        scan: coarse.

    Returns:
        None for scans of too few views or columns (`too_few`), and for images without an
        object (`MIN_SIGNAL_INTEGRAL`).
    """
    if too_few(scan):
        return None
    if float(np.abs(scan.images).max()) < MIN_SIGNAL_INTEGRAL:
        return None
    thin = scan.thinned()
    trial = Trial(thin)
    if not trial.telling.all() and len(thin.images) < len(scan.images):
        trial = Trial(scan.thinned(all_views=True))
    return _reliable(scan, trial, COMPARED_ROWS)


def in_doubt(trial: Trial, least: float = MIN_DOUBTFUL_MISFIT) -> bool:
    """Return whether images fit their geometry so badly that explanations are looked for:
    a misfit of at least `least`, or centroids that wander (`MAX_WANDER`).
    """
    if not trial.telling.any():
        return False
    return trial.excess >= least or trial.wander > MAX_WANDER


def compared(scan: CoarseScan, trial: Trial | None = None) -> Comparison | None:
    """Compare a scan's images with the projections of its volume, and with those of other
    geometries (`Comparison`), which takes most of the time.

    The comparison is `doubtful` if the first look is (`in_doubt`); orders are then tried
    on all views (`_with_orders`). Else it is made once more, with at least `RIVALS_ROWS`
    rows, and judged by that misfit. Orders are then tried on some views alone, where the
    right one may leave uneven angles and fit no better: what that misses are wrong orders
    that leave no larger misfit than most right scans have, as of bodies that look nearly
    alike from all sides.

    Args:
        scan: coarse.
        trial: its `first_look`, if that has been made.

    Returns:
        None for scans without a first look, and where images fit of which the panel cuts
        a part off.
    """
    trial = trial or first_look(scan)
    if trial is None:
        return None
    if not trial.telling.any():
        return Comparison(trial, doubtful=False)
    if in_doubt(trial):
        comparison = Comparison(trial, doubtful=True)
        fewer = len(trial.scan.images) < len(scan.images)
        # Of a scan that is cut off no orders are suspected.
        if trial.whole and fewer and comparison.contradiction() is None:
            return _with_orders(scan, comparison)
        return comparison
    if not trial.whole:
        return None
    trial = _reliable(scan, Trial(scan.thinned(least_rows=RIVALS_ROWS)), RIVALS_ROWS)
    return Comparison(trial, doubtful=trial.excess >= MIN_DOUBTFUL_MISFIT)


def _covered(claimed: float) -> float:
    """Return the largest change of a coarse volume that a claim covers: its
    `SMOOTH_CHANGE_SHARE`, but at least `MIN_CHANGE` of a claim that is larger, and at most
    `MAX_UNTOLD_CHANGE`.
    """
    least = min(claimed, MIN_CHANGE)
    return min(max(SMOOTH_CHANGE_SHARE * claimed, least), MAX_UNTOLD_CHANGE)


def still_misfits(scan: CoarseScan) -> bool:
    """Return whether images of a finer copy do not fit, either (`MAX_MISFIT`), or cannot
    tell: the misfit of objects finer than the coarse pixels falls, that of a wrong geometry
    does not.

    Args:
        scan: the finer copy.
    """
    trial = Trial(scan.thinned())
    return not trial.telling.any() or trial.excess > MAX_MISFIT


def too_few(scan: CoarseScan) -> bool:
    """Return whether a scan has fewer than `MIN_VIEWS` views or columns, or a helix too few
    rows that see only what is reconstructed (`MIN_SEEN_SHARE`).
    """
    rows = scan.seen_rows
    if rows is not None and float(rows.mean()) < MIN_SEEN_SHARE:
        return True
    few = min(len(scan.circle.step), scan.images.shape[2]) < MIN_VIEWS
    return bool(few)


def _reliable(scan: CoarseScan, trial: Trial, least_rows: int) -> Trial:
    """Average the columns of a scan until a comparison is reliable: streaks of few views
    become shallow, and contradictions stay.

    Args:
        scan: coarse.
        trial: without averaged columns.
        least_rows: of the trial.

    Returns:
        `trial` if one of its measures is reliable, else the first that has one, of all
        views and of columns averaged in pairs, threes, up to `MAX_AVERAGED_COLUMNS`;
        without such a one the last that FDK can use.
    """
    across = 2
    while not trial.telling.any() and across <= MAX_AVERAGED_COLUMNS:
        if scan.images.shape[2] // across < MIN_VIEWS:
            break
        coarser = scan.thinned(all_views=True, least_rows=least_rows, across=across)
        try:
            trial = Trial(coarser)
        except GeometryError:  # too few columns beyond the axis
            break
        across += 1
    return trial


class Comparison:
    """The images of a scan compared with its geometry and with explanations.

    Args:
        trial: of the scan's stated geometry.
        doubtful: the residual is larger than of most scans, so that explanations are
            named; else only those are that fit as well and change the volume.
        kinds: see `__init__`.
        excluded_from: see `__init__`.
    """

    def __init__(
        self,
        trial: Trial,
        *,
        doubtful: bool,
        kinds: frozenset[str] = frozenset(),
        excluded_from: float = MIN_EVIDENCE_SIGMAS,
    ) -> None:
        """Try the opposite rotation and the other suspected geometries, unless no measure
        is reliable ("telling").

        Not doubtful means that the scan fits. Unfit is only a whole scan of even steps
        whose misfit exceeds `MAX_MISFIT`. Panels far aside are tried only on an unfit
        scan, mirrored images only if doubtful, movement only of a whole one that is.

        Args:
            trial: of the scan's stated geometry.
            doubtful: the residual is larger than of most scans.
            kinds: explanations that are tried, none of `FOUND_BY_TRIALS`; all if empty. Of
                some alone no result is that nothing explains the images.
            excluded_from: least evidence against an explanation that excludes it
                [standard errors].
        """
        self._trial = trial
        self._doubtful = doubtful
        fits = not doubtful or trial.excess <= MAX_MISFIT
        self._unfit = trial.whole and trial.even and not fits
        self._excluded_from = excluded_from
        self._tried: list[Tried] = []
        self._movement: Tried | None = None
        if kinds:
            self._tried = trial.only(kinds)
        elif trial.telling.any():
            others = trial.others(far=self._unfit, doubtful=doubtful)
            self._tried = [trial.opposite(), *others]
            # Of images that are cut off, shifts push out of view what does not fit.
            if doubtful and trial.whole:
                beside = [one for one in others if one.suspect.kind in PLACES]
                self._movement = trial.movement(beside)
                self._tried.append(self._movement)

    @property
    def undetermined(self) -> Undetermined | None:
        """The reason why a whole scan's images do not show whether they fit their
        geometry: no measure is reliable; None if one is.
        """
        trial = self._trial
        if not trial.whole or trial.telling.any():
            return None
        return Undetermined(float(trial.expected.min()))

    @property
    def widening(self) -> float:
        """Factor of a bound where the images fit less well than those of most scans: the
        misfit over `MIN_DOUBTFUL_MISFIT`; 1 unless doubtful, whole and tried.
        """
        if not self._tried or not self._doubtful or not self._trial.whole:
            return 1.0
        return self._trial.excess / MIN_DOUBTFUL_MISFIT

    def contradiction(self) -> Contradiction | None:
        """Find the error of the scan's geometry.

        An explanation is named if it changes the volume by more than `MIN_CHANGE`, fits
        clearly better than the stated geometry (`_clearly_better`) and fits well
        (`MAX_MISFIT`); others as good are named with it. If none is clearly better, but
        centroids wander (`MAX_WANDER`), movement is named. Else, if the scan does not fit
        its own geometry, or fits another better by `MIN_FINE_EVIDENCE_SIGMAS`, which does
        not fit well, the result names no explanation.

        Returns:
            None if there is no error, nothing was tried, or the scan is not doubtful.
        """
        trial = self._trial
        if not self._tried or not self._doubtful:
            return None
        best = self._best()
        clear = best is not None and self._clearly_better(best)
        if best is not None and clear and trial.excess_of(best) <= MAX_MISFIT:
            return self._named(self._as_good_as(best), best.score)
        wandering = trial.wander > MAX_WANDER
        if self._movement is not None and wandering and not clear:
            return self._named([self._movement], min(self._movement.score, 1.0))
        refuted = best is not None and clear and best.evidence < -MIN_FINE_EVIDENCE_SIGMAS
        if wandering or refuted:
            return Contradiction(trial.excess)
        if self._unfit and self._movement is not None:
            return Contradiction(trial.excess, by_misfit_alone=True)
        return None

    def undecided(
        self, claimed: float, *, sides_known: bool = False
    ) -> Contradiction | None:
        """Find explanations that fit as well (within `EQUAL_MISFIT_RATIO`, or better by
        `MIN_EVIDENCE_SIGMAS`) and would change the volume by more than a claim covers
        (`_covered`), or that fit better (`_fits_better`) and change it by `MIN_CHANGE`.

        Args:
            claimed: largest relative error that is claimed of nine of ten uniform
                regions.
            sides_known: the geometry was found from beads, so that the kinds of `SIDES`
                need no evidence of these images. A clear contradiction is still found by
                `contradiction`.

        Returns:
            None if the scan is truncated or each such explanation is excluded
            (`_least_evidence_against`), as movement is where another is best (`_best`).
            Else all that are as good as the best; `change` is the largest of theirs, or
            None where the best is clearly better than the stated geometry of a doubtful
            scan.
        """
        rivals = self._rivals(_covered(claimed), sides_known)
        if not self._trial.whole or not rivals:
            return None
        best = min(rivals, key=lambda one: one.score)
        as_good = [one for one in self._as_good_as(best) if one in rivals]
        decided = (
            best.evidence < -MIN_EVIDENCE_SIGMAS
            and self._doubtful
            and self._clearly_better(best)
        )
        if decided:
            change = None
        else:
            change = max(one.change for one in as_good)
        named = self._named(as_good, best.score, change)
        return replace(named, fits_better=change is not None and self._fits_better(best))

    def _rivals(self, covered: float, sides_known: bool) -> list[Tried]:
        """List the explanations of `undecided`: not excluded, as good as the stated
        geometry, and with a change that matters.

        Args:
            covered: change of a volume that the claim covers.
            sides_known: leaves out the kinds of `SIDES`.
        """
        best_of_all = self._best()

        def allowed(one: Tried) -> bool:
            """Return whether nothing excludes an explanation; movement is only taken
            where no other is better.
            """
            if sides_known and one.suspect.kind in SIDES:
                return False
            if one.suspect.shifts is not None and one is not best_of_all:
                return False
            return one.evidence < self._least_evidence_against(one)

        def fits(one: Tried) -> bool:
            """Return whether it fits as well as the stated geometry, or clearly better."""
            if one.evidence < -MIN_EVIDENCE_SIGMAS:
                return True
            return self._trial.fits_as_well(one, EQUAL_MISFIT_RATIO)

        return [
            one
            for one in self._tried
            if allowed(one)
            and one.change > (MIN_CHANGE if self._fits_better(one) else covered)
            and fits(one)
        ]

    @property
    def _clear_score(self) -> float:
        """Score below which an explanation is clearly better than the stated geometry:
        `MAX_BETTER_MISFIT`, or `MAX_MUCH_BETTER_MISFIT` for truncated, uneven or partly
        unreliable scans.
        """
        trial = self._trial
        if trial.whole and trial.even and trial.telling.all():
            return MAX_BETTER_MISFIT
        return MAX_MUCH_BETTER_MISFIT

    def _fits_better(self, one: Tried) -> bool:
        """Return whether an explanation's residual is less than the stated geometry's, by
        `MIN_FINE_EVIDENCE_SIGMAS` and by `EQUAL_MISFIT_RATIO`, also of what each volume's
        second reconstruction explains: angles that fill a gap are only easier for FDK.

        One with a figure that was found by trials (`FOUND_BY_TRIALS`) never fits better:
        the best of many small movements always does a little, and a claim covers it.
        """
        if (
            one.suspect.kind in FOUND_BY_TRIALS
            or one.residual * EQUAL_MISFIT_RATIO >= 1.0
        ):
            return False
        if one.evidence >= -MIN_FINE_EVIDENCE_SIGMAS:
            return False
        return self._trial.excess_of(one) * EQUAL_MISFIT_RATIO < self._trial.excess

    def _clearly_better(self, one: Tried) -> bool:
        """Return whether an explanation leaves less of the residual than `_clear_score`,
        also of what each volume's second reconstruction explains: another geometry may
        only be easier for FDK, as a panel less far aside is.
        """
        trial = self._trial
        most = self._clear_score
        return one.score < most and trial.excess_of(one) < most * trial.excess

    def _best(self) -> Tried | None:
        """Return the explanation that changes the volume by more than `MIN_CHANGE` and
        fits best; None without one.

        Movement, which has two free numbers a view, always fits a little better. It is
        returned if no other is clearly better than the stated geometry, or if it is
        clearly better than any other (`MAX_BETTER_MISFIT`) and centroids wander
        (`MAX_WANDER`). Where the other is a panel at another place, which movement
        includes, centroids decide: whether one number for all views leaves any wander in
        its volume (`MAX_STILL_WANDER`).
        """
        other = [one for one in self._tried if one.change > MIN_CHANGE]
        simple = [one for one in other if one.suspect.shifts is None]
        best = min(simple, key=lambda one: one.score, default=None)
        movement = self._movement
        if movement is None or movement not in other:
            return best
        if best is None or best.score >= MAX_BETTER_MISFIT:
            return movement
        if best.suspect.kind in PLACES:
            wanders = self._trial.wander_of(best) > MAX_STILL_WANDER
            most = EQUAL_MISFIT_RATIO
        else:
            wanders = self._trial.wander > MAX_WANDER
            most = MAX_BETTER_MISFIT
        if wanders and movement.score < most * best.score:
            return movement
        return best

    def finer(self, found: Contradiction, scan: CoarseScan) -> Comparison:
        """Compare a finer copy of the scan with the explanations that this one leaves
        undecided, which are then excluded by `MIN_FINE_EVIDENCE_SIGMAS`.

        Args:
            found: of `undecided`, with `finer_copy_decides`.
            scan: the finer copy.

        Returns:
            The comparison, with those explanations alone; this one where the finer copy
            is not reliable.
        """
        trial = Trial(scan.thinned(least_rows=RIVALS_ROWS))
        if not trial.telling.any():
            return self
        return Comparison(
            trial,
            doubtful=self._doubtful,
            kinds=frozenset(found.kinds),
            excluded_from=MIN_FINE_EVIDENCE_SIGMAS,
        )

    def _least_evidence_against(self, one: Tried) -> float:
        """Return the evidence from which an explanation is excluded [standard errors].

        One without shifts has to fit clearly worse than the stated geometry. Shifts, two
        free numbers a view, fit any images a little better: they count only if they fit
        clearly better.
        """
        if one.suspect.shifts is None:
            return self._excluded_from
        return -MIN_EVIDENCE_SIGMAS

    def _as_good_as(self, best: Tried) -> list[Tried]:
        """Return the explanations that fit within `EQUAL_MISFIT_RATIO` as well as the
        best: movement alone, or others without it; movement with others only where
        centroids wander (`MAX_WANDER`), and not with a panel at another place, which it
        includes.
        """
        if best.suspect.shifts is not None:
            return [best]
        most = EQUAL_MISFIT_RATIO * best.score
        wanders = self._trial.wander > MAX_WANDER
        moves = wanders and best.suspect.kind not in PLACES
        listed = [one for one in self._tried if moves or one.suspect.shifts is None]
        return [one for one in listed if one.score <= most]

    def _named(
        self, as_good: list[Tried], score: float, change: float | None = None
    ) -> Contradiction:
        """Make the contradiction that names explanations, each kind once, with its last
        figure.

        Args:
            as_good: the explanations.
            score: the best one's misfit over that of the stated geometry.
            change: see `Contradiction`.
        """
        figures = {one.suspect.kind: one.suspect.figure for one in as_good}
        kinds = tuple(figures)
        figure_texts = tuple(figures.values())
        return Contradiction(self._trial.excess, kinds, score, figure_texts, change)
