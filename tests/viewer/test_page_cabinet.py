"""The cabinet stands around all that the machine's parts reach, however large the machine
is."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.clients.viewer.scenes.meshes.cabinet import cabinet, room_of
from flexdt.clients.viewer.scenes.meshes.part_looks import pieces_of
from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import (
    Machine,
    builtin_machine,
    builtin_machines,
    profile_of,
)

DRAWN = 8
SIZES = (0.05, 2.5)
"""Of the shipped machines: 11 cm to 10 m."""


def scaled(name: str, factor: float) -> Machine:
    """A shipped machine with every part and travel larger or smaller."""
    shipped = builtin_machine(name)
    axes = {
        name: axis
        if axis.kind == "rotation"
        else axis.model_copy(
            update={
                end: getattr(axis, end) * factor for end in ("lower", "upper", "home")
            }
        )
        for name, axis in shipped.axes.items()
    }
    parts = tuple(
        part.model_copy(
            update={
                what: tuple(factor * v for v in getattr(part, what))
                for what in ("size_mm", "center_mm")
            }
        )
        for part in shipped.components
    )
    return shipped.model_copy(update={"axes": axes, "components": parts})


def drawn_corners(machine: Machine, rng: np.random.Generator) -> FloatArray:
    """Corners of the parts as they are drawn, at drawn positions and at the ends of travel."""
    bodies = {b.name: b for b in build_scene(machine, profile_of(machine)).bodies}
    looks = {
        part.name: np.concatenate([piece.mesh.vertices for piece in pieces_of(part)])
        for part in machine.components
    }
    limits = np.array([(a.lower, a.upper) for a in machine.axes.values()])
    out = []
    for k in range(16):
        share = rng.random(len(limits)) if k % 2 else rng.integers(0, 2, len(limits))
        q = limits[:, 0] + share * (limits[:, 1] - limits[:, 0])
        for name, vertices in looks.items():
            turn = bodies[name].rotation(float(q @ bodies[name].turns))
            out.append(vertices @ turn.T + bodies[name].origin + q @ bodies[name].slides)
    return np.concatenate(out)


def require_around(machine: Machine, rng: np.random.Generator) -> None:
    room = room_of(machine)
    pieces, lamp = cabinet(room)
    walls = pieces[0].mesh.vertices
    low, high = walls.min(axis=0), walls.max(axis=0)
    inside = drawn_corners(machine, rng)
    assert (inside.min(axis=0) > low).all()
    assert (inside.max(axis=0) < high).all()
    assert ((lamp > low) & (lamp < high)).all()
    # No more room than in proportion: the walls are near the machine.
    gaps = np.concatenate([room.low - low, high - room.high])
    assert 0.0 < gaps.min() <= gaps.max() <= 351 * room.scale
    assert room.floor_mm == pytest.approx(low[2])
    whole = np.concatenate([p.mesh.vertices for p in pieces])
    assert (whole.max(axis=0) - whole.min(axis=0)).max() < 4 * (
        room.high - room.low
    ).max()


@pytest.mark.parametrize("name", builtin_machines())
def test_the_cabinet_is_around_shipped_and_scaled_machines(name: str) -> None:
    rng = np.random.default_rng(len(name))
    require_around(builtin_machine(name), rng)
    for _ in range(DRAWN // 4):
        require_around(scaled(name, float(np.exp(rng.uniform(*np.log(SIZES))))), rng)


def test_the_flexrays_cabinet_is_as_it_was() -> None:
    pieces, _ = cabinet(room_of(builtin_machine()))
    walls = pieces[0].mesh.vertices
    assert walls.min(axis=0).tolist() == [-1150.0, -600.0, -405.0]
    assert walls.max(axis=0)[:2].tolist() == [1150.0, 1700.0]
