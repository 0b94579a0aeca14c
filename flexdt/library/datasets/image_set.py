"""The images of a scan as a value: frames read on demand or held in memory, with their
geometry.

`ImageSet` is the input of calibration, alignment, reconstruction and the writers of
files. Users meet it as `DataSet` (`flexdt.library.data_set`), which adds a method for
each of these.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import index as whole
from pathlib import Path
from typing import Any, Final, Protocol, Self, TypeVar, overload

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.notebook_html import (
    facts_table,
    thumbnail,
    values_table,
)
from flexdt.runtime.files.dataset_folder import Frame, mean_image, read_image, read_values
from flexdt.twin.dataset.dataset_errors import (
    DatasetFormatError,
    DatasetIndexError,
    DatasetMissingError,
)
from flexdt.twin.dataset.flexdt_json import DatasetDocument
from flexdt.twin.dataset.normalise import LineIntegrals, of_intensities
from flexdt.twin.dataset.provenance import Provenance
from flexdt.twin.dataset.scan_settings import ScanSettings
from flexdt.twin.errors import shape_words
from flexdt.twin.findings import Findings
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.motion import Motion
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.panel import Panel
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.plausibility import Operation, examine, settled
from flexdt.twin.plausibility.examination import some_of
from flexdt.twin.plausibility.pixel_values import integral_findings
from flexdt.twin.scanner.state import NamedCorrection
from flexdt.twin.signatures import public

Counts = npt.NDArray[np.uint16]
OPEN_COUNTS: Final = 60_000.0
MIN_PEAK_COUNTS: Final = 25
"""Largest count of an image below which it is doubtful that these are counts."""
Images = TypeVar("Images", bound="ImageSet")
"""An image set of the caller's kind, such as a `DataSet`."""
Images_co = TypeVar("Images_co", bound="ImageSet", covariant=True)
"""The same in results."""


class CountsReader(Protocol):
    """Images that are made when they are read: an array of (n, rows, cols) as far as
    indexing."""

    @overload
    def __getitem__(self, index: int) -> Counts: ...
    @overload
    def __getitem__(self, index: npt.NDArray[np.int64]) -> CountsReader: ...


@dataclass(frozen=True, eq=False)
class Arrays:
    """Images in memory, or made on demand.

    Attributes:
        counts: uint16 (n, rows, cols); None where they are files.
        darks, flats: (k, rows, cols), or None where there are none.
        integrals: line integrals (n, rows, cols) from which counts were made; None for
            measured counts.
    """

    counts: Counts | CountsReader | None
    darks: npt.NDArray[Any] | None = None
    flats: npt.NDArray[Any] | None = None
    integrals: Float32Array | None = None

    def of_views(self, chosen: npt.NDArray[np.int64]) -> Arrays:
        """Return the counts and line integrals of some of the images, by index, with the
        dark and flat images of all; the object itself where there are no counts.
        """
        if self.counts is None:
            return self
        if self.integrals is None:
            integrals = None
        else:
            integrals = self.integrals[chosen]
        return replace(self, counts=self.counts[chosen], integrals=integrals)


@public
@dataclass(frozen=True, eq=False, repr=False)
class ImageSet:
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
        references: what its dark and flat images contradict, told at opening; None: nothing.
        truth: of a simulated data set, its sample and settings.
        interpolated: pixels whose line integrals are interpolated, (rows, cols); None: dead
            ones.

    Example:
        >>> import numpy as np
        >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
        >>> data = DataSet.from_arrays(np.full((3, 4, 5), 500), scan, flat=np.full((4, 5), 1000))
        >>> data
        <DataSet 'arrays': 3 projections of 4 x 5 (rows x columns), complete, 1 warning>
        >>> round(float(data[0][0, 0]), 4), len(data[1:])
        (0.6931, 2)
    """

    name: str
    frames: tuple[Frame, ...]
    shape: tuple[int, int]
    cone_vec: ConeVec
    correction: NamedCorrection | None = None
    folder: Path | None = None
    darks: tuple[Path, ...] = ()
    flats: tuple[Path, ...] = ()
    arrays: Arrays | None = None
    nominal: Poses | None = None
    positions: Mapping[str, FloatArray] = field(default_factory=dict)
    machine: Machine | None = None
    profile: Profile | None = None
    settings: ScanSettings | None = None
    document: DatasetDocument | None = None
    complete: bool = True
    reason: str = ""
    warnings: tuple[str, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)
    full_scale: int | None = None
    references: Findings | None = None
    truth: Any = None
    interpolated: npt.NDArray[np.bool_] | None = None

    @classmethod
    def from_arrays(
        cls,
        counts: npt.ArrayLike,
        geometry: ConeVec | npt.ArrayLike,
        *,
        dark: npt.ArrayLike | None = None,
        flat: npt.ArrayLike | None = None,
        name: str = "arrays",
        warnings: Sequence[str] = (),
        truth: Any = None,
    ) -> Self:
        """Make a data set in memory; see `DataSet.from_arrays`.

        Args:
            counts: (n, rows, cols).
            geometry: one view for each image.
            dark, flat: (rows, cols), or several images (k, rows, cols), of which the mean
                is taken.
            name, warnings, truth: of the data set.

        Raises:
            DatasetFormatError: as of `DataSet.from_arrays`.
        """
        values = np.asarray(counts)
        if values.ndim != 3 or 0 in values.shape:
            raise DatasetFormatError.of_shape(
                "counts", values.shape, ("n", "rows", "cols")
            )
        integrals = None
        if flat is not None and values.dtype.kind in "fiu" and not _are_counts(values):
            values = _normalise(values, dark, flat)
            flat = None
        if values.dtype.kind == "f" and flat is None:
            doubts = settled(integral_findings(some_of(values)), DatasetFormatError, name)
            integrals = np.asarray(values, dtype=np.float32)
            values, opened, lost = _counts_of(values)
            dark = np.zeros(values.shape[1:])
            flat = np.full(values.shape[1:], opened)
            warnings = [*lost, *doubts, *warnings]
        if (
            values.dtype.kind in "bui"
            and flat is None
            and 0 < int(values[0].max()) < MIN_PEAK_COUNTS
        ):
            doubt = f"whole numbers up to {values[0].max()} without a flat image: counts, or line "
            warnings = [f"{doubt}integrals whose fractions are cut off?", *warnings]
        if values.dtype != np.uint16:
            if not _are_counts(values):
                raise DatasetFormatError(
                    f"counts of {values.dtype} from {values.min():g} to "
                    f"{values.max():g}; allowed: "
                    "whole numbers from 0 to 65535",
                    {"asked": str(values.dtype), "allowed": "uint16"},
                )
            values = values.astype(np.uint16)
        if isinstance(geometry, ConeVec):
            cone = geometry
        else:
            cone = ConeVec(np.asarray(geometry))
        shape = cone.of_shape((values.shape[1], values.shape[2]))
        if len(cone) != len(values):
            raise DatasetFormatError(
                f"{len(values)} images and {len(cone)} views; allowed: as many of both",
                {"asked": len(values), "allowed": len(cone)},
            )
        darks = _image_stack("dark", dark, shape)
        flats = _image_stack("flat", flat, shape)
        arrays = Arrays(values, darks, flats, integrals)
        placed = settled(examine(Operation.OPEN, cone, shape), DatasetFormatError, name)
        blank = _blank(values)
        reason = f"{blank.sum()} of {len(values)} images are zero everywhere: nothing was recorded"
        frames = tuple(
            Frame(i, f"scan_{i:06d}.tif", None, True, shape) for i in range(len(values))
        )
        dark_doubt: tuple[str, ...]
        if dark is not None:
            dark_doubt = ()
        else:
            dark_doubt = ("no dark image: zero is taken",)
        return cls(
            name,
            frames,
            shape,
            cone.with_shape(shape),
            arrays=arrays,
            complete=not blank.any(),
            reason=reason if blank.any() else "",
            warnings=(*dark_doubt, *placed, *warnings),
            truth=truth,
        )

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        """Format name, number and shape of the projections, sample and voltage where they are
        known, complete or not, and how many warnings (none: left out).
        """
        rows, cols = self.shape
        known = self.known_facts
        of = known.get("sample", self.name)
        sample = "" if of == self.name else f" of {of!r}"
        beam = f", {known['beam'].partition(',')[0]}" if "beam" in known else ""
        if self.complete:
            state = "complete"
        else:
            state = "incomplete"
        many = len(self.warnings)
        if many:
            doubts = f", {many} warning{'s' if many > 1 else ''}"
        else:
            doubts = ""
        images = f"{len(self)} projections of {rows} x {cols} (rows x columns)"
        return f"<DataSet {self.name!r}: {images}{sample}{beam}, {state}{doubts}>"

    def _repr_html_(self) -> str:
        """Make a table (HTML) of the number and size of projections, what is known of sample,
        beam and scanner, completeness, numbers of dark and flat images and warnings, and a
        thumbnail of the first projection, if one is present.
        """
        rows, cols = self.shape
        facts = {
            "projections": f"{len(self)} of {rows} x {cols} pixels",
            **self.known_facts,
            "complete": "yes" if self.complete else "no",
            "dark, flat images": ", ".join(map(str, self._reference_counts())),
            **{f"warning {i}": text for i, text in enumerate(self.warnings, 1)},
        }
        picture = ""
        if self.present:
            first = self.present[0]
            picture = thumbnail(self.counts(first), f"projection {first}")
        heads, *stated = self.provenance.rows
        values = values_table(heads, stated) if stated else ""
        return facts_table(f"DataSet {self.name}", facts) + values + picture

    @property
    def known_facts(self) -> dict[str, str]:
        """What is known of sample, beam, scanner and correction, in words; what nobody
        states is left out. A simulated scan's truth goes before its files, these before the
        texts.
        """
        sample, beam = "", None
        if self.truth is not None:
            sample = self.truth.sample.name
            lit = self.truth.exposure
            beam = lit.kV, lit.power_W, lit.exposure_ms, lit.averages
        elif self.document is not None:
            sample = self.document.sample.name
            tube, panel = self.document.tube, self.document.detector
            beam = tube.kV, tube.power_W, panel.exposure_ms, panel.averages
        elif self.settings is not None:
            sample = self.settings.sample_name or ""
            said = self.settings
            beam = said.kV, said.power_W, said.exposure_ms, said.averages
        facts = {"sample": sample}
        if beam is not None and beam[0]:
            kV, power_W, exposure_ms, averages = beam
            parts = [f"{kV:g} kV", f"{power_W:g} W" if power_W else ""]
            if exposure_ms:
                parts.append(f"{averages or 1:g} x {exposure_ms:.4g} ms")
            facts["beam"] = ", ".join(part for part in parts if part)
        if self.machine is not None:
            facts["scanner"] = self.machine.name
        if self.correction is not None:
            facts["correction"] = self.correction.name
        return {name: said for name, said in facts.items() if said}

    def _reference_counts(self) -> tuple[int, int]:
        """Return the numbers of dark and of flat images, of those in memory if there are,
        else in files.
        """
        in_memory: tuple[npt.NDArray[Any] | None, npt.NDArray[Any] | None] = (None, None)
        if self.arrays is not None:
            in_memory = (self.arrays.darks, self.arrays.flats)
        dark, flat = (
            len(files) if images is None else len(images)
            for files, images in zip((self.darks, self.flats), in_memory, strict=True)
        )
        return dark, flat

    @overload
    def __getitem__(self, index: int) -> Float32Array: ...
    @overload
    def __getitem__(self, index: slice | Sequence[int] | npt.NDArray[Any]) -> Self: ...
    def __getitem__(
        self, index: int | slice | Sequence[int] | npt.NDArray[Any]
    ) -> Float32Array | Self:
        """Return line integrals (rows, cols) of one projection, or the data set of
        several.

        Several keep dark and flat images and warnings; the truth only where it can be
        selected. Their shape is that of the first; an empty selection keeps the data
        set's.

        Args:
            index: of a projection, or a slice or indices of several.
        """
        if not isinstance(index, slice) and np.ndim(index) == 0:
            return self.line_integrals(whole(index))  # type: ignore[arg-type]
        chosen = np.arange(len(self))[index]
        arrays = self.arrays
        frames = tuple(self.frames[i] for i in chosen)
        truth = None
        if hasattr(self.truth, "of_views"):
            truth = self.truth.of_views(chosen)
        return replace(
            self,
            frames=frames,
            shape=frames[0].shape if frames else self.shape,
            cone_vec=self.cone_vec[chosen],
            nominal=None if self.nominal is None else self.nominal[chosen],
            positions={name: values[chosen] for name, values in self.positions.items()},
            arrays=None if arrays is None else arrays.of_views(chosen),
            truth=truth,
        )

    def __iter__(self) -> Iterator[Float32Array]:
        """Iterate over line integrals (rows, cols), one projection after the other."""
        return (self.line_integrals(i) for i in range(len(self)))

    @property
    def where(self) -> str:
        """The folder, or the name of a data set in memory, for messages."""
        if self.folder is None:
            return self.name
        return str(self.folder)

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the projections that are not there."""
        return tuple(f.file for f in self.frames if not f.present)

    @property
    def present(self) -> tuple[int, ...]:
        """Indices of the projections that are there."""
        return tuple(i for i, f in enumerate(self.frames) if f.present)

    @cached_property
    def poses(self) -> Poses:
        """Nominal poses of `frames`; where motors are not known, those that `cone_vec` implies.

        Raises GeometryError: a panel on its side, so that the stage's angle is unknown."""
        if self.nominal is None:
            return Poses.from_cone_vec(self.cone_vec)
        return self.nominal

    @property
    def angles_deg(self) -> FloatArray:
        """Nominal stage angle of each frame, (n,) [deg]."""
        return np.asarray(np.degrees(self.poses.angle))

    @property
    def geometry(self) -> ConeVec:
        """Geometry of `frames` with the correction in force; it carries the detector's
        shape."""
        alike = all(frame.shape == self.shape for frame in self.frames)
        return self.corrected().with_shape(self.shape if alike else None)

    def corrected(self, parameters: Offsets | None = None) -> ConeVec:
        """Return the geometry of `frames` with a correction applied to the nominal one.

        Args:
            parameters: offsets from the nominal geometry; default: the correction in
                force, or none, which leaves a geometry as it was given.

        Raises:
            GeometryError: offsets of a panel on its side, whose motors are not known.

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> bool(np.allclose(data.corrected(Offsets(det_roll=0.01)).source, scan.source))
            True
        """
        if parameters is None:
            if self.correction is None and self.nominal is None:
                return self.cone_vec
            if self.correction is None:
                parameters = NOMINAL
            else:
                parameters = self.correction.parameters
        return self.poses.cone_vec(parameters)

    def with_correction(self, correction: NamedCorrection | Offsets | None) -> Self:
        """Return the data set with another correction in force, such as
        `calibrate(...).correction`; None for the nominal geometry.

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> data.with_correction(Offsets(det_roll=0.01)).correction.name
            'given'"""
        if isinstance(correction, Offsets):
            correction = NamedCorrection("given", "", correction, panel=self.panel)
        return replace(self, correction=correction)

    @property
    def panel(self) -> Panel | None:
        """Distortion and lag that the correction in force undoes."""
        if self.correction is None:
            return None
        return self.correction.panel

    def with_motion(self, motion: Motion) -> Self:
        """Return the data set with a motion of scanner or sample in its geometry.

        Raises:
            TwinError: the motion has another number of frames.

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> from flexdt.twin.geometry.motion import Motion
            >>> drift = Motion(("dS_x",), np.c_[[-0.1, 0.0, 0.1]], np.zeros((3, 1)), (9.0,))
            >>> data.with_motion(drift).geometry.source[:, 0].round(3).tolist()
            [-0.1, 86.603, -86.653]
        """
        return replace(self, nominal=motion.applied(self.poses))

    def counts(self, index: int | None = None) -> Counts:
        """Read projections as they were measured.

        Args:
            index: of one projection; None for all.

        Returns:
            uint16 (rows, cols), or (n, rows, cols).

        Raises:
            DatasetIndexError: no such projection.
            DatasetMissingError: a file is not there.
            DatasetFormatError: it is not an image of this data set.

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> data.counts().shape, data.counts(0).dtype
            ((3, 4, 5), dtype('uint16'))
        """
        if index is None:
            return np.stack([self.counts(i) for i in range(len(self))])
        frame = self.frames[self._place(index)]
        if self.arrays is not None and self.arrays.counts is not None:
            counts: Counts = self.arrays.counts[index]
            return counts
        if not frame.present or frame.path is None:
            raise DatasetMissingError(
                f"{frame.path} is missing ({len(self.missing)} of {len(self)} projections are)",
                {"path": str(frame.path), "missing": list(self.missing[:100])},
            )
        return read_image(frame.path, frame.shape)

    @cached_property
    def dark(self) -> Float32Array:
        """Mean of the dark images, float32 (rows, cols) [counts]; zeros without any."""
        dark = self._mean(self.darks, None if self.arrays is None else self.arrays.darks)
        if dark is None:
            return np.zeros(self.shape, dtype=np.float32)
        return dark

    @cached_property
    def flat(self) -> Float32Array:
        """Mean of the flat images, float32 (rows, cols) [counts]; dark is not subtracted.

        Raises:
            DatasetMissingError: there is no flat image.
        """
        flat = self._mean(self.flats, None if self.arrays is None else self.arrays.flats)
        if flat is None:
            raise DatasetMissingError(
                f"{self.where}: no flat field and no count of an open beam, so that counts "
                "have no line integrals; allowed: a flat image (`flat`; io000000.tif of a "
                "folder, key 1 of an NXtomo file) or the count of an open beam (`open_beam`)",
                {"path": self.where, "missing": ["io000000.tif"]},
            )
        return flat

    def _mean(
        self, files: Sequence[Path], images: npt.NDArray[Any] | None
    ) -> Float32Array | None:
        """Average reference images, those in memory or those of files, as float32 (rows,
        cols); None without any.
        """
        if images is not None:
            return np.asarray(images.mean(axis=0), dtype=np.float32)
        if files:
            return mean_image(files, self.shape)
        return None

    @cached_property
    def normalisation(self) -> LineIntegrals:
        """Conversion of counts to line integrals; its `dead` marks the pixels for which
        it has none, and bad pixels found are interpolated.
        """
        plain = LineIntegrals.of(self.dark, self.flat)
        if self.interpolated is None:
            return plain
        return plain.interpolating(self.interpolated)

    def line_integrals(self, index: int | None = None) -> Float32Array:
        """Compute projections as -log((p - d) / (f - d)), always finite.

        Integrals that were given are copied instead. The panel's lag, where the frame
        before is there, and its distortion are undone where the data set's panel has
        some.

        Args:
            index: of one projection; None for all.

        Returns:
            float32 (rows, cols), or (n, rows, cols).

        Raises:
            DatasetError: as `counts` and `flat`.

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> round(float(data.line_integrals(0)[0, 0]), 4)  # log(1000 / 500)
            0.6931
        """
        if index is None:
            return self.stack(range(len(self)))
        image = self._recorded_integrals(index)
        if self.panel is None:
            return image
        index = range(len(self))[index]
        before = self.frames[max(index - 1, 0)]
        if (
            self.panel.lag
            and before.present
            and before.index == self.frames[index].index - 1
        ):
            image = self.panel.without_lag(image, self._recorded_integrals(index - 1))
        return self.panel.undistorted(image)

    def _recorded_integrals(self, index: int) -> Float32Array:
        """Return line integrals of one projection as they were recorded or given, (rows,
        cols).

        Given integrals are copied; otherwise the counts are normalized."""
        arrays = self.arrays
        if arrays is None or arrays.integrals is None:
            return self.normalisation(self.counts(index))
        return np.array(arrays.integrals[self._place(index)])

    def _place(self, index: int) -> int:
        """Return the number of a projection, counted from the first.

        Raises:
            DatasetIndexError: there is none of this number.
        """
        try:
            return range(len(self))[index]
        except IndexError:
            allowed = f"0 to {len(self) - 1}"
            raise DatasetIndexError.instead(f"index is {index}", index, allowed) from None

    def stack(self, indices: Sequence[int] | None = None) -> Float32Array:
        """Return line integrals of several projections, by index (default: all present),
        float32 (n, rows, cols).

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> data.stack([0, 2]).shape
            (2, 4, 5)"""
        if indices is None:
            chosen = self.present
        else:
            chosen = tuple(indices)
        out = np.empty((len(chosen), *self.shape), dtype=np.float32)
        for k, index in enumerate(chosen):
            out[k] = self.line_integrals(index)
        return out

    def require_complete(self) -> Self:
        """Return this data set if it is complete.

        Raises:
            DatasetMissingError: lists the missing files.

        Example:
            >>> import numpy as np
            >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
            >>> counts, flat = np.full((3, 4, 5), 500), np.full((4, 5), 1000)
            >>> data = DataSet.from_arrays(counts, scan, flat=flat)
            >>> data.require_complete() is data
            True
        """
        if not self.complete:
            raise DatasetMissingError(
                f"{self.where} is incomplete: {self.reason}",
                {"path": self.where, "missing": list(self.missing[:100])},
            )
        return self


def _are_counts(values: npt.NDArray[Any]) -> bool:
    """Check whether values are whole numbers from 0 to 65535, of any type."""
    if values.dtype == np.uint16:
        return True
    top = np.iinfo(np.uint16).max
    return bool(((values >= 0) & (values <= top) & (values == np.rint(values))).all())


def _normalise(
    values: npt.NDArray[Any], dark: npt.ArrayLike | None, flat: npt.ArrayLike
) -> Float32Array:
    """Compute line integrals of images that are no counts.

    Several dark or flat images are averaged.

    `values`: (n, rows, cols) intensities. `dark`: (rows, cols) or (k, rows, cols); 0 without.
    `flat`: (rows, cols) or (k, rows, cols).
    """
    shape = values.shape[1], values.shape[2]
    darks = _image_stack("dark", dark, shape)
    flats = _image_stack("flat", flat, shape)
    if flats is None:
        opened = np.zeros(shape)
    else:
        opened = flats.mean(axis=0)
    return of_intensities(values, 0.0 if darks is None else darks.mean(axis=0), opened)


def _blank(counts: Counts) -> npt.NDArray[np.bool_]:
    """Mark images (n, rows, cols) that are zero everywhere.

    Every 41st pixel of the middle row decides for most.
    """
    blank: npt.NDArray[np.bool_] = counts[:, counts.shape[1] // 2, ::41].max(axis=1) == 0
    for i in np.flatnonzero(blank):
        blank[i] = not counts[i].any()
    return blank


def _counts_of(integrals: npt.NDArray[Any]) -> tuple[Counts, float, list[str]]:
    """Convert line integrals to counts of an open beam of `OPEN_COUNTS`, or of down to a
    third of it where pixels are brighter; counts beyond uint16 are cut.

    Returns:
        Counts (n, rows, cols), the open beam's count, and [] or one warning with the
        share of pixels that were cut or are below one count.

    Raises:
        DatasetFormatError: line integrals that are not finite.
    """
    finite = np.isfinite(integrals)
    if not finite.all():
        image, row, column = map(int, np.unravel_index(np.argmin(finite), finite.shape))
        message = (
            f"{finite.size - np.count_nonzero(finite)} of {finite.size} line integrals are not "
            f"finite, the first of them at image {image}, row {row}, column {column}"
        )
        allowed = "finite ones; for a dead pixel, the mean of its neighbors"
        raise DatasetFormatError.instead(message, "NaN or infinity", allowed)
    top = np.iinfo(np.uint16).max
    images = np.exp(-np.maximum(integrals.astype(np.float32), -80.0))
    # Brighter pixels than the open beam, as noise makes them, need room above it.
    opened = float(
        np.clip(np.floor(top / max(images.max(), 1e-9)), OPEN_COUNTS / 3, OPEN_COUNTS)
    )
    images *= opened
    lost = float(((images < 1.0) | (images > top)).mean())
    held = f"{np.log(opened / top):.3g} to {np.log(opened):.3g}"
    warning = (
        f"{100 * lost:.3g} % of the pixels have line integrals outside {held}: they are cut in "
        "counts, as files have them, and kept in line_integrals()"
    )
    return (
        np.rint(np.clip(images, 0, top)).astype(np.uint16),
        opened,
        [warning] if lost else [],
    )


def _image_stack(
    what: str, images: npt.ArrayLike | None, shape: tuple[int, int]
) -> npt.NDArray[Any] | None:
    """Return one or several images as (k, rows, cols).

    Args:
        what: word for the message.
        images: (rows, cols) or (k, rows, cols); None for none.
        shape: the projections' (rows, cols).

    Returns:
        The images; None without any.

    Raises:
        DatasetFormatError: images of another shape, or with values that are not finite.
    """
    if images is None:
        return None
    values = np.asarray(images)
    values = values[None] if values.ndim == 2 else values
    if values.ndim != 3 or values.shape[1:] != shape or len(values) == 0:
        raise DatasetFormatError(
            f"{what} images of shape {shape_words(values.shape)}; allowed: "
            f"{shape_words(shape)} or k x {shape_words(shape)}",
            {"asked": list(values.shape), "allowed": list(shape)},
        )
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        many = int((~np.isfinite(values)).sum())
        problem = f"{what} images: {many} of {values.size} values are not finite"
        raise DatasetFormatError.instead(problem, many, "finite")
    return values


def references(data: ImageSet) -> list[tuple[str, Counts]]:
    """List dark, then flat images as (file name, counts). Those in memory get names
    (di000000.tif, io000000.tif, ...) and are rounded to uint16.
    """
    held = data.arrays or Arrays(None)
    named: list[tuple[str, Counts]] = []
    for kind, files, images in (
        ("di", data.darks, held.darks),
        ("io", data.flats, held.flats),
    ):
        if images is None:
            named += [(path.name, _rounded(read_values(path))) for path in files]
        else:
            named += [
                (f"{kind}{i:06d}.tif", _rounded(image)) for i, image in enumerate(images)
            ]
    return named


def _rounded(image: npt.NDArray[Any]) -> Counts:
    """Round an image to counts."""
    top = np.iinfo(np.uint16).max
    return np.asarray(np.rint(np.clip(image, 0, top)), dtype=np.uint16)
