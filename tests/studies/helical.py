"""FDK of helices beside a circle's: `python tests/studies/helical.py`.

Long random objects (an ellipse of one material with twelve ellipsoids of others in it, out to
0.9 of the field of view) are projected as exact path lengths along helices of a part of the
steepest rise that FDK accepts, three and a half turns on either side of the layers that are
looked at. A line for each rise: mean error and rms of what is even for two voxels around, in
layers at random heights, worst and mean of the objects. The circle sees each layer in its own
plane, where FDK is exact, so that its rms is that of the sampling alone. --objects N, --views N
(a turn), --seed N.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
import numpy.typing as npt

import flexdt as fx
from flexdt.twin.projection import Grid, project_scene
from flexdt.twin.projection.analytic_solids import Ellipsoid, Scene, Solid
from flexdt.twin.reconstruction import fdk

SOD, SDD, PITCH = 300.0, 600.0, 1.6  # mm
SHAPE = (48, 80)
FIELD = SOD * math.sin(math.atan2(SHAPE[1] * PITCH / 2, SDD))
STEEPEST = (SHAPE[0] - 1) * PITCH * (SOD - FIELD) / SDD
CELLS = 81
MU = 0.02  # 1/mm
FloatArray = npt.NDArray[np.float64]
Part = tuple[FloatArray, FloatArray, float]
"""Centre, half axes [mm], attenuation that it adds [1/mm]."""


def thing(rng: np.random.Generator, height: float) -> list[Part]:
    """An upright column with ellipsoids in it, up to `height` above and below the middle."""
    half = 0.9 * FIELD * rng.uniform(0.7, 1.0, 2)
    parts: list[Part] = [(np.zeros(3), np.array([*half, 1e5]), MU)]
    for _ in range(12):
        axes = FIELD * rng.uniform(0.08, 0.3, 3)
        place = rng.uniform(-1.0, 1.0, 3) * (*(0.6 * half), height)
        parts.append((place, axes, MU * float(rng.uniform(-0.8, 1.5))))
    return parts


def truth(parts: list[Part], z: float) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """A layer, and where it and its neighbours two voxels away are even.

    Args:
        parts: place, half axes and attenuation of ellipsoids.
        z: of the layer [mm].
    """
    at = (np.arange(CELLS) - (CELLS - 1) / 2) * 2.0 * FIELD / CELLS
    y, x = np.meshgrid(at, at, indexing="ij")
    value, even = np.zeros(x.shape), np.ones(x.shape, dtype=bool)
    near = 2.5 * 2.0 * FIELD / CELLS
    for place, axes, mu in parts:
        sizes = [
            sum(
                ((c - p) / a) ** 2
                for c, p, a in zip((x, y, z), place, grown, strict=True)
            )
            for grown in (axes, axes + near, np.maximum(axes - near, 1e-3))
        ]
        value += mu * (sizes[0] <= 1.0)
        even &= (sizes[1] > 1.0) | (sizes[2] < 1.0)
    return value, even & (np.hypot(x, y) < 0.95 * FIELD)


def measured(parts: list[Part], part: float, z: float, views: int) -> tuple[float, float]:
    """Mean error and rms of a layer, relative to MU, where it is even.

    Args:
        parts: the object.
        part: of the steepest rise; 0 is a circle at the layer's height.
        z: of the layer [mm].
        views: a turn.
    """
    if part:
        turns = 7.0
        angles = np.linspace(0.0, 360.0 * turns, int(views * turns))
        rise = part * STEEPEST
        geometry = fx.ConeVec.helical(
            sod=SOD,
            sdd=SDD,
            angles=angles,
            rise=rise,
            pixel=PITCH,
            shape=SHAPE,
            height=0.0,
        )
    else:
        geometry = fx.ConeVec.circular(
            sod=SOD, sdd=SDD, angles=views, pixel=PITCH, shape=SHAPE, height=z
        )
    solids = [
        Solid(Ellipsoid(tuple(p.tolist()), tuple(a.tolist())), str(k), mu)
        for k, (p, a, mu) in enumerate(parts)
    ]
    images = project_scene(Scene(tuple(solids)), geometry, SHAPE)
    grid = Grid((1, CELLS, CELLS), 2.0 * FIELD / CELLS, (0.0, 0.0, z))
    value, even = truth(parts, z)
    wrong = ((fdk(images, geometry, grid.blank(), errors=False).data[0] - value) / MU)[
        even
    ]
    return float(wrong.mean()), float(np.sqrt((wrong**2).mean()))


def main() -> None:
    """Print the errors of drawn objects at some parts of the steepest rise."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=int, default=6)
    parser.add_argument("--views", type=int, default=240)
    parser.add_argument("--seed", type=int, default=5)
    options = parser.parse_args()
    print(f"steepest rise {STEEPEST:.3f} mm a turn; errors in % of {MU} / mm")
    print("rise / steepest   mean error: mean, worst   rms: mean, worst")
    for part in (0.0, 0.1, 0.25, 0.5, 0.75, 0.99):
        rng = np.random.default_rng(options.seed)
        found = []
        for _ in range(options.objects):
            parts = thing(rng, STEEPEST)
            z = float(rng.uniform(-0.5, 0.5)) * STEEPEST
            found.append(measured(parts, part, z, options.views))
        mean, rms = 100 * np.array(found).T
        name = f"{part:.2f}" if part else "circle"
        print(f"{name:>15}   {np.abs(mean).mean():9.3f} {np.abs(mean).max():9.3f}        "
              f"{rms.mean():6.3f} {rms.max():6.3f}")  # fmt: skip


if __name__ == "__main__":
    main()
