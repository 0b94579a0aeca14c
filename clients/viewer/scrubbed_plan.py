"""A planned script to scrub through: motor positions at any moment, and a time line of steps.

The twin's own planner runs from the machine's present state; a long script is planned in a
worker process. Collisions come from the twin's `script.check`. Of a data set its
images' poses are scrubbed.
"""

from __future__ import annotations

import asyncio
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flexdt.clients.viewer.scenes.world import camera_of, motors, parameters_of
from flexdt.protocol.rpc_errors import too_large
from flexdt.protocol.state_model import State
from flexdt.runtime.workers import Workers
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.script import parse_script, plan_script
from flexdt.twin.script.parse import is_light
from flexdt.twin.script.planning.plan import ScanPlan
from flexdt.twin.script.planning.plan_values import StartState

MAX_STEPS = 4000
CURVE_POINTS = 400
ORBIT_POINTS = 720
MAX_IMAGES = 1_000_000
"""Largest number of images of a plan to scrub: the moment of each is kept while a page
shows it."""
PLANNERS = 1
PLAN_BYTES = 2 << 30
PLAN_S = 20.0


@dataclass(frozen=True, eq=False)
class RecordedPositions:
    """Motor positions at the images of a data set; straight lines between them."""

    times: FloatArray
    motors: Mapping[str, FloatArray]

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> RecordedPositions | None:
        """Build from a result of `dataset.get`, ordered by time.

        Times are the data set's [s]; images without times are a second apart, by index.
        Images at which the first motor's position is unknown are left out.

        Returns:
            The positions; None where no motor's are known.
        """
        motors = {
            n: np.array(values, dtype=float) for n, values in told["positions"].items()
        }
        if not motors:
            return None
        times = np.array(told["times_s"] or told["indices"], dtype=float)
        order = np.argsort(times, kind="stable")
        order = order[np.isfinite(next(iter(motors.values()))[order])]
        return cls(times[order], {name: values[order] for name, values in motors.items()})

    @property
    def duration_s(self) -> float:
        """To the last image [s]."""
        return float(self.times[-1])

    def positions(self, times: FloatArray) -> dict[str, FloatArray]:
        """Compute motor positions at `times` [s of the scan's clock], same shape."""
        return {n: np.interp(times, self.times, v) for n, v in self.motors.items()}


Scrubbed = ScanPlan | RecordedPositions
"""Plan or recorded positions for a page to scrub through."""


def positions_at(scrubbed: Scrubbed, time: float) -> dict[str, float]:
    """Compute motor positions at `time` [s]; the first ones before the start, the last
    after the end."""
    at = np.clip([time], 0.0, scrubbed.duration_s)
    return {name: float(values[0]) for name, values in scrubbed.positions(at).items()}


@dataclass(frozen=True, eq=False)
class Made:
    """A plan with all that is drawn of it; no path where no state is known."""

    plan: ScanPlan
    path: FloatArray | None
    document: dict[str, Any]


async def make(
    workers: Workers, text: str, machine: Machine, profile: Profile, state: State | None
) -> Made:
    """Plan a script, in a thread if it is short, else in a process of its own.

    Args:
        workers: these processes.
        text: of the script.
        machine, profile: of the scan.
        state: of the twin, from which the script starts; None: from home.

    Returns:
        Plan, path (None without a state) and document.

    Raises:
        ScriptError: it does not parse, if it is short.
        RpcError: it has too many images, takes too long or too much memory, or, if it is
            long, does not parse.
    """
    if is_light(text.encode()):
        return await asyncio.to_thread(_made, text, machine, profile, state)
    (answer,) = await workers.ask(work, [pickle.dumps((text, machine, profile, state))])
    made: Made = await asyncio.to_thread(pickle.loads, answer)
    return made


def work(parts: Sequence[bytes]) -> list[bytes]:
    """Run a plan in a worker, from `make`'s message."""
    return [pickle.dumps(_made(*pickle.loads(parts[0])))]


def _made(text: str, machine: Machine, profile: Profile, state: State | None) -> Made:
    """Plan a script, and compute the source's path, None without a state, and the time
    line.

    Raises:
        RpcError: it takes more than `MAX_IMAGES` images.
        ScriptError: the script is invalid.
    """
    plan = plan_text(text, machine, profile, state)
    images = sum(len(group) for group in plan.groups)
    if images > MAX_IMAGES:
        raise too_large("a plan to scrub", images, MAX_IMAGES, "images")
    path = None
    if state is not None:
        path = source_path(projection_positions(plan), machine, profile, state)
    return Made(plan, path, document(plan))


def plan_text(
    text: str, machine: Machine, profile: Profile, state: State | None
) -> ScanPlan:
    """Plan a script from the twin's positions on, or from the machine's start without a state.

    Only positions are taken from the state, not rates or settings.
    Raises ScriptError: it does not parse."""
    start = StartState.of(machine)
    if state is not None:
        start = replace(start, positions={**start.positions, **motors(machine, state)})
    return plan_script(parse_script(text), machine, profile, start=start)


def document(plan: ScanPlan) -> dict[str, Any]:
    """Make the data of a page's time line.

    Of images every k-th is kept, at most `MAX_STEPS`; of steps the first `MAX_STEPS`.
    Curves have `CURVE_POINTS` points; axes that move by 1e-9 or less have none. Times are
    in [s].

    Args:
        plan: of the script.

    Returns:
        `duration_s`, `frames`, `bytes`, `times`, `curves` of moving axes, `images`,
        `steps` and `problems`.
    """
    times = np.linspace(0.0, plan.duration_s, CURVE_POINTS)
    curves = plan.positions(times)
    moving = {
        name: values.round(4).tolist()
        for name, values in curves.items()
        if float(np.ptp(values)) > 1e-9
    }
    frames = [
        [round(t, 4), group.kind] for group in plan.groups for t in group.starts.tolist()
    ]
    keep = max(1, -(-len(frames) // MAX_STEPS))
    return {
        "duration_s": plan.duration_s,
        "frames": plan.frames,
        "bytes": plan.bytes,
        "times": times.round(4).tolist(),
        "curves": moving,
        "images": frames[::keep],
        "steps": [
            {
                "line": s.line,
                "start_s": s.start_s,
                "duration_s": s.duration_s,
                "what": s.what,
            }
            for s in plan.steps[:MAX_STEPS]
        ],
        "problems": [p.to_dict() for p in plan.problems],
    }


def projection_positions(plan: ScanPlan) -> dict[str, FloatArray]:
    """Return axis -> (n,) positions at the projections of a plan.

    Order is that of the images; dark and flat images are left out."""
    kinds = [group.kind for group in plan.groups for _ in range(len(group))]
    taken = np.array(kinds, dtype=str) == "projection"
    return {name: values[taken] for name, values in plan.image_positions.items()}


def source_path(
    at: Mapping[str, FloatArray], machine: Machine, profile: Profile, state: State
) -> FloatArray:
    """Compute the focal spot's path in the sample's frame, (m, 3) [mm].

    About ORBIT_POINTS of the positions (n,) [mm, deg]; (0, 3) without any.
    """
    count = len(next(iter(at.values()), ()))
    if not count:
        return np.zeros((0, 3))
    pose = motor_poses(machine, profile, camera_of(machine, state.camera), at)
    step = max(1, count // ORBIT_POINTS)
    return np.asarray(pose.cone_vec(parameters_of(state)).source[::step])
