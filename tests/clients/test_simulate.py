"""`simulate` against Beer and Lambert, the sum over the spectrum, photon statistics and the
twin.

Path lengths, shadows, spectra and variances are written out here in plain numpy.
"""

from __future__ import annotations

import asyncio
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from flexdt.library.reading.folders import load_dataset
from flexdt.library.simulate import project, simulate
from flexdt.phantoms import Phantom, load_phantom, material
from flexdt.phantoms.channels import channels, scatter_object
from flexdt.phantoms.samples import as_phantom
from flexdt.runtime.files.directory import open_data
from flexdt.server.imaging.projections import Imaging, TrueGeometry
from flexdt.server.imaging.radiography import Radiography
from flexdt.server.storage.stored_samples import SampleStore
from flexdt.testing.in_process import DirectProjector
from flexdt.twin.attenuation.substances import Substance, tables
from flexdt.twin.errors import GeometryError, LimitError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.physics.detector import Detector
from flexdt.twin.physics.exposure import ExposureSettings, frame_rng
from flexdt.twin.physics.scatter import ScatterSettings
from flexdt.twin.physics.scintillator import deposited
from flexdt.twin.physics.tube import Filter, Tube
from flexdt.twin.projection import Volume
from flexdt.twin.scanner.state import Sample
from tests.support.phantom_texts import SCENE_FILE

SHAPE = (48, 64)
PIXEL = 0.4
SHARP = Detector.ideal(bits=16, electrons_per_count=800.0, response=())
SCENE = [
    {"kind": "cylinder", "center": [0, 0, 0], "radius": 6, "height": 40, "material": "pmma"},
    {"kind": "sphere", "center": [0, 0, 0], "radius": 1.5, "material": "Al@2.70",
     "replaces": "pmma"},
]  # fmt: skip


def view(rng: np.random.Generator, sod: float = 300.0, sdd: float = 500.0) -> ConeVec:
    """A view from anywhere, the detector shifted and rolled, its pixels square."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    if np.linalg.det(turn) < 0:
        turn[:, 0] *= -1
    x, y, z = turn.T
    detector = (sdd - sod) * y + rng.normal(size=1) * x + rng.normal(size=1) * z
    return ConeVec.from_vectors(-sod * y, detector, PIXEL * x, -PIXEL * z)


def directions(row: np.ndarray) -> np.ndarray:
    """Unit vectors from the source to all pixels, (rows, cols, 3)."""
    source, centre, u, v = row.reshape(4, 3)
    r, c = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in SHAPE), indexing="ij")
    ray = centre + c[..., None] * u + r[..., None] * v - source
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def chord(row: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Path of all rays through a ball [mm]."""
    d = directions(row)
    middle = np.asarray(centre) - row[:3]
    along = d @ middle
    return 2.0 * np.sqrt(np.maximum(radius**2 - (middle @ middle - along**2), 0.0))


def transmission(scan) -> np.ndarray:
    flat = scan.flat.astype(float) - scan.dark
    assert flat.min() > 20_000
    assert flat.max() < 65_000
    return (scan.counts().astype(float) - scan.dark) / flat


# -- against formulas ------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_one_energy_through_a_ball_is_beer_lambert(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cone = view(rng)
    centre, radius = rng.uniform(-2, 2, 3), rng.uniform(2, 5)
    ball = {
        "kind": "sphere",
        "center": centre.tolist(),
        "radius": radius,
        "material": "Al@2.70",
    }
    tube = Tube(kV=90, mono_keV=60.25, spot_mm=0.0)
    scan = simulate(ball, cone, tube=tube, detector=SHARP, shape=SHAPE, rays=1)
    mu = Substance.of("Al", "Al", 2.70).attenuation()[
        np.searchsorted(tables().energy_keV, 60.2)
    ]
    assert mu == pytest.approx(
        0.2778 * 2.70 / 10, rel=0.01
    )  # NIST XCOM, with coherent scattering
    depth = mu * chord(cone.rows[0], centre, radius)
    np.testing.assert_allclose(transmission(scan)[0], np.exp(-depth), atol=6e-5)
    np.testing.assert_allclose(scan.truth.line_integrals()[0], depth, atol=2e-4)


def test_a_pixel_averages_the_signals_of_its_rays() -> None:
    rng = np.random.default_rng(12)
    cone = ConeVec(np.concatenate([view(rng).rows for _ in range(2)]))
    centre, radius = rng.uniform(-1.5, 1.5, 3), rng.uniform(4.0, 6.0)
    ball = {
        "kind": "sphere",
        "center": centre.tolist(),
        "radius": radius,
        "material": "Al@2.70",
    }
    scan = simulate(ball, cone, tube=Tube(kV=90, mono_keV=60.25, spot_mm=0.0), detector=SHARP,
                    shape=SHAPE, rays=3)  # fmt: skip
    mu = Substance.of("Al", "Al", 2.70).attenuation()[
        np.searchsorted(tables().energy_keV, 60.2)
    ]
    for image, row in zip(transmission(scan), cone.rows, strict=True):
        expected = np.zeros(SHAPE)
        for j in (-1, 0, 1):
            for i in (-1, 0, 1):
                moved = row.copy()
                moved[3:6] += (3 * i + j) / 9 * row[6:9] + (3 * j - i) / 9 * row[9:12]
                expected += np.exp(-mu * chord(moved, centre, radius)) / 9
        np.testing.assert_allclose(image, expected, atol=2e-4)
    one = simulate(ball, cone, tube=Tube(kV=90, mono_keV=60.25, spot_mm=0.0), detector=SHARP,
                   shape=SHAPE, rays=1)  # fmt: skip
    assert np.abs(transmission(one) - transmission(scan)).max() > 5e-3
    with pytest.raises(LimitError, match="rays is 17; allowed: 1 to 16"):
        simulate(ball, cone, shape=SHAPE, rays=17)
    for name, allowed in (("rays", "a whole number"), ("spot_points", "a whole number")):
        with pytest.raises(LimitError, match=rf"{name} is 4\.0; allowed: {allowed}"):
            simulate(ball, cone, shape=SHAPE, **{name: 4.0})


@pytest.mark.parametrize(
    ("metal", "keV"), [("Cu@8.96", 50.0), ("Gd@7.9", 50.2), ("Gd@7.9", 50.3)]
)
def test_one_energy_attenuates_as_the_material_says(metal: str, keV: float) -> None:
    box = {"kind": "box", "center": [0, 0, 0], "size": [300, 0.1, 300], "material": metal}
    cone = ConeVec.from_vectors([0, -300, 0], [0, 200, 0], [PIXEL, 0, 0], [0, 0, -PIXEL])
    scan = simulate(box, cone, tube=Tube(kV=90, mono_keV=keV), shape=(1, 1))
    xraydb = pytest.importorskip("xraydb")
    name, _, density = metal.partition("@")
    wanted = 0.01 * float(density) * xraydb.mu_elam(name, keV * 1e3)
    assert scan.truth.line_integrals()[0, 0, 0] == pytest.approx(wanted, rel=2e-3)
    assert material(metal).mu_at(keV) * 0.1 == pytest.approx(wanted, rel=2e-3)


@pytest.mark.parametrize("views", [2, 300])
def test_the_flat_images_doubt_looks_at_all_views(views: int) -> None:
    far = np.linspace(1000.0, 1200.0, views)
    cone = ConeVec.from_vectors([0, -500, 0], np.c_[0 * far, far - 500, 0 * far], [1, 0, 0],
                                [0, 0, -1])  # fmt: skip
    with pytest.warns(UserWarning, match="the flat image is that of the first view"):
        scan = simulate(SCENE, cone, tube=Tube(power_W=1), detector=SHARP, shape=(2, 2))
    differs = 100 * (1 - (1000 / 1200) ** 2)
    assert any(f"up to {differs:.2g} %" in one for one in scan.warnings), scan.warnings


def test_a_spectrum_is_the_sum_over_its_energies_and_the_counts_are_absolute() -> None:
    cone = ConeVec.from_vectors([0, -300, 0], [0, 200, 0], [PIXEL, 0, 0], [0, 0, -PIXEL])
    tube = Tube(
        kV=80, power_W=40, filters=[("Al@2.70", 0.5), ("Cu@8.96", 0.1)], spot_mm=0.0
    )
    scan = simulate(SCENE, cone, tube=tube, detector=replace(SHARP, electrons_per_count=300.0),
                    exposure_ms=100.0, shape=SHAPE, rays=1)  # fmt: skip
    table = tables()
    low, high = (int(np.flatnonzero(table.kV == kV)[0]) for kV in (80, 80))
    assert low == high
    layers = 0.5 * mu("Al", 2.70) + 0.1 * mu("Cu", 8.96)
    weight = table.fluence[low] * np.exp(-layers) * Detector().charge_of_photons()[0]
    d = directions(cone.rows[0])
    pmma = 2 * np.sqrt(np.maximum(36.0 * (d[..., 0] ** 2 + d[..., 1] ** 2) - (300 * d[..., 0]) ** 2,
                                  0.0)) / (d[..., 0] ** 2 + d[..., 1] ** 2)  # fmt: skip
    bead = chord(cone.rows[0], np.zeros(3), 1.5)
    depth = (pmma - bead)[..., None] * mu("C5H8O2", 1.19) + bead[..., None] * mu(
        "Al", 2.70
    )
    expected = np.exp(-depth) @ weight / weight.sum()
    np.testing.assert_allclose(transmission(scan)[0], expected, rtol=1.5e-3)
    # mAs times the solid angle of a pixel, from a fluence per cm2 and mAs at 1 m
    ray = 500.0 / d[..., 1]
    flux = PIXEL**2 / 100 * (1000.0 / ray) ** 2 * d[..., 1] * (40 / 80 * 0.1)
    np.testing.assert_allclose(scan.flat - 100.0, weight.sum() * flux / 300.0, rtol=5e-4)


def mu(formula: str, density: float) -> np.ndarray:
    """Attenuation of a compound from the elements' tables [1/mm]."""
    atoms = {"C5H8O2": {"C": 5, "H": 8, "O": 2}}.get(formula, {formula: 1})
    table = tables()
    mass = {s: n * table.molar_mass[table.elements[s]] for s, n in atoms.items()}
    total = sum(mass.values())
    return (
        sum(m / total * table.total[table.elements[s]] for s, m in mass.items())
        * density
        / 10
    )


@pytest.mark.parametrize("ideal", [True, False])
def test_noise_has_the_variance_of_a_compound_poisson_process(ideal: bool) -> None:
    """Of a scintillator, and of an ideal detector, in which every photon leaves all it has."""
    one = ConeVec.from_vectors([0, -300, 0], [0, 200, 0], [PIXEL, 0, 0], [0, 0, -PIXEL])
    cone = ConeVec(np.repeat(one.rows, 120, axis=0))
    gain = 400.0 if ideal else 100.0
    detector = Detector.ideal(
        bits=16, electrons_per_count=gain, read_noise_e=3e4, averages=2, exposure_ms=20.0,
        **({} if ideal else {"response": (), "swank": 0.9}),
    )  # fmt: skip
    slab = {"kind": "box", "center": [0, 0, 0], "size": [200, 4, 200], "material": "pmma"}
    scan = simulate(slab, cone, tube=Tube(kV=60, spot_mm=0.0), detector=detector, noise=5,
                    shape=SHAPE)  # fmt: skip
    table = tables()
    energy = table.energy_keV
    photons = table.fluence[int(np.flatnonzero(table.kV == 60)[0])] * np.exp(
        -0.5 * mu("Al", 2.7)
    )
    d = directions(one.rows[0])[..., 1]
    behind = np.exp(-4.0 / d[..., None] * mu("C5H8O2", 1.19))
    flux = PIXEL**2 / 100 * (1000.0 * d / 500.0) ** 2 * d * (50 / 60 * 0.02)
    there = photons * behind * flux[..., None]
    kept = deposited(Filter(Substance.of("CsI", "CsI", 4.51 * 0.8), 0.15))
    part, square = (1.0, 1.0) if ideal else (kept.mean, kept.square / 0.9)
    charge = 16.0 * energy
    variance = there @ (square * charge**2 + part * charge) / 2 + 3e4**2 / 2
    in_counts = variance / gain**2 + 1.0 / 12.0
    measured = scan.counts().astype(float).var(axis=0, ddof=1)
    assert (measured / in_counts).mean() == pytest.approx(
        1.0, abs=5 * np.sqrt(2 / 119 / 3072)
    )
    mean = scan.counts().mean(axis=0) - 100.0
    assert (mean / (there @ (part * charge) / gain)).mean() == pytest.approx(
        1.0, abs=1e-3
    )
    again = simulate(slab, cone[:3], tube=Tube(kV=60, spot_mm=0.0), detector=detector, noise=5,
                     shape=SHAPE)  # fmt: skip
    # No view depends on the others.
    np.testing.assert_array_equal(again.counts(), scan.counts()[:3])


@pytest.mark.filterwarnings("ignore:the focal spot blurs")
@pytest.mark.parametrize("seed", range(3))
def test_points_of_the_spot_blur_each_depth_as_it_is(seed: int) -> None:
    """Two knives at two depths: the width of each edge's shadow by similar triangles."""
    rng = np.random.default_rng(seed)
    sod, sdd, pixel, spot = (
        rng.uniform(40, 60),
        rng.uniform(300, 400),
        0.1,
        rng.uniform(0.08, 0.12),
    )
    depths = (
        rng.uniform(8, 15),
        -rng.uniform(8, 15),
    )  # upper knife, towards the source, and lower
    knives = [
        {"kind": "box", "center": [-15.0, -at, side * 9.52], "size": [30.0, 0.02, 19.0],
         "material": "W@19.25"}
        for at, side in zip(depths, (1, -1), strict=True)
    ]  # fmt: skip
    cone = ConeVec.from_vectors(
        [0, -sod, 0], [0, sdd - sod, 0], [pixel, 0, 0], [0, 0, -pixel]
    )
    ideal = Detector.ideal(bits=16)
    tube = Tube(kV=60, power_W=20, spot_mm=spot)

    def widths(points: int, rays: int = 1) -> list[float]:
        scan = simulate(
            knives,
            cone,
            tube=tube,
            detector=ideal,
            shape=(61, 121),
            spot_points=points,
            rays=rays,
        )
        assert ("spot_points" in " ".join(scan.warnings)) == (points == 1)
        found = []
        for row in (5, 55):
            spread = np.diff(
                np.exp(-scan.truth.line_integrals()[0, row, 36:85].astype(float))
            )
            x = (
                np.arange(len(spread))
                - (spread * np.arange(len(spread))).sum() / spread.sum()
            )
            found.append(float((spread * x**2).sum() / spread.sum()))
        return found

    sigma = spot / 2.3548
    real = [(sdd / (sod - at) - 1) * sigma / pixel for at in depths]
    axis = (sdd / sod - 1) * sigma / pixel
    # The differences of pixels that are 9 rays wide add 1/12 and that of nine points, 20/243.
    found = [np.sqrt(one - 1 / 12 - 20 / 243) for one in widths(64, 3)]
    assert found == pytest.approx(real, rel=0.02)
    blurred = [np.sqrt(one - 1 / 12) for one in widths(1)]
    assert blurred == pytest.approx([axis, axis], rel=0.02)
    assert real[0] > 1.2 * axis > 1.4 * real[1]


@pytest.mark.parametrize("seed", range(4))
def test_no_axis_is_mirrored(seed: int) -> None:
    """Each of three balls of different places throws its shadow where the pinhole says."""
    rng = np.random.default_rng(seed)
    cone = view(rng)
    for place in np.diag([4.0, 3.0, 5.0]):
        ball = {
            "kind": "sphere",
            "center": place.tolist(),
            "radius": 0.8,
            "material": "steel",
        }
        scan = simulate(ball, cone, detector=SHARP, shape=SHAPE)
        dark = 1.0 - transmission(scan)[0]
        rows, cols = np.indices(SHAPE)
        source, centre, u, v = cone.rows[0].reshape(4, 3)
        lands = np.linalg.solve(
            np.column_stack([place - source, -u, -v]), centre - source
        )
        assert (cols * dark).sum() / dark.sum() == pytest.approx(
            lands[1] + 31.5, abs=0.15
        )  # edges fall between pixels
        assert (rows * dark).sum() / dark.sum() == pytest.approx(
            lands[2] + 23.5, abs=0.15
        )  # edges fall between pixels


def test_two_boxes_of_one_mesh_are_exact_without_voxels(tmp_path: Path) -> None:
    boxes = [
        trimesh.creation.box(extents=(4, 6, 8)),
        trimesh.creation.box(extents=(3, 2, 8)),
    ]
    boxes[1].apply_translation((6, 0, 0))
    file = tmp_path / "two.stl"
    trimesh.util.concatenate(boxes).export(file)
    cone = ConeVec.from_vectors([0, -3e5, 0], [0, 2e5, 0], [0.25, 0, 0], [0, 0, -0.25])
    scan = simulate(str(file), cone, shape=(8, 64), material="water")
    (paths,) = scan.truth.paths_mm()[:, 0]
    x = (np.arange(64) - 31.5) * 0.25 * 3 / 5
    assert x.max() < 7.5
    expected = np.where(abs(x) < 2, 6.0, np.where(x > 4.5, 2.0, 0.0))
    np.testing.assert_allclose(paths[4], expected, atol=1e-3)


def test_line_integrals_of_a_ball_a_mesh_and_voxels_add_up() -> None:
    """Aluminium at 50 keV has 0.3681 cm2/g (NIST), which is where phantoms state
    attenuation."""
    cone = view(np.random.default_rng(7))
    ball = {"kind": "sphere", "center": [1, 2, -3], "radius": 4, "material": "Al@2.70"}
    cubes = [trimesh.creation.box(extents=(3, 3, 3)) for _ in range(2)]
    cubes[1].apply_translation((0, 0, 9))
    mesh = trimesh.util.concatenate(cubes)
    per_mm = 0.3681 * 2.7 / 10
    alone = project(ball, cone, shape=SHAPE)[0]
    np.testing.assert_allclose(
        alone, per_mm * chord(cone.rows[0], np.array([1, 2, -3]), 4), rtol=0.01, atol=1e-4
    )
    both = project([ball, (mesh, "water")], cone, shape=SHAPE)[0]
    grid = np.zeros((48, 12, 12), np.float32)  # the same cubes as voxels of 0.25 mm
    grid[:12] = grid[36:] = 1.0
    volume = Volume(grid * np.float32(material("water").mu_per_mm), 0.25, (0.0, 0.0, 4.5))
    np.testing.assert_allclose(
        both - alone, project(volume, cone, shape=SHAPE)[0], atol=2e-4
    )


# -- the same chain as the twin's ------------------------------------------------------------------


@pytest.mark.parametrize("physics", ["poly", "mono"])
def test_the_twin_makes_the_same_counts(tmp_path: Path, physics: str) -> None:
    machine = builtin_machine()
    camera = CameraSettings("HW4SW1High", Roi(800, 600, 1119, 919), 80.0)
    places = poses(machine, builtin_profile(machine.default_profile), camera,
                   {"rot_obj": [0.0, 25.0]})  # fmt: skip
    imaging = Imaging(
        DirectProjector(),
        TrueGeometry(),
        SampleStore(open_data(tmp_path)),
        machine.detector.pixels,
    )
    twin = Radiography.of(imaging, machine, physics)  # type: ignore[arg-type]
    exposure = ExposureSettings(70.0, 20.0, 80.0)
    images = asyncio.run(twin.take(Sample("lego"), places, camera, [exposure] * 2))
    theirs = [twin.counts(image, camera, exposure, frame_rng(9, 2 + i))
              for i, image in enumerate(images)]  # fmt: skip
    spec = machine.detector.model_copy(
        update={"mode": camera.mode, "roi": (800, 600, 1119, 919), "exposure_ms": 80.0}
    )
    ours = simulate(
        "lego",
        places.cone_vec(),
        tube=Tube(kV=70, power_W=20, mono_keV=50.0 if physics == "mono" else None),
        machine=machine.model_copy(update={"detector": spec}),
        noise=9,
        shape=camera.shape,
    )
    np.testing.assert_array_equal(ours.counts(), np.stack(theirs))


# -- what may be given -----------------------------------------------------------------------------

BLOCK = np.zeros((6, 5, 4), np.float32)
BLOCK[1:4, 1:3, 1:2] = 0.02


def test_every_form_of_a_sample(tmp_path: Path) -> None:
    cube = trimesh.creation.box(extents=(2, 3, 4))
    cube.export(tmp_path / "handle.stl")
    (tmp_path / "scene.toml").write_text(SCENE_FILE)
    (tmp_path / "made.json").write_text(json.dumps(load_phantom("normal-2").to_dict()))
    size = {
        "volume": as_phantom(Volume(BLOCK, 0.5)).size_mm,
        "array": as_phantom(BLOCK, voxel_mm=(0.5, 1.0, 2.0)).size_mm,
        "mesh": as_phantom(cube).size_mm,
        "pair": as_phantom((cube, "steel")).size_mm,
        "stl": as_phantom(tmp_path / "handle.stl").size_mm,
        "made": as_phantom(str(tmp_path / "made.json")).size_mm,
        "toml": as_phantom(tmp_path / "scene.toml").size_mm,
        "list": as_phantom(SCENE).size_mm,
    }
    assert size == {
        "volume": (2.0, 2.5, 3.0), "array": (2.0, 5.0, 12.0), "mesh": (2.0, 3.0, 4.0),
        "pair": (2.0, 3.0, 4.0), "stl": (2.0, 3.0, 4.0), "made": (20.0, 40.0, 60.0),
        "toml": (20.0, 20.0, 44.0), "list": (12.0, 12.0, 40.0),
    }  # fmt: skip
    assembly = as_phantom(tmp_path / "scene.toml")
    assert [s.material for s in assembly.scene.solids] == [
        "pmma",
        "pmma",
        "Al@2.70",
        "steel",
    ]
    assert Phantom.from_dict(json.loads(json.dumps(assembly.to_dict()))) == assembly


@pytest.mark.filterwarnings("ignore:100 % of the pixels of the radiographs are starved")
def test_an_array_with_a_material_is_that_material() -> None:
    cone = ConeVec.from_vectors([0, -3e5, 0], [0, 2e5, 0], [0.25, 0, 0], [0, 0, -0.25])
    full = np.ones((8, 12, 8), np.float32)
    scan = simulate(full, cone, shape=(6, 6), voxel_mm=0.5, material="steel")
    paths = scan.truth.paths_mm()
    assert [s.name for s in scan.truth.chain.substances] == ["steel"]
    np.testing.assert_allclose(paths[0, 0], 6.0, rtol=1e-5)
    assert not scan.truth.assumed
    assert simulate(Volume(BLOCK, 0.5), cone, shape=(6, 6)).truth.assumed == (
        "voxels are taken as water of varying density",
    )


LINE = ConeVec.from_vectors([0, -300, 0], [0, 200, 0], [PIXEL, 0, 0], [0, 0, -PIXEL])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            {"scatter": "lots"},
            "scatter is 'lots'; allowed: 'off', 'mc' or a ScatterSettings",
        ),
        ({"scatter": "first"}, "'first' has been removed, use 'mc'"),
        ({"noise": -1}, "seed >= 0"),
        ({"shape": (0, 3)}, "rows and columns from 1"),
        ({"sample": "appel"}, "no sample 'appel'"),
        ({"sample": BLOCK}, "needs voxel_mm"),
        ({"sample": {1, 2}}, "a sample cannot be set"),
        ({"sample": "lego", "material": "steel"}, "its own materials"),
        ({"sample": [Volume(BLOCK, 1.0), "lego"]}, "cannot be put"),
        (
            {"sample": [{"kind": "sphere", "center": [0, 0, 0], "material": "pmma"}]},
            "radius is",
        ),
        ({"detector": Detector(pixel_mm=0.1)}, "the geometry's 0.4 mm"),
        ({"machine": "flexray"}, "whole number times 0.0748"),
        ({"machine": "nowhere"}, "nowhere"),
    ],
)
def test_what_does_not_hold_says_what_is_allowed(
    wrong: dict[str, object], message: str
) -> None:
    with pytest.raises(TwinError, match=message):
        simulate(**{"sample": "normal-2", "geometry": LINE, "shape": SHAPE, **wrong})  # type: ignore[arg-type]


@pytest.mark.filterwarnings("ignore:the flat image is that")
def test_a_detector_or_tube_that_cannot_be() -> None:
    for figures in (
        {"bits": 17},
        {"averages": 1.5},
        {"swank": 0.0},
        {"exposure_ms": float("nan")},
    ):
        with pytest.raises(LimitError, match="allowed"):
            Detector(**figures)  # type: ignore[arg-type]
    with pytest.raises(
        LimitError, match=r"Detector has no argument 'blurr' .did you mean 'blur_mm'"
    ):
        Detector.ideal(blurr=1.0)
    for kV in (5.0, 400.0):
        with pytest.raises(LimitError, match="allowed: 20 to 240 kV"):
            Tube(kV=kV)
    with pytest.raises(GeometryError, match="shape is not known"):
        simulate("lego", LINE)
    far = ConeVec.concatenate([LINE, LINE.moved(np.eye(3), [0, 0, 1])])
    assert not simulate("normal-2", far, detector=SHARP, shape=(4, 4)).warnings
    rows = far.rows.copy()
    rows[1, 4] += 30.0
    assert (
        "flat image"
        in simulate("normal-2", ConeVec(rows), detector=SHARP, shape=(4, 4)).warnings[0]
    )


def test_scatter_is_added_to_what_comes_straight() -> None:
    """Transmission with scatter less transmission without is the scatter that `truth`
    states."""
    cone = ConeVec.circular(sod=300, sdd=500, angles=[0, 3, 90], shape=SHAPE, pixel=PIXEL)
    given = {"tube": Tube(kV=80, mono_keV=60), "detector": SHARP, "noise": 4}
    plain = simulate(SCENE, cone, **given)  # type: ignore[arg-type]
    scan = simulate(SCENE, cone, scatter="mc", **given)  # type: ignore[arg-type]
    assert plain.truth.scatter is None
    added = np.exp(-scan.truth.line_integrals()) - np.exp(-plain.truth.line_integrals())
    stated = np.stack([scan.truth.scatter[i].signal for i in range(3)])
    assert stated.shape == added.shape
    assert stated.min() > 0.0005
    assert stated.max() < 0.05
    np.testing.assert_allclose(added, stated, atol=2e-6)
    # In the counts, too, and the same ones with the same seed.
    lost = scan.counts().astype(float) - plain.counts()
    open_beam = scan.flat.astype(float) - scan.dark
    np.testing.assert_allclose(lost.mean() / open_beam.mean(), stated.mean(), rtol=0.02)
    again = simulate(SCENE, cone, scatter="mc", **given)  # type: ignore[arg-type]
    np.testing.assert_array_equal(again.counts(), scan.counts())
    assert all(
        one.error.mean() < 0.03 * one.mean.mean() for one in scan.truth.scatter.images
    )


RODS = [
    {"kind": "cylinder", "center": [0, 0, 0], "radius": 20, "height": 30, "material": "pmma"},
    {"kind": "cylinder", "center": [10, 0, 0], "radius": 5, "height": 30, "material": "aluminium",
     "replaces": "pmma"},
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.campaign
def test_scatter_is_subtracted_from_a_scan_of_two_materials() -> None:
    """Scatter by other photons, a finer grid and more nodes than the correction's own."""
    cone = ConeVec.circular(sod=300, sdd=400, angles=72, shape=(48, 64), pixel=1.2)
    tube = Tube(kV=90, power_W=3, filters=[("Al@2.70", 2.0)])
    fine = ScatterSettings(seed=77, error=0.02, voxels=80_000, nodes=400, step_deg=45.0)
    made = [
        simulate(RODS, cone, tube=tube, detector=Detector.ideal(bits=16), scatter=scatter)
        for scatter in ("off", fine)
    ]
    assert not any(data.warnings for data in made)
    given = {"voxel": 0.8, "shape": (3, 60, 60)}
    plain, scattered = (data.reconstruct(**given) for data in made)
    corrected = made[1].reconstruct(
        scatter_correction=["pmma", "aluminium"], tube=tube, **given
    )
    at = (np.arange(60) - 29.5) * 0.8
    y, x = np.meshgrid(at, at, indexing="ij")
    places = {
        "centre": np.hypot(x, y) < 3,
        "rim": (np.hypot(x, y) > 14) & (np.hypot(x, y) < 18) & (x < 0),
        "rod": np.hypot(x - 10, y) < 3,
    }
    for where in places.values():
        truth, before, after = (
            float(volume.data[1][where].mean())
            for volume in (plain, scattered, corrected)
        )
        assert abs(before / truth - 1) > 0.02
        assert after == pytest.approx(truth, rel=0.006)


def test_a_scatter_grid_keeps_the_mass_of_solids_meshes_and_voxels() -> None:
    """A ball, the mesh of a box and voxels, off the coarse planes, against their volumes."""
    ball = as_phantom(
        {"kind": "sphere", "center": [1, 0, 2], "radius": 3, "material": "pmma"}
    )
    mesh = as_phantom(trimesh.creation.box((4.0, 5.0, 7.0)), material="aluminium")
    voxels = as_phantom(
        np.full((7, 10, 8), 0.5, np.float32), voxel_mm=0.7, material="pmma"
    )
    for phantom, volume in (
        (ball, 36 * np.pi),
        (mesh, 140.0),
        (voxels, 560 * 0.5 * 0.7**3),
    ):
        grid = scatter_object(channels(phantom), phantom.size_mm, 900)
        found = grid.amounts.sum(dtype=float) * np.prod(grid.voxel_mm)
        assert found == pytest.approx(volume, rel=0.02)
        assert 500 < grid.amounts.size < 2000


BALL = {"kind": "sphere", "center": [0, 0, 0], "radius": 5, "material": "pmma"}


def _by_the_texts(folder: Path, count: int, shape: tuple[int, int]) -> np.ndarray:
    """(n, 12) rows from `scan settings.txt` alone, by the meaning of its keys: HC, VC and COR
    from the edge of the corner pixel, angles growing clockwise seen from above.
    """
    lines = (folder / "scan settings.txt").read_text().splitlines()
    said = dict(re.split(r"\s*:\s*", line, maxsplit=1) for line in lines if ":" in line)
    sod, sdd, pixel = (float(said[k]) for k in ("SOD", "SDD", "Binned pixel size"))
    hc, vc, cor = (float(said[k]) for k in ("HC", "VC", "COR"))
    axis = (cor - hc) * pixel * sod / sdd
    panel = ((shape[1] / 2 - hc) * pixel, sdd, (vc - shape[0] / 2) * pixel)
    found = []
    for phi in np.linspace(float(said["Start angle"]), float(said["Last angle"]), count):
        c, s = np.cos(np.radians(phi)), np.sin(np.radians(phi))
        turn = np.array(
            [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        )  # the object clockwise, its scanner not
        places = [(-axis, -sod, 0), (panel[0] - axis, panel[1] - sod, panel[2])]
        found.append([turn @ p for p in (*places, (pixel, 0, 0), (0, 0, -pixel))])
    return np.reshape(found, (count, 12))


@pytest.mark.parametrize("seed", range(3))
def test_a_saved_simulation_has_the_texts_of_a_scanner(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    count, shape = (
        int(rng.integers(2, 6)),
        (int(rng.integers(8, 12)), int(rng.integers(8, 14))),
    )
    scan = ConeVec.circular(
        sod=rng.uniform(100, 600), sdd=rng.uniform(700, 1100), shape=shape, pixel=rng.uniform(1, 3),
        angles=rng.uniform(-300, 300) + rng.uniform(-90, 90) * np.arange(count),
        offset=rng.uniform(-3, 3, 2),
    )  # fmt: skip
    made = simulate(BALL, scan, tube=Tube(kV=70.0, power_W=20.0), noise=1)
    made.save(tmp_path / "made")
    assert np.abs(_by_the_texts(tmp_path / "made", count, shape) - scan.rows).max() < 1e-4
    for lost in ("geometry.json", "scan settings.txt"):  # then the second text alone
        (tmp_path / "made" / lost).unlink()
        read = load_dataset(tmp_path / "made")
        assert np.abs(read.geometry.rows - scan.rows).max() < 1e-4
        assert read.settings is not None
        assert (read.settings.kV, read.settings.power_W) == (70.0, 20.0)
        assert np.array_equal(read.counts(), made.counts())


@pytest.mark.parametrize(
    "wrong", [{"tilts": (0.5, 0, 0)}, {"angles": [0, 10, 30]}, {"height": 4.0}], ids=str
)
def test_texts_that_would_say_another_geometry_are_not_written(
    wrong: dict[str, object], tmp_path: Path
) -> None:
    options = {
        "sod": 200,
        "sdd": 400,
        "angles": 3,
        "shape": (8, 9),
        "pixel": 2.0,
        **wrong,
    }
    scan = ConeVec.circular(**options)  # type: ignore[arg-type]
    simulate(BALL, scan, noise=1).save(tmp_path / "made")
    assert not list((tmp_path / "made").glob("*settings*"))
    assert np.allclose(load_dataset(tmp_path / "made").geometry.rows, scan.rows)


@pytest.mark.filterwarnings("ignore:the focal spot blurs")
def test_pixels_need_not_be_square() -> None:
    """Place and size by hand; area and blur are those of the pixels, in mm alike both ways."""
    pitch = (0.2, 0.5)
    view = ConeVec.from_vectors(
        [0, -400, 0], [0, 400, 0], [pitch[0], 0, 0], [0, 0, -pitch[1]]
    )
    ball = {"kind": "sphere", "center": [3, 0, -5], "radius": 4, "material": "aluminium"}
    panel = Detector.ideal(bits=16, electrons_per_count=400.0, blur_mm=1.0)
    tube = Tube(kV=60, spot_mm=1.5)
    shape = (90, 200)
    scan = simulate(ball, view, tube=tube, detector=panel, shape=shape)
    shadow = 1.0 - scan.counts(0) / scan.flat
    rows, cols = (axis.astype(np.float64) for axis in np.indices(shape))
    weight = shadow / shadow.sum()
    centre = [(weight * cols).sum(), (weight * rows).sum()]
    assert centre == pytest.approx([99.5 + 2 * 3 / 0.2, 44.5 + 2 * 5 / 0.5], abs=0.02)
    across = (weight * (cols - centre[0]) ** 2).sum() * pitch[0] ** 2
    down = (weight * (rows - centre[1]) ** 2).sum() * pitch[1] ** 2
    assert across == pytest.approx(down, rel=0.01)
    fine = Detector.ideal(bits=16, electrons_per_count=400.0, blur_mm=0.0)
    sharp = simulate(
        ball, view, tube=Tube(kV=60, spot_mm=0.0), detector=fine, shape=shape
    )
    edge = 1.0 - sharp.counts(0) / sharp.flat
    before = (edge / edge.sum() * (rows - centre[1]) ** 2).sum() * pitch[1] ** 2
    # Variances add: 1 mm of light, and the spot's at magnification 2.
    assert down - before == pytest.approx(1.0 + (1.5 / 2.3548) ** 2, rel=0.05)
    square = replace_rows(view, 0.2)
    alike = {"tube": tube, "exposure_ms": scan.truth.exposure.exposure_ms}
    less = simulate(ball, square, detector=panel, shape=shape, **alike).flat
    assert (scan.flat[45, 100] - 100) / (less[45, 100] - 100) == pytest.approx(
        2.5, rel=0.01
    )
    # The panel of a machine has the file's pitches, and no others.
    with pytest.raises(
        LimitError, match=r"0.2 x 0.5 mm; allowed .* one whole number times"
    ):
        simulate(ball, view, machine="xyzr_cabinet", shape=shape)
    uneven = ConeVec(np.concatenate([view.rows, square.rows]), shape)
    with pytest.raises(GeometryError, match=r"0.2 to 0.5 mm along v; allowed: alike"):
        simulate(ball, uneven, shape=shape)


def replace_rows(view: ConeVec, row_mm: float) -> ConeVec:
    """The same view with another pitch from row to row."""
    rows = view.rows.copy()
    rows[:, 9:12] *= row_mm / np.linalg.norm(rows[0, 9:12])
    return ConeVec(rows)
