"""What touches what, and when: distances and sweeps over convex parts."""

from flexdt.twin.collision.collision_scene import Scene, build_scene
from flexdt.twin.collision.convex_solids import Cylinder, Polytope, box, hull
from flexdt.twin.collision.guard import scene_guard
from flexdt.twin.collision.obstacle_path import direct_contact, plan_move
from flexdt.twin.collision.sample_hull import convex_pieces
from flexdt.twin.collision.scene_search import (
    Clearance,
    Contact,
    SweepResult,
    clearance,
    sweep,
    touching,
)

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
