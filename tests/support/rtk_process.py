"""RTK at work in a process of its own, told and answering in plain arrays and text.

ITK's wrappers can end the interpreter that has loaded them with a segmentation fault while it
shuts down; whoever runs the tests must not be that interpreter. It refuses to know flexdt: what
it says of a geometry is RTK's own opinion.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

P = ParamSpec("P")
T = TypeVar("T")

ANGLES = ("GetGantryAngles", "GetOutOfPlaneAngles", "GetInPlaneAngles",
          "GetProjectionOffsetsX", "GetSourceOffsetsY")  # fmt: skip


@dataclass(frozen=True)
class Seen:
    """What RTK's geometry object says.

    Attributes:
        matrices: (n, 3, 4), of points in RTK's frame.
        distances: source to isocentre, (n,).
        numbers: getter -> one number a view, for each of `ANGLES`.
    """

    matrices: NDArray[np.float64]
    distances: tuple[float, ...]
    numbers: dict[str, tuple[float, ...]]


def read(text: str) -> Seen:
    """What RTK's own reader makes of a file; it checks the matrices against the nine
    numbers."""
    return _seen(_read(text))


def write_circle(views: int) -> tuple[str, Seen]:
    """RTK's circle about its own axis, with offsets and angles: its file, and what RTK
    says of it.

    Args:
        views: how many, 60 deg apart.
    """
    rtk = _itk().RTK
    geometry = rtk.ThreeDCircularProjectionGeometry.New()
    for i in range(views):
        geometry.AddProjection(600.0, 1100.0, 60.0 * i, 3.0, -2.0, 1.5, -0.5, 4.0, -2.5)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "geometry.xml"
        writer = rtk.ThreeDCircularProjectionGeometryXMLFileWriter.New()
        writer.SetFilename(str(file))
        writer.SetObject(geometry)
        writer.WriteFile()
        return file.read_text(), _seen(geometry)


def joseph(
    text: str,
    volume: NDArray[np.float32],
    voxel: float,
    shape: tuple[int, int, int],
    pitch: float,
) -> NDArray[np.float32]:
    """Project a volume by RTK's Joseph projector.

    Args:
        text: RTK's geometry file.
        volume: in RTK's own axes.
        voxel: edge length [mm].
        shape: views, rows and columns.
        pitch: of the pixels [mm].

    Returns:
        Line integrals of that shape.
    """
    itk = _itk()
    image = itk.image_from_array(np.ascontiguousarray(volume))
    image.SetSpacing([voxel] * 3)
    image.SetOrigin([-(n - 1) / 2 * voxel for n in reversed(volume.shape)])
    stack = itk.image_from_array(np.zeros(shape, np.float32))
    stack.SetSpacing([pitch, pitch, 1.0])
    stack.SetOrigin([-(shape[2] - 1) / 2 * pitch, -(shape[1] - 1) / 2 * pitch, 0.0])
    kind = itk.Image[itk.F, 3]
    project = itk.RTK.JosephForwardProjectionImageFilter[kind, kind].New()
    project.SetInput(0, stack)
    project.SetInput(1, image)
    project.SetGeometry(_read(text))
    project.Update()
    return np.array(itk.array_from_image(project.GetOutput()))


class Rtk:
    """The process, asked one thing at a time."""

    def __init__(self, pool: ProcessPoolExecutor) -> None:
        self._pool = pool

    def __call__(self, work: Callable[P, T], *args: P.args, **words: P.kwargs) -> T:
        return self._pool.submit(work, *args, **words).result(240)


@contextmanager
def rtk_process() -> Iterator[Rtk]:
    """Start it; its end is abrupt, see above."""
    with ProcessPoolExecutor(1, get_context("spawn"), initializer=_end_at_once) as pool:
        yield Rtk(pool)


def _end_at_once() -> None:
    import atexit

    atexit.register(os._exit, 0)


def _itk() -> Any:
    """Import ITK with its RTK, without the warnings that its wrappers give while they
    load.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its wrappers warn while they load
        import itk

        itk.RTK.JosephForwardProjectionImageFilter  # noqa: B018 - loads it
        return itk


def _read(text: str) -> Any:
    """Read the text of a geometry file by RTK."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "geometry.xml"
        file.write_text(text)
        reader = _itk().RTK.ThreeDCircularProjectionGeometryXMLFileReader.New()
        reader.SetFilename(str(file))
        reader.GenerateOutputInformation()
        return reader.GetOutputObject()


def _seen(geometry: Any) -> Seen:
    """What RTK says of a geometry: matrices, distances and angles of all views."""
    views = range(len(geometry.GetGantryAngles()))
    itk = _itk()
    return Seen(
        np.array([itk.array_from_matrix(geometry.GetMatrix(i)) for i in views]),
        tuple(geometry.GetSourceToIsocenterDistances()),
        {name: tuple(getattr(geometry, name)()) for name in ANGLES},
    )
