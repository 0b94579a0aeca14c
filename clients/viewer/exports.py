"""Exports of the viewer: pictures of a view, the current scene, and a scan as a replay.

A replay is drawn in a viser server of its own without clients, so that recording does not
disturb the live scene. Both file formats open without any server. The page saves the files;
nothing is written here.
"""

from __future__ import annotations

import base64
import html
import re
import time
from collections.abc import Mapping
from typing import Any, Final, Literal, assert_never

import numpy as np
import viser

from flexdt.clients.viewer.page_html import TRANSLUCENT, page_file
from flexdt.clients.viewer.scenes.lab_scene import LabScene
from flexdt.clients.viewer.scenes.layers import Nodes
from flexdt.clients.viewer.scenes.sample_looks import SampleLook
from flexdt.clients.viewer.scenes.views import FREE, Standpoint
from flexdt.clients.viewer.scenes.world import world_of
from flexdt.clients.viewer.scrubbed_plan import Scrubbed, positions_at
from flexdt.clients.viewer.shown_images import ShownImage, grey, window_of
from flexdt.clients.viewer.viser_gate import Scenes, look_from
from flexdt.library.datasets.pictures import png_of
from flexdt.protocol.state_model import State
from flexdt.twin.machine.description import Machine, Profile

Form = Literal["html", "viser"]
"""Form of an exported file: an HTML page by itself, or viser's own format."""
FRAMES: Final = 240
REPLAY_S: Final = 12.0
LIGHT = (246, 248, 251)
DARK = (16, 19, 25)


def picture(client: viser.ClientHandle, width: int, height: int, dark: bool) -> bytes:
    """Render a client's view as PNG, on the page's background; blocks.

    Translucent pixels are blended with `LIGHT` or `DARK`.

    `client`: one open view, whose browser renders it; `width`: [px]; `height`: [px]; `dark`: the
    page's colors.
    Raises RuntimeError, TimeoutError: the browser does not answer within 30 s.
    """
    rgba = client.get_render(height, width, transport_format="png", timeout=30.0).astype(
        np.float32
    )
    if rgba.shape[2] == 4:
        alpha = rgba[:, :, 3:4] / 255.0
    else:
        alpha = np.ones_like(rgba[:, :, :1])
    flat = rgba[:, :, :3] * alpha + np.array(DARK if dark else LIGHT) * (1.0 - alpha)
    return png_of(flat.astype(np.uint8))


def scene_file(
    server: viser.ViserServer,
    camera: Standpoint,
    nodes: Nodes,
    title: str,
    beside: str,
    form: Form,
    dark: bool,
) -> bytes:
    """Export the live scene as the page shows it: an HTML page, or viser's format.

    `camera` is the first view.
    """
    serializer = server.get_scene_serializer()
    look_from(serializer, camera, nodes)
    return _file(serializer, form, dark, title, beside)


def replay_file(
    machine: Machine,
    profile: Profile,
    state: State,
    look: SampleLook,
    planned: Scrubbed,
    looks: Mapping[str, bytes] | None,
    title: str,
    form: Form,
    dark: bool,
) -> bytes:
    """Export a plan, or a recorded scan, to a file that plays it.

    It is drawn at `FRAMES` moments of the plan, played in `REPLAY_S` seconds, in a server
    of its own that is stopped at the end.

    Args:
        machine, profile: of the scene.
        state: of the twin; its motors and X-rays are replaced.
        look: the sample.
        planned: motor positions over time.
        looks: part -> its own mesh; None for none.
        title: of the file.
        form: html or viser.
        dark: the page's background.
    """
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
    return _file(serializer, form, dark, title)


def _file(serializer: Any, form: Form, dark: bool, title: str, beside: str = "") -> bytes:
    """Convert an exported scene to an HTML page or viser's file.

    The title is escaped, `beside` (HTML at the end) is not.
    """
    match form:
        case "viser":
            return bytes(serializer.serialize())
        case "html":
            return _page(serializer, dark, title, beside)
        case _:
            assert_never(form)


def _page(serializer: Any, dark: bool, title: str, beside: str) -> bytes:
    """Make an exported scene a page of its own; arguments as `_file`."""
    page = re.sub(
        r"<title>.*?</title>", "", str(serializer.as_html(dark_mode=dark)), count=1
    )
    first = page_file(TRANSLUCENT).decode()
    head = f"<head><title>{html.escape(title)}</title><script>{first}</script>"
    return (
        page.replace("<head>", head, 1).replace("</body>", f"{beside}</body>", 1).encode()
    )


def title_of(state: State | None, what: str) -> str:
    """Make the title of a file: the sample, date and time, and `what` it is."""
    sample = (state.sample.name if state is not None else "") or "no sample"
    return f"{sample} · {time.strftime('%Y-%m-%d %H:%M')} · flexdt {what}"


def beside(state: State | None, image: ShownImage | None) -> str:
    """Format a radiograph and its values as HTML over a scene.

    Values are distances [mm], magnification, voxel [um], beam and correction. Without an
    image the picture is empty. Names are escaped.

    Args:
        state: of the twin.
        image: radiograph, shown in its own window; None for none.

    Returns:
        The HTML; "" without a state.
    """
    if state is None:
        return ""
    at = state.geometry
    rows = {}
    if at is not None:
        rows = {
            "source to sample": f"{at.SOD_mm:.2f} mm",
            "source to detector": f"{at.SDD_mm:.2f} mm",
            "magnification": f"{at.magnification:.4f}",
            "voxel": f"{1000 * at.voxel_size_mm:.2f} µm",
        }
    rows |= {
        "beam": f"{state.tube.kV:.0f} kV, {state.tube.power_W:.0f} W",
        "correction": "none" if state.correction is None else state.correction.name,
        "axes": "x right, y to the detector, z up",
    }
    lines = "<br>".join(f"{name}: {html.escape(value)}" for name, value in rows.items())
    if image is None:
        film = ""
    else:
        film = base64.b64encode(png_of(grey(image, window_of(image)))).decode()
    source = f"data:image/png;base64,{film}"
    return (
        '<aside style="position:fixed;left:8px;bottom:8px;width:230px;padding:8px;'
        'border-radius:8px;font:12px/1.5 system-ui,sans-serif;background:#fffd;color:#17202c">'
        f'<img alt="radiograph" style="width:100%" src="{source}">{lines}</aside>'
    )


def at_positions(state: State, positions: dict[str, float]) -> State:
    """Copy the state with its motors at `positions` (others stay) and X-rays on.

    Velocities and targets stay; an unknown axis is ignored. The given state is not
    changed.
    """
    axes = {
        name: axis.model_copy(update={"position": positions.get(name, axis.position)})
        for name, axis in state.axes.items()
    }
    tube = state.tube.model_copy(update={"on": True})
    return state.model_copy(update={"axes": axes, "tube": tube})


def standpoint(client: viser.ClientHandle) -> Standpoint:
    """Return the present camera of a client: position, the point it looks at, up
    direction, and field of view [rad].

    Lengths are in [m].
    """
    c = client.camera
    position, look_at, up = (
        (float(v[0]), float(v[1]), float(v[2]))
        for v in (c.position, c.look_at, c.up_direction)
    )
    return Standpoint(position, look_at, up, float(c.fov))
