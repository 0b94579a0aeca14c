"""The shipped tables: tungsten spectra by kV and attenuation by element, on one energy grid.

`docs/tools/physics_tables.py` made them; their provenance travels inside the file. They are read
once; spectra work on their bins, and one energy by itself is interpolated between edges.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources

import numpy as np

from flexdt.twin.geometry.conventions import FloatArray


@dataclass(frozen=True, eq=False)
class Tables:
    """All arrays are read-only.

    Attributes:
        energy_keV: (e,) centres of the bins [keV].
        kV: (k,) tube voltages of the spectra, growing.
        fluence: (k, e) photons per cm2 and mAs in each bin, 1 m from a tungsten anode, no filter.
        elements: symbol -> row of `total`.
        molar_mass: (z,) [g/mol].
        total: (z, e) mass attenuation with coherent scattering [cm2/g].
        edges_keV: (z, n) absorption edges above 5 keV, growing, NaN where there are fewer.
        provenance: where the numbers come from.
    """

    energy_keV: FloatArray
    kV: FloatArray
    fluence: FloatArray
    elements: Mapping[str, int]
    molar_mass: FloatArray
    total: FloatArray
    edges_keV: FloatArray
    provenance: Mapping[str, str]


@lru_cache
def tables() -> Tables:
    """The shipped tables."""
    arrays, provenance = stored_arrays("tables.npz")
    symbols = [str(s) for s in arrays["symbols"]]
    return Tables(
        arrays["energy_keV"],
        arrays["kV"],
        arrays["fluence"],
        {symbol: row for row, symbol in enumerate(symbols)},
        arrays["molar_mass"],
        arrays["total"],
        arrays["edges_keV"],
        provenance,
    )


def stored_arrays(file: str) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The read-only arrays of a file of this package by name, numbers as float64, and their
    provenance."""
    with (
        (resources.files("flexdt.twin.attenuation") / "data" / file).open("rb") as content,
        np.load(content, allow_pickle=False) as stored,
    ):
        arrays = {
            name: stored[name].astype(np.float64)
            if stored[name].dtype.kind in "iuf"
            else stored[name]
            for name in stored.files
        }
    for array in arrays.values():
        array.flags.writeable = False
    return arrays, json.loads(str(arrays.pop("provenance")))
