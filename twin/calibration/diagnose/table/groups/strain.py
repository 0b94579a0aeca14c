"""Strain: the phantom has another shape than its file says, about the middle of its beads.

A strain about another point is the same strain at another place. So the place of a phantom of
another shape (tau, dO) is defined as that of its beads' mean, which images show and which does not
depend on where the origin of its file is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.table.group import (
    LOG_CHANCE,
    Acts,
    Family,
    Found,
    Known,
)
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.calibration.fit.problem import STRAINS, STRETCHES
from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.told_lengths import PHANTOM

NAME: Final = "strain"
WORDS: Final = "a phantom of another shape"
SHAPES: Final = ("stretch", "shear")
WIDEST: Final = 4e-2
"""Largest standard deviation of a strain: of a phantom that is another, more."""
SIGNIFICANT: Final = 4.5
"""Standard deviations from which a part of a strain is told."""
LENGTHS: Final = {
    "xx": ("longer along x", "shorter along x"),
    "yy": ("longer along y", "shorter along y"),
    "zz": ("taller", "less tall"),
}
"""Stretch -> words on it where it is above, and below 0."""
SHEARS: Final[dict[str, dict[str, float]]] = {
    "sheared across": {"xy": 1.0, "yx": 1.0},
    "aslant along x": {"xz": 1.0},
    "tilted along x": {"zx": 1.0},
    "aslant along y": {"yz": 1.0},
    "tilted along y": {"zy": 1.0},
}
"""Words on a shear -> its weights of STRAINS."""
LEANS: Final = {"x": ("xz", "zx"), "y": ("yz", "zy")}
"""Direction -> the two shears that are opposite where a rigid phantom leans that way."""
LEAST_PART: Final = 0.3
"""Part of the largest strain below which another is not told."""


def _row(terms: Mapping[str, float]) -> FloatArray:
    """Return weights of STRAINS, (len(STRAINS),)."""
    return np.array([terms.get(term, 0.0) for term in STRAINS])


def _parts(mean: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """Yield the parts of a strain that images determine: words, and weights of STRAINS.

    Images do not tell the scale, so the two stretches are told beside the middle one: a
    phantom of one wrong length differs in that one.

    Args:
        mean: of the strain, (len(STRAINS),).
    """
    stretch = {name: float(_row({name: 1.0}) @ mean) for name in LENGTHS}
    middle = sorted(stretch, key=stretch.__getitem__)[1]
    for name, (above, below) in LENGTHS.items():
        if name == middle:
            continue
        beside = _row({name: 1.0, middle: -1.0})
        if beside @ mean < 0.0:
            yield below, -beside
        else:
            yield above, beside
    for words, terms in SHEARS.items():
        yield words, _row(terms)


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make stretches and shears: as wide as stated, which always holds, and wider; none for
    exact beads.

    The images tell how stretches differ, not the scale that they share: that of a phantom of
    another shape is wider in the same proportion as its stretches.
    """
    if known.bead_tolerance_mm == 0:
        return
    columns = table.problem.layout.strain_columns
    first = columns.start
    parts = (
        np.arange(first, first + STRETCHES),
        np.arange(first + STRETCHES, columns.stop),
    )
    for name, part, stated in zip(SHAPES, parts, known.strain, strict=True):
        rows = table.columns[None, :, part]
        if stated > 0:
            yield Family(
                NAME,
                (f"{name} as stated",),
                Acts.COLUMNS,
                (part,),
                0.0,
                rows,
                always=stated,
            )
        root = None
        if name == SHAPES[0]:
            share = _scale_share(table, stated)
            shape = np.linalg.cholesky(np.eye(STRETCHES) + share**2)
            root = np.asarray(shape, dtype=np.float64)
            rows = rows @ root
        yield Family(
            NAME, (name,), Acts.COLUMNS, (part,), LOG_CHANCE, rows, widest=WIDEST,
            root=root,
        )  # fmt: skip


def _scale_share(table: Linearised, stretch: float) -> float:
    """Compute the standard deviation of the phantom's scale over that of a stretch, both as
    stated; 0 where the scale is exact, at most 1.
    """
    names = table.problem.layout.names[: table.parameters]
    if PHANTOM not in names or stretch <= 0.0:
        return 0.0
    scale = float(table.plain.prior_sigma[names.index(PHANTOM)])
    return min(scale / stretch, 1.0)


def lean_of(
    mean: FloatArray, covariance: FloatArray
) -> tuple[dict[str, float], FloatArray]:
    """Split the lean of a rigid phantom off a strain.

    Directions lean where both shears are beyond `SIGNIFICANT` sigmas and opposite, but for
    `LEAST_PART`.

    Args:
        mean, covariance: (len(STRAINS),) and its square.

    Returns:
        Direction of the phantom, such as "-x", -> angle by which its upper end goes there
        [rad]; and the strain without it.
    """
    rest = mean.copy()
    leans = {}
    for axis, names in LEANS.items():
        at = [STRAINS.index(n) for n in names]
        up, down = mean[at]
        sigmas = np.sqrt(covariance[at, at])
        lean = 0.5 * (up - down)
        if np.all(np.abs(mean[at]) > SIGNIFICANT * sigmas) and abs(
            up + down
        ) < LEAST_PART * abs(lean):
            leans["+-"[int(lean < 0.0)] + axis] = float(abs(lean))
            rest[at] = 0.0
    return leans, rest


def strain_words(mean: FloatArray, covariance: FloatArray, beside: float = 0.0) -> str:
    """Write the parts of a strain beyond `SIGNIFICANT` sigmas that are above `LEAST_PART` of
    the largest, such as "0.3 % taller"; "" if there is none.

    Args:
        mean, covariance: (len(STRAINS),) and its square.
        beside: size of what else is told, among the largest.
    """
    certain = {}
    for words, row in _parts(mean):
        value = float(row @ mean)
        sigma = max(float(np.sqrt(row @ covariance @ row)), 1e-12)
        if abs(value) > SIGNIFICANT * sigma:
            certain[words] = value
    most = max([beside, *map(abs, certain.values())])
    return ", ".join(
        f"{100 * value:{'+' if words in SHEARS else ''}.2g} % {words}"
        for words, value in certain.items()
        if abs(value) > LEAST_PART * most
    )


def lean_words(leans: Mapping[str, float]) -> str:
    """Write angles of a lean [rad] by their directions."""
    return " and ".join(
        f"by {np.degrees(angle):.2g} deg towards its {way}"
        for way, angle in leans.items()
    )


def told(found: Found) -> list[Finding]:
    """Tell the phantom's shape where a part of it is significant, apart from its scale, which
    images do not determine, with the causes that look alike.
    """
    if found.strain is None:
        return []
    mean, covariance = found.strain
    leans, rest = lean_of(mean, covariance)
    # What a turn leaves in second order is no other shape.
    strains = strain_words(rest, covariance, max(leans.values(), default=0.0))
    if not strains and not leans:
        return []
    said = []
    if leans:
        said.append(f"the phantom leans on the stage: {lean_words(leans)}")
    if strains:
        said.append(f"the phantom is not as its file says: {strains}")
    alike = [words for words in found.open if words != WORDS]
    rival = f" ({' or '.join(alike)} would look alike)" if alike else ""
    return [
        warning(
            CalibrationCode.PHANTOM_STRAINED,
            f"{', and '.join(said)}{rival}. Its shape was fitted, its size is not in the "
            "images: lengths, dO_z and the magnification hold as far as its millimeter; "
            + (
                "measure it, or give --bead-tolerance MM"
                if strains
                else "mount it upright"
            ),
        )
    ]
