"""CTSimU scenarios beside images that BAM published, and by the evaluations that `ctsimu`
ships.

    python tests/studies/ctsimu_scenarios.py published CHECKOUT
    python tests/studies/ctsimu_scenarios.py evaluate FOLDER [TEST...]  # needs ctsimu
    python tests/studies/ctsimu_scenarios.py wedges FOLDER       # likewise

`published` simulates the examples of a checkout of github.com/BAMresearch/ctsimu-scenarios and
compares every projection with the one that aRTist made of it. `evaluate` simulates scenarios
that `ctsimu` ships or describes, lets it evaluate the images and prints what it finds: 2D-FB-1,
2D-FB-2, 2D-DW-1, 2D-HS-1, 2D-SW-3, 2D-WE-1, 2D-WE-2. Their meshes and spectra are not public:
edges are blocks of tungsten whose sides run towards the source, the wires those of ISO 19232-5,
the foil has holes where its evaluation expects their shadows, the two halves of the step wedge
are as their documentation draws them, the spectra are ours. `wedges` is 2D-SW-1 and 2D-SW-2,
primary radiation: spherical steps as their documentation draws them, thicknesses from the ideal
detector at one energy, spectra ours behind as much aluminium as fits the ideal detector; then
all CsI and GOS cases beside ROSI and McRay, and how far spectra within 20 % of ours that fit
the ideal detector, too, move them. For 2D-SW-4 nobody says what sample and geometry are, and
`testTwin` evaluates lengths that somebody measured, not images.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import re
import sys
import types
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import trimesh
from scipy.optimize import linprog, minimize_scalar

from flexdt.phantoms.mesh_booleans import cut
from flexdt.phantoms.pieces import Surface
from flexdt.twin.attenuation.substances import Substance, tables
from flexdt.twin.errors import TwinError
from flexdt.twin.physics.scintillator import deposited
from flexdt.twin.physics.tube import ALUMINIUM, Filter, TubeModel, tube_spectrum
from flexdt.twin.projection.analytic_solids import Scene
from flexdt_extensions.ctsimu.scenario import ScenarioImages

ENERGY = tables().energy_keV
PANEL_MM = 345.0
WIRES = (0.8, 0.63, 0.5, 0.4, 0.32, 0.25, 0.2, 0.16, 0.13, 0.1, 0.08, 0.063, 0.05)


MANY_RAYS = 15
"""Along each side of a pixel, for what a pixel integrates."""


def published(checkout: Path) -> None:
    """Differences in grey values, of about 50 000 in the open beam; then both beside many
    rays."""
    for path in sorted(checkout.glob("examples/*/*.json")):
        try:
            images, finer = ScenarioImages(path), ScenarioImages(path, rays=MANY_RAYS)
        except TwinError as error:
            print(f"{path.stem:32s} refused: {str(error).partition(': ')[2]}")
            continue
        apart, most = [], 0.0
        for i, (ours, truth) in enumerate(
            zip(images.projections(), finer.projections(), strict=True)
        ):
            theirs = tifffile.imread(
                path.parent / "projections" / f"{path.stem}_{i:04d}.tif"
            )
            one, two, three = (
                image.astype(np.float64) for image in (ours, theirs, truth)
            )
            apart.append((one - two, one - three, two - three))
            most = max(most, float(theirs.max()))
        found = np.array(apart)
        rms = np.sqrt((found**2).mean(axis=(0, 2, 3)))
        print(f"{path.stem:32s} {len(found)} images, at most {most:.0f}: rms {rms[0]:.1f}, mean "
              f"{found[:, 0].mean():+.1f}, worst pixel {np.abs(found[:, 0]).max():.0f}; beside "
              f"{MANY_RAYS} x {MANY_RAYS} rays a pixel ours {rms[1]:.1f}, theirs {rms[2]:.1f}",
              flush=True)  # fmt: skip


def beam(kV: float, aluminium: float) -> np.ndarray[Any, Any]:
    """Photons of each energy, our tungsten spectrum behind aluminium [mm]."""
    return tube_spectrum(kV, TubeModel((Filter(ALUMINIUM, aluminium),))).fluence


def write_spectrum(path: Path, photons: np.ndarray[Any, Any]) -> None:
    np.savetxt(path, np.column_stack([ENERGY, photons * 1e4]))


def between(
    corners: Sequence[Sequence[float]], near: float, far: float
) -> trimesh.Trimesh:
    """The cone from the origin through a convex polygon (y, z) at x = 1, from x = near to
    far."""
    ring = np.array([[1.0, y, z] for y, z in corners])
    hull = trimesh.convex.convex_hull(np.concatenate([near * ring, far * ring]))
    assert isinstance(hull, trimesh.Trimesh)
    return hull


def shipped(
    name: str, folder: Path, mesh: trimesh.Trimesh | None = None
) -> dict[str, Any]:
    """A scenario of the package with our mesh in its place; `mesh` has the world's
    coordinates."""
    text = (
        resources.files("ctsimu") / "evaluation" / "scenarios" / f"{name}.json"
    ).read_text(encoding="utf-8-sig")
    document: dict[str, Any] = json.loads(text)
    spectrum = document["source"]["spectrum"]["file"]["value"]
    if spectrum:
        write_spectrum(
            folder / spectrum, beam(document["source"]["voltage"]["value"], 4.0)
        )
    if mesh is not None:
        sample = document["samples"][0]
        mesh.export(folder / sample["file"]["value"])
        middle = mesh.bounds.mean(axis=0)
        for a, x in zip("uvw", middle, strict=True):
            stage = document["geometry"]["stage"]["center"]["xyz"["uvw".index(a)]][
                "value"
            ]
            sample["position"]["center"][a]["value"] = x - stage
    return document


def simulated(folder: Path, name: str, document: dict[str, Any], rays: int) -> str:
    path = folder / f"{name}.json"
    path.write_text(json.dumps(document))
    images = ScenarioImages(path, seed=1, rays=rays)
    for text in images.scan.notes:
        print(f"  {name}: {text}")
    return str(images.write(folder / name))


def evaluated(test: str, metadata: dict[str, str]) -> str:
    """What an evaluation of `ctsimu` writes about images, all its text files."""
    # It imports reportlab, which it does not install, for reports that are not made here.
    for name in ("reportlab", "reportlab.lib", "reportlab.lib.colors"):
        sys.modules.setdefault(name, types.ModuleType(name))
    sys.modules["reportlab.lib"].colors = None  # type: ignore[attr-defined]
    from ctsimu.evaluation import test2D_HS_1 as holes
    from ctsimu.geometry import Geometry
    from ctsimu.primitives import Vector
    from ctsimu.toolbox import Toolbox

    if test.startswith("2D-WE"):
        Geometry.create_detector_flat_field_sphere = analytic(
            Path(min(metadata.values()))
        )
    # 2D-HS-1 multiplies text by truth values, which numpy 2 allows of Python's own only.
    for owner, name in (
        (Vector, "distance"),
        (Vector, "angle"),
        (holes, "list_mean_and_stddev"),
    ):
        inner = getattr(owner, name)
        if not hasattr(inner, "plainly"):
            setattr(owner, name, plain(inner))
    with contextlib.redirect_stdout(io.StringIO()):
        Toolbox(test, *([metadata[""]] if "" in metadata else []),
                **{key: path for key, path in metadata.items() if key})  # fmt: skip
    folders = [Path(path).parent / f"{test}-results" for path in metadata.values()]
    files = sorted(path for folder in folders for path in folder.glob("*.txt"))
    return "\n".join(path.read_text() for path in files)


def analytic(metadata: Path) -> Callable[..., Any]:
    """`ctsimu`'s own image of its edge, which takes it a quarter of an hour, kept in a file.

    2D-WE-1 and 2D-WE-2 have the same edge, panel and source.
    """
    from ctsimu.geometry import Geometry
    from ctsimu.image import Image

    inner, kept = (
        Geometry.create_detector_flat_field_sphere,
        metadata.parents[1] / "edge.npz",
    )
    if hasattr(inner, "kept"):
        return inner  # type: ignore[no-any-return]

    def call(self: Any, *cover: Any) -> tuple[Any, Any]:
        if not kept.exists():
            np.savez(kept, *(one.px for one in inner(self, *cover)))
        images = []
        for pixels in np.load(kept).values():
            images.append(Image())
            images[-1].px = pixels
            images[-1].height, images[-1].width = pixels.shape
        return images[0], images[1]

    call.kept = True  # type: ignore[attr-defined]
    return call


def plain(inner: Callable[..., Any]) -> Callable[..., Any]:
    """The function with Python's own numbers as its result."""

    def call(*given: Any, **named: Any) -> Any:
        found = inner(*given, **named)
        return tuple(map(float, found)) if isinstance(found, tuple) else float(found)

    call.plainly = True  # type: ignore[attr-defined]
    return call


def quarter(pitch: float) -> trimesh.Trimesh:
    """The quarter of the panel left of and below its middle, turned by 3 degrees."""
    reach, turn = 1.5 * pitch * 501.0 / 1000.0, math.radians(3.0)
    square = [(0, 0), (0, reach), (-reach, reach), (-reach, 0)]
    turned = [(x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn))
              for x, y in square]  # fmt: skip
    return between([(-x, -y) for x, y in turned], 495.0, 505.0)


def duplex() -> trimesh.Trimesh:
    """Pairs of wires as far apart as they are thick, where the evaluation looks for them."""
    wires, at = [], -18.0
    tilt = trimesh.transformations.rotation_matrix(
        math.radians(3.0), [1, 0, 0], [998.6, 0, 0]
    )
    for d in WIRES:
        for k in (0, 2):
            wire = trimesh.creation.cylinder(d / 2.0, 15.0, sections=48)
            wires.append(wire.apply_translation([998.6, -(at + k * d + d / 2), 0]))
        at += 3.0 * d + 3.1
    return trimesh.util.concatenate(wires).apply_transform(tilt)


def foil(document: dict[str, Any]) -> trimesh.Trimesh:
    """The foil of 2D-HS-1 in its own coordinates: ten holes, seen as the evaluation wants them.

    Panel and sample are placed by ctsimu, so that ours has to place both alike.
    """
    from ctsimu.scenario import Scenario

    with contextlib.redirect_stdout(io.StringIO()):
        scenario = Scenario(json_dict=document)
        scenario.set_frame(0)
        geometry = scenario.current_geometry()
        geometry.update()

    def of(vector: Any) -> np.ndarray[Any, Any]:
        return np.array([vector.x(), vector.y(), vector.z()])

    panel, part = geometry.detector, scenario.samples[0].coordinate_system
    spots = [(160.0, 140.0, 133 * 0.15)]
    spots += [
        (y, z, 66 * 0.15) for y in (-205.0, 0.0, 205.0) for z in (-205.0, 0.0, 205.0)
    ]
    near, far = (at / 400.0 for at in (10.0, 10.01))
    whole = [trimesh.creation.box((480.0, 480.0, 1.0))]
    for u, v, radius in spots:
        hole = trimesh.creation.cylinder(radius, 3.0, sections=180)
        whole.append(hole.apply_translation([u, v, 0.0]))
    made = trimesh.boolean.difference(whole, engine="manifold")
    local = np.array(made.vertices)
    depth = np.where(local[:, 2] < 0.0, near, far)[:, None]
    # Walls of holes run towards the source, the rim does not: the middle of its box is the
    # foil's.
    rim = np.abs(local[:, :1]) > 239.0
    across = np.where(rim, 0.5 * (near + far), depth) * local[:, :2]
    world = depth * of(panel.center) + across @ np.stack([of(panel.u), of(panel.v)])
    axes = np.stack([of(part.u), of(part.v), of(part.w)])
    back = (world - of(part.center)) @ axes.T
    return trimesh.Trimesh(back, made.faces, process=False)


def halves() -> list[trimesh.Trimesh]:
    """The step wedge of 2D-SW-3 in two: between the upper steps a gap, below they overlap,
    where the right one takes the left one's place."""
    thick, pitch, step = (
        (41.0, 35.89, 30.79, 25.68, 20.58, 15.47, 10.36, 5.26, 0.15),
        0.4,
        1e3 / 11,
    )

    def seam(row: float) -> float:
        gap, slant = 5.0 / 3.0 * (4.0 - row / step), 10.0 / 3.0 * (7.0 - row / step)
        return 500.0 + max(gap, 0.0) + min(slant, 0.0)

    parts: tuple[list[trimesh.Trimesh], ...] = ([], [])
    for k, d in enumerate(thick):
        rows = [(10 - k - e) * step for e in (1e-4, 1 - 1e-4)]  # from below
        for part, left, right in ((0, (90.0,) * 2, (500.0,) * 2),
                                  (1, tuple(map(seam, rows)), (909.0,) * 2)):  # fmt: skip
            low, high = ((500.0 - row) * pitch / 1e3 for row in rows)
            y = [[(500.0 - at) * pitch / 1e3 for at in side] for side in (right, left)]
            parts[part].append(shell(d, 518.0, y[0], y[1], low, high))
    surfaces = [
        Surface(m.vertices, m.faces, "Al", 0.05)
        for m in map(trimesh.util.concatenate, parts)
    ]
    nothing = Scene(())
    _, found = cut([(nothing, [one], rank) for rank, one in enumerate(surfaces)])
    return [trimesh.Trimesh(one.vertices, one.faces, process=False) for one in found]


def case(folder: Path, test: str, only: str | None = None) -> str:
    """Simulates the scenarios of an evaluation and returns what it writes about the images."""
    names = {
        "2D-FB-1": {"SNR100": "2D-FB-1_Detektor1_SNR100_2021-05-25v06r00dp",
                    "SNR250": "2D-FB-1_Detektor2_SNR250_2021-05-25v06r00dp"},
        "2D-FB-2": {"": "2D-FB-2_2021-03-24v06r00dp"},
        "2D-DW-1": {"SR75": "2D-DW-1_Detektor1_2021-05-26v01r01dp",
                    "SR150": "2D-DW-1_Detektor2_2021-05-26v01r01dp"},
        "2D-HS-1": {"": "2D-HS-1_2021-03-24v02r00dp"},
        "2D-WE-1": {"spot1": "2D-WE-1_Spot1_2021-10-13v02r04dp",
                    "spot2": "2D-WE-1_Spot2_2021-10-13v02r04dp"},
        "2D-WE-2": {"": "2D-WE-2_2021-10-13v02r03dp"},
    }  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    metadata = {}
    if test == "2D-SW-3":
        meshes = halves()
        for key in ("Al_Al", "Al_Ti"):
            document = shipped(names["2D-FB-2"][""], folder)
            wedge(document, 80, None, 1000, 1000, 0.4)
            document["materials"] = materials({"Al": ("Al", 2.6989), "Ti": ("Ti", 4.506)})
            document["samples"] = []
            for side, mesh, metal in zip("lr", meshes, key.split("_"), strict=True):
                mesh.export(folder / f"{side}.stl")
                document["samples"].append(standing(f"{side}.stl", mesh, metal))
            metadata[key] = simulated(folder, key, document, 3)
        return evaluated(test, metadata)
    mesh = {"2D-DW-1": duplex, "2D-WE": lambda: quarter(0.008)}.get(
        test[:7] if test[3] == "D" else test[:5]
    )
    for key, name in names[test].items():
        if only not in (None, key):
            continue
        document = shipped(name, folder, mesh() if mesh else None)
        if test == "2D-HS-1":
            foil(document).export(folder / document["samples"][0]["file"]["value"])
        rays = {"D": 3, "H": 2, "W": 6}.get(test[3], 1)
        metadata[key] = simulated(folder, name.partition("_202")[0], document, rays)
    return evaluated(test, metadata)


def exact_area(folder: Path) -> str:
    """Ours and `ctsimu`'s own image of the edge beside the area that it leaves free, counted on
    200 x 200 points a pixel of all pixels that it covers in part."""
    ours = tifffile.imread(next((folder / "2D-WE-2" / "corrected").glob("*.tif")))
    flat, edge = np.load(folder / "edge.npz").values()
    theirs, turn = 6e4 * edge / flat, math.radians(3.0)
    part = (np.arange(200) + 0.5) / 200 - 500.5
    off = []
    for row, col in np.argwhere((theirs > 1.0) & (theirs < 59900.0)):
        x, y = col + part[None], row + part[:, None]
        across, down = (
            x * math.cos(turn) + y * math.sin(turn),
            y * math.cos(turn) - x * math.sin(turn),
        )
        free = 6e4 * (1.0 - ((across < 0.0) & (down > 0.0)).mean())
        off.append((ours[row, col] - free, theirs[row, col] - free))
    rms = np.sqrt((np.array(off) ** 2).mean(axis=0))
    return f"rms beside the exact area: ours {rms[0]:.0f}, its own {rms[1]:.0f}"


FOUND = {
    "2D-FB-1": (r"(SNR\d+):", r"projection SNR: +(\S+)"),
    "2D-FB-2": (r"Max Absolute GV Difference: (\S+)", r"RMS GV Difference: +(\S+)"),
    "2D-DW-1": (r"iSRb: (\S+)",),
    "2D-HS-1": (r"Mean scale deviation: +(\S+)", r"Mean rotation angle:.*= +(\S+) deg",
                r"Mean translation vector \[px\]: (.*)"),
    "2D-SW-3": (r"treated pixels: (\d+)", r"value anomalies: (\d+)"),
    "2D-WE-1": (r"(?i)(.*MTF ?20.*)", r"(?i)(.*sigma.*)"),
    "2D-WE-2": (r"# (.*(?:pixels|RMSD).*)",),
}  # fmt: skip
"""What is printed of an evaluation's texts."""


def evaluate(folder: Path, *tests: str) -> None:
    """Runs all evaluations or those named; `...-results` folders hold what they find."""
    for test in tests or FOUND:
        text = case(folder, test)
        print(test, *(re.findall(one, text) for one in FOUND[test]), flush=True)
        if test == "2D-WE-2":
            print(exact_area(folder))


def reference(number: int) -> np.ndarray[Any, Any]:
    """Primary grey values by step: ROSI, McRay, McRay's standard deviation, (10, 3)."""
    data = resources.files("ctsimu") / "evaluation" / "data"
    found = [
        p for p in data.iterdir() if p.name.startswith(f"2D-SW-1_scenario{number:02d}_")
    ]
    table = np.loadtxt(found[0].read_text().splitlines(), delimiter="\t")
    return np.asarray(table[:, [9, 12, 13]])


def shell(
    d: float,
    radius: float,
    left: Sequence[float],
    right: Sequence[float],
    low: float,
    high: float,
) -> trimesh.Trimesh:
    """A spherical shell about the source between z = low and high at x = 1; `left` and `right`
    are where it begins and ends there along y, at low and at high."""
    part = np.linspace(0.0, 1.0, 21)
    across, up = np.meshgrid(part, part)
    begin, end = (side[0] + (side[1] - side[0]) * up for side in (left, right))
    y, z = begin + (end - begin) * across, low + (high - low) * up
    way = np.stack([np.ones_like(y), y, z], axis=-1).reshape(-1, 3)
    way /= np.linalg.norm(way, axis=1)[:, None]
    n = np.arange(21 * 21).reshape(21, 21)
    a, b, c, e = (
        n[i : i + 20, j : j + 20].ravel() for i, j in ((0, 0), (0, 1), (1, 1), (1, 0))
    )
    outer = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, e], 1)])
    rim = np.concatenate([n[0, :-1], n[:-1, -1], n[-1, :0:-1], n[:0:-1, 0]])
    after, m = np.roll(rim, -1), 21 * 21
    sides = np.concatenate([np.stack([rim, rim + m, after + m], 1),
                            np.stack([rim, after + m, after], 1)])  # fmt: skip
    faces = np.concatenate([outer, outer[:, ::-1] + m, sides])
    corners = np.concatenate([radius * way, (radius - d) * way])
    return trimesh.Trimesh(corners, faces, process=False)


def steps(thick: np.ndarray[Any, Any], radius: float) -> trimesh.Trimesh:
    """Spherical shells about the source, the lowest the thickest; a hair of space between
    them."""
    parts, half = [], 0.5 * PANEL_MM / 1000.0
    for k, d in enumerate(thick):
        low, high = (-half + 2 * half * (k + e) / 10 for e in (1e-4, 1 - 1e-4))
        parts.append(shell(d, radius, (-0.05,) * 2, (0.05,) * 2, low, high))
    return trimesh.util.concatenate(parts)


def wedge(
    document: dict[str, Any],
    energy: float,
    spectrum: str | None,
    cols: int,
    rows: int,
    pitch: float,
) -> None:
    """Panel, beam and flat image of the step wedges; `spectrum` is None for one energy."""
    document["geometry"]["detector"]["center"]["x"]["value"] = 1000.0
    document["detector"] |= {
        "columns": {"value": cols}, "rows": {"value": rows},
        "pixel_pitch": {a: {"value": pitch} for a in "uv"},
    }  # fmt: skip
    document["environment"]["material_id"] = None
    document["source"] |= {
        "voltage": {"value": energy}, "window": [], "target": None,
        "spectrum": {"monochromatic": spectrum is None, "file": {"value": spectrum}},
    }  # fmt: skip
    document["acquisition"]["flat_field"] = {"number": 1, "ideal": True}


def materials(formulas: dict[str, tuple[str, float]]) -> list[dict[str, Any]]:
    return [{"id": k, "density": {"value": d}, "composition": [{"formula": {"value": f}}]}
            for k, (f, d) in formulas.items()]  # fmt: skip


def standing(file: str, mesh: trimesh.Trimesh, metal: str) -> dict[str, Any]:
    """A sample that stands in the world as its mesh does."""
    middle = dict(zip("xyz", mesh.bounds.mean(axis=0).tolist(), strict=True))
    return {
        "file": {"value": file}, "unit": "mm", "material_id": metal,
        "position": {
            "center": {a: {"value": x} for a, x in middle.items()},
            "vector_r": {"x": 1, "y": 0, "z": 0}, "vector_t": {"x": 0, "y": 0, "z": 1},
        },
    }  # fmt: skip


def wedges(folder: Path) -> None:
    """2D-SW-1 and 2D-SW-2: steps of aluminium and iron behind four detectors and two
    filters."""
    folder.mkdir(parents=True)
    screens = {"D2": Filter(Substance.of("CsI", "CsI", 4.51), 0.2),
               "D3": Filter(Substance.of("CsI", "CsI", 4.51), 0.5),
               "D4": Filter(Substance.of("GOS", "Gd2O2S", 7.34), 0.5)}  # fmt: skip
    base = shipped("2D-FB-2_2021-03-24v06r00dp", folder)
    metadata = {}
    metals = (("Al", 2.7, 518.0, 50, 120, 7), ("Fe", 7.874, 260.0, 100, 200, 11))
    beams, depth, ideal = {}, {}, {}
    for metal, density, radius, keV, kV, first in metals:
        mu = Substance.of(metal, metal, density).attenuation()
        thick = -np.log(reference(first)[:9, :2].mean(axis=1) / 6e4) / np.interp(
            keV, ENERGY, mu
        )
        depth[metal] = through = np.exp(-mu * thick[:, None])
        wanted = reference(first + 2)[:9, :2].mean(axis=1) / 6e4

        def behind(aluminium: float, kV: float = kV) -> np.ndarray[Any, Any]:
            return beam(kV, aluminium) * ENERGY

        def misfit(
            aluminium: float, t: Any = through, w: Any = wanted, f: Any = behind
        ) -> float:
            s = f(aluminium)
            return float((np.log(t @ s / s.sum() / w) ** 2).sum())

        layer = float(minimize_scalar(misfit, bounds=(0.0, 10.0), method="bounded").x)
        print(f"{metal}: {kV} kV behind {layer:.2f} mm of aluminium")
        beams[metal] = behind(layer)
        write_spectrum(folder / f"{metal}.csv", beam(kV, layer))
        mesh = steps(thick, radius)
        mesh.export(folder / f"{metal}.stl")
        for detector in ("D1", *screens):
            for energy in (keV, kV):
                document = json.loads(json.dumps(base))
                spectrum = None if energy == keV else f"{metal}.csv"
                wedge(document, energy, spectrum, 1010, 910, PANEL_MM / 910)
                formulas = {"Al": ("Al", 2.7), "Fe": ("Fe", 7.874), "Cu": ("Cu", 8.92)}
                if detector in screens:
                    thickness = {"value": screens[detector].thickness_mm}
                    document["detector"] |= {
                        "type": "real",
                        "scintillator": {"material_id": "screen", "thickness": thickness},
                    }
                    formulas["screen"] = (
                        ("Gd2O2S", 7.34) if detector == "D4" else ("CsI", 4.51)
                    )
                document["materials"] = materials(formulas)
                document["samples"] = [standing(f"{metal}.stl", mesh, metal)]
                if detector == "D1":
                    ideal[metal] = document
                key = f"{detector}_{metal}_{energy}"
                metadata[key] = simulated(folder, key, document, 1)
    evaluated("2D-SW-1", metadata)
    names: list[str] = []
    rows = []
    text = next(folder.rglob("2D-SW-1_all_GV_means.txt")).read_text().splitlines()
    names = text[0].split("\t")[1:]
    rows = [
        [float(x) if x != "-" else np.nan for x in line.split("\t")[1:]]
        for line in text[1:]
    ]
    means = np.array(rows)
    number = 5
    for name in names:
        number += 2
        ours = means[:9, names.index(name)]
        theirs = reference(number)
        both = theirs[:9, :2].mean(axis=1)
        off = 100.0 * (ours / both - 1.0)
        line = f"{name:10s} % off the mean of ROSI and McRay, steps 1 to 9: " + " ".join(
            f"{x:5.1f}" for x in off
        )
        apart = 100.0 * np.abs(theirs[:9, 0] / theirs[:9, 1] - 1.0).max()
        line += f"; those two differ by up to {apart:.1f}"
        detector, metal, energy = name.split("_")
        if detector != "D1" and energy in ("120", "200"):
            s = beams[metal] / beams[metal].sum()
            wanted = reference(9 if metal == "Al" else 13)[:9, :2].mean(axis=1) / 6e4
            low, high = explained(
                s, deposited(screens[detector]).mean, depth[metal], wanted
            )
            line += f"; spectra explain step 1 from {100 * (low * 6e4 / both[0] - 1):.1f}"
            line += f" to {100 * (high * 6e4 / both[0] - 1):.1f}"
        print(line)
    filtered = {}
    for key, document in [
        (metal + cu, ideal[metal]) for metal in ideal for cu in ("", "Cu")
    ]:
        # The 200 kV of the iron's tube for both, with the thickness of aluminium fitted above.
        document["source"] |= {
            "voltage": {"value": 200.0}, "spectrum": {"file": {"value": "Fe.csv"}},
            "filters": [{"material_id": "Cu", "thickness": {"value": 2.0}}] * key.endswith("Cu"),
        }  # fmt: skip
        filtered[key] = simulated(folder, key, document, 1)
    evaluated("2D-SW-2", filtered)
    for key in filtered:
        text = (
            folder / key / "2D-SW-2-results" / f"2D-SW-2_{key}_ratios.txt"
        ).read_text()
        table = np.loadtxt(text.splitlines())
        print(f"2D-SW-2 {key:4s} ratios of neighbouring steps, % off the reference: "
              + " ".join(f"{100 * x:.1f}" for x in table[:, 6]) + "; its uncertainty: "
              + " ".join(f"{100 * x:.1f}" for x in table[:, 4:6].max(1) / table[:, 3]))  # fmt: skip


def explained(s: Any, response: Any, through: Any, wanted: Any) -> tuple[float, float]:
    """Least and greatest transmission of the first step that a spectrum gives which lies within
    20 % of ours at every energy and fits the ideal detector's steps to 0.3 %."""
    use = s > s.max() * 1e-4
    s, response, through = s[use], response[use], through[:, use]
    n, eye = len(s), np.eye(len(s))
    fits = [sign * (t - w) * s - 0.003 * w * s
            for t, w in zip(through, wanted, strict=True) for sign in (1.0, -1.0)]  # fmt: skip
    above = np.concatenate([np.append(eye, np.full((n, 1), -1.2), 1),
                            np.append(-eye, np.full((n, 1), 0.8), 1)])  # fmt: skip
    limits = np.concatenate([np.append(np.array(fits), np.zeros((18, 1)), 1), above])
    ends = []
    for sign in (1.0, -1.0):
        found = linprog(
            sign * np.append(through[0] * s * response, 0.0), A_ub=limits,
            b_ub=np.zeros(len(limits)), A_eq=[np.append(s * response, 0.0)], b_eq=[1.0],
        )  # fmt: skip
        ends.append(sign * found.fun if found.status == 0 else math.nan)
    return ends[0], ends[1]


STUDIES: dict[str, Callable[..., None]] = {
    "published": published,
    "evaluate": evaluate,
    "wedges": wedges,
}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("study", choices=STUDIES)
    parser.add_argument("folder", type=Path)
    parser.add_argument("test", nargs="*", help="of evaluate; default: all")
    given = parser.parse_args()
    STUDIES[given.study](given.folder, *given.test)
