"""A part that is clicked in a scene selects its motor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from looking import drawn, settled
from scipy.spatial import ConvexHull, Delaunay

from flexdt.clients.client.client import TwinClient
from flexdt.protocol.state_model import State
from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.machine.description import builtin_machine, profile_of
from tests.viewer.test_viewer_scenes import _on_screen, preset

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
MOTORS = {
    "main_platform": None, "mag_rail_left": None, "mag_rail_right": None, "source_platform": None,
    "source_tower": "tra_tube", "xray_source": "ver_tube", "sample_rail": "mag_obj",
    "sample_base": "tra_obj", "sample_holder": "rot_obj", "sample_mount": "rot_obj",
    "sample": "rot_obj", "detector_platform": "mag_det", "detector_tower": "mag_det",
    "detector_stage": "ver_det", "detector": "tra_det",
}  # fmt: skip
"""From the manual's table of stages: what moves each part relative to what it stands on."""
LISTEN = """async () => {
  window.picked = [];
  const { on } = await import('/link.js');
  on('part', (part, motor) => window.picked.push([part, motor]));
}"""


def corners_m(state: State) -> dict[str, npt.NDArray[np.float64]]:
    """Corners of a box around each part, where it stands [m]."""
    machine = builtin_machine()
    scene = build_scene(machine, profile_of(machine))
    q = scene.vector({n: a.position for n, a in state.axes.items() if n in machine.axes})
    out = {}
    for body in scene.bodies:
        low, high = body.solid.bounds()
        box = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1])
                        for z in (low[2], high[2])])  # fmt: skip
        turn = body.rotation(float(q @ body.turns))
        out[body.name] = (box @ turn.T + body.origin + q @ body.slides) * 1e-3
    return out


def inside(points: npt.NDArray[np.float64], at: tuple[float, float]) -> bool:
    hull = points[ConvexHull(points).vertices]
    return bool(Delaunay(hull).find_simplex(np.array([at]))[0] >= 0)


@pytest.mark.slow
def test_a_click_on_a_part_selects_its_motor(
    open_page: Callable[..., Any], twin: TwinClient, wait: Wait
) -> None:
    page = open_page("side", (1280, 720))
    page.add_style_tag(
        content=".inset, #said { visibility: hidden; pointer-events: none }"
    )
    box = page.locator(".view[data-view=side]")
    settled(box, drawn)
    page.evaluate(LISTEN)
    frame = box.bounding_box()
    camera = preset(page, "side", frame)
    boxes = corners_m(twin.state())
    seen = {
        name: np.array([_on_screen(frame, camera, point) for point in corners])
        for name, corners in boxes.items()
    }
    chosen = set()
    for name in ("detector", "xray_source", "sample_base", "detector_tower", "source_tower",
                 "sample_rail", "main_platform"):  # fmt: skip
        at = tuple(seen[name].mean(axis=0))
        before = page.evaluate("window.picked.length")
        page.mouse.move(*at)
        page.mouse.click(*at, delay=50)
        wait(
            lambda n=before: page.evaluate("window.picked.length") > n, f"{name} is told"
        )
        part, motor = page.evaluate("window.picked.at(-1)")
        assert motor == MOTORS[part], part
        assert part == "sample" or inside(seen[part], at), (name, part)
        if motor is None:
            assert "no motor moves it" in str(page.text_content("#notes"))
            continue
        row = page.locator(f".axis[data-axis={motor}]")
        assert row.is_visible()
        assert "chosen" in str(row.get_attribute("class"))
        assert row.locator("input.num").evaluate("e => e === document.activeElement")
        chosen.add(motor)
    assert len(chosen) >= 4, chosen
    page.close()
