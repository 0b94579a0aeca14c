"""Whether the images of a scan and its geometry belong together.

A coarse volume is projected again and compared with the images. How large the residual is where
both are right depends on object and trajectory; the volume, projected and reconstructed a
second time, shows it. Where the residual is larger, other explanations are tried, each with a
coarse reconstruction of its own. All of it is done with few views and rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.reconstruction.coarse_scan import CoarseScan
from flexdt.twin.reconstruction.consistency.reprojection import Reprojection
from flexdt.twin.reconstruction.consistency.suspects import (
    KINDS,
    Suspect,
    moved,
    reversed_turn,
    suspects,
)

MAX_MISFIT: Final = 2.5
"""Largest residual of fitting images, over that of the volume's second reconstruction:
right ones have 0.8 to 1.9, hardened ones up to 2.2 (`tests/studies/misfits.py
--right`)."""
MAX_BETTER_MISFIT: Final = 0.92
"""Misfit of an explanation, relative to the stated geometry's, below which it is
better: right scans have 0.96 and more."""
MAX_MUCH_BETTER_MISFIT: Final = 0.7
"""The same where the panel cuts the object off, whose outer parts no volume holds, and
where the coarse volume shows no edges."""
MIN_DOUBTFUL_MISFIT: Final = 1.4
"""Residual over that of the second reconstruction, below which images fit and nothing
is tried: more than half of right scans; wrong ones that are detected have 1.44 and
more."""
MAX_RELIABLE_RESIDUAL: Final = 0.3
"""Residual of the second reconstruction, over the images, below which it is reliable:
one of few views or few columns beyond the axis has larger ones."""
MIN_VIEWS_A_COLUMN: Final = 1.6
"""Least views for a coarse column; with fewer, streaks hide contradictions."""
MIN_VIEWS: Final = 12
"""Least number of views and coarse columns; with fewer a volume fits anything and no
result is given."""
MAX_ARC_RATIO: Final = 2.0
"""Widest over usual angle of a view, above which views are random and weights are
rough."""
EQUAL_MISFIT_RATIO: Final = 1.05
"""Largest misfit of an equally good explanation, over the best one's."""
MIN_SIGNAL_SHARE: Final = 0.01
"""Share of a residual that is never attributed to noise."""
PROBE_COLUMNS: Final = 0.35
"""Movement of the panel to find the side on which it fits better [coarse columns]."""
FAR_PROBE_COLUMNS: Final = 3.0
"""The same if images do not fit at all [coarse columns]."""
UNEXPLAINED: Final = (
    "No other direction, order, mirror or offset explains it; motion during the scan "
    "does, images "
    "in a wrong order, and images that are not line integrals of one object"
)
MAX_PROBE_STEPS: Final = 7
"""Number of further movements of the panel, each twice as far."""


@dataclass(frozen=True)
class Contradiction:
    """A contradiction between images and their geometry.

    Attributes:
        misfit: residual over its expected value.
        kinds: of `suspects.KINDS`, the best explanation; empty without one.
        better: misfit that the best explanation leaves, over `misfit`; 1 without one.
        figures: of the kinds.
    """

    misfit: float
    kinds: tuple[str, ...] = ()
    better: float = 1.0
    figures: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Describe the contradiction for the user."""
        said = (
            "no accuracy is claimed: images and geometry contradict each other; the volume, "
            f"projected again, differs from the images {self.misfit:.2g} times as much "
            "as it should"
        )
        if not self.kinds:
            return f"{said}. {UNEXPLAINED}"
        words = [
            KINDS[kind] + (f" {figure}" if figure else "")
            for kind, figure in zip(self.kinds, self.figures, strict=True)
        ]
        return f"{said}, {100.0 * self.better:.0f} % of it if {', or '.join(words)}"


def contradiction_of(scan: CoarseScan) -> Contradiction | None:
    """Find whether a scan's images contradict its geometry.

    Args:
        scan: coarse; some of its views and rows are compared.

    Returns:
        None if they fit, for helices, and for scans of too few views or columns.
    """
    if scan.circle.rise or min(len(scan.circle.step), scan.images.shape[2]) < MIN_VIEWS:
        return None
    thin = scan.thinned()
    trial = _Trial(thin)
    if not trial.telling.all() and len(thin.images) < len(scan.images):
        trial = _Trial(scan.thinned(all_views=True))
    return trial.verdict()


@dataclass(frozen=True, eq=False)
class _Tried:
    """One explanation with its misfit.

    Attributes:
        suspect: the explanation.
        shown: its images, and its volume's; None where FDK cannot use its geometry.
        score: its misfit over that of the scan's stated geometry.
    """

    suspect: Suspect
    shown: Reprojection | None
    score: float


class _Trial:
    """Explanations compared with the stated geometry of the scan."""

    def __init__(self, scan: CoarseScan) -> None:
        """Reconstruct the scan as stated and project it again, and compare the residuals with
        those expected.
        """
        self.scan = scan
        self.whole = scan.truncation is None or not scan.truncation.cut_off.any()
        own = Reprojection.of(scan, scan.images, scan.cone_vec, scan.truncation)
        assert own is not None  # as a scan has a volume
        self.misfit = own.misfit()
        self.expected = self._expected(own, scan.cone_vec)
        self.telling = self.expected < MAX_RELIABLE_RESIDUAL
        self.excess = self._excess(own, self.expected)
        step = scan.circle.step
        enough = len(step) >= MIN_VIEWS_A_COLUMN * scan.images.shape[2]
        self.even = bool(enough and step.max() <= MAX_ARC_RATIO * np.median(step))

    def verdict(self) -> Contradiction | None:
        """Judge the scan's geometry by trying other ones: reversed, shifted sideways and those
        of `suspects`.

        Returns:
            The contradiction, with the kinds of error that explain it (none if the images fit
            no trial); None if the images fit.
        """
        if not self.telling.any() or self.excess < MIN_DOUBTFUL_MISFIT:
            return None
        unfit = self.whole and self.even and self.excess > MAX_MISFIT
        better = (
            MAX_BETTER_MISFIT
            if self.whole and self.even and self.telling.all()
            else MAX_MUCH_BETTER_MISFIT
        )
        tried = [self._tried(reversed_turn(self.scan)), *self._beside(unfit)]
        tried += [
            self._tried(one)
            for one in suspects(self.scan, whole=self.whole and self.even)
        ]
        best = min(tried, key=lambda one: one.score)
        if best.score < better and self._explains(best):
            as_good = [
                one for one in tried if one.score <= EQUAL_MISFIT_RATIO * best.score
            ]
            named = {one.suspect.kind: one.suspect.figure for one in as_good}
            kinds, figures = tuple(named), tuple(named.values())
            return Contradiction(self.excess, kinds, best.score, figures)
        return Contradiction(self.excess) if unfit else None

    def _explains(self, one: _Tried) -> bool:
        """Return whether the images fit an explanation, not only better than the scan."""
        if one.shown is None:
            return False
        expected = self._expected(one.shown, one.suspect.cone_vec)
        return self._excess(one.shown, expected) <= MAX_MISFIT

    def _expected(self, shown: Reprojection, cone_vec: ConeVec) -> FloatArray:
        """Compute the misfit of a volume's second reconstruction, infinite without one,
        (2,).
        """
        again = Reprojection.of(self.scan, shown.again, cone_vec, None)
        return np.full(2, np.inf) if again is None else again.misfit()

    def _excess(self, shown: Reprojection, expected: FloatArray) -> float:
        """Compute the misfit relative to the expected one: by edges, if the coarse volume
        has some.
        """
        return float(
            (shown.misfit(MIN_SIGNAL_SHARE) / expected)[1 if self.telling[1] else 0]
        )

    def _tried(self, suspect: Suspect) -> _Tried:
        """Score a suspected geometry: its residuals over those of the stated one, the geometric
        mean; inf if it has no volume.
        """
        # The explanation of a scan also explains why it seemed cut off.
        shown = Reprojection.of(self.scan, suspect.images, suspect.cone_vec, None)
        if shown is None:
            return _Tried(suspect, None, np.inf)
        ratios = (shown.misfit() / self.misfit)[self.telling]
        return _Tried(suspect, shown, float(np.exp(np.log(ratios).mean())))

    def _offset(self, columns: float) -> _Tried:
        """Try the panel moved along its rows [coarse columns]."""
        said = f"by {columns * self.scan.binned[1]:+.1f} px along its rows"
        moved_panel = moved(self.scan.cone_vec, columns)
        return self._tried(Suspect("offset", self.scan.images, moved_panel, said))

    def _beside(self, unfit: bool) -> list[_Tried]:
        """Try panels moved along their rows towards the side where images fit better.

        Args:
            unfit: images do not fit, so that far places are tried as well.
        """
        known = {0.0: 1.0}
        tried: dict[float, _Tried] = {}

        def score(columns: float) -> float:
            """Score a shift of the panel by some columns; each is tried once."""
            if columns not in known:
                tried[columns] = self._offset(columns)
                known[columns] = tried[columns].score
            return known[columns]

        side = min((-PROBE_COLUMNS, PROBE_COLUMNS), key=score)
        if unfit and score(side) >= 1.0:
            side = min((-FAR_PROBE_COLUMNS, FAR_PROBE_COLUMNS), key=score)
        at = side
        for _ in range(MAX_PROBE_STEPS):
            if score(at) >= min(value for place, value in known.items() if place != at):
                break
            at *= 2.0
        if len(known) > 3 or score(side) < 1.0:
            for _ in range(2):
                score(_lowest(known))
        return list(tried.values())


def _lowest(known: dict[float, float]) -> float:
    """Find the vertex of a parabola through the squares of the three lowest scores."""
    places = sorted(known, key=known.__getitem__)[:3]
    squares = np.square([known[place] for place in places])
    if not np.isfinite(squares).all():
        return places[0]
    bend, slope, _ = np.polyfit(places, squares, 2)
    if bend <= 0.0:
        return places[0]
    return float(np.clip(-slope / (2.0 * bend), min(places), max(places)))
