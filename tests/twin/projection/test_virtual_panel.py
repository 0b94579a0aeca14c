"""A panel before or inside the object cuts no ray: chords in closed form, whatever the
panel."""

import numpy as np
import pytest

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.virtual_panel import run_through, stretches
from flexdt.twin.projection import Grid, Volume, back, forward
from flexdt.twin.projection.analytic import TriangleMesh, project_mesh, project_scene
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere
from flexdt.twin.reconstruction import cgls, fdk, sirt, tv

SHAPE = (24, 32)
MU = 0.3


def drawn(seed: int) -> tuple[ConeVec, float]:
    """A circular scan whose panel cuts the object or stands before it."""
    rng = np.random.default_rng(seed)
    sod = rng.uniform(60.0, 200.0)
    far = ConeVec.circular(sod=sod, sdd=2 * sod, angles=45, shape=SHAPE, pixel=sod / 100)
    part = rng.uniform(0.1, 0.53)
    beam = far.detector - far.source
    near = ConeVec.from_vectors(
        far.source, far.source + part * beam, part * far.u, part * far.v
    )
    return near.with_shape(SHAPE), sod


def chords(scan: ConeVec, centre: np.ndarray, radius: float) -> np.ndarray:
    """Lengths of whole lines in a ball, in double precision, (n, rows, cols) [mm]."""
    towards = scan.pixel_centers() - scan.source[:, None, None]
    towards /= np.linalg.norm(towards, axis=3, keepdims=True)
    seen = (centre - scan.source)[:, None, None]
    along = (seen * towards).sum(axis=3)
    squares = radius**2 - ((seen**2).sum(axis=3) - along**2)
    return 2.0 * np.sqrt(np.maximum(squares, 0.0))


@pytest.mark.parametrize("seed", range(6))
def test_solids_meshes_and_voxels_take_whole_lines(seed):
    scan, sod = drawn(seed)
    rng = np.random.default_rng([seed, 1])
    centre, radius = rng.uniform(-0.02, 0.02, 3) * sod, 0.05 * sod
    wanted = chords(scan, centre, radius)
    ball = Scene((Solid(Sphere(tuple(centre), radius), "water", 1.0),))
    assert np.abs(project_scene(ball, scan) - wanted).max() < 1e-4 * radius
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box((2 * radius,) * 3)
    box.apply_translation(centre)
    grid = Volume(np.ones((8, 8, 8), np.float32), radius / 4, tuple(centre))
    mesh = project_mesh(TriangleMesh(box.vertices, box.faces), scan)
    inside = np.abs(forward(grid, scan) - mesh)
    assert np.quantile(inside, 0.99) < 1e-3 * radius


@pytest.mark.parametrize("method", [fdk, sirt, cgls, tv])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_methods_take_whole_lines(method):
    scan, sod = drawn(3)
    radius = 0.05 * sod
    found = method(
        MU / radius * chords(scan, np.zeros(3), radius), scan, Grid((9,) * 3, radius / 4)
    )
    assert abs(found.data[4, 4, 4] * radius / MU - 1.0) < 0.05


def test_back_is_the_adjoint_of_forward():
    scan, sod = drawn(4)
    rng = np.random.default_rng(0)
    volume = Volume(rng.uniform(size=(6, 7, 8)).astype(np.float32), 0.02 * sod)
    images = rng.normal(size=scan.shape).astype(np.float32)
    one = (forward(volume, scan).astype(float) * images).sum()
    other = (back(images, scan, volume).data.astype(float) * volume.data).sum()
    assert one == pytest.approx(other, rel=1e-4)


def test_panels_behind_the_object_stay():
    scan = ConeVec.circular(sod=100, sdd=200, angles=5, shape=SHAPE, pixel=1)
    corners = np.array(
        [[x, y, z] for x in (-9, 9) for y in (-9, 9) for z in (-9, 9)], float
    )
    assert run_through(scan, corners) is scan
    assert (stretches(scan, 12 * corners) > 1).all()
