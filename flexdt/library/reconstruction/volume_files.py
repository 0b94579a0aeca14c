"""Read and write volume files, slab by slab, in the formats of `volume_formats`; slices as PNG.

A file appears under its final name only when complete. Values are float32 [1/mm], index
order z, y, x; voxel size and position go into the file where its format has a place for
them.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.pictures import png
from flexdt.library.reconstruction.volume_formats import (
    VOLUME_FORMATS,
    OtherFormError,
    Sink,
    VolumeFormat,
    VoxelPlaces,
)
from flexdt.runtime.files.whole_files import require_bytes, room_named
from flexdt.twin.errors import GeometryError, LimitError, TwinError, words_of
from flexdt.twin.projection import Grid, Volume
from flexdt.twin.reconstruction.volume_errors import with_errors
from flexdt.twin.signatures import File

NO_PLACE: Final = (
    "NumPy's files have no room for the voxel size; write with numpy.save(FILE, "
    "volume.data) and "
    "read with Volume(numpy.load(FILE), voxel_mm)"
)


@contextmanager
def volume_writer(
    path: Path, grid: Grid | VoxelPlaces, about: Mapping[str, str] | None = None
) -> Iterator[Sink]:
    """Open `path` for a volume on `grid`, and yield the function that takes its slabs.

    The ending chooses the format. The file gets its name when all are written; after an
    error none is left. `about`: how it was made, word -> one line.

    Raises:
        LimitError: another ending, no folder, or too little room.
        TwinError: the format's package is not installed.
        OSError: the file cannot be written.
    """
    form = check_name(path)
    if isinstance(grid, Grid):
        places = VoxelPlaces.of(grid)
    else:
        places = grid
    if about:
        places = replace(places, about=about)
    if not form.packed:
        require_bytes(path, 4 * math.prod(places.shape))
    part = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        with room_named(path):
            yield from form.write(part, path, places)
    finally:
        if part.is_dir():
            shutil.rmtree(part)
        part.unlink(missing_ok=True)


def endings() -> list[str]:
    """List the endings of all formats, in their order."""
    return [ending for form in VOLUME_FORMATS for ending in form.endings]


def ending(path: Path) -> str:
    """Return the ending that names the format: the last part, or .nii.gz."""
    name = path.name.lower()
    known = [ending for ending in endings() if name.endswith(ending) and name != ending]
    return max(known, key=len, default=path.suffix.lower())


def check_name(path: Path) -> VolumeFormat:
    """Return the volume format of a file name, by its ending.

    Raises LimitError: an unknown ending, or no folder; TwinError: a missing package.
    """
    form = _format(path)
    if not path.absolute().parent.is_dir():
        raise LimitError(
            f"{path}: the folder does not exist", {"asked": str(path.parent)}
        )
    return form


def _format(path: Path) -> VolumeFormat:
    """Return the volume format with a file's ending, and check that its package is installed.

    Raises:
        LimitError: no format has this ending.
        TwinError: the package is missing.
    """
    by_ending = {ending: form for form in VOLUME_FORMATS for ending in form.endings}
    form = by_ending.get(ending(path))
    if form is None:
        if ending(path) == ".npy":
            why = f". {NO_PLACE}"
        else:
            why = ""
        raise LimitError(
            f"{path}: the ending must be one of {', '.join(by_ending)}{why}",
            {"asked": path.suffix, "allowed": [*by_ending]},
        )
    form.require()
    return form


def labelled(volume: Volume, about: Mapping[str, str]) -> Volume:
    """Return a volume whose files say how it was made."""
    told = with_errors(volume)
    object.__setattr__(told, "_about", dict(about))
    return told


def save_volume(volume: Volume, file: File) -> None:
    """Write a volume to a file, with its label (`labelled`); see `Volume.save`."""
    about: Mapping[str, str] = getattr(volume, "_about", {})
    with volume_writer(Path(file), VoxelPlaces.of(volume), about) as write:
        write(volume.data)


def read_volume(file: File) -> Volume:
    """Read a volume with its place, from a file that `volume_writer` made; the ending
    chooses the format.

    Volumes with cubic voxels get one edge, others three.

    Raises:
        OSError: it cannot be read.
        LimitError: it is not such a file, or has another ending.
        TwinError: the package that reads the format is not installed.
    """
    path = Path(file)
    form = _format(path)
    try:
        values, voxel, place, first = form.read(path)
        along_x, along_y, along_z = np.broadcast_to(
            np.asarray(voxel, dtype=float), 3
        ).tolist()
        edges = along_x, along_y, along_z
        if first:  # the place is that of the first voxel
            sizes = [*reversed(values.shape)]
            place = [
                float(p) + (n - 1) / 2 * edge
                for p, n, edge in zip(place, sizes, edges, strict=True)
            ]
        x, y, z = (float(p) for p in place)
        cubes = along_x == along_y == along_z
        return Volume(values, along_x if cubes else edges, (x, y, z))
    except OSError as error:
        if error.errno is not None:
            raise
        raise _no_volume(path, "it is cut off or damaged") from None  # h5py's
    except OtherFormError as error:
        raise _no_volume(path, words_of(error)) from None
    except GeometryError as error:
        raise _no_volume(path, error.message) from None
    except MemoryError:
        raise _no_volume(path, "it takes more memory than there is") from None
    except TwinError:
        raise
    except Exception:  # a third party's parser on a damaged file: anything may come
        raise _no_volume(path, "it is cut off or damaged") from None


def _no_volume(path: Path, why: str) -> LimitError:
    """Make the error for a file that is no volume of flexdt."""
    return LimitError(
        f"{path}: not a volume of flexdt reconstruct ({why}); values of other programs: "
        "fx.Volume(array, voxel_mm)",
        {"file": str(path)},
    )


class MiddleSlices:
    """The middle slices of a volume that comes in slabs.

    Args:
        shape: of the volume, (z, y, x).
    """

    def __init__(self, shape: tuple[int, int, int]) -> None:
        """Allocate the three middle slices, zeros, of a volume (nz, ny, nx)."""
        nz, ny, nx = self._shape = shape
        self._across_z = np.zeros((ny, nx), np.float32)
        self._across_y = np.zeros((nz, nx), np.float32)
        self._across_x = np.zeros((nz, ny), np.float32)
        self._done = 0

    def take(self, slab: npt.NDArray[np.float32]) -> bool:
        """Take the next layers (k, ny, nx), from the lowest up, and keep the parts of the
        three middle slices; whether the middle layer is among them.
        """
        nz, ny, nx = self._shape
        layers = slice(self._done, self._done + len(slab))
        self._across_y[layers] = slab[:, ny // 2]
        self._across_x[layers] = slab[:, :, nx // 2]
        middle = layers.start <= nz // 2 < layers.stop
        if middle:
            self._across_z[:] = slab[nz // 2 - layers.start]
        self._done = layers.stop
        return middle

    @property
    def images(self) -> dict[str, npt.NDArray[np.float32]]:
        """Middle slices by name, top row first; layers not taken are zero."""
        return {
            "xy": self._across_z[::-1],
            "xz": self._across_y[::-1],
            "yz": self._across_x[::-1],
        }

    def write(self, path: Path) -> list[Path]:
        """Write PNG files next to `path`, named as it is without its ending, with _xy, _xz
        and _yz; returns their paths.

        All three share one gray scale: the 0.5th and 99.5th percentile of their values.
        """
        every = np.concatenate([image.ravel() for image in self.images.values()])
        written = []
        for name, image in self.images.items():
            stem = path.name[: -len(ending(path))] if ending(path) else path.name
            written.append(path.with_name(f"{stem}_{name}.png"))
            written[-1].write_bytes(png(image, like=every))
        return written
