"""Both representations of a phantom: same origin, same size, same mass."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import trimesh

from flexdt.phantoms import (
    Phantom,
    PhantomError,
    load_phantom,
    material,
    mesh_phantom,
    voxel_phantom,
)
from flexdt.phantoms.channels import channels, line_integrals
from flexdt.phantoms.files.phantom_files import load_phantom_file
from flexdt.phantoms.pieces import Surface
from flexdt.phantoms.samples import as_phantom
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, rotation_about
from flexdt.twin.projection import forward, project_body, project_scene
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

TURN = rotation_about([0.3, -0.5, 0.8], 1.1)
AXES = tuple(tuple(row) for row in TURN.T.tolist())
TILTED = (0.6, 0.0, 0.8)
CENTER = (1.5, -2.0, 0.75)
SHAPES: list[tuple[Shape, float]] = [
    (Sphere(CENTER, 4.0), 4 / 3 * math.pi * 64),
    (Box(CENTER, (3.0, 5.0, 7.0), AXES), 105.0),  # type: ignore[arg-type]
    (Cylinder(CENTER, 2.5, 8.0, TILTED), math.pi * 6.25 * 8),
    (Cylinder(CENTER, 2.5, 8.0), math.pi * 6.25 * 8),
    (Ellipsoid(CENTER, (2.0, 3.0, 4.0), AXES), 4 / 3 * math.pi * 24),  # type: ignore[arg-type]
    (
        ConvexPolyhedron(
            tuple((sx / 3**0.5, sy / 3**0.5, sz / 3**0.5)
                  for sx in (1, -1) for sy in (1, -1) for sz in (1, -1)),
            tuple(3.0 + (sx * 1.5 - sy * 2.0 + sz * 0.75) / 3**0.5
                  for sx in (1, -1) for sy in (1, -1) for sz in (1, -1)),
        ),
        4 / 3 * (3.0 * 3**0.5) ** 3,  # octahedron |x| + |y| + |z| <= a
    ),
]  # fmt: skip
BOX = (20.0, 20.0, 20.0)


def centroid(data: np.ndarray, voxel: float) -> FloatArray:
    """(x, y, z) of the centre of mass of a [z, y, x] grid about the origin."""
    total = float(data.sum(dtype=np.float64))
    out = []
    for axis in (2, 1, 0):
        n = data.shape[axis]
        at = (np.arange(n) - (n - 1) / 2) * voxel
        other = tuple(a for a in range(3) if a != axis)
        out.append(float((data.sum(axis=other, dtype=np.float64) * at).sum() / total))
    return np.array(out)


@pytest.mark.parametrize(("shape", "volume"), SHAPES, ids=lambda v: type(v).__name__)
def test_solids_keep_mass_and_place_as_voxels_and_as_mesh(
    shape: Shape, volume: float
) -> None:
    p = Phantom("one", "", Scene((Solid(shape, "water", 0.5),)), BOX)
    grid = p.volume(0.25, oversample=4)
    assert float(grid.data.sum(dtype=np.float64)) * 0.25**3 == pytest.approx(
        volume / 2, rel=3e-3
    )
    assert float(grid.data.max()) == pytest.approx(0.5, rel=1e-5)
    assert centroid(grid.data, 0.25) == pytest.approx(CENTER, abs=0.02)
    mesh = p.mesh()
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume, rel=0.02)
    assert mesh.center_mass == pytest.approx(CENTER, abs=1e-6)


def test_the_chiral_phantom_is_not_mirrored_or_permuted_in_the_grid() -> None:
    p = load_phantom("chiral")
    grid = p.volume(0.5)
    nz, ny, nx = grid.data.shape
    assert (nx, ny, nz) == (80, 68, 92)
    body = float(np.median(grid.data))
    for bead in p.beads:
        x, y, z = (int(v // 0.5 + n / 2) for v, n in zip(bead, (nx, ny, nz), strict=True))
        assert grid.data[z, y, x] > 3 * body
        assert grid.data[nz - 1 - z, ny - 1 - y, nx - 1 - x] == pytest.approx(body)


def test_shepp_logan_takes_the_tables_contrasts() -> None:
    """Values of the usual table along the middle: 1, 0.2, and 0.2 + 0.1 in the upper
    ellipse."""
    p = load_phantom("shepp-logan")
    grid = p.volume(0.25)
    water = 0.02269
    nz, ny, nx = grid.data.shape

    def at(x: float, y: float, z: float) -> float:
        i = [
            int(c * 25.0 // 0.25 + n / 2)
            for c, n in zip((x, y, z), (nx, ny, nz), strict=True)
        ]
        return float(grid.data[i[2], i[1], i[0]]) / water

    assert at(0.0, 0.9, 0.0) == pytest.approx(1.0, abs=1e-3)
    assert at(0.0, -0.3, 0.0) == pytest.approx(0.2, abs=1e-3)
    assert at(0.0, 0.35, -0.15) == pytest.approx(0.3, abs=1e-3)
    assert at(0.22, 0.0, 0.0) == pytest.approx(0.0, abs=1e-3)


def filled(mesh: trimesh.Trimesh, voxel: float = 0.2) -> float:
    surface = Surface(mesh.vertices, mesh.faces, "water", 1.0)
    p = Phantom("m", "", Scene(()), BOX, surfaces=(surface,))
    return float(p.volume(voxel).data.sum(dtype=np.float64)) * voxel**3


def test_a_torus_fills_to_its_volume() -> None:
    torus = trimesh.creation.torus(6.0, 2.0)
    assert filled(torus) == pytest.approx(torus.volume, rel=1e-4)
    assert torus.volume == pytest.approx(2 * math.pi**2 * 6 * 4, rel=0.02)


def test_hollow_overlapping_and_inside_out_meshes_fill_rightly() -> None:
    outer, inner = trimesh.creation.box((8, 8, 8)), trimesh.creation.box((4, 4, 4))
    inner.invert()
    assert filled(trimesh.util.concatenate([outer, inner])) == pytest.approx(
        512 - 64, rel=1e-4
    )
    moved = trimesh.creation.box((8, 8, 8))
    moved.apply_translation((2.0, 0.0, 0.0))
    both = trimesh.util.concatenate([trimesh.creation.box((8, 8, 8)), moved])
    assert filled(both) == pytest.approx(10 * 64, rel=1e-4)
    inside_out = trimesh.creation.icosphere(3, 5.0)
    volume = inside_out.volume
    inside_out.invert()
    assert filled(inside_out) == pytest.approx(volume, rel=1e-3)


def test_faces_and_edges_on_column_centres_do_not_leak() -> None:
    """A box whose edges run exactly through column centres, where careless fills leave
    streaks."""
    box = trimesh.creation.box((6.0, 6.0, 6.0))
    box.apply_translation((0.25, 0.25, 0.25))  # edges at 3.25: centres of 0.5 mm voxels
    surface = Surface(box.vertices, box.faces, "water", 1.0)
    data = (
        Phantom("m", "", Scene(()), BOX, surfaces=(surface,))
        .volume(0.5, oversample=1)
        .data
    )
    assert np.count_nonzero(data) == 12 * 12 * 13
    assert float(data.sum()) == pytest.approx(12 * 12 * 12)


def test_an_open_mesh_is_refused_by_the_voxeliser() -> None:
    box = trimesh.creation.box((8, 8, 8))
    top = np.flatnonzero(box.face_normals[:, 2] > 0.5)[0]
    surface = Surface(box.vertices, np.delete(box.faces, top, axis=0), "water", 1.0)
    with pytest.raises(PhantomError, match="not closed"):
        Phantom("m", "", Scene(()), BOX, surfaces=(surface,)).volume(0.5)


def test_grids_too_large_are_refused_before_memory_is() -> None:
    with pytest.raises(PhantomError, match="too many"):
        load_phantom("wide").volume(0.001)
    with pytest.raises(PhantomError, match="above 0"):
        load_phantom("wide").volume(0.0)


def test_voxel_phantoms_come_back_as_they_came() -> None:
    data = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    p = voxel_phantom(data, (1.0, 2.0, 3.0), center_mm=(0.0, 0.0, 5.0))
    v = p.volume()
    assert np.array_equal(v.data, data)
    assert tuple(v.voxel_mm) == (1.0, 2.0, 3.0)
    assert p.mesh().bounds.tolist() == [[-2.0, -3.0, 2.0], [2.0, 3.0, 8.0]]
    with pytest.raises(PhantomError, match="not finite"):
        voxel_phantom(np.full((2, 2, 2), np.nan, dtype=np.float32), 1.0)


@pytest.mark.parametrize("name", ["chiral", "lego"])
def test_voxels_cast_the_shadow_of_the_analytic_solids(name: str) -> None:
    """The two X-ray representations through the projector, from an oblique direction."""
    p = load_phantom(name)
    turn = rotation_about([0.0, 0.2, 1.0], 0.7)
    cone = ConeVec.from_vectors(
        [0.0, -300.0, 10.0], [0.0, 200.0, -3.0], [0.8, 0, 0], [0, 0, -0.8]
    )
    cone = cone.moved(turn, [0.0, 0.0, 0.0])
    exact = project_scene(p.scene, cone, (120, 100))[0]

    def error(voxel_mm: float, flip: bool = False) -> float:
        image = forward(p.volume(voxel_mm), cone, (120, 100))[0, :, :: -1 if flip else 1]
        return float(np.abs(image - exact).sum() / exact.sum())

    assert error(0.2) < 0.02
    assert error(0.2) < 0.6 * error(0.4)
    assert error(0.4, flip=True) > 0.1


def test_a_convex_mesh_becomes_exact_half_spaces() -> None:
    stl = trimesh.creation.box((4, 6, 8)).export(file_type="stl")
    p = mesh_phantom(stl, file_type="stl", material="water")
    assert p.is_analytic
    solid = p.scene.solids[0]
    assert isinstance(solid.shape, ConvexPolyhedron)
    assert sorted(solid.shape.offsets) == pytest.approx([2, 2, 3, 3, 4, 4])
    assert p.mesh().volume == pytest.approx(192.0)


@pytest.mark.parametrize("seed", range(3))
def test_labels_are_one_grid_for_each_material(seed: int) -> None:
    """Paths of a ray along y are sums over its column of voxels, done here by hand."""
    rng = np.random.default_rng(seed)
    names = {3: "pmma", 7: "steel", 200: "Al@2.70"}
    labels = rng.choice([0, *names], size=(5, 6, 7), p=[0.4, 0.3, 0.1, 0.2])
    edges = tuple(rng.uniform(0.2, 0.9, 3).tolist())
    phantom = as_phantom(labels, material=names, voxel_mm=edges)
    assert Phantom.from_dict(json.loads(json.dumps(phantom.to_dict()))) == phantom
    parts = {c.material.name: c for c in channels(phantom)}
    total = 0.0
    k, i = int(rng.integers(5)), int(rng.integers(7))
    at = ((i - 3) * edges[0], (k - 2) * edges[2])
    view = ConeVec.from_vectors(
        (at[0], -400, at[1]), (at[0], 400, at[1]), (1, 0, 0), (0, 0, -1)
    )
    for label, name in names.items():
        [[[path]]] = project_body(parts[name].body, view, (1, 1))
        wanted = float((labels[k, :, i] == label).sum() * edges[1])
        assert path == pytest.approx(wanted, abs=1e-5)
        total += wanted * material(name).mu_per_mm
    assert line_integrals(phantom, view, (1, 1))[0, 0, 0] == pytest.approx(
        total, rel=1e-5
    )
    for bad, said in (
        (labels - 1, "labels"),
        (labels.astype(str), "array"),
        ("lego", "'lego'"),
    ):
        with pytest.raises(PhantomError, match=said):
            as_phantom(bad, material=names, voxel_mm=edges)
    with pytest.raises(PhantomError, match="allowed are 0 for nothing"):
        as_phantom(labels, material={**names, 0: "water"}, voxel_mm=edges)


@pytest.mark.parametrize("worst", [255.0, 2.0, -1.0, 1.01])
def test_parts_of_voxels_are_from_0_to_1(worst: float) -> None:
    part = np.zeros((3, 4, 5))
    part[1, 1, 1] = worst
    with pytest.raises(PhantomError, match="0 to 1"):
        as_phantom(part, material="pmma", voxel_mm=1.0)
    part[1, 1, 1] = 1.0
    as_phantom(part, material="pmma", voxel_mm=1.0)


@pytest.mark.parametrize("seed", range(4))
def test_what_is_replaced_must_be_there_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = {"kind": "box", "center": [0, 0, 0], "size": rng.uniform(8, 12, 3).tolist(),
            "material": "steel"}  # fmt: skip

    def ball(x: float, y: float, z: float) -> dict[str, object]:
        return {"kind": "sphere", "center": [x, y, z], "radius": 1.9, "material": "pmma",
                "replaces": "steel"}  # fmt: skip

    place = rng.uniform(-2, 2, 3)
    as_phantom([body, ball(*place)])
    as_phantom([body, ball(-2, 0, 0), ball(2, 0, 0)])
    for wrong in (
        [ball(*place)], [body, ball(0, 0, body["size"][2] / 2)],
        [body, ball(*place), ball(*(place + 0.5))], ball(*place),
    ):  # fmt: skip
        with pytest.raises(PhantomError, match="steel is replaced where"):
            as_phantom(wrong)
    hole = Scene((Solid(Sphere((0.0, 0.0, 0.0), 1.0), "hole", -0.01),))
    as_phantom([body, hole])  # a scene by itself says what it is
    text = json.dumps({"schema": 1, "solid": [ball(*place)]})
    with pytest.raises(PhantomError, match="steel is replaced where"):
        load_phantom_file(text)
