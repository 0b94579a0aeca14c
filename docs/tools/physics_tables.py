"""Writes the tables that flexdt.twin.physics ships, from spekpy and xraydb, with their
provenance.

Run it only to renew the tables: `pip install spekpy xraydb`, then `python
docs/tools/physics_tables.py twin/attenuation/data/tables.npz`. Every number in the file comes
from these two packages; nothing is fitted or smoothed here.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import spekpy
import xraydb

STEP_KEV = 0.5
LOWEST_KEV = 5.0
HIGHEST_KEV = 240.0
KILOVOLTS = [*range(20, 100), *range(100, 241, 5)]
ANODE_DEG = 12.0
PHYSICS = "kqp"
LAST_ELEMENT = 92


def main() -> None:
    """Compute spectra (spekpy) and attenuation (xraydb) at the tables' energies, and
    write them with their provenance to the .npz file OUT.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    out: Path = parser.parse_args().out
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
    elements = range(1, LAST_ELEMENT + 1)
    names = [str(xraydb.atomic_symbol(z)) for z in elements]
    total = np.stack([xraydb.mu_elam(name, energy * 1000.0) for name in names])
    edges_of = [
        sorted(
            e.energy / 1e3
            for e in xraydb.xray_edges(n).values()
            if e.energy > LOWEST_KEV * 1e3
        )
        for n in names
    ]
    edges = np.full((len(names), max(map(len, edges_of))), np.nan)
    for row, values in zip(edges, edges_of, strict=True):
        row[: len(values)] = values
    provenance = {
        "spectra": f"spekpy {spekpy.__version__}, physics {PHYSICS}, tungsten, "
        f"{ANODE_DEG:g} deg, no filter; photons per cm2 and mAs in each bin at 1 m",
        "attenuation": f"xraydb {xraydb.__version__}, mu_elam (Elam, Ravel and Sieber 2002); "
        "cm2/g, total with coherent scattering",
        "script": "docs/tools/physics_tables.py",
    }
    np.savez_compressed(
        out,
        energy_keV=energy,
        kV=np.array(KILOVOLTS, dtype=np.float64),
        fluence=fluence.astype(np.float32),
        symbols=np.array(names),
        molar_mass=np.array([xraydb.atomic_mass(name) for name in names]),
        total=total.astype(np.float32),
        edges_keV=edges,
        provenance=np.array(json.dumps(provenance)),
    )


if __name__ == "__main__":
    main()
