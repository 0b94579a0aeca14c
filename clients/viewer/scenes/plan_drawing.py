"""A scrubbed plan: a blue ghost of the machine and the focal spot's path; and the ray of a
pixel.

They are drawn for the viser clients of one page alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import viser

from flexdt.clients.viewer.scenes.meshes.collision_bodies import bare
from flexdt.clients.viewer.scenes.meshes.painted_meshes import plain
from flexdt.clients.viewer.scenes.world import MM, quaternion
from flexdt.twin.collision.collision_scene import CollisionScene
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine

SCREEN: Any = {"thickness_units": "screen"}
"""Lines have a width in pixels."""
GHOST = (60, 130, 255)
AROUND_MM = 2.0
"""A ghost is so much larger on each side that none of its faces lies in one of the part now."""
PATH = (90, 120, 255)
HOME = "/object/plan"
"""The node that holds the paths in all scenes: one switch for all of them."""
ORBIT = f"{HOME}/orbit"
RAY = "/ray"
RAY_COLOR = (255, 60, 160)


class PlanDrawing:
    """Ghosts and paths in clients' own scenes.

    Args:
        machine: whose parts.
        collision: its collision bodies.
    """

    def __init__(self, machine: Machine, collision: CollisionScene) -> None:
        self._collision = collision
        moving = {part.name for part in machine.components if machine.chain(part)}
        self._moving = [body for body in collision.bodies if body.name in moving]

    def ghost(
        self, clients: Sequence[viser.ClientHandle], positions: Mapping[str, float]
    ) -> None:
        """Show some clients the moving parts at other motor positions.

        Made at the first call, moved later; bodies that no axis moves are left out.
        Positions of axes that are not given are 0. The meshes are the bare collision
        bodies, a little larger, blue and translucent.

        Args:
            clients: that get the ghost.
            positions: motor -> [mm, deg].
        """
        q = self._collision.vector(positions)
        for client in clients:
            with client.atomic():
                if client.scene.get_handle_by_name("/ghost") is None:
                    client.scene.add_frame("/ghost", show_axes=False)
                for body in self._moving:
                    name = f"/ghost/{body.name}"
                    turn = quaternion(body.rotation(float(q @ body.turns)))
                    at = tuple(((body.origin + q @ body.slides) * MM).tolist())
                    handle = client.scene.get_handle_by_name(name)
                    if handle is None:
                        vertices, faces = plain(bare(body.solid))
                        vertices = vertices + np.sign(
                            vertices - 0.5 * (vertices.min(0) + vertices.max(0))
                        ) * np.float32(AROUND_MM * MM)
                        client.scene.add_mesh_simple(
                            name,
                            vertices,
                            faces,
                            color=GHOST,
                            opacity=0.28,
                            side="double",
                            cast_shadow=False,
                            receive_shadow=False,
                            wxyz=turn,
                            position=at,
                        )
                    else:
                        handle.wxyz = turn
                        handle.position = at

    def unghost(self, clients: Iterable[viser.ClientHandle]) -> None:
        """Show them no longer."""
        _remove(clients, "/ghost")

    def orbit(
        self, clients: Sequence[viser.ClientHandle], points: FloatArray | None
    ) -> None:
        """Show some clients the focal spot's path (n, 3) [mm], object frame.

        It replaces a former path; None removes that.
        """
        if points is None:
            steps = None
        else:
            steps = np.stack([points[:-1], points[1:]], axis=1)
        _draw_lines(clients, ORBIT, steps, PATH, 1.5)

    def ray(self, clients: Sequence[viser.ClientHandle], ends: FloatArray | None) -> None:
        """Show some clients a ray, (2, 3) [mm, world]; None: no longer."""
        _draw_lines(clients, RAY, None if ends is None else ends[None], RAY_COLOR, 3.0)


def _draw_lines(
    clients: Sequence[viser.ClientHandle],
    name: str,
    lines: FloatArray | None,
    color: tuple[int, int, int],
    px: float,
) -> None:
    """Replace the lines (n, 2, 3) [mm] that clients had under this name, `px` thick; None
    or no lines remove them.

    `color` is (r, g, b); coordinates are converted to [m].
    """
    _remove(clients, name)
    if lines is not None and len(lines):
        for client in clients:
            client.scene.add_line_segments(
                name, lines * MM, color, thickness=px, **SCREEN
            )


def _remove(clients: Iterable[viser.ClientHandle], name: str) -> None:
    """Remove a node by name from the scenes of some clients; those without it are left
    alone.
    """
    for client in clients:
        handle = client.scene.get_handle_by_name(name)
        if handle is not None:
            handle.remove()
