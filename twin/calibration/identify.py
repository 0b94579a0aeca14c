"""Identification: which spot belongs to which bead, given the phantom's model and a rough
geometry without a start angle.

Many start angles are tried on some of the frames: predict, vote for the shift that brings
predictions and spots together, assign within each frame (`linear_sum_assignment`), fit, and
repeat with a narrower gate. The best hypotheses are finished on all frames, and so are the turns
of each after which the phantom looks the same. Places, missing spots, sizes and contrasts weigh
them; those that are as likely as the best one, with another angle, are its rivals.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import (
    BeadModel,
    BeadPhantom,
    bead_model,
    spot_radii,
)
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.fit.fit import RAYLEIGH_MEDIAN, Solver, solve
from flexdt.twin.calibration.fit.forecast import visible_beads
from flexdt.twin.calibration.fit.priors import OFFSETS, STRAIN
from flexdt.twin.calibration.fit.problem import (
    SIX,
    UNSTRAINED,
    FitProblem,
    as_poses,
    build_problem,
)
from flexdt.twin.calibration.repeated_frames import ROBUST
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, stage_rotation
from flexdt.twin.geometry.offsets import NAMES, NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.geometry.symmetries import Symmetry, spacing, symmetry

LOOSE_PX = 0.6
"""Root mean square distance of spots from their beads above which panel and axis are
loosened."""
LOOSE_FACTOR = 15.0
"""Factor on the priors of panel and axis then."""
WIDE_PX = (120.0, 60.0, 40.0)
NARROW_PX = (25.0, 15.0, 10.0)
"""Gates of the rounds from all start angles, and of those from the promising ones."""
LEAST_GAIN = 0.01
"""Share of its loss that a hypothesis has to lose in a round to go on with the same gate."""
SETTLED_PX = 1e-3
"""Change of the residuals' rms below which a hypothesis is settled, well below the error of a
spot. The fit of the geometry goes on from there."""
ASLANT = (STRAIN, 0.06)
"""Standard deviations of the stretches of a phantom that stands aslant, as assumed, and of its
shears: 0.06 are 3.4 deg."""
MAX_FINALISTS = 4
"""Number of hypotheses finished on all frames."""
STARTS_BETWEEN = 4.0
"""Start angles from a bead to its neighbor, where a turn brings one to the other."""
MAX_RIVAL_LOG = 12.5
"""Largest logarithm of the likelihood of the best hypothesis over a rival's."""
AS_LIKELY_LOG = math.log(20.0)
"""The same up to which the one nearest to the start is taken."""
MISSING_LOG = math.log(20.0)
"""Cost of a bead in view without a spot: one in twenty has none (assumed)."""
SIZE_SPREAD = 0.05
"""Relative error of a bead's stated radius beside the others', with what blur does to it;
assumed."""
CONTRAST_SPREAD = 0.25
"""The same of a contrast: attenuations are of one energy, a beam has many; assumed."""
MOST_FAR = 25.0
"""Most that the size or contrast of one bead counts for, in squared standard deviations: a
spot may be another's shadow."""
WEIGHED_FRAMES = 60
"""Frames in which spots are compared with beads in size and contrast."""
FREE_TURNS = (np.arange(1, 8) * 0.25 * math.pi).tolist()
"""Turns that stand for all, where every one looks alike [rad]."""
AXIS_PX = 0.1
"""Distance of the axes of two hypotheses in the image up to which they share it [px]."""


@dataclass(frozen=True)
class Search:
    """How to search.

    Attributes:
        starts: number of start angles round the circle, of a phantom whose beads are far apart.
        frames: at most so many frames take part in the search.
        gate_px: final gate; a spot further from its prediction is not that bead.
        turn: how far alpha may be from its start [rad]. Further ones count only if they
            explain the spots better; inf: alpha is not known before.
        near: alpha to which the nearest of equally likely ones is taken [rad]; None: the
            start's.
    """

    starts: int = 18
    frames: int = 20
    gate_px: float = 6.0
    turn: float = math.inf
    near: float | None = None

    def allows(self, x: FloatArray, start: FloatArray) -> bool:
        """Check that the parameters `x` (6,) turn the phantom from `start` by at most `turn`."""
        return not math.isinf(self.turn) and _turn_between(x, start) <= self.turn


@dataclass(frozen=True, eq=False)
class Identification:
    """Tracks of the beads and their quality.

    Attributes:
        tracks: (n, k, 2) pixels, nan where unseen.
        covariances: (n, k, 2, 2) [px^2], nan where unseen.
        bias: (n, k) sphere-centre bias factors, 0 where unseen.
        index: (n, k) number of the detection in its frame, -1 where unseen.
        parameters: rough geometry behind the assignment (internal units).
        rms_px: residual of the assigned spots.
        explained: share of the complete spots that are some bead.
        found: share of the beads in view that have a spot, in frames that show any.
        rivals: other geometries that explain the spots as well, with other angles.
        odds: of each rival, its probability over that of `parameters`.
        free_turn: every angle explains the spots as well: the beads are on a line parallel to
            the axis.
        one_axis: all rivals have the same axis and magnification.
        typical_px: `rms_px` estimated from the median, which a few wrong spots do not
            change.
    """

    tracks: FloatArray
    covariances: FloatArray
    bias: FloatArray
    index: npt.NDArray[np.int64]
    parameters: Offsets
    rms_px: float
    explained: float
    found: float
    rivals: tuple[Offsets, ...]
    typical_px: float = math.nan
    odds: tuple[float, ...] = ()
    free_turn: bool = False
    one_axis: bool = True

    @property
    def ambiguous(self) -> bool:
        """More than one assignment explains the spots."""
        return bool(self.rivals)

    @property
    def start_angles(self) -> list[float]:
        """Start angles that explain the spots, from 0 to 360, in order [deg]."""
        found = (self.parameters, *self.rivals)
        return sorted(p.to_edge()["alpha"] % 360.0 for p in found)


def identify_beads(
    detections: Sequence[Detections],
    phantom: BeadPhantom | BeadModel | npt.ArrayLike,
    geometry: Poses | ConeVec,
    *,
    start: Offsets = NOMINAL,
) -> FloatArray:
    """Identify tracks (n, beads, 2) [px], nan where unseen; see `identify`.

    Args:
        detections: spots of each of the n frames.
        geometry: rough geometry of each frame.
        start: offsets at which the search starts.

    Raises:
        TwinError: as `identify`, and if the assignment is ambiguous (a symmetric
            phantom).

    Example: beads detected in rendered radiographs are found in the right order.

    >>> import numpy as np
    >>> from flexdt.phantoms import bead_phantom
    >>> from flexdt.twin.geometry.poses import Poses
    >>> angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    >>> poses = Poses.upright([0, 0, 0], [0, 600, 0], [0, 1059, 0], 0.1496, angle)
    >>> phantom = bead_phantom("normal", 5)
    >>> from flexdt.twin.calibration import detect_beads
    >>> from flexdt.twin.projection import project_scene
    >>> images = project_scene(phantom.scene, poses.cone_vec(), (760, 956))
    >>> detections = [detect_beads(image, radius_px=(16, 34)) for image in images]
    >>> tracks = identify_beads(detections, phantom, poses)
    >>> truth = poses.cone_vec().project_points(phantom.beads, (760, 956))
    >>> bool(np.median(np.abs(tracks - truth)) < 0.01)
    True
    """
    found = identify(detections, phantom, geometry, start=start)
    if found.ambiguous:
        angles = found.start_angles
        raise TwinError(
            "the beads cannot be told apart: start angles "
            + ", ".join(f"{a:.1f}" for a in angles)
            + " deg explain the shadows equally well (symmetric phantom?)",
            {"alpha_deg": angles},
        )
    return found.tracks


def identify(
    detections: Sequence[Detections],
    phantom: BeadPhantom | BeadModel | npt.ArrayLike,
    geometry: Poses | ConeVec,
    *,
    start: Offsets = NOMINAL,
    search: Search | None = None,
    loose: Mapping[str, float] | None = None,
    aslant: bool = False,
) -> Identification:
    """Assign spots to beads.

    `search.starts` start angles are tried all around on `search.frames` frames, first
    roughly; up to `MAX_FINALISTS` different ones on all frames. If the best leaves more
    than `LOOSE_PX`, or with `loose`, roll, tilts and others are fitted too.

    Args:
        detections: of each of the n frames.
        phantom: the beads.
        geometry: rough geometry of each frame; positions may be off by centimeters and
            the start angle may be anything, but the angles between frames must be right.
        start: offsets to begin with.
        search: settings; None is the default.
        loose: standard deviations [mm, deg, 1] of other offsets that may be off.
        aslant: the phantom may be sheared (`ASLANT`).

    Returns:
        The best assignment, its quality, and rivals that fit as well.

    Raises:
        TwinError: frames and geometry differ in number, there is no spot, or no
            orientation fits.
    """
    how = Search() if search is None else search
    model = bead_model(phantom)
    poses = as_poses(geometry)
    if len(detections) != len(poses):
        raise TwinError(
            f"{len(detections)} frames of detections for {len(poses)} poses",
            {"asked": len(detections), "allowed": len(poses)},
        )
    counts = np.array([len(d) for d in detections])
    if counts.sum() == 0:
        raise TwinError("no bead shadow was found in any frame", {"detections": 0})
    shapes = np.array([d.shape for d in detections], dtype=np.float64)
    scene = _Shadows.of(detections)
    chosen = _spread(np.flatnonzero(counts > 0), how.frames)
    some = scene.take(chosen)
    problem = build_problem(
        np.full((len(chosen), len(model), 2), np.nan),
        model,
        poses[chosen],
        free=SIX,
        shape=shapes[chosen],
        start=start,
    )
    base = np.array([getattr(start, n) for n in SIX])
    pixels = float(np.median(poses.pixels_per_mm))
    alike = symmetry(model.beads, how.gate_px / pixels)
    # What looks alike is tried once; neighbours that look alike need starts between them.
    closest = min(2.0 * math.pi / how.starts, spacing(model.beads) / STARTS_BETWEEN)
    starts = min(math.ceil(alike.period / closest - 1e-9), 4 * how.starts)
    turn = np.eye(len(SIX))[SIX.index("alpha")] * alike.period / starts
    hypotheses = [_Hypothesis(base + i * turn, math.inf, 0) for i in range(starts)]
    # All start angles get the wide rounds; only the promising ones the narrow.
    hypotheses = _best_first(_rounds(problem, some, h, WIDE_PX) for h in hypotheses)
    most = max(MAX_FINALISTS, starts // 2)
    stated = [h for h in hypotheses[most:] if how.allows(h.x, base)]
    hypotheses = hypotheses[:most] + stated
    hypotheses = _best_first(_rounds(problem, some, h, NARROW_PX) for h in hypotheses)
    whole = build_problem(
        np.full((len(poses), len(model), 2), np.nan),
        model,
        poses,
        free=SIX,
        shape=shapes,
        start=start,
    )
    finals = _best_first(
        _finish(whole, scene, h, how) for h in _finalists(hypotheses, base, how)
    )
    if finals and (loose or aslant or finals[0].loss > LOOSE_PX**2):
        # A rolled panel or a leaning axis looks like another phantom: only loose priors tell.
        # Where the six explain the spots, this is not needed.
        whole = build_problem(
            np.full((len(poses), len(model), 2), np.nan),
            model,
            poses,
            free=SIX,
            shape=shapes,
            start=start,
            priors={n: LOOSE_FACTOR * w for n, w in OFFSETS.items()} | dict(loose or {}),
            strain=ASLANT if aslant else UNSTRAINED,
        )
        finals = _best_first(_finish(whole, scene, h, how, wide_px=60.0) for h in finals)
    finals = _with_turned(whole, scene, finals, alike, how)
    return _report(whole, scene, finals, shapes, start, how, alike)


def attempt(
    detections: Sequence[Detections], model: BeadModel, poses: Poses, **how: Any
) -> Identification | None:
    """Call `identify` with the options `how`; return None where it raises a TwinError."""
    try:
        return identify(detections, model, poses, **how)
    except TwinError:
        return None


def identified(
    index: npt.NDArray[np.int64], detections: Sequence[Detections], start: Offsets
) -> Identification:
    """Make the identification from known spots; nothing is fitted or checked.

    `index`: (n, beads) spot of each bead, -1 unseen. The residual is NaN; there are no
    rivals.
    """
    shadows = _Shadows.of(detections)
    origin = (np.array([d.shape[::-1] for d in detections], dtype=np.float64) - 1) / 2
    return Identification(
        *shadows.picked(index, origin), index, start, math.nan, 1.0, 1.0, ()
    )


@dataclass(frozen=True, eq=False)
class _Shadows:
    """Detections of all frames, padded to the same number: (n, m, 2) relative to the center."""

    points: FloatArray
    covariances: FloatArray
    bias: FloatArray
    radii: FloatArray
    contrast: FloatArray
    whole: npt.NDArray[np.bool_]
    counts: npt.NDArray[np.int64]

    @classmethod
    def of(cls, detections: Sequence[Detections]) -> _Shadows:
        """Pack the spots of all frames into arrays (n frames, largest number of spots, at
        least one).

        Points are from the image's center [px]; padding is infinite in points, NaN in
        covariances, else 0.

        Args:
            detections: spots of each frame, one frame at least.
        """
        counts = np.array([len(d) for d in detections], dtype=np.int64)
        n = len(detections)
        m = max(int(counts.max()), 1)
        points = np.full((n, m, 2), np.inf)
        covariances = np.full((n, m, 2, 2), np.nan)
        bias = np.zeros((n, m))
        radii = np.zeros((n, m))
        contrast = np.zeros((n, m))
        whole = np.zeros((n, m), dtype=bool)
        for i, d in enumerate(detections):
            k = len(d)
            points[i, :k] = d.centers - (np.array(d.shape[::-1]) - 1) / 2
            covariances[i, :k] = d.covariances
            bias[i, :k] = d.bias
            radii[i, :k] = d.radii_px
            contrast[i, :k] = d.contrast
            whole[i, :k] = d.whole
        return cls(points, covariances, bias, radii, contrast, whole, counts)

    def picked(
        self, index: npt.NDArray[np.int64], origin: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the spots that are assigned to beads.

        Args:
            index: (n, k) spot of each bead in each frame, -1 without.
            origin: (n, 2) added to the places [px].

        Returns:
            Tracks (n, k, 2) [px] and covariances (n, k, 2, 2), nan for unseen beads; bias (n,
            k), 0 for them.
        """
        seen = index >= 0
        rows = np.arange(len(index))[:, None]
        pick = np.maximum(index, 0)
        tracks = self.points[rows, pick] + origin[:, None, :]
        return (
            np.where(seen[..., None], tracks, np.nan),
            np.where(seen[..., None, None], self.covariances[rows, pick], np.nan),
            np.where(seen, self.bias[rows, pick], 0.0),
        )

    def take(self, frames: npt.NDArray[np.intp]) -> _Shadows:
        return _Shadows(*(getattr(self, f.name)[frames] for f in fields(self)))


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """Six parameters, their capped mean squared distance, and how many spots they explain."""

    x: FloatArray
    loss: float
    matches: int


def _best_first(hypotheses: Iterable[_Hypothesis]) -> list[_Hypothesis]:
    return sorted(hypotheses, key=lambda h: h.loss)


def _spread(frames: npt.NDArray[np.intp], count: int) -> npt.NDArray[np.intp]:
    if len(frames) <= count:
        return frames
    return frames[np.linspace(0, len(frames) - 1, count).round().astype(np.intp)]


def assign(
    predicted: FloatArray, points: FloatArray, counts: npt.NDArray[np.int64], gate: float
) -> npt.NDArray[np.int64]:
    """Assign spots to predictions one-to-one within each frame, at the least sum of
    squared distances, capped at the gate.

    Args:
        predicted: (n, k, 2); one that is not finite gets no spot.
        points: (n, m, 2), inf beyond each frame's count.
        counts: (n,) spots in each frame.
        gate: pairs this far apart or further are not assigned [px].

    Returns:
        (n, k) index of the spot, -1 without one.
    """
    from scipy.optimize import linear_sum_assignment

    with np.errstate(invalid="ignore", over="ignore"):
        across, along = np.moveaxis(
            predicted[:, :, None, :] - points[:, None, :, :], 3, 0
        )
        d2 = across**2 + along**2
    far = gate * gate
    d2 = np.where(d2 < far, d2, far)
    # Where no two beads have the same nearest spot, these are the assignment.
    out = np.asarray(d2.argmin(axis=2), dtype=np.int64)
    out[d2.min(axis=2) >= far] = -1
    for f in _shared(out).tolist():
        rows, cols = linear_sum_assignment(d2[f, :, : int(counts[f])])
        near = d2[f, rows, cols] < far
        out[f] = -1
        out[f, rows[near]] = cols[near]
    return out


def _shared(index: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
    """List the frames in which two beads have the same spot.

    `index`: (n, k) spot of each bead, -1 without one."""
    ordered = np.sort(index, axis=1)
    same = (ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)
    return np.flatnonzero(same.any(axis=1))


def _vote(problem: FitProblem, shadows: _Shadows, x: FloatArray) -> FloatArray:
    """Shift dO_x and dO_y in `x` so that prediction and spots overlap most: by the mean
    shift in the 3 x 3 cells of 24 px with most votes.

    Shifts on the panel are converted by the median magnification.

    Args:
        problem: gives the prediction.
        shadows: the spots.
        x: (c,) column values; not changed.

    Returns:
        The shifted values; `x` itself if it predicts nothing.
    """
    try:
        predicted = _predicted(problem, x)
    except TwinError:
        return x
    difference = shadows.points[:, None, :, :] - predicted[:, :, None, :]
    flat = difference.reshape(-1, 2)
    flat = flat[np.isfinite(flat).all(axis=1)]
    cell = 24.0
    keys = np.floor(flat / cell).astype(np.int64)
    low = keys.min(axis=0)
    grid = np.zeros(keys.max(axis=0) - low + 3)
    np.add.at(grid, tuple((keys - low + 1).T), 1.0)
    # Votes of a cell and its neighbours: the peak may straddle cells.
    summed = sum(
        np.roll(grid, (i, j), axis=(0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)
    )
    peak = np.array(np.unravel_index(int(np.argmax(summed)), grid.shape)) + low - 1
    near = (np.abs(keys - peak) <= 1).all(axis=1)
    shift = flat[near].mean(axis=0)
    poses = problem.poses
    scale = float(np.median(np.linalg.norm(poses.u, axis=1) * poses.sod / poses.sdd))
    out = x.copy()
    out[0] += shift[0] * scale
    out[1] -= shift[1] * scale  # rows grow downwards
    return out


def _predicted(problem: FitProblem, x: FloatArray) -> FloatArray:
    """Predict spots (n, k, 2) from the image's center [px]."""
    return problem.predictions(x)[0] - problem.origin[:, None, :]


def _followed(
    problem: FitProblem,
    shadows: _Shadows,
    x: FloatArray,
    gates: Iterable[float],
    solver: Solver,
    cap: float,
    give_up: bool,
) -> _Hypothesis:
    """Assign and fit with each gate in turn, until with a gate equal to the last one no
    assignment changes, or the loss falls by less than `LEAST_GAIN`.

    Args:
        problem: of the fit.
        shadows: the spots.
        x: (c,) start.
        gates: in turn [px].
        solver: of each fit.
        cap: distance at which the loss is capped [px].
        give_up: fewer than four matches give an infinite loss; else they end the rounds.

    Returns:
        The hypothesis, with its loss per possible match; infinite if a fit fails.
    """
    used = math.nan
    before = np.zeros(0, np.int64)
    loss = math.inf
    try:
        predicted = _predicted(problem, x)
        for gate in gates:
            index = assign(predicted, shadows.points, shadows.counts, gate)
            if (index >= 0).sum() < 4:
                if give_up:
                    return _Hypothesis(x, math.inf, 0)
                break
            enough = (1.0 - LEAST_GAIN) * loss
            loss = _loss_of(index, predicted, shadows, gate)
            settled = np.array_equal(index, before) or loss > enough
            if gate == used and settled:
                break
            x = solve(_with_tracks(problem, shadows, index), solver, x=x).x
            predicted = _predicted(problem, x)
            used = gate
            before = index
    except TwinError:
        return _Hypothesis(x, math.inf, 0)
    loss, matches = _loss(predicted, shadows, cap)
    return _Hypothesis(x, loss, matches)


def _rounds(
    problem: FitProblem, shadows: _Shadows, h: _Hypothesis, gates: Sequence[float]
) -> _Hypothesis:
    """Refine one hypothesis: assign and fit in a few steps, with ever smaller gates [px].

    Without a finite loss it starts from a vote. Returns the parameters of `h` and an
    infinite loss if that failed.
    """
    if math.isfinite(h.loss):
        x = h.x
    else:
        x = _vote(problem, shadows, h.x)
    quick = Solver(huber=2.0, trim=math.inf, max_iterations=3, tolerance=0.05)
    # One loss for all rounds, so that hypotheses can be compared: capped at the same distance.
    found = _followed(problem, shadows, x, gates, quick, 40.0, give_up=True)
    if math.isfinite(found.loss):
        return found
    return replace(found, x=h.x)


def _loss(predicted: FloatArray, shadows: _Shadows, cap: float) -> tuple[float, int]:
    """Compute mean squared distances [px^2] of spots to beads `predicted` (n, k, 2).

    Missing pairs count as the `cap` [px]. Returns also the number of spots explained.
    """
    index = assign(predicted, shadows.points, shadows.counts, cap)
    matches = int(np.count_nonzero(index >= 0))
    return _loss_of(index, predicted, shadows, cap), matches


def _loss_of(
    index: npt.NDArray[np.int64], predicted: FloatArray, shadows: _Shadows, cap: float
) -> float:
    """Compute the loss of an assignment [px^2]; see `_loss`.

    Args:
        index: (n, k) spot of each bead, -1 without one.
        predicted, shadows, cap: see `_loss`.
    """
    frames, beads = np.nonzero(index >= 0)
    spots = shadows.points[frames, index[frames, beads]]
    d2 = np.sum((predicted[frames, beads] - spots) ** 2, axis=1)
    possible = int(np.minimum(shadows.counts, predicted.shape[1]).sum())
    missing = possible - len(d2)
    return float((d2.sum() + missing * cap * cap) / max(possible, 1))


def _with_tracks(
    problem: FitProblem, shadows: _Shadows, index: npt.NDArray[np.int64]
) -> FitProblem:
    """Return the problem with assigned spots as its measurements, each of unit weight.

    `problem`: of the fit. `shadows`: the spots. `index`: (n, k) spot of each bead; negative:
    unseen.
    """
    tracks, _, bias = shadows.picked(index, np.zeros((len(index), 2)))
    whiten = np.broadcast_to([1.0, 0.0, 1.0], (*index.shape, 3)).copy()
    return replace(
        problem, measured=np.nan_to_num(tracks), seen=index >= 0, whiten=whiten, bias=bias
    )


def _different(hypotheses: Sequence[_Hypothesis]) -> list[_Hypothesis]:
    """Keep hypotheses of finite loss whose start angle is over 3 deg from that of every
    better one kept.

    Args:
        hypotheses: best first.
    """
    out: list[_Hypothesis] = []
    for h in hypotheses:
        if math.isfinite(h.loss) and all(
            _turn_between(h.x, o.x) > math.radians(3.0) for o in out
        ):
            out.append(h)
    return out


def _finalists(
    hypotheses: Sequence[_Hypothesis], base: FloatArray, how: Search
) -> list[_Hypothesis]:
    """Choose the best different hypotheses, and as many that turn the phantom as
    stated.
    """
    different = _different(hypotheses)
    stated = [h for h in different[MAX_FINALISTS:] if how.allows(h.x, base)]
    return different[:MAX_FINALISTS] + stated[:MAX_FINALISTS]


def _turn_between(a: FloatArray, b: FloatArray) -> float:
    """Return the smallest angle between the start angles of two hypotheses [rad]."""
    return abs((float(a[3] - b[3]) + math.pi) % (2.0 * math.pi) - math.pi)


def _finish(
    problem: FitProblem,
    shadows: _Shadows,
    h: _Hypothesis,
    how: Search,
    wide_px: float = 20.0,
) -> _Hypothesis:
    """Assign and fit on all frames with up to 12 gates: from `wide_px`, halved until 20 px, then
    the search's final one.

    Columns that the hypothesis lacks start at the problem's values.
    `problem`: of all frames; `shadows`: their spots; `h`: the hypothesis; `how`: settings;
    `wide_px`: first gate [px].
    """
    x = np.concatenate([h.x, problem.start[len(h.x) :]])
    gates = [max(wide_px, how.gate_px)]
    while gates[-1] > max(20.0, how.gate_px):
        gates.append(max(0.5 * gates[-1], how.gate_px))
    gates += [how.gate_px] * (12 - len(gates))
    solver = Solver(max_iterations=15, tolerance=SETTLED_PX)
    return _followed(problem, shadows, x, gates, solver, how.gate_px, give_up=False)


def _with_turned(
    problem: FitProblem,
    shadows: _Shadows,
    finals: Sequence[_Hypothesis],
    alike: Symmetry,
    how: Search,
) -> list[_Hypothesis]:
    """Add to each hypothesis those that differ by a turn after which the beads look alike,
    best first; those near another are left out.

    Args:
        problem: of the fit.
        shadows: the spots of all frames.
        finals: refined hypotheses, best first.
        alike: the turns.
        how: settings of the search.
    """
    out = _different(finals)
    for h in tuple(out):
        for turn in alike.turns.tolist():
            turned = alike.turned(_at(problem, h.x, NOMINAL), turn)
            x = h.x.copy()
            for i, name in enumerate(_columns(problem)):
                x[i] = getattr(turned, name)
            if any(_turn_between(x, o.x) < math.radians(3.0) for o in out):
                continue
            loss, matches = _loss(_predicted(problem, x), shadows, how.gate_px)
            other = _Hypothesis(x, loss, matches)
            # Where the places are not exactly alike, the fit tells.
            if loss > (1.0 + LEAST_GAIN) * h.loss:
                other = _finish(problem, shadows, other, how)
            out += _different([*out, other])[len(out) :]
    return _best_first(out)


def _misfit_of_kinds(
    problem: FitProblem, shadows: _Shadows, h: _Hypothesis, how: Search
) -> float:
    """Compute minus the logarithm of the likelihood of what spots show besides their places:
    sizes and contrasts of each bead's spots, up to a common factor, and beads in view that
    have none. In `WEIGHED_FRAMES` frames at most.

    Args:
        problem: of all frames.
        shadows: their spots.
        h: the hypothesis.
        how: settings of the search.
    """
    model = problem.model
    frames = _spread(np.flatnonzero(shadows.counts > 0), WEIGHED_FRAMES)
    geometry = _at(problem, h.x, NOMINAL)
    radii = spot_radii(model, problem.poses[frames].cone_vec(geometry))
    predicted = _predicted(problem, h.x)[frames]
    some = shadows.take(frames)
    index = assign(predicted, some.points, some.counts, how.gate_px)
    clear = ~overlapping(predicted, radii)
    half = problem.origin[frames][:, None] + 0.5
    inside = (np.abs(predicted) + radii[..., None] <= half).all(axis=2)
    missing = float(np.count_nonzero(inside & clear & (index < 0)))
    rows = np.arange(len(frames))[:, None]
    pick = np.maximum(index, 0)
    told = (index >= 0) & clear & some.whole[rows, pick]
    share = len(shadows.counts) / len(frames)
    out = MISSING_LOG * missing * share
    for seen, expected, spread in (
        (some.radii, radii, SIZE_SPREAD),
        (some.contrast, np.broadcast_to(model.contrasts, radii.shape), CONTRAST_SPREAD),
    ):
        good = told & (seen[rows, pick] > 0) & (expected > 0)
        out += 0.5 * _unlike(seen[rows, pick], expected, good, spread)
    return out


def _unlike(
    seen: FloatArray, expected: FloatArray, good: npt.NDArray[np.bool_], spread: float
) -> float:
    """Compute the squared distance of what beads show from what is expected, up to a common
    factor, in standard deviations: of a bead its `spread`, and the error of its median.

    Args:
        seen, expected: (n, k), above 0 where `good`.
        good: (n, k) values that count.
        spread: relative.
    """
    use = good.sum(axis=0) >= 2
    if np.count_nonzero(use) < 2:
        return 0.0
    ratio = np.full(seen.shape, np.nan)
    ratio[good] = np.log(seen[good] / expected[good])
    median = np.nanmedian(ratio[:, use], axis=0)
    scatter = np.nanmedian(np.abs(ratio[:, use] - median), axis=0)
    variance = spread**2 + (scatter * ROBUST) ** 2 / good.sum(axis=0)[use]
    off = median - np.median(median)
    return float(np.minimum(off**2 / variance, MOST_FAR).sum())


def _report(
    problem: FitProblem,
    shadows: _Shadows,
    finals: Sequence[_Hypothesis],
    shapes: FloatArray,
    start: Offsets,
    how: Search,
    alike: Symmetry,
) -> Identification:
    """Make the identification of the best hypothesis: tracks, quality and rivals.

    Rivals are hypotheses over 3 deg away that are less likely by `MAX_RIVAL_LOG` at most.
    Of those as likely as the best the one that turns the phantom least is the best. Where
    the turn is stated, the best is the best of those so near the start, unless another is
    beyond a rival; those near it are no rivals if they see the same beads in all spots. Spots
    that overlap their neighbors in the prediction get no track. The start angle is reduced
    to half a turn about that of `start`.

    Args:
        problem: of the fit.
        shadows: the spots of all frames.
        finals: refined hypotheses, best first.
        shapes: (n, 2) rows and columns of the frames.
        start: offsets that the search began with.
        how: settings of the search.
        alike: turns after which the phantom looks as before.

    Raises:
        TwinError: there is no hypothesis, or the best one has no finite loss.
    """
    model = problem.model
    poses = problem.poses
    if not finals or not math.isfinite(finals[0].loss):
        raise TwinError(
            "the shadows found do not fit the phantom in any orientation",
            {"detections": int(shadows.counts.sum()), "beads": len(model)},
        )
    count = max(int(np.minimum(shadows.counts, len(model)).sum()), 1)
    base = np.array([getattr(start, n) for n in SIX])
    goal = (
        base if how.near is None else np.where(np.arange(len(SIX)) == 3, how.near, base)
    )
    least = max(_typical(problem, shadows, finals[0], how), 0.02) ** 2
    behind = {id(h): 0.5 * (h.loss - finals[0].loss) * count / least for h in finals}
    close = [h for h in finals if behind[id(h)] < 2.0 * MAX_RIVAL_LOG]
    if len(close) > 1:
        for h in close:
            behind[id(h)] += _misfit_of_kinds(problem, shadows, h, how)
        finals = sorted(close, key=lambda h: behind[id(h)])
    top = behind[id(finals[0])]
    finals = [h for h in finals if behind[id(h)] - top < MAX_RIVAL_LOG]
    stated = [h for h in finals if how.allows(h.x, base)]
    if stated:
        finals = stated
    best = min(
        (h for h in finals if behind[id(h)] - behind[id(finals[0])] < AS_LIKELY_LOG),
        key=lambda h: _turn_between(h.x, goal),
    )
    predicted = _predicted(problem, best.x)
    index = assign(predicted, shadows.points, shadows.counts, how.gate_px)
    geometry = _at(problem, best.x, start)
    turns = round((geometry.alpha - start.alpha) / (2.0 * math.pi))
    geometry = replace(geometry, alpha=geometry.alpha - 2.0 * math.pi * turns)
    if alike.free:
        geometry = alike.turned(geometry, float(goal[3]) - geometry.alpha)
    touching = overlapping(predicted, spot_radii(model, poses.cone_vec(geometry)))
    index[touching] = -1
    seen = index >= 0
    tracks, covariances, bias = shadows.picked(index, problem.origin)
    residual = np.linalg.norm(tracks - problem.origin[:, None, :] - predicted, axis=2)[
        seen
    ]
    if seen.any():
        spread = float(np.median(residual)) / RAYLEIGH_MEDIAN
    else:
        spread = math.inf
    total = max(int(shadows.counts.sum()), 1)
    rivals: list[Offsets] = []
    odds: list[float] = []
    if alike.free:
        rivals = [alike.turned(geometry, turn) for turn in FREE_TURNS]
        odds = [1.0] * len(rivals)
    for h in finals:
        if alike.free or _turn_between(h.x, best.x) < math.radians(3.0):
            continue
        if how.allows(best.x, base):
            other = assign(
                _predicted(problem, h.x), shadows.points, shadows.counts, how.gate_px
            )
            if (other[seen] == index[seen]).all():
                continue
        rivals.append(_at(problem, h.x, start))
        odds.append(math.exp(behind[id(best)] - behind[id(h)]))
    view = visible_beads(model, poses, shapes, geometry) & ~touching
    return Identification(
        tracks=tracks,
        covariances=covariances,
        bias=bias,
        index=index,
        parameters=geometry,
        rms_px=float(np.sqrt(np.mean(residual**2) / 2)) if seen.any() else math.nan,
        explained=float(best.matches) / total,
        found=float((seen & view).sum()) / max(int(view[shadows.counts > 0].sum()), 1),
        rivals=tuple(rivals),
        typical_px=spread,
        odds=tuple(odds),
        free_turn=alike.free,
        one_axis=all(_one_axis(poses, geometry, rival) for rival in rivals),
    )


def _typical(
    problem: FitProblem, shadows: _Shadows, h: _Hypothesis, how: Search
) -> float:
    """Compute the typical distance of spots from their beads, a coordinate, by the median
    [px]; infinite if no bead has a spot.
    """
    predicted = _predicted(problem, h.x)
    index = assign(predicted, shadows.points, shadows.counts, how.gate_px)
    frames, beads = np.nonzero(index >= 0)
    if not len(frames):
        return math.inf
    off = predicted[frames, beads] - shadows.points[frames, index[frames, beads]]
    return float(np.median(np.linalg.norm(off, axis=1))) / RAYLEIGH_MEDIAN


def _one_axis(poses: Poses, one: Offsets, other: Offsets) -> bool:
    """Check whether two geometries have the axis, and a length on it, within `AXIS_PX` of
    each other in the first image.
    """
    reach = 20.0 * np.array([[0, 0, 1.0], [0, 0, -1.0], [1.0, 0, 0], [0, 1.0, 0]])
    seen = []
    for p in (one, other):
        turned = stage_rotation(-(p.alpha + p.angle_scale * float(poses.angle[0])))
        on_axis = np.array([p.tau_x, p.tau_z, 0.0]) - poses.mount[0] + reach @ turned.T
        seen.append(poses[:1].cone_vec(p).project_points(on_axis, (1, 1))[0])
    along = seen[0] - seen[1] - np.mean(seen[0] - seen[1], axis=0) * [0.0, 1.0]
    return bool(np.abs(along).max() < AXIS_PX)


def _columns(problem: FitProblem) -> list[str]:
    """List the offsets among the problem's columns."""
    return [n for n in problem.layout.names if n in NAMES]


def _at(problem: FitProblem, x: FloatArray, start: Offsets) -> Offsets:
    values = dict(zip(problem.layout.names, x.tolist(), strict=True))
    return replace(start, **{n: v for n, v in values.items() if n in NAMES})


def overlapping(predicted: FloatArray, radii: FloatArray) -> npt.NDArray[np.bool_]:
    """Mark beads whose predicted spot nearly touches another bead's: closer than 1.12
    times both radii and 2 px.

    Args:
        predicted: (n, k, 2) [px].
        radii: (n, k) of the spots [px].

    Returns:
        (n, k) bool; both of a pair are marked.
    """
    distance = np.linalg.norm(predicted[:, :, None] - predicted[:, None], axis=3)
    reach = 1.12 * (radii[:, :, None] + radii[:, None]) + 2.0
    k = predicted.shape[1]
    touching: npt.NDArray[np.bool_] = (distance < reach) & ~np.eye(k, dtype=bool)
    return np.asarray(touching.any(axis=2))
