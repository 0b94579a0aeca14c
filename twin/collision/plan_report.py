"""Collisions and clearances of a whole plan, for the dry-run report.

A `CollisionCheck` for `flexdt.twin.script.dry_run` reports every contact of the plan with
the line that moves, its time, the pair and the last free position, the least clearance,
and a trace for a plot. After a contact the check continues with the plan as written, so
that one mistake does not hide the next.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexdt.twin.collision.collision_scene import CollisionScene, build_scene
from flexdt.twin.collision.convex_solids import ConvexSolid, UprightCylinder
from flexdt.twin.collision.first_contact import PathSearch, clearance_trace
from flexdt.twin.collision.relative import START, Moment, Path, path_of, sweep_pair
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.scanner.safety import Contact
from flexdt.twin.script.commands import MoveAbsolute
from flexdt.twin.script.dry_run import CollisionCheck
from flexdt.twin.script.planning.check_findings import Clearance, Collision
from flexdt.twin.script.planning.plan import ScanPlan
from flexdt.twin.script.planning.plan_values import SampleSize

MAX_CONTACTS = 20
"""Largest number of contacts of one pair that are listed."""
MAX_LOOKS_IN_CONTACT = 500
"""Number of places at which a pair in contact is examined for being free again."""
TRACE_POINTS = 120
"""Number of points of the clearance plot."""


def collision_check(
    sample: Sequence[ConvexSolid] | None = None, parameters: Offsets = NOMINAL
) -> CollisionCheck:
    """Make a check for `check_script(..., collision=...)`.

    Args:
        sample: convex pieces in the object's frame (see `convex_pieces`). None: the
            cylinder that contains the sample by the script or the caller (as high as it
            is wide, where the height is unknown), or an empty stage.
        parameters: the correction in force.

    Returns:
        A function of plan, machine, profile and the sample's size that returns the plan's
        clearances and collisions.
    """

    def check(
        plan: ScanPlan, machine: Machine, profile: Profile, size: SampleSize | None
    ) -> Clearance:
        """Sweep a plan with the machine's bodies and a sample; see `collision_report`.

        The sample given to `collision_check` counts, else `size`, as a cylinder.
        """
        if sample is None:
            pieces = _from_size(size)
        else:
            pieces = tuple(sample)
        return collision_report(plan, build_scene(machine, profile, pieces, parameters))

    return check


def collision_report(plan: ScanPlan, scene: CollisionScene) -> Clearance:
    """Sweep a plan for its contacts and clearances.

    Without pairs in motion the least clearance is None. Moments without any pair are left
    out of the trace.

    Args:
        plan: of a scan, with the paths of its axes.
        scene: bodies and pairs that must not touch.

    Returns:
        All contacts in the order of time, each with line, pair and the last free
        positions; the least clearance [mm] with its pair; and a trace of (time [s],
        clearance [mm]) at about `TRACE_POINTS` moments.
    """
    path = path_of(scene.axes, plan.paths, 0.0, plan.duration_s, scene.counts)
    search = PathSearch(scene, path)
    contacts = _contacts(search)
    least, pair = _least(search, contacts)
    points = clearance_trace(scene, path, _trace_times(path, TRACE_POINTS))
    return Clearance(
        tuple(
            Collision(_line(plan, scene, c), c.time, c.pair, dict(c.last_free))
            for c in contacts
        ),
        float(least) if np.isfinite(least) else None,
        pair,
        tuple((t, mm) for t, mm, _ in points if np.isfinite(mm)),
    )


def _least(
    search: PathSearch, contacts: Sequence[Contact]
) -> tuple[float, tuple[str, str] | None]:
    """Find the least clearance [mm] and its pair: of the nearest contact, or, without
    contacts, of the whole path within the scene's accuracy.

    (inf, None) if no pair moves.
    """
    if contacts:
        worst = min(contacts, key=lambda c: c.clearance_mm)
        return worst.clearance_mm, worst.pair
    result = search.refined(search.first_contact())
    return result.min_clearance_mm, result.nearest


def _from_size(size: SampleSize | None) -> tuple[ConvexSolid, ...]:
    """Make an upright cylinder of a sample's size, centered on the stage's origin; () for
    no body.

    No body without a size or diameter; without a height it is as high as wide."""
    if size is None or size.diameter_mm <= 0.0:
        return ()
    height = size.height_mm or size.diameter_mm
    return (UprightCylinder((0.0, 0.0, 0.0), 0.5 * size.diameter_mm, height),)


def _contacts(search: PathSearch) -> list[Contact]:
    """Find all contacts of a path, by time; of contacts of the same two names in one
    segment only the first.

    Pairs whose bound is beyond margin plus tolerance are skipped. See `_contacts_of`.
    """
    limits = search.scene.limits
    contacts = []
    for k, bound in enumerate(search.bounds):
        if bound > limits.margin + limits.tolerance:
            break
        contacts += _contacts_of(search, k)
    first: dict[tuple[tuple[str, str], float], Contact] = {}
    for contact in sorted(contacts, key=lambda c: c.time):
        # Pieces of one sample touch one after the other in one and the same motion.
        segment = float(np.searchsorted(search.path.times, contact.time, side="right"))
        first.setdefault((contact.pair, segment), contact)
    return list(first.values())


def _contacts_of(search: PathSearch, k: int) -> list[Contact]:
    """Find the contacts of one pair; after each it must come free before it counts again.

    It is free again at more than margin plus two tolerances, looked for at the beginnings
    of the next `MAX_LOOKS_IN_CONTACT` segments; if none is, the search ends.

    Args:
        search: path and pairs.
        k: index of the pair.

    Returns:
        At most `MAX_CONTACTS`, in order of time.
    """
    motion = search.motion(k)
    limits = search.scene.limits
    separate = search.scene.separation(search.pairs[k])
    out: list[Contact] = []
    start: Moment | None = START
    while start is not None and len(out) < MAX_CONTACTS:
        result = sweep_pair(motion, separate, limits, start=start)
        if result.contact is None:
            break
        out.append(search.contact(k, result))
        start = None
        wanted = limits.margin + 2.0 * limits.tolerance
        after = range(result.contact.segment + 1, len(motion))
        for segment in after[:MAX_LOOKS_IN_CONTACT]:
            if motion.look(Moment(segment, 0.0), separate).gap > wanted:
                start = Moment(segment, 0.0)
                break
    return out


def _line(plan: ScanPlan, scene: CollisionScene, contact: Contact) -> int:
    """Find the line of the script that causes a contact: that of the last motion under
    way that moves one of the two bodies.

    If none is, that of the last step begun by then, else that of the first step.

    Args:
        plan: with its steps.
        scene: which motors move which bodies.
        contact: of one pair.

    Returns:
        Line of the script; 0 for a plan without steps.
    """
    pairs = [scene.names(pair) == contact.pair for pair in scene.all.pairs]
    motors = {scene.axes[i] for i in np.flatnonzero(scene.all.moves[pairs].any(axis=0))}
    under_way = [
        s
        for s in plan.steps
        if isinstance(s.command, MoveAbsolute)
        and plan.machine.has(s.command.component)
        and not motors.isdisjoint(plan.machine.moves(s.command.component))
        and s.start_s <= contact.time <= s.start_s + s.duration_s + 1e-9
    ]
    before = [s for s in plan.steps if s.start_s <= contact.time]
    steps = under_way or before or list(plan.steps[:1])
    return steps[-1].line if steps else 0


def _trace_times(path: Path, count: int) -> FloatArray:
    """Choose about `count` times for a plot: half evenly by travel, half evenly by time.

    Sorted, without repeats. Only start and end of the path if nothing moves or `count` is below
    2.

    `path`: of all motors; `count`: number of times.
    Returns (m,) times [s], m at most `count` (or 2).
    """
    travelled = np.abs(np.diff(path.q, axis=0)).sum(axis=1)
    along = np.concatenate([[0.0], np.cumsum(travelled)])
    if along[-1] == 0.0 or count < 2:
        return path.times[[0, -1]]
    half = count // 2
    by_travel = np.interp(np.linspace(0.0, along[-1], half), along, path.times)
    by_time = np.linspace(path.times[0], path.times[-1], count - half)
    return np.unique(np.concatenate([by_travel, by_time]))
