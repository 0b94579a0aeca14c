"""The lead cabinet around the machine, as painted meshes (mm).

It is drawn only; collisions ignore it. Its walls are seen from the inside alone, so those
between a camera and the machine are cut away. A kerb shows their place; the wall opposite
the operator has the door, with a window of lead glass and the lamp that shows whether
X-rays are on.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import trimesh

from flexdt.clients.viewer.scenes.meshes.painted_meshes import (
    Paint,
    PaintedMesh,
    bevelled,
)
from flexdt.clients.viewer.scenes.meshes.paints import ANODISED, SIGNAL, STEEL
from flexdt.clients.viewer.scenes.meshes.part_looks import pieces_of
from flexdt.twin.collision.stages import stage_bodies
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Component, Machine, profile_of

DRAWN_FOR_MM: Final = (2000.0, 1390.0)
"""Reach of the FleX-ray's parts sideways and upwards, for which all lengths below hold
[mm]; those of another machine are in proportion, by the smaller."""
ROOM_MM: Final = (150.0, 150.0, 350.0)
"""Distance of the walls from all that the machine's parts reach; above it, room for
lamps [mm]."""
BELOW_MM: Final = 45.0
"""Distance from the lowest part to the floor [mm]."""
DOOR_MM: Final = (900.0, 1050.0)
EDGE_MM: Final = 2.0
"""Width cut off the edges of blocks [mm]."""
WALL = Paint((208, 213, 220), 0.0, 0.9)
FLOOR = Paint((120, 127, 138), 0.0, 0.95)
DOOR = Paint((232, 236, 241), 0.0, 0.7)
GLASS = Paint((58, 92, 104), 0.1, 0.25)
LAMP = {False: (92, 98, 106), True: (255, 243, 196)}
"""X-rays on or not -> color of the lamp: no red, in which the page draws parts that touch."""


def ground_of(machine: Machine) -> Component:
    """Find the part that carries the others."""
    return max(machine.components, key=lambda part: part.size_mm[0] * part.size_mm[1])


class Room(NamedTuple):
    """Space of a machine.

    Attributes:
        low, high: corners of all that its parts reach, (3,) [mm].
        scale: its size over that of the FleX-ray.
        floor_mm: height of the floor.
    """

    low: FloatArray
    high: FloatArray
    scale: float
    floor_mm: float


def room_of(machine: Machine) -> Room:
    """Compute the `Room` of a machine: box of its parts' reach, scale, and floor [mm].

    The scale is the smaller ratio of reach to `DRAWN_FOR_MM`, across or up; the floor
    lies `BELOW_MM` times it lower.
    """
    low, high = reach_of(machine)
    across = (high - low)[:2].max()
    tall = (high - low)[2]
    scale = float(min(across / DRAWN_FOR_MM[0], tall / DRAWN_FOR_MM[1]))
    return Room(low, high, scale, float(low[2]) - BELOW_MM * scale)


def reach_of(machine: Machine) -> tuple[FloatArray, FloatArray]:
    """Compute the box of all that the machine's drawn parts reach over their travel.

    A part that turns is taken at any angle about z. Each part is the box of its drawn
    vertices, moved over all axis limits at once; the box of a turning part holds its
    circle about z.

    Args:
        machine: with axes and components.

    Returns:
        Lowest and highest corner (3,) [mm].
    """
    limits = np.array([(axis.lower, axis.upper) for axis in machine.axes.values()])
    bodies = {body.name: body for body in stage_bodies(machine, profile_of(machine))}
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for part in machine.components:
        body = bodies[part.name]
        corners = np.concatenate([piece.mesh.vertices for piece in pieces_of(part)])
        if body.turns.any():  # at any angle
            radius = float(np.linalg.norm(corners[:, :2], axis=1).max())
            corners = np.concatenate(
                [corners, np.array([[-radius] * 2 + [0], [radius] * 2 + [0]])]
            )
        ends = body.slides[None] * limits.T[:, :, None]
        low = np.minimum(
            low, body.origin + corners.min(axis=0) + ends.min(axis=0).sum(axis=0)
        )
        high = np.maximum(
            high, body.origin + corners.max(axis=0) + ends.max(axis=0).sum(axis=0)
        )
    return low, high


def cabinet(room: Room) -> tuple[list[PaintedMesh], FloatArray]:
    """Build the cabinet around all that the machine's parts reach.

    Walls, floor, and door with handle, window and sign are seen from within only. Walls and
    floor are the inside of a box, `ROOM_MM` beyond the machine; the ceiling is left out.
    Door, window, handle and sign are on the wall at lowest x; four steel kerbs surround the
    floor. All lengths scale with `room.scale`. The lamp itself is not among the pieces.

    Args:
        room: of the machine.

    Returns:
        Pieces, and the place of its lamp (3,) [mm].
    """
    s = room.scale
    low = room.low - s * np.array(ROOM_MM)
    high = room.high + s * np.array(ROOM_MM)
    low[2] = room.floor_mm
    (x0, y0, z0) = low
    (x1, y1, _) = high
    door_y = 0.3 * y0 + 0.7 * y1
    (wide, tall) = s * np.array(DOOR_MM)
    door_top = z0 + tall
    left = door_y - wide / 2
    right = door_y + wide / 2
    walls = trimesh.creation.box(bounds=[low, high])
    upward = walls.face_normals[:, 2].copy()
    walls.invert()  # they are seen from within
    floor = walls.copy()
    walls.update_faces(abs(upward) < 0.5)
    floor.update_faces(upward < -0.5)
    middle = (door_top + z0) / 2

    def block(
        size: tuple[float, ...],
        at: tuple[float, ...],
        paint: Paint,
        edge: float = EDGE_MM,
    ) -> PaintedMesh:
        return bevelled(size, at, paint, edge * s)

    pane = door_top - 280 * s
    on_wall = [
        block(
            (8 * s, wide + 60 * s, tall + 60 * s), (x0 + 4 * s, door_y, middle), ANODISED
        ),
        block((14 * s, wide, tall), (x0 + 7 * s, door_y, middle), DOOR, 4.0),
        block((18 * s, 440 * s, 340 * s), (x0 + 9 * s, door_y, pane), ANODISED),
        block((20 * s, 400 * s, 300 * s), (x0 + 10 * s, door_y, pane), GLASS),
        block(
            (40 * s, 26 * s, 220 * s),
            (x0 + 30 * s, left + 90 * s, door_top - 560 * s),
            STEEL,
            8.0,
        ),
        block(
            (16 * s, 150 * s, 150 * s),
            (x0 + 9 * s, right - 170 * s, door_top - 590 * s),
            SIGNAL,
        ),
    ]
    for piece in on_wall:  # as the wall, it is seen from within alone
        piece.mesh.update_faces(piece.mesh.face_normals[:, 0] > 0.2)
    kerb = [
        block(
            (x1 - x0 + 80 * s, 40 * s, 60 * s), (0.5 * (x0 + x1), y, z0 + 30 * s), STEEL
        )
        for y in (y0 - 20 * s, y1 + 20 * s)
    ] + [
        block((40 * s, y1 - y0, 60 * s), (x, 0.5 * (y0 + y1), z0 + 30 * s), STEEL)
        for x in (x0 - 20 * s, x1 + 20 * s)
    ]
    pieces = [PaintedMesh(walls, WALL), PaintedMesh(floor, FLOOR), *on_wall, *kerb]
    return pieces, np.array([x0 + 45.0 * s, door_y, door_top + 130.0 * s])
