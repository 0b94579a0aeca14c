"""Run the kernels that many tests share, so that numba's disk cache holds them: `make ready`.

Workers that start together, and every server that one of them starts, would each compile the
same kernels: more than a minute of processor time each.
"""

from __future__ import annotations

import warnings

import numpy as np

import flexdt as fx
from flexdt.phantoms import load_phantom
from flexdt.twin.calibration import detect_beads
from flexdt.twin.projection import warm_up


def main() -> None:
    """Use whatever the tests compile, once, so that numba's cache holds it before workers
    begin.

    Warnings are silenced from here on.
    """
    warnings.simplefilter("ignore")  # nothing here has to be a good scan
    warm_up()
    scan = fx.ConeVec.circular(sod=600, sdd=1059, angles=12, shape=(96, 120), pixel=1.0)
    for image in fx.simulate("lego", scan, noise=1).line_integrals():
        detect_beads(image)
    fx.simulate("lego", scan, scatter="mc").reconstruct(voxel=4.0, shape=(4, 8, 8))
    seen = scan.project_points(load_phantom("lego").beads)
    marks = [
        (i, str(k), *seen[i, k].tolist(), None) for i, k in np.ndindex(seen.shape[:2])
    ]
    fx.calibrate(None, "lego", geometry=scan, markers=marks)


if __name__ == "__main__":
    main()
