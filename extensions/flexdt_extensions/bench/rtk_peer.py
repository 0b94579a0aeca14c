"""itk-rtk at work in a process of its own: its Joseph projector.

ITK's wrappers can end the interpreter that has loaded them with a segmentation fault while it
shuts down, which would turn a good run into a bad exit code. The process times each call
itself, so the way there and back costs nothing. Only the functions below it import itk.
"""

from __future__ import annotations

import atexit
import os
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, TypeVar

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

Work = tuple[Callable[[], None], Callable[[], Float32Array]]
"""The call to time, and the function of its last result."""
_T = TypeVar("_T")


class Rtk:
    """A process that has prepared one piece of work.

    Args:
        build: `joseph`, or another function of a module that gives `Work`.
        arguments: of `build`.

    Raises:
        RuntimeError: RTK refuses, or its process has ended.
    """

    def __init__(self, build: Callable[..., Work], *arguments: object) -> None:
        self._pool = ProcessPoolExecutor(1, get_context("spawn"))
        self._run_in_process(_prepare, build, arguments)

    def run(self) -> float:
        """Do the work; the seconds it took."""
        return self._run_in_process(_time_work)

    def images(self) -> Float32Array:
        """Get the last result from the process."""
        return self._run_in_process(_result)

    def close(self) -> None:
        """End the process."""
        self._pool.shutdown()

    def _run_in_process(self, do: Callable[..., _T], *arguments: object) -> _T:
        """Run a function in RTK's process, and return its result; after an error the process is
        ended.

        Raises:
            RuntimeError: with RTK's error.
        """
        try:
            return self._pool.submit(do, *arguments).result()
        except Exception as error:
            self.close()
            raise RuntimeError(f"RTK: {error}") from None


_PREPARED: list[Work] = []
"""Prepared work of this process, at most one."""


def _prepare(build: Callable[..., Work], arguments: tuple[object, ...]) -> None:
    """Build the work and append it to `_PREPARED` of this process, which will end without
    ITK's own teardown.

    Warnings of the build are suppressed.
    """
    atexit.register(os._exit, 0)  # past the wrappers' own end
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ITK's wrappers warn while they load
        _PREPARED.append(build(*arguments))


def _time_work() -> float:
    begun = time.perf_counter()
    _PREPARED[0][0]()
    return time.perf_counter() - begun


def _result() -> Float32Array:
    return np.asarray(_PREPARED[0][1](), dtype=np.float32)


# RTK turns about y, with the source on +z: its (x, y, z) is our (x, z, -y).
TO_RTK = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])


def joseph(
    data: Float32Array,
    voxel_mm: tuple[float, float, float],
    center_mm: tuple[float, float, float],
    rows: FloatArray,
    shape: tuple[int, int],
) -> Work:
    """Prepare RTK's Joseph projector, its fastest on the CPU.

    The call returns nothing; call it before the function of its images.

    Args:
        data: volume (z, y, x).
        voxel_mm: pitch (x, y, z).
        center_mm: of the volume (x, y, z).
        rows: cone_vec (n, 12).
        shape: detector (rows, cols).

    Returns:
        The call to time, and the function of its images (n, rows, cols).
    """
    import itk
    from itk import RTK as rtk

    kind = itk.Image[itk.F, 3]
    project = rtk.JosephForwardProjectionImageFilter[kind, kind].New()
    project.SetInput(0, rtk_stack(np.zeros((len(rows), *shape), np.float32), rows))
    project.SetInput(1, rtk_volume(data, voxel_mm, center_mm))
    project.SetGeometry(rtk_geometry(rows))
    project.InPlaceOff()

    def run() -> None:
        project.Modified()
        project.Update()

    return run, lambda: np.array(
        itk.array_from_image(project.GetOutput()), dtype=np.float32
    )


def rtk_geometry(rows: FloatArray) -> Any:
    """Convert cone_vec rows (n, 12) to RTK's geometry object.

    Panel directions are normalized: pitches are not part of it.

    Raises:
        ValueError: RTK rejects a view.
    """
    import itk
    from itk import RTK as rtk

    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    for row in rows:
        source, centre, u, v = (TO_RTK @ row[i : i + 3] for i in (0, 3, 6, 9))
        vectors = [
            itk.Vector[itk.D, 3]([float(x) for x in part])
            for part in (source, centre, u / np.linalg.norm(u), v / np.linalg.norm(v))
        ]
        if not geometry.AddProjection(*vectors):
            raise ValueError("this view is refused")
    return geometry


def rtk_volume(
    data: Float32Array,
    voxel_mm: tuple[float, float, float],
    center_mm: tuple[float, float, float],
) -> Any:
    """Convert a volume (z, y, x) to an ITK image in RTK's axes, whose y is flexdt's z and
    z its -y, with spacing and origin [mm].
    """
    import itk

    image = itk.image_from_array(np.ascontiguousarray(data.transpose(1, 0, 2)[::-1]))
    x, y, z = voxel_mm
    nz, ny, nx = data.shape
    image.SetSpacing([x, z, y])
    half = np.array([(nx - 1) * x, (nz - 1) * z, (ny - 1) * y]) / 2
    image.SetOrigin([float(c) for c in TO_RTK @ np.array(center_mm) - half])
    return image


def rtk_stack(images: Float32Array, rows: FloatArray) -> Any:
    """Convert projections to an ITK image with the panel's center at the origin [mm],
    pixel (0, 0) first.

    Args:
        images: (n, rows, cols).
        rows: (n, 12) cone_vec, whose first one gives the pixels' size.
    """
    import itk

    stack = itk.image_from_array(images)
    u, v = (float(np.linalg.norm(rows[0, i : i + 3])) for i in (6, 9))
    height, width = images.shape[1:]
    stack.SetSpacing([u, v, 1.0])
    stack.SetOrigin([-(width - 1) / 2 * u, -(height - 1) / 2 * v, 0.0])
    return stack
