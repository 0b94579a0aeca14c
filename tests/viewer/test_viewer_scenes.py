"""The scenes themselves: four views, presets, the beam's eye against the projection, dragging."""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from PIL import Image
from scipy.ndimage import distance_transform_edt

from flexdt.clients.client import TwinClient
from flexdt.server.viewer.clients import roomy
from flexdt.server.viewer.gizmos import SIZE_M
from flexdt.server.viewer.views import FIXED

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
Picture = npt.NDArray[np.float32]
SIZE = (1040, 640)


def picture(target: Any) -> Picture:
    raw = target.screenshot(timeout=180_000)
    return np.asarray(Image.open(io.BytesIO(raw)).convert("RGB"), dtype=np.float32)


def still(target: Any) -> Picture:
    """A picture once it no longer changes (scenes fade in)."""
    last = picture(target)
    for _ in range(60):
        target.page.wait_for_timeout(400)
        now = picture(target)
        if now.shape == last.shape and np.abs(now - last).max() < 3.0 and now.std() > 2.0:
            return now
        last = now
    raise AssertionError("the picture never comes to rest")


def settled(target: Any, reached: Callable[[Picture], Any]) -> Picture:
    """A picture at rest of which `reached` holds: what was asked may take a while to be drawn."""
    for _ in range(40):
        now = still(target)
        if reached(now):
            return now
    raise AssertionError("the picture never shows what was asked for")


@pytest.fixture(scope="module")
def scene(open_page: Callable[..., Any]) -> Iterator[Any]:
    page = open_page("none", SIZE)
    yield page
    page.close()


def show(page: Any, view: str) -> Any:
    page.click(f"#view-switch [data-layout={view}]")
    box = page.locator(f".view[data-view={view}]")
    box.locator("iframe").wait_for()
    settled(box, drawn)
    return box


def drawn(view: Picture) -> bool:
    """Something with edges stands between the labels above and below: an empty scene has none."""
    rows = view.shape[0]
    middle = view[rows // 8 : 6 * rows // 8].mean(axis=2)
    return bool((np.abs(np.diff(middle, axis=1)) > 30.0).sum() > 100)


def changed(now: Picture, before: Picture) -> int:
    """Pixels that differ; a frame that is opened again may differ in a few along edges."""
    return int((np.abs(now - before).max(axis=2) > 25.0).sum())


PATH_PX = 100
"""A planned trajectory takes more pixels than that, and what remains without it fewer."""


def layers(page: Any, **values: object) -> None:
    page.evaluate("v => flexdt.call('viewer.layers', v)", values)


def outline_error(scene: Any, lab: Any, wait: Wait) -> float:
    """How far [px of the screen] the drawn sample's outline lies from its shadow's, at worst."""
    hidden = {"machine": False, "panel": False, "beam": False, "axis": False, "orbit": False}
    layers(scene, **hidden, opacity=1.0)
    scene.evaluate("flexdt.call('camera.set', {roi: [32, 8, 1943, 1527], mode: 'HW2SW1High'})")
    with lab.client() as client:
        wait(lambda: not any(a.moving for a in client.state().axes.values()))
        shadow_image = np.asarray(client.projection().image)
    show(scene, "beam")
    crop = scene.locator(".crop")
    crop.wait_for()
    try:
        with_sample = still(crop)
        layers(scene, sample=False)
        empty = still(crop)
    finally:
        layers(scene, **dict.fromkeys(hidden, True), sample=True, opacity=0.6)
    drawn = np.abs(with_sample - empty).max(axis=2) > 24.0
    rows, cols = drawn.shape
    # Pixel centres of the screen to pixels of the image: the crop is exactly the image.
    r = ((np.arange(rows) + 0.5) * shadow_image.shape[0] / rows).astype(int)
    c = ((np.arange(cols) + 0.5) * shadow_image.shape[1] / cols).astype(int)
    shadow = (shadow_image > 1e-4)[np.ix_(r, c)]
    assert 0.02 < shadow.mean() < 0.9
    assert cols > 400
    # A pixel that differs may lie within two pixels of the shadow's outline, on either side.
    depth = np.where(shadow, distance_transform_edt(shadow), distance_transform_edt(~shadow))
    inner = slice(3, -3)  # the crop's own one-pixel frame is no part of the picture
    return float((depth * (drawn ^ shadow))[inner, inner].max(initial=0.0))


def test_beams_eye_is_the_shadow_within_two_pixels(scene: Any, lab: Any, wait: Wait) -> None:
    """The drawn sample's outline, seen from the focal spot, is the outline of its X-ray shadow."""
    move = "t => flexdt.call('axes.move', {targets: t})"
    targets = {"mag_obj": 700.0, "tra_obj": 4.0, "rot_obj": 33.0, "ver_tube": 50.0, "tra_det": 60.0}
    scene.evaluate("flexdt.call('sample.set', {name: 'normal', offset: {x: 3, z: 2, ry: 15}})")
    scene.evaluate("flexdt.call('session.control', {action: 'force'})")
    scene.evaluate(move, targets)
    assert outline_error(scene, lab, wait) <= 2.0


def test_what_another_client_uploads_is_drawn_in_its_shape(
    scene: Any, lab: Any, wait: Wait
) -> None:
    outline = [[0, 0], [26, 0], [26, 9], [9, 9], [9, 20], [0, 20]]
    triangles = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    mesh = trimesh.creation.extrude_triangulation(outline, triangles, 8.0)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(1.2, [1, 0, 0]))
    scene.evaluate("flexdt.call('session.control', {action: 'release'})")
    with lab.client() as client:
        client.upload_mesh(mesh.export(file_type="stl"), "an-angle", format="stl")
        client.set_sample(file="an-angle", material="aluminium")
    # The notch of the L shows light and shadow at once: no box and no hull does.
    scene.wait_for_function("flexdt.store.state.sample.name === 'an-angle'")
    wait(lambda: outline_error(scene, lab, wait) <= 2.0, "the shape is drawn", 120)
    scene.evaluate("flexdt.call('sample.set', {name: 'lego'})")


def test_a_fixed_view_goes_back_to_its_preset(scene: Any, twin: TwinClient) -> None:
    box = show(scene, "side")
    before = still(box)
    frame = box.bounding_box()
    x, y = frame["x"] + frame["width"] / 2, frame["y"] + frame["height"] / 2
    scene.mouse.move(x, y)
    scene.mouse.down()
    scene.mouse.move(x + 90, y + 30, steps=4)
    scene.mouse.up()
    settled(box, lambda turned: np.abs(turned - before).mean() > 2.0)
    box.locator(".home").click()
    settled(box, lambda back: np.abs(back - before).mean() < 1.0)


def test_keys_work_while_a_scene_has_the_focus(scene: Any, twin: TwinClient, wait: Wait) -> None:
    box = show(scene, "side")
    frame = box.bounding_box()
    scene.mouse.click(frame["x"] + frame["width"] / 2, frame["y"] + 60)
    before = twin.state().axes["ver_tube"].position
    scene.keyboard.down("i")
    wait(lambda: twin.state().axes["ver_tube"].position > before + 0.05)
    scene.keyboard.up("i")
    wait(lambda: not twin.state().axes["ver_tube"].moving)


def dragged(moved: Callable[[], bool], seconds: float = 2.0) -> bool:
    """Whether something moves within some seconds; a drag that missed its handle is tried again."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if moved():
            return True
        time.sleep(0.05)
    return False


def with_handles(scene: Any, twin: TwinClient, wait: Wait, view: str) -> dict[str, float]:
    """Show a view with handles, the stages apart; returns where the view lies on the page."""
    scene.evaluate("flexdt.call('session.control', {action: 'force'})")
    scene.evaluate("flexdt.call('axes.move', {targets: {mag_det: 900, mag_obj: 450}})")
    wait(lambda: not any(a.moving for a in twin.state().axes.values()))
    box = show(scene, view)
    scene.click("#tabs [data-tab=move]")
    scene.check("#handles")
    still(box)
    frame: dict[str, float] = box.bounding_box()
    return frame


@pytest.mark.parametrize(
    ("axis", "stage", "along"),
    [("ver_tube", "source", "z"), ("mag_obj", "object", "y"), ("mag_det", "detector", "y"),
     ("ver_det", "detector", "z")],
)  # fmt: skip
def test_dragging_a_handle_moves_its_stage(
    scene: Any, twin: TwinClient, wait: Wait, axis: str, stage: str, along: str
) -> None:
    frame = with_handles(scene, twin, wait, "side")
    before = twin.state().axes[axis].position
    # An arrow begins at its stage's point. Side view: world y runs to the right, z up.
    point = _handles(scene, twin)[stage]
    direction = np.array([0.0, 0.0, 1.0] if along == "z" else [0.0, 1.0, 0.0])
    sign = -1.0 if along == "y" else 1.0  # towards the source there is room
    for reach in 3 * (0.6, 0.8, 0.4, 1.0):
        here = _on_screen(frame, "side", point + SIZE_M * reach * direction)
        scene.mouse.move(*here)
        scene.wait_for_timeout(900)  # a frame or two, in which the handle sees the pointer
        scene.mouse.down()
        there = (here[0], here[1] - 30) if along == "z" else (here[0] - 30, here[1])
        scene.mouse.move(*there, steps=6)
        scene.wait_for_timeout(900)
        scene.mouse.up()
        if dragged(lambda: abs(twin.state().axes[axis].target - before) > 1.0):
            break
    scene.uncheck("#handles")
    wait(lambda: (twin.state().axes[axis].position - before) * sign > 1.0, axis)
    wait(lambda: not any(a.moving for a in twin.state().axes.values()))
    scene.evaluate("t => flexdt.call('axes.move', {targets: t})", {axis: before})
    wait(lambda: abs(twin.state().axes[axis].position - before) < 1e-6)


def test_dragging_the_ring_turns_the_sample_with_the_pointer(
    scene: Any, twin: TwinClient, wait: Wait
) -> None:
    frame = with_handles(scene, twin, wait, "free")
    before = twin.state().axes["rot_obj"].position

    def place(degrees: float, radius: float) -> tuple[float, float]:
        turn = math.radians(degrees)
        arm = SIZE_M * radius * np.array([math.cos(turn), math.sin(turn), 0.0])
        return _on_screen(frame, "free", _handles(scene, twin)["object"] + arm)

    # The ring is an arc from the arrow along x to the one along y; 50 degrees clockwise on it.
    for radius in 3 * (0.65, 0.63, 0.67):
        scene.mouse.move(*place(70.0, radius))
        scene.wait_for_timeout(900)
        scene.mouse.down()
        for degrees in (60.0, 50.0, 40.0, 30.0, 20.0):
            scene.mouse.move(*place(degrees, radius))
        scene.wait_for_timeout(900)
        scene.mouse.up()
        if dragged(lambda: abs(twin.state().axes["rot_obj"].target - before) > 1.0):
            break
    scene.uncheck("#handles")
    wait(lambda: not any(a.moving for a in twin.state().axes.values()))
    # Growing angles turn the object clockwise, seen from above. The ring may be taken hold of 6 px
    # beside it, and 57 px are its radius here: 6 degrees.
    assert twin.state().axes["rot_obj"].position - before == pytest.approx(50.0, abs=7.0)
    scene.evaluate("t => flexdt.call('axes.move', {targets: t})", {"rot_obj": before})
    wait(lambda: abs(twin.state().axes["rot_obj"].position - before) < 1e-6)


def _handles(scene: Any, twin: TwinClient) -> dict[str, npt.NDArray[np.float64]]:
    """Where the handles of a machine that stands in the middle are: world [m]."""
    state = twin.state()
    height = state.axes["ver_tube"].position - 6.29
    rows = state.camera.shape[0]
    off = (state.geometry.piercing_point_px[1] - (rows - 1) / 2) * state.camera.pixel_mm
    above = scene.evaluate("flexdt.store.framing.sample_height_mm")
    along = {"source": (0.0, height), "object": (state.geometry.SOD_mm, height + above),
             "detector": (state.geometry.SDD_mm, height + off)}  # fmt: skip
    return {stage: np.array([0.0, y, z]) * 0.001 for stage, (y, z) in along.items()}


def _on_screen(
    frame: dict[str, float], view: str, point: npt.NDArray[np.float64]
) -> tuple[float, float]:
    """Where a point of the world [m] appears on the page, in a view that is at its preset."""
    camera = roomy(FIXED[view], frame["width"] / frame["height"])
    eye = np.asarray(camera.position)
    ahead = np.asarray(camera.look_at) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, camera.up)
    right /= np.linalg.norm(right)
    along = point - eye
    scale = 0.5 * frame["height"] / math.tan(camera.fov / 2.0) / (along @ ahead)
    return (
        float(frame["x"] + frame["width"] / 2 + scale * (along @ right)),
        float(frame["y"] + frame["height"] / 2 - scale * (along @ np.cross(right, ahead))),
    )


def test_scrubbing_shows_a_ghost(scene: Any) -> None:
    box = show(scene, "side")
    text = "mag_obj\tmove absolute\t300.0\t\tACK\t\t\n"
    scene.evaluate("text => flexdt.call('viewer.plan', {text})", text)
    before = still(box)
    scene.evaluate("flexdt.call('viewer.scrub', {time_s: 100})")
    settled(box, lambda ghost: np.abs(ghost - before).max() > 25.0)
    scene.evaluate("flexdt.call('viewer.scrub', {time_s: null})")
    settled(box, lambda back: np.abs(back - before).mean() < 1.0)


def test_a_planned_trajectory_is_its_own_pages_in_every_view(
    scene: Any, open_page: Callable[..., Any]
) -> None:
    box = show(scene, "free")
    before = still(box)
    other = open_page("none", SIZE)
    wish = "flexdt.call('viewer.compose', {kind: 'fly', frames: 45})"
    plan = "text => flexdt.call('viewer.plan', {text}).then(() => null)"
    text = scene.evaluate(wish)["text"]
    other.evaluate(plan, text)
    scene.wait_for_timeout(900)
    assert changed(still(box), before) < PATH_PX
    scene.evaluate(plan, text)
    settled(box, lambda now: changed(now, before) > PATH_PX)
    other.close()
    show(scene, "side")
    box = show(scene, "free")  # a frame that was opened after the plan
    settled(box, lambda now: changed(now, before) > PATH_PX)
    scene.evaluate(plan, None)
    settled(box, lambda now: changed(now, before) < PATH_PX)


def test_a_planned_trajectory_is_drawn_and_layers_are_switched(scene: Any) -> None:
    box = show(scene, "free")
    scene.click("#tabs [data-tab=scan]")
    scene.select_option("#wish-kind", "fly")
    scene.fill("#wish-frames", "45")
    scene.click("#compose")
    scene.locator("#report .verdict").wait_for()
    before = still(box)
    scene.click("#plan")
    scene.locator("#timeline-card").wait_for()
    scene.click("#unscrub")
    drawn_path = settled(box, lambda now: np.abs(now - before).max() > 25.0)
    scene.click("#tabs [data-tab=setup]")
    for layer in ("orbit", "machine", "sample"):
        last = still(box)
        scene.uncheck(f"#layer-{layer}")
        settled(box, lambda now, last=last: np.abs(now - last).max() > 25.0)
    for layer in ("sample", "machine", "orbit"):
        scene.check(f"#layer-{layer}")
    settled(box, lambda back: np.abs(back - drawn_path).mean() < 1.0)
    scene.locator("#opacity").evaluate(
        "e => { e.value = 1; e.dispatchEvent(new Event('change')); }"
    )
    scene.wait_for_function("flexdt.store.opacity === 1")
    scene.locator("#opacity").evaluate(
        "e => { e.value = 0.6; e.dispatchEvent(new Event('change')); }"
    )


def test_a_picture_of_a_view_is_a_download(scene: Any) -> None:
    show(scene, "side")
    scene.click("#tabs [data-tab=share]")
    with scene.expect_download(timeout=120_000) as promise:
        scene.click("#shot")
    image = Image.open(promise.value.path())
    assert image.size == (1280, 800)
    assert np.asarray(image.convert("L"), dtype=float).std() > 5.0


def test_four_views_at_once(scene: Any) -> None:
    scene.click("#view-switch [data-layout=four]")
    assert scene.locator(".view iframe").count() == 4
    for view in ("iso", "beam", "side", "free"):
        assert picture(scene.locator(f".view[data-view={view}]")).shape[0] > 100
        scene.frame_locator(f".view[data-view={view}] iframe").locator("canvas").first.wait_for()


def test_light_and_dark(scene: Any) -> None:
    box = show(scene, "side")
    light = still(box)
    scene.click("#theme")
    scene.wait_for_timeout(500)
    dark = still(box)
    scene.click("#theme")
    assert light.mean() - dark.mean() > 60.0
