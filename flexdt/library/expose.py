"""`flexdt.expose`: image quality of a scan before it is made, and of one that was."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import numpy as np

from flexdt.library.data_set import DataSet
from flexdt.library.datasets.image_doubts import DARK
from flexdt.library.reading.folders import load_dataset
from flexdt.phantoms.exposure_forecast import (
    SIMULATED_VIEWS,
    Forecast,
    Transmission,
    expose,
)
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.physics.exposure import FEW_COUNTS

__all__ = ["Forecast", "Measured", "Transmission", "expose", "exposure_of"]


@dataclass(frozen=True)
class Measured:
    """Figures of exposure of a recorded scan; see `Forecast`.

    `saturated` is None where the panel's largest count is not known.
    """

    transmission: Transmission
    saturated: float | None
    starved: float
    images: int


def exposure_of(data: DataSet | str | PathLike[str]) -> Measured:
    """Measure transmission, saturated and starved pixels of a scan's radiographs.

    Of `SIMULATED_VIEWS` projections that are there, evenly spread. Pixels whose flat
    image is not brighter than the dark one are left out of transmission and starved
    pixels; starved ones have less than `FEW_COUNTS` above dark.

    Args:
        data: a data set or its folder.

    Returns:
        Transmission, saturated part (None where the full scale is not known), starved
        part, and the number of projections.

    Raises:
        DatasetFormatError: no pixel of its flat image is brighter than the dark one.
    """
    if isinstance(data, DataSet):
        scan = data
    else:
        scan = load_dataset(data)
    wanted = np.unique(np.linspace(0, len(scan.present) - 1, SIMULATED_VIEWS).astype(int))
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
