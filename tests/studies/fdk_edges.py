"""FDK at the edges of the panel: `python tests/studies/fdk_edges.py`.

Four tables. A detector moved aside, level and turned about the vertical, with an object out to
0.95 of the field of view: mean error of flat regions. Objects wider than the panel (cylinders,
boxes, a hexagon, a triangle, and random ellipses with other materials in them): error in the
middle, at half the field of view's radius and near its border. Drawn ellipses, boxes and
irregular polygons wider than the panel with things of drawn sizes in them (`--count` of each):
how many are right within 1 % at half the radius, how many are warned of, how many of these were
right (false alarms), and how many are neither. Panels
rolled, pitched and yawed, with a ball that holds eight smaller ones: mean error and root mean
square error of voxels away from surfaces, width of the smaller balls' edges (10 to 90 %), and
noise. Projections are exact path lengths of the solids, means of 3 x 3 rays a pixel in the last
table.

`--rtk` does the same with itk-rtk's FDK (`pip install itk-rtk`) and writes its figures behind
ours: its weights for displaced detectors; for wide objects its filter's truncation correction
of 0.5. The first table has RTK for level panels only, the third none. `--only tilted` (or
`aside`, `wider`, `told`) makes one table.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings

import numpy as np
import numpy.typing as npt
from scipy.optimize import curve_fit
from scipy.special import ndtr

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
    Sphere,
)
from flexdt.twin.reconstruction import fdk

SOD, SDD, COLS, ROWS, PITCH = 300.0, 600.0, 160, 16, 0.8  # mm
HALF = COLS * PITCH / 2
FIELD = SOD * np.sin(np.arctan2(HALF, SDD))
MU = 0.02  # 1/mm
CELLS = 121
FloatArray = npt.NDArray[np.float64]


def turned(vector: tuple[float, float, float], angles: FloatArray) -> FloatArray:
    """Turn a vector counter-clockwise about z, (n, 3)."""
    x, y, z = vector
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([c * x - s * y, s * x + c * y, np.full_like(c, z)], axis=1)


def scan(views: int, aside: float = 0.0, yaw: float = 0.0) -> ConeVec:
    """Make a full turn of `views`, with the panel moved `aside` along its rows [mm] and
    turned by `yaw` about the vertical [rad].
    """
    angles = np.linspace(0.0, 2.0 * np.pi, views, endpoint=False)
    u = (PITCH * np.cos(yaw), PITCH * np.sin(yaw), 0.0)
    return ConeVec.from_vectors(
        turned((0.0, -SOD, 0.0), angles), turned((aside, SDD - SOD, 0.0), angles),
        turned(u, angles), (0.0, 0.0, -PITCH),
    )  # fmt: skip


def layers(
    solids: list[Solid], geometry: ConeVec, radius: float, rtk: bool, wide: bool = False
) -> list[FloatArray]:
    """Reconstruct the middle layer out to `radius` [mm] by FDK, in units of MU.

    Args:
        solids: of the object.
        geometry: of the scan.
        radius: half the side of the layer [mm].
        rtk: also by RTK.
        wide: with RTK's correction of truncation.

    Returns:
        The layer (CELLS, CELLS), and RTK's if requested.
    """
    images = project_scene(Scene(tuple(solids)), geometry, (ROWS, COLS))
    grid = Grid((1, CELLS, CELLS), 2.0 * radius / CELLS)
    layer = fdk(images, geometry, grid.blank(), errors=False).data[0]
    found = [np.asarray(layer / MU, dtype=np.float64)]
    return [*found, by_rtk(images, geometry, grid, wide)[0]] if rtk else found


def by_rtk(
    images: npt.NDArray[np.float32], geometry: ConeVec, grid: Grid, wide: bool = False
) -> FloatArray:
    """Reconstruct by RTK's FDK with the geometry file made for it, in units of MU.

    RTK's (x, y, z) is our (x, z, -y); the volume is turned back to (z, y, x).

    Args:
        images: (n, rows, cols).
        geometry: n views.
        grid: of the volume.
        wide: correct truncation.
    """
    import itk  # here, so that --help needs no peer
    from itk import RTK

    with tempfile.TemporaryDirectory() as folder:
        geometry.to_rtk(f"{folder}/scan.xml")
        reader = RTK.ThreeDCircularProjectionGeometryXMLFileReader.New()
        reader.SetFilename(f"{folder}/scan.xml")
        reader.GenerateOutputInformation()
    stack = itk.image_from_array(np.ascontiguousarray(images, dtype=np.float32))
    rows, cols = images.shape[1:]
    stack.SetSpacing([PITCH, PITCH, 1.0])
    stack.SetOrigin([-(cols - 1) / 2 * PITCH, -(rows - 1) / 2 * PITCH, 0.0])
    kind = type(stack)
    displaced = RTK.DisplacedDetectorImageFilter[kind].New()
    displaced.SetInput(stack)
    displaced.SetGeometry(reader.GetOutputObject())
    empty = RTK.ConstantImageSource[kind].New()
    size = [grid.shape[i] for i in (2, 0, 1)]
    empty.SetOrigin([-(n - 1) / 2 * grid.voxel_mm for n in size])
    empty.SetSpacing([grid.voxel_mm] * 3)
    empty.SetSize(size)
    empty.SetConstant(0.0)
    filters = RTK.FDKConeBeamReconstructionFilter[kind].New()
    filters.SetInput(0, empty.GetOutput())
    filters.SetInput(1, displaced.GetOutput())
    filters.SetGeometry(reader.GetOutputObject())
    if wide:
        filters.GetRampFilter().SetTruncationCorrection(0.5)
    filters.Update()
    volume = itk.array_from_image(filters.GetOutput())[::-1].transpose(1, 0, 2)
    return np.asarray(volume / MU, dtype=np.float64)


def distance() -> FloatArray:
    """From the axis, relative to the half width of a layer, (CELLS, CELLS)."""
    at = (np.arange(CELLS) - (CELLS - 1) / 2) * 2.0 / CELLS
    return np.asarray(np.hypot(at[:, None], at))


def layer() -> tuple[FloatArray, FloatArray]:
    """x and y of the pixels of a layer of the whole field of view, (CELLS, CELLS) [mm]."""
    at = (np.arange(CELLS) - (CELLS - 1) / 2) * 2.0 * FIELD / CELLS
    x, y = np.meshgrid(at, at)
    return x, y


def moved_aside(views: int, rtk: bool) -> None:
    """Print the error of a cylinder's attenuation [%] for panels moved aside and yawed,
    and RTK's without yaw.
    """
    print(
        "detector moved aside by a part of its half width; object out to 0.95 of the field"
    )
    print(
        "shift "
        + "".join(f"{f'yaw {yaw} deg':>14}" for yaw in (0, 20, -40))
        + "     RTK, yaw 0" * rtk
    )
    for part in (0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95):
        line, theirs = f"{part:5.2f} ", ""
        for yaw in np.deg2rad((0.0, 20.0, -40.0)):
            far = max(
                np.arctan2(
                    (part + s) * HALF * np.cos(yaw), SDD + (part + s) * HALF * np.sin(yaw)
                )
                for s in (1.0, -1.0)
            )
            radius = 0.95 * SOD * np.sin(abs(far))
            try:
                found = layers(
                    [Solid(Cylinder((0, 0, 0), radius, 400.0), "a", MU)],
                    scan(views, part * HALF, yaw),
                    radius,
                    rtk and not yaw,
                )
            except ValueError as error:
                line += f"{str(error)[:12]:>14}"
                continue
            errors = [100 * (each[distance() < 0.9].mean() - 1.0) for each in found]
            line += f"{errors[0]:>+12.3f} %"
            theirs += "".join(f"{error:>+13.3f} %" for error in errors[1:])
        print(line + theirs)


def prism(corners: int, radius: float) -> Shape:
    """Build an upright regular prism around a circle of `radius` [mm]."""
    turn = 0.2 + 2.0 * np.pi * np.arange(corners) / corners
    normals = [(float(np.cos(t)), float(np.sin(t)), 0.0) for t in turn]
    return ConvexPolyhedron(
        (*normals, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)), (*[radius] * corners, 200.0, 200.0)
    )


OUTLINES = ("ellipse", "box", "polygon")
INSIDE = {
    "nothing": (0, (0.0, 0.0), (0.0, 0.0)),
    "three of any density": (3, (0.05, 0.25), (-0.8, 2.0)),
    "four dense": (4, (0.05, 0.25), (0.6, 2.0)),
    "five voids": (5, (0.15, 0.35), (-1.0, -0.6)),
    "five large voids": (5, (0.2, 0.5), (-1.0, -0.8)),
}
"""How many ellipses, their half axes over the field of view's radius, and their attenuation
over the object's own; where voids overlap, a voxel may have less than none."""


def put_in(
    solids: list[Solid],
    count: int,
    sizes: tuple[float, float],
    densities: tuple[float, float],
    rng: np.random.Generator,
) -> npt.NDArray[np.bool_]:
    """Append drawn ellipses to `solids`.

    Args:
        solids: gets them.
        count: number.
        sizes: least and largest half axis, in fields of view.
        densities: least and largest, in MU.
        rng: generator.

    Returns:
        (CELLS, CELLS), True where a layer has none of them.
    """
    x, y = layer()
    outside = np.ones_like(x, dtype=bool)
    for _ in range(count):
        axes, spot = FIELD * rng.uniform(*sizes, 2), FIELD * rng.uniform(-0.6, 0.6, 2)
        thing = Ellipsoid((*spot.tolist(), 0.0), (*axes.tolist(), 1e5))
        solids.append(Solid(thing, "b", MU * float(rng.uniform(*densities))))
        outside &= ((x - spot[0]) / axes[0]) ** 2 + ((y - spot[1]) / axes[1]) ** 2 > 1.3
    return outside


def wider(views: int, rtk: bool) -> None:
    """Print the errors of the attenuation of objects wider than the panel [%], in three
    rings of the field of view, and RTK's.
    """
    print("\nobjects wider than the panel, error of the attenuation at r / field of view")
    print(f"{'':34}   0.0      0.5      0.9" + "        RTK: 0.0      0.5      0.9" * rtk)
    geometry, r = scan(views), distance()
    rings = [
        (r >= low) & (r < high) for low, high in ((0.0, 0.15), (0.4, 0.6), (0.8, 0.95))
    ]

    def row(name: str, solids: list[Solid], even: npt.NDArray[np.bool_]) -> FloatArray:
        """Reconstruct an object and return the errors [%] in each ring, RTK's after ours;
        with a name print them, too.
        """
        found = layers(solids, geometry, FIELD, rtk, wide=True)
        errors = np.array(
            [100 * (f[ring & even].mean() - 1.0) for f in found for ring in rings]
        )
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
    x, y = layer()
    worst = []
    for _ in range(20):
        half = FIELD * rng.uniform(1.05, 2.0), FIELD * rng.uniform(0.8, 2.0)
        place = FIELD * rng.uniform(-0.2, 0.2, 2)
        solids = [Solid(Ellipsoid((*place.tolist(), 0.0), (*half, 1e5)), "a", MU)]
        outer = ((x - place[0]) / half[0]) ** 2 + ((y - place[1]) / half[1]) ** 2
        even = outer < 0.95
        even &= put_in(
            solids, int(rng.integers(0, 5)), *INSIDE["three of any density"][1:], rng
        )
        worst.append(np.abs(row("", solids, even)))
    print(f"{'20 random ones, median':34}{figures(np.median(worst, 0))}")
    print(f"{'20 random ones, worst':34}{figures(np.max(worst, 0))}")


def drawn(
    outline: str, inside: str, rng: np.random.Generator
) -> tuple[list[Solid], npt.NDArray[np.bool_]]:
    """Draw an object wider than the field of view.

    Args:
        outline: of OUTLINES.
        inside: key of INSIDE.
        rng: generator.

    Returns:
        Its solids, and (CELLS, CELLS), True where a layer is of the body's own material.
    """
    x, y = layer()
    turn, place = rng.uniform(0.0, np.pi), FIELD * rng.uniform(-0.2, 0.2, 2)
    if outline == "polygon":
        corners = int(rng.integers(4, 9))
        turns = (
            turn
            + 2
            * np.pi
            * (np.arange(corners) + rng.uniform(-0.25, 0.25, corners))
            / corners
        )
        far = FIELD * rng.uniform(1.0, 1.9, corners)
    else:
        turns, half = turn + np.pi / 2 * np.arange(4), FIELD * rng.uniform(1.05, 2.0, 2)
        far = np.tile(half, 2) + place[0] * np.cos(turns) + place[1] * np.sin(turns)
    c, s = np.cos(turns), np.sin(turns)
    if outline == "ellipse":
        axes = tuple((float(a), float(b), 0.0) for a, b in zip(c[:2], s[:2], strict=True))
        body: Shape = Ellipsoid(
            (*place.tolist(), 0.0),
            (*half.tolist(), 1e5),
            (axes[0], axes[1], (0.0, 0.0, 1.0)),
        )
        u, v = x - place[0], y - place[1]
        along = [(u * c[i] + v * s[i]) / half[i] for i in (0, 1)]
        even = along[0] ** 2 + along[1] ** 2 < 0.95
    else:
        normals = [(float(a), float(b), 0.0) for a, b in zip(c, s, strict=True)]
        body = ConvexPolyhedron(
            (*normals, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)), (*far.tolist(), 1e5, 1e5)
        )
        even = np.all(
            [a * x + b * y < d - 1 for a, b, d in zip(c, s, far, strict=True)], axis=0
        )
    solids = [Solid(body, "a", MU)]
    return solids, even & put_in(solids, *INSIDE[inside], rng)


def told(views: int, count: int) -> None:
    """Reconstruct drawn objects of each outline and content, and print errors, warnings
    and bounds in a ring of the field of view.

    Args:
        views: of the turn.
        count: objects of each kind.
    """
    print(
        f"\n{count} drawn objects of each kind: right within 1 %, warned of, warned of and "
        "right, beyond the bound (largest error, largest bound)"
    )
    geometry, r = scan(views), distance()
    ring = (r >= 0.4) & (r < 0.6)
    for outline in OUTLINES:
        for inside in INSIDE:
            rows = []
            for seed in range(count):
                kind = [OUTLINES.index(outline), list(INSIDE).index(inside)]
                solids, even = drawn(
                    outline, inside, np.random.default_rng([seed, *kind])
                )
                images = project_scene(Scene(tuple(solids)), geometry, (2, COLS))
                grid = Grid((1, CELLS, CELLS), 2.0 * FIELD / CELLS)
                with warnings.catch_warnings(record=True) as said:
                    warnings.simplefilter("always")
                    volume = fdk(images, geometry, grid.blank())
                assert volume.bias_bound is not None
                there = ring & even
                mean, bound = (
                    float(each[0][there].mean()) / MU
                    for each in (volume.data, volume.bias_bound)
                )
                rows.append([abs(mean - 1.0), bound, bool(said)])
            error, most, warned = np.array(rows).T
            print(
                f"{outline + ', ' + inside:32}{np.sum(error <= 0.01):4}{np.sum(warned > 0):6}"
                f"{np.sum((warned > 0) & (error <= 0.01)):6}{np.sum(error > most):6}"
                f"{100 * error.max():8.2f} %{100 * most.max():8.2f} %",
                flush=True,
            )


TILTS = ((0, 0, 0), (2, 0, 0), (0, 3, 0), (0, 0, 4), (2, 3, 4), (15, 0, 0), (5, -8, 15))
"""Roll, pitch and yaw [deg]."""
SIDE, VOXEL, TALL = 130, 0.4, 128  # voxels a side, mm, rows
BODY = 24.0  # mm


def tilted(views: int, rtk: bool) -> None:
    """Print errors [%], edge width [voxels] and noise [%] of FDK with rolled, pitched and
    yawed panels, and RTK's.
    """
    print(
        "\npanels rolled, pitched and yawed: mean and rms error, edge in voxels, noise"
        + ", RTK" * rtk
    )
    rng = np.random.default_rng(3)
    balls: list[tuple[FloatArray, float, float]] = []
    while len(balls) < 8:
        place, radius = (
            rng.uniform(-16, 16, 3) * (1.0, 1.0, 0.8),
            float(rng.uniform(2.5, 4.5)),
        )
        if np.linalg.norm(place) + radius < BODY - 2 and all(
            np.linalg.norm(place - p) > radius + r + 1.5 for p, r, _ in balls
        ):
            balls.append((place, radius, float(rng.choice([-0.8, -0.5, 0.6, 1.2]))))
    solids = [Solid(Sphere((0, 0, 0), BODY), "a", MU)]
    for (px, py, pz), radius, part in balls:
        solids.append(
            Solid(Sphere((float(px), float(py), float(pz)), radius), "b", MU * part)
        )
    at = (np.arange(SIDE) - (SIDE - 1) / 2) * VOXEL
    z, y, x = np.meshgrid(at, at, at, indexing="ij")
    body = np.sqrt(x**2 + y**2 + z**2) - BODY
    truth, far = (body < 0) * 1.0, np.abs(body)
    away = []
    for (px, py, pz), radius, part in balls:
        away.append(np.sqrt((x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2) - radius)
        truth += part * (away[-1] < 0)
        far = np.minimum(far, np.abs(away[-1]))
    flat = (far > 3 * VOXEL) & (truth > 0) & (np.abs(z) < 18)

    def edge(volume: FloatArray) -> float:
        """Fit the edges of all balls in a volume, and return their mean width, 10 to 90 %
        [voxels].
        """
        widths = []
        for off, (_, _, part) in zip(away, balls, strict=True):
            near = np.abs(off) < 4 * VOXEL
            found, _ = curve_fit(
                lambda d, out, step, middle, sigma: out + step * ndtr((middle - d) / sigma),
                off[near] / VOXEL, volume[near], (1.0, part, 0.0, 0.5),
            )  # fmt: skip
            widths.append(2.563 * abs(found[3]))
        return float(np.mean(widths))

    grid, rays = Grid((SIDE,) * 3, VOXEL), 3
    for tilts in TILTS:
        scan = ConeVec.circular(
            sod=SOD, sdd=SDD, angles=views, shape=(TALL, COLS), pixel=PITCH, tilts=tilts
        )
        fine = ConeVec.from_vectors(
            scan.source, scan.detector, scan.u / rays, scan.v / rays
        )
        many = project_scene(Scene(tuple(solids)), fine, (TALL * rays, COLS * rays))
        images = many.reshape(views, TALL, rays, COLS, rays).mean(axis=(2, 4))
        noise = rng.normal(0.0, 0.01, images.shape).astype(np.float32)
        line = f"{tilts!s:12}"
        for theirs in (False, True)[: 1 + rtk]:
            found, grain = (
                by_rtk(im, scan, grid)
                if theirs
                else fdk(im, scan, grid, errors=False).data / MU
                for im in (images, noise)
            )
            error = 100 * (found - truth)[flat]
            line += (
                f"{error.mean():+9.2f} %{np.sqrt((error**2).mean()):6.2f} %{edge(found):7.3f}"
                f"{100 * grain[flat].std():7.2f} %"
            )
        print(line, flush=True)


TABLES = ("aside", "wider", "told", "tilted")

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=360)
    parser.add_argument(
        "--rtk", action="store_true", help="itk-rtk's figures beside ours"
    )
    parser.add_argument("--only", choices=TABLES, help="one table; default: all")
    parser.add_argument(
        "--count", type=int, default=10, help="drawn objects of each kind"
    )
    options = parser.parse_args()
    if options.only in (None, "aside"):
        moved_aside(options.views, options.rtk)
    if options.only in (None, "wider"):
        wider(options.views, options.rtk)
    if options.only in (None, "told"):
        told(options.views, options.count)
    if options.only in (None, "tilted"):
        tilted(options.views, options.rtk)
