"""Kernels compiled before they are needed, on all cores:
`python -m flexdt.runtime.kernels.compile_ahead`.

numba compiles under one lock, so each group of kernels has a process of its own, which
runs it on a tiny problem and leaves it where kernels are kept. Groups that are there
already cost nothing; other kernels compile at their first use, and so do those of a group
that failed, about which there is a line. Names of groups may follow the command.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.long_work import Rhythm, time_span
from flexdt.twin.projection import Grid
from flexdt.twin.projection.analytic import warm_up_back, warm_up_forward

MODULE: Final = "flexdt.runtime.kernels.compile_ahead"


def _detection() -> None:
    """Compile the kernels of bead detection by calling them on a blank image."""
    from flexdt.twin.calibration.detect import spot_kernels

    image = np.zeros((9, 9), np.float32)
    mask = np.zeros((9, 9), np.uint8)
    at = np.float64(4.0)
    one = np.ones(3)
    result = np.zeros(spot_kernels.RESULTS)
    spot_kernels.measure(image, at, at, at, 1.0, at, result)
    spot_kernels.fit_ball(
        image, mask, at, at, at, one, at, 0.5, 0.0, np.bool_(True), True, result
    )


def _fit() -> None:
    """Compile the kernel that evaluates calibrations, by calling it with no views."""
    from flexdt.twin.calibration.fit import fit_kernels

    ints, floats, views = (
        np.zeros(1, np.int64),
        np.zeros(1),
        np.zeros((0, 1)),
    )  # of no view
    sets = np.zeros((1, fit_kernels.PARAMETERS))
    radii = np.zeros(1)
    radii.flags.writeable = False  # as a phantom's
    data = fit_kernels.Data(
        np.zeros((0, fit_kernels.GEOMETRY)),
        ints[:0],
        1.0,
        np.zeros(3),
        radii,
        views,
        np.zeros((0, 1, 2)),
        np.zeros((0, 1, 3)),
        ints,
        sets.astype(np.int64),
        -1,
        np.zeros((0, 1, 2, 0)),
    )
    fit_kernels.evaluate(
        data,
        sets,
        np.zeros((1, 3)),
        floats[:0],
        np.zeros((0, 1), np.bool_),
        math.inf,
        0,
        np.zeros((0, 1, 2)),
        views,
        views,
        np.zeros((1, 1)),
        floats,
    )


def _reconstruction() -> None:
    """Compile the kernels of FDK of what lies within the panel, by reconstructing eight tiny
    views, and that of warping by a call.
    """
    from flexdt.twin.reconstruction.kernels import fdk_kernels

    images = _fdk(0.0, errors=False)
    fdk_kernels.warp(images, np.ones((8, 3, 3)), fdk_kernels.lanczos(), images.copy())


def _fdk(edge: float, *, errors: bool) -> npt.NDArray[np.float32]:
    """Reconstruct eight tiny views, `edge` at the panel's edges and 1 within; return them."""
    from flexdt.twin.reconstruction import fdk

    scan = ConeVec.circular(sod=10, sdd=20, angles=8, shape=(4, 6), pixel=1.0)
    images = np.full((8, 4, 6), edge, np.float32)
    images[:, 1:-1, 2:-2] = 1.0
    fdk(images, scan, Grid((2, 3, 4), 0.5).blank(), errors=errors)
    return images


def _truncation() -> None:
    """Compile FDK of what goes on beyond a panel's edges, with the volume's errors, the fit of
    a prism to it, and the search for parts that do not fit into a layout.
    """
    from flexdt.twin.projection.kernels import layout_kernels
    from flexdt.twin.reconstruction.kernels import truncation_kernels

    _fdk(1.0, errors=True)
    layout_kernels.unfit_parts(np.zeros(8, np.uint32))
    one = np.ones((1, 1))
    six = np.zeros(truncation_kernels.PARAMETERS)
    ray = np.ones((1, 1, 2))
    truncation_kernels.fit_prism(ray[0], ray, one, one, six - 1.0, six + 1.0, 1.0, six)


def _edges() -> None:
    """Compile the kernels of pixels that edges of solids and meshes reach."""
    from flexdt.twin.projection import Box, Scene, Solid, TriangleMesh
    from flexdt.twin.projection.finer_pixels import averaged
    from flexdt.twin.projection.pixel_areas import area_means

    scan = ConeVec.circular(sod=10, sdd=20, angles=1, shape=(4, 6), pixel=1.0)
    solids = Scene((Solid(Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), "water", 0.1),))
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    mesh = TriangleMesh(corners, faces)
    averaged(np.zeros((1, 2, 2), np.float32), 2)
    area_means([(solids, 1.0), (mesh, 0.1)], scan, (4, 6), "auto")


def _smooth() -> None:
    """Compile the kernels of the model "linear" and of its adjoint."""
    from flexdt.twin.projection import back, forward

    scan = ConeVec.circular(sod=10, sdd=20, angles=1, shape=(4, 6), pixel=1.0)
    grid = Grid((2, 3, 4), 0.5)
    forward(grid.blank(), scan, model="linear")
    back(np.ones((1, 4, 6), np.float32), scan, grid, model="linear")


GROUPS: Final[dict[str, tuple[Callable[[], None], str]]] = {
    "back projection": (warm_up_back, "projection.kernels.fan_kernels:spread_fans"),
    "projection": (warm_up_forward, "projection.kernels.fan_kernels:project_fans"),
    "calibration": (_fit, "calibration.fit.fit_kernels:evaluate"),
    "bead detection": (_detection, "calibration.detect.spot_kernels:fit_ball"),
    "edges in pixels": (_edges, "projection.kernels.within_kernels:triangles_within"),
    "smooth volumes": (_smooth, "projection.kernels.linear_kernels:spread_linear"),
    "FDK": (_reconstruction, "reconstruction.kernels.fdk_kernels:warp"),
    "truncated panels": (
        _truncation,
        "reconstruction.kernels.truncation_kernels:fit_prism",
    ),
}
"""Group -> function that compiles it, and the entry point that it compiles last;
the slowest first."""
ANALYSIS: Final = ("calibration", "bead detection", "FDK")
"""Groups that the analysis of a data set needs."""


def is_compiled(group: str) -> bool:
    """Return whether the last kernel of a group, an entry of `GROUPS`, is kept for this
    processor; nothing is compiled.
    """
    from importlib import import_module

    module, _, name = GROUPS[group][1].partition(":")
    entry = getattr(import_module(f"flexdt.twin.{module}"), name)
    return bool(entry._cache.is_kept())


def compile_ahead(groups: Sequence[str], note: Callable[[str], None]) -> None:
    """Compile the missing groups, each in a process of its own, as many at a time as
    there are cores; block until all have ended.

    Nothing is noted if none is missing. A group that fails is no error: its line says why,
    and its kernels compile at their first use.

    Args:
        groups: names, of `GROUPS`.
        note: called with a line at the beginning, when groups are done, and meanwhile ever
            more rarely (`Rhythm`).
    """
    missing = [group for group in groups if not is_compiled(group)]
    if not missing:
        return
    note(f"compiling kernels (once): {', '.join(missing)}")
    begun = time.monotonic()
    rhythm = Rhythm.begun(begun)
    with ThreadPoolExecutor(min(os.cpu_count() or 1, len(missing))) as pool:
        left = {pool.submit(elsewhere, group): group for group in missing}
        while left:
            until_line = max(rhythm.due_s - time.monotonic(), 0.0)
            done = wait(left, until_line, return_when="FIRST_COMPLETED").done
            ended = [left.pop(each) for each in done]
            for failure in filter(None, (each.result() for each in done)):
                note(failure)
            now = time.monotonic()
            if ended or rhythm.write(now):
                compiled = len(missing) - len(left)
                words = ", ".join([*(ended or ["still"]), time_span(now - begun)])
                note(f"compiled {compiled} of {len(missing)} ({words})")


def elsewhere(*groups: str) -> str:
    """Compile groups in a process that ends with this one, one after the other; return the
    sentence on a failure, or "".
    """
    with start(*groups) as process:
        return failure_of(process)


def start(*groups: str) -> subprocess.Popen[bytes]:
    """Start a process that compiles groups and ends with the present one; see `failure_of`."""
    words = ["-P", "-m", "flexdt.runtime.child", MODULE, "--here", *groups]
    return subprocess.Popen(
        [sys.executable, *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def failure_of(process: subprocess.Popen[bytes]) -> str:
    """Wait for a process of `start`; return "", or a sentence on its failure with the last
    line of its standard error.
    """
    assert process.stderr is not None
    lines = process.stderr.read().decode(errors="replace").strip().splitlines()
    if process.wait() == 0:
        return ""
    why = lines[-1] if lines else f"exit status {process.returncode}"
    return f"kernels were not compiled ahead, but will be at their first use: {why}"


def main() -> None:
    """Compile the groups named on the command line, or all, each in another process, and
    print the progress.

    With `--here GROUP...` the missing ones of these groups are compiled in this process,
    without output.
    """
    match sys.argv[1:]:
        case ["--here", *groups]:
            for group in groups:
                if not is_compiled(group):
                    GROUPS[group][0]()
        case groups:
            compile_ahead(
                groups or list(GROUPS), lambda line: print(f"flexdt: {line}", flush=True)
            )


if __name__ == "__main__":
    main()
