"""FDK at the edges of the panel: `python examples/research/fdk_edges.py`.

Two tables. A detector moved aside, level and turned about the vertical, with an object out to 0.95
of the field of view: mean error of flat regions. Objects wider than the panel (cylinders, boxes, a
hexagon, a triangle, and random ellipses with other materials in them): error in the middle, at half
the field of view's radius and near its border. Projections are exact path lengths of the solids.

`--rtk` does the same with itk-rtk's FDK (`pip install itk-rtk`) and writes its figures behind ours:
its weights for displaced detectors; for wide objects its filter's truncation correction of 0.5. It
has no yawed panels.
"""

from __future__ import annotations

import argparse
import warnings

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
CELLS = 121
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


def layers(
    solids: list[Solid], geometry: ConeVec, radius: float, rtk: float | None, wide: bool = False
) -> list[FloatArray]:
    """The middle layer of the reconstruction out to `radius`, in units of MU.

    And RTK's, for a level panel moved aside by so much [mm].
    """
    images = project_scene(Scene(tuple(solids)), geometry, (ROWS, COLS))
    grid = Grid((1, CELLS, CELLS), 2.0 * radius / CELLS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # outlines that are not understood: the table shows them
        found = [np.asarray(fdk(images, geometry, grid.blank()).data[0] / MU, dtype=np.float64)]
    return found if rtk is None else [*found, by_rtk(images, rtk, grid.voxel_mm, wide)]


def by_rtk(images: npt.NDArray[np.float32], aside: float, size: float, wide: bool) -> FloatArray:
    """RTK's middle layer; its y is up, and its detector rows grow upwards."""
    import itk  # here, so that --help needs no peer
    from itk import RTK

    geometry = RTK.ThreeDCircularProjectionGeometry.New()
    for i in range(len(images)):
        geometry.AddProjection(SOD, SDD, -360.0 * i / len(images))
    stack = itk.image_from_array(np.ascontiguousarray(images[:, ::-1], dtype=np.float32))
    stack.SetSpacing([PITCH, PITCH, 1.0])
    stack.SetOrigin([aside - (COLS - 1) / 2 * PITCH, -(ROWS - 1) / 2 * PITCH, 0.0])
    kind = type(stack)
    displaced = RTK.DisplacedDetectorImageFilter[kind].New()
    displaced.SetInput(stack)
    displaced.SetGeometry(geometry)
    empty = RTK.ConstantImageSource[kind].New()
    empty.SetOrigin([-(CELLS - 1) / 2 * size, 0.0, -(CELLS - 1) / 2 * size])
    empty.SetSpacing([size] * 3)
    empty.SetSize([CELLS, 1, CELLS])
    empty.SetConstant(0.0)
    filters = RTK.FDKConeBeamReconstructionFilter[kind].New()
    filters.SetInput(0, empty.GetOutput())
    filters.SetInput(1, displaced.GetOutput())
    filters.SetGeometry(geometry)
    if wide:
        filters.GetRampFilter().SetTruncationCorrection(0.5)
    filters.Update()
    return np.asarray(itk.array_from_image(filters.GetOutput())[:, 0] / MU, dtype=np.float64)


def distance() -> FloatArray:
    """From the axis, relative to the half width of a layer, (CELLS, CELLS)."""
    at = (np.arange(CELLS) - (CELLS - 1) / 2) * 2.0 / CELLS
    return np.asarray(np.hypot(at[:, None], at))


def moved_aside(views: int, rtk: bool) -> None:
    print("detector moved aside by a part of its half width; object out to 0.95 of the field")
    print(
        "shift "
        + "".join(f"{f'yaw {yaw} deg':>14}" for yaw in (0, 20, -40))
        + "     RTK, yaw 0" * rtk
    )
    for part in (0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95):
        line, theirs = f"{part:5.2f} ", ""
        for yaw in np.deg2rad((0.0, 20.0, -40.0)):
            far = max(
                np.arctan2((part + s) * HALF * np.cos(yaw), SDD + (part + s) * HALF * np.sin(yaw))
                for s in (1.0, -1.0)
            )
            radius = 0.95 * SOD * np.sin(abs(far))
            try:
                found = layers(
                    [Solid(Cylinder((0, 0, 0), radius, 400.0), "a", MU)],
                    scan(views, part * HALF, yaw),
                    radius,
                    part * HALF if rtk and not yaw else None,
                )
            except ValueError as error:
                line += f"{str(error)[:12]:>14}"
                continue
            errors = [100 * (each[distance() < 0.9].mean() - 1.0) for each in found]
            line += f"{errors[0]:>+12.3f} %"
            theirs += "".join(f"{error:>+13.3f} %" for error in errors[1:])
        print(line + theirs)


def prism(corners: int, radius: float) -> Shape:
    """An upright regular prism around a circle."""
    turn = 0.2 + 2.0 * np.pi * np.arange(corners) / corners
    normals = [(float(np.cos(t)), float(np.sin(t)), 0.0) for t in turn]
    return ConvexPolyhedron(
        (*normals, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)), (*[radius] * corners, 200.0, 200.0)
    )


def wider(views: int, rtk: bool) -> None:
    print("\nobjects wider than the panel, error of the attenuation at r / field of view")
    print(f"{'':34}   0.0      0.5      0.9" + "        RTK: 0.0      0.5      0.9" * rtk)
    geometry, r = scan(views), distance()
    rings = [(r >= low) & (r < high) for low, high in ((0.0, 0.15), (0.4, 0.6), (0.8, 0.95))]

    def row(name: str, solids: list[Solid], even: npt.NDArray[np.bool_]) -> FloatArray:
        found = layers(solids, geometry, FIELD, 0.0 if rtk else None, wide=True)
        errors = np.array([100 * (f[ring & even].mean() - 1.0) for f in found for ring in rings])
        if name:
            print(f"{name:34}{figures(errors)}")
        return errors

    def figures(errors: FloatArray) -> str:
        words = [f"{e:+7.2f} %" for e in errors]
        return "".join(words[:3]) + "      " * rtk + "".join(words[3:])

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
    at = (np.arange(CELLS) - (CELLS - 1) / 2) * 2.0 * FIELD / CELLS
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
    print(f"{'20 random ones, median':34}{figures(np.median(worst, 0))}")
    print(f"{'20 random ones, worst':34}{figures(np.max(worst, 0))}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=360)
    parser.add_argument("--rtk", action="store_true", help="itk-rtk's figures beside ours")
    options = parser.parse_args()
    moved_aside(options.views, options.rtk)
    wider(options.views, options.rtk)
