"""Formats of volume files: TIFF, NRRD, MetaImage, NIfTI, HDF5, Zarr; how each is written and read.

`VOLUME_FORMATS` is the only list of them. `flexdt-extensions` writes and reads Zarr.
"""

from __future__ import annotations

import gzip
import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.extras import extension, package
from flexdt.twin.projection import Grid

if TYPE_CHECKING:
    from flexdt.twin.geometry.conventions import Float32Array

HEADER_BYTES: Final = 4096
"""In which the header of a file that has one must end."""
NIFTI_DATA_BYTE: Final = 352
"""Where the values of a NIfTI-1 file begin."""
BLOCK_BYTES: Final = 64 << 20
"""Of a volume, that are put in a file's order at a time."""
BIG_TIFF_BYTES: Final = 3 << 30
"""A volume above it is a BigTIFF."""

Sink = Callable[["Float32Array"], None]
"""Takes slabs (k, ny, nx) of layers from low z to high."""
Stored = tuple[npt.NDArray[Any], float, Sequence[float], bool]
"""Values, voxel [mm], place (x, y, z) [mm], and whether that is the first voxel's or the middle."""


@dataclass(frozen=True)
class VolumeFormat:
    """One format of volume files.

    Attributes:
        endings: of its files, in lower case; the first is the usual one.
        write: from (unfinished file, final path, grid): yields what takes the slabs; afterwards the
            unfinished file is whole and gets its final path.
        read: from a path; ValueError and its like where the file is of another kind.
        require: raises TwinError where a package that the format needs is not installed.
    """

    endings: tuple[str, ...]
    write: Callable[[Path, Path, Grid], Iterator[Sink]]
    read: Callable[[Path], Stored]
    require: Callable[[], object] = lambda: None


def _renamed(write: Callable[[Path, Grid], Iterator[Sink]]) -> Callable[..., Iterator[Sink]]:
    """Writes one file, which then gets its final path."""

    def whole(part: Path, path: Path, grid: Grid) -> Iterator[Sink]:
        yield from write(part, grid)
        os.replace(part, path)

    return whole


def _headed(
    header: Callable[[Grid], bytes], compress: bool = False
) -> Callable[..., Iterator[Sink]]:
    """Writes a header and the values after it."""

    def write(part: Path, grid: Grid) -> Iterator[Sink]:
        first = header(grid)
        with gzip.open(part, "wb", compresslevel=1) if compress else part.open("wb") as file:
            file.write(first)
            yield _raw(file)

    return _renamed(write)


def _raw(file: IO[bytes] | gzip.GzipFile) -> Sink:
    def write(slab: Float32Array) -> None:
        for block in _blocks(slab):
            file.write(block.data)

    return write


def _blocks(slab: Float32Array) -> Iterator[Float32Array]:
    """Layers of a slab in the order of a file, some at a time: FDK's lie across it."""
    layers = max(1, BLOCK_BYTES // max(slab[:1].nbytes, 1))
    for first in range(0, len(slab), layers):
        yield np.ascontiguousarray(slab[first : first + layers], dtype="<f4")


def _write_tiff(part: Path, grid: Grid) -> Iterator[Sink]:
    import tifffile

    about = {
        "unit": "1/mm",
        "axes": "zyx",
        "voxel_mm": grid.voxel_mm,
        "center_mm": list(grid.center_mm),
    }
    per_cm = 10.0 / grid.voxel_mm
    with tifffile.TiffWriter(part, bigtiff=grid.bytes > BIG_TIFF_BYTES) as tiff:
        first = True

        def write(slab: Float32Array) -> None:
            nonlocal first
            for layer in chain.from_iterable(_blocks(slab)):
                tiff.write(
                    layer,
                    contiguous=True,
                    photometric="minisblack",
                    resolution=(per_cm, per_cm),
                    resolutionunit="CENTIMETER",
                    description=json.dumps(about) if first else None,
                    metadata=None,
                )
                first = False

        yield write


def _low(grid: Grid) -> list[float]:
    """Centre of the first voxel, (x, y, z) [mm]."""
    nz, ny, nx = grid.shape
    return [
        c - (n - 1) / 2 * grid.voxel_mm for c, n in zip(grid.center_mm, (nx, ny, nz), strict=True)
    ]


def _nrrd_header(grid: Grid) -> bytes:
    nz, ny, nx = grid.shape
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
        "space origin: ({:.9g},{:.9g},{:.9g})".format(*_low(grid)),
    )
    return ("\n".join(lines) + "\n\n").encode("ascii")


def _mha_header(grid: Grid) -> bytes:
    """MetaImage, header and data in one file.

    ITK takes its axes to point left, back and up, so x and y are turned: the place is then that of
    the NRRD and NIfTI files.
    """
    nz, ny, nx = grid.shape
    x, y, z = _low(grid)
    fields = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "TransformMatrix": "-1 0 0 0 -1 0 0 0 1",
        "Offset": " ".join(repr(float(place)) for place in (-x, -y, z)),
        "CenterOfRotation": "0 0 0",
        "ElementSpacing": " ".join([repr(float(grid.voxel_mm))] * 3),
        "DimSize": f"{nx} {ny} {nz}",
        "ElementType": "MET_FLOAT",
        "ElementDataFile": "LOCAL",
    }
    return "".join(f"{key} = {value}\n" for key, value in fields.items()).encode("ascii")


def _nifti_header(grid: Grid) -> bytes:
    """NIfTI-1: x to the right, y to the front, z up; data from byte 352 on."""
    nibabel = _nibabel()
    nz, ny, nx = grid.shape
    affine = np.diag([grid.voxel_mm] * 3 + [1.0])
    affine[:3, 3] = _low(grid)
    header = nibabel.Nifti1Header(endianness="<")
    header.set_data_dtype(np.float32)
    header.set_data_shape((nx, ny, nz))
    header.set_sform(affine, code=1)
    header.set_qform(affine, code=1)
    header.set_xyzt_units("mm")
    header["vox_offset"] = NIFTI_DATA_BYTE
    header["magic"] = b"n+1"
    block: bytes = header.binaryblock
    return block + bytes(NIFTI_DATA_BYTE - len(block))


def _write_hdf5(part: Path, grid: Grid) -> Iterator[Sink]:
    """One data set, `volume`, with its place as attributes."""
    with _h5py().File(part, "w") as file:
        values = file.create_dataset("volume", grid.shape, "f4")
        values.attrs.update(unit="1/mm", axes="zyx", voxel_mm=grid.voxel_mm,
                            center_mm=grid.center_mm)  # fmt: skip
        done = 0

        def write(slab: Float32Array) -> None:
            nonlocal done
            for block in _blocks(slab):
                values[done : done + len(block)] = block
                done += len(block)

        yield write


def _header(path: Path, between: str, end: bytes) -> tuple[dict[str, str], int]:
    """Fields of a header that goes on until `end`, and where the values begin behind it."""
    with path.open("rb") as file:
        head, found, _ = file.read(HEADER_BYTES).partition(end)
    if not found:
        raise ValueError("no values in the file")
    fields = (line.partition(between) for line in head.decode("ascii").splitlines())
    return {key.strip(): value.strip() for key, _, value in fields}, len(head) + len(end)


def _mapped(path: Path, offset: int, sizes: str) -> npt.NDArray[np.float32]:
    nx, ny, nz = map(int, sizes.split())
    return np.memmap(path, "<f4", "r", offset=offset, shape=(nz, ny, nx))


def _read_nrrd(path: Path) -> Stored:
    fields, begin = _header(path, ":", b"\n\n")
    values = _mapped(path, begin, fields["sizes"])
    voxel = float(fields["space directions"].split(",")[0].strip("("))
    low = [float(v) for v in fields["space origin"].strip("()").split(",")]
    return values, voxel, low, True


def _read_tiff(path: Path) -> Stored:
    import tifffile

    with tifffile.TiffFile(path) as file:
        about = json.loads(file.pages.first.description)
    values = np.asarray(tifffile.imread(path), dtype=np.float32)
    return values, float(about["voxel_mm"]), about["center_mm"], False


def _read_mha(path: Path) -> Stored:
    fields, begin = _header(path, "=", b"ElementDataFile = LOCAL\n")
    values = _mapped(path, begin, fields["DimSize"])
    x, y, z = (float(v) for v in fields["Offset"].split())
    low = [-x, -y, z]
    return values, float(fields["ElementSpacing"].split()[0]), low, True


def _read_nifti(path: Path) -> Stored:
    image = _nibabel().load(path)
    values = np.asarray(image.dataobj, dtype=np.float32).T
    return values, float(image.affine[0, 0]), image.affine[:3, 3], True


def _read_hdf5(path: Path) -> Stored:
    with _h5py().File(path) as file:
        values = file["volume"]
        about = values.attrs
        return values[:], float(about["voxel_mm"]), about["center_mm"], False


def _nibabel() -> Any:
    return package("nibabel")


def _h5py() -> Any:
    return package("h5py")


def _zarr() -> Any:
    return extension("zarr", "a volume in .zarr")


def _write_zarr(part: Path, path: Path, grid: Grid) -> Iterator[Sink]:
    yield from _zarr().write(part, path, grid)


def _read_zarr(path: Path) -> Stored:
    stored: Stored = _zarr().read(path)
    return stored


VOLUME_FORMATS: Final = (
    VolumeFormat((".tif", ".tiff"), _renamed(_write_tiff), _read_tiff),
    VolumeFormat((".nrrd",), _headed(_nrrd_header), _read_nrrd),
    VolumeFormat((".mha",), _headed(_mha_header), _read_mha),
    VolumeFormat((".nii.gz",), _headed(_nifti_header, compress=True), _read_nifti, _nibabel),
    VolumeFormat((".h5",), _renamed(_write_hdf5), _read_hdf5, _h5py),
    VolumeFormat((".zarr",), _write_zarr, _read_zarr, _zarr),
)
"""In the order in which they are listed."""
