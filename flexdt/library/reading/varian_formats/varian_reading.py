"""Read Varian's Scan.xml and its XIM images; from documentation, no file seen.

As TIGRE and RTK agree: with columns turned about, the images are as seen from the source, row 0 at
the top; KVSourceRtn, 90 deg behind GantryRtn, grows as the source turns anticlockwise seen from
above; the panel stands KVDetectorLat towards falling columns then, and KVDetectorLng down (of RTK
alone). Images and open beam are divided by the reading of the beam's chamber.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.library.data_set import DataSet
from flexdt.library.reading.foreign_parsing import begin_of, require_memory, xml_values
from flexdt.library.reading.text_formats.text_scans import stated_size, stated_voltage
from flexdt.library.reading.varian_formats.varian_table import VARIAN
from flexdt.library.reading.varian_formats.xim_images import XimImage, read_xim
from flexdt.twin.dataset.dataset_errors import DatasetFormatError, DatasetMissingError
from flexdt.twin.dataset.format_table import ANGLES, GEOMETRY, Ledger
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, rotation_z
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.image_order import ordered
from flexdt.twin.plausibility.scan_geometry import distance_findings

SOURCE_BEFORE_GANTRY_DEG: Final = 90.0
MM_PER_CM: Final = 10.0
LEAST_OPEN: Final = 1e-6
"""Of the brightest pixel of the open beam: what a dead one counts as."""


def is_varian(path: Path) -> bool:
    """Return whether a file has the elements of Varian's scans."""
    begin = begin_of(path)
    return all(word in begin for word in ("Acquisitions", "ImagerRes"))


def read_varian(path: Path, geometry: ConeVec | None) -> DataSet:
    """Read a scan of Varian's into memory, as shares of the open beam.

    Args:
        path: Scan.xml, beside the folders Acquisitions and Calibrations.
        geometry: one view for each image, in place of the file's.

    Raises:
        DatasetError: no such XML, a number is missing, impossible distances, images or
            the open beam are missing, damaged or of another shape.
    """
    said = Ledger(VARIAN, str(path))
    said.state_all(xml_values(path, "Acquisitions"))
    shape = stated_size(said, "ImagerSizeY", "ImagerSizeX")
    images = _Images(said, "xim", shape)
    shares = images.read(_projections(said, path), path)
    said.warnings.insert(
        0,
        f"{said.file}: Varian's format is read from documentation, no file of Varian's was "
        "seen: compare a part whose handedness and size you know",
    )
    at = images.angles()
    cone = _geometry(said, path, images, at, geometry)
    beam = _Images(said, "air", shape)
    opened = beam.read(_open_beam(said, path), path)
    for share, angle in zip(shares, at, strict=True):
        share /= _between(opened, beam.angles() if len(opened) > 1 else at[:1], angle)
    data = DataSet.from_arrays(
        shares,
        cone,
        dark=np.zeros(shape),
        flat=np.ones(shape),
        name=path.resolve().parent.name,
    )
    settings = stated_voltage(said, "xim/KVKiloVolts")
    values = said.finish()
    return replace(
        data,
        warnings=(*said.warnings, *data.warnings),
        provenance=values,
        settings=settings,
    )


def _projections(said: Ledger, path: Path) -> list[Path]:
    """List the projections of all acquisitions, by the numbers in their folders' names, then
    in their own.

    Raises:
        DatasetError: none is there, or two have one number.
    """
    above = path.parent / "Acquisitions"
    folders = ordered([one.parent.name for one in above.glob("*/*")]).names
    found: list[Path] = []
    for folder in (above / name for name in folders):
        names = [
            one.name
            for one in folder.iterdir()
            if one.name.startswith("Proj_") and one.suffix.lower() == ".xim"
        ]
        order = ordered(names)
        said.warnings += settled(order.findings, DatasetFormatError, str(folder))
        found += [folder / name for name in order.names]
    if not found:
        missing = str(path.parent / "Acquisitions" / "*" / "Proj_*.xim")
        facts = {"path": str(path), "missing": missing}
        raise DatasetMissingError(f"{missing} is missing", facts)
    return found


def _open_beam(said: Ledger, path: Path) -> list[Path]:
    """List the images of the open beam for the filter that the scan had.

    Raises:
        DatasetMissingError: there are none.
    """
    bowtie = said.text("Bowtie", "none").lower() not in ("none", "no", "false", "0")
    name = "FilterBowtie*.xim" if bowtie else "Filter.xim"
    found = sorted((path.parent / "Calibrations").glob(f"Air-*/**/{name}"))
    if not found:
        missing = str(path.parent / "Calibrations" / "Air-*" / "**" / name)
        raise DatasetMissingError(
            f"{missing} is missing, the open beam; without it read_xim of "
            f"{read_xim.__module__} gives the counts for DataSet.from_arrays(counts, "
            "geometry, flat=FLAT)",
            {"path": str(path), "missing": missing},
        )
    return found


@dataclass
class _Images:
    """XIM images that are read, and what they state.

    Attributes:
        said: of the scan.
        group: beginning of their fields.
        shape: (rows, cols) that the scan states.
        stated: properties of each image.
    """

    said: Ledger
    group: str
    shape: tuple[int, int]
    stated: list[dict[str, float | str]]

    def __init__(self, said: Ledger, group: str, shape: tuple[int, int]) -> None:
        """Take where their values are entered; nothing is read."""
        self.said, self.group, self.shape, self.stated = said, group, shape, []

    def read(self, paths: Sequence[Path], path: Path) -> npt.NDArray[np.float32]:
        """Read counts over the chamber's reading (n, rows, cols), columns turned about;
        images without pixels are left out with a warning.

        Raises:
            DatasetFormatError: one is damaged, of another shape, or has no such reading.
        """
        size = 4 * len(paths) * self.shape[0] * self.shape[1]
        require_memory(path, "images", size)
        kept, empty = [], []
        for one in paths:
            image = read_xim(one)
            if not image.pixels.size:
                empty.append(one.name)
                continue
            kept.append(self._share(one, image))
            self.stated.append(image.properties)
        if empty:
            more = f"{len(empty)} images without pixels are left out, the first"
            self.said.warnings.append(f"{self.said.file}: {more} {empty[0]}")
        if not kept:
            said = f"{paths[0].parent}: no image has pixels"
            raise DatasetFormatError(said, {"path": str(paths[0].parent)})
        for name in dict.fromkeys(name for one in self.stated for name in one):
            self.said.state(f"{self.group}/{name}", self._shown(name))
        self.said.use(f"{self.group}/KVNormChamber")
        return np.stack(kept)

    def _share(self, path: Path, image: XimImage) -> npt.NDArray[np.float32]:
        """Return the counts of an image over the chamber's reading."""
        if image.pixels.shape != self.shape:
            rows, cols = image.pixels.shape
            said = f"{path} has {cols} x {rows} pixels"
            allowed = f"{self.shape[1]} x {self.shape[0]}, as Scan.xml says"
            raise DatasetFormatError.instead(said, [rows, cols], allowed)
        chamber = image.properties.get("KVNormChamber")
        if not isinstance(chamber, float) or not 0.0 < chamber < np.inf:
            said = f"{path}: KVNormChamber is {chamber or 'missing'}"
            raise DatasetFormatError.instead(said, chamber, "a number above 0")
        return (image.pixels[:, ::-1] / chamber).astype(np.float32)

    def _shown(self, name: str) -> str:
        """Return the value of a property, or its ends where it changes."""
        values = [one[name] for one in self.stated if name in one]
        text = [f"{v:.9g}" if isinstance(v, float) else v for v in values]
        same = len(set(text)) == 1
        return text[0] if same else f"{text[0]} to {text[-1]}"

    def numbers(self, name: str, default: float | None = None) -> FloatArray:
        """Take a property of all images.

        Raises:
            DatasetFormatError: an image has no such number, and there is no default.
        """
        values = [one.get(name, default) for one in self.stated]
        numbers = [v for v in values if isinstance(v, float) and np.isfinite(v)]
        if len(numbers) < len(values):
            said = f"{self.said.path}: {name} of an image is missing or no number"
            raise DatasetFormatError.instead(said, name, "a number in each image")
        self.said.use(f"{self.group}/{name}")
        return np.array(numbers)

    def angles(self) -> FloatArray:
        """Take the source's angles [deg]."""
        if all("KVSourceRtn" in one for one in self.stated):
            return self.numbers("KVSourceRtn")
        return self.numbers("GantryRtn") + SOURCE_BEFORE_GANTRY_DEG

    def millimetres(self, name: str) -> float | None:
        """Return the middle value of a property, for comparison; None without it."""
        if not all(name in one for one in self.stated):
            return None
        return MM_PER_CM * float(np.median(self.numbers(name)))


def _between(
    opened: npt.NDArray[np.float32], angles: FloatArray, angle: float
) -> npt.NDArray[np.float32]:
    """Interpolate the open beam between the angles [deg] at which it was taken; dead pixels
    count as nearly dark.
    """
    turned = np.mod(angles - angle + 180.0, 360.0) - 180.0
    after = int(np.argmin(np.where(turned >= 0.0, turned, turned + 360.0)))
    before = int(np.argmin(np.where(turned <= 0.0, -turned, 360.0 - turned)))
    far, near = turned[after] % 360.0, -turned[before] % 360.0
    share = near / (near + far) if near + far > 0.0 else 0.0
    image = (1.0 - share) * opened[before] + share * opened[after]
    return np.asarray(np.maximum(image, LEAST_OPEN * image.max()), np.float32)


def _geometry(
    said: Ledger, path: Path, images: _Images, angles: FloatArray, given: ConeVec | None
) -> ConeVec:
    """Take the geometry of the file, at the source's angles [deg], or the given one in its
    place.

    Raises:
        DatasetFormatError: a number is missing, or distances are such as no scanner has.
    """
    across = MM_PER_CM * images.numbers("KVDetectorLat", _lat(said) / MM_PER_CM)
    along = MM_PER_CM * images.numbers("KVDetectorLng", 0.0)
    sod, sdd = said.number("SAD"), said.number("SID")
    pitch = said.number("ImagerResX"), said.number("ImagerResY")
    if given is not None:
        said.give((GEOMETRY, ANGLES), "geometry=")
        return given
    source = images.millimetres("KVSourceVrt")
    panel = images.millimetres("KVDetectorVrt")
    ratio = None if panel is None or source is None else source - panel
    _compare(said, "SAD", sod, "xim/KVSourceVrt", source, pitch[0])
    _compare(said, "SID", sdd, "xim/KVDetectorVrt", ratio, pitch[0])
    for axis, name, size, count in zip(
        "XY", ("Width", "Height"), pitch, images.shape[::-1], strict=True
    ):
        stated = images.millimetres(f"Pixel{name}")
        _compare(said, f"ImagerRes{axis}", size, f"xim/Pixel{name}", stated, size / count)
    if said.stated("ImagerLat") is not None and "KVDetectorLat" in images.stated[0]:
        _compare(
            said,
            "xim/KVDetectorLat",
            float(np.median(across)),
            "ImagerLat",
            _lat(said),
            pitch[0],
        )
    settled(
        distance_findings(sod, sdd, pitch, ("SAD", "SID"), "ImagerRes"),
        DatasetFormatError,
        str(path),
    )
    o = np.zeros(len(angles))
    near, far, right, down = o + sod, o + sdd - sod, o + pitch[0], o + pitch[1]
    place = np.stack(
        [o, -near, o, -across, far, -along, right, o, o, o, o, -down], axis=-1
    )
    turned = place.reshape(-1, 4, 3) @ rotation_z(-np.deg2rad(angles))
    return ConeVec(turned.reshape(-1, 12))


def _lat(said: Ledger) -> float:
    """Return Scan.xml's offset of the panel [mm]; 0 without it."""
    return said.number("ImagerLat") if said.stated("ImagerLat") is not None else 0.0


def _compare(
    said: Ledger,
    winner: str,
    taken: float,
    name: str,
    value: float | None,
    tolerance: float,
) -> None:
    """Compare a figure that is taken with another statement of it [mm]."""
    said.agree(
        winner.rpartition("/")[2], [(winner, taken), (name, value)], tolerance, "mm"
    )
