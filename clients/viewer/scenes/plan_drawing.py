"""A scrubbed plan in the scene: a blue ghost of the machine and the focal spot's path.

It is drawn for the viser clients of one page alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import viser

from flexdt.clients.viewer.scenes import collision_bodies as bodies
from flexdt.clients.viewer.scenes import sample as solids
from flexdt.clients.viewer.scenes.sample import MM
from flexdt.clients.viewer.scenes.world import quaternion
from flexdt.twin.collision.stages import Body
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine

GHOST = (60, 130, 255)
PATH = (90, 120, 255)
HOME = "/object/plan"
"""The node that holds the paths in all scenes: one switch for all of them."""
ORBIT = f"{HOME}/orbit"


class PlanDrawing:
    """Ghosts and paths in clients' own scenes.

    Args:
        machine: whose axes.
        parts: its collision bodies, by component.
    """

    def __init__(self, machine: Machine, parts: Mapping[str, Body]) -> None:
        self._machine, self._axes = machine, tuple(machine.axes)
        self._moving = {p.name: parts[p.name] for p in machine.components if machine.chain(p)}

    def ghost(self, clients: Sequence[viser.ClientHandle], positions: Mapping[str, float]) -> None:
        """Show some clients where the moving parts would be for motor positions [mm, deg]."""
        q = np.array([positions.get(n, self._machine.axes[n].home) for n in self._axes])
        for client in clients:
            with client.atomic():
                if client.scene.get_handle_by_name("/ghost") is None:
                    client.scene.add_frame("/ghost", show_axes=False)
                for name, body in self._moving.items():
                    turn = quaternion(body.rotation(float(q @ body.turns)))
                    at = tuple(((body.origin + q @ body.slides) * MM).tolist())
                    handle = client.scene.get_handle_by_name(f"/ghost/{name}")
                    if handle is None:
                        vertices, faces = solids.plain(bodies.bare(body.solid))
                        client.scene.add_mesh_simple(
                            f"/ghost/{name}", vertices, faces, color=GHOST, opacity=0.28,
                            side="double", cast_shadow=False, receive_shadow=False,
                            wxyz=turn, position=at,
                        )  # fmt: skip
                    else:
                        handle.wxyz, handle.position = turn, at

    def unghost(self, clients: Iterable[viser.ClientHandle]) -> None:
        """Show them no longer."""
        _remove(clients, "/ghost")

    def orbit(self, clients: Sequence[viser.ClientHandle], points: FloatArray | None) -> None:
        """Show some clients the focal spot's path as the sample sees it; None: no longer.

        Args:
            clients: that see it.
            points: (n, 3) [mm], object frame.
        """
        _remove(clients, ORBIT)
        if points is None or len(points) < 2:
            return
        segments = (np.stack([points[:-1], points[1:]], axis=1) * MM).astype(np.float32)
        for client in clients:
            client.scene.add_line_segments(
                ORBIT, segments, PATH, thickness=1.5, thickness_units="screen"
            )


def _remove(clients: Iterable[viser.ClientHandle], name: str) -> None:
    for client in clients:
        handle = client.scene.get_handle_by_name(name)
        if handle is not None:
            handle.remove()
