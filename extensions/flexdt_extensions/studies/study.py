"""`flexdt study` without its command line: distributes the runs of an experiment over processes
and collects their results in one document. The runs are `flexdt_extensions.studies`.

The experiment `basin` is here, too: how far off may the start be? It is success against the
start's error in mm and degrees (RQ5). Gauss-Newton and Levenberg-Marquardt of Algorithm 2 and
our fit are given the beads' identities; our identification is given spots without them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.library.figures import require_plots
from flexdt.phantoms import (
    Phantom,
    cuboid_with_beads,
    load_phantom,
    loop_positions,
    material,
)
from flexdt.twin.calibration import (
    SIX,
    BeadModel,
    bead_model,
    build_problem,
    estimate_geometry,
)
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.identify import identify
from flexdt.twin.errors import LimitError, TwinError, UnknownNameError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.physics import Chain, Detector, EffectiveBeam, effective_beam, weights_of
from flexdt_extensions.executors import executor
from flexdt_extensions.studies import experiment_4 as real
from flexdt_extensions.studies.algorithm_2 import algorithm_2
from flexdt_extensions.studies.experiments import (
    DAMPING,
    EXPERIMENTS,
    NOISE_PX,
    SHAPE,
    VARIANTS,
    WorkUnit,
    author,
    require_counts,
    scenario,
    tasks,
)
from flexdt_extensions.studies.experiments import FIDELITIES as ALL_FIDELITIES
from flexdt_extensions.studies.runs import Run, errors_of, point_runs, summary

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
        return f"{self.mm:g} mm, {self.deg:g} deg"


def cells(seed: int = 1, noise_px: float = NOISE_PX) -> list[Cell]:
    """List the cells of the grid of start errors, each a shift [mm] and an angle [deg],
    with ten draws of phantom normal-5.
    """
    return [
        Cell(mm, deg, 10, "normal-5", seed, noise_px)
        for mm in START_MM
        for deg in START_DEG
    ]


def basin_runs(cell: Cell, model: BeadModel) -> list[Run]:
    """Run all methods on all draws of a cell; the start is the truth plus the error.

    Each draw has a shift of `cell.mm` in a random direction and a turn of +-`cell.deg`. A
    run that fails has no errors and no success; success is a mean error (mm, deg alike)
    below LIMIT.

    Args:
        cell: size of the error, draws and noise.
        model: the beads.
    """
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
            truth,
            dO_x=truth.dO_x + way[0],
            dO_y=truth.dO_y + way[1],
            dO_z=truth.dO_z + way[2],
            alpha=truth.alpha + turn,
        )
        for method in METHODS:
            found, iterations = _solve(method, _Draw(tracks, model, poses, start, rng))
            if found is None:
                values = {}
            else:
                values = found.to_edge()
            errors = errors_of({n: v for n, v in values.items() if n in SIX}, truth)
            out.append(
                Run(
                    method,
                    cell.name,
                    FRAMES,
                    found is not None,
                    errors,
                    {},
                    iterations,
                    math.nan,
                    bool(errors) and float(np.mean(list(errors.values()))) < LIMIT,
                )
            )
    return out


@dataclass(frozen=True, eq=False)
class _Draw:
    """Input of a method: measured points, beads, poses, start and random numbers."""

    tracks: FloatArray
    model: BeadModel
    poses: Poses
    start: Offsets
    rng: np.random.Generator


_Found = tuple[Offsets | None, int]
"""Geometry, if any, and iterations."""


def _algorithm_2_solver(lam: float) -> Callable[[_Draw], _Found]:
    """Return a function that solves a draw by Algorithm 2 with the damping `lam`; its
    result is offsets and iterations.
    """

    def solve(draw: _Draw) -> _Found:
        """Solve a draw by Algorithm 2, all six parameters free; returns offsets and
        number of iterations.
        """
        problem = build_problem(
            draw.tracks, draw.model, draw.poses, free=SIX, shape=SHAPE, start=draw.start
        )
        result = algorithm_2(problem, lam)
        return result.parameters, result.iterations

    return solve


def _solve_by_fit(draw: _Draw) -> _Found:
    """Solve a draw by our fit, with the beads' identities known; returns offsets and
    number of iterations.
    """
    fit = estimate_geometry(
        draw.tracks,
        draw.model,
        draw.poses,
        shape=SHAPE,
        noise_px=NOISE_PX,
        start=draw.start,
    )
    return fit.parameters, fit.iterations


def _solve_unidentified(draw: _Draw) -> _Found:
    """Identify a draw's points in random order, and fit to them; returns offsets and
    iterations, (None, 0) if they stay ambiguous.
    """
    # Points in random order, as if detected.
    seen = [
        Detections.of_points(draw.rng.permutation(f), NOISE_PX, 15.0, SHAPE)
        for f in draw.tracks
    ]
    found = identify(seen, draw.model, draw.poses, start=draw.start)
    if found.ambiguous:
        return None, 0
    return _solve_by_fit(replace(draw, tracks=found.tracks, start=found.parameters))


_SOLVERS: Final[Mapping[str, Callable[[_Draw], _Found]]] = {
    "GN": _algorithm_2_solver(DAMPING["GN"]),
    "LM_normal": _algorithm_2_solver(DAMPING["LM_normal"]),
    "ours": _solve_by_fit,
    "ours, identities unknown": _solve_unidentified,
}
METHODS: Final = tuple(_SOLVERS)


def _solve(method: str, draw: _Draw) -> _Found:
    """Solve a draw by a method; returns offsets and iterations, (None, 0) if it fails
    with a TwinError.
    """
    try:
        return _SOLVERS[method](draw)
    except TwinError:
        return None, 0


KILOVOLTS = 90.0
LOOP_RADIUS_MM = 2.0
LOOP_INSET_MM = 3.0
"""Radius of the beads of the author's code, and their distance from the faces [mm]."""
FIDELITIES: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(EXPERIMENTS, ALL_FIDELITIES),
    "real": ("points", "noisy", "images"),
    "basin": ("noisy", "points"),
}
"""Fidelities of each experiment, the default first."""

Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""`map`, or that of an executor."""
Tell = Callable[[str], None]
Document = dict[str, Any]


def run_study(
    experiment: str,
    fidelity: str | None = None,
    *,
    out: Path | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    counts: Sequence[int] | None = None,
    seed: int = 1,
    variant: str = "printed",
    tell: Tell | None = None,
) -> Document:
    """Run one of the thesis's experiments, and write its report if `out` is given.

    Args:
        experiment: beads, phantoms, damping, detector, real or basin.
        fidelity: points, noisy, clean or images; None is the experiment's own (points;
            basin: noisy).
        out: folder for summary.json, tables and heat maps; None writes nothing.
        jobs: processes; None is one for each core.
        scheduler: address of a dask scheduler to use instead of own processes.
        counts: numbers of projections; None is the thesis's. Each divides the largest
            where images are rendered; basin has one.
        seed: of all noise.
        variant: phantoms and scenarios of beads, phantoms and damping as the thesis
            prints them (printed), or as its author's public code has them (author).
        tell: called with a line of text after each task.

    Returns:
        The JSON of `flexdt study`.

    Raises:
        UnknownNameError: no such experiment, or it has no such fidelity or variant.
        LimitError: counts that no run can have; nothing was run.
        TwinError: counts were given for basin; dask.distributed is not installed; `out`
            was given and matplotlib is not installed.
        CommandError: the scheduler cannot be reached.
    """
    _require("no experiment", experiment, FIDELITIES)
    allowed = FIDELITIES[experiment]
    fidelity = allowed[0] if fidelity is None else fidelity
    _require(f"experiment {experiment!r} has no fidelity", fidelity, allowed)
    variants = (
        VARIANTS if experiment in ("beads", "phantoms", "damping") else VARIANTS[:1]
    )
    _require(f"no variant of {experiment}", variant, variants)
    if experiment == "basin" and counts is not None:
        raise TwinError("basin has one number of projections; counts are not for it")
    if out is not None:
        require_plots()
    say = tell or (lambda _: None)
    with executor(jobs, scheduler) as pool:
        spread: Map = map if pool is None else pool.map
        match experiment, fidelity:
            case "basin", _:
                runs, more = _run_basin(spread, say, fidelity, seed)
            case "real", "images":
                runs, more = real_images_runs(spread, say, seed, counts or real.COUNTS)
            case "real", _:
                runs, more = _real(spread, say, fidelity, seed, counts)
            case _:
                work = tasks(
                    experiment, fidelity, counts=counts, seed=seed, variant=variant
                )
                names = [f"{task.setting} {task.scenario}" for task in work]
                runs = _collect_runs(spread(run_task, work), names, say)
                more = {}
    document = {**summary(experiment, fidelity, runs), "variant": variant, **more}
    if out is not None:
        from flexdt_extensions.studies.study_report import write_study

        write_study(out, document, runs)
    return document


def _require(problem: str, name: str, allowed: Iterable[str]) -> None:
    if name not in allowed:
        raise UnknownNameError.among(f"{problem} {name!r}; allowed", name, allowed)


def _collect_runs(
    results: Iterable[list[Run]], names: Sequence[str], say: Tell
) -> list[Run]:
    """Collect the runs of all tasks, with a line of progress on each task's successes;
    `names` and results go together.
    """
    runs = []
    for i, (name, some) in enumerate(zip(names, results, strict=True)):
        runs += some
        good = sum(run.success for run in some)
        say(f"{i + 1}/{len(names)} {name}: {good} of {len(some)} runs succeed")
    return runs


def run_task(task: WorkUnit) -> list[Run]:
    """Run one task on points or, by its fidelity, on rendered images; a plain function,
    so that it can be sent to another process.

    The phantom is the shipped one for variant "printed", else the author's.
    """
    if task.variant == "printed":
        phantom = load_phantom(task.phantom)
    else:
        phantom = authors(task.phantom)
    model = bead_model(phantom)
    if task.fidelity in ("points", "noisy"):
        return point_runs(task, model)
    from flexdt_extensions.studies.rendered_runs import image_runs

    return image_runs(task, model, phantom.scene)


def authors(name: str) -> Phantom:
    """Build a cuboid of ABS with K steel beads, named "CUBOID-K", at the places on a loop
    that the author's public code gives.
    """
    cuboid, beads = name.split("-")
    w, b, h = author()["cuboids"][cuboid]
    return cuboid_with_beads(
        name,
        (w, b, h),
        loop_positions((w, b, h), int(beads), LOOP_INSET_MM),
        LOOP_RADIUS_MM,
        body_material="abs",
        bead_materials=("steel",) * int(beads),
        description="author's cuboid",
    )


def basin_task(cell: Cell) -> list[Run]:
    """Run all methods in one cell of start errors."""
    return basin_runs(cell, bead_model(load_phantom(cell.phantom)))


def _run_basin(
    spread: Map, say: Tell, fidelity: str, seed: int
) -> tuple[list[Run], Document]:
    """Run all cells: success against the start's error, for Algorithm 2, our fit, unknown
    identities.

    Args:
        spread: maps work over processes.
        say: prints progress.
        fidelity: "points" are without noise.
        seed: of the draws.

    Returns:
        All runs, and start_mm, start_deg and success_share (method -> table).
    """
    work = cells(seed=seed, noise_px=0.0 if fidelity == "points" else NOISE_PX)
    runs = _collect_runs(spread(basin_task, work), [cell.name for cell in work], say)
    shares = {}
    for method in METHODS:
        good = [
            run.success for run in runs if run.setting == method
        ]  # by cells, then draws
        shares[method] = (
            np.reshape(good, (len(START_MM), len(START_DEG), -1)).mean(axis=2).tolist()
        )
    return runs, {
        "start_mm": list(START_MM),
        "start_deg": list(START_DEG),
        "success_share": shares,
    }


def real_task(
    task: tuple[str, real.GroupTruth, int, bool, Sequence[int] | None],
) -> tuple[list[Run], Document]:
    """Run one scan of experiment 4: (scan, truth of its group, seed, exact points,
    counts)."""
    name, truth, seed, exact, used = task
    model = bead_model(load_phantom("lego"))
    return real.real_runs(name, model, truth, seed, exact=exact, used=used)


def _real(
    spread: Map, say: Tell, fidelity: str, seed: int, used: Sequence[int] | None
) -> tuple[list[Run], Document]:
    """Compare the author's 242 fits of real scans with their simulation and ours.

    Curves are in the order of the results.

    Args:
        spread: `map`, or that of an executor.
        say: called with a line of text after each scan.
        fidelity: points or noisy.
        seed: of the noise.
        used: numbers of projections; None is the logs'.

    Returns:
        The runs, and `assumed`, `logs_source`, `truths`, `curves` and `explained` of the
        document.

    Raises:
        LimitError: no counts, or some below 1.
    """
    if used is not None:
        require_counts(used, rendered=False)
    model = bead_model(load_phantom("lego"))
    truths = [real.physical_truth(group, model) for group in real.GROUPS]
    names = real.scan_names()
    curves = []

    def runs_of(results: Iterable[tuple[list[Run], Document]]) -> Iterable[list[Run]]:
        for some, curve in results:
            curves.append(curve)
            yield some

    work = [
        (name, truth, seed, fidelity == "points", used)
        for group, truth in zip(real.GROUPS, truths, strict=True)
        for name in names[group]
    ]
    runs = _collect_runs(runs_of(spread(real_task, work)), names, say)
    return runs, {
        "assumed": {
            "beads": "those of the LEGO phantom",
            "truths": "fitted to the logs at N = 360",
            "centroids": "of whole pixels" if fidelity == "noisy" else "exact",
        },
        "logs_source": author()["source"],
        "truths": [
            {
                "scans": list(names[group]),
                **dict(zip(SIX, truth.values.tolist(), strict=True)),
                "noise_px": {f"{sod:g}": noise for sod, noise in truth.noise_px.items()},
            }
            for group, truth in zip(real.GROUPS, truths, strict=True)
        ],
        "curves": curves,
        "explained": real.explained(curves),
    }


def lego_beam() -> EffectiveBeam:
    """Compute effective energies of the tube's beam behind the LEGO phantom (60 mm of
    ABS, 2.5 mm of others).
    """
    names = sorted({solid.material for solid in load_phantom("lego").scene.solids})
    signal, noise = weights_of(Chain(Detector()), KILOVOLTS)
    longest = [60.0 if name == "abs" else 2.5 for name in names]
    return effective_beam(signal, noise, [material(n).substance for n in names], longest)


def real_images_task(task: tuple[str, BeadModel, int, int, Sequence[int]]) -> list[Run]:
    """Calibrate one real scan of the LEGO phantom on simulated images, with its beads as
    found.

    Args:
        task: name of the scan, beads as found, seed, frames, and numbers of images.

    Returns:
        One run for each number of images.
    """
    name, found, seed, frames, counts = task
    phantom = load_phantom("lego")
    return real.image_runs(
        name,
        phantom.scene,
        bead_model(phantom),
        found,
        lego_beam(),
        seed,
        frames=frames,
        counts=counts,
    )


def real_images_runs(
    spread: Map,
    say: Tell,
    seed: int,
    counts: Sequence[int],
    scans: Sequence[str] | None = None,
    frames: int = real.FRAMES,
) -> tuple[list[Run], Document]:
    """Run experiment 4 on images: the first scan gives the beads, all are calibrated with
    them.

    Args:
        spread: `map`, or that of an executor.
        say: called with a line of text after each scan.
        seed: of beads and noise.
        counts: numbers of images to calibrate from.
        scans: names; None is all eleven.
        frames: images of a scan.

    Returns:
        The runs, and `beads_off_truth_mm` of the document.

    Raises:
        LimitError: no counts, or some below 1 or above `frames`.
    """
    phantom = load_phantom("lego")
    model = bead_model(phantom)
    require_counts(counts, rendered=False)
    if max(counts) > frames:
        raise LimitError(
            f"counts {[n for n in counts if n > frames]}: a scan has {frames} images; "
            f"allowed are 1 to {frames}",
            {"asked": list(counts), "allowed": [1, frames]},
        )
    found, _ = real.first_scan("Scan1", phantom.scene, model, lego_beam(), seed, frames)
    truth = real.hidden_phantom(phantom.scene, model, seed)[1]
    names = real.scan_names() if scans is None else scans
    work = [(name, found, seed, frames, tuple(counts)) for name in names]
    runs = _collect_runs(spread(real_images_task, work), names, say)
    return runs, {"beads_off_truth_mm": real.off_truth(found, truth).tolist()}
