"""The lead cabinet around the machine, as painted meshes (mm).

It is drawn only; no collision knows of it. Its walls are seen from the inside alone, so whatever
stands between a camera and the machine is cut away. A kerb shows where they go; the wall opposite
the operator has the door, with a window of lead glass and the lamp that says whether X-rays are on.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import trimesh

from flexdt.clients.viewer.scenes.meshes.painted_meshes import Paint, PaintedMesh, bevelled
from flexdt.clients.viewer.scenes.meshes.paints import ANODISED, SIGNAL, STEEL
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Component, Machine

ROOM_MM: Final = (150.0, 150.0, 450.0)
"""Between the machine's largest part and the walls; above that part, what towers need and more."""
DOOR_MM: Final = (900.0, 1050.0)
WALL = Paint((208, 213, 220), 0.0, 0.9)
FLOOR = Paint((120, 127, 138), 0.0, 0.95)
DOOR = Paint((232, 236, 241), 0.0, 0.7)
GLASS = Paint((58, 92, 104), 0.1, 0.25)
LAMP = {False: (92, 98, 106), True: (255, 243, 196)}
"""X-rays on or not -> colour of the lamp: no red, in which the page draws parts that touch."""


def ground_of(machine: Machine) -> Component:
    """The part on which the others stand."""
    return max(machine.components, key=lambda part: part.size_mm[0] * part.size_mm[1])


def cabinet(machine: Machine, floor_mm: float) -> tuple[list[PaintedMesh], FloatArray]:
    """The cabinet's pieces, and where its lamp is, (3,).

    Args:
        machine: around the largest of whose parts it stands.
        floor_mm: height of the floor.
    """
    ground = ground_of(machine)
    towers = max(part.size_mm[2] for part in machine.components)
    half = np.array(ground.size_mm) / 2 + ROOM_MM
    low = np.array(ground.center_mm) - half
    high = np.array(ground.center_mm) + half
    low[2], high[2] = floor_mm, ground.center_mm[2] + towers + ROOM_MM[2]
    (x0, y0, z0), (x1, y1, _) = low, high
    door_y, (wide, door_top) = 0.3 * y0 + 0.7 * y1, (DOOR_MM[0], z0 + DOOR_MM[1])
    left, right = door_y - wide / 2, door_y + wide / 2
    room = trimesh.creation.box(bounds=[low, high])
    upward = room.face_normals[:, 2].copy()
    room.invert()  # it is seen from within
    walls, floor = room, room.copy()
    walls.update_faces(abs(upward) < 0.5)
    floor.update_faces(upward < -0.5)
    middle, tall = (door_top + z0) / 2, DOOR_MM[1]
    on_wall = [
        bevelled((8, wide + 60, tall + 60), (x0 + 4, door_y, middle), ANODISED),
        bevelled((14, wide, tall), (x0 + 7, door_y, middle), DOOR, 4.0),
        bevelled((18, 440, 340), (x0 + 9, door_y, door_top - 280), ANODISED),
        bevelled((20, 400, 300), (x0 + 10, door_y, door_top - 280), GLASS),
        bevelled((40, 26, 220), (x0 + 30, left + 90, door_top - 560), STEEL, 8.0),
        bevelled((16, 150, 150), (x0 + 9, right - 170, door_top - 590), SIGNAL),
    ]
    for piece in on_wall:  # as the wall, it is seen from within alone
        piece.mesh.update_faces(piece.mesh.face_normals[:, 0] > 0.2)
    kerb = [
        bevelled((x1 - x0 + 80, 40, 60), (0.5 * (x0 + x1), y, z0 + 30), STEEL)
        for y in (y0 - 20, y1 + 20)
    ] + [
        bevelled((40, y1 - y0, 60), (x, 0.5 * (y0 + y1), z0 + 30), STEEL)
        for x in (x0 - 20, x1 + 20)
    ]
    pieces = [PaintedMesh(walls, WALL), PaintedMesh(floor, FLOOR), *on_wall, *kerb]
    return pieces, np.array([x0 + 45.0, door_y, door_top + 130.0])
