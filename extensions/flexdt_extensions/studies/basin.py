"""How far off may the start be? Success against the start's error in mm and degrees (RQ5).

Gauss-Newton and Levenberg-Marquardt of Algorithm 2 and our fit are given the beads' identities; our
identification is given spots without them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from flexdt.twin.calibration import SIX, BeadModel, build_problem, estimate_geometry
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.identify import identify
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt_extensions.studies.algorithm_2 import algorithm_2
from flexdt_extensions.studies.experiments import DAMPING, NOISE_PX, SHAPE, scenario
from flexdt_extensions.studies.runs import Run, errors_of

START_MM: Final = (0.0, 5.0, 10.0, 20.0, 40.0, 80.0)
START_DEG: Final = (0.0, 30.0, 60.0, 90.0, 120.0, 150.0, 180.0)
FRAMES: Final = 36
LIMIT: Final = 0.2


@dataclass(frozen=True)
class Cell:
    """One start error: draws of random directions."""

    mm: float
    deg: float
    draws: int
    phantom: str
    seed: int
    noise_px: float = NOISE_PX

    @property
    def name(self) -> str:
        """For tables."""
        return cell_name(self.mm, self.deg)


def cell_name(mm: float, deg: float) -> str:
    """What a start error is called in tables."""
    return f"{mm:g} mm, {deg:g} deg"


def cells(seed: int = 1, noise_px: float = NOISE_PX) -> list[Cell]:
    """The grid of start errors."""
    return [Cell(mm, deg, 10, "normal-5", seed, noise_px) for mm in START_MM for deg in START_DEG]


def basin_runs(cell: Cell, model: BeadModel) -> list[Run]:
    """All methods on all draws of a cell; the start is the truth plus the error."""
    out = []
    for draw in range(cell.draws):
        rng = np.random.default_rng([cell.seed, int(cell.mm * 10), int(cell.deg), draw])
        poses, truth = scenario(f"G{draw % 5}", FRAMES)
        exact = poses.cone_vec(truth).project_points(model.beads, SHAPE)
        tracks = exact + cell.noise_px * rng.normal(size=exact.shape)
        way = rng.normal(size=3)
        way *= cell.mm / np.linalg.norm(way)
        turn = math.radians(cell.deg) * rng.choice([-1.0, 1.0])
        start = replace(
            truth, dO_x=truth.dO_x + way[0], dO_y=truth.dO_y + way[1], dO_z=truth.dO_z + way[2],
            alpha=truth.alpha + turn,
        )  # fmt: skip
        for method in METHODS:
            found, iterations = _solve(method, _Draw(tracks, model, poses, start, rng))
            errors = {} if found is None else _six(found, truth)
            out.append(
                Run(
                    method, cell.name, FRAMES, found is not None, errors, {}, iterations, math.nan,
                    bool(errors) and float(np.mean(list(errors.values()))) < LIMIT,
                )
            )  # fmt: skip
    return out


def _six(found: Offsets, truth: Offsets) -> dict[str, float]:
    edge = found.to_edge()
    return errors_of({n: edge[n] for n in SIX}, truth)


@dataclass(frozen=True, eq=False)
class _Draw:
    """What a method gets: measured points, beads, poses, where to start, and dice."""

    tracks: FloatArray
    model: BeadModel
    poses: Poses
    start: Offsets
    rng: np.random.Generator


_Found = tuple[Offsets | None, int]
"""Geometry, if any, and iterations."""


def _damped(lam: float) -> Callable[[_Draw], _Found]:
    def solve(draw: _Draw) -> _Found:
        problem = build_problem(
            draw.tracks, draw.model, draw.poses, free=SIX, shape=SHAPE, start=draw.start
        )
        result = algorithm_2(problem, lam)
        return result.parameters, result.iterations

    return solve


def _ours(draw: _Draw) -> _Found:
    fit = estimate_geometry(
        draw.tracks, draw.model, draw.poses, shape=SHAPE, noise_px=NOISE_PX, start=draw.start
    )
    return fit.parameters, fit.iterations


def _nameless(draw: _Draw) -> _Found:
    found = identify(_shadows(draw.tracks, draw.rng), draw.model, draw.poses, start=draw.start)
    if found.ambiguous:
        return None, 0
    return _ours(replace(draw, tracks=found.tracks, start=found.parameters))


_SOLVERS: Final[Mapping[str, Callable[[_Draw], _Found]]] = {
    "GN": _damped(DAMPING["GN"]),
    "LM_normal": _damped(DAMPING["LM_normal"]),
    "ours": _ours,
    "ours, identities unknown": _nameless,
}
METHODS: Final = tuple(_SOLVERS)


def _solve(method: str, draw: _Draw) -> _Found:
    try:
        return _SOLVERS[method](draw)
    except TwinError:
        return None, 0


def _shadows(tracks: FloatArray, rng: np.random.Generator) -> list[Detections]:
    """Points in random order, as if detected."""
    return [Detections.of_points(rng.permutation(f), NOISE_PX, 15.0, SHAPE) for f in tracks]


def success_grid(runs: Sequence[Run], method: str) -> FloatArray:
    """Share of successes, (mm, deg); nan where nothing was run."""
    out = np.full((len(START_MM), len(START_DEG)), np.nan)
    for i, mm in enumerate(START_MM):
        for j, deg in enumerate(START_DEG):
            name = cell_name(mm, deg)
            some = [r.success for r in runs if r.setting == method and r.scenario == name]
            if some:
                out[i, j] = float(np.mean(some))
    return out
