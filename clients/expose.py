"""`flexdt.expose`: image quality of a scan before it is made, and of one that was."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import numpy as np

from flexdt.clients.datasets.data_set import DataSet
from flexdt.clients.datasets.dataset import load_dataset
from flexdt.phantoms.exposure_forecast import VIEWS, Forecast, Transmission, expose
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.physics.exposure import FEW_COUNTS, NOTICED

FROM_DISK = 32
"""Radiographs in files that are looked at before a reconstruction."""
DARK = "no pixel of the flat images is brighter than the dark ones: was the tube off?"

__all__ = ["Forecast", "Measured", "Transmission", "expose", "exposure_of"]


@dataclass(frozen=True)
class Measured:
    """The same figures of a scan that was made; see `Forecast`.

    `saturated` is None where the panel's largest count is not known.
    """

    transmission: Transmission
    saturated: float | None
    starved: float
    images: int


def exposure_of(data: DataSet | str | PathLike[str]) -> Measured:
    """Transmission, saturated and starved pixels of a scan's radiographs.

    Args:
        data: a data set or its folder.

    Raises:
        DatasetFormatError: no pixel of its flat image is brighter than the dark one.
    """
    scan = data if isinstance(data, DataSet) else load_dataset(data)
    wanted = np.unique(np.linspace(0, len(scan.present) - 1, VIEWS).astype(int))
    counts = np.stack([scan.counts(scan.present[i]) for i in wanted])
    alive = scan.flat > scan.dark
    if not alive.any():
        raise DatasetFormatError(DARK, {"asked": 0, "allowed": "> 0 pixels"})
    signal = (counts - scan.dark)[:, alive]
    return Measured(
        Transmission.of(signal / (scan.flat - scan.dark)[alive]),
        None if scan.full_scale is None else float((counts >= scan.full_scale).mean()),
        float((signal < FEW_COUNTS).mean()),
        len(scan),
    )


def image_doubts(scan: DataSet, *, needed: bool = False) -> list[str]:
    """What in the exposure of a scan's images makes its line integrals doubtful.

    Saturated pixels are those with the panel's largest count. Where that is not known, it is the
    largest among the images if it is one at which converters end (2^bits - 1). All radiographs in
    memory are looked at, `FROM_DISK` of those in files, and the flat image.

    Raises:
        DatasetFormatError: line integrals are `needed`, and the images hold none: no pixel of the
            flat image is brighter than the dark one, or all are saturated.
    """
    flat, dark = scan.flat, scan.dark
    alive, wanted = flat > dark, scan.present
    if scan.arrays is None:
        some = np.linspace(0, len(wanted) - 1, FROM_DISK).astype(int)
        wanted = tuple(wanted[i] for i in np.unique(some))
    doubts: list[str] = [] if alive.any() else [DARK]
    held = bool(alive.any())
    if held:
        top: float | None = scan.full_scale
        if top is None:
            top = float(max(flat.max(), max(int(scan.counts(i).max()) for i in wanted)))
            top = top if np.log2(top + 1.0).is_integer() else np.inf
        few = dark[alive] + FEW_COUNTS
        images = (scan.counts(i)[alive] for i in wanted)
        each = [((seen >= top).mean(), (seen < few).mean()) for seen in images]
        saturated, starved = np.mean(each, axis=0)
        shares = {
            "radiographs": float(saturated),
            "flat image": float((flat[alive] >= top).mean()),
        }
        held = min(shares.values()) <= 1.0 - NOTICED
        doubts = [
            f"{100.0 * share:.3g} % of the pixels of the {what} are saturated, where attenuation "
            "comes out wrong: lower the tube's power or the exposure"
            for what, share in shares.items()
            if share >= NOTICED
        ]
        if starved >= NOTICED:
            doubts.append(
                f"{100.0 * starved:.3g} % of the pixels of the radiographs are starved (fewer "
                f"than {FEW_COUNTS:g} counts of signal), where attenuation is mostly noise: raise "
                "the tube's power, its voltage or the exposure"
            )
    if needed and not held:
        raise DatasetFormatError(
            f"{scan.where}: the images hold no line integrals; {'; '.join(doubts)}",
            {"path": scan.where},
        )
    return doubts
