"""Volumes to files, slab by slab: TIFF, NRRD, MetaImage, NIfTI, HDF5; slices as PNG.

`flexdt-extensions` writes and reads Zarr.

A file appears under its final name only when whole. Values are float32 [1/mm], index order z, y, x;
voxel size and position go into the file where its format has a place for them.
"""

from __future__ import annotations

import gzip
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.pictures import png
from flexdt.library.extras import extension, package
from flexdt.twin.errors import LimitError
from flexdt.twin.projection import Grid, Volume
from flexdt.twin.signatures import File

if TYPE_CHECKING:
    from flexdt.twin.geometry.conventions import Float32Array

SUFFIXES: Final = (".tif", ".tiff", ".nrrd", ".mha", ".nii.gz", ".h5", ".zarr")
PACKAGES: Final = {".nii.gz": "nibabel", ".h5": "h5py"}
"""What writes these formats; the others need nothing more."""
NO_PLACE: Final = (
    "NumPy's files have no room for the voxel size; write with numpy.save(FILE, volume.data) and "
    "read with Volume(numpy.load(FILE), voxel_mm)"
)


Sink = Callable[["Float32Array"], None]
"""Takes slabs (k, ny, nx) of layers from low z to high."""


@contextmanager
def volume_writer(path: Path, grid: Grid) -> Iterator[Sink]:
    """Open `path` for a volume on `grid`; the ending chooses the format.

    Raises:
        LimitError: another ending, or a folder that is not there.
        TwinError: the package that writes the format is not installed.
        OSError: the file cannot be written.
    """
    check_name(path)
    part = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        match ending(path):
            case ".h5":
                yield from _hdf5(part, grid)
            case ".zarr":
                yield from _zarr().write(part, path, grid)
                return
            case ".nii.gz":
                header = _nifti_header(grid)
                with gzip.open(part, "wb", compresslevel=1) as file:
                    file.write(header)
                    yield _raw(file)
            case form:
                with part.open("wb") as file:
                    if form in HEADERS:
                        file.write(HEADERS[form](grid))
                        yield _raw(file)
                    else:
                        yield from _tiff(file, grid)
        os.replace(part, path)
    finally:
        if part.is_dir():
            shutil.rmtree(part)
        part.unlink(missing_ok=True)


def ending(path: Path) -> str:
    """What says the format: the last part of the name, with two dots for .nii.gz."""
    name = path.name.lower()
    return ".nii.gz" if name.endswith(".nii.gz") else path.suffix.lower()


def check_name(path: Path) -> None:
    """Check, before any work, that a file of this name can be written."""
    _check_format(path)
    if not path.absolute().parent.is_dir():
        raise LimitError(f"{path}: the folder does not exist", {"asked": str(path.parent)})


def _check_format(path: Path) -> None:
    if ending(path) not in SUFFIXES:
        why = f". {NO_PLACE}" if ending(path) == ".npy" else ""
        raise LimitError(
            f"{path}: the ending must be one of {', '.join(SUFFIXES)}{why}",
            {"asked": path.suffix, "allowed": list(SUFFIXES)},
        )
    if ending(path) in PACKAGES:
        package(PACKAGES[ending(path)])
    elif ending(path) == ".zarr":
        _zarr()


def _zarr() -> Any:
    return extension("zarr", "a volume in .zarr")


def save_volume(volume: Volume, file: File) -> None:
    """See `Volume.save`."""
    voxel = volume.voxel_xyz
    if len(set(voxel)) > 1:
        said = f"voxels of {' x '.join(f'{v:g}' for v in voxel)} mm"
        raise LimitError.instead(said, list(voxel), "cubes, three equal edges")
    with volume_writer(Path(file), Grid(volume.shape, voxel[0], volume.center_mm)) as write:
        write(volume.data)


def _raw(file: IO[bytes] | gzip.GzipFile) -> Sink:
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
    nibabel = package("nibabel")
    nz, ny, nx = grid.shape
    affine = np.diag([grid.voxel_mm] * 3 + [1.0])
    affine[:3, 3] = _low(grid)
    header = nibabel.Nifti1Header(endianness="<")
    header.set_data_dtype(np.float32)
    header.set_data_shape((nx, ny, nz))
    header.set_sform(affine, code=1)
    header.set_qform(affine, code=1)
    header.set_xyzt_units("mm")
    header["vox_offset"] = 352
    header["magic"] = b"n+1"
    block: bytes = header.binaryblock
    return block + bytes(352 - len(block))


HEADERS: Final[Mapping[str, Callable[[Grid], bytes]]] = {".nrrd": _nrrd_header, ".mha": _mha_header}
"""Formats that are a header and the values after it."""


def _hdf5(part: Path, grid: Grid) -> Iterator[Sink]:
    """One data set, `volume`, with its place as attributes."""
    h5py = package("h5py")
    with h5py.File(part, "w") as file:
        values = file.create_dataset("volume", grid.shape, "f4")
        values.attrs.update(unit="1/mm", axes="zyx", voxel_mm=grid.voxel_mm,
                            center_mm=grid.center_mm)  # fmt: skip
        done = 0

        def write(slab: Float32Array) -> None:
            nonlocal done
            values[done : done + len(slab)] = slab
            done += len(slab)

        yield write


def read_volume(file: File) -> Volume:
    """A volume with its place, from a file that `volume_writer` made.

    Raises:
        OSError: it cannot be read.
        LimitError: it is not such a file.
    """
    path = Path(file)
    _check_format(path)
    try:
        values, voxel, place, first = READERS[ending(path)](path)
        if first:  # the place is that of the first voxel
            sizes = reversed(values.shape)
            place = [float(p) + (n - 1) / 2 * voxel for p, n in zip(place, sizes, strict=True)]
        x, y, z = (float(p) for p in place)
        return Volume(values, float(voxel), (x, y, z))
    except (ValueError, KeyError, TypeError, AttributeError, IndexError):
        raise LimitError(
            f"{path}: not a volume of flexdt reconstruct", {"file": str(path)}
        ) from None


Read = tuple[npt.NDArray[Any], float, Sequence[float], bool]
"""Values, voxel [mm], place (x, y, z) [mm], and whether that is the first voxel's or the middle."""


def _header(path: Path, between: str, end: bytes) -> tuple[dict[str, str], int]:
    """Fields of a header that goes on until `end`, and where the values begin behind it."""
    with path.open("rb") as file:
        head, found, _ = file.read(4096).partition(end)
    if not found:
        raise ValueError("no values in the file")
    fields = (line.partition(between) for line in head.decode("ascii").splitlines())
    return {key.strip(): value.strip() for key, _, value in fields}, len(head) + len(end)


def _mapped(path: Path, offset: int, sizes: str) -> npt.NDArray[np.float32]:
    nx, ny, nz = map(int, sizes.split())
    return np.memmap(path, "<f4", "r", offset=offset, shape=(nz, ny, nx))


def _read_nrrd(path: Path) -> Read:
    fields, begin = _header(path, ":", b"\n\n")
    values = _mapped(path, begin, fields["sizes"])
    voxel = float(fields["space directions"].split(",")[0].strip("("))
    low = [float(v) for v in fields["space origin"].strip("()").split(",")]
    return values, voxel, low, True


def _read_tiff(path: Path) -> Read:
    import tifffile

    with tifffile.TiffFile(path) as file:
        about = json.loads(file.pages.first.description)
    values = np.asarray(tifffile.imread(path), dtype=np.float32)
    return values, float(about["voxel_mm"]), about["center_mm"], False


def _read_mha(path: Path) -> Read:
    fields, begin = _header(path, "=", b"ElementDataFile = LOCAL\n")
    values = _mapped(path, begin, fields["DimSize"])
    x, y, z = (float(v) for v in fields["Offset"].split())
    low = [-x, -y, z]
    return values, float(fields["ElementSpacing"].split()[0]), low, True


def _read_nifti(path: Path) -> Read:
    image = package("nibabel").load(path)
    values = np.asarray(image.dataobj, dtype=np.float32).T
    return values, float(image.affine[0, 0]), image.affine[:3, 3], True


def _read_hdf5(path: Path) -> Read:
    with package("h5py").File(path) as file:
        values = file["volume"]
        about = values.attrs
        return values[:], float(about["voxel_mm"]), about["center_mm"], False


READERS: Final[Mapping[str, Callable[[Path], Read]]] = {
    ".tif": _read_tiff,
    ".tiff": _read_tiff,
    ".nrrd": _read_nrrd,
    ".mha": _read_mha,
    ".nii.gz": _read_nifti,
    ".h5": _read_hdf5,
    ".zarr": lambda path: _zarr().read(path),
}


def write_slices(path: Path, volume: npt.NDArray[np.float32]) -> list[Path]:
    """Middle slices across z, y and x as PNG files beside `path`, named after all of its name (so
    those of `v.tif` and `v.nrrd` keep apart); returns their paths.

    All three share one grey scale: the 0.5th and 99.5th percentile of their values.
    """
    slices = middle_slices(volume)
    every = np.concatenate([s.ravel() for s in slices.values()])
    written = []
    for name, image in slices.items():
        written.append(path.with_name(f"{path.name}_{name}.png"))
        written[-1].write_bytes(png(image, like=every))
    return written


def middle_slices(volume: npt.NDArray[np.float32]) -> dict[str, npt.NDArray[np.float32]]:
    """Middle slices by name: xy (seen from above, +y up), xz and yz (+z up)."""
    nz, ny, nx = volume.shape
    return {
        "xy": volume[nz // 2, ::-1],
        "xz": volume[::-1, ny // 2],
        "yz": volume[::-1, :, nx // 2],
    }
