"""Writes the two tables that flexdt.twin.attenuation ships: tube spectra from spekpy, and the
elements from xraydb, with their provenance.

Run it only to renew a table: `pip install spekpy xraydb`, then `python
docs/tools/physics_tables.py spectra twin/attenuation/data/spectra.npz`, or `elements` and
`elements.npz`. Every number comes from these two packages, but for the densities of
`LIQUID_G_CM3`; nothing is fitted or smoothed.
"""

from __future__ import annotations

import argparse
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import xraydb

STEP_KEV = 0.5
LOWEST_KEV = 5.0
HIGHEST_KEV = 240.0
"""Bins of the spectra."""
KILOVOLTS = [*range(20, 100), *range(100, 241, 5)]
ANODE_DEG = 12.0
PHYSICS = "kqp"
LAST_ELEMENT = 92
ELEMENTS_KEV = (1.0, 800.0)
"""Range of the elements' nodes: Elam's tables end at 0.1 and 800 keV, and are said to be
unreliable at the lower end."""
OFF = 1e-4
"""Largest error of a straight line between two nodes, of both logarithms."""
JUMP = 1e-5
"""Distance of two of Elam's energies (logarithm) that stand for an edge."""
LIQUID_G_CM3 = {
    "H": 0.071, "He": 0.125, "N": 0.807, "O": 1.141, "F": 1.505, "Ne": 1.207,
    "Cl": 1.565, "Ar": 1.395, "Kr": 2.413, "Xe": 2.953, "Rn": 4.4,
}  # fmt: skip
"""Of the elements that are gases at room temperature, as liquids at their boiling points
(CRC Handbook of Chemistry and Physics)."""


def spectra(out: Path) -> None:
    """Compute the spectra of spekpy at all voltages and write them with the centers of
    their bins."""
    import spekpy

    energy = np.arange(LOWEST_KEV, HIGHEST_KEV, STEP_KEV) + STEP_KEV / 2
    fluence = np.zeros((len(KILOVOLTS), len(energy)))
    for i, kV in enumerate(KILOVOLTS):
        tube = spekpy.Spek(
            kvp=kV, th=ANODE_DEG, dk=STEP_KEV, physics=PHYSICS, targ="W", z=100, mas=1
        )
        k, density = tube.get_spectrum(edges=False, flu=True, diff=True)
        at = np.rint((k - energy[0]) / STEP_KEV).astype(int)
        keep = (at >= 0) & (at < len(energy))
        assert np.allclose(energy[at[keep]], k[keep])
        fluence[i, at[keep]] = density[keep] * STEP_KEV
    provenance = {
        "spectra": f"spekpy {spekpy.__version__}, physics {PHYSICS}, tungsten, "
        f"{ANODE_DEG:g} deg, no filter; photons per cm2 and mAs in each bin at 1 m",
        "script": "docs/tools/physics_tables.py spectra",
    }
    np.savez_compressed(
        out,
        energy_keV=energy,
        kV=np.array(KILOVOLTS, dtype=np.float64),
        fluence=fluence.astype(np.float32),
        provenance=np.array(json.dumps(provenance)),
    )


def elements(out: Path) -> None:
    """Write molar mass, density when packed and attenuation at nodes of all elements."""
    symbols = [str(xraydb.atomic_symbol(z)) for z in range(1, LAST_ELEMENT + 1)]
    nodes = [nodes_of(symbol) for symbol in symbols]
    provenance = {
        "attenuation": f"xraydb {xraydb.__version__}, mu_elam (Elam, Ravel and Sieber 2002); "
        "cm2/g, total with coherent scattering",
        "script": "docs/tools/physics_tables.py elements",
    }
    np.savez_compressed(
        out,
        symbols=np.array(symbols),
        molar_mass=np.array([xraydb.atomic_mass(symbol) for symbol in symbols]),
        packed_g_cm3=np.array(
            [LIQUID_G_CM3.get(s) or xraydb.atomic_density(s) for s in symbols]
        ),
        node_counts=np.array([len(energy) for energy, _ in nodes]),
        node_keV=np.concatenate([energy for energy, _ in nodes]).astype(np.float32),
        node_cm2_g=np.concatenate([mass for _, mass in nodes]).astype(np.float32),
        provenance=np.array(json.dumps(provenance)),
    )


def nodes_of(symbol: str) -> tuple[np.ndarray, np.ndarray]:
    """Choose energies between which an element's attenuation is straight on logarithmic
    axes, within `OFF`; an absorption edge is two nodes of one energy.

    Returns:
        (keV, cm2/g).
    """
    row = xraydb.get_xraydb().get_cache("photoabsorption", "element", symbol)[0]
    own = np.array(json.loads(row.log_energy)) - np.log(1e3)
    low, high = np.log(ELEMENTS_KEV)
    own = np.array([low, *own[(own > low) & (own < high)], high])
    xs: list[float] = []
    ys: list[float] = []
    for a, b in pairwise(own.tolist()):
        if b - a < JUMP:
            continue
        # Not at Elam's own energies: there xraydb interpolates across them.
        inner = np.linspace(a + 1e-9, b - 1e-9, 2)
        x, y = divided(symbol, inner)
        first = 0
        if xs and a - xs[-1] < JUMP and abs(y[0] - ys[-1]) < OFF / 10:
            first = 1
        xs += x[first:].tolist()
        ys += y[first:].tolist()
    x, y = thinned(np.array(xs), np.array(ys))
    return np.exp(x), np.exp(y)


def divided(symbol: str, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Halve the intervals of log keV between `x` until the middle of each is straight
    within a fifth of `OFF`; returns them with log cm2/g."""
    while True:
        y = np.log(xraydb.mu_elam(symbol, np.exp(x) * 1e3))
        middle = 0.5 * (x[1:] + x[:-1])
        there = np.log(xraydb.mu_elam(symbol, np.exp(middle) * 1e3))
        bent = np.abs(there - 0.5 * (y[1:] + y[:-1])) > OFF / 5
        if not bent.any():
            return x, y
        x = np.sort(np.concatenate([x, middle[bent]]))


def thinned(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave out nodes as long as the line between those that stay is within `OFF`."""
    keep = [0]
    while keep[-1] < len(x) - 1:
        first = keep[-1]
        last = first + 1
        while last + 1 < len(x) and x[last + 1] - x[last] > JUMP:
            slope = (y[last + 1] - y[first]) / (x[last + 1] - x[first])
            line = y[first] + slope * (x[first : last + 2] - x[first])
            if np.abs(line - y[first : last + 2]).max() > 0.8 * OFF:
                break
            last += 1
        keep.append(last)
        if last + 1 < len(x) and x[last + 1] - x[last] <= JUMP:
            keep.append(last + 1)
    return x[keep], y[keep]


def main() -> None:
    """Write the table that the command line names to OUT."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", choices=("spectra", "elements"))
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    {"spectra": spectra, "elements": elements}[given.table](given.out)


if __name__ == "__main__":
    main()
