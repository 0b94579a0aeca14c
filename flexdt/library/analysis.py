"""Public functions from data sets to geometry and volumes, as `flexdt.clients` offers them.

Each function is short: it opens data sets named by folders and calls the function that
the command line calls too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from flexdt.library.calibration.calibration_options import CalibrationOptions
from flexdt.library.data_set import DataSet
from flexdt.library.datasets.exchange import with_geometry
from flexdt.library.reading.folders import load_dataset
from flexdt.phantoms import Phantom
from flexdt.twin import long_work
from flexdt.twin.algorithms import DEFAULT
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.long_work import Progress
from flexdt.twin.physics.tube import Tube
from flexdt.twin.projection import Volume
from flexdt.twin.signatures import public, with_options_of

if TYPE_CHECKING:
    from flexdt.library.calibration.align_dataset import Aligned
    from flexdt.library.calibration.calibrate import Outcome

Data = DataSet | str | PathLike[str]


@public
@with_options_of(CalibrationOptions)
def calibrate(
    data: Data | Sequence[Data] | None,
    phantom: str | Phantom,
    *,
    geometry: ConeVec | str | PathLike[str] | None = None,
    progress: Progress = None,
    **options: Unpack[CalibrationOptions],
) -> Outcome[DataSet]:
    """Estimate the geometry of scans of a bead phantom, or of markers of unknown positions.

    Args:
        data: a data set or its folder, or several of the same phantom; None where `markers` and
            `geometry` are all there is.
        phantom: a phantom, its name, the path of a phantom file, or "unknown": three or
            more markers at unknown positions.
        geometry: nominal geometry of all frames, or its file: in place of the data set's, or
            for a folder of anybody's TIFF images (see `read_tiffs`).
        progress: a bar after two seconds; False for no bar, or a function of the fraction
            done.
        options: OPTIONS

    Returns:
        The calibration with its uncertainty report; `document` is the JSON of `flexdt
        calibrate`.

    Raises:
        TwinError: a folder is no data set, the phantom has no beads, `free` has an unknown
            name, or a file does not hold.

    Example:
        >>> import flexdt as fx
        >>> found = fx.calibrate("my-scans/lego", "lego")  # doctest: +SKIP
        >>> found.document["parameters"]["dO_x"]  # doctest: +SKIP
        >>> scan = {"geometry": "scan.json", "scale": "0-3=41.5"}
        >>> found = fx.calibrate("my-tiffs", "unknown", **scan)  # doctest: +SKIP
    """
    with long_work.during("calibrating", progress):
        return _calibrate(data, phantom, geometry, options)


def _calibrate(
    data: Data | Sequence[Data] | None,
    phantom: str | Phantom,
    geometry: ConeVec | str | PathLike[str] | None,
    options: CalibrationOptions,
) -> Outcome[DataSet]:
    """Open the data sets, and calibrate them.

    Without data, geometry and `markers` make a data set without images. Otherwise a
    geometry replaces that of each data set.

    Args:
        data, phantom, geometry, options: as for `calibrate`.

    Raises:
        TwinError: neither data, nor geometry and markers.
    """
    from flexdt.library.calibration.calibrate import calibrate_with, typed_words
    from flexdt.library.reading.listed_images import markers_alone

    files: tuple[str, ...] = ()
    if geometry is not None:
        files = ("GEOMETRY",)
    if isinstance(geometry, str | PathLike):
        files = (str(geometry),)
        geometry = ConeVec.load(geometry)
    markers = options.get("markers")
    if data is None:
        if geometry is None or markers is None:
            raise TwinError("no data: allowed with geometry and markers")
        if isinstance(markers, str | PathLike):
            name = Path(markers).stem
        else:
            name = "marks"
        sets = [markers_alone(geometry, name)]
        folders: list[str] = []
    else:
        if isinstance(data, DataSet | str | PathLike):
            several = [data]
        else:
            several = list(data)
        sets = [
            _open(d) if geometry is None else _with_geometry(d, geometry) for d in several
        ]
        folders = [_typed(d) for d in several]
    typed = replace(
        typed_words(sets, phantom, options),
        data=tuple(folders),
        geometry=files * max(len(folders), 1),
    )
    return calibrate_with(sets, phantom, options, typed)


@public
def reconstruct(
    data: Data,
    algorithm: str = DEFAULT,
    *,
    voxel: float | None = None,
    shape: tuple[int, int, int] | None = None,
    center: tuple[float, float, float] | None = None,
    binning: int = 1,
    every: int = 1,
    iterations: int | None = None,
    weight: float | None = None,
    window: str | None = None,
    rings: bool = False,
    material: str | Sequence[str] | None = None,
    scatter_correction: str | Sequence[str] | None = None,
    tube: Tube | None = None,
    parameters: Offsets | None = None,
    progress: Progress = None,
    errors: bool | None = None,
) -> Volume:
    """Reconstruct a data set into a volume in memory.

    Args:
        data: a data set or its folder.
        algorithm: fdk, sirt, sart, cgls, em or tv.
        voxel: edge of a voxel [mm]; default: the pixel's size at the rotation axis.
        shape: (z, y, x) of the volume; default: the field of view.
        center: (x, y, z) of the volume's center [mm]; default: the middle of the field of view,
            or the origin where `shape` is given.
        binning: mean over so many pixels a side first.
        every: use every n-th frame.
        iterations: of an iterative algorithm; default: its own.
        weight: of the total variation (tv); default: its own.
        window: of FDK's ramp filter: ram-lak (default), shepp-logan, cosine, hamming, hann.
        rings: subtract the offsets that pixels add to all views, where they exceed object
            and noise; offsets of entire columns in full turns only.
        material: the object is made of this alone: correct beam hardening. For sirt and sart
            also all the materials it is made of.
        scatter_correction: the material that the object is made of, or all of them: simulate
            its scatter and subtract it (a circular scan).
        tube: of the scan, for the two corrections; default: the tube that the data set
            states.
        parameters: correction; default: the one in force during the scan, if any.
        progress: a bar after two seconds; False for no bar, or a function of the fraction
            done.
        errors: compare the volume with its images (default: True), and warn of
            contradictions and large errors; `volume.accuracy`, `bias_bound` and
            `residuals` tell more, `volume.sigma` the noise (by FDK of a circle of five rows
            or more; of iterations it reads the images and iterates twice more).

    Returns:
        Volume of attenuation [1/mm].

    Raises:
        TwinError: no such algorithm, a volume too large for this machine, a trajectory that the
            algorithm cannot use, or a frame that cannot be read.

    Example:
        >>> import flexdt as fx
        >>> volume = fx.reconstruct("my-scans/lego", "fdk", voxel=0.2)  # doctest: +SKIP
    """
    return _open(data).reconstruct(
        algorithm,
        voxel=voxel,
        shape=shape,
        center=center,
        binning=binning,
        every=every,
        iterations=iterations,
        weight=weight,
        window=window,
        rings=rings,
        material=material,
        scatter_correction=scatter_correction,
        tube=tube,
        parameters=parameters,
        progress=progress,
        errors=errors,
    )


@public
def align(
    data: Data, *, per_frame: bool = False, progress: Progress = None
) -> Aligned[DataSet]:
    """Find axis and source plane of an ordinary scan without a phantom.

    Args:
        data: a data set or its folder.
        per_frame: look for shifts of single frames (jitter) too; `.dataset` then has them.
        progress: a bar after two seconds; False for no bar, or a function of the fraction
            done.

    Returns:
        Axis column and, if the object determines them, roll and yaw of the panel and row
        of the plane in which the source turns, each with its sigma, the refused
        parameters with reasons, and the correction; `document` is the JSON of `flexdt
        align`. Half a turn and the fan, and single rows, determine the column. Where the
        scan does not, `identifiable` is False.

    Raises:
        TwinError: the folder is no data set, or a frame cannot be read.

    Example:
        >>> import flexdt as fx
        >>> data = fx.open("my-scans/apple")  # doctest: +SKIP
        >>> found = fx.align(data)  # doctest: +SKIP
        >>> volume = data.with_correction(found.correction).reconstruct("fdk")  # doctest: +SKIP
    """
    return _open(data).align(per_frame=per_frame, progress=progress)


def _with_geometry(data: Data, geometry: ConeVec) -> DataSet:
    """Return a data set with another nominal geometry, or open a folder with it."""
    if isinstance(data, DataSet):
        return with_geometry(data, geometry)
    return load_dataset(data, geometry=geometry)


def _typed(data: Data) -> str:
    """Return the folder of a scan as it was given, or what stands for one in memory."""
    from flexdt.library.calibration.proposed_commands import IN_MEMORY

    if not isinstance(data, DataSet):
        return str(data)
    if data.folder is None:
        return IN_MEMORY
    return data.where


def _open(data: Data) -> DataSet:
    if isinstance(data, DataSet):
        return data
    return load_dataset(data)
