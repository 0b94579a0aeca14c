"""Explanations of a scan's images, tried beside its stated geometry.

Images are reconstructed as of each geometry, and the volume is projected again. Which geometry
fits better is told by likelihood: the logarithm of the residuals' ratio, in arcs of views, whose
scatter gives the standard error of its mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.acquisition.trajectory import (
    circle_of,
    distinct_angles,
    narrow_overlap,
)
from flexdt.twin.reconstruction.coarse_scan import CoarseScan
from flexdt.twin.reconstruction.consistency.movement import moving, wandering
from flexdt.twin.reconstruction.consistency.reprojection import Reprojection, lowered
from flexdt.twin.reconstruction.consistency.suspects import (
    Suspect,
    moved,
    reversed_turn,
    shifts_of,
    suspects,
)
from flexdt.twin.reconstruction.uniform_nodes import UniformNodes, smoothed

MAX_RELIABLE_RESIDUAL: Final = 0.3
"""Residual of the second reconstruction, over the images, below which it is reliable:
one of few views or few columns beyond the axis has larger ones."""
MIN_VIEWS_A_COLUMN: Final = 1.6
"""Least views for a coarse column of the whole field of view, of which a panel aside sees
half at a time; with fewer, streaks hide contradictions."""
MAX_ARC_RATIO: Final = 2.0
"""Widest over usual angle of a view, above which views are random and weights are
rough."""
MIN_SIGNAL_SHARE: Final = 0.01
"""Share of a residual that is never attributed to noise."""
PROBE_COLUMNS: Final = 0.35
"""Movement of the panel to find the side on which it fits better [coarse columns]."""
FAR_PROBE_COLUMNS: Final = 3.0
"""The same if images do not fit at all [coarse columns]."""
MIN_EVIDENCE_SIGMAS: Final = 2.0
"""Least distance of two likelihoods, in standard errors, at which one geometry fits
better than another."""
NARROW_STEPS: Final = 3
"""Least number of movements of a panel to either side where few columns are beyond the axis:
FDK rounds such an axis to half columns, so that the first steps may fit worse though larger
ones fit better."""
MAX_PROBE_STEPS: Final = 7
"""Number of further movements of the panel, each twice as far."""
UPSIDE_DOWN: Final = frozenset({"rows", "turned"})
"""Explanations whose volume is upside down."""
TURNED: Final = frozenset({"direction", "columns", "turned"})
"""Explanations whose volume is turned about the axis."""
MIRRORED: Final = frozenset({"columns", "rows", "turned"})
"""Explanations by mirrored images."""
REORDERED: Final = frozenset({"listed", "interlaced", "reversed", "names", "span"})
"""Explanations by other angles, which may leave arcs out that the stated ones do not."""
TURN_STEPS: Final = 180
"""Angles of a turn in which a mirrored object is compared."""


@dataclass(frozen=True, eq=False)
class Tried:
    """One explanation beside the stated geometry.

    Attributes:
        suspect: the explanation.
        shown: its images, and its volume's; None where FDK cannot use its geometry.
        score: its misfit over that of the stated geometry.
        residual: the same with noise, from which the evidence is.
        evidence: by how many standard errors the stated geometry fits better.
        find_change: computes `change`, which few explanations need.
    """

    suspect: Suspect
    shown: Reprojection | None
    score: float = np.inf
    residual: float = np.inf
    evidence: float = np.inf
    find_change: Callable[[], float] = float

    @cached_property
    def change(self) -> float:
        """What nine of ten uniform nodes change by at most, relative to their values
        (`Trial._change`); 0 where FDK cannot use the geometry.
        """
        return self.find_change()


class Trial:
    """The stated geometry of a scan, beside which explanations are tried.

    Args:
        scan: coarse; all of its views and rows are compared.
    """

    def __init__(self, scan: CoarseScan) -> None:
        """Reproject the scan in its own geometry and find what can be compared.

        Sets `whole` (no row is cut off), `expected` (misfit (2,) of a second
        reconstruction), `telling` ((2,): for values and their changes, whether that is
        below `MAX_RELIABLE_RESIDUAL`), `excess` (misfit over the expected one), `wander`
        (see `wandering`; 0 for a scan that is not whole) and `even` (views at
        `MIN_VIEWS_A_COLUMN` angles a column of the field of view, and no step above
        `MAX_ARC_RATIO` times the median).

        Args:
            scan: coarse; all of its views and rows are compared.

        Raises:
            GeometryError: FDK cannot use the scan's geometry.
        """
        self.scan = scan
        self.whole = scan.truncation is None or not scan.truncation.cut_off.any()
        own = Reprojection.of(scan, scan.images, scan.cone_vec, scan.truncation)
        if own is None:
            raise GeometryError("FDK cannot use the views of a coarse copy of the scan")
        self.own = own
        self._seconds: dict[Tried, Reprojection | None] = {}
        second = self._second(own, scan.cone_vec)
        self.expected = _misfit_of(second)
        self.wander = 0.0
        if self.whole and second is not None:
            self.wander = wandering(scan.angles, own, second)
        self.telling = self.expected < MAX_RELIABLE_RESIDUAL
        self.excess = self._excess(own, self.expected)
        low, high = scan.ends
        self._aside = abs(high - low) > (low + high) / scan.images.shape[2]
        self._full = circle_of(scan.cone_vec).full
        # A panel aside sees half of the field of view at a time.
        columns = scan.images.shape[2] * 2.0 * max(low, high) / (low + high)
        step = scan.circle.step
        views = len(distinct_angles(scan.circle)[0])
        enough = views >= MIN_VIEWS_A_COLUMN * columns * scan.turns
        self.even = bool(enough and step.max() <= MAX_ARC_RATIO * np.median(step))

    @cached_property
    def _nodes(self) -> UniformNodes:
        """The stated geometry's volume."""
        return UniformNodes.of(self.own.values, self.scan.rim)

    @cached_property
    def _stated(self) -> Reprojection:
        """The stated geometry, beside which explanations are tried: of an object that
        seems cut off also as a complete one, as `_shown` takes it to be, if that fits
        better. What merely ends the continuation of rows explains nothing.
        """
        if self.whole:
            return self.own
        scan = self.scan
        complete = Reprojection.of(scan, scan.images, scan.cone_vec, scan.complete)
        if complete is None or complete.arcs.sum() >= self.own.arcs.sum():
            return self.own
        return complete

    def opposite(self) -> Tried:
        """Try the rotation the other way."""
        return self._tried(reversed_turn(self.scan))

    def others(self, *, far: bool, doubtful: bool = True) -> list[Tried]:
        """Try all explanations but the opposite rotation: panels moved along rows, then
        `suspects`.

        Args:
            far: panels far aside, too, as for images that do not fit.
            doubtful: images mirrored or turned, too (a panel in the middle sees the
                opposite rotation so).
        """
        listed = suspects(self.scan, whole=self.whole)
        chosen = [one for one in listed if doubtful or one.kind not in MIRRORED]
        columns = self.scan.images.shape[2]
        narrow = narrow_overlap(self.scan.circle, self.scan.level, columns)
        steps = NARROW_STEPS if narrow else 1
        return [*self._beside(far, steps), *map(self._tried, chosen)]

    def movement(self, beside: list[Tried]) -> Tried:
        """Try shifts of single images: movement of object or scanner between views.

        Args:
            beside: tried panels at other places, where registration may begin.
        """
        starts = [(np.zeros((len(self.scan.angles), 2)), self.own)]
        for one in beside:
            if one.shown is not None:
                starts.append((shifts_of(self.scan, one.suspect), one.shown))
        return self._compared(*moving(self.scan, starts, self._shown))

    def only(self, kinds: frozenset[str]) -> list[Tried]:
        """Try the explanations of some kinds: of those that `suspects` lists, and the
        opposite rotation.
        """
        listed = [reversed_turn(self.scan), *suspects(self.scan, whole=self.whole)]
        return [self._tried(one) for one in listed if one.kind in kinds]

    def excess_of(self, one: Tried) -> float:
        """Compute an explanation's misfit over that of its volume's second reconstruction
        (cached); infinite if FDK cannot use its geometry.
        """
        if one.shown is None:
            return np.inf
        return self._excess(one.shown, _misfit_of(self._second_of(one, one.shown)))

    def wander_of(self, one: Tried) -> float:
        """Compute how far images' centroids are from those of an explanation's volume
        (`wandering`); infinite if FDK cannot use its geometry.
        """
        if one.shown is None:
            return np.inf
        second = self._second_of(one, one.shown)
        if second is None:
            return np.inf
        angles = circle_of(one.suspect.cone_vec).angle
        return wandering(angles, one.shown, second)

    def fits_as_well(self, one: Tried, ratio: float) -> bool:
        """Return whether an explanation leaves at most `ratio` times the residual of the
        stated geometry, each measured by its volume's second reconstruction; False if FDK
        cannot use its geometry.
        """
        if one.shown is None:
            return False
        expected = _misfit_of(self._second_of(one, one.shown)) / self.expected
        usual = float(np.exp(np.log(expected[self.telling]).mean()))
        return one.residual <= ratio * usual

    def _second_of(self, one: Tried, shown: Reprojection) -> Reprojection | None:
        """Reproject an explanation's volume, reconstructed from its own projections; None
        where FDK cannot use the geometry. It is made once and cached.
        """
        if one not in self._seconds:
            suspect = one.suspect
            self._seconds[one] = self._second(shown, suspect.cone_vec, suspect.shifts)
        return self._seconds[one]

    def _second(
        self, shown: Reprojection, cone_vec: ConeVec, shifts: FloatArray | None = None
    ) -> Reprojection | None:
        """Reconstruct a volume's projections and project them again; None where FDK cannot
        use the geometry.

        Args:
            shown: projections of the volume.
            cone_vec: n views.
            shifts: (n, 2) of the projections, or None.
        """
        scan = self.scan
        noise = shown.noise_again if scan.seen_rows is None else None
        return Reprojection.of(scan, shown.again, cone_vec, scan.complete, shifts, noise)

    def _excess(self, shown: Reprojection, expected: FloatArray) -> float:
        """Compute the misfit relative to the expected one: of changes along rows if those
        are reliable, else of values.
        """
        ratios = shown.misfit(MIN_SIGNAL_SHARE) / expected
        return float(ratios[1 if self.telling[1] else 0])

    def _tried(self, suspect: Suspect) -> Tried:
        """Reproject a suspected geometry and compare it with the scan's own."""
        return self._compared(suspect, self._shown(suspect))

    def _compared(self, suspect: Suspect, shown: Reprojection | None) -> Tried:
        """Compare a suspected geometry with the scan's own, by the reliable ("telling")
        measures.

        Score and residual are geometric means of ratios, suspect to own: below 1 the
        suspect fits better. Evidence is the mean log ratio over arcs, in standard errors:
        negative if the suspect fits better.

        Args:
            suspect: reconstructed as complete: the explanation of a scan also explains
                why it seemed cut off.
            shown: its reprojection; None where FDK cannot use its geometry.

        Returns:
            With the suspect alone (scores infinite) if FDK cannot use it or no measure is
            reliable.
        """
        if shown is None or not self.telling.any():
            return Tried(suspect, None)
        misfits = (shown.misfit() / self._stated.misfit())[self.telling]
        score = float(np.exp(np.log(misfits).mean()))
        residuals = (shown.arcs / self._stated.arcs)[self.telling]
        each = 0.5 * np.log(residuals).mean(axis=0)
        spread = max(float(each.std(ddof=1)), np.finfo(np.float32).tiny)
        evidence = float(each.mean()) * np.sqrt(len(each)) / spread
        residual = float(np.exp(each.mean()))

        def find_change() -> float:
            return self._change(suspect, shown, better=residual < 1.0)

        return Tried(suspect, shown, score, residual, evidence, find_change)

    def _shown(self, suspect: Suspect) -> Reprojection | None:
        """Reproject a suspect; None where FDK cannot use its geometry, or weighs the rays
        of a panel aside otherwise because its angles have gaps and the scan's have not, or
        the other way round: what it does better then may be FDK's.

        Shifted images are cut off as the scan's are. Any other explanation of a scan also
        explains why it seemed cut off.
        """
        scan = self.scan
        if suspect.kind in REORDERED and self._aside:
            try:
                full = circle_of(suspect.cone_vec).full
            except GeometryError:
                return None
            if full != self._full:
                return None
        truncation = scan.complete if suspect.shifts is None else scan.truncation
        return Reprojection.of(
            scan, suspect.images, suspect.cone_vec, truncation, suspect.shifts
        )

    def _change(self, suspect: Suspect, shown: Reprojection, *, better: bool) -> float:
        """Compute the largest relative change of nine of ten uniform nodes of the stated
        geometry's volume; of an explanation that fits better also of its own: a wrong
        geometry leaves small parts without uniform nodes.

        A mirrored volume is turned upside down first (`UPSIDE_DOWN`), and one of `TURNED`
        is compared as it is and turned onto the scan's, whichever is less: the zero of an
        opposite rotation is unknown, and so is which end of an object is up.

        Args:
            suspect: the explanation.
            shown: its volume; voxels of the rim count as 0.
            better: its residual is the smaller one.
        """
        nodes = self._nodes
        values = shown.values
        if suspect.kind in UPSIDE_DOWN:
            # Images are mirrored about the panel's middle, the grid about the copy's.
            values = lowered(values[::-1], self.scan.rest[0])
        if better:
            theirs = UniformNodes.of(values, self.scan.rim)
            sides = [(nodes, theirs.found), (theirs, nodes.found)]
        else:
            values = np.where(self.scan.rim, np.float32(0.0), np.nan_to_num(values))
            sides = [(nodes, smoothed(values))]
        return max(self._change_of(suspect, *side) for side in sides)

    def _change_of(
        self, suspect: Suspect, nodes: UniformNodes, other: Float32Array
    ) -> float:
        """Compute the change of a volume's uniform nodes in another volume, which is also
        turned onto it for one of `TURNED`.
        """
        change = nodes.change(other)
        if suspect.kind not in TURNED:
            return change
        return min(change, nodes.change(_turned_onto(other, nodes.found)))

    def _offset(self, columns: float) -> Tried:
        """Try the panel moved along its rows [coarse columns]."""
        figure = f"by {columns * self.scan.binned[1]:+.1f} px along its rows"
        moved_panel = moved(self.scan.cone_vec, columns)
        return self._tried(Suspect("offset", self.scan.images, moved_panel, figure))

    def _beside(self, far: bool, least_steps: int) -> list[Tried]:
        """Try panels moved along their rows (offset axis): towards the side where images
        fit better, in doubled steps until they fit worse (`MAX_PROBE_STEPS` at most);
        then twice at the parabola's vertex between the best.

        With `far`, larger first steps (`FAR_PROBE_COLUMNS`) are tried if small ones do
        not help. For a whole scan both sides are tried until the evidence against reaches
        `MIN_EVIDENCE_SIGMAS`.

        Args:
            far: see above.
            least_steps: that are tried on either side of a whole scan.

        Returns:
            All that were tried, in order.
        """
        known = {0.0: 1.0}
        tried: dict[float, Tried] = {}

        def score(columns: float) -> float:
            """Score the panel moved by so many columns (0: 1.0); each movement is tried
            once and cached.
            """
            if columns not in known:
                tried[columns] = self._offset(columns)
                known[columns] = tried[columns].score
            return known[columns]

        side = min((-PROBE_COLUMNS, PROBE_COLUMNS), key=score)
        if far and score(side) >= 1.0:
            side = min((-FAR_PROBE_COLUMNS, FAR_PROBE_COLUMNS), key=score)
        at = side
        for _ in range(MAX_PROBE_STEPS):
            if score(at) >= min(value for place, value in known.items() if place != at):
                break
            at *= 2.0
        if len(known) > 3 or score(side) < 1.0:
            for _ in range(2):
                score(_lowest(known))
        for at in (-PROBE_COLUMNS, PROBE_COLUMNS) if self.whole else ():
            for steps in range(1, MAX_PROBE_STEPS + 1):
                score(at)
                excluded = at in tried and tried[at].evidence >= MIN_EVIDENCE_SIGMAS
                if excluded and steps >= least_steps:
                    break
                at *= 2.0
        return list(tried.values())


def _misfit_of(shown: Reprojection | None) -> FloatArray:
    """Return the misfit (2,) of a reprojection; infinite without one."""
    return np.full(2, np.inf) if shown is None else shown.misfit()


def _lowest(known: dict[float, float]) -> float:
    """Find the place of the lowest score: vertex of a parabola through the squares of the
    three lowest, within their range.

    Args:
        known: place -> score, three at least.

    Returns:
        The place; that of the lowest score if one of the three is not finite or the
        parabola opens downwards.
    """
    places = sorted(known, key=known.__getitem__)[:3]
    squares = np.square([known[place] for place in places])
    if not np.isfinite(squares).all():
        return places[0]
    bend, slope, _ = np.polyfit(places, squares, 2)
    if bend <= 0.0:
        return places[0]
    return float(np.clip(-slope / (2.0 * bend), min(places), max(places)))


def _turned_onto(values: Float32Array, other: Float32Array) -> Float32Array:
    """Turn a volume about its middle axis, in steps of a turn over `TURN_STEPS`, so that
    its mean layer is most like that of another.

    Args:
        values: (nz, ny, nx), turned (linear interpolation).
        other: (nz, ny, nx) of the same grid.

    Returns:
        A turned copy; 0 where the corners are empty.
    """
    from scipy.ndimage import rotate

    moving, fixed = (np.fft.rfft(_around(one), axis=1) for one in (values, other))
    likeness = np.fft.irfft((fixed * np.conj(moving)).sum(axis=0), TURN_STEPS)
    turn_deg = 360.0 / TURN_STEPS * int(np.argmax(likeness))
    turned = rotate(values, -turn_deg, axes=(1, 2), reshape=False, order=1)
    return np.asarray(turned, np.float32)


def _around(values: Float32Array) -> FloatArray:
    """Sample the mean layer on circles about its middle, weighted by the roots of their
    radii.

    Args:
        values: (nz, n, n).

    Returns:
        (radii, TURN_STEPS), radii 1, 2 ... below half the side [voxels].
    """
    from scipy.ndimage import map_coordinates

    layer = values.mean(axis=0, dtype=np.float64)
    middle = 0.5 * (len(layer) - 1)
    radii = np.arange(1.0, middle)[:, None]
    angles = 2.0 * np.pi / TURN_STEPS * np.arange(TURN_STEPS)
    places = middle + radii * np.sin(angles), middle + radii * np.cos(angles)
    return np.asarray(np.sqrt(radii) * map_coordinates(layer, places, order=1))
