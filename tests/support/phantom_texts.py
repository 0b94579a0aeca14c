"""Phantom files as a user writes them: beads in a block, and a scene of solids and a mesh."""

from __future__ import annotations

BEAD_FILE = """\
schema = 1
name = "mine"
description = "two steel beads in a PMMA block"

[body]                          # leave out for beads in air
size_mm = [20, 20, 40]          # along x, y, z; centred on the rotation axis
material = "pmma"

[[bead]]
position_mm = [5, 0, -12]       # object frame: x right, y away from the source, z up at rot_obj = 0
radius_mm = 1
material = "steel"              # the default

[[bead]]
position_mm = [0, 6, 12]
radius_mm = 1
"""
"""A bead file with two beads; `[spiral] beads = 5, radius_mm = 2` may stand for the beads."""


SCENE_FILE = """\
schema = 1
name = "assembly"

[[solid]]                       # solids add up; where one lies in another, say what it replaces
kind = "cylinder"               # sphere, box, cylinder, ellipsoid or convex
center = [0, 0, 0]
radius = 10
height = 30
material = "pmma"               # of the table, or FORMULA@DENSITY [g/cm3]

[[solid]]
kind = "sphere"
center = [4, 0, 5]
radius = 2
material = "Al@2.70"
replaces = "pmma"

[[mesh]]
file = "handle.stl"             # beside this file
material = "steel"
unit = "mm"                     # the default: m for GLB, mm for the others
position_mm = [0, 0, 20]        # of the middle of its box; left out: where the file has it
priority = 1                    # where meshes overlap, the highest is there alone; else 0
"""
"""A scene file: two solids and a mesh."""
