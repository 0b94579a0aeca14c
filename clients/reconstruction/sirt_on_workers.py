"""SIRT by workers anywhere: each reads some views and says where the volume should change.

The views are split into a fixed number of subsets, and the client adds up what the workers found in
the order of the subsets, so the bytes do not depend on how many workers there are; they are not
those of `sirt`, which adds in another order. What is found lies in files in the folder of
`on_workers`, under its final name only when whole: after any end the same command goes on where it
was. The volume must fit into the memory of each worker, and of the client.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from flexdt.clients.reconstruction.on_workers import folder_of, same_version
from flexdt.clients.reconstruction.volume_files import volume_writer
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction.iterative import Problem, inverse

SUBSETS: Final = 16
"""Of the views, whatever the number of workers."""
ITERATIONS: Final = 50


@dataclass(frozen=True, eq=False)
class SubsetWork:
    """What a worker needs to know of a subset of views.

    Attributes:
        image: gives the line integrals of a view, (rows, cols), by its number.
        views: numbers of the subset's.
        cone_vec: of these.
        grid: of the volume.
        home: folder of what is found.
        subset: its number.
        made_by: version of flexdt.
    """

    image: Callable[[int], Float32Array]
    views: tuple[int, ...]
    cone_vec: ConeVec
    grid: Grid
    home: Path
    subset: int
    made_by: str

    def file(self, name: str) -> Path:
        """Where something of this subset is kept."""
        return self.home / f"{name}-{self.subset}.npy"

    def problem(self) -> Problem:
        """Its frames, geometry and grid."""
        same_version(self.made_by)
        images = np.stack([self.image(view) for view in self.views])
        return Problem.of(images, self.cone_vec, self.grid, 1)


def find_sums(work: SubsetWork) -> None:
    """Keep the inverse sums of the projector's rows, and the sums of its columns."""
    problem = work.problem()
    rows = problem.project(np.ones(work.grid.shape, np.float32))
    keep(work.file("rows"), inverse(rows))
    keep(work.file("columns"), problem.spread(np.ones_like(rows)))


def find_step(work: SubsetWork, iteration: int) -> None:
    """Keep A' R (b - A x) of these views."""
    problem = work.problem()
    rest = problem.measured - problem.project(np.load(volume_file(work.home, iteration)))
    rest *= np.load(work.file("rows"))
    keep(work.file(f"step-{iteration}"), problem.spread(rest))


def sirt_on_workers(
    image: Callable[[int], Float32Array],
    views: tuple[int, ...],
    cone_vec: ConeVec,
    grid: Grid,
    iterations: int | None,
    out: Path,
    identity: object,
    pool: Executor,
    tell: Callable[[float, float], None],
) -> None:
    """Go on with SIRT, x += C A' R (b - A x), and write the file at the end.

    Args:
        image, views, cone_vec, grid: of `SubsetWork`, for all views.
        iterations: how many; None is 50.
        out, identity, pool: of `on_workers.fdk_on_workers`.
        tell: called with iterations done and iterations to do, parts of one among them.
    """
    iterations = ITERATIONS if iterations is None else iterations
    home, made_by = folder_of(out, identity)
    home.mkdir(exist_ok=True)
    works = [
        SubsetWork(image, tuple(views[i] for i in part), cone_vec[part], grid, home, k, made_by)
        for k, part in enumerate(np.array_split(np.arange(len(views)), min(SUBSETS, len(views))))
    ]
    inverse_columns, sums = home / "columns.npy", [work.file("columns") for work in works]
    if not inverse_columns.exists():
        lacking = [work for work, found in zip(works, sums, strict=True) if not found.exists()]
        _wait([pool.submit(find_sums, work) for work in lacking], lambda part: None)
        keep(inverse_columns, inverse(_sum(sums)))
    _remove(sums)
    columns = np.load(inverse_columns)
    begun = next((i for i in range(iterations, 0, -1) if volume_file(home, i).exists()), 0)
    if begun == 0:
        keep(volume_file(home, 0), np.zeros(grid.shape, np.float32))
    for i in range(begun, iterations):
        steps = [work.file(f"step-{i}") for work in works]
        todo = [work for work, step in zip(works, steps, strict=True) if not step.exists()]
        running = [pool.submit(find_step, work, i) for work in todo]
        _wait(running, lambda part, i=i: tell(i - begun + part, iterations - begun))  # type: ignore[misc]
        keep(volume_file(home, i + 1), np.load(volume_file(home, i)) + columns * _sum(steps))
        _remove([volume_file(home, i), *steps])
    with volume_writer(out, grid) as write:
        write(np.load(volume_file(home, iterations)))
    shutil.rmtree(home, ignore_errors=True)


def volume_file(home: Path, iteration: int) -> Path:
    """The volume after so many iterations."""
    return home / f"volume-{iteration}.npy"


def keep(file: Path, values: Float32Array) -> None:
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


def _wait(running: list[Any], tell: Callable[[float], None]) -> None:
    """Until all have ended, with the part that has; what one raises cancels the others."""
    try:
        for done, future in enumerate(as_completed(running), 1):
            future.result()
            tell(done / len(running))
    finally:
        for future in running:
            future.cancel()
