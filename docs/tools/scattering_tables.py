"""Writes the form factors and incoherent scattering functions that flexdt.twin.attenuation
ships.

Run it only to renew them: `pip install xraylib numpy`, then `python
docs/tools/scattering_tables.py twin/attenuation/data/scattering.npz`. Every number comes from
xraylib (BSD license), which took both functions from EPDL97, and EPDL97 from Hubbell et al.,
J. Phys. Chem. Ref. Data 4 (1975) 471 (incoherent) and Hubbell and Overbo, 8 (1979) 69
(coherent). Nothing is fitted or smoothed here.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import xraylib

LAST_ELEMENT = 92
POINTS = 256
GREATEST = 20.0
"""x = sin(theta / 2) / lambda [1/A] at 248 keV and 180 degrees; the tables end at 240 keV."""
LEAST = 1.5e-3
"""Below this xraylib has no incoherent function; it grows as x squared from 0."""


def main() -> None:
    """Compute form factors and incoherent scattering functions (xraylib) of all elements
    at `POINTS` values of x, evenly spaced in its root, and write them with their
    provenance to the .npz file OUT.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    out: Path = parser.parse_args().out
    x = np.linspace(0.0, np.sqrt(GREATEST), POINTS) ** 2
    elements = range(1, LAST_ELEMENT + 1)
    form = np.array([[xraylib.FF_Rayl(z, float(q)) for q in x] for z in elements])
    incoherent = np.array([[_incoherent(z, float(q)) for q in x] for z in elements])
    provenance = {
        "form_factor": f"xraylib {xraylib.__version__}, FF_Rayl: EPDL97 (Cullen, Hubbell and "
        "Kissel 1997), Hubbell and Overbo 1979; independent atoms",
        "incoherent": f"xraylib {xraylib.__version__}, SF_Compt: EPDL97, Hubbell et al. 1975; "
        f"below x = {LEAST:g} 1/A as x squared",
        "script": "docs/tools/scattering_tables.py",
    }
    np.savez_compressed(
        out,
        x=x,
        form_factor=np.maximum(form, 0.0).astype(np.float32),
        incoherent=incoherent.astype(np.float32),
        provenance=np.array(json.dumps(provenance)),
    )


def _incoherent(z: int, x: float) -> float:
    if x < LEAST:
        return float(xraylib.SF_Compt(z, LEAST) * (x / LEAST) ** 2)
    return float(xraylib.SF_Compt(z, x))


if __name__ == "__main__":
    main()
