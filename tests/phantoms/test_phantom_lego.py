"""The LEGO phantom against the thesis's dimensions and a hand-made inside test."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexdt.phantoms import load_phantom, material
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.analytic_solids import Box, Cylinder, Scene, Sphere

ABS = material("abs").mu_per_mm


def inside(scene: Scene, p: FloatArray, materials: tuple[str, ...]) -> FloatArray:
    """Sum of attenuation at points (n, 3), written apart from the voxeliser."""
    total = np.zeros(len(p))
    for s in scene.solids:
        if s.material not in materials:
            continue
        match s.shape:
            case Sphere(center, radius):
                hit = np.linalg.norm(p - center, axis=1) < radius
            case Box(center, size, axes):
                hit = (np.abs((p - center) @ np.array(axes).T) < np.array(size) / 2).all(
                    axis=1
                )
            case Cylinder(center, radius, height, axis):
                along = (p - center) @ np.array(axis)
                across = np.linalg.norm(p - center - np.outer(along, axis), axis=1)
                hit = (np.abs(along) < height / 2) & (across < radius)
            case other:
                raise AssertionError(other)
        total += s.mu_per_mm * hit
    return total


def test_the_thesis_dimensions() -> None:
    p = load_phantom("lego")
    assert p.size_mm == pytest.approx((24.0, 16.0, 49.8))
    assert len(p.beads) == 5
    assert p.bead_radius_mm == pytest.approx(1.0)
    low, high = p.mesh().bounds
    assert low == pytest.approx([-12, -8, -24.9], abs=1e-9)
    assert high == pytest.approx([12, 8, 24.9], abs=1e-9)
    assert any("wall_mm" in a for a in p.assumed)


def test_one_bead_in_each_brick_on_a_spiral_out_of_any_plane() -> None:
    p = load_phantom("lego")
    for k, bead in enumerate(p.beads):
        floor = -24.9 + 9.6 * k
        assert floor + 1.0 < bead[2] < floor + 8.6
    angles = np.unwrap(np.arctan2(p.beads[:, 1] / 5.5, p.beads[:, 0] / 9.5))
    assert np.diff(angles) == pytest.approx(2 * math.pi / 5)
    assert np.linalg.svd(p.beads - p.beads.mean(axis=0))[1].min() > 4.0


def test_attenuation_is_nowhere_negative_or_doubled() -> None:
    """Random points see air, plastic or steel, nothing in between: no solids overlap."""
    p = load_phantom("lego")
    points = np.random.default_rng(1).uniform(
        [-12, -8, -24.9], [12, 8, 24.9], (200_000, 3)
    )
    plastic = inside(p.scene, points, ("abs",))
    assert set(np.unique(np.round(plastic / ABS, 9) + 0.0)) == {0.0, 1.0}
    both = inside(p.scene, points, ("abs", "steel"))
    steel = material("steel").mu_per_mm
    levels = np.unique(np.round(both, 9) + 0.0)
    assert levels == pytest.approx([0.0, ABS, steel])


def test_mesh_voxels_and_arithmetic_agree_on_the_plastic() -> None:
    brick = 24 * 16 * 9.6 - 21 * 13 * 8.1 + 6 * math.pi * 2.4**2 * 1.8
    brick += 2 * math.pi * (3.255**2 - 2.4**2) * 8.1
    p = load_phantom("lego")
    meshes = [q for q in p.parts() if q.material == "abs"]
    volume = sum(-q.mesh.volume if q.hole else q.mesh.volume for q in meshes)
    assert volume == pytest.approx(5 * brick, rel=2e-3)  # round parts have 48 sides
    beads = 5 * 4 / 3 * math.pi * material("steel").mu_per_mm
    grid = p.volume(0.25, oversample=4)
    total = float(grid.data.sum(dtype=np.float64)) * 0.25**3
    assert total == pytest.approx(5 * brick * ABS + beads, rel=2e-3)


def test_beads_are_visible_parts_of_their_own() -> None:
    steel = [q for q in load_phantom("lego").parts() if q.material == "steel"]
    assert len(steel) == 5
    assert all(q.mesh.is_watertight and not q.hole for q in steel)
    centers = np.array([q.mesh.vertices.mean(axis=0) for q in steel])
    assert centers == pytest.approx(load_phantom("lego").beads, abs=1e-9)
