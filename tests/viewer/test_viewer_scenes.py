"""The scenes themselves: four views, presets, the beam's eye against the projection,
dragging."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from looking import changed, drawn, frames, picture, seen, settled, still
from PIL import Image
from scipy.ndimage import distance_transform_edt
from scipy.spatial import ConvexHull

from flexdt.clients.client.client import TwinClient
from flexdt.clients.viewer.scenes.drag_handles import SIZE_M
from flexdt.clients.viewer.scenes.layers import LAYERS
from flexdt.clients.viewer.scenes.sample_looks import MeshCache
from flexdt.clients.viewer.scenes.views import Standpoint, presets
from flexdt.clients.viewer.scenes.world import world_of
from flexdt.protocol.state_model import State
from flexdt.twin.machine.description import builtin_machine, profile_of

pytestmark = pytest.mark.browser
Wait = Callable[..., Any]
SIZE = (1040, 640)


@pytest.fixture(scope="module")
def scene(open_page: Callable[..., Any]) -> Iterator[Any]:
    page = open_page("none", SIZE, notes_stay=False)  # they lie over the views
    # The places of handles on the screen are told for views of this size.
    page.evaluate("document.querySelector('main').style.setProperty('--right', '274px')")
    # The sample's own picture over the isometric view changes in its own time.
    page.add_style_tag(content=".inset { visibility: hidden }")
    yield page
    page.close()


def show(page: Any, view: str) -> Any:
    page.click(f"#view-switch [data-layout={view}]")
    box = page.locator(f".view[data-view={view}]")
    box.locator("iframe").wait_for()
    settled(box, drawn)
    return box


AT_FIRST = {**{layer.name: layer.shown for layer in LAYERS}, "opacity": 0.6}
"""What a page shows before anybody has switched a layer."""

PATH_PX = 100
"""A planned trajectory takes more pixels than that, and what remains without it fewer."""


def layers(page: Any, **values: object) -> None:
    page.evaluate("v => flexdt.call('viewer.layers', v)", values)


def outline_error(scene: Any, lab: Any, wait: Wait) -> float:
    """How far [px of the screen] the drawn sample's outline lies from its shadow's, at
    worst."""
    hidden = dict.fromkeys(HIDDEN, False)
    layers(scene, **hidden, opacity=1.0)
    scene.evaluate(
        "flexdt.call('camera.set', {roi: [32, 8, 1943, 1527], mode: 'HW2SW1High'})"
    )
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
        layers(scene, **AT_FIRST)
    drawn = np.abs(with_sample - empty).max(axis=2) > 24.0
    rows, cols = drawn.shape
    # Pixel centres of the screen to pixels of the image: the crop is exactly the image.
    r = ((np.arange(rows) + 0.5) * shadow_image.shape[0] / rows).astype(int)
    c = ((np.arange(cols) + 0.5) * shadow_image.shape[1] / cols).astype(int)
    shadow = (shadow_image > 1e-4)[np.ix_(r, c)]
    assert 0.02 < shadow.mean() < 0.9
    assert cols > 400
    # A pixel that differs may lie within two pixels of the shadow's outline, on either side.
    depth = np.where(
        shadow, distance_transform_edt(shadow), distance_transform_edt(~shadow)
    )
    inner = slice(3, -3)  # the crop's own one-pixel frame is no part of the picture
    return float((depth * (drawn ^ shadow))[inner, inner].max(initial=0.0))


def test_beams_eye_is_the_shadow_within_two_pixels(
    scene: Any, lab: Any, wait: Wait
) -> None:
    """The drawn sample's outline, seen from the focal spot, is the outline of its X-ray
    shadow."""
    move = "t => flexdt.call('axes.move', {targets: t})"
    targets = {
        "mag_obj": 700.0,
        "tra_obj": 4.0,
        "rot_obj": 33.0,
        "ver_tube": 50.0,
        "tra_det": 60.0,
    }
    scene.evaluate(
        "flexdt.call('sample.set', {name: 'normal', offset: {x: 3, z: 2, ry: 15}})"
    )
    scene.evaluate("flexdt.call('session.control', {action: 'force'})")
    scene.evaluate(move, targets)
    wait(
        lambda: outline_error(scene, lab, wait) <= 2.0, "it is drawn where it stands", 240
    )


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
    wait(lambda: outline_error(scene, lab, wait) <= 2.0, "the shape is drawn", 240)
    scene.evaluate("flexdt.call('sample.set', {name: 'lego'})")


@pytest.mark.campaign
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


def test_keys_work_while_a_scene_has_the_focus(
    scene: Any, twin: TwinClient, wait: Wait
) -> None:
    scene.check("#key-jog")
    box = show(scene, "side")
    frame = box.bounding_box()
    scene.mouse.click(frame["x"] + frame["width"] / 2, frame["y"] + 60)
    before = twin.state().axes["ver_tube"].position
    scene.keyboard.down("i")
    try:
        wait(lambda: twin.state().axes["ver_tube"].position > before + 0.05)
    finally:
        scene.keyboard.up("i")
    wait(lambda: not twin.state().axes["ver_tube"].moving)


def held(box: Any) -> bool:
    """Whether the pointer lies on a handle: it is yellow then, and nothing else is."""
    frames(box, 3)
    red, green, blue = np.moveaxis(picture(box), 2, 0)
    yellow = (
        (np.minimum(red, green) - blue > 70.0)
        & (np.abs(red - green) < 20.0)
        & (red > 180.0)
    )
    return int(yellow.sum()) > 20


def with_handles(scene: Any, twin: TwinClient, wait: Wait, view: str) -> Any:
    """Show a view at its preset with handles, the stages apart."""
    scene.evaluate("flexdt.call('session.control', {action: 'force'})")
    scene.evaluate(
        "flexdt.call('axes.move', {targets: {mag_det: 900, mag_obj: 450, tra_obj: 0}})"
    )
    wait(lambda: not any(a.moving for a in twin.state().axes.values()))
    box = show(scene, view)
    scene.click("#tabs [data-tab=move]")
    scene.check("#handles")
    seen(scene, twin)
    box.locator(".home").click()  # the preset of the machine as it stands now
    scene.mouse.move(1, 1)
    still(box)
    return box


@pytest.mark.parametrize(
    ("axis", "stage", "along"),
    [("ver_tube", "source", "z"), ("mag_obj", "object", "y"), ("mag_det", "detector", "y"),
     ("ver_det", "detector", "z")],
)  # fmt: skip
@pytest.mark.campaign(1)
def test_dragging_a_handle_moves_its_stage(
    scene: Any, twin: TwinClient, wait: Wait, axis: str, stage: str, along: str
) -> None:
    box = with_handles(scene, twin, wait, "side")
    frame = box.bounding_box()
    before = twin.state().axes[axis].position
    # An arrow begins at its stage's point; those of the detector point to the source. Side view:
    # world y runs to the right, z up.
    point, camera = _handles(scene, twin)[stage], preset(scene, "side", frame)
    direction = np.array([0.0, 0.0, 1.0] if along == "z" else [0.0, 1.0, 0.0])
    sign = -1.0 if along == "y" else 1.0  # towards the source there is room
    way = -direction if (stage, along) == ("detector", "y") else direction
    for reach in 3 * (1.0, 0.95, 0.9, 0.85):  # the ring, 0.65 wide, lies before the arrow
        here = _on_screen(frame, camera, point + SIZE_M * reach * way)
        scene.mouse.move(*here)
        if held(box):
            break
    else:
        raise AssertionError("no handle sees the pointer")
    scene.mouse.down()
    there = (here[0], here[1] - 30) if along == "z" else (here[0] - 30, here[1])
    scene.mouse.move(*there, steps=6)
    frames(box, 3)
    scene.mouse.up()
    wait(
        lambda: abs(twin.state().axes[axis].target - before) > 1.0,
        f"{axis} is sent somewhere",
    )
    assert re.search(f"{axis} .*can be reached", str(scene.text_content("#dragged")))
    scene.uncheck("#handles")
    wait(lambda: (twin.state().axes[axis].position - before) * sign > 1.0, axis)
    wait(lambda: not any(a.moving for a in twin.state().axes.values()))
    scene.evaluate("t => flexdt.call('axes.move', {targets: t})", {axis: before})
    wait(lambda: abs(twin.state().axes[axis].position - before) < 1e-6)


def test_dragging_the_ring_turns_the_sample_with_the_pointer(
    scene: Any, twin: TwinClient, wait: Wait
) -> None:
    box = with_handles(scene, twin, wait, "free")
    frame = box.bounding_box()
    camera = preset(scene, "free", frame)
    before = twin.state().axes["rot_obj"].position

    def place(degrees: float, radius: float) -> tuple[float, float]:
        turn = math.radians(degrees)
        arm = SIZE_M * radius * np.array([math.cos(turn), math.sin(turn), 0.0])
        return _on_screen(frame, camera, _handles(scene, twin)["object"] + arm)

    # The ring is an arc from the arrow along x to the one along y; 50 degrees clockwise on it.
    for radius in 3 * (0.65, 0.63, 0.67):
        scene.mouse.move(*place(70.0, radius))
        if held(box):
            break
    else:
        raise AssertionError("no handle sees the pointer")
    scene.mouse.down()
    for degrees in (60.0, 50.0, 40.0, 30.0, 20.0):
        scene.mouse.move(*place(degrees, radius))
    frames(box, 3)
    scene.mouse.up()
    # The stage follows the drag at its end, however late.
    wait(
        lambda: abs(twin.state().axes["rot_obj"].target - before) > 43.0, "the drag's end"
    )
    scene.uncheck("#handles")
    wait(lambda: not any(a.moving for a in twin.state().axes.values()))
    # Growing angles turn the object clockwise, seen from above. The ring may be taken hold of 6
    # px beside it, and 57 px are its radius here: 6 degrees.
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


def preset(page: Any, view: str, frame: dict[str, float]) -> Standpoint:
    """A view's preset in a pane, from the state that the page shows."""
    machine = builtin_machine()
    state = State.model_validate(page.evaluate("flexdt.store.state"))
    world = world_of(machine, profile_of(machine), state)
    shipped = state.sample.revision is None
    look_mm = MeshCache().look(state.sample).radius_mm if shipped else 0.0
    radius_mm = look_mm if shipped else 0.5 * float(np.linalg.norm(BLOCK_MM))
    return presets(world, radius_mm)[view].at(frame["width"] / frame["height"])


def _on_screen(
    frame: dict[str, float], camera: Standpoint, point: npt.NDArray[np.float64]
) -> tuple[float, float]:
    """Where a point of the world [m] appears on the page, in a view that is at its preset."""
    eye = np.asarray(camera.position)
    ahead = np.asarray(camera.look_at) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, camera.up)
    right /= np.linalg.norm(right)
    along = point - eye
    scale = 0.5 * frame["height"] / math.tan(camera.fov / 2.0) / (along @ ahead)
    return (
        float(frame["x"] + frame["width"] / 2 + scale * (along @ right)),
        float(
            frame["y"] + frame["height"] / 2 - scale * (along @ np.cross(right, ahead))
        ),
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


@pytest.mark.campaign
def test_a_planned_trajectory_is_its_own_pages_in_every_view(
    scene: Any, open_page: Callable[..., Any]
) -> None:
    box = show(scene, "free")
    before = still(box)
    other = open_page("none", SIZE, notes_stay=False)
    wish = "flexdt.call('viewer.compose', {kind: 'fly', frames: 45})"
    plan = "text => flexdt.call('viewer.plan', {text}).then(() => null)"
    text = scene.evaluate(wish)["text"]
    other.evaluate(plan, text)
    assert changed(still(box), before) < PATH_PX
    scene.evaluate(plan, text)
    settled(box, lambda now: changed(now, before) > PATH_PX)
    other.close()
    show(scene, "side")
    box = show(scene, "free")  # a frame that was opened after the plan
    settled(box, lambda now: changed(now, before) > PATH_PX)
    scene.evaluate(plan, None)
    settled(box, lambda now: changed(now, before) < PATH_PX)


@pytest.mark.campaign
def test_a_planned_trajectory_is_drawn_and_layers_are_switched(scene: Any) -> None:
    box = show(scene, "free")
    scene.click("#tabs [data-tab=scan]")
    scene.select_option("#wish-kind", "fly")
    scene.fill("#wish-frames", "45")
    scene.fill("#script", "")
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


@pytest.mark.campaign
def test_four_views_at_once(scene: Any) -> None:
    scene.click("#view-switch [data-layout=four]")
    assert scene.locator(".view iframe").count() == 4
    for view in ("iso", "beam", "side", "free"):
        settled(scene.locator(f".view[data-view={view}]"), drawn)


BLOCK_MM = (120.0, 80.0, 30.0)
HIDDEN = ("names", "cabinet", "machine", "panel", "beam", "axis", "orbit")
MIDDLE = {"tra_obj": 0.0, "tra_tube": 0.0, "tra_det": 24.1, "ver_tube": 50.0, "ver_det": 60.0,
          "mag_obj": 500.0, "mag_det": 1000.0, "rot_obj": 25.0}  # fmt: skip
PINK = (255.0, 60.0, 160.0)


@pytest.fixture
def block(scene: Any, twin: TwinClient, wait: Wait) -> Iterator[Any]:
    """A block on the stage, turned, the stages in the middle, and nothing else drawn;
    afterwards everything is where it was."""
    stood = {n: a.position for n, a in twin.state().axes.items() if n in MIDDLE}
    scene.evaluate("flexdt.call('session.control', {action: 'release'})")
    mesh = trimesh.creation.box(BLOCK_MM)
    twin.upload_mesh(mesh.export(file_type="stl"), "a-block", format="stl")
    twin.set_sample(file="a-block", material="abs")
    go(scene, twin, wait, MIDDLE)
    layers(scene, **dict.fromkeys(HIDDEN, False), opacity=1.0)
    scene.set_viewport_size({"width": 1340, "height": 800})
    yield scene
    scene.set_viewport_size({"width": SIZE[0], "height": SIZE[1]})
    layers(scene, **AT_FIRST)
    scene.evaluate("flexdt.call('sample.set', {name: 'lego'})")
    go(scene, twin, wait, stood)


def go(scene: Any, twin: TwinClient, wait: Wait, targets: dict[str, float]) -> None:
    scene.evaluate("flexdt.call('session.control', {action: 'force'})")
    scene.evaluate("t => flexdt.call('axes.move', {targets: t, plan: true})", targets)

    def there() -> bool:
        axes = twin.state().axes
        return all(abs(axes[n].position - v) < 1e-6 for n, v in targets.items())

    wait(there, f"at {targets}")


def off_outline(
    box: Any, layer: str, view: str, points: npt.NDArray[np.float64]
) -> float:
    """How far [px] a layer's picture lies off the outline of a convex body's points [m], at
    worst.

    The points are projected here, with the pinhole of the view's camera alone.
    """
    found = math.inf
    # The image on the panel, a shape or the view's own size may come late.
    for _ in range(12):
        box.locator(".home").click()
        layers(box.page, **{layer: True})
        shown = still(box)
        layers(box.page, **{layer: False})
        bare = still(box)
        if bare.shape != shown.shape:
            continue
        differs = np.abs(bare - shown).max(axis=2) > 24.0
        wanted = _convex_outline(box, view, points, differs.shape)
        assert 200 < wanted.sum() < 0.2 * wanted.size
        depth = np.where(
            wanted, distance_transform_edt(wanted), distance_transform_edt(~wanted)
        )
        found = min(found, float((depth * (differs ^ wanted)).max()))
        if found <= 2.0:
            break
    return found


def _convex_outline(
    box: Any, view: str, points: npt.NDArray[np.float64], shape: tuple[int, ...]
) -> npt.NDArray[np.bool_]:
    """Draw the convex hull of points [m] as a view of now shows it, in a picture of `shape`
    (rows, cols)."""
    frame = {**box.bounding_box(), "x": 0.0, "y": 0.0}
    camera = preset(box.page, view, frame)
    corners = np.array([_on_screen(frame, camera, p) for p in points])
    return inside_hull(corners, *shape)


def inside_hull(
    corners: npt.NDArray[np.float64], rows: int, cols: int
) -> npt.NDArray[np.bool_]:
    """Pixels whose centres lie in the convex hull of points (x, y)."""
    hull = ConvexHull(corners)
    y, x = np.mgrid[0:rows, 0:cols] + 0.5
    sides = (
        hull.equations[:, :2] @ np.stack([x.ravel(), y.ravel()]) + hull.equations[:, 2:]
    )
    return np.asarray((sides <= 0.0).all(axis=0).reshape(rows, cols))


@pytest.mark.parametrize("view", ["iso", "side", "free"])
@pytest.mark.campaign(1)
def test_a_view_shows_sample_and_image_where_the_geometry_puts_them(
    block: Any, twin: TwinClient, view: str
) -> None:
    box = show_bare(block, view, "sample")
    turn = -math.radians(25.0)  # growing angles turn clockwise, seen from above
    c, n = math.cos(turn), math.sin(turn)
    signs = np.array(
        [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float
    )
    points = signs * np.array(BLOCK_MM) / 2000.0
    points = points @ np.array([[c, -n, 0.0], [n, c, 0.0], [0.0, 0.0, 1.0]]).T
    assert (
        off_outline(box, "sample", view, points + _handles(block, twin)["object"]) <= 2.0
    )
    if view == "side":  # which sees the panel from its edge
        return
    block.evaluate(
        "flexdt.call('viewer.window', {low: 100, high: 200})"
    )  # black all over
    try:
        state = twin.state()
        (rows, cols), pitch = state.camera.shape, state.camera.pixel_mm * 0.001
        off = state.geometry.piercing_point_px[0] - (cols - 1) / 2
        centre = _handles(block, twin)["detector"] - [off * pitch, 0.0, 0.0]
        points = 0.5 * signs[:, [0, 2, 1]] * [cols * pitch, 0.0, rows * pitch]
        corners = np.unique(points, axis=0) + centre
        assert off_outline(box, "panel", view, corners) <= 2.0
    finally:
        block.evaluate("flexdt.call('viewer.window', {})")


def show_bare(page: Any, view: str, layer: str) -> Any:
    page.click(f"#view-switch [data-layout={view}]")
    box = page.locator(f".view[data-view={view}]")
    box.locator("iframe").wait_for()
    layers(page, **{layer: True})
    still(box)
    box.locator(".home").click()  # the preset of a picture as wide as this one
    still(box)
    return box


def test_a_clicked_pixels_ray_is_drawn_and_says_what_it_goes_through(
    block: Any, twin: TwinClient, wait: Wait
) -> None:
    """Where the ray cuts the block's faces, and where it lies on the screen, is computed
    here."""
    box = show_bare(block, "iso", "machine")
    layers(block, machine=False, sample=False)
    settled(box, lambda now: pink(now).sum() == 0)
    seen(block, twin)
    told = twin.geometry()
    source, middle, u, v = np.array(told.cone_vec).reshape(4, 3)
    rows, cols = told.detector_shape
    block.wait_for_function("flexdt.store.image.code === 'deflate'")
    block.select_option("#tool", "ray")
    rng = np.random.default_rng(8)
    for k in range(3):
        # In the object's frame the block stands as it was uploaded; the panel sees its upper
        # part.
        aim = rng.uniform([-0.4, -0.4, 0.3], [0.4, 0.4, 0.48]) * BLOCK_MM
        across, down, _ = np.linalg.solve(
            np.stack([u, v, source - aim], axis=1), source - middle
        )
        column, row = round(across + (cols - 1) / 2), round(down + (rows - 1) / 2)
        if k == 0:
            block.fill("#measure-at", f"{column} {row}")
            block.press("#measure-at", "Enter")
        else:
            click_pixel(block, column, row, (rows, cols))
        end = middle + (column - (cols - 1) / 2) * u + (row - (rows - 1) / 2) * v
        faces = np.sort(
            (np.array([-1, 1])[:, None] * BLOCK_MM / 2 - source) / (end - source), 0
        )
        length = float(np.linalg.norm(end - source))
        inside = max(0.0, faces[1].min() - faces[0].max()) * length
        assert inside > 5.0
        words = rf"abs {NUMBER} mm · {NUMBER} mm from the focal spot"

        def said(
            wanted: tuple[float, float] = (inside, length), words: str = words
        ) -> bool:
            found = re.fullmatch(words, block.inner_text("#measured"))
            return found is not None and np.allclose(
                [*map(float, found.groups())], wanted, 0, 0.06
            )

        wait(said, f"{inside} mm of abs at {column} {row}")
    frame = {**box.bounding_box(), "x": 0.0, "y": 0.0}
    here, there = (
        np.array(_on_screen(frame, preset(block, "iso", frame), point))
        for point in (_handles(block, twin)["source"], place_of(twin, (column, row)))
    )
    shown = settled(box, lambda now: pink(now).sum() > PATH_PX)
    y, x = np.nonzero(pink(shown))
    length = float(np.linalg.norm(there - here))
    along, at = (there - here) / length, np.stack([x, y], axis=1) + 0.5 - here
    assert np.abs(at @ [-along[1], along[0]]).max() <= 4.0
    assert (at @ along).min() == pytest.approx(0.0, abs=6.0)
    assert (at @ along).max() == pytest.approx(length, abs=6.0)
    block.select_option("#tool", "pan")
    settled(box, lambda now: pink(now).sum() == 0)


NUMBER = r"([0-9.]+)"


def pink(view: Any) -> Any:
    return np.abs(view[..., :3] - np.array(PINK)).max(axis=2) < 40.0


def place_of(twin: TwinClient, pixel: tuple[int, int]) -> npt.NDArray[np.float64]:
    """The centre of a pixel in the world [m], of a machine that stands in the middle."""
    state = twin.state()
    at, pitch = state.geometry.piercing_point_px, state.camera.pixel_mm * 0.001
    height = (state.axes["ver_tube"].position - 6.29) * 0.001
    return np.array([(pixel[0] - at[0]) * pitch, state.geometry.SDD_mm * 0.001,
                     height - (pixel[1] - at[1]) * pitch])  # fmt: skip


def click_pixel(page: Any, column: int, row: int, shape: tuple[int, int]) -> None:
    """Clicks a pixel of the radiograph that is fitted into its film."""
    canvas = page.locator("#film-canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    scale = min(box["width"] / shape[1], box["height"] / shape[0])
    x = box["x"] + box["width"] / 2 + (column + 0.5 - shape[1] / 2) * scale
    y = box["y"] + box["height"] / 2 + (row + 0.5 - shape[0] / 2) * scale
    page.mouse.click(x, y)


@pytest.mark.campaign
def test_names_axes_scale_and_a_look_at_the_sample(scene: Any) -> None:
    box = show(scene, "iso")
    bare = still(box)
    layers(scene, labels=True)
    named = settled(box, lambda now: changed(now, bare) > 2000)
    layers(scene, labels=False)
    settled(box, lambda now: changed(now, bare) < changed(now, named) / 20)
    # The sample, which is red, is most of what is seen from near.
    red = lambda now: (now[..., 0] - now[..., 1:].max(axis=2) > 40.0).mean()  # noqa: E731
    layers(scene, opacity=1.0)
    far = red(still(box))
    box.locator(".look").click()
    settled(box, lambda now: red(now) > max(0.05, 10 * far))
    box.locator(".home").click()
    settled(box, lambda now: abs(red(now) - far) < 0.01)
    layers(scene, opacity=0.6)


def test_parts_about_to_touch_are_highlighted(
    scene: Any, twin: TwinClient, wait: Wait
) -> None:
    """Their collision bodies turn red, and lose it when they are apart again."""
    box = show(scene, "side")
    red = lambda now: int((now[..., 0] - now[..., 1:].max(axis=2) > 40.0).sum())  # noqa: E731
    layers(scene, sample=False)  # which is red itself
    apart = red(still(box))
    into = "flexdt.call('axes.move', {targets: {mag_det: 300}}).then(() => null, (e) => e.code)"
    try:
        assert scene.evaluate(into) == -32002
        scene.locator("#near .meter.touch").wait_for()
        settled(box, lambda now: red(now) > apart + 1000)
    finally:
        scene.evaluate("flexdt.call('safety.reset')")
        scene.evaluate("flexdt.call('axes.move', {targets: {mag_det: 1000}})")
        wait(lambda: abs(twin.state().axes["mag_det"].position - 1000.0) < 1e-6)
    settled(box, lambda now: red(now) < apart + 200)
    layers(scene, sample=True)


def test_a_scene_of_another_size_shows_the_old_picture_until_the_new_one(
    scene: Any,
) -> None:
    """A canvas is emptied by a new size: it has none that no picture has begun with."""
    show(scene, "iso")
    frame = next(f for f in scene.frames if "/iso?" in f.url)
    inside = scene.locator(".view[data-view=iso] iframe").element_handle()
    frame.evaluate("""() => {
        const canvas = document.querySelector("canvas[data-engine]");
        const glass = canvas.getContext("webgl2");
        const clear = glass.clear;
        window.begun = new Set([glass.drawingBufferWidth]);
        window.empty = [];
        glass.clear = function (mask) {
            clear.call(glass, mask);
            begun.add(glass.drawingBufferWidth);
        };
        window.looks = setInterval(() => {
            const width = glass.drawingBufferWidth;
            if (!begun.has(width)) empty.push(width);
        }, 1);
    }""")
    try:
        for count, width in enumerate((400, 460, 430), 2):
            inside.evaluate(f"e => e.style.width = '{width}px'")
            frame.wait_for_function(
                f"begun.size >= {count} || empty.length > 0", polling=100
            )
        assert frame.evaluate("empty") == []
    finally:
        frame.evaluate("clearInterval(looks)")
        inside.evaluate("e => e.style.width = ''")
    settled(scene.locator(".view[data-view=iso]"), drawn)


def test_nothing_is_drawn_while_nothing_changes(scene: Any, wait: Wait) -> None:
    """By viser's own count of its pictures; left to itself it draws one every second."""
    frame = show(scene, "side").locator("iframe").element_handle().content_frame()

    def pictures() -> int:
        return int(frame.evaluate("window.__viserTestpoints.rendererInfo.render.frame"))

    def at_rest() -> bool:
        before = pictures()
        scene.wait_for_timeout(4000)
        return pictures() == before

    wait(at_rest, "four seconds without a picture")


def test_light_and_dark(scene: Any) -> None:
    box = show(scene, "side")
    light = still(box).mean()
    scene.click("#theme")
    settled(box, lambda dark: light - dark.mean() > 60.0)
    scene.click("#theme")
    settled(box, lambda again: abs(light - again.mean()) < 5.0)
