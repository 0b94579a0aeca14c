"""A scene swept along a motion as the check of a plan does it, for tests of the search."""

from collections.abc import Mapping

from flexdt.twin.collision.collision_scene import CollisionScene
from flexdt.twin.collision.first_contact import PathSearch, SweepResult
from flexdt.twin.motion.profiles import Trajectory


def sweep(
    scene: CollisionScene,
    trajectories: Mapping[str, Trajectory],
    start: float,
    end: float,
) -> SweepResult:
    """The first contact; without one the least clearance, refined."""
    search = PathSearch(scene, scene.path(trajectories, start, end))
    found = search.first_contact()
    return search.refined(found) if found.contact is None else found
