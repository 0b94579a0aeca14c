"""The gear's paths and volume against plain geometry."""

from __future__ import annotations

import math

import numpy as np
import trimesh

from flexdt.phantoms import load_phantom, material


def test_the_gears_surface_is_closed_and_has_the_volume_of_its_cross_sections() -> None:
    """A slanted tooth has the area of a straight one at every height."""
    body = load_phantom("gear").surfaces[0]
    mesh = trimesh.Trimesh(body.vertices, body.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    angle = np.linspace(0.0, 2.0 * np.pi, 160, endpoint=False)
    wanted = 0.0
    for teeth, foot, tip, height in ((20, 17.0, 20.0, 14.0), (10, 8.5, 11.0, 16.0)):
        wave = np.clip(1.6 * np.cos(teeth * angle), -1.0, 1.0)
        radius = 0.5 * (foot + tip) + 0.5 * (tip - foot) * wave
        outer = 0.5 * math.sin(2.0 * math.pi / 160) * float(radius @ np.roll(radius, 1))
        bore = 0.5 * math.sin(2.0 * math.pi / 160) * 160 * 9.0
        wanted += height * (outer - bore)
    assert abs(mesh.volume / wanted - 1.0) < 0.004


def test_the_gears_voxels_hold_plastic_windows_and_pores() -> None:
    step = 0.5
    made = load_phantom("gear").volume(step)
    plastic = material("abs").mu_per_mm
    assert made.data.min() > -1e-6
    assert abs(made.data.max() - plastic) < 1e-6
    nz, ny, nx = made.data.shape

    def at(x: float, y: float, z: float) -> float:
        cx, cy, cz = made.center_mm
        place = ((z - cz) / step + (nz - 1) / 2, (y - cy) / step + (ny - 1) / 2,
                 (x - cx) / step + (nx - 1) / 2)  # fmt: skip
        return float(made.data[tuple(round(p) for p in place)])

    assert abs(at(12.6, 0.0, -8.0)) < 1e-6  # a window
    assert abs(at(0.0, 0.0, 5.0)) < 1e-6  # the bore
    turn = math.radians(262.0)
    assert at(15.6 * math.cos(turn), 15.6 * math.sin(turn), -8.0) < 1e-6  # a pore
    assert abs(at(6.0, 0.0, 5.0) - plastic) < 1e-6
