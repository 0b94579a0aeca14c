"""Parts with meshes: the convex bodies around them, beside linear programs and least
squares."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from scipy.optimize import linprog, nnls

from flexdt.twin.collision import outer_hull as hulls
from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.convex_solids import hull
from flexdt.twin.collision.first_contact import clearance
from flexdt.twin.collision.outer_hull import outer_hull
from flexdt.twin.errors import MachineFileError, TwinError
from flexdt.twin.machine.description import (
    MAX_POINTS,
    Machine,
    Vector3,
    parse_machine,
    profile_of,
)

Points = npt.NDArray[np.float64]
TEXT = """base = "xyzr_cabinet"
name = "mine"
[[components]]
name = "arm"
parent = "x_carriage"
anchor = "object"
mesh = "arm.stl"
mesh_at_mm = [0.0, 250.0, 60.0]
[[components]]
name = "shield"
mesh = "shield.stl"
mesh_at_mm = [30.0, 700.0, 80.0]
"""


def drawn(rng: np.random.Generator, many: int, size: float = 60.0) -> Points:
    """Points all over a lopsided ellipsoid."""
    points = rng.normal(size=(many, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return np.asarray(
        size * rng.uniform(0.3, 1.0, 3) * points + rng.uniform(-5.0, 5.0, 3)
    )


@pytest.mark.parametrize("seed", range(4))
def test_planes_of_a_body_are_those_of_its_faces(seed: int) -> None:
    """All corners are behind each plane, at least three of them in it."""
    body = hull(drawn(np.random.default_rng(seed), 12))
    planes = hulls._planes(body)
    assert len(planes) == len(body.faces)
    heights = body.vertices @ planes[:, :3].T + planes[:, 3]
    assert heights.max() <= 1e-9
    assert ((np.abs(heights) < 1e-9).sum(axis=0) >= 3).all()


def inside(point: Points, corners: Points) -> bool:
    """Whether a point is a mean of corners with some weights: a linear program."""
    system = np.vstack([corners.T, np.ones(len(corners))])
    found = linprog(
        np.zeros(len(corners)), A_eq=system, b_eq=[*point, 1.0], bounds=(0.0, None)
    )
    return bool(found.status == 0)


def apart(a: Points, b: Points) -> float:
    """Distance of two convex hulls: least squares over weights that are not negative."""
    heavy = 1e4
    sides = [[*np.full(len(a), heavy), *np.zeros(len(b))],
             [*np.zeros(len(a)), *np.full(len(b), heavy)]]  # fmt: skip
    system = np.vstack([np.hstack([a.T, -b.T]), sides])
    weights, _ = nnls(system, [0.0, 0.0, 0.0, heavy, heavy], maxiter=20_000)
    left, right = weights[: len(a)], weights[len(a) :]
    return float(np.linalg.norm(left @ a / left.sum() - right @ b / right.sum()))


def machine_with(meshes: Mapping[str, Points]) -> Machine:
    def corners(name: str) -> list[Vector3]:
        return [(x, y, z) for x, y, z in outer_hull(meshes[name]).vertices.tolist()]

    return parse_machine(TEXT, "mine.toml", corners)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("many", [40, 1500])
def test_a_body_around_points_leaves_none_outside_and_is_tight(
    seed: int, many: int
) -> None:
    rng = np.random.default_rng(seed)
    points = drawn(rng, many)
    body = outer_hull(points)
    assert len(body.vertices) <= MAX_POINTS
    assert all(inside(p, body.vertices) for p in rng.choice(points, 25))
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    out = (body.vertices @ directions.T).max(axis=0) - (points @ directions.T).max(axis=0)
    assert out.min() > -1e-9
    assert out.max() < 1e-6 + (many > MAX_POINTS) * 0.03 * np.ptp(points, axis=0).max()


def test_planes_that_cut_different_corners_are_taken_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each plane adds about two corners, so that 256 take 120 rounds one by one, 15 by
    eights."""
    rounds = []

    def counted(planes: list[Points], inside: Points) -> Points:
        rounds.append(len(planes))
        return corners(planes, inside)

    corners = hulls._corners
    monkeypatch.setattr(hulls, "_corners", counted)
    outer_hull(drawn(np.random.default_rng(1), 1500))
    assert len(rounds) < 40


def test_flat_faces_of_a_turned_part_stay_flat() -> None:
    drum = trimesh.creation.cylinder(40.0, 120.0, sections=500)
    drum.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    body = outer_hull(drum.vertices)
    corners = body.vertices[body.faces]
    volume = float(np.linalg.det(corners).sum()) / 6.0
    assert volume == pytest.approx(np.pi * 40.0**2 * 120.0, rel=1e-3)
    # A plate without thickness is a body, too.
    angle = np.linspace(0.0, 6.2, 600)
    plate = outer_hull(
        np.column_stack([50 * np.cos(angle), 50 * np.sin(angle), 0 * angle])
    )
    assert np.ptp(plate.vertices[:, 2]) < 0.01


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("many", [30, 1200])
def test_clearance_of_parts_with_meshes_is_that_of_their_hulls(
    seed: int, many: int
) -> None:
    """Of few points it is exact, of many it is on the safe side."""
    rng = np.random.default_rng(100 * seed + many)
    meshes = {"arm.stl": drawn(rng, many), "shield.stl": drawn(rng, many)}
    machine = machine_with(meshes)
    scene = build_scene(machine, profile_of(machine))
    arm, shield = meshes["arm.stl"] + [0, 250, 60], meshes["shield.stl"] + [30, 700, 80]
    found = 0
    for _ in range(4):
        at = {"X": rng.uniform(-60, 60), "Z": rng.uniform(150, 320), "Y": 0.0, "R": 0.0}
        true = apart(arm + [at["X"], at["Z"], 0.0], shield)
        nearest = clearance(scene, at)
        if true < 1.0 or set(nearest.pair) != {"arm", "shield"}:
            continue
        found += 1
        assert nearest.mm < true + 1e-5
        assert nearest.mm > true - (1e-3 if many < MAX_POINTS else 6.0)
    assert found


def test_a_document_of_a_machine_with_meshes_is_read_without_them() -> None:
    machine = machine_with({n: drawn(np.random.default_rng(3), 30) for n in
                            ("arm.stl", "shield.stl")})  # fmt: skip
    part = next(p for p in machine.components if p.name == "shield")
    points = np.array(part.points_mm)
    np.testing.assert_allclose(part.size_mm, np.ptp(points, axis=0), atol=1e-9)
    np.testing.assert_allclose(
        part.center_mm, (points.max(0) + points.min(0)) / 2, atol=1e-9
    )
    assert Machine.model_validate_json(machine.model_dump_json(by_alias=True)) == machine


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('mesh = "arm.stl"', 'mesh = "arm.stl"\nsize_mm = [1.0, 1.0, 1.0]',
         r"mine.toml: components.arm.size_mm: must be left out: the mesh says it"),
        ('mesh = "arm.stl"', "mesh = 3", r"components.arm.mesh: must be a file's name \(value: 3"),
        ("[0.0, 250.0, 60.0]", "[0.0, 250.0]", "components.arm.mesh_at_mm: must be three numbers"),
        ("[0.0, 250.0, 60.0]", '"here"', "components.arm.mesh_at_mm: must be three numbers"),
        ("[0.0, 250.0, 60.0]", "[0.0, 1e9, 0.0]", "center_mm"),
        ('mesh = "arm.stl"\nmesh_at_mm = [0.0, 250.0, 60.0]',
         'shape = "hull"\nsize_mm = [1.0, 1.0, 1.0]\ncenter_mm = [0.0, 0.0, 0.0]',
         "points_mm: must be there for a hull"),
        ('mesh = "arm.stl"\nmesh_at_mm = [0.0, 250.0, 60.0]',
         'shape = "hull"\npoints_mm = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]\n'
         "size_mm = [2.0, 1.0, 1.0]\ncenter_mm = [0.5, 0.5, 0.5]",
         "size_mm: must be those of the box around points_mm"),
        ('mesh = "arm.stl"', 'mesh = "gone.stl"', "components.arm.mesh: no such file gone.stl"),
    ],
)  # fmt: skip
def test_what_does_not_hold_of_a_mesh_is_told_with_file_and_part(
    old: str, new: str, message: str
) -> None:
    def corners(name: str) -> list[Vector3]:
        if name == "gone.stl":
            raise TwinError(f"no such file {name}")
        return [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]

    assert old in TEXT
    with pytest.raises(MachineFileError, match=message):
        parse_machine(TEXT.replace(old, new), "mine.toml", corners)


def test_where_no_files_are_read_a_mesh_is_refused() -> None:
    with pytest.raises(
        MachineFileError, match=r"arm\.mesh: must be left out: no files are read"
    ):
        parse_machine(TEXT)
