"""Are causes of shapes that no table has named or vague, and is none offered that is wrong?

`python tests/studies/outside_kinds.py [--each 3] [--seed 0] [--kinds a,b] [--coverage 0]
[--json]` draws scans of bead phantoms whose causes have shapes, widths and odds of their own:
exponential relaxation, breathing, a panel of fifth degree, noise of heavy tails, noise that grows
aside, a focal spot that walks, jumps, shakes, loose beads, gaps, and mixtures of two. Nothing of
the calibration is in them; rays are those of `faults_drawn`. It prints, of each kind, how many
were offered, and how many sigmas the worst value is from the *mean* geometry of the scan. More
than one value beyond four sigmas in 600 scans, or a right scan that is refused, fails.
`--coverage N` counts N right scans whose 50, 80 and 95 % regions hold the truth.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from flexdt.twin.calibration.pipeline import Calibration
from flexdt.twin.errors import TwinError

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from causes_named import calibrated
from faults_drawn import Array, Draft, Faulty, reshaped, right_draft, taken, usual

FAR_SIGMAS: Final = 4.0
MOST_FAR: Final = 1 / 600
"""Values beyond that, a scan."""
Change = Callable[[Draft, np.random.Generator], Draft]


def _place(draft: Draft) -> Array:
    """Place of each frame in the scan, 0 to 1."""
    n = len(draft.world.angles)
    return (np.arange(n) + 0.5) / n


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a size, evenly in its logarithm, of either sign."""
    return float(
        rng.choice([-1, 1]) * math.exp(rng.uniform(math.log(low), math.log(high)))
    )


def _moved(draft: Draft, name: str, course: Array) -> Draft:
    """Move a parameter by a course, about its mean."""
    own = draft.world.offsets.get(name, 0.0) + course - course.mean()
    return replace(
        draft, world=replace(draft.world, offsets={**draft.world.offsets, name: own})
    )


def _of_object(shape: Callable[[Array, np.random.Generator], Array]) -> Change:
    """Move the object along a drawn axis with a course of size 1."""

    def change(draft: Draft, rng: np.random.Generator) -> Draft:
        name, low, high = [
            ("dO_x", 0.01, 0.6), ("dO_y", 0.01, 0.6), ("dO_z", 0.1, 4.0), ("alpha", 0.02, 0.8),
        ][int(rng.integers(4))]  # fmt: skip
        return _moved(draft, name, _log(rng, low, high) * shape(_place(draft), rng))

    return change


def _relaxing(place: Array, rng: np.random.Generator) -> Array:
    return np.exp(-place / rng.uniform(0.03, 0.6))


def _stretched(place: Array, rng: np.random.Generator) -> Array:
    return np.exp(-((place / rng.uniform(0.05, 0.5)) ** rng.uniform(0.4, 0.8)))


def _creeping(place: Array, rng: np.random.Generator) -> Array:
    return np.log1p(place / rng.uniform(0.01, 0.2)) / 3.0


def _ramp(place: Array, rng: np.random.Generator) -> Array:
    return place


def _late_ramp(place: Array, rng: np.random.Generator) -> Array:
    return np.maximum(place - rng.uniform(0.2, 0.7), 0.0)


def _swing(place: Array, rng: np.random.Generator) -> Array:
    return 0.5 * np.sin(2 * math.pi * (rng.uniform(0.5, 6.0) * place + rng.uniform()))


def _two_jumps(place: Array, rng: np.random.Generator) -> Array:
    first, second = rng.uniform(0.1, 0.9, size=2)
    return (place > first) + rng.uniform(-1.5, 1.0) * (place > second)


def _one_jump(place: Array, rng: np.random.Generator) -> Array:
    return (place > rng.uniform(0.1, 0.9)) * 1.0


def _shaking(place: Array, rng: np.random.Generator) -> Array:
    return 0.3 * rng.standard_t(4, size=len(place))


def _walk(place: Array, rng: np.random.Generator) -> Array:
    return np.cumsum(rng.normal(size=len(place))) / math.sqrt(len(place))


def _breathing(draft: Draft, rng: np.random.Generator) -> Draft:
    """The panel's mount breathes: it comes and goes, and shifts aside with it."""
    wave = np.sin(2 * math.pi * (rng.uniform(0.7, 3.0) * _place(draft) + rng.uniform()))
    draft = _moved(draft, "dD_z", _log(rng, 0.1, 2.0) * wave)
    return _moved(draft, "dD_x", _log(rng, 0.01, 0.2) * wave)


def _growing(draft: Draft, rng: np.random.Generator) -> Draft:
    """It is held below, above or within."""
    course = _relaxing(_place(draft), rng)
    size = 1.0 + _log(rng, 5e-4, 1e-2) * (course - course.mean())
    draft = replace(draft, world=replace(draft.world, size=size))
    return _moved(draft, "dO_y", rng.uniform(-25.0, 25.0) * (size - 1.0))


def _focal_walk(draft: Draft, rng: np.random.Generator) -> Draft:
    """The focal spot walks aside, up and a little along the beam."""
    n = len(draft.world.angles)
    steps = np.cumsum(rng.normal(size=(n, 3)), axis=0) / math.sqrt(n)
    spot = (steps - steps.mean(axis=0)) * [abs(_log(rng, 0.01, 0.3)), 0.05, 0.05]
    return replace(draft, world=replace(draft.world, spot=draft.world.spot + spot))


def _after(draft: Draft, change: Callable[[Array], Array]) -> Draft:
    """Change the places of the spots of each frame; earlier changes come first."""
    before = draft.after

    def after(spots: list[Array | None]) -> list[Array | None]:
        some = spots if before is None else before(spots)
        for spot in some:
            if spot is not None:
                spot[:, :2] += change(spot[:, :2])
        return some

    return replace(draft, after=after)


def _in_panel(draft: Draft, places: Array) -> Array:
    rows, cols = draft.world.shape
    return (places - [(cols - 1) / 2, (rows - 1) / 2]) / (max(rows, cols) / 2)


def _fifth_degree(draft: Draft, rng: np.random.Generator) -> Draft:
    """Radial terms of third and fifth degree about a middle that is elsewhere."""
    third, fifth = _log(rng, 0.05, 2.0), _log(rng, 0.05, 3.0)
    middle = rng.uniform(-0.2, 0.2, size=2)

    def change(places: Array) -> Array:
        off = _in_panel(draft, places) - middle
        r2 = (off**2).sum(axis=1, keepdims=True)
        return off * (third * r2 + fifth * r2**2)

    return _after(draft, change)


def _waves(draft: Draft, rng: np.random.Generator) -> Draft:
    """A panel of gentle waves, of a length of half the panel and more."""
    size, phase = abs(_log(rng, 0.02, 0.4)), rng.uniform(0, 6.3, size=2)
    along = rng.normal(size=2) * rng.uniform(1.0, 3.0)

    def change(places: Array) -> Array:
        angle = _in_panel(draft, places) @ along
        return size * np.stack([np.sin(angle + p) for p in phase], axis=1)

    return _after(draft, change)


def _gap(draft: Draft, rng: np.random.Generator) -> Draft:
    axis = int(rng.integers(2))
    at = draft.world.shape[1 - axis] * rng.uniform(0.25, 0.75)
    shift = np.array([_log(rng, 0.1, 3.0), _log(rng, 0.1, 3.0)])
    return _after(draft, lambda places: np.outer(places[:, axis] >= at, shift))


def _heavy_tails(draft: Draft, rng: np.random.Generator) -> Draft:
    size, freedom = draft.noise_px, rng.uniform(2.5, 5.0)
    return _after(
        replace(draft, noise_px=1e-4 + 0.2 * size),
        lambda places: size * rng.standard_t(freedom, size=places.shape),
    )


def _noisy_aside(draft: Draft, rng: np.random.Generator) -> Draft:
    size = draft.noise_px * rng.uniform(1.0, 5.0)

    def change(places: Array) -> Array:
        r2 = (_in_panel(draft, places) ** 2).sum(axis=1, keepdims=True)
        return size * r2 * rng.normal(size=places.shape)

    return _after(draft, change)


def _loose(draft: Draft, rng: np.random.Generator) -> Draft:
    """One ball relaxes to another place; the others stay."""
    n, k = len(draft.world.angles), len(draft.world.beads)
    way = rng.normal(size=3)
    way *= abs(_log(rng, 0.03, 0.4)) / np.linalg.norm(way)
    loose = np.zeros((n, k, 3))
    course = 1.0 - _stretched(_place(draft), rng)
    loose[:, int(rng.integers(k))] = course[:, None] * way
    return replace(draft, world=replace(draft.world, loose=loose))


def _misplaced(draft: Draft, rng: np.random.Generator) -> Draft:
    """Every ball is off by a Laplace deviate: a few by much more than the others."""
    off = abs(_log(rng, 0.004, 0.08)) * rng.laplace(size=draft.world.beads.shape)
    return replace(draft, world=replace(draft.world, beads=draft.world.beads + off))


def _bent_phantom(draft: Draft, rng: np.random.Generator) -> Draft:
    """The phantom is bent like a rod that is loaded at its end."""
    beads = draft.world.beads.copy()
    height = (beads[:, 2] - beads[:, 2].min()) / np.ptp(beads[:, 2])
    off = np.zeros_like(beads)
    off[:, int(rng.integers(2))] = _log(rng, 0.01, 0.3) * height**2 * (3 - height) / 2
    return _warp(draft, off)


def _warp(draft: Draft, off: Array) -> Draft:
    """Displace balls, (k, 3), and put the phantom where they fit their file best: their mean,
    and their mean turn about the axis, are as it says.
    """
    beads = draft.world.beads
    off = off - off.mean(axis=0)
    across = (beads - beads.mean(axis=0))[:, :2]
    turn = across[:, 0] @ off[:, 1] - across[:, 1] @ off[:, 0]
    turn /= (across**2).sum()
    off[:, :2] -= turn * np.stack([-across[:, 1], across[:, 0]], axis=1)
    return replace(draft, world=replace(draft.world, beads=beads + off))


def _warped(
    shape: Callable[[Array, np.random.Generator], Array],
    low_mm: float = 0.01,
    high_mm: float = 0.3,
) -> Change:
    """Displace beads by a field of a drawn size, of places by the phantom's half length about a
    point of it that is drawn.
    """

    def change(draft: Draft, rng: np.random.Generator) -> Draft:
        beads = draft.world.beads
        low, high = beads.min(axis=0), beads.max(axis=0)
        at = (beads - rng.uniform(low, high)) / (0.5 * (high - low).max())
        return _warp(draft, _log(rng, low_mm, high_mm) * shape(at, rng))

    return change


def _bow(at: Array, rng: np.random.Generator) -> Array:
    """A rod that sags to a side between its ends."""
    side = rng.uniform(0.0, 2 * math.pi)
    return at[:, 2:] ** 2 * [math.cos(side), math.sin(side), 0.0]


def _twist(at: Array, rng: np.random.Generator) -> Array:
    return at[:, 2:] * np.stack([-at[:, 1], at[:, 0], 0 * at[:, 0]], axis=1)


def _dropped_end(at: Array, rng: np.random.Generator) -> Array:
    """What is above a joint leans, and sinks by a little."""
    above = np.maximum(at[:, 2] - rng.uniform(-0.6, 0.6), 0.0)
    side = rng.uniform(0.0, 2 * math.pi)
    return above[:, None] * [math.cos(side), math.sin(side), rng.uniform(-0.3, 0.0)]


def _barrel(at: Array, rng: np.random.Generator) -> Array:
    """Thicker in the middle, like glue that has sagged."""
    return (1.0 - at[:, 2:] ** 2) * at * [1.0, 1.0, 0.0]


def _s_shape(at: Array, rng: np.random.Generator) -> Array:
    side = rng.uniform(0.0, 2 * math.pi)
    return np.sin(2.0 * at[:, 2:]) * [math.cos(side), math.sin(side), 0.0]


def _quadratic(at: Array, rng: np.random.Generator) -> Array:
    """All monomials of second degree, each with its own weight."""
    pairs = np.einsum("ki,kj->kij", at, at).reshape(len(at), -1)
    return pairs @ rng.normal(size=(9, 3)) / 3.0


def _slant(at: Array, rng: np.random.Generator) -> Array:
    """Aslant, and nothing else, by more than a file's tolerance of .1 %."""
    side = rng.uniform(0.0, 2 * math.pi)
    return at[:, 2:] * [math.cos(side), math.sin(side), 0.0]


def _encoder(draft: Draft, rng: np.random.Generator) -> Draft:
    """An encoder errs with the turn, by harmonics that no table lists together."""
    turn = np.radians(draft.world.angles)
    course = sum(
        _log(rng, 0.003, 0.15)
        * np.sin(int(rng.integers(1, 6)) * turn + rng.uniform(0, 6.3))
        for _ in range(2)
    )
    return _moved(draft, "alpha", np.asarray(course))


def _leaning(draft: Draft, rng: np.random.Generator) -> Draft:
    turn = np.radians(draft.world.angles)
    for name in ("axis_tilt_x", "axis_tilt_z"):
        wave = np.sin(int(rng.integers(2, 5)) * turn + rng.uniform(0, 6.3))
        draft = _moved(draft, name, _log(rng, 0.01, 0.3) * wave)
    return draft


def _both(*changes: Change) -> Change:
    """Make a mixture of causes."""

    def change(draft: Draft, rng: np.random.Generator) -> Draft:
        for one in changes:
            draft = one(draft, rng)
        return draft

    return change


def _right(draft: Draft, rng: np.random.Generator) -> Draft:
    """Draw the phantom's scale and shape as they are assumed; nothing else is off."""
    beads = draft.world.beads
    change = (1.0 + 1e-3 * rng.normal()) * np.eye(3) + 1e-3 * rng.normal(size=(3, 3))
    return replace(draft, world=replace(draft.world, beads=reshaped(beads, change)))


MOVING: Final[dict[str, Change]] = {
    "ramp": _of_object(_ramp),
    "late_ramp": _of_object(_late_ramp),
    "relaxing": _of_object(_relaxing),
    "stretched": _of_object(_stretched),
    "creeping": _of_object(_creeping),
    "swinging": _of_object(_swing),
    "jump": _of_object(_one_jump),
    "two_jumps": _of_object(_two_jumps),
    "shaking": _of_object(_shaking),
    "walking": _of_object(_walk),
    "breathing": _breathing,
    "growing": _growing,
    "focal_walk": _focal_walk,
    "encoder": _encoder,
    "leaning": _leaning,
}
"""Something moves: the mean geometry is what is asked."""
STILL: Final[dict[str, Change]] = {
    "fifth_degree": _fifth_degree,
    "waves": _waves,
    "gap": _gap,
    "heavy_tails": _heavy_tails,
    "noisy_aside": _noisy_aside,
    "misplaced": _misplaced,
    "bent_phantom": _bent_phantom,
    "loose": _loose,
    "bowed": _warped(_bow),
    "twisted": _warped(_twist),
    "dropped_end": _warped(_dropped_end),
    "barrel": _warped(_barrel),
    "s_shape": _warped(_s_shape),
    "quadratic": _warped(_quadratic),
    "slanted": _warped(_slant, 0.2, 1.5),
}
MIXED: Final[dict[str, Change]] = {
    "ramp+gap": _both(MOVING["ramp"], _gap),
    "jump+misplaced": _both(MOVING["jump"], _misplaced),
    "shaking+waves": _both(MOVING["shaking"], _waves),
    "relaxing+heavy_tails": _both(MOVING["relaxing"], _heavy_tails),
    "breathing+bent_phantom": _both(_breathing, _bent_phantom),
    "gap+fifth_degree": _both(_gap, _fifth_degree),
    "swinging+jump": _both(MOVING["swinging"], MOVING["jump"]),
}
KINDS: Final = {"right": _right, **MOVING, **STILL, **MIXED}


@dataclass(frozen=True)
class Scored:
    """What came of a scan: findings, the largest error of an offered value [sigma], the level
    of the region that just holds the truth, and processor time [s]."""

    kind: str
    seed: int
    offered: bool
    said: tuple[str, ...]
    worst: float
    where: str
    level: float
    cpu_s: float


def drawn(kind: str, seed: int) -> Faulty:
    """Draw a scan of a kind."""
    rng = np.random.default_rng([seed, *kind.encode(), 76])
    draft = usual(right_draft(rng), rng)
    beads = draft.world.beads
    if kind not in ("right", "misplaced", "bent_phantom"):
        draft = _right(draft, rng)
    draft = KINDS[kind](draft, rng)
    truth = {n: float(np.mean(v)) for n, v in draft.world.offsets.items()}
    assert draft.believed.beads is beads
    return taken(replace(draft, truth=truth), rng)


def worst_of(result: Calibration, scan: Faulty) -> tuple[float, str, float]:
    """Compare the offered values with the mean geometry; see `Scored`."""
    assert result.fit is not None
    certificate = result.fit.certificate
    worst, where = 0.0, ""
    truth = {}
    for name, estimate in certificate.estimates.items():
        true = float(np.mean(scan.truth.get(name, (0.0, 0.0))))
        if name == "alpha":
            true = estimate.value + (true - estimate.value + 180.0) % 360.0 - 180.0
        if name not in ("pixel", "phantom"):
            truth[name] = true
            off = abs(estimate.value - true) / max(estimate.sigma, 1e-12)
            if off > worst:
                worst, where = off, name
    return worst, where, certificate.level(truth)


def scored(kind: str, seed: int) -> Scored:
    """Draw a scan, calibrate it, and compare what is offered with the truth."""
    scan = drawn(kind, seed)
    start = time.process_time()
    try:
        result = calibrated(scan)
    except TwinError as error:
        spent = time.process_time() - start
        return Scored(kind, seed, False, (f"refused: {error}",), 0.0, "", math.nan, spent)
    spent = time.process_time() - start
    said = tuple(f"{f.code}: {f.text}" for f in result.findings)
    if not result.identifiable:
        return Scored(kind, seed, False, said, 0.0, "", math.nan, spent)
    return Scored(kind, seed, True, said, *worst_of(result, scan), spent)


def main(argv: Sequence[str] | None = None) -> int:
    """Score scans of every kind, and print a line a kind and the sums.

    Returns:
        1 if more values are far off than may be, or a right scan is refused; else 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=3, help="scans of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--coverage", type=int, default=0, help="right scans")
    parser.add_argument("--json", action="store_true", help="a line a scan")
    args = parser.parse_args(argv)
    every = []
    work = [
        (k, s)
        for k in args.kinds.split(",")
        for s in range(args.seed, args.seed + args.each)
    ]
    work += [("right", 10_000 + args.seed + i) for i in range(args.coverage)]
    for kind, seed in work:
        every.append(scored(kind, seed))
        if args.json:
            print(json.dumps(asdict(every[-1])), flush=True)
    for kind in dict.fromkeys(s.kind for s in every):
        some = [s for s in every if s.kind == kind]
        worst = max(some, key=lambda s: s.worst)
        print(
            f"{kind}: {len(some)}, offered {sum(s.offered for s in some)}, named "
            f"{sum(bool(s.said) for s in some)}, worst {worst.worst:.1f} {worst.where} (seed "
            f"{worst.seed}), {np.mean([s.cpu_s for s in some]):.2f} s"
        )
    far = [s for s in every if s.worst > FAR_SIGMAS]
    moving = [s for s in every if s.kind in MOVING]
    held = sum(s.offered and s.worst <= FAR_SIGMAS for s in moving)
    right = [s for s in every if s.kind == "right"]
    refused = sum(not s.offered for s in right)
    levels = np.array([s.level for s in right if s.offered])
    regions = (
        {q: round(float(np.mean(levels <= q)), 3) for q in (0.5, 0.8, 0.95)}
        if len(levels)
        else {}
    )
    print(
        f"scans {len(every)}, far {len(far)}, moving offered and right {held} of {len(moving)}, "
        f"right refused {refused} of {len(right)}, regions {regions}"
    )
    return int(len(far) > max(MOST_FAR * len(every), 1) or refused > 0)


if __name__ == "__main__":
    raise SystemExit(main())
