"""Contacts of bodies and their times: distances and sweeps over convex parts."""

from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.convex_solids import box
from flexdt.twin.collision.guard import SceneGuard

__all__ = ["SceneGuard", "box", "build_scene"]
