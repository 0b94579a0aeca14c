"""What touches what, and when: distances and sweeps over convex parts."""

from flexdt.twin.collision.guard import scene_guard
from flexdt.twin.collision.planning import direct_contact, plan_move
from flexdt.twin.collision.sample import convex_pieces
from flexdt.twin.collision.scene import Scene, build_scene
from flexdt.twin.collision.search import (
    Clearance,
    Contact,
    SweepResult,
    clearance,
    sweep,
    touching,
)
from flexdt.twin.collision.solids import Cylinder, Polytope, box, hull

__all__ = [
    "Clearance",
    "Contact",
    "Cylinder",
    "Polytope",
    "Scene",
    "SweepResult",
    "box",
    "build_scene",
    "clearance",
    "convex_pieces",
    "direct_contact",
    "hull",
    "plan_move",
    "scene_guard",
    "sweep",
    "touching",
]
