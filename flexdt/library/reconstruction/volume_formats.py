"""Formats of volume files: TIFF, NRRD, MetaImage, NIfTI, HDF5, Zarr; how each is written and
read.

`VOLUME_FORMATS` is the only list of them. `flexdt-extensions` writes and reads Zarr.
"""

from __future__ import annotations

import gzip
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.optional.extras import extension, package
from flexdt.library.optional.hdf5_files import hdf5_file
from flexdt.twin.projection import Grid
from flexdt.twin.projection.volume import edges_xyz

if TYPE_CHECKING:
    from flexdt.twin.geometry.conventions import Float32Array, FloatArray
    from flexdt.twin.projection import Volume

HEADER_BYTES: Final = 4096
"""In which the header of a file that has one must end."""
NIFTI_DATA_BYTE: Final = 352
"""Where the values of a NIfTI-1 file begin."""
BLOCK_BYTES: Final = 64 << 20
"""Of a volume, that are put in a file's order at a time."""
BIG_TIFF_BYTES: Final = 3 << 30
"""A volume above it is a BigTIFF."""
NRRD_FIELDS: Final[Mapping[str, str]] = {
    "type": "float",
    "dimension": "3",
    "space": "3D-right-handed",
    "sizes": "",
    "space directions": "",
    "kinds": "domain domain domain",
    "endian": "little",
    "encoding": "raw",
    "space origin": "",
}
"""Field of NRRD's header, in order -> its value in every file, empty where it is the
volume's."""
MHA_FIELDS: Final[Mapping[str, str]] = {
    "ObjectType": "Image",
    "NDims": "3",
    "BinaryData": "True",
    "BinaryDataByteOrderMSB": "False",
    "CompressedData": "False",
    "TransformMatrix": "1 0 0 0 1 0 0 0 1",
    "Offset": "",
    "CenterOfRotation": "0 0 0",
    "ElementSpacing": "",
    "DimSize": "",
    "ElementType": "MET_FLOAT",
    "ElementDataFile": "LOCAL",
}
"""The same of MetaImage's header."""
OLDER_FIELDS: Final[Mapping[str, str]] = {
    "space": "right-anterior-superior",
    "TransformMatrix": "-1 0 0 0 -1 0 0 0 1",
}
"""Values of files up to version 0.4: the first names the same coordinates, and with the second
x and y of the offset have the other sign."""
FIELDS_OF_OTHER_VALUES: Final = (
    "ElementNumberOfChannels",
    "HeaderSize",
    "byte skip",
    "line skip",
    "data file",
    "datafile",
)
"""Fields of either header that change the values or their place."""
TIFF_LINE: Final = "flexdt="
"""Begins the line of a TIFF's description that has voxel, place and what the volume is of."""
NIFTI_WORDS: Final = 79
"""Longest text in a NIfTI-1 header [bytes]."""
MHA_WORDS: Final = 200
"""Longest text in MetaImage's header: older readers hold 255 bytes."""
MAX_ASIDE: Final = 1e-6
"""Largest component of an axis along another, relative to the longest edge: rounding."""

Sink = Callable[["Float32Array"], None]
"""Takes slabs (k, ny, nx) of layers from low z to high."""
Stored = tuple[npt.NDArray[Any], float | Sequence[float], Sequence[float], bool]
"""Values, edge or edges (x, y, z) of a voxel [mm], place (x, y, z) [mm], and whether that is
the first voxel's or the middle."""


class OtherFormError(ValueError):
    """A file that is no volume of flexdt; its message says what is different."""


@dataclass(frozen=True)
class VoxelPlaces:
    """Positions of the voxels of a file.

    Attributes:
        shape: (nz, ny, nx).
        edges_mm: of a voxel, (x, y, z) [mm].
        center_mm: (x, y, z) of the middle [mm].
        about: word -> of what the volume is and how it was made, one line each.
    """

    shape: tuple[int, int, int]
    edges_mm: tuple[float, float, float]
    center_mm: tuple[float, float, float]
    about: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, grid: Grid | Volume) -> VoxelPlaces:
        """Take those of a grid, or of a volume."""
        return cls(grid.shape, edges_xyz(grid.voxel_mm), grid.center_mm)

    @property
    def cubes(self) -> bool:
        """Whether voxels are cubes."""
        return len(set(self.edges_mm)) == 1

    @property
    def voxel_mm(self) -> float | tuple[float, float, float]:
        """Edge of cubes, else the three edges (x, y, z) [mm]."""
        return self.edges_mm[0] if self.cubes else self.edges_mm

    @property
    def bytes(self) -> int:
        """Size of the values as float32."""
        return 4 * math.prod(self.shape)

    @property
    def first_mm(self) -> list[float]:
        """Centre of the first voxel (lowest x, y and z), (x, y, z) [mm]."""
        counts = reversed(self.shape)
        return [
            middle - (n - 1) / 2 * edge
            for middle, n, edge in zip(self.center_mm, counts, self.edges_mm, strict=True)
        ]


@dataclass(frozen=True)
class VolumeFormat:
    """One format of volume files.

    Attributes:
        endings: of its files, in lower case; the first is the usual one.
        write: from (unfinished file, final path, places): yields the function that takes
            slabs; afterwards the unfinished file is complete and gets its final path.
        read: from a path; ValueError and its like where the file is of another kind.
        require: raises TwinError where a package that the format needs is not installed.
        packed: whether it is compressed, so that its size is not known before.
    """

    endings: tuple[str, ...]
    write: Callable[[Path, Path, VoxelPlaces], Iterator[Sink]]
    read: Callable[[Path], Stored]
    require: Callable[[], object] = lambda: None
    packed: bool = False


def _write_and_rename(
    write: Callable[[Path, VoxelPlaces], Iterator[Sink]],
) -> Callable[..., Iterator[Sink]]:
    """Wrap the writer of one file: it writes to a temporary path.

    That gets the final name at the end, but not after an error.
    """

    def write_whole_file(part: Path, path: Path, places: VoxelPlaces) -> Iterator[Sink]:
        yield from write(part, places)
        os.replace(part, path)

    return write_whole_file


def _write_headed(
    header: Callable[[VoxelPlaces], bytes], compress: bool = False
) -> Callable[..., Iterator[Sink]]:
    """Return a writer of a header and the raw values after it, for `VolumeFormat.write`.

    The file gets its path only when complete.

    Args:
        header: makes the header of a volume.
        compress: by gzip.
    """

    def write(part: Path, places: VoxelPlaces) -> Iterator[Sink]:
        """Write header and voxels to a file, compressed by gzip on request; yields the
        function that takes the slabs.
        """
        first = header(places)
        with (
            gzip.open(part, "wb", compresslevel=1)
            if compress
            else part.open("wb") as file
        ):
            file.write(first)
            yield _raw(file)

    return _write_and_rename(write)


def _raw(file: IO[bytes] | gzip.GzipFile) -> Sink:
    """Return a function that writes slabs to a file as raw float32, x fastest, then y,
    then z.
    """

    def write(slab: Float32Array) -> None:
        for block in _blocks(slab):
            file.write(block.data)

    return write


def _blocks(slab: Float32Array) -> Iterator[Float32Array]:
    """Yield layers of a slab in the order of a file, some at a time: FDK's order is another."""
    layers = max(1, BLOCK_BYTES // max(slab[:1].nbytes, 1))
    for first in range(0, len(slab), layers):
        yield np.ascontiguousarray(slab[first : first + layers], dtype="<f4")


def _write_tiff(part: Path, places: VoxelPlaces) -> Iterator[Sink]:
    """Write a page for each layer, with voxel and place in the first page's description: in
    lines that ImageJ, Fiji and tifffile read, then in one of ours.

    Yields the function that takes the slabs, lowest first; BigTIFF above
    `BIG_TIFF_BYTES`.

    Args:
        part: the unfinished file.
        places: of the voxels.
    """
    import tifffile

    about = {
        "unit": "1/mm",
        "axes": "zyx",
        "voxel_mm": places.voxel_mm,
        "center_mm": list(places.center_mm),
        "about": dict(places.about),
    }
    layers = places.shape[0]
    lines = [
        "ImageJ=1.11a",
        f"images={layers}",
        f"slices={layers}",
        "unit=mm",
        f"spacing={places.edges_mm[2]!r}",
        "loop=false",
        TIFF_LINE + json.dumps(about),
    ]
    with tifffile.TiffWriter(part, bigtiff=places.bytes > BIG_TIFF_BYTES) as tiff:
        first = True

        def write(slab: Float32Array) -> None:
            """Write a slab as pages, one a layer; only the file's first page gets the
            description (size and place, JSON).
            """
            nonlocal first
            for layer in chain.from_iterable(_blocks(slab)):
                tiff.write(
                    layer,
                    contiguous=True,
                    photometric="minisblack",
                    # Of the description's unit, as ImageJ writes it.
                    resolution=(1.0 / places.edges_mm[0], 1.0 / places.edges_mm[1]),
                    resolutionunit="NONE",
                    description="\n".join(lines) + "\n" if first else None,
                    metadata=None,
                )
                first = False

        yield write


def _plain(words: str, most: int) -> str:
    """Return words as at most so many ASCII characters of one line, others as ``\\xe9``."""
    line = " ".join(words.split())
    return line.encode("ascii", "backslashreplace")[:most].decode("ascii")


def _nrrd_header(places: VoxelPlaces) -> bytes:
    """Make NRRD's header for raw little-endian floats: sizes (x, y, z), voxel edges and
    first voxel [mm] in a right-handed space, whose names of directions are left open: readers
    would turn those of patients.
    """
    nz, ny, nx = places.shape
    x, y, z = (f"{edge:.9g}" for edge in places.edges_mm)
    fields = dict(NRRD_FIELDS) | {
        "sizes": f"{nx} {ny} {nz}",
        "space directions": f"({x},0,0) (0,{y},0) (0,0,{z})",
        "space origin": "({:.9g},{:.9g},{:.9g})".format(*places.first_mm),
    }
    about = (f"{key}:={_plain(value, 500)}" for key, value in places.about.items())
    lines = ("NRRD0004", *(f"{key}: {value}" for key, value in fields.items()), *about)
    return ("\n".join(lines) + "\n\n").encode("ascii")


def _mha_header(places: VoxelPlaces) -> bytes:
    """Make MetaImage's header, of a file with header and data; its physical point is ours."""
    nz, ny, nx = places.shape
    said = "; ".join(f"{key}: {value}" for key, value in places.about.items())
    fields = ({"Comment": _plain(said, MHA_WORDS)} if said else {}) | dict(MHA_FIELDS)
    fields |= {
        "Offset": " ".join(repr(float(place)) for place in places.first_mm),
        "ElementSpacing": " ".join(repr(float(edge)) for edge in places.edges_mm),
        "DimSize": f"{nx} {ny} {nz}",
    }
    return "".join(f"{key} = {value}\n" for key, value in fields.items()).encode("ascii")


def _nifti_header(places: VoxelPlaces) -> bytes:
    """Make NIfTI-1's header, padded to the data's first byte (352): x to the right, y to
    the front, z up, [mm].

    Raises TwinError if nibabel is missing.
    """
    nibabel = _nibabel()
    nz, ny, nx = places.shape
    affine = np.diag([*places.edges_mm, 1.0])
    affine[:3, 3] = places.first_mm
    header = nibabel.Nifti1Header(endianness="<")
    header.set_data_dtype(np.float32)
    header.set_data_shape((nx, ny, nz))
    header.set_sform(affine, code=1)
    header.set_qform(affine, code=1)
    header.set_xyzt_units("mm")
    header["vox_offset"] = NIFTI_DATA_BYTE
    header["magic"] = b"n+1"
    header["descrip"] = _plain("; ".join(places.about.values()), NIFTI_WORDS).encode()
    block: bytes = header.binaryblock
    return block + bytes(NIFTI_DATA_BYTE - len(block))


def _write_hdf5(part: Path, places: VoxelPlaces) -> Iterator[Sink]:
    """Write one data set, `volume`, with its place as attributes.

    Args:
        part: the unfinished file.
        places: of the voxels.

    Yields:
        The function that takes the slabs, lowest first.

    Raises:
        TwinError: h5py is missing.
    """
    with _h5py().File(part, "w") as file:
        values = file.create_dataset("volume", places.shape, "f4")
        values.attrs.update(
            unit="1/mm",
            axes="zyx",
            voxel_mm=places.voxel_mm,
            center_mm=places.center_mm,
            **places.about,
        )
        done = 0

        def write(slab: Float32Array) -> None:
            """Write a slab behind those written before."""
            nonlocal done
            for block in _blocks(slab):
                values[done : done + len(block)] = block
                done += len(block)

        yield write


def _header(path: Path, between: str, end: bytes) -> tuple[dict[str, str], int]:
    """Read the fields of an ASCII header, name and value stripped, and the offset of the values
    [bytes].

    `path`: of the file; `between`: separates name and value in a line; `end`: ends the header,
    within the first `HEADER_BYTES`.
    Raises ValueError: no such end, or a header that is not ASCII."""
    with path.open("rb") as file:
        head, mark, _ = file.read(HEADER_BYTES).partition(end)
    if not mark:
        raise OtherFormError("no values in the file")
    fields = (line.partition(between) for line in head.decode("ascii").splitlines())
    return {key.strip(): value.strip() for key, _, value in fields}, len(head) + len(end)


def _require_own(fields: Mapping[str, str], own: Mapping[str, str]) -> None:
    """Check that a header contradicts nothing that each file of flexdt states: a form of values
    that is read as it is. Fields that are missing pass.

    `fields`: of the file; `own`: `NRRD_FIELDS` or `MHA_FIELDS`.
    Raises ValueError: names the first field that does.
    """
    for key, value in own.items():
        if value and fields.get(key, value) not in (value, OLDER_FIELDS.get(key)):
            raise OtherFormError(f"its {key} is {fields[key]}; allowed: {value}")
    for key in FIELDS_OF_OTHER_VALUES:
        if key in fields:
            raise OtherFormError(f"its {key} is {fields[key]}; allowed: none")


def _map_values(path: Path, offset: int, sizes: str) -> npt.NDArray[np.float32]:
    """Map the values of a file, (nz, ny, nx), which end where it ends.

    Raises:
        ValueError: it has more or fewer bytes.
    """
    nx, ny, nz = map(int, sizes.split())
    held = path.stat().st_size - offset
    if held != 4 * nx * ny * nz:
        raise OtherFormError(
            f"{nx} x {ny} x {nz} values take {4 * nx * ny * nz} bytes; it holds {held}"
        )
    return np.memmap(path, "<f4", "r", offset=offset, shape=(nz, ny, nx))


def _read_nrrd(path: Path) -> Stored:
    """Read voxels (memory-mapped), edges [mm], the first voxel's place [mm] and True (it
    is the first voxel's, not the center) from an .nrrd file.
    """
    fields, begin = _header(path, ":", b"\n\n")
    _require_own(fields, NRRD_FIELDS)
    values = _map_values(path, begin, fields["sizes"])
    rows = fields["space directions"].split()
    axes = np.array([row.strip("()").split(",") for row in rows], dtype=float)
    edges = _upright(axes)
    low = [float(v) for v in fields["space origin"].strip("()").split(",")]
    return values, edges, low, True


def _read_tiff(path: Path) -> Stored:
    """Read voxels, edge [mm], center [mm] and False (it is the center, not the first
    voxel's place) from a .tif file.
    """
    import tifffile

    with tifffile.TiffFile(path) as file:
        said = file.pages.first.description
    # Files up to version 0.4 have nothing else.
    about = json.loads(said.partition(TIFF_LINE)[2] or said)
    values = np.asarray(tifffile.imread(path), dtype=np.float32)
    return values, about["voxel_mm"], about["center_mm"], False


def _read_mha(path: Path) -> Stored:
    """Read voxels (memory-mapped), edges [mm], the first voxel's place [mm] and True (it
    is the first voxel's, not the center) from an .mha file, or from an .mhd with its values
    in a file beside it."""
    fields, begin = _header(path, "=", b"ElementDataFile =")
    with path.open("rb") as file:
        file.seek(begin)
        line = file.readline(HEADER_BYTES)
    name = line.decode("ascii").strip()
    _require_own(fields, MHA_FIELDS)
    if name == "LOCAL":
        values = _map_values(path, begin + len(line), fields["DimSize"])
    elif Path(name).name == name:
        values = _map_values(path.parent / name, 0, fields["DimSize"])
    else:
        raise OtherFormError(f"its values are in {name}; allowed: a file beside it")
    x, y, z = (float(v) for v in fields.get("Offset", "0 0 0").split())
    older = fields.get("TransformMatrix") == OLDER_FIELDS["TransformMatrix"]
    low = [-x, -y, z] if older else [x, y, z]
    return values, [float(edge) for edge in fields["ElementSpacing"].split()], low, True


def _read_nifti(path: Path) -> Stored:
    """Read voxels, edges [mm], the first voxel's place [mm] and True (it is the first
    voxel's, not the center) from a .nii.gz file, by its own scale.

    Raises:
        ValueError: another unit of length, values that are not real, or turned axes.
    """
    image = _nibabel().load(path)
    length = image.header.get_xyzt_units()[0]
    if length != "mm":
        raise OtherFormError(f"its lengths are in {length}; allowed: mm")
    values = np.asarray(image.dataobj)
    if values.ndim != 3 or values.dtype.kind not in "fiu":
        kind = f"{values.dtype} of shape {values.shape[::-1]}"
        raise OtherFormError(f"its values are {kind}; allowed: real numbers (nz, ny, nx)")
    edges = _upright(image.affine[:3, :3])
    return values.astype(np.float32).T, edges, image.affine[:3, 3], True


def _upright(axes: FloatArray) -> list[float]:
    """Return the voxel edges of axes (3, 3) that point right, front and up [mm].

    Raises:
        ValueError: axes that are turned or mirrored.
    """
    edges = np.diag(axes)
    aside = np.abs(axes - np.diag(edges)).max()
    if not (edges > 0.0).all() or not aside <= MAX_ASIDE * edges.max():
        raise OtherFormError(
            f"its axes are {axes.tolist()}; allowed: right, front and up"
        )
    return [float(edge) for edge in edges]


def _read_hdf5(path: Path) -> Stored:
    """Read voxels, edge [mm], center [mm] and False (it is the center, not the first
    voxel's place) from an .h5 file.
    """
    with hdf5_file(path, "a volume in .h5") as file:
        values = file["volume"]
        about = values.attrs
        return values[:], about["voxel_mm"], about["center_mm"], False


def _nibabel() -> Any:
    return package("nibabel")


def _h5py() -> Any:
    return package("h5py")


def _zarr() -> Any:
    return extension("zarr", "a volume in .zarr")


def _write_zarr(part: Path, path: Path, places: VoxelPlaces) -> Iterator[Sink]:
    """Write by the function of the extension."""
    yield from _zarr().write(part, path, places)


def _read_zarr(path: Path) -> Stored:
    stored: Stored = _zarr().read(path)
    return stored


VOLUME_FORMATS: Final = (
    VolumeFormat((".tif", ".tiff"), _write_and_rename(_write_tiff), _read_tiff),
    VolumeFormat((".nrrd",), _write_headed(_nrrd_header), _read_nrrd),
    VolumeFormat((".mha", ".mhd"), _write_headed(_mha_header), _read_mha),
    VolumeFormat(
        (".nii.gz",),
        _write_headed(_nifti_header, compress=True),
        _read_nifti,
        _nibabel,
        packed=True,
    ),
    VolumeFormat((".h5",), _write_and_rename(_write_hdf5), _read_hdf5, _h5py),
    VolumeFormat((".zarr",), _write_zarr, _read_zarr, _zarr, packed=True),
)
"""In the order in which they are listed."""
