"""CIL, TIGRE and LEAP themselves beside the geometries that flexdt writes for them.

None of the three is on the package index, and TIGRE needs a CUDA device to project, so each is
run as far as a processor takes it, from a checkout of its source:

- CIL: `create_Cone3D_Flex` and `set_panel` make the geometry, CIL's own conversion makes
  ASTRA's vectors of it (`convert_geometry_to_astra_vec_3D`); these are compared with ours.
- TIGRE: `Geometry.check_geo` takes the attributes, and the functions of `Siddon_projection.cu`
  that place source, first pixel and steps are compiled for the processor, in double precision.
- LEAP: its library, built for the processor, keeps the modular beam and projects three blobs
  with its own projector; places are compared by least squares.

    python tests/studies/exchange_peers.py --cil CIL --tigre TIGRE --leap LEAP/src [--count 50]

CIL and TIGRE are checkouts; LEAP/src holds `leapctype.py` and `libleapct.so` (made by its
`cpu_CMakeLists.txt`). Parts without a folder are left out, and said.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib.util
import re
import subprocess
import sys
import tempfile
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "support"))

from random_scans import CHIRAL, SHAPE, some_parameters, some_poses

import flexdt as fx
from flexdt.twin.projection import Volume, forward

BLOB_MM: Final = 2.5
"""Standard deviation of a blob that LEAP projects."""
VOXEL_MM: Final = 0.5
SIDE: Final = 64
"""Voxels along an edge of LEAP's volume."""
CXX: Final = "g++"
TIGRE_FUNCTIONS: Final = ("computeDeltas_Siddon", "rollPitchYaw", "eulerZYZ")
CALL: Final = """
extern "C" void place(double* g, int* n, double* out) {
    Geometry geo;
    geo.nDetecU = n[0]; geo.nDetecV = n[1];
    geo.dDetecU = g[0]; geo.dDetecV = g[1];
    geo.DSO = g + 2; geo.DSD = g + 3;
    geo.offOrigX = g + 4; geo.offOrigY = g + 5; geo.offOrigZ = g + 6;
    geo.offDetecU = g + 7; geo.offDetecV = g + 8;
    geo.dYaw = g + 9; geo.dPitch = g + 10; geo.dRoll = g + 11;
    geo.alpha = g[12]; geo.theta = 0; geo.psi = 0;
    double none = 0; geo.COR = &none;
    geo.dVoxelX = geo.dVoxelY = geo.dVoxelZ = 1;
    geo.sVoxelX = geo.sVoxelY = geo.sVoxelZ = 0;
    Point3D* o = (Point3D*)out;
    computeDeltas_Siddon(geo, 0, o, o + 1, o + 2, o + 3);
}
"""


def scan(seed: int) -> fx.ConeVec:
    """A drawn scan: any axis, panel and source, the 17 parameters of a correction."""
    rng = np.random.default_rng(seed)
    poses = some_poses(rng, int(rng.integers(1, 9)), even=False, still=bool(seed % 2))
    return poses.cone_vec(some_parameters(rng)).with_shape(SHAPE)


def off_px(rows: Any, expected: fx.ConeVec) -> float:
    """The largest distance between the pixels that two geometries see points in [px]."""
    places = (c.project_points(CHIRAL, SHAPE) for c in (fx.ConeVec(rows), expected))
    return float(np.abs(np.subtract(*places)).max())


def loaded(name: str, file: Path) -> Any:
    """Load one module of a checkout."""
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def cil(checkout: Path) -> Callable[[fx.ConeVec], float]:
    """Load CIL without its compiled parts, which no geometry needs."""
    sys.path.insert(0, str(checkout / "Wrappers" / "Python"))
    compiled = types.ModuleType("cil.framework.cilacc")
    compiled.cilacc = None  # type: ignore[attr-defined]
    sys.modules["cil.framework.cilacc"] = compiled
    if importlib.util.find_spec("astra") is None:
        astra = types.ModuleType("astra")
        astra.creators = types.SimpleNamespace(  # type: ignore[attr-defined]
            create_proj_geom=lambda kind, rows, cols, vectors: {"Vectors": vectors}
        )
        astra.create_vol_geom = lambda *sizes: sizes  # type: ignore[attr-defined]
        sys.modules["astra"] = astra
    version = types.ModuleType("cil.version")
    version.version = "of a checkout"  # type: ignore[attr-defined]
    sys.modules["cil.version"] = version
    from cil.framework import ImageGeometry  # type: ignore[import-not-found]

    path = (
        "Wrappers/Python/cil/plugins/astra/utilities/convert_geometry_to_astra_vec_3D.py"
    )
    converter = loaded("converter", checkout / path)

    def compare(expected: fx.ConeVec) -> float:
        """How far apart [pixels] the geometry is after CIL's own conversion to ASTRA's
        vectors.
        """
        geometry = expected.to_cil()
        assert [*geometry.shape] == [
            n for n in expected.shape if n > 1
        ]  # as CIL leaves them out
        _, theirs = converter.convert_geometry_to_astra_vec_3D(
            ImageGeometry(9, 9, 9), geometry
        )
        return off_px(theirs["Vectors"], expected)

    return compare


def tigre(checkout: Path) -> Callable[[fx.ConeVec], float]:
    """Compile TIGRE's functions that place source and pixels."""
    cuda = checkout / "Common" / "CUDA"
    source = (cuda / "Siddon_projection.cu").read_text("utf-8")
    types_text = (cuda / "types_TIGRE.hpp").read_text("utf-8")
    bodies = []
    for name in TIGRE_FUNCTIONS:
        found = re.search(rf"^void {name}\(.*?^}}", source, re.MULTILINE | re.DOTALL)
        assert found is not None, name
        bodies.append(found[0])
    heads = [re.sub(r"\s*\{.*", ";", body, flags=re.DOTALL) for body in bodies]
    text = "\n".join(["#include <cmath>", "using namespace std;",
                      re.sub(r"\bfloat\b(?!\))", "double", types_text).replace("to_float", "same")
                      .replace("(float)", "(double)"), *heads, *bodies, CALL])  # fmt: skip
    folder = Path(tempfile.mkdtemp())
    (folder / "place.cpp").write_text(text, "utf-8")
    made = folder / "place.so"
    subprocess.run(
        [CXX, "-shared", "-fPIC", "-o", made, folder / "place.cpp"], check=True
    )
    place = ctypes.CDLL(str(made)).place
    # The package's own __init__ wants its CUDA extension; the geometry's module does not.
    package = types.ModuleType("tigre")
    sys.modules["tigre"] = package
    module = loaded("tigre_geometry", checkout / "Python/tigre/utilities/geometry.py")
    package.geometry = module.geometry  # type: ignore[attr-defined]

    def compare(expected: fx.ConeVec) -> float:
        """How far apart [pixels] the geometry is by the functions of TIGRE's kernel, view
        by view.
        """
        geometry, angles = expected.to_tigre(fx.Grid((5, 6, 7), 0.5))
        assert isinstance(geometry, module.Geometry)
        geometry.check_geo(angles)
        rows = np.empty((len(expected), 12))
        counts = (ctypes.c_int * 2)(*map(int, geometry.nDetector[::-1]))
        for view in range(len(expected)):
            given = [*geometry.dDetector[::-1], geometry.DSO[view], geometry.DSD[view],
                     *geometry.offOrigin[view][::-1], *geometry.offDetector[view][::-1],
                     *geometry.rotDetector[view], geometry.angles[view][0]]  # fmt: skip
            out = (ctypes.c_double * 12)()
            place((ctypes.c_double * 13)(*given), counts, out)
            first, u, step, at = np.array(out).reshape(4, 3)
            # The kernel counts pixelV = nDetecV - v - 1: row v = 0 lies farthest along its
            # step.
            nv, nu = geometry.nDetector
            middle = first + (nu - 1) / 2 * u + (nv - 1) / 2 * step
            rows[view] = np.concatenate([at, middle, u, -step])
        return off_px(rows, expected)

    return compare


def blobs(rng: np.random.Generator) -> Volume:
    """Three blobs of different weight about a drawn place."""
    ticks = (np.arange(SIDE) - (SIDE - 1) / 2) * VOXEL_MM
    z, y, x = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    data = np.zeros((SIDE,) * 3)
    for weight, (px, py, pz) in enumerate(0.6 * CHIRAL[[3, 4, 5]], 1):
        squares = (x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2
        data += weight * np.exp(-squares / (2 * BLOB_MM**2))
    x, y, z = rng.uniform(-3, 3, 3)
    return Volume(data.astype(np.float32), VOXEL_MM, (x, y, z))


def seen(rng: np.random.Generator) -> fx.ConeVec:
    """A drawn scan that sees the blobs: angles, offsets, tilts and a rise."""
    return fx.ConeVec.circular(
        sod=rng.uniform(500, 600), sdd=rng.uniform(700, 900), angles=rng.uniform(0, 360, 4),
        shape=SHAPE, pixel=0.9, offset=rng.uniform(-4, 4, 2), tilts=rng.uniform(-4, 4, 3),
        height=rng.uniform(-3, 3),
    )  # fmt: skip


def kept_as(expected: fx.ConeVec, model: Any) -> None:
    """Check that LEAP keeps a scan, in its single precision."""
    width, height = model.get_pixelWidth(), model.get_pixelHeight()
    kept = np.concatenate(
        [model.get_sourcePositions(), model.get_moduleCenters(), model.get_colVectors() * width,
         model.get_rowVectors() * height], axis=1)  # fmt: skip
    assert off_px(kept, expected) < 1e-3


def leap(folder: Path) -> Callable[[fx.ConeVec], float]:
    """LEAP's projector beside ours, by the shift of three blobs."""
    sys.path.insert(0, str(folder))
    rng = np.random.default_rng(0)

    def compare(drawn: fx.ConeVec) -> float:
        """How far apart [pixels] LEAP's projections of drawn blobs are from ours.

        A mirror image, or another scale of the values, raises AssertionError.
        """
        volume, expected = blobs(rng), seen(rng)
        kept_as(drawn, drawn.to_leap())
        model = expected.to_leap(volume)
        model.set_gpu(-1)
        theirs = model.allocate_projections()
        model.project(theirs, volume.data.copy())
        ours = forward(volume, expected, SHAPE)
        worst = 0.0
        for one, other in zip(ours, theirs, strict=True):
            down, across = np.gradient(one)
            table = np.stack([-across.ravel(), -down.ravel(), one.ravel()], axis=1)
            shift = np.linalg.lstsq(table, (other - one).ravel(), rcond=None)[0]
            assert abs(shift[2]) < 0.05, shift  # a mirror image gives 0.2 and more
            worst = max(worst, float(np.abs(shift[:2]).max()))
        return worst

    return compare


def main() -> None:
    """Compare drawn scans with each library whose checkout is given, and print the
    largest distance.
    """
    parser = argparse.ArgumentParser(
        description=__doc__.partition("\n\n")[0] if __doc__ else None
    )
    peers = {"cil": cil, "tigre": tigre, "leap": leap}
    for name in peers:
        parser.add_argument(f"--{name}", type=Path)
    parser.add_argument("--count", type=int, default=50)
    given = parser.parse_args()
    for name, load in peers.items():
        folder = getattr(given, name)
        if folder is None:
            print(f"{name}: no checkout was given, not compared")
            continue
        compare = load(folder.resolve())
        worst = max(compare(scan(seed)) for seed in range(given.count))
        print(f"{name}: {given.count} drawn scans, at most {worst:.2g} px apart")


if __name__ == "__main__":
    main()
