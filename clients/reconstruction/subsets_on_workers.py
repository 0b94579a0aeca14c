"""SIRT, CGLS and TV by workers anywhere: each projects and backprojects some of the views.

The views are split into a fixed number of subsets, and the client adds up what the workers found in
the order of the subsets, so the bytes do not depend on how many workers there are; they are not
those of `sirt`, `cgls` and `tv`, which add in another order. What is found lies in files in the
folder of `on_workers`, under its final name only when whole, and its name says of which step it is:
after any end the same command goes on where it was. Residuals stay with the subsets, A x - b by the
parts of which they are sums; the volume must fit into the memory of each worker, and of the client.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.clients.reconstruction.on_workers import as_made, folder_of, same_version
from flexdt.clients.reconstruction.volume_files import volume_writer
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction.iterative import Problem, dot, inverse
from flexdt.twin.reconstruction.tv import IN_A_ROW, NORM, WEIGHT, Regular, momentum

SUBSETS: Final = 16
"""Of the views, whatever the number of workers."""
ITERATIONS: Final = {"sirt": 50, "cgls": 15, "tv": 100}
TOLERANCE: Final = 1e-4
"""As for `tv`."""
Terms = tuple[tuple[float, str], ...]
"""A sum of stacks of projections by their names, each with its factor."""


@dataclass(frozen=True, eq=False)
class SubsetWork:
    """What a worker needs to know of a subset of views.

    Attributes:
        image: gives the line integrals of a view, (rows, cols), by its number.
        views: numbers of the subset's.
        cone_vec: of these.
        shape: of an image, (rows, cols).
        grid: of the volume.
        home: folder of what is found.
        subset: its number.
        made_by: version of flexdt.
    """

    image: Callable[[int], Float32Array]
    views: tuple[int, ...]
    cone_vec: ConeVec
    shape: tuple[int, int]
    grid: Grid
    home: Path
    subset: int
    made_by: str

    def file(self, name: str) -> Path:
        """Where something of this subset is kept."""
        return self.home / f"{name}-{self.subset}.npy"

    def problem(self, measured: bool = True) -> Problem:
        """Its geometry and grid, and its frames if they are needed."""
        same_version(self.made_by)
        images = np.zeros((len(self.views), *self.shape), np.float32)
        if measured:
            for k, view in enumerate(self.views):
                images[k] = self.image(view)
        return Problem.of(images, self.cone_vec, self.grid, 1)


def find_sums(work: SubsetWork) -> None:
    """Keep the inverse sums of the projector's rows, and the sums of its columns."""
    problem = work.problem(measured=False)
    rows = problem.project(np.ones(work.grid.shape, np.float32))
    keep(work.file("rows"), inverse(rows))
    keep(work.file("columns"), problem.spread(np.ones_like(rows)))


def find_step(work: SubsetWork, iteration: int) -> None:
    """Keep A' R (b - A x) of these views."""
    problem = work.problem()
    rest = problem.measured - problem.project(np.load(work.home / f"volume-{iteration}.npy"))
    rest *= np.load(work.file("rows"))
    keep(work.file(f"step-{iteration}"), problem.spread(rest))


def find_image(work: SubsetWork, volume: str, image: str, rest: bool) -> None:
    """Keep A x of these views, A x - b for a `rest`, and the sum of its squares."""
    problem = work.problem(measured=rest)
    found = problem.project(np.load(work.home / f"{volume}.npy"))
    if rest:
        found -= problem.measured
    keep(work.file(image), found)
    keep(work.file(f"{image}.square"), np.array(dot(found, found)))


def find_slope(work: SubsetWork, name: str, terms: Terms) -> None:
    """Keep a sum of projections of these views, and its A'."""
    problem = work.problem(measured=False)
    total = sum(np.float32(factor) * np.load(work.file(term)) for factor, term in terms)
    keep(work.file(name), total)
    keep(work.file(f"{name}.slope"), problem.spread(total))


@dataclass(frozen=True, eq=False)
class Subsets:
    """The client's side of all subsets.

    Attributes:
        works: one for each.
        home: folder of what is found.
        pool: of the workers.
        tell: called with the part of a round that is done.
    """

    works: list[SubsetWork]
    home: Path
    pool: Executor
    tell: Callable[[float], None]

    def files(self, name: str) -> list[Path]:
        """What the subsets found, in order."""
        return [work.file(name) for work in self.works]

    def find(self, made: str, task: Callable[..., None], *args: object) -> list[Path]:
        """Have every subset do `task`, whose last file is `made`; what one raises cancels all."""
        missing = [work for work in self.works if not work.file(made).exists()]
        running = [self.pool.submit(task, work, *args) for work in missing]
        with closing(as_made(running)) as results:
            for done, _ in enumerate(results, 1):
                self.tell(done / len(running))
        return self.files(made)

    def square(self, volume: str, image: str, *, rest: bool) -> float:
        """Have `image` projected from a volume; its sum of squares."""
        found = self.find(f"{image}.square", find_image, volume, image, rest)
        return math.fsum(float(np.load(file)) for file in found)

    def slope(self, name: str, terms: Terms) -> Float32Array:
        """A' of a sum of projections, which is kept under `name`."""
        return _sum(self.find(f"{name}.slope", find_slope, name, terms))

    def volume(self, name: str) -> Float32Array:
        """A volume that was kept."""
        return np.asarray(np.load(self.home / f"{name}.npy"))

    def put(self, name: str, values: Float32Array) -> None:
        """Keep a volume."""
        keep(self.home / f"{name}.npy", values)

    def state(self) -> dict[str, Any]:
        """What `save` kept; empty before the first."""
        file = self.home / "state.json"
        return dict(json.loads(file.read_text())) if file.exists() else {}

    def save(self, state: dict[str, Any], *old: str) -> None:
        """Keep what to go on with; then remove volumes and projections that it does not need."""
        with (self.home / "state.part").open("w") as part:
            json.dump(state, part)
            part.flush()
            os.fsync(part.fileno())
        os.replace(part.name, self.home / "state.json")
        for name in old:
            for end in ("", ".square", ".slope"):
                _remove([self.home / f"{name}{end}.npy", *self.files(name + end)])


def reconstruct_on_workers(
    algorithm: str,
    image: Callable[[int], Float32Array],
    views: tuple[int, ...],
    cone_vec: ConeVec,
    shape: tuple[int, int],
    grid: Grid,
    iterations: int | None,
    weight: float | None,
    out: Path,
    identity: object,
    pool: Executor,
    tell: Callable[[float, float], None],
) -> None:
    """Go on with an algorithm where it was, and write the file at the end.

    Args:
        algorithm: sirt, cgls or tv.
        image, views, cone_vec, shape, grid: of `SubsetWork`, for all views.
        iterations: how many; None is the algorithm's own number.
        weight: of the total variation; None is that of `tv`.
        out, identity, pool: of `on_workers.fdk_on_workers`.
        tell: called with iterations done and iterations to do, parts of one among them.
    """
    count = ITERATIONS[algorithm] if iterations is None else iterations
    home, made_by = folder_of(out, identity)
    home.mkdir(exist_ok=True)
    at = [0.0, 0.0]  # iterations done, and what a round is of one
    parts = np.array_split(np.arange(len(views)), min(SUBSETS, len(views)))
    works = [
        SubsetWork(
            image, tuple(views[i] for i in part), cone_vec[part], shape, grid, home, k, made_by
        )
        for k, part in enumerate(parts)
    ]
    subsets = Subsets(works, home, pool, lambda part: tell(at[0] + at[1] * part, count))

    def begin(done: int, round: float) -> None:
        at[:] = min(done + round, count), 0.5 if algorithm != "sirt" else 1.0
        tell(at[0], count)

    if algorithm == "sirt":
        found = _sirt(subsets, grid, count, begin)
    elif algorithm == "cgls":
        found = _cgls(subsets, grid, count, begin)
    else:
        found = _tv(subsets, grid, count, WEIGHT if weight is None else weight, begin)
    with volume_writer(out, grid) as write:
        write(found)
    shutil.rmtree(home, ignore_errors=True)


Begin = Callable[[int, float], None]


def _sirt(subsets: Subsets, grid: Grid, iterations: int, begin: Begin) -> Float32Array:
    """x += C A' R (b - A x)."""
    state = subsets.state()
    if not state:
        subsets.put("inverse", inverse(_sum(subsets.find("columns", find_sums))))
        subsets.put("volume-0", np.zeros(grid.shape, np.float32))
        subsets.save({"done": 0}, "columns")
    columns = subsets.volume("inverse")
    for i in range(state.get("done", 0), iterations):
        begin(i, 0.0)
        step = _sum(subsets.find(f"step-{i}", find_step, i))
        subsets.put(f"volume-{i + 1}", subsets.volume(f"volume-{i}") + columns * step)
        subsets.save({"done": i + 1}, f"volume-{i}", f"step-{i}")
    begin(iterations, 0.0)
    return subsets.volume(f"volume-{iterations}")


def _cgls(subsets: Subsets, grid: Grid, iterations: int, begin: Begin) -> Float32Array:
    """Conjugate gradients for least squares; here the residual is A x - b."""
    state = subsets.state()
    if not state:
        subsets.put("x-0", np.zeros(grid.shape, np.float32))
        subsets.square("x-0", "start", rest=True)
        gradient = subsets.slope("rest-0", ((1.0, "start"),))
        subsets.put("direction-0", -gradient)
        state = {"done": 0, "norm": dot(gradient, gradient)}
        subsets.save(state, "start")
    for i in range(state["done"], iterations):
        begin(i, 0.0)
        norm = state["norm"]
        if norm == 0.0:
            return subsets.volume(f"x-{i}")
        direction = subsets.volume(f"direction-{i}")
        size = norm / subsets.square(f"direction-{i}", f"image-{i}", rest=False)
        begin(i, 0.5)
        terms = ((1.0, f"rest-{i}"), (size, f"image-{i}"))
        gradient = subsets.slope(f"rest-{i + 1}", terms)
        new = dot(gradient, gradient)
        subsets.put(f"x-{i + 1}", subsets.volume(f"x-{i}") + np.float32(size) * direction)
        subsets.put(f"direction-{i + 1}", np.float32(new / norm) * direction - gradient)
        state = {"done": i + 1, "norm": new}
        subsets.save(state, f"x-{i}", f"direction-{i}", f"image-{i}", f"rest-{i}")
    begin(iterations, 0.0)
    return subsets.volume(f"x-{iterations}")


def _tv(subsets: Subsets, grid: Grid, iterations: int, weight: float, begin: Begin) -> Float32Array:
    """`minimise_tv` with x >= 0; points are named by the number of the try that found them."""
    state = subsets.state()
    regular = Regular.of(grid.blank(), True, None)
    if "tries" not in state:
        subsets.put("x-0", regular.allow(np.zeros(grid.shape, np.float32)))
        cost = 0.5 * subsets.square("x-0", "rest-0", rest=True)
        strength = weight * max(float(subsets.slope("scale", ((-1.0, "rest-0"),)).max()), 0.0)
        subsets.put("dual-0", regular.dual)
        length, old = _step(subsets, grid)
        state = {"tries": 0, "at": 0, "last": 0, "ahead": 0.0, "t": 1.0, "little": 0,
                 "costs": [cost], "strength": strength, "step": length}  # fmt: skip
        subsets.save(state, "scale", *old)
    regular.dual[:] = subsets.volume(f"dual-{state['tries']}")
    strength, step, costs = state["strength"], state["step"], list(state["costs"])
    while step and len(costs) <= iterations and state["little"] < IN_A_ROW:
        k, at, last = state["tries"] + 1, state["at"], state["last"]
        begin(len(costs) - 1, 0.0)
        part, x = state["ahead"], subsets.volume(f"x-{at}")
        ahead = x + np.float32(part) * (x - subsets.volume(f"x-{last}")) if part else x
        terms = ((1.0 + part, f"rest-{at}"), (-part, f"rest-{last}"))
        slope = subsets.slope(f"ahead-{k}", terms if part else ((1.0, f"rest-{at}"),))
        begin(len(costs) - 1, 0.5)
        tried = regular.proximal(ahead - np.float32(step) * slope, step * strength)
        subsets.put(f"x-{k}", tried)
        subsets.put(f"dual-{k}", regular.dual)
        cost = 0.5 * subsets.square(f"x-{k}", f"rest-{k}", rest=True)
        cost += strength * regular.variation(tried)
        if cost > costs[-1] and part:
            state = {**state, "tries": k, "ahead": 0.0, "t": 1.0}
            subsets.save(state, f"x-{k}", f"rest-{k}", f"ahead-{k}", f"dual-{k - 1}")
            continue
        better = cost <= costs[-1]
        costs.append(cost if better else costs[-1])
        little = state["little"] + 1 if costs[-2] - costs[-1] <= TOLERANCE * costs[-1] else 0
        t, ahead_by = momentum(state["t"])
        new = k if better else at
        state = {**state, "tries": k, "at": new, "last": at, "ahead": ahead_by, "t": t,
                 "little": little, "costs": costs}  # fmt: skip
        old = [f"{what}-{n}" for n in {last, k} - {new, at} for what in ("x", "rest")]
        subsets.save(state, f"ahead-{k}", f"dual-{k - 1}", *old)
    begin(iterations, 0.0)
    return subsets.volume(f"x-{state['at']}")


def _step(subsets: Subsets, grid: Grid) -> tuple[float, list[str]]:
    """One over the largest eigenvalue of A' A, by the power method; 0 where no ray meets the grid.

    As `Operator.norm` does it, with the same tolerance. Returns also what it leaves to be removed.
    """
    k = subsets.state().get("power", 0)
    if k == 0:
        x = np.ones(grid.shape, np.float32)
        subsets.put("power-0", x / np.float32(math.sqrt(dot(x, x))))
    while True:
        x, old = subsets.volume(f"power-{k}"), [f"power-{k}", f"ray-{k}", f"back-{k}"]
        subsets.square(f"power-{k}", f"ray-{k}", rest=False)
        image = subsets.slope(f"back-{k}", ((1.0, f"ray-{k}"),))
        square = dot(x, image)
        if square == 0.0:
            return 0.0, old
        rest = image - np.float32(square) * x
        if dot(rest, rest) <= (2 * NORM * square) ** 2:
            return 1.0 / (1.02**2 * square), old
        k += 1
        subsets.put(f"power-{k}", image / np.float32(math.sqrt(dot(image, image))))
        subsets.save({"power": k}, *old)


def keep(file: Path, values: Float32Array | FloatArray) -> None:
    """Write values; the file appears only when whole."""
    part = file.with_name(f"{file.name}.{os.getpid()}.part")
    with part.open("wb") as opened:
        np.save(opened, values)
        opened.flush()
        os.fsync(opened.fileno())
    os.replace(part, file)


def _sum(files: Iterable[Path]) -> Float32Array:
    first, *rest = (np.load(file, mmap_mode="r") for file in files)
    total = np.array(first)
    for values in rest:
        total += values
    return total


def _remove(files: Iterable[Path]) -> None:
    for file in files:
        file.unlink(missing_ok=True)
