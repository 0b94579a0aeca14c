"""Volumes to files, slab by slab: TIFF stack, NumPy array or NRRD, and three slices as PNG.

A file appears under its final name only when whole. Values are float32 [1/mm], index order z, y, x;
voxel size and position go into the file where its format has a place for them. It refuses formats
it cannot write in slabs.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import LimitError
from flexdt.twin.projection import Volume

if TYPE_CHECKING:
    from flexdt.twin.conventions import Float32Array
    from flexdt.twin.reconstruction import Grid

SUFFIXES = (".tif", ".tiff", ".npy", ".nrrd")


class Sink(Protocol):
    """Takes slabs from low z to high."""

    def __call__(self, slab: Float32Array) -> None:
        """Add (k, ny, nx) layers."""


@contextmanager
def volume_writer(path: Path, grid: Grid) -> Iterator[Sink]:
    """Open `path` for a volume on `grid`; the ending chooses the format.

    Raises:
        LimitError: another ending, or a folder that is not there.
        OSError: the file cannot be written.
    """
    check_name(path)
    part = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        with part.open("wb") as file:
            match path.suffix.lower():
                case ".npy":
                    _npy_header(file, grid)
                    yield _raw(file)
                case ".nrrd":
                    _nrrd_header(file, grid)
                    yield _raw(file)
                case _:
                    yield from _tiff(file, grid)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def check_name(path: Path) -> None:
    """Refuse, before any work, a name that cannot be written."""
    if path.suffix.lower() not in SUFFIXES:
        raise LimitError(
            f"{path}: the ending must be one of {', '.join(SUFFIXES)}",
            {"asked": path.suffix, "allowed": list(SUFFIXES)},
        )
    if not path.absolute().parent.is_dir():
        raise LimitError(f"{path}: the folder does not exist", {"asked": str(path.parent)})


def _raw(file: IO[bytes]) -> Sink:
    def write(slab: Float32Array) -> None:
        file.write(np.ascontiguousarray(slab, dtype="<f4").tobytes())

    return write


def _tiff(file: IO[bytes], grid: Grid) -> Iterator[Sink]:
    import tifffile

    about = {
        "unit": "1/mm",
        "axes": "zyx",
        "voxel_mm": grid.voxel_mm,
        "center_mm": list(grid.center_mm),
    }
    per_cm = 10.0 / grid.voxel_mm
    with tifffile.TiffWriter(file, bigtiff=grid.bytes > 3 << 30) as tiff:
        first = True

        def write(slab: Float32Array) -> None:
            nonlocal first
            for layer in slab:
                tiff.write(
                    np.ascontiguousarray(layer, dtype=np.float32),
                    contiguous=True,
                    photometric="minisblack",
                    resolution=(per_cm, per_cm),
                    resolutionunit="CENTIMETER",
                    description=json.dumps(about) if first else None,
                    metadata=None,
                )
                first = False

        yield write


def _npy_header(file: IO[bytes], grid: Grid) -> None:
    np.lib.format.write_array_header_1_0(
        file, {"descr": "<f4", "fortran_order": False, "shape": grid.shape}
    )


def _nrrd_header(file: IO[bytes], grid: Grid) -> None:
    nz, ny, nx = grid.shape
    low = [
        c - (n - 1) / 2 * grid.voxel_mm for c, n in zip(grid.center_mm, (nx, ny, nz), strict=True)
    ]
    v = f"{grid.voxel_mm:.9g}"
    lines = (
        "NRRD0004",
        "type: float",
        "dimension: 3",
        "space: right-anterior-superior",
        f"sizes: {nx} {ny} {nz}",
        f"space directions: ({v},0,0) (0,{v},0) (0,0,{v})",
        "kinds: domain domain domain",
        "endian: little",
        "encoding: raw",
        f"space origin: ({low[0]:.9g},{low[1]:.9g},{low[2]:.9g})",
    )
    file.write(("\n".join(lines) + "\n\n").encode("ascii"))


def read_values(path: Path) -> npt.NDArray[np.float32]:
    """Values of a file that `volume_writer` made, (nz, ny, nx).

    Raises:
        OSError: it cannot be read.
        LimitError: it is not such a file.
    """
    if path.suffix.lower() == ".nrrd":
        head, sizes, _ = _nrrd(path)
        return np.memmap(path, "<f4", "r", offset=head, shape=sizes)
    if path.suffix.lower() == ".npy":
        return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))
    import tifffile

    return np.asarray(tifffile.imread(path), dtype=np.float32)


def read_volume(path: Path) -> Volume:
    """A volume with its place, from a TIFF or NRRD that `volume_writer` made.

    Raises:
        OSError: it cannot be read.
        LimitError: it is not such a file (NumPy's format has no room for the place).
    """
    try:
        if path.suffix.lower() == ".nrrd":
            _, sizes, fields = _nrrd(path)
            voxel = float(fields["space directions"].split(",")[0].strip("("))
            low = [float(v) for v in fields["space origin"].strip("()").split(",")]
            center = [v + (n - 1) / 2 * voxel for v, n in zip(low, reversed(sizes), strict=True)]
        else:
            import tifffile

            with tifffile.TiffFile(path) as file:
                about = json.loads(file.pages.first.description)
            voxel, center = float(about["voxel_mm"]), [float(v) for v in about["center_mm"]]
        x, y, z = center
        return Volume(read_values(path), voxel, (x, y, z))
    except (ValueError, KeyError, TypeError, AttributeError):
        raise LimitError(
            f"{path}: not a volume of flexdt reconstruct", {"file": str(path)}
        ) from None


def _nrrd(path: Path) -> tuple[int, tuple[int, int, int], dict[str, str]]:
    """Length of an NRRD's header, (nz, ny, nx), and its fields."""
    with path.open("rb") as file:
        head, end, _ = file.read(4096).partition(b"\n\n")
    if not head.startswith(b"NRRD") or not end:
        raise LimitError(f"{path}: not an NRRD with attached data", {"file": str(path)})
    lines = head.decode("ascii").splitlines()[1:]
    fields = {k: v.strip() for k, _, v in (line.partition(":") for line in lines)}
    nx, ny, nz = (int(n) for n in fields["sizes"].split())
    return len(head) + 2, (nz, ny, nx), fields


def write_slices(path: Path, volume: npt.NDArray[np.float32]) -> list[Path]:
    """Middle slices across z, y and x as PNG files beside `path`, named after all of its name (so
    those of `v.tif` and `v.nrrd` keep apart); returns their paths.

    All three share one grey scale: the 0.5th and 99.5th percentile of their values.
    """
    import cv2

    slices = middle_slices(volume)
    low, high = np.percentile(np.concatenate([s.ravel() for s in slices.values()]), [0.5, 99.5])
    written = []
    for name, image in slices.items():
        scaled = (image - low) * (255.0 / max(float(high - low), 1e-30))
        file = path.with_name(f"{path.name}_{name}.png")
        ok, encoded = cv2.imencode(".png", np.clip(np.rint(scaled), 0, 255).astype(np.uint8))
        if not ok:
            raise OSError(f"{file}: the image could not be encoded as PNG")
        file.write_bytes(encoded.tobytes())
        written.append(file)
    return written


def middle_slices(volume: npt.NDArray[np.float32]) -> dict[str, npt.NDArray[np.float32]]:
    """Middle slices by name: xy (seen from above, +y up), xz and yz (+z up)."""
    nz, ny, nx = volume.shape
    return {
        "xy": volume[nz // 2, ::-1],
        "xz": volume[::-1, ny // 2],
        "yz": volume[::-1, :, nx // 2],
    }
