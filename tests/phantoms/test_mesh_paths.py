"""Radiographs of mesh samples have exact paths; bodies that overlap count once, cavities
not."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from traced_mesh import traced

from flexdt.phantoms import material, mesh_phantom
from flexdt.phantoms.channels import attenuating, channels, line_integrals
from flexdt.phantoms.pieces import PhantomError
from flexdt.phantoms.samples import as_phantom
from flexdt.server.imaging.projections import Imaging, TrueGeometry
from flexdt.testing.in_process import DirectProjector
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.projection import TriangleMesh, project_body
from flexdt.twin.scanner.state import Sample

SHAPE = (40, 50)


def view(rng: np.random.Generator) -> np.ndarray:
    """From a drawn direction, 200 mm to the object, 100 more to the panel."""
    ahead = rng.normal(size=3)
    ahead /= np.linalg.norm(ahead)
    u = np.cross(ahead, rng.normal(size=3))
    u /= np.linalg.norm(u)
    return np.concatenate([-200 * ahead, 100 * ahead, u, np.cross(ahead, u)])


def lumps(
    rng: np.random.Generator, at: np.ndarray, turned: bool = False
) -> trimesh.Trimesh:
    """A ball with a rough surface about `at`, which is not convex."""
    ball = trimesh.creation.icosphere(2, 1.0)
    corners = ball.vertices * rng.uniform(4.0, 7.0, (len(ball.vertices), 1)) + at
    return trimesh.Trimesh(
        corners, ball.faces[:, ::-1] if turned else ball.faces, process=False
    )


def drawn(kind: str, rng: np.random.Generator) -> trimesh.Trimesh:
    zero = np.zeros(3)
    if kind == "one":
        return lumps(rng, zero)
    if kind == "apart":
        return trimesh.util.concatenate(
            [lumps(rng, zero), lumps(rng, np.array([0.0, 15.0, 3.0]))]
        )
    if kind == "overlapping":
        return trimesh.util.concatenate(
            [lumps(rng, zero), lumps(rng, rng.uniform(-4, 4, 3))]
        )
    hole = lumps(rng, zero, turned=True)
    hole.vertices *= 0.4  # a cavity is a shell turned inwards
    return trimesh.util.concatenate([lumps(rng, zero), hole])


@pytest.mark.parametrize("kind", ["one", "apart", "overlapping", "hollow"])
@pytest.mark.parametrize("seed", range(3))
def test_line_integrals_of_drawn_meshes(kind: str, seed: int) -> None:
    rng = np.random.default_rng(50 + seed)
    mesh = drawn(kind, rng)
    phantom = mesh_phantom(mesh.export(file_type="ply"), file_type="ply", place="keep")
    [(body, factor)] = attenuating(phantom)
    assert factor == material("abs").mu_per_mm
    row = view(rng)
    got = line_integrals(phantom, ConeVec(row[None]), SHAPE)[0].ravel()
    pixels = rng.choice(got.size, 400, replace=False)
    path = traced(mesh.vertices, mesh.faces, row, SHAPE, pixels)
    known = np.isfinite(path)
    assert known.sum() > 360
    assert path[known].max() > 4.0
    error = got[pixels][known] / material("abs").mu_per_mm - path[known]
    assert (
        np.abs(error).max() < 1e-5 * 14.0 + 2e-6 * got.max() / material("abs").mu_per_mm
    )
    [channel] = channels(phantom)
    assert isinstance(body, TriangleMesh)
    assert isinstance(channel.body, TriangleMesh)
    paths = project_body(channel.body, ConeVec(row[None]), SHAPE)[0].ravel()
    np.testing.assert_allclose(paths[pixels][known], path[known], atol=2e-4)


def together(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    return trimesh.util.concatenate(meshes)


@pytest.mark.parametrize("seed", range(4))
def test_where_meshes_overlap_the_highest_is_there_alone(seed: int) -> None:
    """Beside lengths of unions, which rays that meet triangles one by one give: what a mesh has
    for itself is the union of it and those above, less the union of those above."""
    rng = np.random.default_rng(70 + seed)
    meshes = [lumps(rng, rng.uniform(-5, 5, 3)) for _ in range(4)]
    ranks = rng.permutation([0.0, 1.0, 2.0, 2.0])  # equal ones add up
    names = ["abs", "pmma", "steel", "aluminium"]
    phantom = as_phantom(list(zip(meshes, names, strict=True)), priority=ranks.tolist())
    row = view(rng)
    pixels = rng.choice(SHAPE[0] * SHAPE[1], 400, replace=False)

    def union(some: list[trimesh.Trimesh]) -> np.ndarray:
        if not some:
            return np.zeros(len(pixels))
        whole = together(some)
        return traced(whole.vertices, whole.faces, row, SHAPE, pixels)

    parts = {channel.material.name: channel.body for channel in channels(phantom)}
    told = 0
    for mesh, name, rank in zip(meshes, names, ranks, strict=True):
        above = [other for other, its in zip(meshes, ranks, strict=True) if its > rank]
        path = union([mesh, *above]) - union(above)
        known = np.isfinite(path)
        assert known.sum() > 340
        got = project_body(parts[name], ConeVec(row[None]), SHAPE)[0].ravel()[pixels]
        np.testing.assert_allclose(got[known], path[known], atol=2e-4)
        told += path[known].max() > 3.0
    assert told >= 3


def test_priorities_of_a_scene_file_and_what_is_refused(tmp_path: Path) -> None:
    inner, outer = trimesh.creation.box((4.0,) * 3), trimesh.creation.box((10.0,) * 3)
    inner.export(tmp_path / "inner.stl")
    outer.export(tmp_path / "outer.stl")
    text = """
[[mesh]]
file = "outer.stl"
material = "pmma"
[[mesh]]
file = "inner.stl"
material = "steel"
priority = RANK
"""
    file = tmp_path / "scene.toml"
    row = ConeVec.from_vectors([0, -500, 0], [0, 500, 0], [1, 0, 0], [0, 0, -1])
    for rank, pmma in (("1", 6.0), ("0", 10.0), ("-1", 10.0)):
        file.write_text(text.replace("RANK", rank))
        parts = {c.material.name: c for c in channels(as_phantom(file))}
        paths = {
            n: float(project_body(c.body, row, (1, 1))[0, 0, 0]) for n, c in parts.items()
        }
        assert paths.pop("pmma") == pytest.approx(pmma, abs=1e-5)
        # Inside another of higher priority there is nothing of it.
        assert paths == ({} if rank == "-1" else {"steel": pytest.approx(4.0, abs=1e-5)})
    file.write_text(text.replace("RANK", '"first"'))
    with pytest.raises(PhantomError, match=r"phantom.mesh\[1\].priority"):
        as_phantom(file)
    with pytest.raises(PhantomError, match="1 priorities for 2 parts"):
        as_phantom([inner, outer], priority=[1.0])
    # Solids with flat faces are cut, too; round ones cannot be, unless they are apart.
    box = {"kind": "box", "center": [0, 0, 0], "size": [8, 8, 8], "material": "abs"}
    ball = {"kind": "sphere", "center": [0, 0, 0], "radius": 3, "material": "abs"}
    parts = {c.material.name: c for c in channels(as_phantom([box, (inner, "Fe@7.87")],
                                                             priority=[0, 1]))}  # fmt: skip
    assert project_body(parts["abs"].body, row, (1, 1))[0, 0, 0] == pytest.approx(
        4.0, abs=1e-5
    )
    with pytest.raises(
        PhantomError, match=r"a sphere of abs overlaps .* replaces instead"
    ):
        as_phantom([ball, (inner, "steel")], priority=[0, 1])
    apart = as_phantom([{**ball, "center": [9, 0, 0]}, (inner, "steel")], priority=[0, 1])
    assert apart.scene.solids[0].shape.radius == 3  # type: ignore[union-attr]


def test_the_twins_images_of_a_mesh_are_exact() -> None:
    rng = np.random.default_rng(8)
    mesh = lumps(rng, np.zeros(3))
    phantom = mesh_phantom(mesh.export(file_type="stl"), file_type="stl")
    store: Any = SimpleNamespace(load=lambda name, material: phantom)
    machine = builtin_machine()
    profile = builtin_profile(machine.default_profile)
    camera = CameraSettings("HW2SW1High", Roi(572, 568, 1371, 967))
    imaging = Imaging(DirectProjector(), TrueGeometry(), store, machine.detector.pixels)
    pose = poses(machine, profile, camera, {"rot_obj": [35.0]})
    lines = asyncio.run(imaging.line_integrals(Sample("rough"), pose, camera))[0].ravel()
    found, paths, rows, _ = asyncio.run(
        imaging.path_lengths(Sample("rough"), pose, camera)
    )
    assert len(found) == 1
    row = np.array(rows[0])
    shadow = np.flatnonzero(lines)
    assert len(shadow) > 300
    pixels = rng.choice(shadow, 300, replace=False)
    path = traced(mesh.vertices, mesh.faces, row, camera.shape, pixels)
    known = np.isfinite(path)
    assert path[known].max() > 5.0
    np.testing.assert_allclose(paths[0, 0].ravel()[pixels][known], path[known], atol=2e-4)
    mu = material("abs").mu_per_mm
    np.testing.assert_allclose(lines[pixels][known], mu * path[known], atol=1e-5)
