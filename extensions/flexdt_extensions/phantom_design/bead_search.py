"""The search for bead positions that let a planned scan determine the geometry best.

Beads are exchanged between seats one at a time, from several random starts, until no exchange
helps. A set that looks like itself turned, or whose spots fit at a second start angle, is
discarded. Seats are plain points (see `seats` for those of a LEGO stack), and
`information_table` scores a set of them.

Simulated scans then check the predictions: can the beads be identified, and how far do real
fits scatter? These figures use nothing of the information matrix.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from flexdt.twin.calibration import (
    IN_IMAGES,
    BeadModel,
    Prediction,
    axis_in_image,
    estimate_geometry,
    identifiability,
    spot_radii,
    tolerance_of,
    visible_beads,
)
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.identify import Search, identify, overlapping
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt_extensions.phantom_design.information_table import (
    CRITERIA,
    Criterion,
    PlannedScans,
    SeatTable,
    inverse,
    score_of,
)

_TRIAL_SHIFT_MM: Final = 2.0


def share_identified(
    model: BeadModel,
    planned: PlannedScans,
    *,
    trials: int = 3,
    seed: int = 1,
    frames: int = 24,
) -> float:
    """Compute the share of simulated scans, each from its own start angle, whose beads
    are told apart.

    A scan counts only if the identification does not fail, is not ambiguous, gives no
    spot to another bead, and gives one to its own.

    Args:
        model: the beads.
        planned: the scans; at most `frames` frames of them are used.
        trials: scans; each has a random start angle and offsets of a few millimeters.
        seed: of angles, offsets and noise.
        frames: see `planned`.
    """
    some, _ = planned.thinned(frames)
    rng = np.random.default_rng([seed, 7])
    good = 0
    for trial in range(trials):
        shift = rng.normal(0.0, _TRIAL_SHIFT_MM, 3)
        turn = 2.0 * math.pi * (trial + rng.random()) / trials
        truth = Offsets(dO_x=shift[0], dO_y=shift[1], dO_z=shift[2], alpha=turn)
        shadows, owners = _simulate_detections(model, some, truth, rng)
        try:
            found = identify(shadows, model, some.poses, search=Search(frames=frames))
        except TwinError:
            continue
        given = np.concatenate(
            [
                _match_owners(index, owner)
                for index, owner in zip(found.index, owners, strict=True)
            ]
        )
        good += not found.ambiguous and not (given == 0).any() and bool((given > 0).any())
    return good / trials


def measured_spread(
    model: BeadModel, planned: PlannedScans, *, trials: int = 60, seed: int = 1
) -> dict[str, float]:
    """Simulate fits to noisy points and compute the rms error (fit minus truth) of
    parameters and IN_IMAGES.

    It is the check of `forecast`. All frames are used. Parameters that the first fit does
    not report are left out.

    Args:
        model: the beads; with a tolerance in `planned` each trial's beads are off by it
            and fitted, too. Parameters are drawn from their priors (0 where none).
        planned: the scans.
        trials: fits.
        seed: of the noise.

    Returns:
        Name -> rms error, edge units.
    """
    rng = np.random.default_rng([seed, 11])
    errors: list[dict[str, float]] = []
    tolerance = planned.spread_mm
    free_beads = tolerance > 0
    widths = {name: width for name, width in planned.widths.items() if width > 0}
    for _ in range(trials):
        hidden = {name: width * rng.normal() for name, width in widths.items()}
        truth = Offsets.from_edge(hidden)
        beads = model.beads + rng.normal(0.0, tolerance, model.beads.shape) * free_beads
        tracks = _tracks(BeadModel(beads, model.bead_radius_mm), planned, truth)
        tracks = tracks + rng.normal(0.0, planned.noise_px, tracks.shape)
        fit = estimate_geometry(
            tracks,
            model,
            planned.poses,
            planned.free,
            shape=planned.sizes(),
            noise_px=planned.noise_px,
            free_beads=free_beads,
            bead_tolerance_mm=tolerance if free_beads else None,
            priors=widths,
        )
        off = {
            n: fit.values[n] - hidden.get(n, 0.0) for n in planned.free if n in fit.values
        }
        seen, true = (
            axis_in_image(planned.poses[:1], at, fit.problem.origin[0])
            for at in (fit.parameters, truth)
        )
        errors.append(off | dict(zip(IN_IMAGES, (seen - true).tolist(), strict=True)))
    square = {name: np.mean([off[name] ** 2 for off in errors]) for name in errors[0]}
    return {name: math.sqrt(float(value)) for name, value in square.items()}


def _tracks(model: BeadModel, planned: PlannedScans, at: Offsets) -> FloatArray:
    """Project the beads: (n, k, 2) pixels; nan where a spot overlaps another or is not
    visible.
    """
    cone = planned.poses.cone_vec(at)
    pixels = cone.project_points(model.beads, planned.shape)
    hidden = overlapping(pixels, spot_radii(model, planned.poses.cone_vec(at)))
    hidden |= ~visible_beads(model, planned.poses, planned.sizes(), at)
    return np.where(hidden[..., None], np.nan, pixels)


def _simulate_detections(
    model: BeadModel, planned: PlannedScans, truth: Offsets, rng: np.random.Generator
) -> tuple[list[Detections], list[npt.NDArray[np.intp]]]:
    """Simulate noisy detections in random order.

    Hidden and overlapping spots are left out.

    Args:
        model: the beads.
        planned: scans to simulate.
        truth: offsets.
        rng: generator.

    Returns:
        Detections of each frame, and the bead of each spot.
    """
    tracks = _tracks(model, planned, truth)
    radii = spot_radii(model, planned.poses.cone_vec(truth))
    out = []
    owners = []
    for frame, points in enumerate(tracks):
        seen = rng.permutation(np.flatnonzero(np.isfinite(points[:, 0])))
        noisy = points[seen] + rng.normal(0.0, planned.noise_px, (len(seen), 2))
        out.append(
            Detections.of_points(
                noisy, planned.noise_px, radii[frame, seen], planned.shape
            )
        )
        owners.append(seen)
    return out, owners


def _match_owners(
    index: npt.NDArray[np.int64], owner: npt.NDArray[np.intp]
) -> npt.NDArray[np.int64]:
    """Compare each bead's spot with its owner: 1 for its own, 0 for another's, -1
    without a spot.

    `owner` names the bead of each spot; the result has one value for each bead.
    """
    out = np.full(len(index), -1, dtype=np.int64)
    hit = index >= 0
    out[hit] = owner[index[hit]] == np.flatnonzero(hit)
    return out


DESIGN_FRAMES: Final = 48
"""Largest number of frames in the search, spread over the plan; the forecast uses all
frames."""
_TRIED_SEATS: Final = 12
"""Number of seats tried for one bead, best first, before it keeps its own."""
_TURNS: Final = np.radians(np.arange(10.0, 351.0, 5.0))


@dataclass(frozen=True, eq=False)
class BeadForecast:
    """Forecast of the planned scans with some beads.

    Attributes:
        sigmas: parameter -> predicted standard deviation, edge units; inf if not
            determined.
        image_sigmas: the same of IN_IMAGES: column [px] and angle [deg] of the axis,
            magnification.
        score: value of the criterion, smaller is better.
        used: share of all spots that count (in view, touching no other).
    """

    sigmas: dict[str, float]
    image_sigmas: dict[str, float]
    score: float
    used: float

    @property
    def worst(self) -> float:
        """Largest sigma in units of its tolerance."""
        return max(s / tolerance_of(n) for n, s in self.sigmas.items())


@dataclass(frozen=True, eq=False)
class Design:
    """Beads that were chosen.

    Attributes:
        beads: (k, 3) [mm, object frame], by height.
        seats: (k,) index of each among the offered seats; -1 where moved off them.
        forecast: with these beads.
        discarded: better sets that were ambiguous or did not identify.
    """

    beads: FloatArray
    seats: npt.NDArray[np.int64]
    forecast: BeadForecast
    discarded: int


def forecast(
    model: BeadModel, planned: PlannedScans, criterion: Criterion = "a"
) -> BeadForecast:
    """Compute the predicted uncertainties, touching spots left out.

    Returns sigmas of parameters and of image quantities, score, and share of spots used.

    Args:
        model: the beads.
        planned: the scans.
        criterion: of the score.
    """
    seats = SeatTable.of(model.beads, float(model.bead_radius_mm.max()), planned, 1.0)
    masks = seats.alone(np.arange(len(model)))
    information = seats.information(masks)
    covariance = inverse(information + np.diag(seats.known))
    sigma = np.sqrt(np.diag(covariance)) * seats.tolerances
    felt = seats.felt(information)
    return BeadForecast(
        dict(zip(seats.names[: seats.asked], sigma.tolist(), strict=False)),
        dict(
            zip(IN_IMAGES, (np.sqrt(np.diag(felt)) / seats.edge_px).tolist(), strict=True)
        ),
        float(score_of(felt[None], criterion)[0]),
        float(masks.mean()),
    )


def stated(model: BeadModel, planned: PlannedScans) -> Prediction | None:
    """Predict what `flexdt calibrate` states, with the phantom's strain and what other
    causes leave open; touching spots count.

    Returns:
        Sigmas of parameters and IN_IMAGES, edge units, and their ranges; None if the scans
        do not determine all parameters.
    """
    found = identifiability(
        model,
        planned.poses,
        planned.noise_px,
        planned.free,
        shape=planned.shape,
        bead_tolerance_mm=planned.bead_tolerance_mm,
        priors=planned.widths,
    )
    return found if found.identifiable else None


def design(
    seats: npt.ArrayLike,
    radius_mm: float,
    count: int,
    planned: PlannedScans,
    *,
    criterion: Criterion = "a",
    slots: npt.ArrayLike | None = None,
    per_slot: int | None = None,
    gap_mm: float = 0.5,
    unlike_mm: float = 1.0,
    starts: int = 8,
    seed: int = 1,
    bounds_mm: npt.ArrayLike | None = None,
    resolution_mm: float = 0.1,
) -> Design:
    """Choose `count` of the seats so that a criterion is least, by exchanges from random
    sets.

    The search uses at most `DESIGN_FRAMES` of the frames. Sets are tried from the best
    on; the first whose beads are told apart in all simulated scans is returned, beads in
    order of z, x and y, with its forecast (of all frames) and the number of ambiguous
    sets before it.

    Args:
        seats: (m, 3) places a bead may take [mm, object frame].
        radius_mm: of every bead.
        count: beads to place.
        planned: the scans to be determined.
        criterion: to be minimized.
        slots: (m,) number of the brick of each seat; None: all in one.
        per_slot: most beads in one slot; None: any.
        gap_mm: least distance between two beads' surfaces.
        unlike_mm: least `turned_likeness`; symmetric sets have none.
        starts: random starts.
        seed: the same seed gives the same design.
        bounds_mm: (3,) half extents within which centers may afterwards be moved off the
            seats.
        resolution_mm: smallest step of those moves.

    Raises:
        TwinError: an unknown criterion, a count below 2 or above the number of seats,
            seats that the rules do not allow together, or every set found is ambiguous.
    """
    places = np.asarray(seats, dtype=np.float64).reshape(-1, 3)
    if criterion not in CRITERIA:
        raise TwinError(
            f"no criterion {criterion!r}; there are: {', '.join(CRITERIA)}",
            {"asked": criterion, "allowed": list(CRITERIA)},
        )
    if not 2 <= count <= len(places):
        raise TwinError(
            f"{count} beads asked for {len(places)} seats; allowed: 2 to the number of seats "
            "(one bead determines neither scale nor angle)",
            {"asked": count, "allowed": [2, len(places)]},
        )
    some, weight = planned.thinned(DESIGN_FRAMES)
    if slots is None:
        slot = np.zeros(len(places), np.int64)
    else:
        slot = np.asarray(slots, dtype=np.int64)
    most = count if per_slot is None else per_slot
    table = SeatTable.of(places, radius_mm, some, weight)
    rules = _Rules(slot, most, 2.0 * radius_mm + gap_mm, unlike_mm)
    rng = np.random.default_rng([seed, count])
    found: dict[tuple[int, ...], float] = {}
    for _ in range(starts):
        chosen = _random_set(table, rules, count, rng)
        chosen, score = _exchange_beads(table, rules, chosen, criterion)
        if math.isfinite(score):
            found.setdefault(tuple(sorted(chosen.tolist())), score)
    discarded = 0
    for key, _ in sorted(found.items(), key=lambda item: (item[1], item[0])):
        index = np.array(key, dtype=np.int64)
        beads = places[index]
        if bounds_mm is not None:
            bounds = np.asarray(bounds_mm, dtype=np.float64)
            beads, index = _polish(
                beads,
                index,
                radius_mm,
                some,
                weight,
                criterion,
                rules,
                bounds,
                resolution_mm,
            )
        order = np.lexsort((beads[:, 1], beads[:, 0], beads[:, 2]))
        beads = beads[order]
        index = index[order]
        model = BeadModel(beads, np.array(radius_mm))
        if share_identified(model, planned, seed=seed) == 1.0:
            return Design(beads, index, forecast(model, planned, criterion), discarded)
        discarded += 1
    raise TwinError(
        f"all {discarded} bead sets found are ambiguous: their shadows fit at another "
        "start angle as well; use another number of beads, more bricks or fewer beads in one brick",
        {"asked": count, "discarded": discarded},
    )


def turned_likeness(beads: FloatArray) -> float:
    """Compute the distance of beads from a copy turned about their mean, at the best turn
    [mm].

    Root mean square distance between each bead and the one it would be taken for, over
    turns about the vertical of 10 to 350 deg in steps of 5; 0 for a set that looks the
    same after such a turn.

    Args:
        beads: (k, 3) [mm].
    """
    centred = beads - beads.mean(axis=0)
    cos = np.cos(_TURNS)
    sin = np.sin(_TURNS)
    turned = np.empty((len(_TURNS), *centred.shape))
    turned[..., 0] = cos[:, None] * centred[:, 0] - sin[:, None] * centred[:, 1]
    turned[..., 1] = sin[:, None] * centred[:, 0] + cos[:, None] * centred[:, 1]
    turned[..., 2] = centred[:, 2]
    squares = np.sum((turned[:, :, None] - centred[None, None]) ** 2, axis=3)
    # No assignment can be better than everyone's nearest: most turns need no assignment.
    bounds = np.maximum(squares.min(axis=2).sum(axis=1), squares.min(axis=1).sum(axis=1))
    best = math.inf
    for t in np.argsort(bounds):
        if bounds[t] >= best:
            break
        rows, cols = linear_sum_assignment(squares[t])
        best = min(best, float(squares[t][rows, cols].sum()))
    return math.sqrt(max(best, 0.0) / len(beads))


@dataclass(frozen=True, eq=False)
class _Rules:
    """Which sets are allowed: beads per slot, distance between centers, and how unlike itself a
    set must be when turned [mm]."""

    slot: npt.NDArray[np.int64]
    most: int
    apart: float
    unlike: float


def _allowed_seats(
    table: SeatTable, rules: _Rules, others: npt.NDArray[np.int64]
) -> npt.NDArray[np.bool_]:
    """Find the seats that a further bead may take, given `others`, (m,): far enough from
    them, in a brick that is not full, and visible in some frame.
    """
    gaps = np.linalg.norm(table.places[:, None] - table.places[others][None], axis=2)
    full = (
        np.bincount(rules.slot[others], minlength=int(rules.slot.max()) + 1) >= rules.most
    )
    seen = table.visible.any(axis=1)
    return np.asarray((gaps >= rules.apart - 1e-9).all(axis=1) & ~full[rules.slot] & seen)


def _random_set(
    table: SeatTable, rules: _Rules, count: int, rng: np.random.Generator
) -> npt.NDArray[np.int64]:
    """Draw seats for `count` beads that the rules allow together; returns their numbers.

    Each is drawn among the seats that are left.

    Raises:
        TwinError: no seat is left for a bead.
    """
    chosen = np.zeros(0, dtype=np.int64)
    for _ in range(count):
        free = np.flatnonzero(_allowed_seats(table, rules, chosen))
        if len(free) == 0:
            raise TwinError(
                f"{count} beads do not fit: after {len(chosen)} no seat is left that is in view, "
                "far enough from the others and in a brick that may hold more",
                {"asked": count, "allowed": len(chosen)},
            )
        chosen = np.append(chosen, rng.choice(free))
    return chosen


def _exchange_beads(
    table: SeatTable, rules: _Rules, chosen: npt.NDArray[np.int64], criterion: Criterion
) -> tuple[npt.NDArray[np.int64], float]:
    """Move beads one at a time to the best of their allowed seats, until no exchange
    helps; at most _TRIED_SEATS are tried for likeness.

    A set to begin with that is too like its turned copy has an infinite score, so that
    any allowed one is better.

    Args:
        table: of the seats.
        rules: distances, slots and likeness.
        chosen: (k,) seats to begin with.
        criterion: to be minimized.

    Returns:
        The seats, and their score; inf if no allowed set was found.
    """
    masks = table.alone(chosen)
    summed = np.einsum("kn,knf->kf", masks.astype(np.float64), table.blocks[chosen])
    best = float(
        score_of(table.felt(table.marginal(summed).sum(axis=0))[None], criterion)[0]
    )
    improved = True
    if turned_likeness(table.places[chosen]) < rules.unlike:
        best = math.inf
    while improved:
        improved = False
        for k in range(len(chosen)):
            others = np.delete(chosen, k)
            scores = _scores_beside(table, others, criterion)
            scores[~_allowed_seats(table, rules, others)] = np.inf
            for seat in np.argsort(scores, kind="stable")[:_TRIED_SEATS]:
                if not scores[seat] < best * (1.0 - 1e-9):
                    break
                trial = chosen.copy()
                trial[k] = seat
                if turned_likeness(table.places[trial]) >= rules.unlike:
                    chosen = trial
                    best = float(scores[seat])
                    improved = True
                    break
    return chosen, best


def _scores_beside(
    table: SeatTable, others: npt.NDArray[np.int64], criterion: Criterion
) -> FloatArray:
    """Compute the criterion of `others` (the k - 1 beads that stay) with each of the m
    seats added, (m,).

    Spots that touch in an image are left out.
    """
    m = len(table.places)
    touch = table.touching(np.arange(m), others)  # (m, k-1, n)
    own = (table.visible & ~touch.any(axis=1)).astype(np.float64)
    mine = np.matmul(own[:, None], table.blocks)[:, 0]
    kept = (table.alone(others)[None] & ~touch).astype(np.float64)
    theirs = np.matmul(kept.transpose(1, 0, 2), table.blocks[others])  # (k-1, m, f)
    information = table.marginal(mine) + table.marginal(theirs).sum(axis=0)
    return score_of(table.felt(information), criterion)


def _polish(
    beads: FloatArray,
    index: npt.NDArray[np.int64],
    radius: float,
    planned: PlannedScans,
    weight: float,
    criterion: Criterion,
    rules: _Rules,
    bounds: FloatArray,
    resolution: float,
) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Move beads off their seats, one at a time, to the best of 26 neighbors on a grid,
    while that helps and the rules allow it.

    The step begins at an eighth of the largest half extent, and is halved when no bead
    moves, down to `resolution`.

    Args:
        beads: (k, 3) [mm].
        index: (k,) seat of each bead; -1 once it is moved.
        radius: of the beads [mm].
        planned: the scans.
        weight: of each frame.
        criterion: to be minimized.
        rules: distances and likeness.
        bounds: (3,) half extents [mm].
        resolution: smallest step [mm].

    Returns:
        Beads and seats after the moves.
    """
    beads = beads.copy()
    index = index.copy()
    steps = (
        np.array([s for s in np.ndindex(3, 3, 3) if s != (1, 1, 1)], dtype=np.float64)
        - 1.0
    )
    size = float(bounds.max()) / 8.0
    while size >= resolution:
        moved = False
        for k in range(len(beads)):
            near = beads[k] + np.concatenate([np.zeros((1, 3)), size * steps])
            near = np.clip(np.round(near / resolution) * resolution, -bounds, bounds)
            others = np.delete(beads, k, axis=0)
            places = np.concatenate([near, others])
            table = SeatTable.of(places, radius, planned, weight)
            rest = np.arange(len(near), len(places))
            scores = _scores_beside(table, rest, criterion)[: len(near)]
            gaps = np.linalg.norm(near[:, None] - others[None], axis=2)
            scores[(gaps < rules.apart - 1e-9).any(axis=1)] = np.inf
            best = int(np.argmin(scores))
            trial = beads.copy()
            trial[k] = near[best]
            if (
                scores[best] < scores[0] * (1.0 - 1e-6)
                and turned_likeness(trial) >= rules.unlike
            ):
                beads[k] = near[best]
                moved = True
                index[k] = -1
        if not moved:
            size /= 2.0
    return beads, index
