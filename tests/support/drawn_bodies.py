"""The bodies of `area_integrals` as the projectors take them: solids, and cones as meshes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from area_integrals import Drawn

from flexdt.twin.projection import Body, Scene, Solid, TriangleMesh
from flexdt.twin.projection.analytic_solids import Box, Cylinder, Sphere

SECTIONS = 512
"""Sides of a cone's mesh: its paths are 2.5e-5 short."""


def parts_of(bodies: Sequence[Drawn]) -> list[tuple[Body, float]]:
    """Bodies and factors whose projections add up."""
    solids: list[Solid] = []
    out: list[tuple[Body, float]] = []
    for one in bodies:
        center: Any = tuple(one.center.tolist())
        axes: Any = tuple(map(tuple, one.axes.tolist()))
        if one.kind == "sphere":
            solids.append(Solid(Sphere(center, one.size[0]), "a", one.mu))
        elif one.kind == "box":
            size: Any = tuple(2 * x for x in one.size)
            solids.append(Solid(Box(center, size, axes), "a", one.mu))
        elif one.kind == "cylinder":
            shape = Cylinder(center, one.size[0], 2 * one.size[2], axes[2])
            solids.append(Solid(shape, "a", one.mu))
        else:
            out.append((cone(one), one.mu))
    return [(Scene(tuple(solids)), 1.0), *out] if solids else out


def cone(one: Drawn) -> TriangleMesh:
    """A cone's mesh, with corners half outside the circle so that its volume is the cone's."""
    turn = 2 * np.pi * np.arange(SECTIONS) / SECTIONS
    step = 2 * np.pi / SECTIONS
    radius = one.size[0] * np.sqrt(step / np.sin(step))
    rim = np.stack(
        [radius * np.cos(turn), radius * np.sin(turn), 0 * turn - one.size[2]], 1
    )
    points = np.concatenate([rim, [[0, 0, one.size[2]], [0, 0, -one.size[2]]]])
    i = np.arange(SECTIONS)
    j = (i + 1) % SECTIONS
    tip, base = np.full_like(i, SECTIONS), np.full_like(i, SECTIONS + 1)
    faces = np.concatenate([np.stack([i, j, tip], 1), np.stack([j, i, base], 1)])
    return TriangleMesh(points @ one.axes + one.center, faces)
