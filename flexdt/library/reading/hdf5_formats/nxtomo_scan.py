"""The values of a scan in an NXtomo file, by their place in the application definition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.nxtomo_writing import PROJECTION
from flexdt.library.reading.hdf5_formats.hdf5_values import (
    lengths_mm,
    members_of,
    text_of,
)
from flexdt.library.reading.hdf5_formats.nxtomo_table import DETECTOR, NXTOMO
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.format_table import Ledger

ALIASES: Final = {
    "x_pixel_size": f"{DETECTOR}/x_pixel_size",
    "y_pixel_size": f"{DETECTOR}/y_pixel_size",
    "distance": f"{DETECTOR}/distance",
    "source/distance": "instrument/source/distance",
}
"""Other places in an entry -> the canonical ones."""


@dataclass(frozen=True, eq=False)
class NxScan:
    """The scan of a file: where it is, and every value by its canonical place.

    Attributes:
        file: open.
        name: of the group with the images.
        path: of the file, for messages.
        keys: of the images, (n,).
        members: canonical place -> datasets there.
        ledger: of all values.
    """

    file: Any
    name: str
    path: Path
    keys: npt.NDArray[Any]
    members: dict[str, list[Any]]
    ledger: Ledger

    @property
    def projections(self) -> npt.NDArray[np.bool_]:
        """Which images are projections, (n,)."""
        return np.asarray(self.keys == PROJECTION)

    def one(self, place: str) -> Any:
        """Take the dataset of a place, the one beside the images first; None without one."""
        found = self.members.get(place)
        if not found:
            return None
        self.ledger.use(place)
        return found[0]

    def length(self, place: str) -> float | None:
        """Take one length [mm], its sign kept; None where there is none, or several.

        Raises:
            DatasetFormatError: an unknown unit, or two places state it differently.
        """
        found = [one for one in self.members.get(place, ()) if one.size == 1]
        if not found:
            return None
        values = [float(lengths_mm(one)[0]) for one in found]
        if not np.allclose(values, values[0], rtol=1e-9):
            both = " and ".join(f"{v:g} mm" for v in values)
            said = f"{self.path}: {place} is {both}"
            raise DatasetFormatError.instead(said, values, "one value")
        self.ledger.use(place)
        return values[0]

    def figure(self, place: str) -> float | None:
        """Take one finite number; None where there is none."""
        found = self.one(place)
        if found is None or found.size != 1:
            return None
        value = float(np.ravel(found[()])[0])
        if not np.isfinite(value):
            said = f"{self.path}: {place} is {value}"
            raise DatasetFormatError.instead(said, str(value), "a number")
        return value

    def of_images(self, place: str) -> npt.NDArray[np.float64] | None:
        """Take a number for each image, (n,): one stands for all; None without any or with
        another number of them, which is told.
        """
        found = self.members.get(place)
        if not found or found[0].dtype.kind not in "iuf":
            return None
        values = np.ravel(np.asarray(found[0][()], dtype=np.float64))
        if values.size == 1:
            values = np.repeat(values, len(self.keys))
        if values.size != len(self.keys):
            many = f"{place} has {values.size} values for {len(self.keys)} images"
            self.ledger.set_aside(place, f"{many}: it is not used")
            return None
        self.ledger.use(place)
        return values


def scan_of(file: Any, name: str, path: Path, keys: npt.NDArray[Any]) -> NxScan:
    """Enter every value of a file in a ledger, by its canonical place.

    Args:
        file: open.
        name: of the group with the images.
        path: for messages.
        keys: of the images.
    """
    ledger = Ledger(NXTOMO, str(path))
    members: dict[str, list[Any]] = {}
    entry = name.split("/")[0]
    bases = [entry]
    if "/instrument" in name:
        bases.insert(0, name.partition("/instrument")[0])
    found = sorted(members_of(file), key=lambda one: not one[0].startswith(f"{name}/"))
    for place, item in found:
        canonical = _canonical(place, name, entry, bases)
        ledger.state(canonical, text_of(item), place)
        if hasattr(item, "attrs"):
            members.setdefault(canonical, []).append(item)
    for place in ("data", "image_key"):
        ledger.use(f"{DETECTOR}/{place}")
    return NxScan(file, name, path, keys, members, ledger)


def _canonical(place: str, name: str, entry: str, bases: Sequence[str]) -> str:
    """Return the place in the application definition of a place in a file.

    Args:
        place: in the file, from its root.
        name: of the group with the images.
        entry: of the scan.
        bases: groups that stand for the entry, the longest first.
    """
    if place.startswith((f"{name}/", f"{name}@")):
        return f"{DETECTOR}{place[len(name) :]}"
    for base in bases:
        if place.startswith(f"{base}/"):
            short = place[len(base) + 1 :]
            return ALIASES.get(short, short)
    if "/" in place and "cone_vec" not in place:
        return f"other entry/{place}"
    return place
