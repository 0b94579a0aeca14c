"""FDK at the edges of the panel: `python examples/research/fdk_edges.py`.

Two tables. A detector moved aside, level and turned about the vertical, with an object out to 0.95
of the field of view: mean error of flat regions. Objects wider than the panel (cylinders, boxes, a
hexagon, a triangle, and random ellipses with other materials in them): error in the middle, at half
the field of view's radius and near its border. Projections are exact path lengths of the solids.
"""

from __future__ import annotations

import argparse

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Grid, project_scene
from flexdt.twin.projection.analytic_solids import (
    Box,
    ConvexPolyhedron,
    Cylinder,
    Ellipsoid,
    Scene,
    Shape,
    Solid,
)
from flexdt.twin.reconstruction import fdk

SOD, SDD, COLS, ROWS, PITCH = 300.0, 600.0, 160, 16, 0.8  # mm
HALF = COLS * PITCH / 2
FIELD = SOD * np.sin(np.arctan2(HALF, SDD))
MU = 0.02  # 1/mm
FloatArray = npt.NDArray[np.float64]


def turned(vector: tuple[float, float, float], angles: FloatArray) -> FloatArray:
    """A vector turned counter-clockwise about z, (n, 3)."""
    x, y, z = vector
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([c * x - s * y, s * x + c * y, np.full_like(c, z)], axis=1)


def scan(views: int, aside: float = 0.0, yaw: float = 0.0) -> ConeVec:
    """A full turn; `aside` [mm] along x, `yaw` [rad] of the panel."""
    angles = np.linspace(0.0, 2.0 * np.pi, views, endpoint=False)
    u = (PITCH * np.cos(yaw), PITCH * np.sin(yaw), 0.0)
    return ConeVec.from_vectors(
        turned((0.0, -SOD, 0.0), angles), turned((aside, SDD - SOD, 0.0), angles),
        turned(u, angles), (0.0, 0.0, -PITCH),
    )  # fmt: skip


def layer(solids: list[Solid], geometry: ConeVec, radius: float, cells: int = 121) -> FloatArray:
    """The middle layer of the reconstruction out to `radius`, in units of MU."""
    images = project_scene(Scene(tuple(solids)), geometry, (ROWS, COLS))
    grid = Grid((1, cells, cells), 2.0 * radius / cells)
    return np.asarray(fdk(images, geometry, grid.blank()).data[0] / MU, dtype=np.float64)


def distance(cells: int = 121) -> FloatArray:
    """From the axis, relative to the half width of a layer, (cells, cells)."""
    at = (np.arange(cells) - (cells - 1) / 2) * 2.0 / cells
    return np.asarray(np.hypot(at[:, None], at))


def moved_aside(views: int) -> None:
    print("detector moved aside by a part of its half width; object out to 0.95 of the field")
    print("shift " + "".join(f"{f'yaw {yaw} deg':>14}" for yaw in (0, 20, -40)))
    for part in (0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95):
        line = f"{part:5.2f} "
        for yaw in np.deg2rad((0.0, 20.0, -40.0)):
            far = max(
                np.arctan2((part + s) * HALF * np.cos(yaw), SDD + (part + s) * HALF * np.sin(yaw))
                for s in (1.0, -1.0)
            )
            radius = 0.95 * SOD * np.sin(abs(far))
            try:
                found = layer(
                    [Solid(Cylinder((0, 0, 0), radius, 400.0), "a", MU)],
                    scan(views, part * HALF, yaw),
                    radius,
                )
            except ValueError as error:
                line += f"{str(error)[:12]:>14}"
                continue
            line += f"{100 * (found[distance() < 0.9].mean() - 1.0):>+12.3f} %"
        print(line)


def prism(corners: int, radius: float) -> Shape:
    """An upright regular prism around a circle."""
    turn = 0.2 + 2.0 * np.pi * np.arange(corners) / corners
    normals = [(float(np.cos(t)), float(np.sin(t)), 0.0) for t in turn]
    return ConvexPolyhedron(
        (*normals, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)), (*[radius] * corners, 200.0, 200.0)
    )


def wider(views: int) -> None:
    print("\nobjects wider than the panel, error of the attenuation at r / field of view")
    print(f"{'':34}  0.0     0.5     0.9")
    geometry, r = scan(views), distance()
    rings = [(r >= low) & (r < high) for low, high in ((0.0, 0.15), (0.4, 0.6), (0.8, 0.95))]

    def row(name: str, solids: list[Solid], even: npt.NDArray[np.bool_]) -> FloatArray:
        found = layer(solids, geometry, FIELD)
        errors = np.array([100 * (found[ring & even].mean() - 1.0) for ring in rings])
        if name:
            print(f"{name:34}" + "".join(f"{e:+6.2f} %" for e in errors))
        return errors

    everywhere = np.ones_like(r, dtype=bool)
    for wide in (1.05, 1.11, 1.43, 2.0):
        f = wide * FIELD
        shapes: dict[str, Shape] = {
            "cylinder": Cylinder((0, 0, 0), f, 400.0),
            "box": Box((0, 0, 0), (2 * f, 2.5 * f, 400.0)),
            "hexagon": prism(6, f),
            "triangle": prism(3, f),
        }
        for name, shape in shapes.items():
            row(f"{name}, {wide} of the field", [Solid(shape, "a", MU)], everywhere)
    rng = np.random.default_rng(1)
    at = (np.arange(121) - 60) * 2.0 * FIELD / 121
    x, y = np.meshgrid(at, at)
    worst = []
    for _ in range(20):
        half = FIELD * rng.uniform(1.05, 2.0), FIELD * rng.uniform(0.8, 2.0)
        place = FIELD * rng.uniform(-0.2, 0.2, 2)
        solids = [Solid(Ellipsoid((*place.tolist(), 0.0), (*half, 1e5)), "a", MU)]
        outer = ((x - place[0]) / half[0]) ** 2 + ((y - place[1]) / half[1]) ** 2
        even = outer < 0.95
        for _ in range(rng.integers(0, 5)):
            axes, spot = FIELD * rng.uniform(0.05, 0.25, 2), FIELD * rng.uniform(-0.6, 0.6, 2)
            tall = (float(axes[0]), float(axes[1]), 1e5)
            solids.append(Solid(Ellipsoid((*spot.tolist(), 0.0), tall), "b",
                                MU * float(rng.uniform(-0.8, 2.0))))  # fmt: skip
            inner = ((x - spot[0]) / axes[0]) ** 2 + ((y - spot[1]) / axes[1]) ** 2
            even &= inner > 1.3
        worst.append(np.abs(row("", solids, even)))
    print(f"{'20 random ones, median':34}" + "".join(f"{e:6.2f} %" for e in np.median(worst, 0)))
    print(f"{'20 random ones, worst':34}" + "".join(f"{e:6.2f} %" for e in np.max(worst, 0)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=360)
    options = parser.parse_args()
    moved_aside(options.views)
    wider(options.views)
