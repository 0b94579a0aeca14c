"""FDK by workers anywhere: each reads the frames, makes one slab and writes it where all see it.

The data set and the volume lie in folders that every worker sees under the same path. The slabs are
those of `zarr_volume`, whatever the number of workers. A slab's file is there only when it is
whole, so the folder itself says what is done: after any end the same command makes the slabs that
are missing. The folder's name holds a digest of what is asked for, so different requests never mix.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Executor, Future, as_completed
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from tempfile import mkdtemp
from typing import Final, TypeVar

from flexdt.clients.reconstruction.reconstruct import ScanFrames, VolumeRequest
from flexdt.extending import volume_writer
from flexdt.measuring import gpu
from flexdt.twin.errors import LimitError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import Truncation, fdk_parts
from flexdt_extensions.volumes import zarr_volume

STORE: Final = "volume.zarr"
_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class SlabWork:
    """What a worker needs to know of a volume; it travels with each slab.

    Attributes:
        parts: gives the line integrals of all views in parts.
        cone_vec: of all views.
        shape: of an image, (rows, cols).
        grid: of the whole volume.
        window: of the ramp filter.
        truncation: what lies beyond the panel's edges.
    """

    parts: Callable[[], Iterable[Float32Array]]
    cone_vec: ConeVec
    shape: tuple[int, int]
    grid: Grid
    window: str
    truncation: Truncation | None


def make_slab(work: SlabWork, slab: int, store: Path, made_by: str) -> bool:
    """Make and write one slab; a plain function, so that it can be sent to another process.

    Returns:
        Whether a CUDA device made it.

    Raises:
        TwinError: this process has another version of flexdt than the one that asks, or too little
            memory.
        DatasetError: a frame cannot be read here.
        OSError: the slab cannot be written here.
    """
    same_version(made_by)
    first, last = zarr_volume.slabs(work.grid)[slab]
    like = work.grid.slab(first, last).blank()
    try:
        made = fdk_parts(
            work.parts, work.cone_vec, work.shape, like, work.window, truncation=work.truncation
        )
        zarr_volume.put_whole(store, work.grid, slab, made.data)
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
    """Make the slabs that are missing, then the file; returns what is doubtful.

    Args:
        views: the frames, of a data set in a folder.
        grid: of the volume.
        request: the volume, by FDK.
        out: the file; the slabs lie in a hidden folder beside it until all are there.
        pool: of the workers.
        tell: called with slabs done and slabs to do.

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
        asdict(replace(request, png=False)), asdict(grid), views.cone_vec.rows.tolist(),
        [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats],
    )  # fmt: skip
    # Workers compute for themselves what this process has computed of the data set.
    sent = replace(views, dataset=replace(data))
    truncation = views.truncation()
    work = SlabWork(sent.parts, views.cone_vec, views.shape, grid, request.window, truncation)
    home, made_by = folder_of(out, identity)
    store = home / STORE
    if not store.exists():
        home.mkdir(exist_ok=True)
        empty = Path(mkdtemp(prefix="store-", dir=home))
        zarr_volume.create(empty, work.grid)
        os.replace(empty, store)
    numbers = range(len(zarr_volume.slabs(work.grid)))
    missing = [k for k in numbers if not zarr_volume.mark(store, k).exists()]
    tell(0.0, len(missing))
    running = [pool.submit(make_slab, work, k, store, made_by) for k in missing]
    kinds = set()
    with closing(as_made(running)) as made:
        for done, on_device in enumerate(made, 1):
            kinds.add(on_device)
            tell(done, len(missing))
    _finish(store, out, grid)
    shutil.rmtree(home, ignore_errors=True)
    doubts = [truncation.doubt] if truncation is not None and truncation.doubt else []
    if len(kinds) > 1:
        doubts.append("some slabs were made on devices, others on processors: last digits differ")
    return doubts


def as_made(running: Sequence[Future[_T]]) -> Generator[_T, None, None]:
    """Results in the order in which they come; what one of the tasks raises cancels the others.

    Who may fail between two results closes it, so that this cancels the others, too.
    """
    try:
        for future in as_completed(running):
            yield future.result()
    finally:
        for future in running:
            future.cancel()


def folder_of(out: Path, identity: object) -> tuple[Path, str]:
    """The folder beside `out` for what is being made of it, and this version of flexdt."""
    made_by = version("flexdt")
    text = json.dumps([made_by, identity], sort_keys=True, default=str)
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    return out.absolute().with_name(f".{out.name}.{digest}.part"), made_by


def same_version(made_by: str) -> None:
    """Check, on a worker, that it has the version of flexdt of the one that asks.

    Raises:
        TwinError: it has another.
    """
    if (here := version("flexdt")) != made_by:
        raise TwinError(f"a worker has flexdt {here}, this is {made_by}: they must be the same")


def _finish(store: Path, out: Path, grid: Grid) -> None:
    """The file of a store that is whole."""
    if out.suffix.lower() == ".zarr":
        zarr_volume.move(store, out)
        return
    values = zarr_volume.opened(store)["0"]
    with volume_writer(out, grid) as write:
        for first, last in zarr_volume.slabs(grid):
            write(values[first:last])
