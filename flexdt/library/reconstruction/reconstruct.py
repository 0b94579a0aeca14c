"""`flexdt reconstruct` without its command line: a data set in, a volume file out.

FDK goes slab by slab and prepares images in parts, so memory stays bounded whatever the
volume's size, and each image is read once: `memory_plan` decides which parts are in memory
at a time, and images that are needed again are in `kept_images`. The iterative algorithms
hold everything and are for small or binned problems. Missing frames are left out, and the
outcome states how many.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from flexdt.library.datasets.image_doubts import image_doubts
from flexdt.library.datasets.image_set import ImageSet
from flexdt.library.optional.extras import extension
from flexdt.library.reconstruction.bad_pixels import without_bad_pixels
from flexdt.library.reconstruction.kept_images import (
    CountsOnce,
    ImagesInMemory,
    ImagesOnDisk,
    KeptImages,
)
from flexdt.library.reconstruction.memory_plan import (
    PART_IMAGES,
    MemoryPlan,
    plan_memory,
    plan_whole,
)
from flexdt.library.reconstruction.ring_correction import scan_rings
from flexdt.library.reconstruction.slab_fdk import StandingImages, Work, fdk_slabs
from flexdt.library.reconstruction.volume_files import (
    MiddleSlices,
    check_name,
    labelled,
    read_volume,
    volume_writer,
)
from flexdt.runtime.files.directory import free_memory_bytes, memory_bytes
from flexdt.runtime.files.whole_files import free_bytes
from flexdt.twin.algorithms import ALGORITHMS, DEFAULT, PLAIN, having, misfit
from flexdt.twin.caller_warnings import warn_caller
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import (
    GeometryError,
    LimitError,
    TwinError,
    UnknownNameError,
    require_within,
)
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.plausibility import Operation, examine, settled
from flexdt.twin.plausibility.volume_grid import voxel_findings
from flexdt.twin.projection import Volume, gpu
from flexdt.twin.projection.volume import Width
from flexdt.twin.reconstruction import (
    Grid,
    LostVoxels,
    Polychromatic,
    Truncation,
    bias_warnings,
    fdk_parts,
    field_of_view,
    hardening,
    truncation_of,
    with_errors,
)
from flexdt.twin.reconstruction.acquisition.coverage import ends_not_seen_mm
from flexdt.twin.reconstruction.acquisition.trajectory import circle_of, distinct_angles
from flexdt.twin.reconstruction.acquisition.truncation import SAMPLES as TRUNCATION_VIEWS
from flexdt.twin.reconstruction.bias import BiasOnDemand, copies_of
from flexdt.twin.reconstruction.coarse_scan import ScanCopies
from flexdt.twin.reconstruction.iterative_errors import (
    quietly,
    with_iteration_errors,
)
from flexdt.twin.reconstruction.known_beam import (
    CORRECTED_BEAM,
    STRAIGHT_BEAM,
    UNKNOWN_BEAM,
    Beam,
    KnownBeam,
)
from flexdt.twin.reconstruction.resolution import widths_of
from flexdt.twin.reconstruction.scatter_correction import scatterer_of, subtracted
from flexdt.twin.reconstruction.total_variation import WEIGHT

if TYPE_CHECKING:
    from flexdt.twin.physics.detector import Detector
    from flexdt.twin.physics.scatter import ScanScatter
    from flexdt.twin.physics.tube import Tube, TubeModel
    from flexdt.twin.reconstruction import Hardening

Progress = Callable[[float, float], None]
"""Called with the work done and the total, in the algorithm's own units."""

FREE_SHARE: Final = 0.5
"""Share of the free memory that FDK uses by default."""
PREVIEW_VIEWS: Final = 180
PREVIEW_VOXELS: Final = 160
SCATTER_VIEWS = 180
SCATTER_PIXELS = 100
"""Number of frames, and about their pixels a side, to find the scattering object."""


@dataclass(frozen=True)
class VolumeRequest:
    """The volume that a user requests.

    Attributes:
        algorithm: one of `flexdt.twin.algorithms.ALGORITHMS`.
        voxel_mm: edge of a voxel; None is the pixel's size at the rotation axis.
        shape: (z, y, x) about the rotation axis at the sample's height; None is the field of
            view.
        binning: pixels a side over which images are averaged first.
        every: use every n-th frame.
        iterations: of an iterative algorithm; None is its own default.
        window: of FDK's ramp filter; None is `PLAIN`.
        center_mm: (x, y, z) of the grid; None is the middle of the field of view, or the origin
            where `shape` is given.
        rings: subtract the offsets that pixels add to all views, where they exceed object
            and noise.
        material: the object is made of this alone: correct beam hardening with the data set's
            tube (the default one where it names none); several with `sirt` and `sart` (see
            `Polychromatic`); None for no correction.
        kV: of the scan, for `material` and `scatter_correction`; None is the voltage in the
            data set.
        png: write the three middle slices next to the volume.
        weight: of the total variation (`tv`); None is its own default.
        scatter_correction: materials of the object: find their scatter and subtract it; None
            for no correction.
        tube: of the scan, in place of the data set's and of `kV`.
    """

    algorithm: str = DEFAULT
    voxel_mm: float | None = None
    shape: tuple[int, int, int] | None = None
    binning: int = 1
    every: int = 1
    iterations: int | None = None
    window: str | None = None
    center_mm: tuple[float, float, float] | None = None
    rings: bool = False
    material: str | tuple[str, ...] | None = None
    kV: float | None = None
    png: bool = False
    weight: float | None = None
    scatter_correction: tuple[str, ...] | None = None
    tube: Tube | None = None

    @property
    def ramp_window(self) -> str:
        """Window of FDK's ramp filter; `PLAIN` by default."""
        return PLAIN if self.window is None else self.window


@dataclass(frozen=True, eq=False)
class ScanFrames:
    """The frames of a reconstruction: geometry, reading, corrections.

    Attributes:
        dataset: whose frames.
        indices: of the m frames that are used.
        cone_vec: their geometry after binning, m views.
        binning: pixels a side that are averaged.
        rings: (rows, cols) to subtract from the line integrals, or None.
        harden: straightens line integrals of one material, or None.
        mixture: beam hardening by several materials, for iterations; or None.
        scatter: of each of the m frames, to subtract, or None.
        doubts: about the images, the trajectory and the corrections.
        kept: store of images that are needed again; None reads them again.
        sides_known: their geometry is corrected by beads, which determine the direction of
            rotation and mirrored images.
        copies: take the corrected images as they are read, to find the errors of FDK.
        known: what is known about the energies of their line integrals.
    """

    dataset: ImageSet
    indices: tuple[int, ...]
    cone_vec: ConeVec
    binning: int
    rings: Float32Array | None = None
    harden: Hardening | None = None
    mixture: Polychromatic | None = None
    scatter: ScanScatter | None = None
    doubts: tuple[str, ...] = ()
    kept: KeptImages | None = None
    sides_known: bool = False
    copies: ScanCopies | None = None
    known: KnownBeam = UNKNOWN_BEAM

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) after binning."""
        rows, cols = self.dataset.shape
        return rows // self.binning, cols // self.binning

    def parts(self) -> Iterator[Float32Array]:
        """Yield line integrals of all frames in order, corrected as in `view`,
        `PART_IMAGES` at a time, (k, rows, cols); they are not kept for another pass.
        """
        count = len(self.indices)
        for first in range(0, count, PART_IMAGES):
            numbers = range(first, min(first + PART_IMAGES, count))
            yield np.stack([self.view(number, again=False) for number in numbers])

    @cached_property
    def truncation(self) -> Truncation | None:
        """Estimate of the object beyond the panel's edges, for FDK."""
        return truncation_of(self.view, self.cone_vec, self.shape)

    def view(self, number: int, *, again: bool = True) -> Float32Array:
        """Return one frame's line integrals, binned and corrected.

        Corrected are scatter, rings and beam hardening, in this order, where requested.

        Args:
            number: of the frame among those that are reconstructed.
            again: keep the image as measured, where images are kept.

        Returns:
            float32 (rows, cols).
        """
        if self.kept is None:
            image = self.measured(self.dataset, number)
        else:
            image = self.kept.image(number, again=again)
        if self.scatter is not None:
            image = subtracted(image, self.scatter.signal(number))
        if self.rings is not None:
            image = image - self.rings
        if self.harden is not None:
            image = self.harden(image)
        if self.copies is not None:
            self.copies.take(number, image)
        return image

    def measured(self, dataset: ImageSet, number: int) -> Float32Array:
        """Read one frame's line integrals, binned, from a data set of the same frames."""
        image = dataset.line_integrals(self.indices[number])
        return np.asarray(binned_mean(image, self.binning), np.float32)


def views_of(
    dataset: ImageSet,
    parameters: Offsets | None = None,
    *,
    binning: int = 1,
    every: int = 1,
) -> ScanFrames:
    """Select the frames that are there, and compute their geometry.

    Every `every`-th of the frames that are there is taken, the first included; binning is
    of the geometry here, and of the images as they are read.

    Args:
        dataset: from `load_dataset`.
        parameters: correction; None is the one in force during the scan, if any.
        binning, every: see `VolumeRequest`.

    Raises:
        LimitError: no frame would be left, `every` is no whole number from 1, or binning
            is no whole number from 1 to half of the shorter side.
    """
    rows, cols = dataset.shape
    most = max(1, min(rows, cols) // 2)
    require_within(f"binning of {cols} x {rows} pixels", binning, 1, most)
    if not isinstance(every, int | np.integer) or every < 1:
        raise LimitError.instead(f"every {every} frames", every, "a whole number from 1")
    indices = dataset.present[::every]
    if not indices:
        raise LimitError(
            f"{dataset.where}: no projections to reconstruct from", {"asked": every}
        )
    cone_vec = dataset.corrected(parameters)[np.array(indices)]
    if binning > 1:
        cone_vec = cone_vec.binned(binning, dataset.shape)
    in_force = dataset.correction
    sides_known = (
        in_force is not None
        and in_force.sides_known
        and parameters in (None, in_force.parameters)
    )
    return ScanFrames(dataset, indices, cone_vec, binning, sides_known=sides_known)


def grid_of(views: ScanFrames, request: VolumeRequest) -> Grid:
    """Choose the grid of a requested volume; missing values are those of the field
    of view, of a helix without the ends that FDK cannot fill.

    A requested shape without a center is centered at the origin.

    Args:
        views: to reconstruct.
        request: voxel size, shape and center, each may be None.

    Raises:
        GeometryError: voxels that are implausibly large for the field of view.
    """
    whole = field_of_view(views.cone_vec, views.shape, request.voxel_mm)
    if request.voxel_mm is not None and request.shape is None:
        across = field_of_view(views.cone_vec, views.shape)
        seen_mm = across.voxel_mm * across.shape[2]
        settled(voxel_findings(request.voxel_mm, seen_mm), GeometryError)
    shape = whole.shape
    center = whole.center_mm
    if ALGORITHMS[request.algorithm].direct:
        left_out = math.floor(ends_not_seen_mm(views.cone_vec) / whole.voxel_mm)
        shape = max(1, shape[0] - 2 * left_out), *shape[1:]
    if request.shape is not None:
        shape = request.shape
        center = (0.0, 0.0, 0.0)
    if request.center_mm is None:
        chosen = center
    else:
        chosen = request.center_mm
    return Grid(shape, whole.voxel_mm, chosen)


@dataclass(frozen=True, eq=False)
class ReconstructionTask:
    """A reconstruction that can be made.

    Attributes:
        request: the volume.
        views: its frames, not yet corrected.
        grid: of the volume.
        counts: of the data set, as far as they have been looked at.
    """

    request: VolumeRequest
    views: ScanFrames
    grid: Grid
    counts: CountsOnce

    @property
    def direct(self) -> bool:
        """Whether it uses each image once, as FDK does."""
        return ALGORITHMS[self.request.algorithm].direct

    @cached_property
    def standing(self) -> StandingImages:
        """Images as upright panels record them, for FDK, without truncation."""
        return StandingImages.of(self.views.cone_vec, self.views.shape, None)

    @cached_property
    def again(self) -> int:
        """Images that are needed more than once even of a single slab, at most all.

        All, with ring correction or detector lag; else those that the scatter correction
        and, for a direct method, the estimate of truncation reads once more.
        """
        count = len(self.views.indices)
        panel = self.views.dataset.panel
        if self.request.rings or (panel is not None and panel.lag):
            return count
        if self.request.scatter_correction is None:
            some = 0
        else:
            some = SCATTER_VIEWS + 1
        if self.direct:
            angles = len(distinct_angles(circle_of(self.views.cone_vec))[0])
            some += TRUNCATION_VIEWS * -(-count // angles)
        return min(some, count)

    def plan(self, memory: int | None, *, slabs: bool = True) -> MemoryPlan:
        """Decide on the use of memory and disk.

        Iterative methods make the volume as a whole. With a CUDA device, which may fail,
        all images may be read again and are kept as prepared. Without a stated memory at
        least a layer at a time is planned.

        Args:
            memory: to use; None for half of the free memory [bytes].
            slabs: whether the volume may be made in slabs.

        Raises:
            LimitError: too little memory.
        """
        if memory is None:
            given = FREE_SHARE * free_memory_bytes()
        else:
            given = memory
        images = len(self.views.indices)
        pixels = math.prod(self.views.shape)
        again = self.again
        if not self.direct:
            return plan_whole(self.grid, again, pixels, int(given))
        pixels = max(pixels, math.prod(self.standing.shape))
        if (
            gpu.availability().present
        ):  # which may fail, or lack room, and take images anew
            again = images
        if not slabs:
            plan = plan_whole(self.grid, again, pixels, int(given))
        else:
            plan = plan_memory(
                self.grid, images, again, pixels, int(given), least=memory is None
            )
        return replace(plan, prepared=plan.prepared or gpu.availability().present)


def reconstruct_dataset(
    dataset: ImageSet,
    out: str | os.PathLike[str],
    request: VolumeRequest | None = None,
    *,
    parameters: Offsets | None = None,
    progress: Progress | None = None,
    workers: AbstractContextManager[Executor] | None = None,
    memory: int | None = None,
) -> dict[str, Any]:
    """Reconstruct a data set into a file, which appears under its name only when
    complete.

    Each image is read once, except when workers make the slabs. Those that are needed
    again are kept in memory, or in a file without a name in the folder of `out`.

    Args:
        dataset: from `load_dataset`.
        out: the file: .tif, .nrrd, .mha, .nii.gz, .h5 or .zarr.
        request: the volume; None is FDK of the entire field of view.
        parameters: correction; None is the one in force during the scan, if any.
        progress: called with the work done and the total.
        workers: make the slabs of FDK; they see the data set and `out` under the same
            paths. An interrupted reconstruction is taken up.
        memory: that FDK may use; None for half of the free memory [bytes].

    Returns:
        JSON-able: file, slices, algorithm, shape (z, y, x), voxel_mm, center_mm, frames,
        missing, correction (edge units), accuracy (see `Volume.accuracy`; None except for
        FDK), warnings, seconds.

    Raises:
        UnknownNameError: unknown algorithm, window or material.
        TwinError: a correction of beam hardening, or of scatter, for images that the twin
            made without it.
        LimitError: another ending, one of the data set's own files, a volume too large
            for this machine, too little memory or room on disk, or a correction without
            a stated tube voltage.
        GeometryError: a trajectory that the algorithm cannot use.
        DatasetError: a frame or the flat field cannot be read.
        OSError: the file cannot be written.
    """
    out = Path(out)
    check_name(out)
    images = {f.file for f in dataset.frames} | {
        p.name for p in (*dataset.darks, *dataset.flats)
    }
    if dataset.folder is None:
        home = None
    else:
        home = dataset.folder.resolve()
    if out.parent.resolve() == home and out.name in images:
        raise LimitError(f"{out} is an image of the data set itself", {"asked": str(out)})
    begun = time.perf_counter()
    task = _task(dataset, request, parameters)
    tell = progress or _untold
    _require_room(out, task.grid)
    slices = MiddleSlices(task.grid.shape)
    if workers is None:
        views, bias, width, doubts = _reconstruct_in_process(
            task, task.plan(memory), out, slices, tell
        )
    else:
        with workers as pool:
            views = _apply_corrections(task.views, task.request)
            by_workers = extension("slabs", "a reconstruction by workers")
            doubts = by_workers(views, task.grid, task.request, out, pool, tell)
        bias, width = _bias_read_again(views), None
        if task.request.png:
            slices.take(read_volume(out).data)
    accuracy = None
    if task.direct:
        if bias is None:
            accuracy = None
        else:
            accuracy = bias.accuracy(task.grid, width)
        doubts = [*bias_warnings(bias, task.grid), *doubts]
    if task.request.png:
        pictures = slices.write(out)
    else:
        pictures = []
    in_force = dataset.correction
    if parameters is not None:
        used = parameters
    elif in_force:
        used = in_force.parameters
    else:
        used = None
    return {
        "file": str(out),
        "slices": [str(file) for file in pictures],
        "algorithm": task.request.algorithm,
        "shape": list(task.grid.shape),
        "voxel_mm": task.grid.voxel_mm,
        "center_mm": list(task.grid.center_mm),
        "frames": len(views.indices),
        "missing": len(dataset.missing),
        "correction": None if used is None else used.to_edge(),
        "accuracy": None if accuracy is None else asdict(accuracy),
        "warnings": [*views.doubts, *doubts],
        "seconds": round(time.perf_counter() - begun, 3),
    }


def about_volume(views: ScanFrames, request: VolumeRequest) -> dict[str, str]:
    """Say what a volume shows and how it was made, for the file: word -> one line.

    Args:
        views: the frames.
        request: the volume.
    """
    data, used = views.dataset, views.dataset.settings
    steps = [request.algorithm]
    if request.algorithm == DEFAULT:
        steps.append(f"window {request.ramp_window}")
    if request.rings:
        steps.append("rings subtracted")
    for what, of in (
        ("beam hardening", request.material),
        ("scatter", request.scatter_correction),
    ):
        if of is not None:
            names = (of,) if isinstance(of, str) else of
            steps.append(f"corrected for {what} of {', '.join(names)}")
    words = {
        "sample": None if used is None else used.sample_name,
        "owner": None if used is None else used.sample_owner,
        "comment": None if used is None else used.comment,
        "kV": None if used is None or used.kV is None else f"{used.kV:g}",
        "data_set": data.name,
        "frames": f"{len(views.indices)}",
        "algorithm": ", ".join(steps),
        "software": f"flexdt {version('flexdt')}",
        "values": "attenuation [1/mm]",
    }
    return {word: line for word, line in words.items() if line}


def _untold(done: float, total: float) -> None:
    """Ignore progress."""


def _copied(views: ScanFrames) -> ScanFrames:
    """Return the views with copies that take their images as they are read."""
    copies = copies_of(views.cone_vec, views.shape, views.truncation)
    return replace(views, copies=copies)


def _bias(views: ScanFrames) -> BiasOnDemand | None:
    """Find what copies of all views tell of FDK's errors; None where no copy can be made."""
    return BiasOnDemand.of(views.copies, sides_known=views.sides_known, known=views.known)


def _bias_read_again(views: ScanFrames) -> BiasOnDemand | None:
    """Find the same where other processes have read the images: some are read again."""
    views = _copied(views)
    for number in () if views.copies is None else views.copies.wanted:
        views.view(number, again=False)
    return _bias(views)


def _reconstruct_in_process(
    task: ReconstructionTask,
    plan: MemoryPlan,
    out: Path,
    slices: MiddleSlices,
    tell: Progress,
) -> tuple[ScanFrames, BiasOnDemand | None, Width | None, list[str]]:
    """Reconstruct into a file in this process.

    The disk must have room for kept images, else LimitError before any work. Doubts are
    FDK's voxels that are not seen; other algorithms have none.

    Args:
        task: the reconstruction.
        plan: of memory and disk.
        out: the file.
        slices: take the middle slices.
        tell: called with the work done and the total.

    Returns:
        The views, the bias of FDK and the width of edges across the axis in its middle slab
        (None of other algorithms), and doubts.
    """
    folder = out.absolute().parent
    grid = task.grid
    _require_room_for_images(folder, plan, grid.bytes)
    with (
        _reading_once(task, plan, folder, tell) as (kept_images, work),
        volume_writer(out, grid, about_volume(task.views, task.request)) as write,
    ):
        views = _apply_corrections(replace(task.views, kept=kept_images), task.request)
        if not task.direct:
            volume = _iterative(views, grid, task.request, tell)
            write(volume.data)
            slices.take(volume.data)
            return views, None, None, []
        views = _copied(views)
        lost = LostVoxels()
        width = None
        for slab in _fdk_slabs(task, views, kept_images, plan, work):
            write(slab.data)
            if slices.take(slab.data):
                width, _ = widths_of(slab)
            lost += LostVoxels.of(slab.data)
            del slab  # before there is another
        bias = _bias(views)
    return views, bias, width, lost.warnings()


def _fdk_slabs(
    task: ReconstructionTask,
    views: ScanFrames,
    kept_images: KeptImages,
    plan: MemoryPlan,
    work: Work,
    *,
    errors: bool = False,
) -> Iterator[Volume]:
    """Reconstruct by FDK, slab after slab.

    Where the plan keeps no prepared images, images enter as they are read, and one volume
    of the whole grid is yielded; this is computed at the call.

    Args:
        task: the reconstruction.
        views: corrected frames.
        kept_images: keeps prepared images.
        plan: of slabs and memory.
        work: gets the progress.
        errors: estimate `sigma`.
    """
    window = task.request.ramp_window
    if plan.prepared:
        images = replace(task.standing, truncation=views.truncation)
        view = partial(views.view, again=False)
        return fdk_slabs(
            view,
            kept_images,
            images,
            task.grid,
            plan.slabs,
            window,
            work.slab,
            errors=errors,
        )
    whole = fdk_parts(
        views.parts,
        views.cone_vec,
        views.shape,
        task.grid,
        window,
        partial(work.slab, 0),
        views.truncation,
        errors=errors,
    )
    return iter([whole])


@contextmanager
def _reading_once(
    task: ReconstructionTask, plan: MemoryPlan, folder: Path, tell: Progress
) -> Iterator[tuple[KeptImages, Work]]:
    """Read each image once from here on, and report the work done.

    Yields the kept images, on disk or in memory as planned, deleted at the end, and the
    progress, of FDK only. `folder`: of the file; `tell`: gets the work done and the
    total, in images.
    """
    views = task.views
    fdk = task.direct
    dataset = task.counts.read_by(views.dataset)
    if fdk:
        work = Work.of(task.standing, task.grid, plan.slabs, tell)
    else:
        work = Work(1, 1.0, (), _untold)
    store = ImagesOnDisk(folder, plan.most_pixels) if plan.on_disk else ImagesInMemory()
    with KeptImages(partial(views.measured, dataset), store, work.read) as kept_images:
        yield kept_images, work


def reconstruct_volume(
    dataset: ImageSet,
    request: VolumeRequest | None = None,
    *,
    parameters: Offsets | None = None,
    progress: Progress | None = None,
    errors: bool = False,
) -> Volume:
    """Reconstruct a data set in memory.

    Doubts about the frames, the errors and lost voxels are warnings. A volume by FDK of
    more than a third of the machine's memory is in a file without a name in the folder
    for temporary files (TMPDIR), and has no `sigma`; iterations never use a file.

    Args:
        dataset, request, parameters, progress: as for `reconstruct_dataset`.
        errors: compare the volume with its images: `bias_bound`, `accuracy`, `residuals`,
            and `sigma`, of iterations by reading the images and iterating twice more.

    Returns:
        The volume, attenuation [1/mm]; its files say what those of `reconstruct_dataset` do.

    Raises:
        TwinError: as `reconstruct_dataset`.
    """
    tell = progress or _untold
    folder = Path(gettempdir())
    task = _task(dataset, request, parameters)
    grid = task.grid
    fdk = task.direct
    in_memory = not fdk or 3 * grid.bytes <= memory_bytes()
    if in_memory:
        _require("of memory", 3 * grid.bytes, memory_bytes(), grid)
    else:
        _require(f"free in {folder}", grid.bytes, free_bytes(folder), grid)
        _require_layer(grid)
    plan = task.plan(None, slabs=not in_memory)
    _require_room_for_images(folder, plan, 0 if in_memory else grid.bytes)
    with _reading_once(task, plan, folder, tell) as (kept_images, work):
        views = _apply_corrections(replace(task.views, kept=kept_images), task.request)
        for doubt in views.doubts:
            warn_caller(doubt)
        if not fdk:
            if errors:
                copies = copies_of(views.cone_vec, views.shape)
                views = replace(views, copies=copies)
            made = _iterative(views, grid, task.request, tell)
            return labelled(made, about_volume(views, task.request))
        if errors:
            views = _copied(views)
        slabs = _fdk_slabs(
            task, views, kept_images, plan, work, errors=errors and in_memory
        )
        if in_memory:
            volume = next(slabs)
        else:
            volume = _in_a_file(slabs, grid, folder)
    doubts = LostVoxels.of(volume.data).warnings()
    if errors:
        bias = _bias(views)
        volume = with_errors(volume, bias=bias)
        doubts = [*bias_warnings(bias, volume), *doubts]
    for doubt in doubts:
        warn_caller(doubt)
    return labelled(volume, about_volume(views, task.request))


def _in_a_file(slabs: Iterator[Volume], grid: Grid, folder: Path) -> Volume:
    """Collect slabs in a volume whose values are in a file without a name, which is
    deleted when the values are.

    Args:
        slabs: from the lowest up.
        grid: of the volume.
        folder: of the file.
    """
    with TemporaryFile(dir=folder) as file:
        data = np.memmap(file, np.float32, "w+", shape=grid.shape)
    done = 0
    for slab in slabs:
        data[done : done + len(slab.data)] = slab.data
        done += len(slab.data)
        del slab  # before there is another
    return replace(grid.blank(), data=data)


def _task(
    dataset: ImageSet, request: VolumeRequest | None, parameters: Offsets | None
) -> ReconstructionTask:
    """Check a request, and make its task: views without bad pixels, not yet corrected,
    and grid.

    Bad pixels are marked to be interpolated; doubts about geometry, pixels and images are
    kept in the views.

    Args:
        dataset: its images are read for bad pixels and doubts.
        request: the defaults without.
        parameters: offsets instead of the correction's.

    Raises:
        TwinError: an unknown algorithm, several materials with an algorithm that takes
            one, a binning or selection that leaves nothing, an implausible geometry, or
            images without line integrals.
    """
    if request is None:
        wanted = VolumeRequest()
    else:
        wanted = request
    name = wanted.algorithm
    require_effect(wanted)
    several = _names(wanted.material)
    if len(several) > 1 and "materials" not in ALGORITHMS[name].options:
        message = f"materials {', '.join(several)} with {name}"
        follow = " or ".join(having("materials"))
        allowed = f"one, or several with {follow}, which follow each through the volume"
        raise LimitError.instead(message, [name, *several], allowed)
    views = views_of(dataset, parameters, binning=wanted.binning, every=wanted.every)
    counts = CountsOnce(dataset.counts)
    grid = grid_of(views, wanted)
    if ALGORITHMS[name].direct:
        operation = Operation.FDK
    else:
        operation = Operation.ITERATE
    half = 0.5 * grid.voxel_mm * np.array(grid.shape[::-1])
    box = np.array([grid.center_mm - half, grid.center_mm + half])
    findings = examine(operation, views.cone_vec, views.shape, grid=box)
    doubts = settled(findings, GeometryError)
    mended, bad = without_bad_pixels(
        dataset, dataset.corrected(parameters), counts.looked_at
    )
    doubts += [*bad, *image_doubts(mended, needed=True, counts=counts.looked_at)]
    views = replace(views, dataset=mended, doubts=tuple(doubts))
    return ReconstructionTask(wanted, views, grid, counts)


def require_effect(request: VolumeRequest, errors: bool | None = None) -> None:
    """Check that every option of a request has an effect (`twin.algorithms.OPTIONS`).

    Args:
        request: of a volume.
        errors: whether the noise and the bound of the bias are asked for; None where
            nothing was said.

    Raises:
        UnknownNameError: there is no such algorithm.
        LimitError: an option has no effect; says with what it has one.
    """
    name = request.algorithm
    if name not in ALGORITHMS:
        raise UnknownNameError.among(
            f"unknown algorithm {name!r}; allowed", name, ALGORITHMS
        )
    stated = {
        "iterations": request.iterations,
        "weight": request.weight,
        "window": request.window,
        "errors": errors or None,
        "material": request.material,
        "scatter_correction": request.scatter_correction,
        "tube": request.tube,
        "kv": request.kV,
    }
    given = {name for name, value in stated.items() if value is not None}
    found = misfit(name, given)
    if found is not None:
        option, sentence = found
        raise LimitError(sentence, {"asked": option, "algorithm": name})


def preview(
    dataset: ImageSet,
    out: Path,
    *,
    parameters: Offsets | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Reconstruct a quick look at a scan: few views, coarse pixels and voxels, FDK, PNG
    slices.

    `out` is the volume's file. About PREVIEW_VOXELS voxels along the longest side, and
    from PREVIEW_VIEWS to twice as many views (all, if there are fewer), with a Hann
    window.

    Args:
        dataset, out, parameters, progress: as for `reconstruct_dataset`.

    Returns:
        As `reconstruct_dataset`.
    """
    whole = field_of_view(dataset.corrected(parameters), dataset.shape)
    coarser = max(1.0, max(whole.shape) / PREVIEW_VOXELS)
    request = VolumeRequest(
        voxel_mm=round(whole.voxel_mm * coarser, 6),
        binning=math.floor(coarser),
        every=max(1, len(dataset.present) // PREVIEW_VIEWS),
        window="hann",
        png=True,
    )
    return reconstruct_dataset(
        dataset, out, request, parameters=parameters, progress=progress
    )


def _apply_corrections(views: ScanFrames, request: VolumeRequest) -> ScanFrames:
    """Prepare the requested corrections, in this order: scatter, rings (estimated after
    scatter), and beam hardening.

    Several materials are corrected within an iterative algorithm; a single energy has no
    beam hardening.

    Args:
        views: uncorrected frames; kept images are read once, in order, where the detector
            lags.
        request: the volume.

    Returns:
        The frames with their corrections, applied as they are read.
    """
    panel = views.dataset.panel
    if views.kept is not None and panel is not None and panel.lag:
        # Each image takes the one before, too: read in order, all are read once.
        for number in range(len(views.indices)):
            views.view(number)
    if request.scatter_correction is not None:
        views = _without_scatter(views, request.scatter_correction, request)
    if request.rings:
        views = replace(views, rings=scan_rings(views.view, views.cone_vec, views.shape))
    views = replace(views, known=_known_beam(views.dataset, request))
    if request.material is not None:
        from flexdt.twin.attenuation.materials import material, stated_keV

        made_of = [material(name) for name in _names(request.material)]
        source = _source(views.dataset, request)
        kV, tube, mono_keV = source.kV, source.tube, source.mono_keV
        substances = [one.substance for one in made_of]
        if mono_keV is None and len(made_of) == 1:
            harden = hardening(
                substances[0], kV, made_of[0].effective_energy_keV, source.panel, tube
            )
            views = replace(views, harden=harden)
        elif mono_keV is None:
            mixture = Polychromatic.of(substances, kV, stated_keV(), source.panel, tube)
            views = replace(views, mixture=mixture)
    return views


def _names(given: str | tuple[str, ...] | None) -> tuple[str, ...]:
    if isinstance(given, str):
        return (given,)
    return given or ()


def _without_scatter(
    views: ScanFrames, names: tuple[str, ...], request: VolumeRequest
) -> ScanFrames:
    """Simulate the scatter of an object of these materials in some views, and prepare its
    subtraction from all.

    A quick volume of about `SCATTER_VIEWS` views, binned to about `SCATTER_PIXELS`, gives
    the object. Images that state no model of noise are taken as a scanner's.

    Args:
        views: the frames.
        names: of the materials.
        request: gives the tube.

    Returns:
        The frames, with the scatter to subtract and its doubts added.

    Raises:
        TwinError: the twin made the images without scatter, or with one energy.
        LimitError: neither request nor data set states the tube's voltage.
    """
    from flexdt.phantoms import material
    from flexdt.twin.physics.chain import Chain
    from flexdt.twin.physics.detector import Detector
    from flexdt.twin.physics.scatter import Beam, scan_scatter

    figures = {} if views.dataset.document is None else views.dataset.document.noise.model
    if figures and not any(name.startswith("scatter_") for name in figures):
        raise TwinError(
            f"{views.dataset.where} was made without scatter: there is none to subtract",
            {
                "asked": "scatter correction",
                "allowed": "a scanner's data, or scatter simulated",
            },
        )
    substances = tuple(material(name).substance for name in names)
    source = _source(views.dataset, request)
    kV = source.kV
    chain = Chain(Detector(), source.tube, substances, mono_keV=source.mono_keV)
    factor = max(1, min(max(views.shape) // SCATTER_PIXELS, min(views.shape) // 2))
    each = max(1, len(views.indices) // SCATTER_VIEWS)
    geometry = views.cone_vec[::each].binned(factor, views.shape)
    chosen = range(0, len(views.indices), each)
    stack = np.stack([binned_mean(views.view(number), factor) for number in chosen])
    scatterer = scatterer_of(stack, geometry, chain, kV)
    beam = Beam.of(chain, kV)
    scatter = scan_scatter(scatterer.thing, views.cone_vec.rows, views.shape, beam)
    return replace(views, scatter=scatter, doubts=(*views.doubts, *scatterer.doubts))


@dataclass(frozen=True)
class _Source:
    """Of the X-rays: voltage, tube, panel (None: the default one) and single energy."""

    kV: float
    tube: TubeModel
    panel: Detector | None = None
    mono_keV: float | None = None


def _source(dataset: ImageSet, request: VolumeRequest) -> _Source:
    """Return the source as requested, as the data set names it, or as it was simulated.

    The request's tube is taken first, then its voltage, then the data set's. A single
    energy comes from the request's tube or the simulation's; filters and focal spot otherwise
    from the data set's figures, if it has any.

    Raises:
        LimitError: none states the voltage.
        TwinError: the data set's images have no beam hardening.
    """
    from flexdt.twin.physics.tube import TubeModel

    if request.tube is not None:
        return _Source(request.tube.kV, request.tube.model(), None, request.tube.mono_keV)
    if dataset.settings is None:
        stated_kV = None
    else:
        stated_kV = dataset.settings.kV
    chain = getattr(dataset.truth, "chain", None)
    if stated_kV is None and chain is not None:
        kV = dataset.truth.exposure.kV if request.kV is None else request.kV
        return _Source(kV, chain.tube, chain.panel, chain.mono_keV)
    kV = stated_kV if request.kV is None else request.kV
    if kV is None:
        raise LimitError(
            f"{dataset.where} does not say its tube voltage, "
            "which corrections of beam hardening and scatter need; give the tube, as "
            "tube=fx.Tube(kV=...), or its voltage with --kv",
            {"missing": "kV"},
        )
    figures = {} if dataset.document is None else dataset.document.noise.model
    made = next((p for p in ("poly", "mono") if f"physics_{p}" in figures), "ideal")
    if figures and made != "poly":
        raise TwinError(
            f"{dataset.where} was made with physics {made}, one energy: its line integrals are "
            "straight, and a correction of beam hardening would bend them; leave out the material",
            {"asked": "material", "allowed": "physics poly, or a scanner's data"},
        )
    return _Source(kV, TubeModel.of_figures(figures))


def _known_beam(dataset: ImageSet, request: VolumeRequest) -> KnownBeam:
    """Say what is known of the energies of the line integrals, as they are corrected."""
    try:
        source = _source(dataset, request)
    except LimitError:
        return UNKNOWN_BEAM
    except TwinError:  # of one energy
        return STRAIGHT_BEAM
    if source.mono_keV is not None:
        return STRAIGHT_BEAM
    if request.material is not None:
        return CORRECTED_BEAM
    return KnownBeam(Beam(source.kV, source.tube, source.panel))


def _require_room(out: Path, grid: Grid) -> None:
    """Check, before any work, that the volume fits the disk and a layer of it the memory.

    Raises LimitError: names the needed and the free space."""
    folder = out.absolute().parent
    _require(f"free in {folder}", grid.bytes, free_bytes(folder), grid)
    _require_layer(grid)


def _require_layer(grid: Grid) -> None:
    layer = 3 * grid.bytes // grid.shape[0]
    _require("of memory for a layer and its filling", layer, memory_bytes(), grid)


def _require_room_for_images(folder: Path, plan: MemoryPlan, volume_bytes: int) -> None:
    """Check, before any work, that the kept images and the volume fit the disk together;
    nothing is checked where images are kept in memory.

    Args:
        folder: of the images.
        plan: of memory and disk.
        volume_bytes: of the volume in the same folder.

    Raises:
        LimitError: names the needed and the free space.
    """
    if not plan.on_disk:
        return
    need = plan.disk_bytes + volume_bytes
    free = free_bytes(folder)
    if need > free:
        raise LimitError(
            f"{plan.kept} images that are needed again take {plan.disk_bytes / 2**30:.3g} GiB "
            f"beside the volume's {volume_bytes / 2**30:.3g} GiB; there are "
            f"{free / 2**30:.3g} GiB "
            f"free in {folder}: choose another folder, binning, fewer frames, or more memory",
            {"asked": need, "allowed": free},
        )


def _require(where: str, need: int, free: int, grid: Grid) -> None:
    """Check that a volume fits the memory or the disk.

    `where`: words for the message; `need`: bytes; `free`: bytes; `grid`: of the volume, for the
    message.
    Raises LimitError: it does not.
    """
    if need > free:
        nz, ny, nx = grid.shape
        raise LimitError(
            f"{nz} x {ny} x {nx} voxels of {grid.voxel_mm:g} mm (z, y, x) need "
            f"{need / 2**30:.3g} GiB; there are {free / 2**30:.3g} GiB {where}: choose larger "
            "voxels or a smaller shape (for iterations also binning, or fewer frames)",
            {"asked": need, "allowed": free},
        )


def _iterative(
    views: ScanFrames, grid: Grid, request: VolumeRequest, tell: Progress
) -> Volume:
    """Reconstruct by an iterative algorithm, after checking that the memory suffices.

    Options that are None are the algorithm's own. Plausibility warnings are not shown, as
    they are among the views' doubts.

    Args:
        views: to reconstruct.
        grid: of the volume.
        request: algorithm and its options.
        tell: called with the iterations done, and all.

    Raises:
        LimitError: the algorithm's stacks and grids need more than 80 % of the memory.
    """
    algorithm = ALGORITHMS[request.algorithm]
    stacks = algorithm.stacks
    grids = algorithm.grids
    if views.mixture is not None:
        stacks = stacks + 2 * len(views.mixture.mu)
        grids = grids + 3
    need = stacks * 4 * len(views.indices) * math.prod(views.shape) + grids * grid.bytes
    _require(f"of memory for {request.algorithm}", need, int(0.8 * memory_bytes()), grid)
    options = {"iterations": request.iterations, "weight": request.weight}
    given = {name: value for name, value in options.items() if value is not None}
    if "weight" in algorithm.options:
        given.setdefault("weight", WEIGHT)
    mixture = {} if views.mixture is None else {"hardening": views.mixture}
    run = algorithm.load()
    stack = _stack_integrals(views)

    def watch(step: Any) -> None:
        """Report the iterations done."""
        tell(step.iteration, step.of)

    more = {**given, **mixture}
    made = quietly(run, stack, views.cone_vec, grid.blank(), watch=watch, **more)
    copies = views.copies
    if copies is None:
        return made
    return with_iteration_errors(
        made,
        stack,
        partial(_stack_integrals, replace(views, kept=None, copies=None)),
        views.cone_vec,
        run,
        more,
        copies,
        sides_known=views.sides_known,
        known=views.known,
    )


def _stack_integrals(views: ScanFrames) -> Float32Array:
    """Stack line integrals of all frames, (n, rows, cols), each read once."""
    stack = np.empty((len(views.indices), *views.shape), np.float32)
    for number, image in enumerate(stack):
        image[:] = views.view(number, again=False)
    return stack
