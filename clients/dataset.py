"""Reads a data set: frames when asked for, normalised line integrals, geometry, completeness.

Works on folders this package wrote and on a scanner's own (TIFFs and the two settings texts alone).
Whatever is wrong is a typed error naming the file, or, when the rest is still of use, a warning in
`warnings`. It refuses to hide gaps: missing frames are named, and asking for one is an error.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.clients.dataset_files import (
    Folder,
    Frame,
    list_folder,
    mean_image,
    read_image,
    read_text,
)
from flexdt.twin.conventions import Float32Array, FloatArray
from flexdt.twin.dataset.document import DatasetDocument, parse_document
from flexdt.twin.dataset.errors import DatasetError, DatasetFormatError, DatasetMissingError
from flexdt.twin.dataset.names import DOCUMENT, SCAN_SETTINGS, XRE_SETTINGS
from flexdt.twin.dataset.normalise import LineIntegrals
from flexdt.twin.dataset.rebuild import rebuild
from flexdt.twin.dataset.settings import ScanSettings
from flexdt.twin.dataset.settings_text import parse_scan_settings
from flexdt.twin.dataset.xre import parse_xre
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry import ConeVec
from flexdt.twin.machine import (
    Machine,
    Profile,
    builtin_machine,
    builtin_machines,
    builtin_profile,
    builtin_profiles,
)
from flexdt.twin.parameters import NOMINAL, Parameters
from flexdt.twin.pose import Poses
from flexdt.twin.state import Correction

AGREE_MM: Final = 1e-6
"""How far the cone_vec of a file may lie from what its motor positions give [mm]."""


@dataclass(frozen=True, eq=False)
class Dataset:
    """A data set, read lazily; geometry is nominal unless a correction is asked for.

    Attributes:
        folder: where it lies.
        name: the scan's.
        frames: all projections the scan should have, in order; `present` says which are there.
        darks, flats: paths of the dark and flat images that are there.
        shape: image (rows, cols) of the first projection.
        poses: nominal poses of `frames`.
        cone_vec: nominal, uncorrected geometry of `frames`: what the file says, or the texts give.
        positions: motor -> (n,) positions of `frames` [mm, deg], script's sign.
        machine, profile: what the poses come from; None for an unknown scanner.
        settings: the scanner's text, None if there is none.
        document: flexdt.json, None if there is none.
        complete: whether the scan says it finished and no file is missing.
        reason: why it is not complete.
        warnings: what is doubtful.
    """

    folder: Path
    name: str
    frames: tuple[Frame, ...]
    darks: tuple[Path, ...]
    flats: tuple[Path, ...]
    shape: tuple[int, int]
    poses: Poses
    cone_vec: ConeVec
    positions: Mapping[str, FloatArray]
    machine: Machine | None
    profile: Profile | None
    settings: ScanSettings | None
    document: DatasetDocument | None
    complete: bool
    reason: str
    warnings: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.frames)

    @cached_property
    def missing(self) -> tuple[str, ...]:
        """Names of the projections that are not there."""
        return tuple(f.file for f in self.frames if not f.present)

    @property
    def correction(self) -> Correction | None:
        """The correction in force during the scan; it is not in `cone_vec`."""
        return None if self.document is None else self.document.correction_in_force()

    @property
    def angles_deg(self) -> FloatArray:
        """Nominal stage angle of each frame, (n,) [deg]."""
        return np.asarray(np.degrees(self.poses.angle))

    def corrected(self, parameters: Parameters | None = None) -> ConeVec:
        """Geometry of `frames` with a correction applied.

        Args:
            parameters: offsets to add; default: the correction in force during the scan, or none.
        """
        if parameters is None:
            in_force = self.correction
            parameters = NOMINAL if in_force is None else in_force.parameters
        return self.poses.cone_vec(parameters)

    def counts(self, index: int) -> npt.NDArray[np.uint16]:
        """Projection `index` as it was written, (rows, cols).

        Raises:
            DatasetMissingError: the file is not there.
            DatasetFormatError: it is not an image of this data set.
        """
        frame = self.frames[index]
        if not frame.present:
            raise DatasetMissingError(
                f"{frame.path} is missing ({len(self.missing)} of {len(self)} projections are)",
                {"path": str(frame.path), "missing": list(self.missing[:100])},
            )
        return read_image(frame.path, frame.shape)

    @cached_property
    def dark(self) -> Float32Array:
        """Mean of the dark images, (rows, cols); zero if there is none (a warning says so)."""
        if not self.darks:
            return np.zeros(self.shape, dtype=np.float32)
        return mean_image(self.darks, self.shape)

    @cached_property
    def flat(self) -> Float32Array:
        """Mean of the flat images, (rows, cols).

        Raises:
            DatasetMissingError: there is none.
        """
        if not self.flats:
            raise DatasetMissingError(
                f"{self.folder}: no flat field (io000000.tif); without one there are no line "
                "integrals",
                {"path": str(self.folder), "missing": ["io000000.tif"]},
            )
        return mean_image(self.flats, self.shape)

    @cached_property
    def normalisation(self) -> LineIntegrals:
        """How counts become line integrals; its `dead` mask tells which pixels cannot."""
        return LineIntegrals.of(self.dark, self.flat)

    def line_integrals(self, index: int) -> Float32Array:
        """Projection `index` as -log((p - d) / (f - d)), (rows, cols), always finite.

        Raises:
            DatasetError: as `counts` and `flat`.
        """
        return self.normalisation(self.counts(index))

    def stack(self, indices: Sequence[int] | None = None) -> Float32Array:
        """Line integrals of several projections (default: all that are there), (n, rows, cols)."""
        chosen = self.present if indices is None else tuple(indices)
        out = np.empty((len(chosen), *self.shape), dtype=np.float32)
        for k, index in enumerate(chosen):
            out[k] = self.line_integrals(index)
        return out

    @property
    def present(self) -> tuple[int, ...]:
        """Indices of the projections that are there."""
        return tuple(f.index for f in self.frames if f.present)

    def __iter__(self) -> Iterator[Float32Array]:
        """Line integrals, one projection after the other."""
        return (self.line_integrals(i) for i in range(len(self)))

    def require_complete(self) -> Dataset:
        """This data set if it is complete.

        Raises:
            DatasetMissingError: says what is missing.
        """
        if not self.complete:
            raise DatasetMissingError(
                f"{self.folder} is incomplete: {self.reason}",
                {"path": str(self.folder), "missing": list(self.missing[:100])},
            )
        return self


def load_dataset(
    folder: str | PathLike[str],
    *,
    machine: Machine | None = None,
    profile: Profile | None = None,
    ignore_document: bool = False,
) -> Dataset:
    """Open a data set.

    Args:
        folder: a folder of TIFFs with flexdt.json, or with a scanner's settings texts.
        machine: the scanner, for texts that do not say one that ships with the package.
        profile: zero offsets to use; default: those of the file, or the profile that reproduces
            the printed figures.
        ignore_document: use the texts alone even if flexdt.json is there.

    Raises:
        DatasetError: what is wrong, with its path.
    """
    content = list_folder(Path(folder))
    if content.document is not None and not ignore_document:
        return _from_document(content, machine, profile)
    return _from_texts(content, machine, profile)


def _from_document(content: Folder, machine: Machine | None, profile: Profile | None) -> Dataset:
    path = content.path / DOCUMENT
    doc = parse_document(read_text(path), str(path))
    own = machine is None and profile is None
    machine = doc.machine_of(str(path)) if machine is None else machine
    profile = doc.profile_of(str(path)) if profile is None else profile
    try:
        found = doc.poses(machine, profile)
        shapes = doc.shapes("projection")
    except TwinError as error:
        raise DatasetFormatError(
            f"{path}: {error.message}", {"path": str(path), **error.data}
        ) from None
    files = doc.files("projection")
    if not files:
        raise DatasetMissingError(f"{path} lists no projections", {"path": str(path)})
    cone_vec = doc.cone_vec() if own else found.cone_vec()
    frames = content.frames(files, shapes)
    warnings: list[str] = []
    settings = _settings(content, warnings)
    if np.abs(found.cone_vec().rows - cone_vec.rows).max() > AGREE_MM:
        warnings.append(f"{path}: cone_vec does not follow from its motor positions")
    others = (*doc.files("dark"), *doc.files("flat"))
    lost = [f for f in others if f not in content.names]
    lost += [f.file for f in frames if not f.present]
    reason = doc.reason if not doc.complete else ""
    if lost:
        reason = "; ".join(filter(None, (reason, _names(lost, "is missing", "are missing"))))
    return Dataset(
        content.path,
        doc.name,
        frames,
        content.paths(doc.files("dark")),
        content.paths(doc.files("flat")),
        shapes[0],
        found,
        cone_vec,
        doc.positions(),
        machine,
        profile,
        settings,
        doc,
        doc.complete and not lost,
        reason or ("" if doc.complete else "the scan did not finish"),
        tuple(warnings + _doubts(doc.files("dark"))),
    )


def _from_texts(content: Folder, machine: Machine | None, profile: Profile | None) -> Dataset:
    if not content.projections:
        raise DatasetMissingError(
            f"{content.path}: no projections (scan_000000.tif ...)",
            {"path": str(content.path), "missing": ["scan_000000.tif"]},
        )
    warnings: list[str] = []
    settings = _settings(content, warnings)
    if settings is None:
        raise DatasetMissingError(
            f"{content.path}: none of {DOCUMENT}, {SCAN_SETTINGS!r} and {XRE_SETTINGS!r} is there, "
            "so the geometry is unknown",
            {"path": str(content.path), "missing": [DOCUMENT, SCAN_SETTINGS, XRE_SETTINGS]},
        )
    _require_one_circle(content)
    count = max(content.last_index + 1, settings.projections or 0)
    first = next(iter(content.projections.values()))
    rows, cols = read_image(content.path / first).shape
    shape = (rows, cols)
    machines = [machine] if machine else [builtin_machine(n) for n in builtin_machines()]
    profiles = [profile] if profile else [builtin_profile(n) for n in builtin_profiles()]
    rebuilt = rebuild(
        settings,
        count,
        shape,
        machines,
        profiles,
        file=str(content.path / SCAN_SETTINGS),
    )
    frames = content.frames([content.projection_name(i) for i in range(count)], [shape] * count)
    lost = [f.file for f in frames if not f.present]
    reasons = ["the text says SCRIPT CANCELLED!"] if settings.cancelled else []
    if lost:
        reasons.append(_names(lost, "is missing", "are missing"))
    if settings.projections is not None and count > settings.projections:
        warnings.append(
            f"{count} projections are there, the text says {settings.projections}; angles follow "
            "the text"
        )
    return Dataset(
        content.path,
        settings.scan_id or content.path.name,
        frames,
        content.paths(content.darks),
        content.paths(content.flats),
        shape,
        rebuilt.poses,
        rebuilt.poses.cone_vec(),
        rebuilt.positions,
        rebuilt.machine,
        rebuilt.profile,
        settings,
        None,
        not reasons,
        "; ".join(reasons),
        (*warnings, *rebuilt.notes, *_doubts(content.darks)),
    )


def _settings(content: Folder, warnings: list[str]) -> ScanSettings | None:
    """The scanner's text, or what the other text says of it."""
    errors: list[DatasetError] = []
    if content.scan_settings is not None:
        path = content.path / content.scan_settings
        try:
            return parse_scan_settings(read_text(path), str(path))
        except DatasetError as error:
            errors.append(error)
    if content.xre_settings is not None:
        path = content.path / content.xre_settings
        try:
            settings = parse_xre(read_text(path), str(path)).settings
        except DatasetError as error:
            errors.append(error)
        else:
            warnings += [f"{e.message}; {XRE_SETTINGS!r} is used instead" for e in errors]
            return settings
    if errors and content.document is None:
        raise errors[0]
    warnings += [e.message for e in errors]
    return None


def _require_one_circle(content: Folder) -> None:
    """The texts state one pose; a tiled or helical scan needs flexdt.json.

    Raises:
        DatasetFormatError: the texts themselves say that there is more than one section.
    """
    if content.xre_settings is None:
        return
    path = content.path / content.xre_settings
    try:
        one = parse_xre(read_text(path), str(path)).one_circle
    except DatasetError:
        return
    if not one:
        raise DatasetFormatError(
            f"{path} says that the scan has several sections (tiled, helical, repeated): the texts "
            f"state the pose of one only; {DOCUMENT} is needed",
            {"path": str(path), "missing": [DOCUMENT]},
        )


def _doubts(darks: Sequence[str]) -> list[str]:
    return [] if darks else ["no dark image (di000000.tif): zero is taken"]


def _names(names: Sequence[str], one: str, many: str) -> str:
    shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    return f"{shown} {one if len(names) == 1 else many}"
