"""FDK by workers anywhere: each reads the frames, makes one slab and writes it to a
shared folder.

The data set and the volume are in folders that every worker sees under the same path. The
slabs are the same for any number of workers. A slab's file appears only when it is
complete, so the folder itself records the progress: after any end the same command makes
the missing slabs. The folder's name holds a digest of the request, so different requests
never mix.

The volume is OME-NGFF 0.5 (Zarr 3), written slab by slab, in any order, by any process. A
slab is a fixed number of layers. At each resolution it is a file (a shard) for every 256
rows, which no other slab touches: slabs need no lock, and their bytes do not depend on
the writer, or on the time.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import (
    Callable,
    Generator,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from concurrent.futures import Executor, Future, as_completed
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any, Final, TypeVar

import numpy as np
import zarr

from flexdt.extending import VoxelPlaces, volume_writer
from flexdt.library.reconstruction.reconstruct import (
    ScanFrames,
    VolumeRequest,
    about_volume,
)
from flexdt.measuring import gpu
from flexdt.twin.errors import LimitError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import Truncation, fdk_parts

Sink = Callable[[Float32Array], None]
Places = Grid | VoxelPlaces
CHUNK: Final = 64
"""Number of voxels along each side of a chunk."""
ROWS: Final = 4 * CHUNK
"""Largest number of rows of a shard: data under compression are held two or three
times."""
SLAB_BYTES: Final = 128 << 20
"""Largest size of a slab [bytes]; one layer if that is more."""
SLABS: Final = 256
"""Largest number of slabs of a large volume, whose slabs are larger instead: each
reads all frames again."""
COARSEST: Final = 128
"""Number of voxels along the longest side below which there is no coarser resolution."""


def opened(path: Path) -> Any:
    """Open the group of an existing volume."""
    return zarr.open_group(path, mode="r")


def move(made: Path, path: Path) -> None:
    """Move a complete volume to its name, in place of an earlier one."""
    if (path / "zarr.json").is_file():
        shutil.rmtree(path)
    os.replace(made, path)


def slabs(grid: Places) -> list[tuple[int, int]]:
    """List the layers (first, end) of each slab of a volume; a slab has a power of two of
    layers, the last one perhaps fewer.

    There are at most CHUNK layers in one, and half as many until it has at most
    SLAB_BYTES or a SLABS-th of the volume.
    """
    each = CHUNK
    (nz, ny, nx) = grid.shape
    while each > 1 and 4 * each * ny * nx > max(SLAB_BYTES, grid.bytes // SLABS):
        each //= 2
    return [(first, min(first + each, nz)) for first in range(0, nz, each)]


def levels(grid: Places) -> list[tuple[int, int, int]]:
    """List the shape (z, y, x) of each resolution, finest first, halved (rounded up) from
    one to the next, until all sides are at most `COARSEST` or a slab has no layer
    left.
    """
    first, last = slabs(grid)[0]
    shape = grid.shape
    shapes = [shape]
    while max(shape) > COARSEST and (last - first) >> len(shapes) >= 1:
        shape = tuple(-(-n // 2) for n in shape)  # type: ignore[assignment]
        shapes.append(shape)
    return shapes


def create(path: Path, grid: Places) -> Any:
    """Create the group with its empty arrays, one for each resolution.

    An existing group is overwritten; all voxels are nan until written. Its metadata are
    OME-Zarr 0.5, with places in mm.

    Args:
        path: of the group.
        grid: of the volume.

    Returns:
        The Zarr group.
    """
    axes = [{"name": name, "type": "space", "unit": "millimeter"} for name in "zyx"]
    datasets: list[Any] = []
    about: Any = {"name": "attenuation [1/mm]", "axes": axes, "datasets": datasets}
    group = zarr.open_group(path, mode="w", zarr_format=3)
    first, last = slabs(grid)[0]
    edges = np.broadcast_to(np.asarray(grid.voxel_mm, dtype=float), 3)[::-1].tolist()
    places = list(zip(grid.center_mm[::-1], grid.shape, edges, strict=True))
    for level, shape in enumerate(levels(grid)):
        half = 2**level
        first_voxel = [at + (half * edge - n * edge) / 2 for at, n, edge in places]
        scale = {"type": "scale", "scale": [half * edge for edge in edges]}
        place = {"type": "translation", "translation": first_voxel}
        datasets.append({"path": str(level), "coordinateTransformations": [scale, place]})
        layers = -(-(last - first) // 2**level)
        chunks = layers, min(shape[1], CHUNK), min(shape[2], CHUNK)
        _, y, x = (-(-n // c) * c for n, c in zip(shape, chunks, strict=True))
        group.create_array(
            str(level),
            shape=shape,
            dtype="f4",
            chunks=chunks,
            shards=(layers, min(y, ROWS), x),
            # Zarr makes no file of a shard that holds nothing else, and zeros are something.
            fill_value=float("nan"),
            dimension_names=["z", "y", "x"],
        )
    group.attrs["ome"] = {"version": "0.5", "multiscales": [about]}
    return group


def put(group: Any, grid: Places, slab: int, values: Float32Array) -> None:
    """Write a slab of a volume into its store, at each resolution.

    Each level halves the values of the one before.

    Args:
        group: of the store.
        grid: of the volume.
        slab: its number.
        values: (k, ny, nx).
    """
    first, _ = slabs(grid)[slab]
    for level in range(len(levels(grid))):
        start = first >> level
        for y in range(0, values.shape[1], ROWS):
            block = values[:, y : y + ROWS]
            group[str(level)][start : start + len(block), y : y + block.shape[1]] = block
        values = halved(values)


def put_whole(path: Path, grid: Grid, slab: int, values: Float32Array) -> None:
    """Write a slab as `put`, from another process: into a temporary folder first, whose
    flushed files are then moved to the store, that of `mark` last.

    Args:
        path: of the store.
        grid: of the volume.
        slab: its number.
        values: (layers, ny, nx).

    Raises:
        OSError: it cannot be written; FileNotFoundError where the store is no longer
            there.
    """
    with TemporaryDirectory(
        prefix="slab-", dir=path.parent, ignore_cleanup_errors=True
    ) as folder:
        put(create(Path(folder), grid), grid, slab, values)
        for level in reversed(range(len(levels(grid)))):
            for made in sorted(Path(folder, str(level), "c").glob("*/*/0"), reverse=True):
                with made.open("rb") as file:
                    os.fsync(file.fileno())
                final = path / made.relative_to(folder)
                if path.is_dir():
                    final.parent.mkdir(parents=True, exist_ok=True)
                os.replace(made, final)


def mark(path: Path, slab: int) -> Path:
    """Return the file that exists when the slab is complete."""
    return path / "0" / "c" / str(slab) / "0" / "0"


def halved(values: Float32Array) -> Float32Array:
    """Compute means of 2 x 2 x 2 voxels, (z, y, x) rounded up; where a side is odd, its
    last layer counts twice.
    """
    odd = [(0, n % 2) for n in values.shape]
    if any(n for _, n in odd):
        even = np.pad(values, odd, "edge")
    else:
        even = values
    halves = slice(0, None, 2), slice(1, None, 2)
    # One after the other, so that the sums do not depend on the order of values in memory.
    total = sum((even[a, b, c] for a, b, c in product(halves, repeat=3)), np.float32(0.0))
    return np.asarray(total * np.float32(0.125), dtype=np.float32)


class VolumeFormat:
    """`.zarr` for flexdt (entry point `zarr`)."""

    @staticmethod
    def write(part: Path, path: Path, grid: VoxelPlaces) -> Iterator[Sink]:
        """Yield a function that takes the layers in order; at the end `part` is complete
        and becomes `path`.

        After an error `part` stays as it is.

        Args:
            part: temporary path.
            path: of the volume.
            grid: of the volume, and of what it is.
        """
        group = create(part, grid)
        if grid.about:
            group.attrs["about"] = dict(grid.about)
        todo = list(enumerate(slabs(grid)))
        held: list[Float32Array] = []

        def take(layers: Float32Array) -> None:
            """Gather layers, and write each slab once all of it is there; the rest is
            held for the next call.
            """
            held.append(layers)
            while todo and sum(map(len, held)) >= todo[0][1][1] - todo[0][1][0]:
                number, (first, last) = todo.pop(0)
                if len(held) == 1:
                    whole = held[0]
                else:
                    whole = np.concatenate(held)
                put(group, grid, number, whole[: last - first])
                held[:] = [whole[last - first :]]

        yield take
        move(part, path)

    @staticmethod
    def read(path: Path) -> tuple[Float32Array, Sequence[float], Sequence[float], bool]:
        """Read a volume from its store.

        Returns:
            Values (z, y, x), edges of a voxel and center of the first one (x, y, z) [mm], and
            True, which marks that place.
        """
        group = opened(path)
        (scale,) = group.attrs["ome"]["multiscales"]
        size, place = scale["datasets"][0]["coordinateTransformations"]
        return group["0"][:], size["scale"][::-1], place["translation"][::-1], True


STORE: Final = "volume.zarr"
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class SlabWork:
    """Data of a volume for a worker; they travel with each slab.

    Attributes:
        parts: gives the line integrals of all views in parts.
        cone_vec: of all views.
        shape: of an image, (rows, cols).
        grid: of the complete volume.
        window: of the ramp filter.
        truncation: assumption beyond the panel's edges.
    """

    parts: Callable[[], Iterable[Float32Array]]
    cone_vec: ConeVec
    shape: tuple[int, int]
    grid: Grid
    window: str
    truncation: Truncation | None


def make_slab(work: SlabWork, slab: int, store: Path, made_by: str) -> bool:
    """Reconstruct one slab by FDK and write it; a plain function, so that it can be sent
    to another process.

    Args:
        work: the volume.
        slab: number of the slab.
        store: folder of the volume.
        made_by: version of flexdt of the requesting process.

    Returns:
        Whether a CUDA device made it.

    Raises:
        TwinError: this process has another version of flexdt, or too little memory.
        DatasetError: a frame cannot be read here.
        OSError: the slab cannot be written here.
    """
    same_version(made_by)
    first, last = slabs(work.grid)[slab]
    like = work.grid.slab(first, last).blank()
    try:
        made = fdk_parts(
            work.parts,
            work.cone_vec,
            work.shape,
            like,
            work.window,
            truncation=work.truncation,
        )
        put_whole(store, work.grid, slab, made.data)
    except MemoryError as error:
        raise TwinError(
            f"a worker lacks memory for a slab of {like.data.size >> 18} MiB: {error}"
        ) from None
    return bool(gpu.availability().present)


def fdk_on_workers(
    views: ScanFrames,
    grid: Grid,
    request: VolumeRequest,
    out: Path,
    pool: Executor,
    tell: Callable[[float, float], None],
) -> list[str]:
    """Make the missing slabs of a volume on workers, then the file, and delete the slabs'
    folder.

    Slabs that exist already, of the same data, request and version, are kept.

    Args:
        views: the frames, of a data set in a folder.
        grid: of the volume.
        request: the volume, by FDK.
        out: the file; the slabs are in a hidden folder next to it until all are complete.
        pool: of the workers.
        tell: called with slabs done and slabs to do.

    Returns:
        A warning if devices made some of the slabs and processors others; else [].

    Raises:
        LimitError: another algorithm, or a data set in memory.
        TwinError: as `make_slab`.
    """
    data = views.dataset
    if request.algorithm != "fdk" or data.folder is None:
        raise LimitError(
            f"workers reconstruct data sets in folders, by fdk; not {data.where} by "
            f"{request.algorithm}",
            {"asked": request.algorithm, "allowed": ["fdk"]},
        )
    files = [path for i in views.indices if (path := data.frames[i].path) is not None]
    stats = [(str(file), file.stat()) for file in (*files, *data.darks, *data.flats)]
    identity = (
        asdict(replace(request, png=False)),
        asdict(grid),
        views.cone_vec.rows.tolist(),
        [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats],
    )
    # Workers compute derived values of the data set themselves.
    sent = replace(views, dataset=replace(data))
    truncation = views.truncation
    work = SlabWork(
        sent.parts, views.cone_vec, views.shape, grid, request.ramp_window, truncation
    )
    home, made_by = folder_of(out, identity)
    store = home / STORE
    if not store.exists():
        home.mkdir(exist_ok=True)
        empty = Path(mkdtemp(prefix="store-", dir=home))
        create(empty, work.grid)
        os.replace(empty, store)
    numbers = range(len(slabs(work.grid)))
    missing = [k for k in numbers if not mark(store, k).exists()]
    tell(0.0, len(missing))
    running = [pool.submit(make_slab, work, k, store, made_by) for k in missing]
    kinds = set()
    with closing(as_made(running)) as made:
        for done, on_device in enumerate(made, 1):
            kinds.add(on_device)
            tell(done, len(missing))
    _finish(store, out, grid, about_volume(views, request))
    shutil.rmtree(home, ignore_errors=True)
    if len(kinds) > 1:
        return [
            "some slabs were made on devices, others on processors: last digits differ"
        ]
    return []


def as_made(running: Sequence[Future[_T]]) -> Generator[_T, None, None]:
    """Yield results in the order in which they come.

    An error of one task, or closing the generator, cancels those that have not begun.
    """
    try:
        for future in as_completed(running):
            yield future.result()
    finally:
        for future in running:
            future.cancel()


def folder_of(out: Path, identity: object) -> tuple[Path, str]:
    """Name the hidden folder next to `out` for the unfinished volume; nothing is made.

    The name has a hash of flexdt's version and `identity`, so other requests have other
    folders.

    Returns:
        The path, and the version.
    """
    made_by = version("flexdt")
    text = json.dumps([made_by, identity], sort_keys=True, default=str)
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    return out.absolute().with_name(f".{out.name}.{digest}.part"), made_by


def same_version(made_by: str) -> None:
    """Check, on a worker, that it has the version of flexdt of the requesting process.

    Args:
        made_by: version of that process.

    Raises:
        TwinError: it has another.
    """
    if (here := version("flexdt")) != made_by:
        raise TwinError(
            f"a worker has flexdt {here}, this is {made_by}: they must be the same"
        )


def _finish(store: Path, out: Path, grid: Grid, about: Mapping[str, str]) -> None:
    """Move a complete store to `out` if that is .zarr; else copy its finest volume into a
    file of the other format, slab by slab.
    """
    if out.suffix.lower() == ".zarr":
        zarr.open_group(store, mode="r+").attrs["about"] = dict(about)
        move(store, out)
        return
    values = opened(store)["0"]
    with volume_writer(out, grid, about) as write:
        for first, last in slabs(grid):
            write(values[first:last])
