"""`flexdt reconstruct` without its command line: a data set in, a volume file out.

FDK goes slab by slab and reads frames in parts, so memory stays bounded whatever the volume's size;
the iterative algorithms hold everything and are for small or binned problems. Missing frames are
left out, and the outcome states how many.
"""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from flexdt.library.datasets.image_doubts import image_doubts
from flexdt.library.datasets.image_set import ImageSet
from flexdt.library.extras import extension
from flexdt.library.reconstruction.volume_files import (
    check_name,
    read_volume,
    volume_writer,
    write_slices,
)
from flexdt.runtime.files.directory import memory_bytes
from flexdt.runtime.files.whole_files import free_bytes
from flexdt.twin.algorithms import ALGORITHMS, DEFAULT, PLAIN, having
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import LimitError, TwinError, UnknownNameError, require_within
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.projection import Volume
from flexdt.twin.reconstruction import (
    Grid,
    Polychromatic,
    Truncation,
    bias_of,
    bias_warnings,
    checked_fdk,
    fdk_parts,
    field_of_view,
    hardening,
    layer_warnings,
    lost_layers,
    ring_errors,
    truncation_of,
)
from flexdt.twin.reconstruction.scatter_correction import scatterer_of, subtracted

if TYPE_CHECKING:
    from flexdt.twin.physics.scatter import ScanScatter
    from flexdt.twin.physics.tube import Tube, TubeModel
    from flexdt.twin.reconstruction import Hardening

Progress = Callable[[float, float], None]
"""Called with the work done and the whole, in the algorithm's own units."""

SLAB_BYTES: Final = 512 << 20
PART: Final = 16
"""Frames read at a time."""
PREVIEW_VIEWS: Final = 180
PREVIEW_VOXELS: Final = 160
SCATTER_VIEWS, SCATTER_PIXELS = 180, 100
"""Frames, and about their pixels a side, from which it is found what scatters."""


@dataclass(frozen=True)
class VolumeRequest:
    """The volume that a user requests.

    Attributes:
        algorithm: one of `flexdt.twin.algorithms.ALGORITHMS`.
        voxel_mm: edge of a voxel; None is the pixel's size at the rotation axis.
        shape: (z, y, x) about the rotation axis at the sample's height; None is the field of view.
        binning: pixels a side over which images are averaged first.
        every: use every n-th frame.
        iterations: of an iterative algorithm; None is its own default.
        window: of FDK's ramp filter.
        center_mm: (x, y, z) of the grid; None is the middle of the field of view, or the origin
            where `shape` is given.
        rings: correct for rings (full turns).
        material: the object is made of this alone: correct beam hardening with the data set's
            tube (the default one where it names none); several with `sirt` and `sart` (see
            `Polychromatic`); None for no correction.
        kV: of the scan, for `material` and `scatter_correction`; None is the voltage in the data
            set.
        png: write the three middle slices beside the volume.
        weight: of the total variation (`tv`); None is its own default.
        scatter_correction: materials of the object: find their scatter and subtract it; None
            for no correction.
        tube: of the scan, in place of what the data set says and of `kV`.
    """

    algorithm: str = DEFAULT
    voxel_mm: float | None = None
    shape: tuple[int, int, int] | None = None
    binning: int = 1
    every: int = 1
    iterations: int | None = None
    window: str = PLAIN
    center_mm: tuple[float, float, float] | None = None
    rings: bool = False
    material: str | tuple[str, ...] | None = None
    kV: float | None = None
    png: bool = False
    weight: float | None = None
    scatter_correction: tuple[str, ...] | None = None
    tube: Tube | None = None


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
        mixture: what the spectrum does behind several, for iterations; or None.
        scatter: of each of the m frames, to subtract, or None.
        doubts: what is doubtful about the images, the trajectory and the corrections.
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

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) after binning."""
        rows, cols = self.dataset.shape
        return rows // self.binning, cols // self.binning

    def parts(self) -> Iterator[Float32Array]:
        """Line integrals of all frames, `PART` at a time, (k, rows, cols)."""
        for first in range(0, len(self.indices), PART):
            chosen = self.indices[first : first + PART]
            yield np.stack([self.image(i) for i in chosen])

    @cached_property
    def truncation(self) -> Truncation | None:
        """What of the object lies beyond the panel's edges, for FDK."""
        return truncation_of(self.view, self.cone_vec, self.shape)

    def view(self, number: int) -> Float32Array:
        """As `image`, by the number among those that are reconstructed."""
        return self.image(self.indices[number])

    def image(self, index: int) -> Float32Array:
        """One frame's line integrals, binned and corrected."""
        image = binned_mean(self.dataset.line_integrals(index), self.binning)
        if self.scatter is not None:
            image = subtracted(image, self.scatter.signal(self.indices.index(index)))
        if self.rings is not None:
            image = image - self.rings
        return image if self.harden is None else self.harden(image)


def views_of(
    dataset: ImageSet, parameters: Offsets | None = None, *, binning: int = 1, every: int = 1
) -> ScanFrames:
    """The frames that are there, and their geometry.

    Args:
        dataset: from `load_dataset`.
        parameters: correction; None is the one in force during the scan, if any.
        binning, every: see `VolumeRequest`.

    Raises:
        LimitError: nothing would be left.
    """
    rows, cols = dataset.shape
    most = max(1, min(rows, cols) // 2)
    require_within(f"binning of {cols} x {rows} pixels", binning, 1, most)
    if not isinstance(every, int | np.integer) or every < 1:
        raise LimitError.instead(f"every {every} frames", every, "a whole number from 1")
    indices = dataset.present[::every]
    if not indices:
        raise LimitError(f"{dataset.where}: no projections to reconstruct from", {"asked": every})
    cone_vec = dataset.corrected(parameters)[np.array(indices)]
    if binning > 1:
        cone_vec = cone_vec.binned(binning, dataset.shape)
    return ScanFrames(dataset, indices, cone_vec, binning)


def grid_of(views: ScanFrames, request: VolumeRequest) -> Grid:
    """The grid of a requested volume."""
    whole = field_of_view(views.cone_vec, views.shape, request.voxel_mm)
    shape, center = whole.shape, whole.center_mm
    if request.shape is not None:
        shape, center = request.shape, (0.0, 0.0, 0.0)
    chosen = center if request.center_mm is None else request.center_mm
    return Grid(shape, whole.voxel_mm, chosen)


def reconstruct_dataset(
    dataset: ImageSet,
    out: str | os.PathLike[str],
    request: VolumeRequest | None = None,
    *,
    parameters: Offsets | None = None,
    progress: Progress | None = None,
    workers: AbstractContextManager[Executor] | None = None,
) -> dict[str, Any]:
    """Reconstruct a data set into a file, which appears under its name only when whole.

    Args:
        dataset: from `load_dataset`.
        out: the file: .tif, .nrrd, .mha, .nii.gz, .h5 or .zarr.
        request: the volume; None is FDK of the whole field of view.
        parameters: correction; None is the one in force during the scan, if any.
        progress: called with the work done and the whole.
        workers: make the slabs of FDK; they see the data set and `out` under the same paths. An
            interrupted reconstruction is taken up.

    Returns:
        JSON-able: file, slices, algorithm, shape (z, y, x), voxel_mm, center_mm, frames, missing,
        correction (edge units), accuracy (see `Volume.accuracy`; None but for FDK), warnings,
        seconds.

    Raises:
        UnknownNameError: no such algorithm, window or material.
        TwinError: beam hardening cannot be corrected, because the data set has none.
        LimitError: another ending, one of the data set's own files, or a volume too large for this
            machine.
        GeometryError: a trajectory that the algorithm cannot use.
        DatasetError: a frame or the flat field cannot be read.
        OSError: the file cannot be written.
    """
    out = Path(out)
    check_name(out)
    images = {f.file for f in dataset.frames} | {p.name for p in (*dataset.darks, *dataset.flats)}
    home = None if dataset.folder is None else dataset.folder.resolve()
    if out.parent.resolve() == home and out.name in images:
        raise LimitError(f"{out} is an image of the data set itself", {"asked": str(out)})
    begun = time.perf_counter()
    wanted, views, grid = _task(dataset, request, parameters)
    _require_room(out, grid)
    tell = progress or _untold
    with nullcontext() if workers is None else workers as pool:
        views = _corrected(views, wanted)
        if pool is None:
            doubts = _here(views, grid, wanted, out, tell)
        else:
            by_workers = extension("slabs", "a reconstruction by workers")
            doubts = by_workers(views, grid, wanted, out, pool, tell)
    accuracy = None
    if ALGORITHMS[wanted.algorithm].direct:
        bias = bias_of(views.view, views.cone_vec, views.shape, views.truncation)
        accuracy = None if bias is None else bias.accuracy(grid)
        doubts = [*bias_warnings(bias, accuracy), *doubts]
    doubts = [*views.doubts, *doubts]
    slices = write_slices(out, read_volume(out).data) if wanted.png else []
    in_force = dataset.correction
    used = parameters if parameters is not None else in_force.parameters if in_force else None
    return {
        "file": str(out),
        "slices": [str(file) for file in slices],
        "algorithm": wanted.algorithm,
        "shape": list(grid.shape),
        "voxel_mm": grid.voxel_mm,
        "center_mm": list(grid.center_mm),
        "frames": len(views.indices),
        "missing": len(dataset.missing),
        "correction": None if used is None else used.to_edge(),
        "accuracy": None if accuracy is None else asdict(accuracy),
        "warnings": doubts,
        "seconds": round(time.perf_counter() - begun, 3),
    }


def _untold(done: float, total: float) -> None:
    """Progress that is not reported."""


def _here(
    views: ScanFrames, grid: Grid, request: VolumeRequest, out: Path, tell: Progress
) -> list[str]:
    """Reconstruct into a file; returns what is doubtful."""
    with volume_writer(out, grid) as write:
        if not ALGORITHMS[request.algorithm].direct:
            write(_iterative(views, grid, request, tell).data)
            return []
        slabs, truncation = grid.slabs(SLAB_BYTES), views.truncation
        lost = 0
        for k, (first, last) in enumerate(slabs):

            def part(done: float, k: int = k) -> None:
                tell(k + done, len(slabs))

            like = grid.slab(first, last).blank()
            slab = fdk_parts(
                views.parts, views.cone_vec, views.shape, like, request.window, part, truncation
            )
            write(slab.data)
            lost += lost_layers(slab.data)
    return layer_warnings(lost, grid.shape[0])


def reconstruct_volume(
    dataset: ImageSet,
    request: VolumeRequest | None = None,
    *,
    parameters: Offsets | None = None,
    progress: Progress | None = None,
    errors: bool = False,
) -> Volume:
    """Reconstruct a data set in memory; arguments and errors as for `reconstruct_dataset`, and
    `errors` as for `fdk`.
    """
    tell = progress or _untold
    wanted, views, grid = _task(dataset, request, parameters)
    _require("of memory", 3 * grid.bytes, memory_bytes(), grid)
    views = _corrected(views, wanted)
    for doubt in views.doubts:
        warnings.warn(doubt, stacklevel=2)
    if not ALGORITHMS[wanted.algorithm].direct:
        return _iterative(views, grid, wanted, tell)
    volume, doubts = checked_fdk(
        views.view, views.parts, views.cone_vec, views.shape, grid, wanted.window,
        lambda done: tell(done, 1.0), errors=errors,
    )  # fmt: skip
    for doubt in doubts:
        warnings.warn(doubt, stacklevel=2)
    return volume


def _task(
    dataset: ImageSet, request: VolumeRequest | None, parameters: Offsets | None
) -> tuple[VolumeRequest, ScanFrames, Grid]:
    """A request that can be met, its views, not yet corrected, and its grid."""
    wanted = VolumeRequest() if request is None else request
    name = wanted.algorithm
    if name not in ALGORITHMS:
        raise UnknownNameError.among(f"unknown algorithm {name!r}; allowed", name, ALGORITHMS)
    several = _names(wanted.material)
    if len(several) > 1 and "materials" not in ALGORITHMS[name].options:
        said = f"materials {', '.join(several)} with {name}"
        follow = " or ".join(having("materials"))
        allowed = f"one, or several with {follow}, which follow each through the volume"
        raise LimitError.instead(said, [name, *several], allowed)
    views = views_of(dataset, parameters, binning=wanted.binning, every=wanted.every)
    views = replace(views, doubts=tuple(image_doubts(dataset, needed=True)))
    return wanted, views, grid_of(views, wanted)


def preview(
    dataset: ImageSet,
    out: Path,
    *,
    parameters: Offsets | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """A quick look at a scan: few views, coarse pixels and voxels, FDK, slices as PNG.

    Arguments, result and errors as for `reconstruct_dataset`.
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
    return reconstruct_dataset(dataset, out, request, parameters=parameters, progress=progress)


def _corrected(views: ScanFrames, request: VolumeRequest) -> ScanFrames:
    """The views with the requested corrections."""
    if request.scatter_correction is not None:
        views = _without_scatter(views, request.scatter_correction, request)
    if request.rings:
        views = replace(views, rings=ring_errors(views.image(i) for i in views.indices))
    if request.material is not None:
        from flexdt.phantoms.materials import material, stated_keV

        made_of = [material(name) for name in _names(request.material)]
        kV, tube, mono_keV = _source(views.dataset, request)
        substances = [one.substance for one in made_of]
        if mono_keV is None and len(made_of) == 1:
            harden = hardening(substances[0], kV, made_of[0].effective_energy_keV, tube=tube)
            views = replace(views, harden=harden)
        elif mono_keV is None:
            mixture = Polychromatic.of(substances, kV, stated_keV(), tube=tube)
            views = replace(views, mixture=mixture)
    return views


def _names(given: str | tuple[str, ...] | None) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else given or ()


def _without_scatter(
    views: ScanFrames, names: tuple[str, ...], request: VolumeRequest
) -> ScanFrames:
    """The views less the scatter of an object of these materials.

    Raises:
        TwinError: the twin made them without scatter.
    """
    from flexdt.phantoms import material
    from flexdt.twin.physics.chain import Chain
    from flexdt.twin.physics.detector import Detector
    from flexdt.twin.physics.scatter import Beam, scan_scatter

    figures = {} if views.dataset.document is None else views.dataset.document.noise.model
    if figures and not any(name.startswith("scatter_") for name in figures):
        raise TwinError(
            f"{views.dataset.where} was made without scatter: there is none to subtract",
            {"asked": "scatter correction", "allowed": "a scanner's data, or scatter simulated"},
        )
    substances = tuple(material(name).substance for name in names)
    kV, tube, mono_keV = _source(views.dataset, request)
    chain = Chain(Detector(), tube, substances, mono_keV=mono_keV)
    factor = max(1, min(max(views.shape) // SCATTER_PIXELS, min(views.shape) // 2))
    each = max(1, len(views.indices) // SCATTER_VIEWS)
    geometry = views.cone_vec[::each].binned(factor, views.shape)
    coarse = ScanFrames(views.dataset, views.indices[::each], geometry, views.binning * factor)
    stack = np.concatenate(list(coarse.parts()))
    found = scatterer_of(stack, geometry, chain, kV)
    beam = Beam.of(chain, kV)
    scatter = scan_scatter(found.thing, views.cone_vec.rows, views.shape, beam)
    return replace(views, scatter=scatter, doubts=(*views.doubts, *found.doubts))


def _source(dataset: ImageSet, request: VolumeRequest) -> tuple[float, TubeModel, float | None]:
    """Voltage, tube and single energy, as requested or as the data set names them.

    Raises:
        LimitError: neither says the voltage.
        TwinError: the data set's images know no beam hardening.
    """
    from flexdt.twin.physics.tube import TubeModel

    if request.tube is not None:
        return request.tube.kV, request.tube.model(), request.tube.mono_keV
    said = None if dataset.settings is None else dataset.settings.kV
    kV = said if request.kV is None else request.kV
    if kV is None:
        raise LimitError(
            f"{dataset.where} does not say its tube voltage, which corrections of beam hardening "
            "and scatter need; give kV= or tube=",
            {"missing": "kV"},
        )
    figures = {} if dataset.document is None else dataset.document.noise.model
    made = next((p for p in ("poly", "mono") if f"physics_{p}" in figures), "ideal")
    if figures and made != "poly":
        raise TwinError(
            f"{dataset.where} was made with physics {made}, one energy: its line integrals are "
            "straight, and a correction of beam hardening would bend them",
            {"asked": "material", "allowed": "physics poly, or a scanner's data"},
        )
    return kV, TubeModel.of_figures(figures), None


def _require_room(out: Path, grid: Grid) -> None:
    """Check, before any work, that the volume fits the disk and a layer of it the memory.

    Raises:
        LimitError: says what is needed and what there is.
    """
    folder = out.absolute().parent
    _require(f"free in {folder}", grid.bytes, free_bytes(folder), grid)
    layer = 3 * grid.bytes // grid.shape[0]
    _require("of memory for a layer and its filling", layer, memory_bytes(), grid)


def _require(where: str, need: int, free: int, grid: Grid) -> None:
    if need > free:
        nz, ny, nx = grid.shape
        raise LimitError(
            f"{nz} x {ny} x {nx} voxels of {grid.voxel_mm:g} mm (z, y, x) need "
            f"{need / 2**30:.3g} GiB; there are {free / 2**30:.3g} GiB {where}: choose larger "
            "voxels or a smaller shape (for iterations also binning, or fewer frames)",
            {"asked": need, "allowed": free},
        )


def _iterative(views: ScanFrames, grid: Grid, request: VolumeRequest, tell: Progress) -> Volume:
    algorithm = ALGORITHMS[request.algorithm]
    stacks, grids = algorithm.stacks, algorithm.grids
    if views.mixture is not None:
        stacks, grids = stacks + 2 * len(views.mixture.mu), grids + 3
    need = stacks * 4 * len(views.indices) * math.prod(views.shape) + grids * grid.bytes
    _require(f"of memory for {request.algorithm}", need, int(0.8 * memory_bytes()), grid)
    asked = {
        "iterations": request.iterations, "weight": request.weight, "hardening": views.mixture,
    }  # fmt: skip
    made: Volume = algorithm.load()(
        np.concatenate(list(views.parts())),
        views.cone_vec,
        grid.blank(),
        watch=lambda step: tell(step.iteration, step.of),
        **{name: value for name, value in asked.items() if value is not None},
    )
    return made
