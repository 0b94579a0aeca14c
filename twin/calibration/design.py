"""Where to put beads so that a planned scan determines the geometry best.

Each bead adds its own block to the Fisher information of the planned frames, so a set of seats is
judged by adding blocks; shadows that touch another's in a frame count for nothing there, as in
identification. Seats are exchanged one at a time from several random starts until no exchange
helps, and a set whose shadows fit at a second start angle is discarded. It refuses to know what
holds the beads: seats are points (see `flexdt.phantoms.seats`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from flexdt.twin.calibration.beads import BeadModel
from flexdt.twin.calibration.detect import Detections
from flexdt.twin.calibration.directions import tolerance_of
from flexdt.twin.calibration.fit import estimate_geometry
from flexdt.twin.calibration.identifiability import visible_beads
from flexdt.twin.calibration.identify import Search, identify, overlapping, shadow_radii
from flexdt.twin.calibration.model import SIX, build_problem, edge_factor
from flexdt.twin.conventions import FloatArray
from flexdt.twin.errors import TwinError
from flexdt.twin.parameters import NOMINAL, Parameters
from flexdt.twin.pose import Poses

Criterion = Literal["a", "d", "worst"]
CRITERIA: Final[Mapping[Criterion, str]] = {
    "a": "A-optimality: root mean square of sigma / tolerance",
    "d": "D-optimality: geometric mean of the ellipsoid's axes, in tolerances",
    "worst": "the largest sigma / tolerance",
}
DESIGN_FRAMES: Final = 48
"""Frames that take part in the search, spread over the plan; the answer is predicted with all."""
RIDGE: Final = 1e-9
"""Information added so that sets which determine too little can still be compared."""
_TRIAL_SHIFT_MM: Final = 2.0
_TRIED: Final = 12
"""Seats tried for one bead, best first, before it stays where it is."""
_TURNS: Final = np.radians(np.arange(10.0, 351.0, 5.0))


@dataclass(frozen=True, eq=False)
class ScanWish:
    """The scans a phantom is designed for.

    Attributes:
        poses: nominal pose of every frame of every placement.
        shape: detector (rows, cols).
        noise_px: standard deviation of a detected coordinate.
        free: parameters to be estimated, shared by all placements.
        bead_tolerance_mm: > 0: how well beads sit where they should; they are estimated, too.
    """

    poses: Poses
    shape: tuple[int, int]
    noise_px: float = 0.1
    free: tuple[str, ...] = SIX
    bead_tolerance_mm: float = 0.0

    def sizes(self) -> FloatArray:
        """(n, 2) detector (rows, cols) of each frame."""
        return np.broadcast_to(np.asarray(self.shape, dtype=np.float64), (len(self.poses), 2))

    def thinned(self, frames: int) -> tuple[ScanWish, float]:
        """At most `frames` of the frames, and how many each stands for."""
        n = len(self.poses)
        if n <= frames:
            return self, 1.0
        chosen = np.linspace(0, n, frames, endpoint=False).round().astype(np.intp)
        some = ScanWish(
            self.poses[chosen], self.shape, self.noise_px, self.free, self.bead_tolerance_mm
        )
        return some, n / frames


@dataclass(frozen=True, eq=False)
class Forecast:
    """What the planned scans would determine with some beads.

    Attributes:
        sigmas: parameter -> predicted standard deviation, edge units; inf if not determined.
        score: value of the criterion, smaller is better.
        used: share of all shadows that count (in view, touching no other).
    """

    sigmas: dict[str, float]
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
        criterion: what was minimised.
        forecast: with these beads.
        discarded: better sets that were ambiguous or did not identify.
        starts: random starts of the search.
        seed: of the starts and of the ambiguity trials.
    """

    beads: FloatArray
    seats: npt.NDArray[np.int64]
    criterion: Criterion
    forecast: Forecast
    discarded: int
    starts: int
    seed: int


def forecast(model: BeadModel, wish: ScanWish, criterion: Criterion = "a") -> Forecast:
    """Predicted uncertainties, touching shadows left out.

    Args:
        model: the beads.
        wish: the scans.
        criterion: of the score.
    """
    seats = _Seats.of(model.beads, float(model.bead_radius_mm.max()), wish, 1.0)
    masks = seats.alone(np.arange(len(model)))
    information = seats.information(masks)[None]
    names = seats.names
    covariance = _inverse(information)[0]
    sigma = np.sqrt(np.diag(covariance)) * seats.tolerances
    return Forecast(
        dict(zip(names, sigma.tolist(), strict=True)),
        float(_score(information, criterion)[0]),
        float(masks.mean()),
    )


def design(
    seats: npt.ArrayLike,
    radius_mm: float,
    count: int,
    wish: ScanWish,
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
    """Choose `count` of the seats.

    Args:
        seats: (m, 3) places a bead may take [mm, object frame].
        radius_mm: of every bead.
        count: beads to place.
        wish: the scans to be determined.
        criterion: what is minimised.
        slots: (m,) which brick a seat is in; None: all in one.
        per_slot: most beads in one slot; None: any.
        gap_mm: least distance between two beads' surfaces.
        unlike_mm: least `turned_likeness`; symmetric sets have none.
        starts: random starts.
        seed: the same seed gives the same design.
        bounds_mm: (3,) half extents within which centres may afterwards be moved off the seats.
        resolution_mm: smallest step of those moves.

    Raises:
        TwinError: too few seats, or every set found is ambiguous.
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
    some, weight = wish.thinned(DESIGN_FRAMES)
    slot = np.zeros(len(places), np.int64) if slots is None else np.asarray(slots, dtype=np.int64)
    most = count if per_slot is None else per_slot
    table = _Seats.of(places, radius_mm, some, weight)
    rules = _Rules(slot, most, 2.0 * radius_mm + gap_mm, unlike_mm)
    rng = np.random.default_rng([seed, count])
    found: dict[tuple[int, ...], float] = {}
    for _ in range(starts):
        chosen = _random_set(table, rules, count, rng)
        chosen, score = _exchanged(table, rules, chosen, criterion)
        if math.isfinite(score):
            found.setdefault(tuple(sorted(chosen.tolist())), score)
    discarded = 0
    for key, _score_of in sorted(found.items(), key=lambda item: (item[1], item[0])):
        index = np.array(key, dtype=np.int64)
        beads = places[index]
        if bounds_mm is not None:
            beads, index = _polished(
                beads, index, radius_mm, some, weight, criterion, rules.apart,
                np.asarray(bounds_mm, dtype=np.float64), resolution_mm, unlike_mm,
            )  # fmt: skip
        order = np.lexsort((beads[:, 1], beads[:, 0], beads[:, 2]))
        beads, index = beads[order], index[order]
        model = BeadModel(beads, np.array(radius_mm))
        if identified(model, wish, seed=seed) == 1.0:
            return Design(
                beads, index, criterion, forecast(model, wish, criterion), discarded, starts, seed
            )
        discarded += 1
    raise TwinError(
        f"all {discarded} bead sets found are ambiguous: their shadows fit at another start angle "
        "as well; use another number of beads, more bricks or fewer beads in one brick",
        {"asked": count, "discarded": discarded},
    )


def turned_likeness(beads: FloatArray) -> float:
    """How far beads are from a turned and shifted copy of themselves, at the best turn [mm].

    Root mean square distance between each bead and the one it would be taken for, over turns about
    the vertical of 10 to 350 deg in steps of 5; 0 for a set that looks the same after such a turn.

    Args:
        beads: (k, 3) [mm].
    """
    centred = beads - beads.mean(axis=0)
    cos, sin = np.cos(_TURNS), np.sin(_TURNS)
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


def identified(
    model: BeadModel, wish: ScanWish, *, trials: int = 3, seed: int = 1, frames: int = 24
) -> float:
    """Share of simulated scans, each from a start angle of its own, whose beads are told apart.

    Args:
        model: the beads.
        wish: the scans; at most `frames` frames of them are used.
        trials: scans; each has a random start angle and offsets of a few millimetres.
        seed: of angles, offsets and noise.
        frames: see `wish`.
    """
    some, _ = wish.thinned(frames)
    rng = np.random.default_rng([seed, 7])
    good = 0
    for trial in range(trials):
        shift = rng.normal(0.0, _TRIAL_SHIFT_MM, 3)
        turn = 2.0 * math.pi * (trial + rng.random()) / trials
        truth = Parameters(dO_x=shift[0], dO_y=shift[1], dO_z=shift[2], alpha=turn)
        shadows, owners = _shadows(model, some, truth, rng)
        try:
            found = identify(shadows, model, some.poses, search=Search(frames=frames))
        except TwinError:
            continue
        given = np.concatenate(
            [_named(index, owner) for index, owner in zip(found.index, owners, strict=True)]
        )
        good += not found.ambiguous and not (given == 0).any() and bool((given > 0).any())
    return good / trials


def measured_spread(
    model: BeadModel, wish: ScanWish, *, trials: int = 60, seed: int = 1
) -> dict[str, float]:
    """Standard deviation of real fits to noisy simulated points, edge units.

    The check of `forecast`: nothing of the information matrix enters.

    Args:
        model: the beads; with a tolerance in `wish` each trial's beads are off by it.
        wish: the scans.
        trials: fits.
        seed: of the noise.
    """
    rng = np.random.default_rng([seed, 11])
    values: list[list[float]] = []
    tolerance = wish.bead_tolerance_mm
    free_beads = tolerance > 0
    for _ in range(trials):
        beads = model.beads + rng.normal(0.0, tolerance, model.beads.shape) * free_beads
        tracks = _tracks(BeadModel(beads, model.bead_radius_mm), wish, NOMINAL)
        tracks = tracks + rng.normal(0.0, wish.noise_px, tracks.shape)
        fit = estimate_geometry(
            tracks, model, wish.poses, wish.free, shape=wish.sizes(), noise_px=wish.noise_px,
            free_beads=free_beads, bead_tolerance_mm=tolerance if free_beads else None,
        )  # fmt: skip
        values.append([fit.values[name] for name in wish.free if name in fit.values])
    spread = np.std(np.array(values), axis=0, ddof=1)
    names = [name for name in wish.free if name in fit.values]
    return dict(zip(names, spread.tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class _Rules:
    """Which sets are allowed: beads per slot, distance between centres, and how unlike itself a
    set must be when turned [mm]."""

    slot: npt.NDArray[np.int64]
    most: int
    apart: float
    unlike: float


@dataclass(frozen=True, eq=False)
class _Seats:
    """Every seat's share in the information, frame by frame.

    `blocks` (m, n, q q) is a seat's information in one frame, parameters in units of their
    tolerance, the bead's own coordinates after them; `pixels` (m, n, 2) and `reach` (m, n) say
    where its shadow is and how far it must stay from others'; `visible` (m, n).
    """

    places: FloatArray
    names: tuple[str, ...]
    tolerances: FloatArray
    blocks: FloatArray
    pixels: FloatArray
    radii: FloatArray
    visible: npt.NDArray[np.bool_]
    prior: float

    @classmethod
    def of(cls, places: FloatArray, radius: float, wish: ScanWish, weight: float) -> _Seats:
        parts: list[FloatArray] = []
        names: tuple[str, ...] = ()
        prior = wish.bead_tolerance_mm
        for first in range(0, len(places), 8):
            rows, names = _rows(BeadModel(places[first : first + 8], np.array(radius)), wish)
            parts.append(rows)
        rows = np.concatenate(parts)  # (m, n, 2, q)
        p = len(names)
        tolerances = np.array([tolerance_of(name) for name in names])
        rows[..., :p] *= tolerances
        blocks = weight * np.einsum("mnip,mniq->mnpq", rows, rows)
        model = BeadModel(places, np.array(radius))
        return cls(
            places,
            names,
            tolerances,
            blocks.reshape(*blocks.shape[:2], -1),
            wish.poses.cone_vec().project_points(places, (1, 1)).transpose(1, 0, 2),
            shadow_radii(model, wish.poses, NOMINAL).T,
            visible_beads(model, wish.poses, wish.sizes()).T,
            prior,
        )

    def touching(self, a: npt.NDArray[np.int64], b: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """(a, b, n) whether the shadows of two seats touch; the rule of `identify.overlapping`."""
        first, second = self.pixels[a], self.pixels[b]
        across = first[:, None, :, 0] - second[None, :, :, 0]
        down = first[:, None, :, 1] - second[None, :, :, 1]
        reach = 1.12 * (self.radii[a][:, None] + self.radii[b][None]) + 2.0
        return np.asarray(across * across + down * down < reach * reach)

    def alone(self, chosen: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """(k, n) which shadows of a set count."""
        touch = self.touching(chosen, chosen)
        touch[np.arange(len(chosen)), np.arange(len(chosen))] = False
        return np.asarray(self.visible[chosen] & ~touch.any(axis=1))

    def information(self, masks: npt.NDArray[np.bool_]) -> FloatArray:
        """(p, p) of a set of all seats under masks (m, n)."""
        summed = np.einsum("mn,mnf->mf", masks.astype(np.float64), self.blocks)
        return np.asarray(self.marginal(summed).sum(axis=0))

    def marginal(self, summed: FloatArray) -> FloatArray:
        """(..., p, p): beads' summed blocks (..., q q) with the beads' own places marginalised."""
        p = len(self.names)
        q = p + (3 if self.prior > 0 else 0)
        full = summed.reshape(*summed.shape[:-1], q, q)
        if q == p:
            return full
        cross = full[..., :p, p:]
        own = full[..., p:, p:] + np.eye(3) / self.prior**2
        return np.asarray(
            full[..., :p, :p] - cross @ np.linalg.solve(own, np.swapaxes(cross, -1, -2))
        )


def _rows(model: BeadModel, wish: ScanWish) -> tuple[FloatArray, tuple[str, ...]]:
    """Whitened Jacobian rows of each bead, (k, n, 2, q) edge units, and the parameters' names."""
    n, k = len(wish.poses), len(model)
    problem = build_problem(
        np.zeros((n, k, 2)), model, wish.poses, free=wish.free, shape=wish.sizes(),
        noise_px=wish.noise_px, free_beads=wish.bead_tolerance_mm > 0,
    )  # fmt: skip
    names = problem.layout.names
    factor = np.array([edge_factor(name) for name in names])
    rows = (problem.jacobian(problem.start) / factor).reshape(n, k, 2, -1).transpose(1, 0, 2, 3)
    p = problem.layout.parameter_count
    if p == len(names):
        return np.array(rows), names
    # A bead's rows touch its own three coordinates only.
    own = np.stack([rows[i, :, :, p + 3 * i : p + 3 * i + 3] for i in range(k)])
    return np.concatenate([rows[..., :p], own], axis=3), names[:p]


def _inverse(information: FloatArray) -> FloatArray:
    """Covariances (..., p, p) in units of tolerances; infinite diagonal where not determined."""
    values, vectors = np.linalg.eigh(information)
    lost = values <= 1e-12 * np.maximum(values[..., -1:], 1e-300)
    safe = np.where(lost, np.inf, values)
    covariance = (vectors / safe[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    touched = (np.abs(vectors) * lost[..., None, :] > 1e-6).any(axis=-1)
    p = information.shape[-1]
    covariance[..., np.arange(p), np.arange(p)] += np.where(touched, np.inf, 0.0)
    return np.asarray(covariance)


def _score(information: FloatArray, criterion: Criterion) -> FloatArray:
    """The criterion of a stack of information matrices (m, p, p), ridge included."""
    p = information.shape[-1]
    values, vectors = np.linalg.eigh(information + RIDGE * np.eye(p))
    values = np.maximum(values, RIDGE / 2)
    match criterion:
        case "a":
            return np.asarray(np.sqrt(np.mean(1.0 / values, axis=-1)))
        case "d":
            return np.asarray(np.exp(-0.5 * np.mean(np.log(values), axis=-1)))
        case _:
            variances = np.einsum("mij,mj->mi", vectors**2, 1.0 / values)
            return np.asarray(np.sqrt(variances.max(axis=-1)))


def _allowed(table: _Seats, rules: _Rules, others: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """(m,) seats that a further bead may take beside `others`."""
    gaps = np.linalg.norm(table.places[:, None] - table.places[others][None], axis=2)
    full = np.bincount(rules.slot[others], minlength=int(rules.slot.max()) + 1) >= rules.most
    seen = table.visible.any(axis=1)
    return np.asarray((gaps >= rules.apart - 1e-9).all(axis=1) & ~full[rules.slot] & seen)


def _random_set(
    table: _Seats, rules: _Rules, count: int, rng: np.random.Generator
) -> npt.NDArray[np.int64]:
    chosen = np.zeros(0, dtype=np.int64)
    for _ in range(count):
        free = np.flatnonzero(_allowed(table, rules, chosen))
        if len(free) == 0:
            raise TwinError(
                f"{count} beads do not fit: after {len(chosen)} no seat is left that is in view, "
                "far enough from the others and in a brick that may hold more",
                {"asked": count, "allowed": len(chosen)},
            )
        chosen = np.append(chosen, rng.choice(free))
    return chosen


def _exchanged(
    table: _Seats, rules: _Rules, chosen: npt.NDArray[np.int64], criterion: Criterion
) -> tuple[npt.NDArray[np.int64], float]:
    """Exchange beads one at a time for the best seat until no exchange helps."""
    masks = table.alone(chosen)
    summed = np.einsum("kn,knf->kf", masks.astype(np.float64), table.blocks[chosen])
    best = float(_score(table.marginal(summed).sum(axis=0)[None], criterion)[0])
    improved = True
    if turned_likeness(table.places[chosen]) < rules.unlike:
        best = math.inf
    while improved:
        improved = False
        for k in range(len(chosen)):
            others = np.delete(chosen, k)
            scores = _scores_beside(table, others, criterion)
            scores[~_allowed(table, rules, others)] = np.inf
            for seat in np.argsort(scores, kind="stable")[:_TRIED]:
                if not scores[seat] < best * (1.0 - 1e-9):
                    break
                trial = chosen.copy()
                trial[k] = seat
                if turned_likeness(table.places[trial]) >= rules.unlike:
                    chosen, best, improved = trial, float(scores[seat]), True
                    break
    return chosen, best


def _scores_beside(
    table: _Seats, others: npt.NDArray[np.int64], criterion: Criterion
) -> FloatArray:
    """(m,) the criterion of `others` with each seat added."""
    m = len(table.places)
    touch = table.touching(np.arange(m), others)  # (m, k-1, n)
    own = (table.visible & ~touch.any(axis=1)).astype(np.float64)
    mine = np.matmul(own[:, None], table.blocks)[:, 0]
    kept = (table.alone(others)[None] & ~touch).astype(np.float64)
    theirs = np.matmul(kept.transpose(1, 0, 2), table.blocks[others])  # (k-1, m, f)
    information = table.marginal(mine) + table.marginal(theirs).sum(axis=0)
    return _score(information, criterion)


def _polished(
    beads: FloatArray,
    index: npt.NDArray[np.int64],
    radius: float,
    wish: ScanWish,
    weight: float,
    criterion: Criterion,
    apart: float,
    bounds: FloatArray,
    resolution: float,
    unlike: float,
) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Move beads off their seats by ever smaller steps while that helps."""
    beads, index = beads.copy(), index.copy()
    steps = np.array([s for s in np.ndindex(3, 3, 3) if s != (1, 1, 1)], dtype=np.float64) - 1.0
    size = float(bounds.max()) / 8.0
    while size >= resolution:
        moved = False
        for k in range(len(beads)):
            near = beads[k] + np.concatenate([np.zeros((1, 3)), size * steps])
            near = np.clip(np.round(near / resolution) * resolution, -bounds, bounds)
            others = np.delete(beads, k, axis=0)
            places = np.concatenate([near, others])
            table = _Seats.of(places, radius, wish, weight)
            rest = np.arange(len(near), len(places))
            scores = _scores_beside(table, rest, criterion)[: len(near)]
            gaps = np.linalg.norm(near[:, None] - others[None], axis=2)
            scores[(gaps < apart - 1e-9).any(axis=1)] = np.inf
            best = int(np.argmin(scores))
            trial = beads.copy()
            trial[k] = near[best]
            if scores[best] < scores[0] * (1.0 - 1e-6) and turned_likeness(trial) >= unlike:
                beads[k], moved = near[best], True
                index[k] = -1
        if not moved:
            size /= 2.0
    return beads, index


def _tracks(model: BeadModel, wish: ScanWish, at: Parameters) -> FloatArray:
    """(n, k, 2) pixels of the shadows that count, nan elsewhere."""
    cone = wish.poses.cone_vec(at)
    pixels = cone.project_points(model.beads, wish.shape)
    hidden = overlapping(pixels, shadow_radii(model, wish.poses, at))
    hidden |= ~visible_beads(model, wish.poses, wish.sizes(), at)
    return np.where(hidden[..., None], np.nan, pixels)


def _shadows(
    model: BeadModel, wish: ScanWish, truth: Parameters, rng: np.random.Generator
) -> tuple[list[Detections], list[npt.NDArray[np.intp]]]:
    """Simulated detections in random order, and whose shadow each is."""
    tracks = _tracks(model, wish, truth)
    radii = shadow_radii(model, wish.poses, truth)
    out, owners = [], []
    for frame, points in enumerate(tracks):
        seen = rng.permutation(np.flatnonzero(np.isfinite(points[:, 0])))
        k = len(seen)
        out.append(
            Detections(
                points[seen] + rng.normal(0.0, wish.noise_px, (k, 2)),
                np.broadcast_to(wish.noise_px**2 * np.eye(2), (k, 2, 2)).copy(),
                radii[frame, seen],
                np.ones(k),
                np.zeros(k),
                np.ones(k, dtype=bool),
                np.ones(k),
                wish.shape,
            )
        )
        owners.append(seen)
    return out, owners


def _named(index: npt.NDArray[np.int64], owner: npt.NDArray[np.intp]) -> npt.NDArray[np.int64]:
    """For each bead of a frame: 1 if its shadow is its own, 0 if another's, -1 if it has none."""
    out = np.full(len(index), -1, dtype=np.int64)
    hit = index >= 0
    out[hit] = owner[index[hit]] == np.flatnonzero(hit)
    return out
