"""Read and save data sets in folders: frames, geometry, completeness.

Works on folders that this package wrote and on a scanner's own (TIFFs and the two settings
texts alone). Errors are typed and name the file; a defect that leaves the rest usable is a
warning in `warnings`. Missing frames are listed, and reading one is an error.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Final, Unpack, cast

import numpy as np
import numpy.typing as npt

from flexdt.library.data_set import DataSet
from flexdt.library.datasets import scan_files
from flexdt.library.datasets.cutting import cut
from flexdt.library.datasets.exchange import with_geometry
from flexdt.library.datasets.image_doubts import SATURATED
from flexdt.library.datasets.image_sources import (
    Reference,
    angles_deg,
    hdf5_numbers,
    hdf5_place,
    matching,
)
from flexdt.library.datasets.reference_look import looked_at
from flexdt.library.datasets.saving import unfinished
from flexdt.library.datasets.scan_inputs import (
    NO_DARK,
    NO_FLAT,
    Geometry,
    geometry_said,
    placed,
    references_said,
    with_options,
    with_statements,
)
from flexdt.library.datasets.scan_options import ScanOptions
from flexdt.library.reading.foreign_files import (
    SCAN_FORMATS,
    format_of,
    open_file,
    refuse_distances,
)
from flexdt.library.reading.hdf5_formats.hdf5_values import SAID_ANGLES
from flexdt.library.reading.listed_images import (
    in_memory,
    in_order,
    listed,
    of_places,
    without_flat,
)
from flexdt.runtime.files.dataset_folder import (
    Folder,
    list_folder,
    read_text,
    read_values,
)
from flexdt.runtime.files.image_files import (
    IMAGE_ENDINGS,
    IMAGE_FORMATS,
    ImageHead,
    image_head,
    is_image_name,
    raw_folder_advice,
)
from flexdt.twin.dataset.dataset_errors import (
    DatasetError,
    DatasetFormatError,
    DatasetMissingError,
)
from flexdt.twin.dataset.file_names import (
    DOCUMENT,
    GEOMETRY,
    SCAN_SETTINGS,
    UNFINISHED,
    XRE_SETTINGS,
)
from flexdt.twin.dataset.flexdt_json import DatasetDocument, parse_document
from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.dataset.provenance import Provenance
from flexdt.twin.dataset.rebuild import rebuild
from flexdt.twin.dataset.scan_settings import ScanSettings
from flexdt.twin.dataset.scan_settings_text import parse_scan_settings
from flexdt.twin.dataset.scan_tables import SETTINGS_TEXT, XRE_TEXT
from flexdt.twin.dataset.text_accounts import account, account_beside
from flexdt.twin.dataset.xre_reading import parse_xre
from flexdt.twin.errors import TwinError
from flexdt.twin.exchange.number_tables import read_geometry_text
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.input_limits import LIMITS
from flexdt.twin.machine.description import (
    Machine,
    Profile,
    builtin_machine,
    builtin_machines,
    builtin_profile,
    builtin_profiles,
)
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.image_order import duplicate
from flexdt.twin.plausibility.scan_geometry import azimuths
from flexdt.twin.plausibility.stated_figures import angle_findings, pixel_findings
from flexdt.twin.signatures import called, public, with_options_of

DARK_PATTERN: Final = "di*"
FLAT_PATTERN: Final = "io*"
"""Names of dark and flat images where nothing is said of them: the scanner's."""
AGREE_MM: Final = 1e-6
"""Largest difference of a file's cone_vec from the one of its motor positions [mm]."""
MAX_SETTINGS_BYTES: Final = LIMITS["settings"].file_bytes
"""Largest settings text [bytes]; a larger file is none."""


@public
@called("open")
@with_options_of(ScanOptions)
def load_dataset(
    folder: str | PathLike[str],
    *,
    machine: Machine | None = None,
    profile: Profile | None = None,
    ignore_document: bool = False,
    geometry: ConeVec | npt.ArrayLike | str | PathLike[str] | None = None,
    distances: tuple[float, float] | None = None,
    **options: Unpack[ScanOptions],
) -> DataSet:
    """Open a data set.

    A folder is read by the first of these that it has: the only file of a supported
    format of another program (in a folder without a document, geometry or projections of
    flexdt's names), flexdt.json, the geometry that `DataSet.save` wrote, a scanner's
    settings texts; with a `geometry` anybody's images, as `read_tiffs` does.

    Args:
        folder: a folder of TIFFs with flexdt.json, or with a scanner's settings texts; a scan
            file (.toml) that says images, geometry and options;
            Nikon's .xtekct, SkyScan's .log, phoenix's .pca or YXLON's
            ScanParameter.xml with its TIFFs; Varian's Scan.xml; Zeiss's .txrm; a
            Data Exchange or NXtomo file; or a folder with one of these; with a `geometry`
            a file of images, too.
        machine: the scanner, for texts that do not name one that ships with the package.
            Ignored, like `profile`, unless flexdt.json or texts are read.
        profile: zero offsets to use; default: those of the file, or the profile that
            reproduces the printed figures.
        ignore_document: use the texts alone even if flexdt.json or a saved geometry is
            there.
        geometry: one view for each projection, or a file that `ConeVec.load` reads, in place
            of the stated one, with no correction in force, or where an NXtomo or .txrm file
            has none.
        distances: source to axis and source to panel [mm], of an NXtomo file that has
            angles and pixels only. Ignored where `geometry` is given.
        options: OPTIONS

    Raises:
        DatasetError: the data set is invalid, its folder was not saved to the end, or
            distances with any other data set; names the path.
        ExchangeError: a geometry with another number of views, or of another panel.

    Example:
        >>> data = load_dataset("my-scans/lego")  # doctest: +SKIP
        >>> len(data), data.shape  # doctest: +SKIP
    """
    source = Path(folder)
    if source.suffix.lower() == scan_files.ENDING and source.is_file():
        return _of_scan_file(source, geometry, options)
    if geometry is not None and _holds_images(source):
        return read_tiffs(folder, geometry, **options)
    if source.is_file():
        # Angles of a geometry of one view make the others.
        stated = None if geometry is None else geometry_said(geometry, options)
        given = None if stated is None else stated.cone_vec
        kept = options if given is None else _without_angles(options)
        said = kept.get("angles")
        angles = None if said is None else angles_deg(said, source.parent)
        made = open_file(source, given, distances, angles)
        if made.provenance.field(SAID_ANGLES):
            angles = None  # the reader has taken them
        kept = cast(ScanOptions, {**kept, "angles": angles})
        if stated is not None:
            made = with_statements(made, stated)
        return looked_at(with_options(made, kept))
    content = list_folder(source)
    if UNFINISHED in content.names:
        raise DatasetMissingError(
            f"{unfinished(content.path)}; save it once more with resume=True, or remove the folder",
            {"path": str(content.path)},
        )
    foreign = _foreign_file(content)
    if foreign is not None:
        return load_dataset(foreign, geometry=geometry, distances=distances, **options)
    if distances is not None:
        refuse_distances(content.path, "flexdt or a scanner", distances)
    if content.document is not None and not ignore_document:
        data = _from_document(content, machine, profile)
    elif content.geometry is not None and not ignore_document:
        data = _from_geometry(content)
    elif geometry is not None and not (content.scan_settings or content.xre_settings):
        return read_tiffs(folder, geometry, **options)
    else:
        data = _from_texts(content, machine, profile)
    if geometry is None:
        return looked_at(with_options(data, options))
    stated = geometry_said(geometry, options, data.shape, content.path)
    placed_as_given = with_statements(_with_given(data, stated.cone_vec), stated)
    return looked_at(with_options(placed_as_given, _without_angles(options)))


def _of_scan_file(path: Path, geometry: Geometry | None, options: ScanOptions) -> DataSet:
    """Open what a scan file says; a geometry and options given besides come before its own."""
    said = scan_files.scan_file(path)
    both = cast(ScanOptions, {**said.options, **options})
    given = said.geometry if geometry is None else geometry
    made = _of_images(said.images, given, said.frames, both)
    return replace(made, name=path.stem)


def _holds_images(source: Path) -> bool:
    """Return whether this is a file of images, not a scan of another program."""
    return is_image_name(source.name) and source.is_file() and format_of(source) is None


def _without_angles(options: ScanOptions) -> ScanOptions:
    """Return the options without the angles, which the geometry has by now."""
    return cast(ScanOptions, {k: v for k, v in options.items() if k != "angles"})


def _with_given(data: DataSet, geometry: ConeVec) -> DataSet:
    """Replace a data set's geometry; its own angles and pixels are compared with the new
    ones, and a difference is a warning.

    Raises:
        ExchangeError: another number of views, or another panel.
    """
    replaced = with_geometry(data, geometry)
    pixel_mm = float(np.linalg.norm(data.cone_vec.u[0]))
    findings = (
        *angle_findings(geometry, azimuths(data.cone_vec)),
        *pixel_findings(geometry, pixel_mm),
    )
    doubts = settled(findings, DatasetFormatError, data.where)
    return replace(replaced, warnings=(*replaced.warnings, *doubts))


@public
@with_options_of(ScanOptions)
def read_tiffs(
    folder: str | PathLike[str],
    geometry: ConeVec | npt.ArrayLike | str | PathLike[str],
    *,
    frames: str | None = None,
    **options: Unpack[ScanOptions],
) -> DataSet:
    """Read images in a folder, or all images of one file, with a geometry for them.

    Formats are TIFF, PNG, BMP, EDF, MetaImage, NRRD and NumPy's. Images are counts, or other
    numbers: intensities if there is a flat image, else line integrals where they are floats.
    Line integrals are kept in memory as counts of an open beam of 60000, or down to 20000
    where pixels are brighter than it; a warning gives the number beyond that range.

    Args:
        folder: where the images are, or a file of several.
        geometry: one view for each projection, in the order of their names, where 10 comes
            after 9; or a file that `ConeVec.load` reads.
        frames: pattern of the names of projections, in either case; default: all images of
            the folder's first format that are not dark or flat.
        options: OPTIONS

    Without `dark`, `flat` and `open_beam` the files di* and io* are dark and flat images.

    Raises:
        DatasetError: no images, or another number or shape of them than the geometry has.

    Example:
        >>> import pathlib, tempfile, tifffile
        >>> folder = pathlib.Path(tempfile.mkdtemp())
        >>> for i in range(3):
        ...     tifffile.imwrite(folder / f"proj{i}.tif", np.full((4, 5), 500, np.uint16))
        >>> tifffile.imwrite(folder / "white.tif", np.full((4, 5), 1000, np.uint16))
        >>> scan = ConeVec.circular(sod=100, sdd=200, angles=3, pixel=1)
        >>> data = read_tiffs(folder, scan, flat="white*")
        >>> data.geometry.shape, round(float(data[0][0, 0]), 4)
        ((3, 4, 5), 0.6931)
    """
    return _of_images(folder, geometry, frames, options)


def _of_images(
    folder: str | PathLike[str],
    geometry: Geometry,
    frames: str | None,
    options: ScanOptions,
) -> DataSet:
    """Read images with a geometry; see `read_tiffs`."""
    source = Path(folder)
    if (place := hdf5_place(str(folder))) is not None:
        data = _of_hdf5(*place, geometry, options)
    elif source.is_file():
        dark, flat = references_said(options, source.parent)
        data = _of_stacks([source], source.stem, geometry, options, dark, flat)
    else:
        data = _of_folder(list_folder(source), geometry, frames, options)
    kept = cut(data, options.get("crop"), options.get("binning"), options.get("views"))
    return looked_at(kept)


def _of_hdf5(
    path: Path, inside: str, geometry: Geometry, options: ScanOptions
) -> DataSet:
    """Read the images of a data set of an HDF5 file into memory."""
    images = hdf5_numbers(path, inside)[0]
    if images.ndim != 3 or 0 in images.shape:
        raise DatasetFormatError.of_shape(
            f"{path}:{inside}", images.shape, ("n", "rows", "cols")
        )
    dark, flat = references_said(options, path.parent)
    stated = geometry_said(geometry, options, images.shape[1:], path.parent)
    made = in_memory(images, stated.cone_vec, dark, flat, path.stem)
    return with_statements(made, stated)


def _of_folder(
    content: Folder, geometry: Geometry, frames: str | None, options: ScanOptions
) -> DataSet:
    """Read the images of a folder; see `read_tiffs`."""
    names = content.in_order
    dark, flat = references_said(options, content.path)
    if dark is None:
        dark = _by_pattern(content, names, DARK_PATTERN)
    if flat is None:
        flat = _by_pattern(content, names, FLAT_PATTERN)
    others = {p.name for p in (*dark.named, *flat.named) if p.parent == content.path}
    chosen = [n for n in _frame_names(names, frames, others) if n not in others]
    if not chosen:
        raise _no_projections(content.path, names, frames, others)
    head = image_head(content.path / chosen[0])
    stated = geometry_said(geometry, options, head.shape, content.path)
    cone = stated.cone_vec
    said, unknown = _said_by(head, chosen[0])
    if head.images > 1:
        several, doubts = in_order(content, chosen, -1)
        paths = [content.path / name for name in several]
        made = _of_stacks(paths, content.path.name, stated, {}, dark, flat)
        return replace(made, warnings=(*made.warnings, *doubts))
    chosen, doubts = in_order(content, chosen, len(cone))
    doubts += unknown
    if not flat:
        doubts = [*doubts, without_flat(content.path.name, names)]
    if not (head.counts and _countable(content.path / chosen[0], head)):
        images = _finite_images(content.path, chosen, head.shape)
        made = in_memory(images, cone, dark, flat, content.path.name)
        told = (
            doubts
            if images.dtype.kind in "ui"
            else [d for d in doubts if NO_FLAT not in d]
        )
        made = replace(made, warnings=(*made.warnings, *told), provenance=said)
        return with_statements(made, stated)
    made = listed(
        content,
        cone,
        chosen,
        (),
        (),
        warnings=doubts,
        references=(dark, flat),
        provenance=said,
    )
    return with_statements(made, stated)


def _said_by(head: ImageHead, file: str) -> tuple[Provenance, list[str]]:
    """Return what the first image's file says and what became of it, and a doubt that names
    what no table has.
    """
    said = Provenance(replace(one, file=file) for one in head.facts)
    names = [one.field for one in said.unknown]
    if not names:
        return said, []
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    many = f"{len(names)} field{'s' if len(names) > 1 else ''} not known to flexdt"
    return said, [f"{file}: {many}, ignored: {', '.join(names[:5])}{more}"]


def _by_pattern(content: Folder, names: Sequence[str], pattern: str) -> Reference:
    """Return the images of a folder whose names match a pattern."""
    found = [n for n in matching(names, pattern) if is_image_name(n)]
    return Reference.of_files([content.path / name for name in found])


def _frame_names(names: Sequence[str], frames: str | None, others: Set[str]) -> list[str]:
    """List the names that match `frames`; if it is None, all of the first image format with a
    name that is not in `others`, whose own names the caller removes."""
    if frames is not None:
        return matching(names, frames)
    for form in IMAGE_FORMATS:
        found = [n for n in names if n.lower().endswith(form.endings)]
        if set(found) - others:
            return found
    return []


def _no_projections(
    folder: Path, names: Sequence[str], frames: str | None, others: Set[str]
) -> DatasetMissingError:
    """Make the error for a folder in which no projection is found; it says what there is."""
    if not names:
        why = "it is empty"
    elif others and all(n in others for n in names if is_image_name(n)):
        why = (
            f"dark ({DARK_PATTERN} unless said) and flat ({FLAT_PATTERN}) took "
            f"{', '.join(sorted(others)[:3])}"
        )
    else:
        why = f"there are {', '.join(names[:3])} ..."
        raw = raw_folder_advice([folder / name for name in names])
        why += f"; {raw}" if raw else ""
    wanted = (
        f"match {frames!r}"
        if frames is not None
        else f"end with {', '.join(IMAGE_ENDINGS)}"
    )
    return DatasetMissingError(
        f"{folder}: no projections {wanted}; {why}",
        {"path": str(folder), "missing": [frames or "images"]},
    )


def _of_stacks(
    paths: Sequence[Path],
    name: str,
    geometry: Geometry,
    options: ScanOptions,
    dark: Reference | None,
    flat: Reference | None,
) -> DataSet:
    """Read files of several images each; counts when they are needed, other numbers now."""
    heads = [image_head(path) for path in paths]
    if len({head.shape for head in heads}) > 1:
        sizes = ", ".join(f"{h.shape[1]} x {h.shape[0]}" for h in heads[:3])
        raise DatasetFormatError(f"{paths[0].parent}: files of images of {sizes} pixels")
    stated = geometry_said(geometry, options, heads[0].shape, paths[0].parent)
    cone = stated.cone_vec
    said, unknown = _said_by(heads[0], paths[0].name)
    many = sum(head.images for head in heads)
    if many != len(cone):
        raise DatasetFormatError.instead(
            f"{paths[0]}: {many} projections and {len(cone)} views", len(cone), many
        )
    if not all(head.counts for head in heads) or not _countable(paths[0], heads[0]):
        images = np.concatenate(
            [
                [read_values(path, head.shape, i) for i in range(head.images)]
                for path, head in zip(paths, heads, strict=True)
            ]
        )
        made = in_memory(images, cone, dark, flat, name)
        made = replace(made, warnings=(*made.warnings, *unknown), provenance=said)
        return with_statements(made, stated)
    places = [
        (p, i) for p, head in zip(paths, heads, strict=True) for i in range(head.images)
    ]
    doubts = unknown if flat else [*unknown, without_flat(name, [])]
    made = of_places(places, heads[0].shape, cone, name, doubts, dark_told=not dark)
    made = placed(made, dark or Reference(), flat or Reference())
    return with_statements(replace(made, provenance=said), stated)


def _countable(path: Path, head: ImageHead) -> bool:
    """Return whether the first image of a file has no number below 0."""
    return head.dtype.kind == "u" or int(read_values(path, head.shape, 0).min()) >= 0


def _finite_images(
    folder: Path, names: Sequence[str], shape: tuple[int, int]
) -> npt.NDArray[Any]:
    """Read images of a folder that are no counts, (n, rows, cols).

    `folder`: of the images; `names`: of the files, in order; `shape`: that each must have (rows,
    cols).
    Raises DatasetFormatError: a pixel is not finite, or an image has another shape.
    """
    images = np.stack([read_values(folder / n, shape) for n in names])
    bad = np.flatnonzero(~np.isfinite(images).all(axis=(1, 2)))
    if len(bad):
        raise DatasetFormatError(
            f"{folder / names[int(bad[0])]} has pixels that are no numbers; allowed: finite",
            {"path": names[int(bad[0])]},
        )
    return images


def _from_document(
    content: Folder, machine: Machine | None, profile: Profile | None
) -> DataSet:
    """Read a data set by its flexdt.json.

    The stored geometry is used unless machine or profile is given; then it is computed
    from the motor positions. Warns if the stored geometry does not follow from these
    within `AGREE_MM`, and of doubts predicted at submission. A scan that did not finish
    is an incomplete data set, with the reason.

    Args:
        content: the folder.
        machine, profile: in place of the document's, or None.

    Raises:
        DatasetError: the document is invalid or lists no projections, or frames do not
            fit it.
    """
    path = content.path / DOCUMENT
    doc = parse_document(read_text(path), str(path))
    own = machine is None and profile is None
    if machine is None:
        machine = doc.machine_of(str(path))
    if profile is None:
        profile = doc.profile_of(str(path))
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
    warnings: list[str] = []
    settings = read_settings(content, warnings)
    if np.abs(found.cone_vec().rows - cone_vec.rows).max() > AGREE_MM:
        warnings.append(f"{path}: cone_vec does not follow from its motor positions")
    made = listed(
        content,
        cone_vec,
        files,
        doc.files("dark"),
        doc.files("flat"),
        doc.name,
        shapes,
        [] if doc.complete else [doc.reason or "the scan did not finish"],
        warnings,
        correction=doc.correction_in_force(),
        nominal=found,
        positions=doc.positions(),
        machine=machine,
        profile=profile,
        settings=settings,
        document=doc,
        full_scale=(1 << machine.detector.bits) - 1,
    )
    return replace(
        made,
        warnings=(
            *made.warnings,
            *_predicted_doubts(doc, made.warnings),
            *_exposure_doubts(doc),
        ),
    )


def _foreign_file(content: Folder) -> Path | None:
    """Find the only file with a scan of another program, by its ending, whatever its
    case.

    Returns:
        Its path; None where there is no such file, or several, or the folder has
        projections, a document or a geometry of flexdt.
    """
    if (
        content.projections
        or content.document is not None
        or content.geometry is not None
    ):
        return None
    known = tuple(ending for form in SCAN_FORMATS for ending in form.endings)
    named = [
        content.path / name for name in content.in_order if name.lower().endswith(known)
    ]
    found = [path for path in named if format_of(path) is not None]
    if len(found) == 1:
        return found[0]
    return None


def _other_scan(content: Folder) -> str:
    """Explain how to open a folder of another program's scan or TIFF images, as the end
    of an error's sentence; "" if it holds neither.
    """
    for form in SCAN_FORMATS:
        named = [
            name
            for name in content.in_order
            if name.lower().endswith(form.endings)
            and format_of(content.path / name) is form
        ]
        if named:
            return f"; it holds a scan of {form.name}: fx.open({str(content.path / named[0])!r})"
    images = sorted(n for n in content.names if n.lower().endswith((".tif", ".tiff")))
    if images:
        return (
            f", but {len(images)} other TIFFs, which fx.read_tiffs(FOLDER, geometry) reads, "
            "and commands read with --geometry FILE"
        )
    raw = raw_folder_advice([content.path / name for name in content.in_order])
    return f", but {raw}" if raw else ""


def _exposure_doubts(doc: DatasetDocument) -> list[str]:
    """List doubts about the exposures that a document states of dark and flat images."""
    times = {
        kind: {one.exposure_ms for one in doc.frames if one.kind == kind}
        for kind in ("dark", "flat", "projection")
    }
    usual = times["projection"]
    doubts = []
    for kind in ("dark", "flat"):
        if times[kind] and usual and not times[kind] <= usual:
            listed_ms = ", ".join(f"{ms:g}" for ms in sorted(times[kind])[:3])
            doubts.append(
                f"the {kind} images were exposed for {listed_ms} ms, the projections for "
                f"{', '.join(f'{ms:g}' for ms in sorted(usual)[:3])} ms"
            )
    lit = [one.file for one in doc.frames if one.kind == "dark" and one.xrays_on]
    if lit:
        doubts.append(f"the tube was on in {len(lit)} dark images, such as {lit[0]}")
    return doubts


def _predicted_doubts(doc: DatasetDocument, seen: Sequence[str]) -> list[str]:
    """List the doubts predicted at submission about a scan's exposure; those of
    saturation are left out if its images show it already (`seen`).
    """
    saturated = any(SATURATED in one for one in seen)
    return [
        f"predicted at submission: {doubt}"
        for one in doc.predicted
        for doubt in one.doubts
        if not (saturated and "saturate" in doubt)
    ]


def _from_geometry(content: Folder) -> DataSet:
    """Read the data set that `DataSet.save` wrote for a scan without a machine: images
    and geometry.

    The stored notes become warnings, except that on missing dark images. Without stored
    names the images have flexdt's.

    Raises:
        DatasetError: two images have one number, or the geometry is invalid.
    """
    _require_one_each(content)
    path = content.path / GEOMETRY
    geometry = read_geometry_text(read_text(path), str(path))
    names = geometry.files or [content.projection_name(i) for i in range(len(geometry))]
    notes = [note for note in geometry.notes if not note.startswith(NO_DARK)]
    cone = geometry.cone_vec.with_shape(geometry.shape)
    return listed(
        content,
        cone,
        names,
        content.darks,
        content.flats,
        geometry.name,
        warnings=notes,
        full_scale=geometry.full_scale,
        provenance=geometry.provenance,
        settings=_settings_beside(content, geometry.kV),
    )


def _settings_beside(content: Folder, kV: float | None) -> ScanSettings | None:
    """Read the settings in a scanner's text, with the voltage of a saved geometry.

    None without either; a text that cannot be read is none.
    """
    try:
        found = read_settings(content, [])
    except DatasetError:
        found = None
    if kV is None:
        return found
    return ScanSettings(kV=kV) if found is None else replace(found, kV=kV)


def _from_texts(
    content: Folder, machine: Machine | None, profile: Profile | None
) -> DataSet:
    """Read a data set by the scanner's settings texts.

    Projections beyond the number in the text are read with a warning; fewer are missing
    frames. A canceled script makes the data set incomplete. See `rebuild` for the
    geometry: where machine, motors or profile do not give it, the printed figures do, and
    the data set has no profile.

    Args:
        content: the folder.
        machine: taken whatever its name; None: the built-in one that the texts name.
        profile: taken unchecked; None: the built-in one that reproduces the printed
            figures, as the texts name none.

    Raises:
        DatasetError: no projections, two with one number, no usable text, a scan of
            several sections, or texts that do not give the geometry.
    """
    if not content.projections:
        raise DatasetMissingError(
            f"{content.path}: no projections (scan_000000.tif ...){_other_scan(content)}",
            {"path": str(content.path), "missing": ["scan_000000.tif"]},
        )
    _require_one_each(content)
    warnings: list[str] = []
    texts: list[_Text] = []
    settings = read_settings(content, warnings, texts)
    if settings is None:
        raise DatasetMissingError(
            f"{content.path}: none of {DOCUMENT}, {SCAN_SETTINGS!r} and {XRE_SETTINGS!r} "
            "is there, so the geometry is unknown; fx.read_tiffs(FOLDER, geometry) and "
            "--geometry FILE of the commands state it",
            {
                "path": str(content.path),
                "missing": [DOCUMENT, SCAN_SETTINGS, XRE_SETTINGS],
            },
        )
    _require_one_circle(content)
    count = max(content.last_index + 1, settings.projections or 0)
    first = next(iter(content.projections.values()))
    shape = image_head(content.path / first).shape
    if machine:
        machines = [machine]
    else:
        machines = [builtin_machine(n) for n in builtin_machines()]
    if profile:
        profiles = [profile]
    else:
        profiles = [builtin_profile(n) for n in builtin_profiles()]
    said_in = str(content.path / SCAN_SETTINGS)
    rebuilt = rebuild(settings, count, shape, machines, profiles, file=said_in)
    names = [content.projection_name(i) for i in range(count)]
    if settings.projections is not None and count > settings.projections:
        warnings.append(
            f"{count} projections are there, "
            f"the text says {settings.projections}; angles follow the text"
        )
    values, told = _accounted(texts, rebuilt.machine)
    full_scale = None
    if rebuilt.machine is not None:
        full_scale = (1 << rebuilt.machine.detector.bits) - 1
    return listed(
        content,
        rebuilt.poses.cone_vec(),
        names,
        content.darks,
        content.flats,
        settings.scan_id or "",
        [shape] * count,
        ["the text says SCRIPT CANCELLED!"] if settings.cancelled else [],
        [*warnings, *rebuilt.notes, *told],
        provenance=values,
        nominal=rebuilt.poses,
        positions=rebuilt.positions,
        machine=rebuilt.machine,
        profile=rebuilt.profile,
        settings=settings,
        full_scale=full_scale,
    )


def read_settings(
    content: Folder, warnings: list[str], accounts: list[_Text] | None = None
) -> ScanSettings | None:
    """Read the settings of the scanner's text, or of its second text if the first is
    unusable.

    Where no text is usable but the folder has its document, it is None, and the errors
    are warnings.

    Args:
        content: the folder.
        warnings: extended by the errors of texts that are not used.
        accounts: extended by the texts that can be read, the one that is used first; None:
            only that one is read.

    Returns:
        None where there is no text, or none usable beside a document.

    Raises:
        DatasetError: no text is usable, and there is no document; the first text's error.
    """
    errors: list[DatasetError] = []
    used: ScanSettings | None = None
    for file, table, parse in (
        (content.scan_settings, SETTINGS_TEXT, parse_scan_settings),
        (content.xre_settings, XRE_TEXT, _parse_xre),
    ):
        if file is None or (used is not None and accounts is None):
            continue
        path = content.path / file
        said = Ledger(table, str(path))
        try:
            settings = parse(read_text(path, MAX_SETTINGS_BYTES), str(path), said)
        except DatasetError as error:
            errors.append(error)
            continue
        if accounts is not None:
            accounts.append(_Text(said, settings))
        if used is None:
            warnings += [f"{e.message}; {XRE_SETTINGS!r} is used instead" for e in errors]
            used = settings
    if used is not None:
        return used
    if errors and content.document is None:
        raise errors[0]
    warnings += [e.message for e in errors]
    return None


@dataclass(frozen=True)
class _Text:
    """A scanner's text that was read: its lines, and what they say."""

    said: Ledger
    settings: ScanSettings


def _parse_xre(text: str, name: str, said: Ledger) -> ScanSettings:
    """Read the scanner's second text, and enter its values in a ledger."""
    found = parse_xre(text, name)
    found.enter(said)
    return found.settings


def _accounted(
    texts: Sequence[_Text], machine: Machine | None
) -> tuple[Provenance, list[str]]:
    """Explain the lines of the texts of a scan, the one that was used first."""
    first = texts[0]
    motors = () if machine is None else (*machine.axes, *machine.virtual_axes)
    values, told = account(first.said, first.settings, motors)
    for other in texts[1:]:
        winner = first.said.file
        more, doubts = account_beside(other.said, other.settings, first.settings, winner)
        values, told = values.and_also(more), [*told, *doubts]
    return values, told


def _require_one_each(content: Folder) -> None:
    """Check that no two images have one number. Raises DatasetFormatError: names two that
    have."""
    if content.duplicate is not None:
        settled([duplicate(*content.duplicate)], DatasetFormatError, str(content.path))


def _require_one_circle(content: Folder) -> None:
    """Check that the scan has one circular section; others need flexdt.json.

    Only the scanner's second text states sections: nothing is checked if it is missing or
    cannot be parsed.

    Raises:
        DatasetFormatError: that text states several sections.
    """
    if content.xre_settings is None:
        return
    path = content.path / content.xre_settings
    try:
        one = parse_xre(read_text(path, MAX_SETTINGS_BYTES), str(path)).one_circle
    except DatasetError:
        return
    if not one:
        raise DatasetFormatError(
            f"{path} says that the scan has several sections (tiled, "
            f"helical, repeated): the texts state the pose of one only; {DOCUMENT} is needed",
            {"path": str(path), "missing": [DOCUMENT]},
        )
