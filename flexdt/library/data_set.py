"""`DataSet`: the images of a scan with a method for each thing that users do with them.

The value itself is `ImageSet`. Each method calls the module that does the work, imported when
the method is first called: detection, kernels and figures are heavy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self, Unpack

import numpy as np
import numpy.typing as npt

from flexdt.library.calibration.calibration_options import CalibrationOptions
from flexdt.library.datasets.cutting import cut
from flexdt.library.datasets.exchange import with_geometry
from flexdt.library.datasets.image_set import ImageSet
from flexdt.library.datasets.reference_look import looked_at, order_doubts
from flexdt.library.datasets.scan_inputs import (
    geometry_said,
    references_said,
    with_statements,
)
from flexdt.library.datasets.scan_options import ScanOptions
from flexdt.phantoms import Phantom
from flexdt.twin import long_work
from flexdt.twin.algorithms import DEFAULT
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.long_work import Progress
from flexdt.twin.physics.tube import Tube
from flexdt.twin.signatures import File, public, with_options_of

if TYPE_CHECKING:
    from flexdt.library.calibration.align_dataset import Aligned
    from flexdt.library.calibration.calibrate import Outcome
    from flexdt.library.notebook.notebook_pages import NotebookPage
    from flexdt.twin.projection import Volume


@public
class DataSet(ImageSet):
    """The projections of a scan with dark and flat images and geometry.

    Iteration and `data[i]` give line integrals, one projection after the other; `data[2:10]` is
    the data set of those projections.

    Attributes:
        name: the scan's.
        frames: all projections the scan should have, in order; `present` says which are there.
        shape: image (rows, cols) of the first projection.
        cone_vec: nominal, uncorrected geometry of `frames`, from the file or the texts.
        correction: in force during the scan, or given since: in `geometry`, not in `cone_vec`.
        folder: its folder, None in memory.
        darks, flats: paths of the dark and flat images that are there.
        arrays: the images, where they are in memory.
        nominal: nominal poses of `frames`; None where `cone_vec` is all that is known.
        positions: motor -> (n,) positions of `frames` [mm, deg], script's sign.
        machine, profile: from which the poses follow; None for an unknown scanner.
        settings: the scanner's text, None if there is none.
        document: flexdt.json, None if there is none.
        complete: whether the scan reports its end and no file is missing.
        reason: why it is not complete.
        warnings: doubts about the data set.
        provenance: every value of the scan's files, and whether it is used, contradicted or
            ignored; a table.
        full_scale: largest count of the panel; None where it is not known.
        truth: of a simulated data set, its sample and settings.

    Example:
        >>> import numpy as np
        >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
        >>> data = DataSet.from_arrays(np.full((3, 4, 5), 500), scan, flat=np.full((4, 5), 1000))
        >>> data
        <DataSet 'arrays': 3 projections of 4 x 5 (rows x columns), complete, 1 warning>
        >>> round(float(data[0][0, 0]), 4), len(data[1:])
        (0.6931, 2)
    """

    @classmethod
    @with_options_of(ScanOptions)
    def from_arrays(
        cls,
        counts: npt.ArrayLike,
        geometry: ConeVec | npt.ArrayLike | File,
        *,
        name: str = "arrays",
        warnings: Sequence[str] = (),
        truth: Any = None,
        **options: Unpack[ScanOptions],
    ) -> Self:
        """Make a data set in memory.

        Args:
            counts: (n, rows, cols), integers from 0 to 65535; with a flat image also
                images of any other scale, such as floats, or negative values after a dark
                image was subtracted; or line integrals, which are floats without a flat
                image. Line integrals are kept as they are, and as counts of an open beam
                of 60000, or down to 20000 where pixels are brighter than it, for
                functions of counts; a warning gives the number beyond the range of
                counts.
            geometry: one view for each image, or a file that `ConeVec.load` reads.
            name: of the data set.
            warnings: doubts about it.
            truth: sample and settings of a simulation.
            options: OPTIONS

        Without a flat image or an open beam, counts have no line integrals.

        Raises:
            DatasetFormatError: shapes that do not fit, values that are no counts, line
                integrals that are not finite, or an implausible geometry. Images that are
                zero everywhere make the data set incomplete.

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> DataSet.from_arrays(np.full((3, 4, 5), 500), scan, name="mine")
            <DataSet 'mine': 3 projections of 4 x 5 (rows x columns), complete, 1 warning>
        """
        values = np.asarray(counts)
        shape = values.shape[1:] if values.ndim == 3 else None
        before, opened = references_said(options)
        stated = geometry_said(geometry, options, shape)
        made = super().from_arrays(
            values,
            stated.cone_vec,
            dark=before.read(shape, "dark") if before and shape else None,
            flat=opened.read(shape, "flat") if opened and shape else None,
            name=name,
            warnings=warnings,
            truth=truth,
        )
        made = with_statements(made, stated)
        made = looked_at(replace(made, warnings=(*made.warnings, *order_doubts(made))))
        kept = {key: options.get(key) for key in ("crop", "binning", "views")}
        return cut(made, **kept)  # type: ignore[arg-type]

    @with_options_of(CalibrationOptions)
    def calibrate(
        self,
        phantom: str | Phantom,
        *,
        geometry: ConeVec | File | None = None,
        progress: Progress = None,
        **options: Unpack[CalibrationOptions],
    ) -> Outcome[DataSet]:
        """Estimate the geometry from the beads of a phantom; see `flexdt.calibrate`.

        `data.with_correction(data.calibrate("lego").correction)` is the corrected data set.

        Args:
            phantom: a phantom, its name, the path of a phantom file, or "unknown".
            geometry: nominal geometry of all frames, or its file, in place of the data set's.
            progress: a bar after two seconds; False for no bar, or a function of the
                fraction done.
            options: OPTIONS
        """
        from flexdt.library.calibration.calibrate import calibrate_with

        if geometry is None:
            posed = self
        else:
            posed = with_geometry(self, geometry)
        with long_work.during("calibrating", progress):
            return calibrate_with([posed], phantom, options)

    def align(
        self, *, per_frame: bool = False, progress: Progress = None
    ) -> Aligned[DataSet]:
        """Estimate the geometry without a phantom; see `flexdt.align`.

        `data.with_correction(data.align().correction)` is the corrected data set."""
        from flexdt.library.calibration.align_dataset import align_dataset

        with long_work.during("aligning", progress):
            return align_dataset(self, per_frame)

    def reconstruct(
        self,
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
        """Reconstruct into a volume in memory; see `flexdt.reconstruct` for the options.

        Unless `progress` is False or a function, a bar is shown after two seconds.

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 1000), np.full((4, 5), 1000)
            >>> counts[:, 1:3, 2] = 500
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> data.reconstruct("fdk", voxel=0.5)
            <Volume: 4 x 5 x 5 voxels (z, y, x) of 0.5 mm about (0, 0, 0) mm>
        """
        from flexdt.library.reconstruction.reconstruct import (
            VolumeRequest,
            reconstruct_volume,
            require_effect,
        )

        request = VolumeRequest(
            algorithm=algorithm,
            voxel_mm=voxel,
            shape=shape,
            binning=binning,
            every=every,
            iterations=iterations,
            window=window,
            center_mm=center,
            rings=rings,
            weight=weight,
            tube=tube,
            material=_names(material) if not isinstance(material, str) else material,
            scatter_correction=_names(scatter_correction),
        )
        require_effect(request, errors)
        with long_work.during("reconstructing", progress) as advance:
            return reconstruct_volume(
                self,
                request,
                parameters=parameters,
                progress=lambda done, whole: advance(done / whole),
                errors=errors is not False,
            )

    def save(self, folder: File, *, resume: bool = False) -> None:
        """Write a folder that `flexdt.open` reads: di000000.tif, io000000.tif, scan_000000.tif
        ... (uint16) and the geometry.

        geometry.json holds the geometry with the correction in force, warnings and the
        largest count of the panel. A data set with flexdt.json keeps that instead, as
        long as it has all of its projections; texts are copied. A data set in memory gets
        the scanner's two texts, `scan settings.txt` and `data settings XRE.txt`, where
        they can express its geometry: a circle in the plane z = 0 with equal steps and an
        upright panel of square pixels. Dark and flat images in memory that are no
        integers are rounded.

        Args:
            folder: made if it is not there; it must be empty.
            resume: go on in a folder in which saving this data set was interrupted.

        Raises:
            DatasetExistsError: the folder is not empty; the message tells whether it is
                half-saved.
            OSError: it cannot be written.

        Example:
            >>> import os, tempfile
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     data.save(folder)
            ...     sorted(os.listdir(folder))[:3]
            ['data settings XRE.txt', 'geometry.json', 'io000000.tif']
        """
        from flexdt.library.datasets.saving import save_data_set

        save_data_set(self, folder, resume)

    def to_nxtomo(self, file: File) -> None:
        """Write NeXus's NXtomo (HDF5), which needs h5py (the extra `io`).

        Raises:
            TwinError: h5py is not installed.
            OSError: the file cannot be written.

        Example:
            >>> import os, tempfile
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     data.to_nxtomo(f"{folder}/scan.nx")
            ...     os.path.exists(f"{folder}/scan.nx")
            True
        """
        from flexdt.library.datasets.nxtomo_writing import save_nxtomo

        save_nxtomo(self, file)

    def to_xarray(self) -> Any:
        """Return line integrals as an xarray DataArray (view, row, column), which needs xarray.

        Raises:
            TwinError: xarray is not installed.

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> data.to_xarray().dims
            ('view', 'row', 'column')
        """
        from flexdt.library.xarray_forms import images_to_xarray

        return images_to_xarray(self)

    def show(self) -> NotebookPage:
        """Show projections behind a slider, and the sinogram of the middle row, in a notebook.

        The page needs no package; `.save("scan.html")` writes it.

        Raises:
            DatasetError: an image cannot be read.
            TwinError: there is no projection.

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> "sinogram" in data.show().html
            True
        """
        from flexdt.library.notebook.notebook_pages import data_page

        return data_page(self)

    def plot(self, index: int = 0, axes: Any = None) -> Any:
        """Show one projection's line integrals; needs matplotlib.

        Args:
            index: of the projection.
            axes: matplotlib's axes to draw into; None makes a figure.

        Returns:
            The axes.

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> data.plot(0).get_title()
            'arrays: scan_000000.tif'
        """
        from flexdt.library.plots import plot_projection

        return plot_projection(self, index, axes)


def _names(materials: str | Sequence[str] | None) -> tuple[str, ...] | None:
    """Return the names of several materials, or of one, as a tuple; None for None."""
    if materials is None:
        return None
    if isinstance(materials, str):
        return (materials,)
    return tuple(materials)
