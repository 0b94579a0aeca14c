"""A planned script to scrub through: motor positions at any moment, and a time line of steps.

The twin's own planner runs from the machine's present state; a long script is planned in a worker
process. Collisions come from the twin's `script.check`. Paths outside the data directory are an
error.

Exports are here as well: pictures of a view, the current scene, and a scan as a replay.

A replay is drawn in a viser server of its own without clients, so that recording does not disturb
the live scene. Both file formats open without any server. The page saves what it receives; nothing
is written here.
"""

from __future__ import annotations

import asyncio
import pickle
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import viser

from flexdt.clients.viewer.scenes.lab_scene import LabScene
from flexdt.clients.viewer.scenes.sample import Look
from flexdt.clients.viewer.scenes.standpoints import FREE
from flexdt.clients.viewer.scenes.world import camera_of, motors, parameters_of, world_of
from flexdt.clients.viewer.viser_gate import Scenes, look_from
from flexdt.protocol.rpc_errors import too_large
from flexdt.protocol.state_model import AxisState, State
from flexdt.server.runtime.workers import Workers
from flexdt.twin.dataset import DatasetMissingError, plain_name
from flexdt.twin.dataset.file_names import SCRIPT
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.script import parse_script, plan_script
from flexdt.twin.script.lexer import is_light
from flexdt.twin.script.planning.plan import ScanPlan, StartState

MAX_STEPS = 4000
MAX_SCRIPT = 8 << 20
CURVE_POINTS = 400
ORBIT_POINTS = 720
MAX_IMAGES = 1_000_000
"""Of a plan to scrub: so many moments are kept while a page shows it."""
PLANNERS = 1
PLAN_BYTES = 2 << 30
PLAN_S = 20.0


@dataclass(frozen=True, eq=False)
class Planned:
    """A plan that pages scrub through."""

    plan: ScanPlan
    times: FloatArray

    def positions(self, time: float) -> dict[str, float]:
        """Motor positions at `time` [s of the plan]."""
        at = np.clip(np.array([time]), 0.0, self.plan.duration_s)
        return {name: float(values[0]) for name, values in self.plan.positions(at).items()}


@dataclass(frozen=True, eq=False)
class Made:
    """A plan with all that is drawn of it; no path where no state is known."""

    planned: Planned
    path: FloatArray | None
    document: dict[str, Any]


async def make(
    workers: Workers, text: str, machine: Machine, profile: Profile, state: State | None
) -> Made:
    """Plan a script, in a process of its own where that may take long.

    Raises:
        ScriptError: it does not parse.
        RpcError: it has too many images, or takes too long or too much memory.
    """
    if is_light(text.encode()):
        return await asyncio.to_thread(_made, text, machine, profile, state)
    (answer,) = await workers.ask(work, [pickle.dumps((text, machine, profile, state))])
    made: Made = await asyncio.to_thread(pickle.loads, answer)
    return made


def work(parts: Sequence[bytes]) -> list[bytes]:
    """In a worker process: what `make` sent."""
    return [pickle.dumps(_made(*pickle.loads(parts[0])))]


def _made(text: str, machine: Machine, profile: Profile, state: State | None) -> Made:
    planned = plan_text(text, machine, profile, state)
    images = sum(len(group) for group in planned.plan.groups)
    if images > MAX_IMAGES:
        raise too_large("a plan to scrub", images, MAX_IMAGES, "images")
    path = None if state is None else orbit(planned, machine, profile, state)
    return Made(planned, path, document(planned))


def plan_text(text: str, machine: Machine, profile: Profile, state: State | None) -> Planned:
    """Plan a script.

    Raises:
        ScriptError: it does not parse.
    """
    start = StartState.of(machine)
    if state is not None:
        start = replace(start, positions={**start.positions, **motors(machine, state)})
    plan = plan_script(parse_script(text), machine, profile, start=start)
    return Planned(plan, np.linspace(0.0, plan.duration_s, CURVE_POINTS))


def script_of(folder: Path, dataset: str) -> str:
    """The script in the data set `dataset` of the twin's data directory.

    Raises:
        DatasetNameError: no plain name.
        DatasetMissingError: there is no such script.
    """
    path = folder / plain_name(dataset, "data set") / SCRIPT
    if path.is_symlink() or path.parent.is_symlink() or not path.is_file():
        raise DatasetMissingError(f"{dataset}: no script lies with this data set")
    with path.open("rb") as file:
        return file.read(MAX_SCRIPT).decode("utf-8", "replace")


def document(planned: Planned) -> dict[str, Any]:
    """What a page needs to draw the timeline."""
    plan = planned.plan
    curves = plan.positions(planned.times)
    moving = {
        name: [round(float(v), 4) for v in values]
        for name, values in curves.items()
        if float(np.ptp(values)) > 1e-9
    }
    kinds = [group.kind for group in plan.groups for _ in range(len(group))]
    frames = [
        [round(float(t), 4), kind] for t, kind in zip(plan.starts.tolist(), kinds, strict=True)
    ]
    keep = max(1, -(-len(frames) // MAX_STEPS))
    return {
        "duration_s": plan.duration_s,
        "frames": plan.frames,
        "bytes": plan.bytes,
        "times": [round(float(t), 4) for t in planned.times],
        "curves": moving,
        "images": frames[::keep],
        "steps": [
            {"line": s.line, "start_s": s.start_s, "duration_s": s.duration_s, "what": s.what}
            for s in plan.steps[:MAX_STEPS]
        ],
        "problems": [
            {"severity": p.severity, "code": p.code, "line": p.line, "column": p.column,
             "message": p.message}
            for p in plan.problems
        ],
    }  # fmt: skip


def orbit(planned: Planned, machine: Machine, profile: Profile, state: State) -> FloatArray:
    """The focal spot's path as the sample sees it while images are taken, (n, 3) [mm]."""
    plan = planned.plan
    projections = np.array(
        [group.kind == "projection" for group in plan.groups for _ in range(len(group))], dtype=bool
    )
    if not projections.any():
        return np.zeros((0, 3))
    at = {name: values[projections] for name, values in plan.image_positions.items()}
    pose = motor_poses(machine, profile, camera_of(machine, state.camera), at)
    step = max(1, len(pose) // ORBIT_POINTS)
    return np.asarray(pose.cone_vec(parameters_of(state)).source[::step])


FRAMES: Final = 240
REPLAY_S: Final = 12.0
LIGHT, DARK = (246, 248, 251), (16, 19, 25)


def picture(client: viser.ClientHandle, width: int, height: int, dark: bool) -> bytes:
    """A view as PNG, on the page's background.

    Raises:
        RuntimeError, TimeoutError: the browser does not answer.
    """
    import imageio.v3 as iio

    rgba = client.get_render(height, width, transport_format="png", timeout=30.0).astype(np.float32)
    alpha = rgba[:, :, 3:4] / 255.0 if rgba.shape[2] == 4 else np.ones_like(rgba[:, :, :1])
    flat = rgba[:, :, :3] * alpha + np.array(DARK if dark else LIGHT) * (1.0 - alpha)
    return bytes(iio.imwrite("<bytes>", flat.astype(np.uint8), extension=".png"))


def scene_html(server: viser.ViserServer, dark: bool, bare: bool) -> bytes:
    """The live scene as one HTML page, or (bare) as a .viser file."""
    serializer = server.get_scene_serializer()
    look_from(serializer, FREE)
    return serializer.serialize() if bare else _html(serializer, dark)


def replay_html(
    machine: Machine, profile: Profile, state: State, look: Look, planned: Planned, dark: bool
) -> bytes:
    """A plan as one HTML page that plays it."""
    return _html(_replay(machine, profile, state, look, planned), dark)


def replay_viser(
    machine: Machine, profile: Profile, state: State, look: Look, planned: Planned, dark: bool
) -> bytes:
    """A plan as a .viser file."""
    return bytes(_replay(machine, profile, state, look, planned).serialize())


def _html(serializer: Any, dark: bool) -> bytes:
    return str(serializer.as_html(dark_mode=dark)).encode()


def _replay(machine: Machine, profile: Profile, state: State, look: Look, planned: Planned) -> Any:
    scenes = Scenes()
    server = scenes.server
    try:
        server.initial_camera.position = FREE.position
        server.initial_camera.look_at = FREE.look_at
        scene = LabScene(server, machine, profile)
        scene.wear(look)
        serializer = server.get_scene_serializer()
        for time_s in np.linspace(0.0, planned.plan.duration_s, FRAMES):
            moved = at_positions(state, planned.positions(float(time_s)))
            scene.update(moved, world_of(machine, profile, moved))
            serializer.insert_sleep(REPLAY_S / FRAMES)
        return serializer
    finally:
        scenes.stop()


def at_positions(state: State, positions: dict[str, float]) -> State:
    """The state with its motors elsewhere and X-rays on."""
    axes: dict[str, AxisState] = {
        name: axis.model_copy(update={"position": positions.get(name, axis.position)})
        for name, axis in state.axes.items()
    }
    tube = state.tube.model_copy(update={"on": True})
    return state.model_copy(update={"axes": axes, "tube": tube})
