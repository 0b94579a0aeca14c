"""CTSimU scenarios beside images that BAM published, and by the evaluations that `ctsimu` ships.

    python tests/studies/ctsimu_scenarios.py published CHECKOUT
    python tests/studies/ctsimu_scenarios.py evaluate FOLDER [TEST...]  # needs ctsimu, reportlab
    python tests/studies/ctsimu_scenarios.py wedges FOLDER       # likewise

`published` simulates the examples of a checkout of github.com/BAMresearch/ctsimu-scenarios and
compares every projection with the one that aRTist made of it. `evaluate` simulates scenarios that
`ctsimu` ships and lets it evaluate the images: 2D-FB-1, 2D-FB-2, 2D-DW-1, 2D-WE-1, 2D-WE-2. Their
meshes and spectra are not public: edges are blocks of tungsten whose sides run towards the source,
the wires those of ISO 19232-5, the spectra ours. `wedges` is 2D-SW-1, primary radiation: spherical
steps as its documentation draws them, thicknesses from its ideal detector at one energy, spectra
ours behind as much aluminium as fits the ideal detector; then all CsI and GOS cases beside ROSI and
McRay, and how far spectra within 20 % of ours that fit the ideal detector, too, move them.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import trimesh
from scipy.optimize import linprog, minimize_scalar

from flexdt.clients.scenario import ScenarioImages
from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.attenuation.tables import tables
from flexdt.twin.errors import TwinError
from flexdt.twin.physics.scintillator import deposited
from flexdt.twin.physics.spectrum import ALUMINIUM, Filter, TubeModel, tube_spectrum

ENERGY = tables().energy_keV
PANEL_MM = 345.0
WIRES = (0.8, 0.63, 0.5, 0.4, 0.32, 0.25, 0.2, 0.16, 0.13, 0.1, 0.08, 0.063, 0.05)


def published(checkout: Path) -> None:
    """Differences in grey values, of about 50 000 in the open beam."""
    for path in sorted(checkout.glob("examples/*/*.json")):
        try:
            images = ScenarioImages(path)
        except TwinError as error:
            print(f"{path.stem:32s} refused: {str(error).partition(': ')[2]}")
            continue
        difference, most = [], 0.0
        for i, ours in enumerate(images.projections()):
            theirs = tifffile.imread(path.parent / "projections" / f"{path.stem}_{i:04d}.tif")
            difference.append(ours.astype(np.float64) - theirs)
            most = max(most, float(theirs.max()))
        found = np.array(difference)
        print(f"{path.stem:32s} {len(found)} images, at most {most:.0f}: rms "
              f"{np.sqrt((found**2).mean()):.1f}, mean {found.mean():+.1f}, worst pixel "
              f"{np.abs(found).max():.0f}")  # fmt: skip


def beam(kV: float, aluminium: float) -> np.ndarray[Any, Any]:
    """Photons of each energy, our tungsten spectrum behind aluminium [mm]."""
    return tube_spectrum(kV, TubeModel((Filter(ALUMINIUM, aluminium),))).fluence


def write_spectrum(path: Path, photons: np.ndarray[Any, Any]) -> None:
    np.savetxt(path, np.column_stack([ENERGY, photons * 1e4]))


def between(corners: Sequence[Sequence[float]], near: float, far: float) -> trimesh.Trimesh:
    """The cone from the origin through a convex polygon (y, z) at x = 1, from x = near to far."""
    ring = np.array([[1.0, y, z] for y, z in corners])
    hull = trimesh.convex.convex_hull(np.concatenate([near * ring, far * ring]))
    assert isinstance(hull, trimesh.Trimesh)
    return hull


def shipped(name: str, folder: Path, mesh: trimesh.Trimesh | None = None) -> dict[str, Any]:
    """A scenario of the package with our mesh in its place; `mesh` has the world's coordinates."""
    text = (resources.files("ctsimu") / "evaluation" / "scenarios" / f"{name}.json").read_text(
        encoding="utf-8-sig"
    )
    document: dict[str, Any] = json.loads(text)
    spectrum = document["source"]["spectrum"]["file"]["value"]
    if spectrum:
        write_spectrum(folder / spectrum, beam(document["source"]["voltage"]["value"], 4.0))
    if mesh is not None:
        sample = document["samples"][0]
        mesh.export(folder / sample["file"]["value"])
        middle = mesh.bounds.mean(axis=0)
        for a, x in zip("uvw", middle, strict=True):
            stage = document["geometry"]["stage"]["center"]["xyz"["uvw".index(a)]]["value"]
            sample["position"]["center"][a]["value"] = x - stage
    return document


def simulated(folder: Path, name: str, document: dict[str, Any], rays: int) -> str:
    path = folder / f"{name}.json"
    path.write_text(json.dumps(document))
    images = ScenarioImages(path, seed=1, rays=rays)
    for text in images.scan.notes:
        print(f"  {name}: {text}")
    return str(images.write(folder / name))


def evaluate(folder: Path, *tests: str) -> None:
    """Runs all evaluations or those named; `...-results` folders hold what they find."""
    from ctsimu.toolbox import Toolbox

    folder.mkdir(parents=True, exist_ok=True)
    turn = math.radians(3.0)

    def quarter(pitch: float) -> trimesh.Trimesh:
        """The quarter of the panel left of and below its middle, turned by 3 degrees."""
        reach = 1.5 * pitch * 501.0 / 1000.0
        square = [(0, 0), (0, reach), (-reach, reach), (-reach, 0)]
        turned = [(x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn))
                  for x, y in square]  # fmt: skip
        return between([(-x, -y) for x, y in turned], 495.0, 505.0)

    wires, at = [], -24.0
    tilt = trimesh.transformations.rotation_matrix(turn, [1, 0, 0], [998.6, 0, 0])
    for d in WIRES:
        for k in (0, 2):
            wire = trimesh.creation.cylinder(d / 2.0, 15.0, sections=48)
            wires.append(wire.apply_translation([998.6, -(at + k * d + d / 2), 0]))
        at += 3.0 * d + 2.7
    duplex = trimesh.util.concatenate(wires).apply_transform(tilt)
    cases: tuple[tuple[str, str, str, Any, int], ...] = (
        ("2D-FB-1", "SNR100", "2D-FB-1_Detektor1_SNR100_2021-05-25v06r00dp", None, 1),
        ("2D-FB-1", "SNR250", "2D-FB-1_Detektor2_SNR250_2021-05-25v06r00dp", None, 1),
        ("2D-FB-2", "", "2D-FB-2_2021-03-24v06r00dp", None, 1),
        ("2D-DW-1", "SR75", "2D-DW-1_Detektor1_2021-05-26v01r01dp", duplex, 3),
        ("2D-DW-1", "SR150", "2D-DW-1_Detektor2_2021-05-26v01r01dp", duplex, 3),
        ("2D-WE-1", "spot1", "2D-WE-1_Spot1_2021-10-13v02r04dp", quarter(0.008), 5),
        ("2D-WE-1", "spot2", "2D-WE-1_Spot2_2021-10-13v02r04dp", quarter(0.008), 5),
        ("2D-WE-2", "", "2D-WE-2_2021-10-13v02r03dp", quarter(0.008), 5),
    )
    for test in tests or dict.fromkeys(case[0] for case in cases):
        metadata = {}
        for _, key, name, mesh, rays in (case for case in cases if case[0] == test):
            own = name.partition("_202")[0]
            metadata[key] = simulated(folder, own, shipped(name, folder, mesh), rays)
        if "" in metadata:
            Toolbox(test, metadata[""])
        else:
            Toolbox(test, **metadata)


def reference(number: int) -> np.ndarray[Any, Any]:
    """Primary grey values by step: ROSI, McRay, McRay's standard deviation, (10, 3)."""
    data = resources.files("ctsimu") / "evaluation" / "data"
    found = [p for p in data.iterdir() if p.name.startswith(f"2D-SW-1_scenario{number:02d}_")]
    table = np.loadtxt(found[0].read_text().splitlines(), delimiter="\t")
    return np.asarray(table[:, [9, 12, 13]])


def steps(thick: np.ndarray[Any, Any], radius: float) -> trimesh.Trimesh:
    """Spherical shells about the source, the lowest the thickest; a hair of space between them."""
    parts, half = [], 0.5 * PANEL_MM / 1000.0
    for k, d in enumerate(thick):
        low, high = (-half + 2 * half * (k + e) / 10 for e in (1e-4, 1 - 1e-4))
        y, z = np.meshgrid(np.linspace(-0.05, 0.05, 21), np.linspace(low, high, 21))
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
        parts.append(trimesh.Trimesh(corners, faces, process=False))
    return trimesh.util.concatenate(parts)


def wedges(folder: Path) -> None:
    """2D-SW-1: steps of aluminium and iron behind four detectors."""
    from ctsimu.toolbox import Toolbox

    folder.mkdir(parents=True)
    screens = {"D2": Filter(Substance.of("CsI", "CsI", 4.51), 0.2),
               "D3": Filter(Substance.of("CsI", "CsI", 4.51), 0.5),
               "D4": Filter(Substance.of("GOS", "Gd2O2S", 7.34), 0.5)}  # fmt: skip
    base = shipped("2D-FB-2_2021-03-24v06r00dp", folder)
    metadata = {}
    metals = (("Al", 2.7, 518.0, 50, 120, 7), ("Fe", 7.874, 260.0, 100, 200, 11))
    beams, depth = {}, {}
    for metal, density, radius, keV, kV, first in metals:
        mu = Substance.of(metal, metal, density).attenuation()
        thick = -np.log(reference(first)[:9, :2].mean(axis=1) / 6e4) / np.interp(keV, ENERGY, mu)
        depth[metal] = through = np.exp(-mu * thick[:, None])
        wanted = reference(first + 2)[:9, :2].mean(axis=1) / 6e4

        def behind(aluminium: float, kV: float = kV) -> np.ndarray[Any, Any]:
            return beam(kV, aluminium) * ENERGY

        def misfit(aluminium: float, t: Any = through, w: Any = wanted, f: Any = behind) -> float:
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
                document["geometry"]["detector"]["center"]["x"]["value"] = 1000.0
                document["detector"] |= {
                    "columns": {"value": 1010}, "rows": {"value": 910},
                    "pixel_pitch": {a: {"value": PANEL_MM / 910} for a in "uv"},
                }  # fmt: skip
                if detector in screens:
                    thickness = {"value": screens[detector].thickness_mm}
                    document["detector"] |= {
                        "type": "real",
                        "scintillator": {"material_id": "screen", "thickness": thickness},
                    }
                formulas = {"Al": ("Al", 2.7), "Fe": ("Fe", 7.874)}
                if detector in screens:
                    formulas["screen"] = ("Gd2O2S", 7.34) if detector == "D4" else ("CsI", 4.51)
                document["materials"] = [
                    {"id": k, "density": {"value": d},
                     "composition": [{"formula": {"value": f}}]}
                    for k, (f, d) in formulas.items()
                ]  # fmt: skip
                document["environment"]["material_id"] = None
                mono = energy == keV
                document["source"] |= {
                    "voltage": {"value": energy}, "window": [], "target": None,
                    "spectrum": {"monochromatic": mono,
                                 "file": {"value": None if mono else f"{metal}.csv"}},
                }  # fmt: skip
                middle = dict(zip("xyz", mesh.bounds.mean(axis=0).tolist(), strict=True))
                document["samples"] = [{
                    "file": {"value": f"{metal}.stl"}, "unit": "mm", "material_id": metal,
                    "position": {
                        "center": {a: {"value": x} for a, x in middle.items()},
                        "vector_r": {"x": 1, "y": 0, "z": 0}, "vector_t": {"x": 0, "y": 0, "z": 1},
                    },
                }]  # fmt: skip
                document["acquisition"]["flat_field"] = {"number": 1, "ideal": True}
                key = f"{detector}_{metal}_{energy}"
                metadata[key] = simulated(folder, key, document, 1)
    Toolbox("2D-SW-1", **metadata)
    names: list[str] = []
    rows = []
    text = next(folder.rglob("2D-SW-1_all_GV_means.txt")).read_text().splitlines()
    names = text[0].split("\t")[1:]
    rows = [[float(x) if x != "-" else np.nan for x in line.split("\t")[1:]] for line in text[1:]]
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
            low, high = explained(s, deposited(screens[detector]).mean, depth[metal], wanted)
            line += f"; spectra explain step 1 from {100 * (low * 6e4 / both[0] - 1):.1f}"
            line += f" to {100 * (high * 6e4 / both[0] - 1):.1f}"
        print(line)


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
