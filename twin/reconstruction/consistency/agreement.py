"""Whether the images of a scan and its geometry belong together, and by what they do not.

Numbers that agree in any right scan are compared (`cause_table`). What differs by more than noise
and sampling is explained by errors with sizes; geometries that no small error leads to (another
direction, order, span) are compared by likelihood. What remains is stated as such.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.acquisition.trajectory import circle_of
from flexdt.twin.reconstruction.coarse_scan import CoarseScan
from flexdt.twin.reconstruction.consistency.cause_table import (
    ARCS,
    FALSE_ALARMS,
    FINE_BLUR,
    CauseTable,
    Finding,
    findings,
    quantile,
)
from flexdt.twin.reconstruction.consistency.suspects import (
    KINDS,
    SIDES,
    Suspect,
    suspects,
)

TABLE_VIEWS: Final = 120
"""Largest number of views in a table, about: each has to be seen from several sides."""
LIKE_THE_BEST: Final = 0.9
"""Share of the best geometry's gain from which on another one is named with it."""
CONFIRMING: Final = 0.5
"""Least number of differences by which another geometry is confirmed, over that of the stated
one (assumed)."""
VARIANCE_KNOWN: Final = 0.1
"""Relative error of the variances, about, so that smaller differences of surprise say nothing
(assumed)."""
LEAST: Final = 0.01
"""Surprise below which arcs agree perfectly: a hundredth of the usual one."""
EXCLUDED: Final = 0.05
"""Probability with which a right geometry is excluded beside the stated one."""


@dataclass(frozen=True)
class Contradiction:
    """Another geometry that the images fit better than the stated one.

    Attributes:
        kinds: of `suspects.KINDS`, the best first.
        figures: of the kinds; "" where the kind is enough.
        p_value: probability of such a difference if the stated geometry is right.
    """

    kinds: tuple[str, ...]
    figures: tuple[str, ...]
    p_value: float

    def __str__(self) -> str:
        """Say so as one sentence."""
        ways = [
            KINDS[kind] + (f" {figure}" if figure else "")
            for kind, figure in zip(self.kinds, self.figures, strict=True)
        ]
        return (
            "no accuracy is claimed: images and geometry contradict each other "
            f"(p = {self.p_value:.1g}); they fit if {', or '.join(ways)}"
        )


@dataclass(frozen=True, eq=False)
class Agreement:
    """What a comparison of images and geometry came to.

    Attributes:
        contradiction: a geometry that fits better; None without one.
        findings: errors, and the ranges of those that are not told.
        share: (n,) of the scan before each view of the copy.
        unexplained: by how much numbers differ that should agree, beyond noise, sampling
            and the told errors, relative to them.
        open: kinds of `suspects.KINDS` that the images do not exclude.
        compared: there were views to compare.
    """

    contradiction: Contradiction | None = None
    findings: list[Finding] = field(default_factory=list)
    unexplained: float = 0.0
    open: tuple[str, ...] = ()
    compared: bool = False


def looked_at(scan: CoarseScan) -> CauseTable | None:
    """Compare the numbers of a scan that should agree, in its stated geometry alone.

    Of an object that the panel cuts off at its sides opposed rays alone compare. `scan`: coarse.
    Returns None where nothing compares."""
    return _table(scan, scan.images, Suspect("", scan.images, scan.cone_vec))


def agreement_of(scan: CoarseScan, *, sides_known: bool = False) -> Agreement:
    """Compare images and geometry, and explain what differs.

    Args:
        scan: coarse.
        sides_known: beads have told the direction of rotation and mirrored images: what
            these images leave open of it is not open. They are evidence of another scan, and
            hide no contradiction.
    """
    first = looked_at(scan)
    if first is None:
        return Agreement()
    found: tuple[list[Finding], CauseTable] | None = [], first
    if not scan.cut_off:  # opposed rays alone tell errors less well apart
        some, share = _some(scan)
        images, views = _without_level(scan, scan.images[some]), scan.cone_vec[some]
        found = findings(images, views, circle_of(views), share[some])
    if found is None:
        return Agreement()
    told, table = found
    there, base = scan, table
    if not first.doubtful and not any(one.told for one in told):
        # What images leave open is seen as well with fewer pixels.
        fewer = looked_at(scan.halved)
        if fewer is not None and fewer.counts.keys() == table.counts.keys():
            there, base = scan.halved, fewer
    stated = base.surprise()
    better: list[tuple[float, float, Suspect]] = []
    undecided = []
    for one in suspects(there):
        rival = _table(there, one.images, one)
        if rival is None:
            continue
        # A span of few opposed rays is not confirmed as the stated one is by its own.
        surprise = {
            kind: value
            for kind, value in rival.surprise().items()
            if rival.counts[kind] >= CONFIRMING * base.counts.get(kind, 0)
        }
        confirmed = len(surprise) >= len(stated)
        if not confirmed and not first.doubtful:
            continue
        gain, evidence = _evidence(stated, surprise)
        alike = abs(gain) < VARIANCE_KNOWN * base.surprises
        beads_tell = sides_known and one.kind in SIDES
        if confirmed and (alike or evidence > -quantile(2.0 * EXCLUDED)):
            undecided += [one.kind] * (not beads_tell)
        better.append((evidence, gain, one))
    left = table.unexplained()
    bar = quantile(FALSE_ALARMS / max(len(better), 1))
    # Of a round body any order averages the error of sampling: it has to explain most.
    least = 0.5 * table.surprises
    fitting = [one for one in better if one[0] > bar and one[1] > least]
    fitting.sort(key=lambda one: -one[1])
    if not fitting or not first.doubtful:
        return Agreement(None, told, left, tuple(dict.fromkeys(undecided)), compared=True)
    most = fitting[0][1]
    named = [one for one in fitting if one[1] > LIKE_THE_BEST * most]
    contradiction = Contradiction(
        tuple(one.kind for *_, one in named),
        tuple(one.figure for *_, one in named),
        min(1.0, _probability(fitting[0][0]) * len(better)),
    )
    return Agreement(contradiction, told, left, (), compared=True)


def _some(scan: CoarseScan) -> tuple[slice, FloatArray]:
    """Return a choice of views, and the share of the scan before each of the copy."""
    each = -(-len(scan.images) // TABLE_VIEWS)
    return slice(None, None, each), scan.share


def _table(scan: CoarseScan, images: Float32Array, one: Suspect) -> CauseTable | None:
    """Make the table of a geometry; None where it has none."""
    some, share = _some(scan)
    views = one.cone_vec[some]
    try:
        circle = circle_of(views)
    except GeometryError:
        return None
    level = _without_level(scan, images[some])
    return CauseTable.of(level, views, circle, share[some], FINE_BLUR, not scan.cut_off)


def _without_level(scan: CoarseScan, images: Float32Array) -> Float32Array:
    """Subtract what each view has beside the object, of the side that has less; nothing of one
    that the panel cuts off."""
    if scan.cut_off:
        return images
    ends = images[:, :, [0, -1]].mean(axis=1)
    beside = np.take_along_axis(ends, np.abs(ends).argmin(axis=1)[:, None], axis=1)
    return np.ascontiguousarray(images - beside[:, :, None])


def _evidence(
    stated: dict[str, FloatArray], rival: dict[str, FloatArray]
) -> tuple[float, float]:
    """Compare surprises by arcs: how much less the rival has, and in standard errors of `ARCS`
    clusters that are as improbable, by the logarithms of arcs, which differ by far.

    Kinds of rows count alike, each by the arcs where both geometries have such rows.
    """
    from scipy.special import stdtr, stdtrit

    gain, ratio, square, freedom = 0.0, 0.0, 0.0, 0.0
    for kind, one in stated.items():
        other = rival.get(kind, one)
        both = np.isfinite(one) & np.isfinite(other)
        if both.sum() < 2:
            continue
        gain += float((one - other)[both].mean()) / len(stated)
        less = np.log(np.maximum(one[both], LEAST) / np.maximum(other[both], LEAST))
        part = float(less.var(ddof=1)) / len(less)
        ratio += float(less.mean())
        square += part
        freedom += part * part / (len(less) - 1.0)
    if square <= 0.0:
        return gain, 0.0
    ratio /= np.sqrt(square)
    chance = float(stdtr(square * square / freedom, -abs(ratio)))  # Welch, Satterthwaite
    evidence = -float(stdtrit(ARCS - 1.0, max(chance, 1e-30)))
    return gain, float(np.copysign(evidence, ratio))


def _probability(evidence: float) -> float:
    """Compute how probable so much evidence is by chance."""
    from scipy.special import stdtr

    return float(stdtr(ARCS - 1.0, -evidence))
