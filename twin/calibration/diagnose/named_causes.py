"""Findings on the causes of the residuals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose import CalibrationCode, listed
from flexdt.twin.calibration.diagnose.causes import SHAPES, Found, border_name
from flexdt.twin.calibration.diagnose.measured_spots import exposure_arc
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import STRAINS, usual_step
from flexdt.twin.calibration.fit.residual_structure import SIGNIFICANT
from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.conventions import FloatArray

CAUSE_WORDS: Final = {
    "stretch": "a phantom of another shape",
    "shear": "a phantom of another shape",
    "beads": "beads elsewhere",
    "arc": "a stage that turns while a frame is exposed",
    "rows": "a stage that turns while the rows of a frame are read",
    "panel": "a panel that distorts",
}
"""Cause that may be left open -> its words."""
SHAPE_LIKE_CAUSES: Final = ("arc", "rows", "beads", "panel")
"""Causes that may look like a phantom of another shape."""
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


def named_causes(fit: FitResult, found: Found) -> list[Finding]:
    """Report the causes of a fit as findings (warnings): certain ones by name, doubtful
    ones together in one, with their rivals.

    Rivals of a strained phantom are named in its own finding.

    Args:
        fit: with the causes as columns.
        found: which there are, and their odds.

    Returns:
        In the order shape, arc, rows, beads, panel, doubtful ones; empty if there is none.
    """
    out: list[Finding] = []
    panel = fit.panel
    borders = () if panel is None else panel.model.borders
    strained = _strained(found)
    out += listed(strained)
    if found.named("arc"):
        out.append(_turning(fit))
    if found.named("rows"):
        out.append(_read_in_turn(fit))
    if found.named("beads"):
        out.append(_elsewhere(fit))
    if found.named("panel") or any(found.named(border_name(b)) for b in borders):
        out.append(_distorted(fit))
    doubtful = [n for n in found.applied if not found.named(n)]
    if strained is not None:  # It is said which rivals it has.
        doubtful = [n for n in doubtful if n not in SHAPES and n not in SHAPE_LIKE_CAUSES]
    if doubtful:
        rivals = dict.fromkeys(
            CAUSE_WORDS.get(n, f"a {n}") for n in [*doubtful, *found.open]
        )
        alternatives = " or ".join(rivals)
        out.append(
            warning(
                CalibrationCode.CAUSES_OPEN,
                "the residuals have a cause that the images do not tell for certain: "
                f"{alternatives}; the intervals contain what they differ by",
            )
        )
    return out


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


def _strained(found: Found) -> Finding | None:
    """Make the warning on the phantom's shape, apart from its scale, which images do not
    determine.

    Args:
        found: the causes, with mean and covariance of the strain.

    Returns:
        The warning, with the causes that look alike; None if the strain is not judged or
        no part is significant.
    """
    if found.strain is None:
        return None
    mean, covariance = found.strain
    leans, rest = lean_of(mean, covariance)
    # What a turn leaves in second order is no other shape.
    strains = strain_words(rest, covariance, max(leans.values(), default=0.0))
    if not strains and not leans:
        return None
    said = []
    if leans:
        said.append(f"the phantom leans on the stage: {lean_words(leans)}")
    if strains:
        said.append(f"the phantom is not as its file says: {strains}")
    alike = [
        CAUSE_WORDS[n] for n in SHAPE_LIKE_CAUSES if n in found.open or n in found.applied
    ]
    if alike:
        rival = f" ({' or '.join(alike)} would look alike)"
    else:
        rival = ""
    return warning(
        CalibrationCode.PHANTOM_STRAINED,
        f"{', and '.join(said)}{rival}. Its shape was fitted, its size is not in the images: "
        "lengths, dO_z and the magnification hold as far as its millimetre; "
        + ("measure it, or give --bead-tolerance MM" if strains else "mount it upright"),
    )


def _turning(fit: FitResult) -> Finding:
    """Make the warning that the object turns during an exposure, with the arc [deg] and
    its share of a step.

    Args:
        fit: with an arc column; a negative square counts as 0.
    """
    layout = fit.problem.layout
    share = float(np.sqrt(max(fit.solution.x[layout.arc_column], 0.0)))
    step = np.degrees(usual_step(fit.problem.poses.angle))
    return exposure_arc(share * step, share, "the mean of the arc was fitted")


def _read_in_turn(fit: FitResult) -> Finding:
    """Make the warning that the object turns while the rows of a frame are read, with the
    arc from the first row to the last [deg] and its share of a step.

    Args:
        fit: with a column of the rows' turn.
    """
    share = float(fit.solution.x[fit.problem.layout.rows_column])
    step = np.degrees(usual_step(fit.problem.poses.angle))
    first, last = ("first", "last") if share > 0.0 else ("last", "first")
    return warning(
        CalibrationCode.ROWS_IN_TURN,
        "a frame's rows are read one after another while the object turns: by "
        f"{abs(share) * step:.2g} deg, {abs(share):.2f} of a step, from the {first} row to the "
        f"{last} (or the phantom is twisted so, which looks alike). It was fitted, and angles "
        "are those of the middle row; volumes of such scans are twisted by as much: stop the "
        "stage for each frame, or expose all rows at once",
    )


def _elsewhere(fit: FitResult) -> Finding:
    """Make the warning that beads lie off the phantom's model and were fitted too, with
    the largest distance and the prior [um].
    """
    moved = np.linalg.norm(fit.beads - fit.problem.model.beads, axis=1)
    return warning(
        CalibrationCode.BEAD_TOLERANCE,
        f"the beads lie {1000 * float(moved.max()):.0f} um off their model at most; their "
        f"positions were fitted too (prior {1000 * fit.bead_prior_mm:.0f} um): wider intervals",
    )


def _distorted(fit: FitResult) -> Finding:
    """Make the warning on the panel's fitted distortion: its largest shift along an axis
    [px], on a grid of 9 x 9 points, and where each tile begins.

    Args:
        fit: must have a panel model.
    """
    panel = fit.panel
    assert panel is not None
    rows, cols = panel.model.shape
    row, column = np.mgrid[0 : rows - 1 : 9j, 0 : cols - 1 : 9j]
    size = float(np.abs(panel.shift(np.stack([column, row], axis=-1))).max())
    tiles = "".join(
        f"; a tile begins at {('column', 'row')[b.axis]} {b.at:.0f}"
        for b in panel.model.borders
    )
    return warning(
        CalibrationCode.PANEL_DISTORTED,
        f"the panel distorts its picture by up to {size:.2f} px{tiles}: this was "
        "estimated along with the geometry, its uncertainty is in every sigma, "
        "and reconstruct undoes it with the correction",
    )
