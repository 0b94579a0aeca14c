"""The plane of symmetry of a circular scan, from its mean over a turn or from opposite rays.

First the column about which the images are most symmetric, then all parameters of the
plane, and their uncertainty with a gap between tiles and steps of the images.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.without_phantom.alignment import refuse_if
from flexdt.twin.calibration.without_phantom.circular_scan import (
    OF_TURN,
    CircularScan,
    about_axis,
)
from flexdt.twin.calibration.without_phantom.conjugate_rays import ConjugateRays
from flexdt.twin.calibration.without_phantom.gaps.gap_evidence import (
    SIGMAS,
    GapFound,
    contradicted,
    find_gap,
)
from flexdt.twin.calibration.without_phantom.gaps.hidden_gap import HiddenGap
from flexdt.twin.calibration.without_phantom.mirror_symmetry import (
    REACH,
    Symmetry,
    find_symmetry,
    first_column,
)
from flexdt.twin.calibration.without_phantom.opposite_rays import OppositeRays
from flexdt.twin.calibration.without_phantom.tile_gap import Gap
from flexdt.twin.calibration.without_phantom.turn import Turn, read_turn
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.panel import Panel

BAND: Final = 12
"""Rows above and below the source's plane that are read for opposite rays."""
MIN_COLUMNS: Final = 3
"""Columns that have a second difference, from which noise is estimated."""
MOST_VIEWS: Final = 1440
"""Of more views every second, third and so on is used for opposite rays."""
LEAST_RATIO: Final = 1.5
"""How much less symmetric the mean must be about any other column (ratio of squares;
assumed)."""
MOST_ASYMMETRY: Final = 0.05
"""Largest part of the mean's structure that is neither symmetric nor noise (assumed)."""
MOST_COLUMN: Final = 2.0
"""Largest sigma of the column that is offered [px]."""
MOST_ROLL: Final = 0.5
"""Largest sigma of the roll that is offered [deg]."""
FLOOR_DEG: Final = 0.001
"""Added to the roll's sigma: the effect of beam hardening and lag on the mean (assumed)
[deg]."""
APART_SIGMAS: Final = 4.0
"""From here on a difference between the mean and opposite rays is a warning."""
LEAST_APART_PX: Final = 0.1
"""Least difference of the columns to report, however well both are known [px]: no volume
shows less."""


@dataclass(frozen=True, eq=False)
class FirstColumn:
    """The column about which the images are most symmetric, and the start of the fit of
    the plane.

    Attributes:
        turn: the frames of a full turn; None without one.
        rays: rays that two views see from opposite ends; None with a full turn.
        values: parameters in the order of `circular_scan.FREE`, (k,).
        scales: change of each that moves the image's ends by about a pixel, (k,).
        priors: standard deviation of each, inf for none, (k,).
        column: most symmetric column [px].
        ratio: of the next best column's asymmetry to its own.
        preface: beginning of errors: the reason for no full turn, or the gap.
    """

    turn: Turn | None
    rays: OppositeRays | None
    values: FloatArray
    scales: FloatArray
    priors: FloatArray
    column: float
    ratio: float
    preface: str


class OppositeColumn(NamedTuple):
    """The column by opposite rays, compared with that of the mean of a full turn.

    Attributes:
        apart_px: their column less that of the mean.
        sigma_px: standard deviation of their column from leaving out sectors of the turn.
        mean_sigma_px: that of the column of the mean before the comparison.
    """

    apart_px: float
    sigma_px: float
    mean_sigma_px: float

    @property
    def floor_px(self) -> float:
        """Systematic part missing in the mean's sigma, as far as opposite rays show it
        [px]: their distance and sigma, the less the better the mean is known; the mean's
        own sigma if theirs is infinite.
        """
        if not math.isfinite(self.sigma_px):
            return self.mean_sigma_px
        share = self.mean_sigma_px / math.hypot(self.mean_sigma_px, self.sigma_px)
        return share * math.hypot(self.apart_px, self.sigma_px)

    @property
    def warning(self) -> str | None:
        """Warning that opposite rays and the mean image find different axis columns, by
        more than `APART_SIGMAS` sigmas and `LEAST_APART_PX`; None where they agree.
        """
        sigma = math.hypot(self.mean_sigma_px, self.sigma_px)
        if not abs(self.apart_px) > max(APART_SIGMAS * sigma, LEAST_APART_PX):
            return None
        return (
            f"opposite rays put the axis {self.apart_px:+.3f} +- {self.sigma_px:.2g} "
            f"px beside the column of the mean, {abs(self.apart_px) / sigma:.1f} sigma "
            "apart: something differs between views; the column's sigma contains it"
        )


@dataclass(frozen=True, eq=False)
class SymmetryPlane:
    """The plane of symmetry, with other results of the images.

    Attributes:
        scan: the scan; its images have the gap closed.
        turn: the frames of a full turn, the gap closed; None without one.
        values: parameters in the order of `circular_scan.FREE`, (k,).
        covariance: of them, with the priors, (k, k).
        images_rad: standard deviations of roll and yaw by the images alone, (2,).
        priors_rad: the same before the images, (2,).
        told: whether the images determine roll and yaw, (2,).
        column_sigma_px: standard deviation of the column.
        gap: between two tiles of the panel.
        panel: the distortion that was undone, the gap in it.
        opposite: the column by opposite rays of a full turn.
        hidden: a possible gap near the axis.
    """

    scan: CircularScan
    turn: Turn | None
    values: FloatArray
    covariance: FloatArray
    images_rad: FloatArray
    priors_rad: FloatArray
    told: npt.NDArray[np.bool_]
    column_sigma_px: float
    gap: Gap | None
    panel: Panel | None
    opposite: OppositeColumn | None = None
    hidden: HiddenGap | None = None

    @property
    def sigmas_deg(self) -> tuple[float, float]:
        """Standard deviations of roll and yaw."""
        roll, yaw = np.degrees(np.sqrt(np.diag(self.covariance)[1:3])).tolist()
        return roll, yaw


def find_plane(
    scan: CircularScan, panel: Panel | None, random: np.random.Generator
) -> SymmetryPlane:
    """Find the plane of symmetry.

    A gap between two panel tiles is fitted along, unless the fit shows that there is
    none.

    Args:
        scan: its images, without distortion.
        panel: the distortion that is undone in them.
        random: for images of noise.

    Raises:
        NotIdentifiableError: the images are symmetric about no plane, about several, or
            hardly; the panel has two gaps; or column or roll is too uncertain.
    """
    first = _first_column(scan, random)
    _require_one_column(scan, first)
    seen = _gap(scan, first, panel)
    gap, hidden = seen.gap, seen.hidden
    whole = first
    if gap is not None:
        first = _with_gap(first, gap, seen.values)
    found = _fit(scan, first, gap)
    if gap is not None and _closes(found, gap):
        gap = None
        first = whole
        found = _fit(scan, first, gap)
    if gap is not None:
        hidden = None
    _require_symmetric(found, first.preface)
    judged = seen._replace(gap=gap, hidden=hidden)
    plane = _plane(scan, first, found, judged, panel)
    _require_precise(plane, first.preface)
    return plane


def _first_column(scan: CircularScan, random: np.random.Generator) -> FirstColumn:
    """Search for the axis in the mean over a full turn, or else in opposite rays.

    Args:
        scan: to align; its frames are read.
        random: for images of noise.

    Raises:
        NotIdentifiableError: neither determines it; the message has both reasons.
    """
    try:
        angle = scan.base.angle_scale * scan.poses.angle
        turn = read_turn(scan.image, angle, scan.present, source_row=scan.source_row())
    except NotIdentifiableError as error:
        why = error
    else:
        return _first_in_turn(scan, turn)
    try:
        return _first_in_rays(scan, f"{why.message}; ", random)
    except NotIdentifiableError as error:
        raise NotIdentifiableError(f"{why.message}; {error.message}") from error


def _first_in_turn(scan: CircularScan, turn: Turn) -> FirstColumn:
    """Search for the axis's column in the mean image of a full turn, and set the start values to
    it; yaw alone has a prior.

    `scan`: to align; `turn`: its frames.
    Returns with three parameters; ratio 0 if the best column is at the end of the search (not
    raised here).
    """
    nominal = scan.column(scan.start)
    values = scan.start[:OF_TURN]
    scales = scan.scales[:OF_TURN]
    column, ratio = first_column(turn.mean, nominal)
    values[0] += (column - nominal) / scan.slopes(values, scales)[0]
    priors = np.array([math.inf, math.inf, scan.yaw_prior_rad])
    return FirstColumn(turn, None, values, scales, priors, column, ratio, "")


def _first_in_rays(
    scan: CircularScan, no_turn: str, random: np.random.Generator
) -> FirstColumn:
    """Search for the axis in opposite rays, with all five parameters of `FREE`.

    All but the axis column have priors. `no_turn`: why there is no turn; errors begin
    with it.

    Raises:
        NotIdentifiableError: hardly two views see a line from both ends.
    """
    scales = scan.scales
    given = scan.priors
    scales[1] = 2 / scan.shape[1]
    priors = np.array(
        [
            math.inf,
            math.radians(given["det_roll"]),
            scan.yaw_prior_rad,
            given["dD_z"],
            given["dD_y"],
        ]
    )
    rays = _opposite_rays(scan, scan.start, scales, priors, random)
    values, ratio = rays.first()
    return FirstColumn(
        None, rays, values, scales, priors, scan.column(values), ratio, no_turn
    )


def _require_one_column(scan: CircularScan, first: FirstColumn) -> None:
    """Check that the images are symmetric about one column: another one is as good if
    `ratio` is below `LEAST_RATIO`.

    Args:
        scan: gives the shape.
        first: the best column.

    Raises:
        NotIdentifiableError: no column within `REACH`, or another one as good.
    """
    reach = REACH * scan.shape[1]
    refuse_if(
        first.ratio == 0.0,
        f"{first.preface}the images are symmetric about no column within {reach:.0f} px "
        f"of the nominal one ({scan.column(scan.start):.1f}): the axis is elsewhere, "
        "or too much of the object is out of view",
    )
    refuse_if(
        first.ratio < LEAST_RATIO,
        f"{first.preface}the images are about as symmetric about another column as about "
        f"{first.column:.1f} (ratio {first.ratio:.2f}; at least {LEAST_RATIO:g})",
    )


def _gap(scan: CircularScan, first: FirstColumn, panel: Panel | None) -> GapFound:
    """Look for a gap between two panel tiles that the known panel does not close.

    Nothing without a full turn, or where the machine states none (`gap = 0`). Raises
    NotIdentifiableError: there are two.
    """
    if first.turn is None or scan.priors.get("gap") == 0.0:
        return GapFound(None, None)
    borders = panel.model.borders if panel else ()
    closed = [b.at for b in borders if b.axis == 0]
    rays = ConjugateRays.of(scan, first.turn)
    return find_gap(rays, first.values, first.turn, closed)


def _closes(found: Symmetry, gap: Gap) -> bool:
    """Check whether the fit shows no gap: it converged, and leaves no width above
    `SIGMAS`.

    The width must be known twice as well as by its prior; False beside the axis.
    """
    if gap.beside_axis:
        return False
    sigma = float(np.sqrt(found.covariance[-1, -1]))
    precise = sigma < gap.sigma / 2
    return found.converged and precise and not found.values[-1] > SIGMAS * sigma


def _with_gap(first: FirstColumn, gap: Gap, behind: FloatArray | None) -> FirstColumn:
    """Start at the plane with the gap closed: the mean's axis is off by half its width.

    The width becomes the last parameter, but not beside the axis, where the plane does
    not tell it. `behind`: parameters with it closed; None: the first's.
    """
    values = first.values if behind is None else behind
    if gap.beside_axis:
        return replace(first, values=values, preface=f"{gap.text}; ")
    return replace(
        first,
        values=np.append(values, gap.width),
        scales=np.append(first.scales, 1.0),
        priors=np.append(first.priors, gap.sigma),
        preface=f"{gap.text}; ",
    )


def _fit(scan: CircularScan, first: FirstColumn, gap: Gap | None) -> Symmetry:
    """Fit all parameters of the plane, in the mean over the turn or else in opposite
    rays.

    Args:
        scan: to align.
        first: first estimate of the axis.
        gap: of the panel, whose width is fitted, or fixed beside the axis; None without.

    Returns:
        The plane, perhaps not converged.
    """
    if first.turn is None:
        assert first.rays is not None
        return first.rays.find(first.values)
    return find_symmetry(
        first.turn,
        scan.view,
        first.values,
        first.scales,
        first.priors,
        border=gap.column if gap else None,
        held_px=gap.width if gap and gap.beside_axis else None,
    )


def _require_symmetric(found: Symmetry, preface: str) -> None:
    """Check that a plane was found (converged), and that at most `MOST_ASYMMETRY` of the
    images' structure is not symmetric about it.

    Args:
        found: the plane.
        preface: beginning of errors.

    Raises:
        NotIdentifiableError: they are not.
    """
    refuse_if(
        not found.converged,
        f"{preface}no plane of symmetry is found: too little structure for the noise, "
        "or too few columns on both sides of the axis",
    )
    refuse_if(
        found.asymmetry > MOST_ASYMMETRY,
        f"{preface}{100 * found.asymmetry:.1f} % of the mean, or of opposite rays, "
        f"is not symmetric (at most {100 * MOST_ASYMMETRY:g} %): something does not turn "
        "with the stage, or the angles or the object change during the scan",
    )


def _plane(
    scan: CircularScan,
    first: FirstColumn,
    found: Symmetry,
    gap_found: GapFound,
    panel: Panel | None,
) -> SymmetryPlane:
    """Collect the results, with the uncertainty that the fit does not contain.

    Added are half of a step, doubts of the axis column, an open or hidden gap between
    panel tiles, and a floor of the roll. The gap is closed in images and mean. With
    opposite rays the roll in force is kept, and neither roll nor yaw counts as told; a
    parameter is told if the images know it twice as well as its prior.

    Args:
        scan: the scan.
        first: start of the fit.
        found: its result; not changed.
        gap_found: the gap, and what is hidden.
        panel: the distortion that was undone, or None.
    """
    turn = first.turn
    scales = first.scales
    gap, hidden = gap_found.gap, gap_found.hidden
    values = found.values.copy()
    covariance = found.covariance.copy()
    unseen = hidden.column_px if hidden else 0.0
    if gap is not None and turn is not None:
        if gap.beside_axis:
            unseen = gap.sigma / 2
        else:
            gap, unseen = _gap_of_fit(gap, found, gap_found.widths)
        values = values[:OF_TURN]
        covariance = covariance[:OF_TURN, :OF_TURN]
        scales = scales[:OF_TURN]
        scan, turn = _closed(scan, turn, gap)
        panel = gap.panel(scan.shape, panel)
    determined = found.images[1:3] < first.priors[1:3] / 2
    beside = 0.0
    if first.rays is not None:
        determined[:] = False
        beside = _beside_rows(scan, first.rays, first.priors[1])
        _keep_roll(values, covariance, scan.base.det_roll, first.priors[1])
    if turn is None:
        step = (0.0, 0.0)
    else:
        step = turn.step_px
    opposite = _opposite_column(scan, first, values, covariance, gap)
    floor = opposite.floor_px if opposite else 0.0
    covariance[0, 0] += (math.hypot(floor, step[0] / 2, beside, unseen) * scales[0]) ** 2
    covariance[1, 1] += math.radians(FLOOR_DEG) ** 2 + (step[0] / scan.shape[0]) ** 2
    slopes = scan.slopes(values, scales)
    sigma = math.sqrt(slopes @ covariance @ slopes)
    return SymmetryPlane(
        scan,
        turn,
        values,
        covariance,
        found.images[1:3],
        first.priors[1:3],
        determined,
        sigma,
        gap,
        panel,
        opposite,
        hidden,
    )


def _gap_of_fit(
    gap: Gap, found: Symmetry, widths: Sequence[tuple[float, float]]
) -> tuple[Gap, float]:
    """Give a gap the fitted width, the plane's last parameter [px].

    Its sigma rises as far as the other `widths` contradict it. Returns also what that
    adds to the sigma of the axis column [px].
    """
    sigma = float(np.sqrt(found.covariance[-1, -1]))
    fitted = gap._replace(width=float(found.values[-1]), sigma=sigma)
    raised = contradicted(fitted, widths)
    return raised, math.sqrt(raised.sigma**2 - sigma**2) / 2


def _opposite_column(
    scan: CircularScan,
    first: FirstColumn,
    values: FloatArray,
    covariance: FloatArray,
    gap: Gap | None,
) -> OppositeColumn | None:
    """Compare the column of the mean with that of opposite rays, in the row that these are read
    in.

    `scan`: the scan. `first`: start of the fit. `values` and `covariance`: of the parameters,
    (k,) and (k, k). `gap`: between two tiles, closed in the rays; or None.
    Returns their distance and both sigmas [px]; None without a full turn.
    """
    if first.turn is None:
        return None
    rays = ConjugateRays.of(scan, first.turn)
    if gap is not None:
        rays = rays.closed(gap.column, gap.width)
    slopes = scan.slopes(values, first.scales[: len(values)])
    own = math.sqrt(slopes @ covariance @ slopes)
    moved, sigma = rays.column(values)
    apart = scan.column(moved, rays.row) - scan.column(values, rays.row)
    return OppositeColumn(apart, sigma, own)


def _closed(scan: CircularScan, turn: Turn, gap: Gap) -> tuple[CircularScan, Turn]:
    """Close a gap between panel tiles in the images (each as it is read) and in their
    mean; returns copies of scan and turn, whose doubts, samples and bands stay as they
    were.
    """
    own = gap.panel(scan.shape)
    image = scan.image
    mean = own.undistorted(turn.mean.astype(np.float32)).astype(float)
    closed = replace(scan, image=lambda i: own.undistorted(image(i)))
    return closed, replace(turn, mean=mean)


def _beside_rows(scan: CircularScan, rays: OppositeRays, roll_rad: float) -> float:
    """Compute the axis' motion [px] from the rows read to the middle one by the roll."""
    read = rays.frames.shape[1]
    return float(roll_rad * (rays.top - (scan.shape[0] - read) / 2) * (read > 1))


def _keep_roll(
    values: FloatArray, covariance: FloatArray, roll_rad: float, sigma_rad: float
) -> None:
    """Put the roll in force, value and sigma, in place of the fitted one, in place."""
    # Few rows gave values up to six sigma off.
    values[1] = roll_rad
    covariance[1] = 0.0
    covariance[:, 1] = 0.0
    covariance[1, 1] = sigma_rad**2


def _require_precise(plane: SymmetryPlane, preface: str) -> None:
    """Check the uncertainty of the column (`MOST_COLUMN`), and of the roll (`MOST_ROLL`) if the
    images determine it.

    `plane`: of symmetry; `preface`: beginning of errors.
    Raises NotIdentifiableError: it is too large.
    """
    sigma = plane.column_sigma_px
    (roll, _) = plane.sigmas_deg
    refuse_if(
        sigma > MOST_COLUMN or (bool(plane.told[0]) and roll > MOST_ROLL),
        f"{preface}the column would be known to {sigma:.2g} px and the roll to {roll:.2g} deg; "
        f"allowed: {MOST_COLUMN:g} px and {MOST_ROLL:g} deg (more views or light help)",
    )


def _opposite_rays(
    scan: CircularScan,
    start: FloatArray,
    scales: FloatArray,
    known: FloatArray,
    random: np.random.Generator,
) -> OppositeRays:
    """Collect the rays near the plane of the source that two views see from opposite
    ends.

    At most `MOST_VIEWS` views are read, by angle. Rows within `BAND` of the plane are
    kept; averaged to one if the panel ends there.

    Args:
        scan: the scan.
        start, scales, known: of the parameters, see `OppositeRays`.
        random: for the image of noise.

    Raises:
        NotIdentifiableError: there are hardly any, fewer than `MIN_COLUMNS` columns, or
            the plane is too far from the panel's rows.
    """
    rows, cols = scan.shape
    refuse_if(
        cols < MIN_COLUMNS,
        f"images of {cols} columns do not show their noise; allowed: {MIN_COLUMNS} or more",
    )
    angle = (
        scan.offsets(start).angle_scale
        * scan.poses.angle[list(scan.present)]
        % (2 * np.pi)
    )
    order = np.array(scan.present)[np.argsort(angle, kind="stable")][
        :: -(-len(scan.present) // MOST_VIEWS)
    ]
    some = scan.poses[order]
    first = about_axis(some[:1], scan.offsets(start))
    row = first.project_points([[0.0, 0.0, float(first.source[0, 2])]], scan.shape)[
        0, 0, 1
    ]
    lean = 2 * float(some.sdd[0]) / (cols * float(np.linalg.norm(some.u[0])))
    refuse_if(
        not -lean < row < rows - 1 + lean,
        f"the source turns in the plane of row {row:.0f}: rays to rows 0 to {rows - 1} "
        "lean too much to be those of opposite views; allowed are regions within "
        f"{lean:.0f} rows of it",
    )
    top, end = np.clip(
        np.round(row) + (-BAND, BAND + 1), (0, 1), (rows - 1, rows)
    ).astype(int)
    stack = np.stack([scan.image(i)[top:end] for i in order.tolist()])
    if end - top <= 2 * BAND:
        stack = stack.mean(axis=1, keepdims=True)

    def views(values: FloatArray) -> FloatArray:
        return np.asarray(about_axis(some, scan.offsets(values)).rows)

    return OppositeRays(stack, int(top), scan.shape, views, start, scales, known, random)
