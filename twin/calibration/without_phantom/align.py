"""Geometry of an ordinary circular scan from its own projections: what it tells, and what not.

Mirror symmetry (`mirror_symmetry.py`) tells where the image of the axis lies and, less well, the
panel's yaw; planes through two sources (`plane_pairs.py`) tell the row in which the source turns
and shifts of single frames. They are given as offsets: dO_x for the column,
det_roll for the panel against the axis, det_yaw, dD_y for the row. A panel shifted sideways looks
as an axis shifted the other way does, but for a yaw of shift / SDD, and one shifted upwards as an
axis that leans, but for a pitch: the geometry as a whole is right whichever of the two it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import wraps
from typing import Final, NamedTuple, ParamSpec

import numpy as np

from flexdt.twin.calibration.fit.fit import axis_in_image
from flexdt.twin.calibration.without_phantom.mirror_symmetry import (
    REACH,
    find_symmetry,
    first_column,
    sharpness,
)
from flexdt.twin.calibration.without_phantom.opposite_rays import OppositeRays
from flexdt.twin.calibration.without_phantom.plane_pairs import (
    PlanePairs,
    Shifts,
    find_height,
    find_shifts,
)
from flexdt.twin.calibration.without_phantom.turn import Gap, Image, Turn, find_gap, read_turn
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray, from_unity
from flexdt.twin.geometry.motion import Motion
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.panel import Panel
from flexdt.twin.geometry.poses import Poses

P = ParamSpec("P")
FREE: Final = ("dO_x", "det_roll", "det_yaw", "dD_z", "dD_y")
"""Of these the last two are not told, but add to what opposite rays leave open."""
UNTOLD: Final[Mapping[str, str]] = {
    "SOD": "an object twice as large at twice the distance gives the same images; a phantom of "
    "known size tells it",
    "magnification": "it is SDD / SOD; a phantom of known size tells it",
    "SDD": "in a circular scan it trades against the object's size; a phantom tells it (dD_z)",
    "det_pitch": "its axis is perpendicular to the plane of symmetry, which stays as it is; a "
    "phantom tells it",
    "dO_y": "a shift along the axis moves the object alone; a phantom tells it",
}
"""What a circular scan, or this method, cannot tell, and why."""

BAND: Final = 12
"""Rows above and below the source's plane that are read for opposite rays."""
MOST_VIEWS: Final = 1440
"""Of more views every second, third and so on is used for opposite rays."""
STANDS: Final = 0.05
"""Source and panel may move so far between frames, seen from the axis [px]."""
LEAST_RATIO: Final = 1.5
"""How much less symmetric the mean must be about any other column (ratio of squares; assumed)."""
MOST_ASYMMETRY: Final = 0.05
"""Of the mean's structure, what may be neither symmetric nor noise (assumed)."""
MOST_COLUMN: Final = 2.0
"""Largest sigma of the column that is offered [px]."""
MOST_ROLL: Final = 0.5
"""Largest sigma of the roll that is offered [deg]."""
FLOOR_PX: Final = 0.01
"""Added to the column's sigma: what beam hardening and lag do to the mean (assumed) [px]."""
FLOOR_DEG: Final = 0.001
"""The same for the roll [deg]."""
STEP_TOLD: Final = 0.2
"""From here on a step of the images is a warning [px]."""
COLUMNS: Final = 256
"""Frames are binned to about so many columns where planes are looked at."""
MOST_FRAMES: Final = 360
"""For the row, of more frames than this every second, third and so on is used."""
MOST_SHIFTS: Final = 2000
"""Frames whose shifts can be asked for."""
FLOOR_OF_ROW: Final = 0.1
"""The row's sigma is this at least: what sampling does (assumed) [px of the binned frames]."""
SHARP_ROWS: Final = 2.0
"""What sampling does to edges along rows as sharp as those of points (assumed) [px]."""
STEP_OF_ROW: Final = 10.0
"""A step of the images may move the row so many times as far (assumed)."""


class AlignEstimate(NamedTuple):
    """A value with its standard deviation."""

    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Alignment:
    """What a scan tells of its geometry.

    Attributes:
        offsets: the correction, all of it: what was in force with what was found; None: refused.
        parameters: axis_column_px and, if the images tell them, det_roll, det_yaw and
            source_row_px [px, deg].
        refused: name -> why it is not given.
        warnings: what is doubtful about the scan.
        frames: number of those that were used.
        motion: shifts of single frames, as shifts of the sample; None: not asked for, or refused.
        panel: the distortion that was undone, with a gap between two tiles that was found; None:
            there is none.
    """

    offsets: Offsets | None
    parameters: Mapping[str, AlignEstimate]
    refused: Mapping[str, str]
    warnings: tuple[str, ...]
    frames: int
    motion: Motion | None = None
    panel: Panel | None = None

    @property
    def identifiable(self) -> bool:
        """Whether the axis column is given."""
        return self.offsets is not None


def _or_refused(find: Callable[P, Alignment]) -> Callable[P, Alignment]:
    """What is not identifiable is refused in the result."""

    @wraps(find)
    def found(*args: P.args, **options: P.kwargs) -> Alignment:
        try:
            return find(*args, **options)
        except NotIdentifiableError as error:
            names = ("axis_column_px", "det_roll", "det_yaw", "source_row_px")
            return Alignment(None, {}, {**dict.fromkeys(names, error.message), **UNTOLD}, (), 0)

    return found


@_or_refused
def align_turn(
    image: Image,
    poses: Poses,
    present: tuple[int, ...],
    shape: tuple[int, int],
    base: Offsets,
    priors: Mapping[str, float],
    random: np.random.Generator,
    per_frame: bool = False,
    panel: Panel | None = None,
) -> Alignment:
    """Estimate axis column, roll, yaw and the source's row from the frames of a turn.

    Args:
        image: line integrals of a frame, (rows, cols).
        poses: nominal poses of all frames.
        present: indices of the frames that are there.
        shape: (rows, cols) of every image.
        base: offsets in force; dO_x, det_roll, det_yaw and dD_y are replaced.
        priors: standard deviation of each offset [mm, deg]; those of the panel and of axis_tilt_x
            count.
        random: for images of noise, which tell what noise does.
        per_frame: whether shifts of single frames are looked for.
        panel: the distortion that is undone in the images.

    Returns:
        The alignment; what the scan cannot tell is in `refused`.
    """
    _refuse_if(len(present) == 0, "no frame is there")
    pose = _standing(poses, present)
    rows, cols = shape
    middle = np.array([(cols - 1) / 2, (rows - 1) / 2])

    def offsets(values: FloatArray) -> Offsets:
        return replace(base, **dict(zip(FREE, values.tolist(), strict=False)))

    def view(values: FloatArray) -> FloatArray:
        return np.asarray(_about_axis(pose, offsets(values)).rows[0])

    def seen(values: FloatArray) -> float:
        return float(axis_in_image(pose, offsets(values), middle)[0])

    start = np.array([getattr(base, name) for name in FREE])
    pitch, sdd = float(np.linalg.norm(pose.u[0])), float(pose.sdd[0])
    ends, nominal = 2 * sdd / cols, seen(start)
    scales = np.array(
        [pitch * float(pose.sod[0]) / sdd, 2 / rows, ends / (pitch * cols), ends, pitch]
    )
    sideways = math.atan(priors["dD_x"] / sdd)
    yaw = max(math.hypot(math.radians(priors["det_yaw"]), sideways), 1e-9)
    turn, rays, instead = None, None, ""
    try:
        turn = read_turn(image, base.angle_scale * poses.angle, present)
    except NotIdentifiableError as error:
        instead = f"{error.message}; "
    if turn is not None:
        known, start, scales = np.array([math.inf, math.inf, yaw]), start[:3], scales[:3]
        column, ratio = first_column(turn.mean, nominal)
        start[0] += (column - nominal) / _slopes(seen, start, scales)[0]
    else:
        scales[1] = 2 / cols
        known = np.array(
            [math.inf, math.radians(priors["det_roll"]), yaw, priors["dD_z"], priors["dD_y"]]
        )
        try:
            rays = _rays(image, poses, present, shape, offsets, start, scales, known, random)
        except NotIdentifiableError as error:
            raise NotIdentifiableError(instead + error.message) from error
        start, ratio = rays.first()
        column = seen(start)
    _refuse_if(
        ratio == 0.0,
        f"{instead}the images are symmetric about no column within {REACH * cols:.0f} px of the "
        f"nominal one ({nominal:.1f}): the axis is elsewhere, or too much of the object is out of "
        "view",
    )
    _refuse_if(
        ratio < LEAST_RATIO,
        f"{instead}the images are about as symmetric about another column as about {column:.1f} "
        f"(ratio {ratio:.2f}; at least {LEAST_RATIO:g})",
    )
    gap = None
    if turn is not None:
        borders = panel.model.borders if panel else ()
        gap = find_gap(turn.samples, column, [b.at for b in borders if b.axis == 0])
        if gap is not None:
            start, scales = np.append(start, gap.width), np.append(scales, 1.0)
            known, instead = np.append(known, gap.sigma), f"{_apart(gap)}; "
        border = gap.column if gap else None
        found = find_symmetry(turn, view, start, scales, known, border)
    else:
        assert rays is not None
        found = rays.find(start)
    _refuse_if(
        not found.converged,
        f"{instead}no plane of symmetry is found: too little structure for the noise, or too few "
        "columns on both sides of the axis",
    )
    _refuse_if(
        found.asymmetry > MOST_ASYMMETRY,
        f"{instead}{100 * found.asymmetry:.1f} % of the mean, or of opposite rays, is not "
        f"symmetric (at most {100 * MOST_ASYMMETRY:g} %): something does not turn with the stage, "
        "or the angles or the object change during the scan",
    )
    values, covariance = found.values.copy(), found.covariance.copy()
    if gap is not None and turn is not None:  # what is read from here on has the gap closed
        gap = gap._replace(width=float(values[-1]), sigma=float(np.sqrt(covariance[-1, -1])))
        values, covariance, scales = values[:3], covariance[:3, :3], scales[:3]
        own, apart = gap.panel(shape), image
        image = lambda i: own.undistorted(apart(i))  # noqa: E731
        turn = replace(turn, mean=own.undistorted(turn.mean.astype(np.float32)).astype(float))
        panel = gap.panel(shape, panel)
    told, beside = found.images[1:3] < known[1:3] / 2, 0.0
    if rays is not None:  # what few rows say of the roll was up to six sigma off
        # It moves the axis in the panel's middle row, if rows beside that were read.
        read = rays.frames.shape[1]
        beside = known[1] * (rays.top - (rows - read) / 2) * (read > 1)
        told[:], values[1], covariance[1], covariance[:, 1] = False, base.det_roll, 0.0, 0.0
        covariance[1, 1] = known[1] ** 2
    step = (0.0, 0.0) if turn is None else turn.step_px
    covariance[0, 0] += (math.hypot(FLOOR_PX, step[0] / 2, beside) * scales[0]) ** 2
    covariance[1, 1] += math.radians(FLOOR_DEG) ** 2 + (step[0] / rows) ** 2
    slopes = _slopes(seen, values, scales)
    sigma = math.sqrt(slopes @ covariance @ slopes)
    roll, turned = np.degrees(np.sqrt(np.diag(covariance)[1:3])).tolist()
    _refuse_if(
        sigma > MOST_COLUMN or (bool(told[0]) and roll > MOST_ROLL),
        f"{instead}the column would be known to {sigma:.2g} px and the roll to {roll:.2g} deg; "
        f"allowed: {MOST_COLUMN:g} px and {MOST_ROLL:g} deg (more views or light help)",
    )
    parameters = {"axis_column_px": AlignEstimate(seen(values), sigma, "px")}
    aside = math.hypot(turned, math.degrees(sideways))
    refused, widths = dict(UNTOLD), (roll, aside)
    for i, name in enumerate(FREE[1:3]):
        if told[i]:
            value = math.degrees(values[1 + i])
            parameters[name] = AlignEstimate(value, widths[i], "deg")
        else:
            refused[name] = (
                f"the images tell it to +- {math.degrees(found.images[1 + i]):.2g} deg, its prior "
                f"to +- {math.degrees(known[1 + i]):.2g} deg: that is what the correction contains"
            )
    corrected, motion = offsets(values[:3]), None
    if turn is None:
        told_by = "a full turn of more rows tells it; the correction keeps what was in force"
        refused |= dict.fromkeys(("det_roll", "source_row_px", "motion"), told_by)
        return Alignment(corrected, parameters, refused, (), len(present), None, panel)
    planes = _Planes(image, poses, turn, offsets, values, covariance, priors)
    try:
        corrected, parameters["source_row_px"] = planes.row(random)
    except NotIdentifiableError as error:
        refused["source_row_px"] = error.message
    if per_frame and turn.repeated:
        refused["motion"] = (
            f"frames {list(turn.repeated)} repeat the one before: from there on the others may be "
            "a step behind their angles"
        )
    elif per_frame:
        try:
            motion = planes.motion(corrected, random)
        except NotIdentifiableError as error:
            refused["motion"] = error.message
    warnings = _warnings(turn, gap, len(poses) - len(present))
    return Alignment(corrected, parameters, refused, warnings, len(turn.used), motion, panel)


def _rays(
    image: Image, poses: Poses, present: tuple[int, ...], shape: tuple[int, int],
    offsets: Callable[[FloatArray], Offsets], start: FloatArray, scales: FloatArray,
    known: FloatArray, random: np.random.Generator,
) -> OppositeRays:  # fmt: skip
    """Rays near the plane of the source that two views see from opposite ends.

    Raises:
        NotIdentifiableError: there are hardly any.
    """
    rows, cols = shape
    angle = offsets(start).angle_scale * poses.angle[list(present)] % (2 * np.pi)
    order = np.array(present)[np.argsort(angle, kind="stable")][:: -(-len(present) // MOST_VIEWS)]
    some = poses[order]
    first = _about_axis(some[:1], offsets(start))
    row = first.project_points([[0.0, 0.0, float(first.source[0, 2])]], shape)[0, 0, 1]
    lean = 2 * float(some.sdd[0]) / (cols * float(np.linalg.norm(some.u[0])))
    _refuse_if(
        not -lean < row < rows - 1 + lean,
        f"the source turns in the plane of row {row:.0f}: rays to rows 0 to {rows - 1} lean too "
        f"much to be those of opposite views; allowed are regions within {lean:.0f} rows of it",
    )
    top, end = np.clip(np.round(row) + (-BAND, BAND + 1), (0, 1), (rows - 1, rows)).astype(int)
    stack = np.stack([image(i)[top:end] for i in order.tolist()])
    if end - top <= 2 * BAND:
        stack = stack.mean(axis=1, keepdims=True)

    def views(values: FloatArray) -> FloatArray:
        return np.asarray(_about_axis(some, offsets(values)).rows)

    return OppositeRays(stack, int(top), shape, views, start, scales, known, random)


class _Planes:
    """What planes through two sources tell once the plane of symmetry is known.

    Args:
        image, poses: as of `align_turn`.
        turn: the frames' mean.
        offsets: of dO_x, det_roll and det_yaw to all.
        values: of those three.
        covariance: of those three.
        priors: as of `align_turn`.
    """

    def __init__(
        self, image: Image, poses: Poses, turn: Turn,
        offsets: Callable[[FloatArray], Offsets], values: FloatArray, covariance: FloatArray,
        priors: Mapping[str, float],
    ) -> None:  # fmt: skip
        self.image, self.poses, self.turn, self.offsets = image, poses, turn, offsets
        self.values, self.priors = values, priors
        self.doubts = np.linalg.cholesky(covariance)
        self.pitch = float(np.linalg.norm(poses.v[turn.used[0]]))
        self.factor = max(1, round(turn.mean.shape[1] / COLUMNS))
        scale = offsets(values).angle_scale
        around = scale * poses.angle[list(turn.used)] % (2 * np.pi)
        self.sorted = np.array(turn.used)[np.argsort(around)]
        self.stack: Float32Array | None = None

    def _of(self, at: FloatArray) -> Offsets:
        """Offsets for the panel's height above what is said [px], three doubts of the plane of
        symmetry and those of SDD and pitch [sigma]."""
        given = self.offsets(self.values + self.doubts @ at[1:4])
        return replace(
            given,
            dD_y=given.dD_y + float(at[0]) * self.pitch,
            dD_z=given.dD_z + float(at[4]) * self.priors["dD_z"],
            det_pitch=given.det_pitch + math.radians(float(at[5]) * self.priors["det_pitch"]),
        )

    def _pairs(self, stride: int, coarser: int = 1) -> PlanePairs:
        """Pairs of every frame, or of every second, third and so on."""
        frames = self.sorted[::stride]
        if self.stack is None or len(self.stack) != len(frames):
            images = [binned_mean(self.image(i), self.factor) for i in frames.tolist()]
            self.stack = np.stack(images)
        poses, stack = self.poses[frames], binned_mean(self.stack, coarser)

        def views(at: FloatArray) -> ConeVec:
            return _about_axis(poses, self._of(at))

        return PlanePairs(stack, self.turn.mean, coarser * self.factor, views, np.zeros(6))

    def row(self, random: np.random.Generator) -> tuple[Offsets, AlignEstimate]:
        """Offsets with the panel's height, and the row of the source's plane.

        Raises:
            NotIdentifiableError: the images do not tell it.
        """
        stride = -(-len(self.sorted) // MOST_FRAMES)
        fine, coarse = (self._pairs(stride, coarser) for coarser in (1, 2))
        height, sigma = find_height(fine, coarse, REACH * self.turn.mean.shape[0], random)
        sampled = FLOOR_OF_ROW * self.factor, SHARP_ROWS * sharpness(self.turn.mean) ** 2
        sigma = math.hypot(sigma, *sampled, STEP_OF_ROW * math.hypot(*self.turn.step_px))
        sdd = float(self.poses.sdd[self.sorted[0]])
        lean = sdd * math.tan(math.radians(self.priors["axis_tilt_x"]))
        known = math.hypot(self.priors["dD_y"], lean) / self.pitch
        _refuse_if(
            sigma > known / 2,
            f"the images tell it to +- {sigma:.2g} px, the priors of dD_y and axis_tilt_x to +- "
            f"{known:.2g} px",
        )
        at = np.array([height, *(5 * [0.0])])
        cone_vec = _about_axis(self.poses[self.sorted[:1]], self._of(at))
        level = [[0.0, 0.0, float(cone_vec.source[0, 2])]]
        row = cone_vec.project_points(level, self.turn.mean.shape)[0, 0, 1]
        return self._of(at), AlignEstimate(float(row), sigma, "px")

    def motion(self, corrected: Offsets, random: np.random.Generator) -> Motion:
        """Shifts of single frames as shifts of the sample, dO_x and dO_y.

        Raises:
            NotIdentifiableError: the images do not tell them, or there are too many frames.
        """
        n = len(self.sorted)
        _refuse_if(n > MOST_SHIFTS, f"{n} frames; shifts are looked for in up to {MOST_SHIFTS}")
        at = np.zeros(6)
        at[0] = (corrected.dD_y - self._of(at).dD_y) / self.pitch
        angle = corrected.angle_scale * self.poses.angle[self.sorted]
        return self._as_motion(find_shifts(self._pairs(1), at, angle, random))

    def _as_motion(self, shifts: Shifts) -> Motion:
        pose = self.poses[self.sorted[:1]]
        scale = self.factor * float(pose.sod[0] / pose.sdd[0])
        values, sigmas = np.zeros((2, len(self.poses), 2))
        sigmas[:] = np.sqrt(np.square(shifts.values).mean(axis=0))  # of frames that are not used
        across, upwards = scale * float(pose.u[0, 0]), scale * float(pose.v[0, 2])
        values[self.sorted] = shifts.values * [across, upwards]
        sigmas[self.sorted] = shifts.sigmas
        return Motion(("dO_x", "dO_y"), values, sigmas * np.abs([across, upwards]), shifts.evidence)


def _about_axis(poses: Poses, offsets: Offsets) -> ConeVec:
    """The views, the rotation axis at the origin."""
    foot = from_unity([offsets.tau_x, 0.0, offsets.tau_z]) - poses.mount
    return poses.cone_vec(offsets).moved(np.eye(3), -foot)


def _standing(poses: Poses, present: tuple[int, ...]) -> Poses:
    """The pose that all frames share but for the angle of the stage.

    Raises:
        NotIdentifiableError: source or panel move, so the scan is not on one circle.
    """
    chosen = np.array(present)
    table = np.hstack([poses.source - poses.axis, poses.detector - poses.axis, poses.u, poses.v])
    table = table[chosen]
    pitch = float(np.linalg.norm(poses.u[chosen[0]]))
    moved = float(np.abs(table - table[0]).max()) / pitch
    _refuse_if(
        moved > STANDS,
        f"source or panel move by {moved:.4g} px between frames; allowed: {STANDS:g} px (one "
        "circle about z, the rotation axis)",
    )
    return poses[chosen[:1]]


def _slopes(seen: Callable[[FloatArray], float], at: FloatArray, scales: FloatArray) -> FloatArray:
    """Change of the column with each parameter, (k,)."""
    steps = np.diag(0.1 * scales)
    return np.array([(seen(at + e) - seen(at - e)) / (2 * e.sum()) for e in steps])


def _refuse_if(wrong: bool, why: str) -> None:
    if wrong:
        raise NotIdentifiableError(why)


def _apart(gap: Gap) -> str:
    return (
        f"from column {gap.column} on everything appears nearer by {gap.width:.2f} +- "
        f"{gap.sigma:.2g} px, as behind a gap between two tiles of the panel"
    )


def _warnings(turn: Turn, gap: Gap | None, missing: int) -> tuple[str, ...]:
    out = []
    if gap is not None:
        out.append(
            f"{_apart(gap)}: it is closed in what is told here, its uncertainty is in the axis "
            "column's sigma, and reconstruct closes it with the correction"
        )
    if turn.repeated:
        out.append(f"frames {list(turn.repeated)} repeat the one before and are left out")
    if missing:
        out.append(f"{missing} frames are missing; the sigmas contain what that may do")
    right, down = turn.step_px
    if abs(right) > STEP_TOLD:
        out.append(
            f"after frame {turn.step_after} the images step by {right:.2f} px to the right and "
            f"{down:.2f} px down: a jump there, or a drift over the scan; the sigmas contain half "
            "of it"
        )
    return tuple(out)
