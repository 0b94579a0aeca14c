"""A polychromatic radiograph beside gVirtualXRay's: a plastic box with five steel beads.

Needs `pip install gvxr` and, without a graphics card, Mesa's software OpenGL (`apt install
libegl1 libgl1 libxcb-res0 libxcb-ewmh2 libxcb-icccm4 libxcb-composite0 libxcb-xinerama0
libxcb-keysyms1`). Both get the same spectrum and the same geometry and see the signal of a
detector that measures energy. gVirtualXRay uses meshes and its own attenuation tables. The
direction of its rows and columns is found with one ball whose shadow is worked out by hand, so
a mirrored image of ours would not pass. Prints the differences of the transmissions
of all pixels and of those off the edges.

    python tests/studies/compare_gvxr.py
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from gvxrPython3 import gvxr
from scipy.ndimage import maximum_filter, minimum_filter

from flexdt.phantoms import bead_phantom, material
from flexdt.phantoms.channels import channels
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.physics.effective import effective_beam
from flexdt.twin.physics.tube import tube_spectrum
from flexdt.twin.projection import project_scene

KV = 90.0
SOD, SDD, PIXEL = 600.0, 1059.0, 0.2992
SHAPE = (380, 478)
NEAR = 5
STEADY = 0.2
"""A pixel is off the edges when no path changes by more than this part within NEAR x NEAR."""


def ours() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Compute the transmission of a bead phantom by this package, and the path through
    each material.

    Returns:
        Share of the open beam (rows, cols), and material -> path [mm] (rows, cols).
    """
    scan = ConeVec.from_vectors(
        (0, -SOD, 0), (0, SDD - SOD, 0), (PIXEL, 0, 0), (0, 0, -PIXEL)
    )
    parts = channels(bead_phantom("normal", 5))
    paths = {c.material.name: project_scene(c.body, scan, SHAPE)[0] for c in parts}
    spectrum = tube_spectrum(KV)
    signal = spectrum.fluence * spectrum.energy_keV
    beam = effective_beam(
        signal,
        signal * spectrum.energy_keV,
        [c.material.substance for c in parts],
        [c.thickest_mm for c in parts],
    )
    image, _ = beam.transmit(np.stack(list(paths.values())))
    return image / beam.signal.sum(), paths


def theirs(folder: Path) -> np.ndarray:
    """Compute the transmission of the same phantom by gVirtualXRay, columns along +x,
    rows down.

    Args:
        folder: for the meshes.

    Returns:
        Share of the open beam (rows, cols).
    """
    phantom = bead_phantom("normal", 5)
    gvxr.createOpenGLContext()
    gvxr.setSourcePosition(0.0, -SOD, 0.0, "mm")
    gvxr.usePointSource()
    gvxr.resetBeamSpectrum()
    spectrum = tube_spectrum(KV)
    scale = 1e6 / spectrum.photons
    for energy, photons in zip(spectrum.energy_keV, spectrum.fluence, strict=True):
        if photons > 0:
            gvxr.addEnergyBinToSpectrum(float(energy), "keV", float(photons * scale))
    gvxr.setDetectorPosition(0.0, SDD - SOD, 0.0, "mm")
    gvxr.setDetectorUpVector(0, 0, 1)
    gvxr.setDetectorNumberOfPixels(SHAPE[1], SHAPE[0])
    gvxr.setDetectorPixelSize(PIXEL, PIXEL, "mm")
    way = ways(folder)
    box = trimesh.creation.box(extents=phantom.size_mm)
    bodies = {"box": box}
    for i, (at, radius) in enumerate(
        zip(phantom.beads, phantom.bead_radius_mm, strict=True)
    ):
        bead = trimesh.creation.icosphere(subdivisions=6, radius=float(radius))
        bead.apply_translation(at)
        bodies[f"bead{i}"] = bead
    formulas = {"box": "C15H17N", "bead": "Fe"}
    for name, mesh in bodies.items():
        file = folder / f"{name}.stl"
        mesh.export(file)
        gvxr.loadMeshFile(name, str(file), "mm", False)
        kind = name.rstrip("0123456789")
        density = material("abs" if kind == "box" else "steel").density_g_cm3
        gvxr.setCompound(name, formulas[kind])
        gvxr.setDensity(name, density, "g/cm3")
        if kind == "box":
            gvxr.addPolygonMeshAsOuterSurface(name)
        else:
            gvxr.addPolygonMeshAsInnerSurface(name)
    return transmission()[way]


def transmission() -> np.ndarray:
    """Compute the transmission image of gVirtualXRay's present scene, 1 in the open beam."""
    image = np.array(gvxr.computeXRayImage(), dtype=np.float64)
    return image / float(gvxr.getTotalEnergyWithDetectorResponse())


def ways(folder: Path) -> tuple[slice, slice]:
    """Find out how gVirtualXRay's rows and columns must be read to run down and along +x,
    by the shadow of a steel ball.

    The ball is to the right (+x) and above (+z); its shadow is where the line from the
    source through its centre meets the panel.

    Args:
        folder: for the ball's mesh.

    Returns:
        Slices of rows and columns, each forwards or backwards.

    Raises:
        SystemExit: the shadow is more than a pixel off either way.
    """
    at = np.array([30.0, 0.0, 20.0])
    ball = trimesh.creation.icosphere(subdivisions=4, radius=4.0)
    ball.apply_translation(at)
    file = folder / "probe.stl"
    ball.export(file)
    gvxr.loadMeshFile("probe", str(file), "mm", False)
    gvxr.setCompound("probe", "Fe")
    gvxr.setDensity("probe", 7.8, "g/cm3")
    gvxr.addPolygonMeshAsOuterSurface("probe")
    weight = 1.0 - transmission()
    gvxr.removePolygonMeshesFromXRayRenderer()
    right, up = at[[0, 2]] * SDD / SOD / PIXEL
    rows, cols = (np.arange(n) - (n - 1) / 2 for n in SHAPE)
    row, col = (
        (weight * rows[:, None]).sum() / weight.sum(),
        (weight * cols).sum() / weight.sum(),
    )
    if not (abs(abs(col) - right) < 1.0 and abs(abs(row) - up) < 1.0):
        raise SystemExit(
            f"the ball's shadow is at {col:.1f}, {row:.1f}, not {right:.1f}, {up:.1f}"
        )
    return slice(None, None, -1 if row > 0 else 1), slice(
        None, None, -1 if col < 0 else 1
    )


def main() -> None:
    """Print the absolute differences of both transmissions over gVirtualXRay's as JSON,
    in all, off the edges and behind each material; also the share of pixels off the
    edges, the open beam's largest deviation from 1 and the least transmission.
    """
    mine, paths = ours()
    with tempfile.TemporaryDirectory() as folder:
        other = theirs(Path(folder))
    relative = np.abs(mine - other) / other
    flat = np.ones(SHAPE, dtype=bool)
    for path in paths.values():
        flat &= maximum_filter(path, NEAR) - minimum_filter(path, NEAR) <= STEADY * path
    seen = {name: flat & (path > 0) for name, path in paths.items()}
    figures = {
        "mean": float(relative.mean()),
        "mean_if_mirrored": float((np.abs(mine[:, ::-1] - other) / other).mean()),
        "part_off_edges": float(flat.mean()),
        "worst_off_edges": float(relative[flat].max()),
        "open_beam": float(np.abs(other[~(paths["abs"] > 0) & flat] - 1).max()),
        **{f"mean_behind_{k}": float(relative[v].mean()) for k, v in seen.items()},
        **{f"worst_behind_{k}": float(relative[v].max()) for k, v in seen.items()},
        "least_transmission": float(mine.min()),
    }
    print(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
