"""What a page shows first: cameras that hold what matters, a picture that the viewer
computes."""

from __future__ import annotations

import contextlib
import io
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from looking import changed, picture, settled, until
from PIL import Image
from scipy.spatial import ConvexHull
from viser._messages import (
    SetCameraFovMessage,
    SetCameraLookAtMessage,
    SetCameraPositionMessage,
)

from flexdt.clients.client.client import TwinClient
from flexdt.clients.viewer.page_cameras import SceneClients
from flexdt.clients.viewer.scenes.meshes.cabinet import cabinet, room_of
from flexdt.clients.viewer.scenes.sample_looks import MeshCache
from flexdt.clients.viewer.scenes.still import Shape, drawn
from flexdt.clients.viewer.scenes.views import (
    ROOM,
    WIDE,
    Standpoint,
    fitted,
    presets,
    rim,
)
from flexdt.clients.viewer.scenes.world import World, placed
from flexdt.protocol.state_model import SampleState
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import builtin_machine, profile_of

HOME = {
    "ver_tube": 26.29,
    "mag_obj": 600.0,
    "mag_det": 1059.0,
    "ver_det": 20.0,
    "tra_det": 25.32,
}
Points = npt.NDArray[np.float64]


def world_at(**targets: float) -> World:
    machine = builtin_machine()
    motors = {name: axis.home for name, axis in machine.axes.items()} | HOME | targets
    camera = CameraSettings("HW2SW1High", Roi(32, 8, 1943, 1527))
    return placed(machine, profile_of(machine), camera, motors)


def seen_at(points: Points, camera: Standpoint, aspect: float) -> Points:
    """Places (n, 2) in the picture, from -1 to 1, by a matrix as graphics libraries make it."""
    eye = np.asarray(camera.position)
    back = eye - np.asarray(camera.look_at)
    back /= np.linalg.norm(back)
    right = np.cross(camera.up, back)
    right /= np.linalg.norm(right)
    look = np.stack([right, np.cross(back, right), back])
    slope = math.tan(camera.fov / 2.0)
    lens = np.array([[1 / slope / aspect, 0, 0], [0, 1 / slope, 0], [0, 0, -1]])
    x, y, w = lens @ look @ (points - eye).T
    assert (w > 0).all()
    return np.stack([x / w, y / w], axis=1)


@pytest.mark.parametrize("aspect", [0.45, 0.72, 1.0, WIDE, 2.2])
@pytest.mark.parametrize(
    "targets",
    [{}, {"mag_obj": 200.0}, {"mag_det": 700.0, "mag_obj": 300.0, "ver_tube": 200.0}],
)
def test_views_hold_source_sample_and_image(
    targets: dict[str, float], aspect: float
) -> None:
    world = world_at(**targets)
    views = presets(world, 45.0)
    middle, up = world.sample.shift, np.array([0.0, 0.0, 45.0])
    points = np.concatenate([[world.source, middle - up, middle + up], world.corners])
    for view in ("iso", "side", "free"):
        camera = views[view].at(aspect)
        assert views[view].fits(camera, aspect)
        seen = np.abs(seen_at(0.001 * points, camera, aspect))
        assert seen.max() <= ROOM + 1e-9
        assert seen.max() > 0.75
        # The image on the panel is seen from its front, or its edge.
        assert (
            np.asarray(camera.position) - 0.001 * world.detector
        ) @ world.normal < 0.05


@pytest.mark.parametrize("name", ["lego", "wide", "small", "chiral"])
@pytest.mark.parametrize("mag_obj", [150.0, 600.0, 1000.0])
def test_the_sample_close_up_is_large_at_any_magnification_and_turn(
    name: str, mag_obj: float
) -> None:
    """Its longer side takes at least two thirds of the picture, whose side is a third of the
    pane's height: a fifth of the pane."""
    skins = MeshCache().look(SampleState(name=name)).skins
    vertices = np.concatenate([skin.vertices for skin in skins]).astype(float)
    for turn in (0.0, 31.0, 90.0):
        world = world_at(mag_obj=mag_obj, rot_obj=turn)
        rim_mm = rim(world, [skin.vertices for skin in skins])
        camera = presets(world, 45.0, rim_mm)["sample"].at(1.0)
        places = vertices @ world.sample.turn.T + 0.001 * world.sample.shift
        seen = seen_at(places, camera, 1.0)
        size = np.ptp(seen, axis=0) / 2.0
        assert np.abs(seen).max() <= ROOM + 1e-9
        assert size.max() >= 0.62


def test_no_nearer_camera_holds_all_points() -> None:
    points = np.random.default_rng(3).normal(size=(40, 3))
    way = (-0.5, 0.7, -0.4)
    camera = fitted(points, way, 0.7, np.zeros(3))
    ahead = np.asarray(way) / np.linalg.norm(way)
    reach = np.abs(seen_at(points, camera, WIDE)).max(axis=0)
    assert reach.max() == pytest.approx(ROOM)
    eye = np.asarray(camera.position) + 0.01 * ahead
    closer = replace(camera, position=tuple(eye.tolist()))
    assert np.abs(seen_at(points, closer, WIDE)).max() > ROOM


class Pane:
    """viser with one client, whose frame can be resized, whose camera a person can move, and
    which loses what it is told now and then."""

    client_id = 1

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self.aspect = rng, WIDE
        self.position, self.look_at = (0.0,) * 3, (0.0, 1.0, 0.0)
        self.up_direction, self.fov = (0.0, 0.0, 1.0), 1.0
        self.server = self.camera = self._websock_connection = self.gui = self
        self.told = 0

    def path_of(self, client_id: int) -> str:
        return "/scene/0123456789abcdef/iso"

    def get_clients(self) -> dict[int, Any]:
        return {1: self}

    def on_client_connect(self, call: Callable[[Any], None]) -> None:
        self.connect = call

    def on_update(self, call: Callable[[Any], None]) -> None:
        self.report = call

    def on_client_disconnect(self, call: Any) -> None: ...

    def configure_theme(self, **words: bool) -> None: ...

    @contextlib.contextmanager
    def atomic(self) -> Iterator[None]:
        self.heard = self.rng.random() < 0.5
        self.told += 1
        yield
        self.report(self)

    def queue_message(self, message: Any) -> None:
        match message:
            case SetCameraPositionMessage() if self.heard:
                self.position = message.position
            case SetCameraLookAtMessage() if self.heard:
                self.look_at = message.look_at
            case SetCameraFovMessage() if self.heard:
                self.fov = message.fov


@pytest.mark.parametrize("seed", range(10))
def test_a_camera_that_nobody_moved_is_the_one_of_its_pane(seed: int) -> None:
    """Whatever sizes the pane has had (a bar above it comes and goes) and whatever of its
    cameras it lost. One that a person has moved stays, and at rest nothing is said."""
    rng = np.random.default_rng(seed)
    pane = Pane(rng)
    clients = SceneClients(pane)  # type: ignore[arg-type]
    clients.cameras = presets(world_at(), 45.0)
    pane.connect(pane)
    for _ in range(30):
        for _ in range(rng.integers(1, 4)):
            pane.aspect = float(rng.uniform(0.4, 3.0))
            clients.fit()
        for _ in range(60):  # it hears every other time
            clients.fit()
        wanted = clients.cameras["iso"].at(pane.aspect).position
        assert pane.position == pytest.approx(wanted, abs=2e-4)  # [m]
    told = pane.told
    clients.fit()
    pane.position = moved = (5.0, 5.0, 5.0)
    pane.report(pane)
    pane.aspect = 1.0
    clients.fit()
    assert (pane.position, pane.told) == (moved, told)


class Dragged(Pane):
    """The same; what it is told comes at once, later or never, also while a person drags."""

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self.late: list[list[Any]] = []

    @contextlib.contextmanager
    def atomic(self) -> Iterator[None]:
        self.told += 1
        self.batch: list[Any] = []
        yield
        fate = self.rng.integers(3)
        if fate < 2:
            self.late.append(self.batch)
        if fate < 1:
            self.hear()
        else:
            self.report(self)

    def queue_message(self, message: Any) -> None:
        self.batch.append(message)

    def hear(self) -> None:
        self.heard = True
        for batch in self.late:
            for message in batch:
                super().queue_message(message)
            self.report(self)
        self.late = []

    def drag(self) -> None:
        if self.rng.integers(2):
            self.hear()
        far = self.rng.choice([1e-3, 0.1]) * self.rng.normal(size=3)
        far[0] += 2e-3  # a pixel at least
        self.position = tuple((np.asarray(self.position) + far).tolist())
        self.report(self)


@pytest.mark.parametrize("seed", range(20))
def test_a_camera_stays_where_a_person_lets_it_go(seed: int) -> None:
    """Whatever it is told meanwhile; until that person asks for its preset, which it then gets
    whatever it loses."""
    rng = np.random.default_rng(seed)
    pane = Dragged(rng)
    clients = SceneClients(pane)  # type: ignore[arg-type]
    clients.cameras = presets(world_at(), 45.0)
    pane.connect(pane)

    def resized() -> None:
        pane.aspect = float(rng.uniform(0.4, 3.0))
        clients.fit()

    def at_home() -> bool:
        wanted = clients.cameras["iso"].at(pane.aspect).position
        return bool(np.allclose(pane.position, wanted, atol=2e-4))

    for _ in range(30):
        for _ in range(60):
            clients.fit()
        pane.hear()
        assert at_home()
        for _ in range(rng.integers(1, 5)):
            for _ in range(rng.integers(3)):
                resized()
            pane.drag()
        pane.hear()
        pane.drag()
        let_go = pane.position
        for _ in range(10):
            resized()
            pane.hear()
            assert pane.position == let_go
        clients.reset("0123456789abcdef", "iso")


EYE = Standpoint((0.3, -2.0, 0.4), (0.1, 0.1, 0.05), (0.0, 0.0, 1.0), 0.6)


def test_a_solid_covers_the_hull_of_its_corners_and_hides_what_lies_behind() -> None:
    box = trimesh.creation.box((0.5, 0.3, 0.4))
    ball = trimesh.creation.icosphere(radius=0.1)
    ball.apply_translation((0.0, 0.6, 0.0))
    red, blue = np.array([250, 0, 0]), np.array([0, 0, 250])
    behind = Shape(ball.triangles, blue, lit=False)
    size = (300, 200)
    now = drawn([behind, Shape(box.triangles, red, lit=False)], EYE, size, False).astype(
        int
    )
    is_red = (now[..., 0] > 200) & (now[..., 2] < 60)
    corners = seen_at(np.asarray(box.vertices), EYE, 1.5) * [150.0, 100.0]
    assert is_red.sum() == pytest.approx(
        ConvexHull(corners).volume, rel=0.02
    )  # area, in 2-D
    assert not ((now[..., 2] > 200) & (now[..., 0] < 60)).any()
    glass = Shape(box.triangles, red, 0.4, lit=False)
    through = drawn([behind, glass], EYE, size, False).astype(int)
    middle = seen_at(np.array([[0.0, 0.6, 0.0]]), EYE, 1.5)[0]
    row, column = int(100 - 100 * middle[1]), int(150 + 150 * middle[0])
    assert through[row, column] == pytest.approx([100, 0, 150], abs=3)


def test_large_triangles_that_reach_behind_the_eye_do_not_break_a_picture() -> None:
    around = trimesh.creation.box((9.0, 9.0, 9.0))
    around.invert()
    grey = np.array([90, 90, 90])
    now = drawn([Shape(around.triangles, grey, lit=False)], EYE, (64, 48), True)
    assert now.shape == (48, 64, 3)


def test_the_cabinet_never_stands_between_a_camera_outside_and_the_machine() -> None:
    pieces, lamp = cabinet(room_of(builtin_machine()))
    triangles = np.concatenate(
        [p.mesh.triangles for p in pieces if p.mesh.extents.max() < 2400.0]
    )
    whole = np.concatenate([p.mesh.triangles for p in pieces]).reshape(-1, 3)
    low, high = whole.min(axis=0), whole.max(axis=0)
    assert ((lamp > low) & (lamp < high)).all()
    rng = np.random.default_rng(5)
    for _ in range(300):
        way = rng.normal(size=3)
        way[2] = abs(way[2])
        target = rng.uniform([-150, 0, -100], [150, 1000, 300])
        eye = target + way * 4000.0 / np.linalg.norm(way)
        a, b, c = np.moveaxis(triangles, 1, 0)
        normal = np.cross(b - a, c - a)
        ahead = target - eye
        with np.errstate(divide="ignore", invalid="ignore"):
            along = ((a - eye) * normal).sum(axis=1) / (normal @ ahead)
        at = eye + along[:, None] * ahead
        sides = [(np.cross(q - p, at - p) * normal).sum(axis=1) >= 0
                 for p, q in ((a, b), (b, c), (c, a))]  # fmt: skip
        front = normal @ ahead < 0.0
        assert not (
            np.logical_and.reduce(sides) & front & (along > 0.0) & (along < 0.99)
        ).any()


def still_of(page: Any, url: str) -> Image.Image:
    """Fetch the viewer's own picture of the scene; a JPEG of at most 60 kB.

    A viewer that has none yet says so (204), and is asked again.
    """
    reply = until(lambda: (r := page.request.get(url)).status != 204 and r, url)
    raw = reply.body()
    assert reply.ok
    assert len(raw) <= 60_000
    painted = Image.open(io.BytesIO(raw))
    assert painted.format == "JPEG"
    return painted


@pytest.mark.browser
def test_the_viewer_paints_the_scene_until_the_live_one_is_there(
    open_page: Callable[..., Any], lab: Any
) -> None:
    page = open_page("iso", (1366, 768), notes_stay=False)
    box = page.locator(".view[data-view=iso]")
    page.wait_for_function("document.querySelector('#still').naturalWidth > 0")
    url = page.evaluate("document.querySelector('#still').src")
    asked = {name: int(re.search(rf"[?&]{name}=(\d+)", url)[1]) for name in "wh"}
    painted = still_of(page, url)
    assert painted.size == (asked["w"], asked["h"])
    page.locator(".view.live").wait_for()
    page.locator("#still").wait_for(state="hidden")

    def same(live: Any) -> bool:
        # The bar above may have wrapped to a second row since: one picture of the pane as it is.
        size = f"w={live.shape[1]}&h={live.shape[0]}"
        painted = still_of(page, re.sub(r"w=\d+&h=\d+", size, url))
        own = np.asarray(painted.convert("L"), dtype=np.float32)
        part = np.s_[60:-130, 130:-20]  # without buttons, tag and the sample's picture
        both = live.mean(axis=2)[part].ravel(), own[part].ravel()
        return bool(np.corrcoef(*both)[0, 1] > 0.8)

    # Both pictures are of one scene, from one place: edges of the one are edges of the other,
    # once the live one has faded in.
    settled(box, same)
    page.set_viewport_size({"width": 1366, "height": 600})
    settled(box, same)
    inset = page.locator(".view .inset")
    inset.click()
    inset.wait_for(state="hidden")  # the view itself shows the sample now
    page.click(".view .home")
    inset.wait_for()
    page.keyboard.press("Alt+0")
    inset.wait_for(state="hidden")
    page.close()


@pytest.mark.browser
def test_the_samples_own_picture_turns_with_it(
    open_page: Callable[..., Any], twin: TwinClient
) -> None:
    page = open_page("iso", (1366, 768), notes_stay=False)
    inset = page.locator(".view .inset img")
    page.wait_for_function("document.querySelector('.inset img').naturalWidth > 0")
    before = picture(inset)
    twin.control("force")
    twin.move({"rot_obj": 70}, relative=True, wait=True)
    twin.control("release")

    def turned() -> bool:
        """While somebody has control the header may be higher, and the pane smaller."""
        now = picture(inset)
        return now.shape == before.shape and changed(now, before) > 200

    until(turned, "the turned sample")
    page.close()


@pytest.mark.browser
def test_a_still_of_no_view_is_empty(open_page: Callable[..., Any], lab: Any) -> None:
    page = open_page()
    for asked in ("view=none", "view=iso&w=x", ""):
        answer = page.request.get(f"{lab.url}still.jpg?{asked}")
        assert answer.status == (200 if asked.startswith("view=iso") else 204)
    page.close()
