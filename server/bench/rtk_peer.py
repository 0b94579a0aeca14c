"""itk-rtk at work in a process of its own: its Joseph projector.

ITK's wrappers can end the interpreter that has loaded them with a segmentation fault while it shuts
down, which would turn a good run into a bad exit code. The process times each call itself, so the
way there and back costs nothing. Only the functions below it import itk.
"""

from __future__ import annotations

import atexit
import os
import time
import warnings
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

Work = tuple[Callable[[], None], Callable[[], Float32Array]]
"""What is timed, and what gives its last result."""
PATIENCE_S = 60.0
"""How long the process may take to end."""


class Rtk:
    """A process that has prepared one piece of work.

    Args:
        build: `joseph`, or another function of a module that gives `Work`.
        arguments: of `build`.

    Raises:
        RuntimeError: RTK refuses, or its process has ended.
    """

    def __init__(self, build: Callable[..., Work], *arguments: object) -> None:
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, build, arguments), daemon=True)
        self._process.start()
        theirs.close()
        self._answer()

    def run(self) -> float:
        """Do the work; the seconds it took."""
        return float(self._ask("run"))

    def images(self) -> Float32Array:
        """The last result."""
        return np.asarray(self._ask("images"), dtype=np.float32)

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join(PATIENCE_S)
        if self._process.is_alive():
            self._process.kill()

    def _ask(self, word: str) -> Any:
        self._pipe.send(word)
        return self._answer()

    def _answer(self) -> Any:
        try:
            answer = self._pipe.recv()
        except EOFError:
            raise RuntimeError("RTK's process has ended") from None
        if isinstance(answer, Exception):
            raise RuntimeError(f"RTK: {answer}")
        return answer


def _serve(pipe: Connection, build: Callable[..., Work], arguments: tuple[object, ...]) -> None:
    """The process: prepares, then does as it is told until nobody is there any more."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ITK's wrappers warn while they load
            run, images = build(*arguments)
        pipe.send(None)
        while True:
            if pipe.recv() == "run":
                begun = time.perf_counter()
                run()
                pipe.send(time.perf_counter() - begun)
            else:
                pipe.send(images())
    except EOFError:
        pass
    except Exception as error:
        pipe.send(RuntimeError(str(error)))
    atexit.register(os._exit, 0)  # past the wrappers' own end


# RTK turns about y, with the source on +z: its (x, y, z) is our (x, z, -y).
TO_RTK = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])


def joseph(
    data: Float32Array,
    voxel_mm: tuple[float, float, float],
    center_mm: tuple[float, float, float],
    rows: FloatArray,
    shape: tuple[int, int],
) -> Work:
    """RTK's Joseph projector, its fastest on the CPU, on our arrays and cone_vec rows."""
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

    return run, lambda: np.array(itk.array_from_image(project.GetOutput()), dtype=np.float32)


def rtk_geometry(rows: FloatArray) -> Any:
    """RTK's geometry object of cone_vec rows."""
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
    data: Float32Array, voxel_mm: tuple[float, float, float], center_mm: tuple[float, float, float]
) -> Any:
    """A volume (z, y, x) as an ITK image in RTK's axes."""
    import itk

    image = itk.image_from_array(np.ascontiguousarray(data.transpose(1, 0, 2)[::-1]))
    x, y, z = voxel_mm
    nz, ny, nx = data.shape
    image.SetSpacing([x, z, y])
    half = np.array([(nx - 1) * x, (nz - 1) * z, (ny - 1) * y]) / 2
    image.SetOrigin([float(c) for c in TO_RTK @ np.array(center_mm) - half])
    return image


def rtk_stack(images: Float32Array, rows: FloatArray) -> Any:
    """Projections as an ITK image, pixel (0, 0) first."""
    import itk

    stack = itk.image_from_array(images)
    u, v = (float(np.linalg.norm(rows[0, i : i + 3])) for i in (6, 9))
    height, width = images.shape[1:]
    stack.SetSpacing([u, v, 1.0])
    stack.SetOrigin([-(width - 1) / 2 * u, -(height - 1) / 2 * v, 0.0])
    return stack
