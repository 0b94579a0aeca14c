"""Exports of the viewer: pictures of a view, the current scene, and a scan as a replay.

A replay is drawn in a viser server of its own without clients, so that recording does not disturb
the live scene. Both file formats open without any server. The page saves what it receives; nothing
is written here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import viser

from flexdt.clients.viewer.page_params import Form
from flexdt.clients.viewer.scenes.lab_scene import LabScene
from flexdt.clients.viewer.scenes.sample import SampleLook
from flexdt.clients.viewer.scenes.standpoints import FREE
from flexdt.clients.viewer.scenes.world import world_of
from flexdt.clients.viewer.scrubbed_plan import Scrubbed, positions_at
from flexdt.clients.viewer.viser_gate import Scenes, look_from
from flexdt.protocol.state_model import State
from flexdt.twin.machine.description import Machine, Profile

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


def scene_file(server: viser.ViserServer, form: Form, dark: bool) -> bytes:
    """The live scene as a file."""
    serializer = server.get_scene_serializer()
    look_from(serializer, FREE)
    return _file(serializer, form, dark)


def replay_file(
    machine: Machine,
    profile: Profile,
    state: State,
    look: SampleLook,
    planned: Scrubbed,
    looks: Mapping[str, bytes] | None,
    form: Form,
    dark: bool,
) -> bytes:
    """A plan, or a scan that was made, as a file that plays it."""
    scenes = Scenes()
    server = scenes.server
    try:
        server.initial_camera.position = FREE.position
        server.initial_camera.look_at = FREE.look_at
        scene = LabScene(server, machine, profile, looks=looks)
        scene.wear(look)
        serializer = server.get_scene_serializer()
        for time_s in np.linspace(0.0, planned.duration_s, FRAMES):
            moved = at_positions(state, positions_at(planned, float(time_s)))
            scene.update(moved, world_of(machine, profile, moved))
            serializer.insert_sleep(REPLAY_S / FRAMES)
    finally:
        scenes.stop()
    return _file(serializer, form, dark)


def _file(serializer: Any, form: Form, dark: bool) -> bytes:
    if form == "html":
        return str(serializer.as_html(dark_mode=dark)).encode()
    return bytes(serializer.serialize())


def at_positions(state: State, positions: dict[str, float]) -> State:
    """The state with its motors elsewhere and X-rays on."""
    axes = {
        name: axis.model_copy(update={"position": positions.get(name, axis.position)})
        for name, axis in state.axes.items()
    }
    tube = state.tube.model_copy(update={"on": True})
    return state.model_copy(update={"axes": axes, "tube": tube})
