"""What the scene draws is the public geometry: against the rows, and against plain optics."""

from __future__ import annotations

import asyncio
import io
import json
import math
import struct
import zlib
from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import trimesh
import viser
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

from flexdt.clients.viewer.scenes.beam_planes import MOST, fans
from flexdt.clients.viewer.scenes.drag_handles import Gizmos
from flexdt.clients.viewer.scenes.lab_scene import LabScene
from flexdt.clients.viewer.scenes.layers import LAYERS, Shown
from flexdt.clients.viewer.scenes.meshes.collision_bodies import bare, grown
from flexdt.clients.viewer.scenes.meshes.painted_meshes import glb
from flexdt.clients.viewer.scenes.meshes.part_looks import pieces_of
from flexdt.clients.viewer.scenes.name_tags import names_of_image
from flexdt.clients.viewer.scenes.sample_looks import (
    OTHER_COLOR,
    MeshCache,
    SampleLook,
    Skin,
    fetch,
)
from flexdt.clients.viewer.scenes.views import Standpoint, beam_view, presets, rim
from flexdt.clients.viewer.scenes.world import World, beads_on, placed, quaternion
from flexdt.clients.viewer.scrubbed_plan import (
    document,
    plan_text,
    projection_positions,
    source_path,
)
from flexdt.clients.viewer.shown_images import ShownImage, grey, packed, window_of
from flexdt.phantoms import load_phantom, materials, phantom_names
from flexdt.protocol import RpcError
from flexdt.protocol.state_model import SampleState, State
from flexdt.twin.collision.convex_solids import UprightCylinder, hull
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import (
    builtin_machine,
    builtin_machines,
    builtin_profile,
    profile_of,
)
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.scanner.state import StagePlacement

MACHINE = builtin_machine()
PROFILE = builtin_profile(MACHINE.default_profile)
CAMERA = MACHINE.detector.camera
AT = {"tra_tube": 12.0, "ver_tube": 50.0, "mag_obj": 640.0, "tra_obj": -7.0, "rot_obj": 71.0,
      "mag_det": 1020.0, "tra_det": 40.0, "ver_det": 22.0}  # fmt: skip
CORRECTION = Offsets.from_edge(
    {"dO_x": 0.7, "dO_z": -1.1, "alpha": 3.0, "tau_x": 0.4, "dD_y": 1.3, "dS_x": -0.6,
     "det_roll": 0.5, "axis_tilt_x": 0.3, "axis_tilt_z": -0.2, "angle_scale": 1.001}
)  # fmt: skip


@pytest.mark.parametrize("correction", [Offsets(), CORRECTION])
def test_world_and_rows_project_alike(correction: Offsets) -> None:
    """Points of the object drawn in the world appear where the rows say, seen from the
    source."""
    world = placed(MACHINE, PROFILE, CAMERA, AT, correction)
    cone = poses(MACHINE, PROFILE, CAMERA, AT).cone_vec(correction)
    points = np.random.default_rng(1).uniform(-20.0, 20.0, (30, 3))
    wanted = cone.project_points(points, CAMERA.shape)[0]
    drawn = points @ world.stage.turn.T + world.stage.shift
    rays = drawn - world.source
    reach = world.distance / (rays @ world.normal)
    hits = world.source + rays * reach[:, None] - world.detector
    rows, cols = CAMERA.shape
    column = hits @ world.u / (world.u @ world.u) + (cols - 1) / 2
    row = hits @ world.v / (world.v @ world.v) + (rows - 1) / 2
    np.testing.assert_allclose(np.stack([column, row], axis=1), wanted, atol=1e-8)
    np.testing.assert_allclose(
        world.piercing_px, cone.piercing_points(CAMERA.shape)[0], atol=1e-8
    )


@pytest.mark.parametrize("name", builtin_machines())
def test_without_a_correction_tube_and_panel_stand_where_their_motors_are(
    name: str,
) -> None:
    """Also where stages on the turntable hold the sample beside the axis."""
    machine = builtin_machine(name)
    at = {n: 0.9 * axis.home + 0.1 * axis.upper for n, axis in machine.axes.items()}
    world = placed(machine, profile_of(machine, None), machine.detector.camera, at)
    np.testing.assert_allclose([world.tube_shift, world.panel_shift], 0.0, atol=1e-9)


def cone_of(world: World) -> ConeVec:
    """The world's geometry as a row in the sample's own frame."""
    back = world.sample.turn.T
    row = ConeVec.from_vectors(world.source, world.detector, world.u, world.v)
    return row.moved(back, -back @ world.sample.shift)


def test_offset_of_the_sample_and_beads() -> None:
    offset = StagePlacement(3.0, -2.0, 1.0, 10.0, 20.0, 30.0)
    world = placed(MACHINE, PROFILE, CAMERA, AT, CORRECTION, offset)
    cone = poses(MACHINE, PROFILE, CAMERA, AT).cone_vec(CORRECTION)
    beads = load_phantom("lego").beads
    wanted = offset.to_sample(cone).project_points(beads, CAMERA.shape)[0]
    np.testing.assert_allclose(
        cone_of(world).project_points(beads, CAMERA.shape)[0], wanted, atol=1e-8
    )
    found = np.array(beads_on(cone.rows[0].tolist(), beads, world, CAMERA.shape))
    rows, cols = CAMERA.shape
    inside = ((wanted > -0.5) & (wanted < [cols - 0.5, rows - 0.5])).all(axis=1)
    np.testing.assert_allclose(found, wanted[inside], atol=1e-8)


def test_quaternion() -> None:
    for rotation in Rotation.random(50, random_state=3):
        w, x, y, z = quaternion(rotation.as_matrix())
        again = Rotation.from_quat([x, y, z, w]).as_matrix()
        np.testing.assert_allclose(again, rotation.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("tra_det", [-30.0, 24.1, 60.0, 95.0])
def test_beams_eye_frames_exactly_the_image(tra_det: float) -> None:
    """A symmetric camera and the page's crop together show the image's corners at the
    corners."""
    world = placed(MACHINE, PROFILE, CAMERA, {**AT, "tra_det": tra_det, "tra_tube": 0.0})
    camera, frame = beam_view(world)
    assert frame["exact"]
    eye, aim = np.array(camera.position), np.array(camera.look_at)
    forward = (aim - eye) / np.linalg.norm(aim - eye)
    up = np.array(camera.up)
    right = np.cross(forward, up)
    for corner, (x, y) in zip(
        world.corners * 0.001,
        ((0, 0), (1, 0), (1, frame["aspect"]), (0, frame["aspect"])),
        strict=True,
    ):
        d = corner - eye
        half = math.tan(camera.fov / 2.0) * (d @ forward)
        px = frame["width"] / 2 + (d @ right) / half * frame["height"] / 2
        py = frame["height"] / 2 - (d @ up) / half * frame["height"] / 2
        assert (px - frame["left"], py - frame["top"]) == pytest.approx((x, y), abs=1e-9)


def test_far_off_axis_the_beams_eye_says_that_it_is_not_exact() -> None:
    assert not beam_view(placed(MACHINE, PROFILE, CAMERA, {**AT, "tra_det": 404.0}))[1][
        "exact"
    ]


@pytest.mark.parametrize("name", builtin_machines())
@pytest.mark.daily(1)
def test_every_component_has_a_look_in_metres(name: str) -> None:
    for part in builtin_machine(name).components:
        content = glb(pieces_of(part))
        scene = trimesh.load(trimesh.util.wrap_as_stream(content), file_type="glb")
        extent = np.asarray(scene.extents)
        # A look may add a housing or feet to the body that collides, no more.
        assert extent.max() * 1000.0 < 1.2 * max(part.size_mm) + 400.0
        assert (extent * 1000.0 > 0.6 * np.asarray(part.size_mm).min()).all()


@pytest.mark.parametrize("name", phantom_names())
def test_samples_look_as_large_as_they_are(name: str) -> None:
    phantom = load_phantom(name)
    look = MeshCache().look(SampleState(name=name, size_mm=phantom.size_mm))
    assert look.exact
    points = np.concatenate([skin.vertices for skin in look.skins]) * 1000.0
    size = points.max(axis=0) - points.min(axis=0)
    np.testing.assert_allclose(size, phantom.size_mm, rtol=0.02, atol=0.05)


@pytest.mark.parametrize("name", phantom_names())
def test_the_close_up_holds_what_turns_and_no_more(name: str) -> None:
    """The cylinder of the close-up against all vertices of the mesh, turned by degrees."""
    look = MeshCache().look(SampleState(name=name))
    vertices = 1000.0 * np.concatenate([s.vertices for s in look.skins]).astype(float)
    reach = np.hypot(vertices[:, 0], vertices[:, 1]).max()
    world = placed(MACHINE, PROFILE, CAMERA, {**AT, "rot_obj": 31.0}, Offsets())
    around = rim(world, look.hulls_m)
    assert around is not None
    across = np.hypot(*(around - world.axis)[:, :2].T)
    assert across.min() * np.cos(np.pi / 12) == pytest.approx(reach, abs=1e-3)
    heights = vertices[:, 2] + world.sample.shift[2]
    assert around[:, 2].min() == pytest.approx(heights.min(), abs=1e-3)
    assert around[:, 2].max() == pytest.approx(heights.max(), abs=1e-3)


def share_of_height(camera: Standpoint, points_m: FloatArray) -> float:
    """Part of a picture's height from the lowest to the highest point."""
    eye = np.array(camera.position)
    ahead = np.array(camera.look_at) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, camera.up)
    upright = np.cross(right / np.linalg.norm(right), ahead)
    heights = (points_m - eye) @ upright / ((points_m - eye) @ ahead)
    return float(np.ptp(heights) / (2.0 * math.tan(0.5 * camera.fov)))


@pytest.mark.parametrize(
    "mag_obj", [150.0, 250.0, 350.0, 450.0, 550.0, 650.0, 750.0, 800.0]
)
def test_only_the_close_up_shows_the_gear_a_fifth_of_a_panes_height(
    mag_obj: float,
) -> None:
    """No camera that holds tube and panel whole shows it so large, from whichever side; the
    close-up, a quarter of a pane's height (`test_viewer_task_controls.py`), does."""
    look = MeshCache().look(SampleState(name="gear"))
    at = {**AT, "tra_tube": 0.0, "ver_tube": 26.29, "mag_obj": mag_obj, "tra_obj": 0.0}
    world = placed(MACHINE, PROFILE, CAMERA, {**at, "mag_det": 1000.0, "tra_det": 25.3})
    around = rim(world, look.hulls_m)
    assert around is not None
    views = presets(world, look.radius_mm, around)
    gear_m = 1e-3 * around
    assert share_of_height(views["sample"].at(1.0), gear_m) > 0.8
    rng = np.random.default_rng(int(mag_obj))
    shares = []
    for _ in range(150):
        yaw, pitch = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, np.radians(60.0))
        level = math.cos(pitch)
        way = (math.sin(yaw) * level, math.cos(yaw) * level, -math.sin(pitch))
        fov = math.radians(rng.uniform(10.0, 75.0))
        whole = replace(views["iso"], ways=(way,), fov=fov)
        shares.append(share_of_height(whole.at(rng.uniform(0.7, 1.8)), gear_m))
    assert max(shares) < 0.2
    assert share_of_height(views["iso"].at(0.73), gear_m) < 0.05


def test_a_material_has_the_colour_of_the_list() -> None:
    cube = trimesh.creation.box((10, 10, 10)).export(file_type="stl")
    for name in (*materials(), "Sn@7.29"):
        sample = SampleState(name="cube", revision=name, material=name)
        looks = MeshCache()
        looks.add(sample, cube)
        own = materials()[name].color if name in materials() else None
        assert looks.look(sample).skins[0].color == (own or OTHER_COLOR), name


def test_a_hole_of_the_sample_is_open_in_the_scene() -> None:
    """No triangle lies above a place in a hole where no voxel above holds anything."""
    voxels = load_phantom("gear").volume(0.5)
    empty = voxels.data < 1e-3 * voxels.data.max()
    above = np.flip(np.logical_and.accumulate(np.flip(empty, 0)), 0)
    outlines = np.stack([ndimage.binary_fill_holes(~layer) for layer in empty])
    inside = ndimage.binary_erosion(above & outlines, np.ones((1, 5, 5)))
    x, y, z = voxels.centers()
    places = [(x[i], y[j], z[k]) for k, j, i in np.argwhere(inside)]
    assert len(places) > 500
    (skin,) = MeshCache().look(SampleState(name="gear")).skins
    corners = 1e3 * skin.vertices[skin.faces]
    for place in places[:: len(places) // 25]:
        apart = corners[..., :2] - place[:2]
        after = np.roll(apart, -1, axis=1)
        turns = apart[..., 0] * after[..., 1] - apart[..., 1] * after[..., 0]
        meets = (turns > 0).all(axis=1) | (turns < 0).all(axis=1)
        assert not (corners[meets][..., 2].mean(axis=1) > place[2]).any(), place


def test_the_name_of_the_sample_stands_above_it() -> None:
    """Against all vertices of the mesh."""
    look = MeshCache().look(SampleState(name="lego"))
    world = placed(MACHINE, PROFILE, CAMERA, {**AT, "rot_obj": 31.0})
    around = rim(world, look.hulls_m)
    assert around is not None
    places = dict(names_of_image(world, float(around[:, 2].max())))
    vertices_m = np.concatenate([s.vertices for s in look.skins]).astype(float)
    top_m = (vertices_m @ world.sample.turn.T)[:, 2].max() + 1e-3 * world.sample.shift[2]
    assert places["sample"][2] == pytest.approx(top_m, abs=1e-5)
    assert places["sample"][:2] == pytest.approx(1e-3 * world.sample.shift[:2])


def test_an_unknown_upload_is_a_box_of_its_size() -> None:
    look = MeshCache().look(SampleState(name="somebody's", size_mm=(10.0, 20.0, 30.0)))
    assert not look.exact
    np.testing.assert_allclose(np.ptp(look.skins[0].vertices, axis=0), [0.01, 0.02, 0.03])


def test_an_upload_looks_as_the_twin_says_once_its_shape_has_come() -> None:
    mesh = trimesh.creation.annulus(3.0, 5.0, 8.0)
    mesh.apply_translation([0.5, 0.0, 0.0])
    sample = SampleState(
        name="ring", revision="1", material="pmma", size_mm=(10.0, 10.0, 8.0)
    )
    wardrobe = MeshCache()
    assert not wardrobe.look(sample).exact
    assert wardrobe.lacks(sample)
    wardrobe.add(sample, mesh.export(file_type="stl"))
    assert not wardrobe.lacks(sample)
    look = wardrobe.look(sample)
    assert look.exact
    points = np.concatenate([s.vertices for s in look.skins]) * 1000.0
    assert points.min(axis=0) == pytest.approx(mesh.bounds[0], abs=1e-3)
    assert points.max(axis=0) == pytest.approx(mesh.bounds[1], abs=1e-3)
    assert wardrobe.lacks(sample.model_copy(update={"revision": "2"})), "another content"


class Twin:
    """Answers `sample.mesh` from some bytes; `after` parts the sample is another one."""

    def __init__(self, content: bytes, after: int = 99, name: str = "ring") -> None:
        self.content, self.left, self.name = content, after, name

    async def ask(self, method: str, params: Mapping[str, Any]) -> object:
        assert method == "sample.mesh"
        self.left -= 1
        start, count = params["start"], 1000
        return {
            "name": self.name, "revision": "1" if self.left >= 0 else "2",
            "total": len(self.content), "start": start,
            "data": self.content[start : start + count],
        }  # fmt: skip


def test_a_shape_comes_in_parts_or_not_at_all() -> None:
    sample = SampleState(name="ring", revision="1")
    content = bytes(range(256)) * 20
    assert asyncio.run(fetch(Twin(content).ask, sample)) == content
    assert asyncio.run(fetch(Twin(content, after=3).ask, sample)) is None
    assert asyncio.run(fetch(Twin(content, name="other").ask, sample)) is None
    assert asyncio.run(fetch(Twin(b"").ask, sample)) is None

    async def refuse(method: str, params: Mapping[str, Any]) -> object:
        raise RpcError(-32601, "no such method")

    assert asyncio.run(fetch(refuse, sample)) is None


def test_packed_pixels_come_out_within_half_a_step() -> None:
    pixels = np.random.default_rng(2).uniform(-0.1, 2.5, (31, 41)).astype(np.float32)
    image = ShownImage(pixels, "line_integral", (0.0,) * 12, 1.5, 7)
    head, values = _unpack(
        packed(image, coarse=False, beads=[(1.5, 2.5)], facts={"x": 1})
    )
    assert np.abs(values - pixels).max() <= 0.51 * head["scale"]
    assert (head["seq"], head["beads"], head["x"]) == (7, [[1.5, 2.5]], 1)
    head, values = _unpack(packed(image, coarse=True, beads=[], facts={}))
    assert head["shape"] == [15, 20]
    by_hand = [[pixels[2 * r : 2 * r + 2, 2 * c : 2 * c + 2].mean() for c in range(20)]
               for r in range(15)]  # fmt: skip
    np.testing.assert_allclose(binned_mean(pixels, 2), by_hand, atol=1e-6)


def test_a_coarse_image_is_near_and_small() -> None:
    y, x = np.mgrid[:760, :956] / 956.0
    pixels = np.exp(-((x - 0.5) ** 2 + (y - 0.4) ** 2) * 9.0) + 0.3 * (
        np.hypot(x - 0.6, y) < 0.2
    )
    image = ShownImage(pixels.astype(np.float32), "line_integral", (0.0,) * 12, 1.5, 7)
    content = packed(image, coarse=True, beads=[], facts={})
    _, values = _unpack(content)
    error = values - binned_mean(pixels.astype(np.float32), 2)
    assert np.sqrt((error**2).mean()) < 0.005 * pixels.max()
    assert len(content) < 50_000
    assert len(packed(image, coarse=False, beads=[], facts={})) < 2 * pixels.size


def test_counts_are_exact_and_windows_hold() -> None:
    counts = np.arange(12, dtype=np.uint16).reshape(3, 4) * 1000
    image = ShownImage(counts, "counts", (0.0,) * 12, 0.0, 1)
    _, values = _unpack(packed(image, coarse=False, beads=[], facts={}))
    np.testing.assert_array_equal(values, counts)
    low, high = window_of(image)
    assert low < high
    rgb = grey(image, (0.0, 11000.0))
    assert rgb.shape == (3, 4, 3)
    assert (rgb[0, 0, 0], rgb[2, 3, 0]) == (0, 255)


def test_beads_do_not_set_the_window() -> None:
    """Plastic walls were nearly black beside steel beads a hundred times as dense."""
    rng = np.random.default_rng(7)
    pixels = rng.normal(0.0, 0.01, (400, 400)).astype(np.float32)
    pixels[100:300, 100:300] += 0.4  # a quarter of the image
    for row, column in rng.integers(105, 290, (12, 2)):
        pixels[row : row + 8, column : column + 8] += 12.0
    image = ShownImage(pixels, "line_integral", (0.0,) * 12, 0.0, 1)
    low, high = window_of(image)
    assert low <= 0.0
    assert (0.4 - low) / (high - low) > 0.5, "walls are brighter than the middle grey"
    only = np.zeros((400, 400), np.float32)
    only[200:216, 200:216] = 3.0  # a small sample is seen, too
    low, high = window_of(ShownImage(only, "line_integral", (0.0,) * 12, 0.0, 1))
    assert high == 3.0


def _unpack(content: bytes) -> tuple[dict[str, Any], np.ndarray]:
    assert content[:4] == b"FXI2"
    (size,) = struct.unpack_from("<I", content, 4)
    head, body = json.loads(content[8 : 8 + size]), content[8 + size :]
    if head["code"] == "jpeg":
        raw = np.asarray(Image.open(io.BytesIO(body)), dtype=np.float64) * 257.0
        assert list(raw.shape) == head["shape"]
    else:
        low, high = np.frombuffer(zlib.decompress(body), np.uint8).reshape(
            2, *head["shape"]
        )
        raw = np.cumsum(low + 256 * high.astype(np.int64), axis=1) % 65536
    return head, head["low"] + head["scale"] * raw


def test_the_margin_is_the_body_and_what_is_within_the_clearance_of_it() -> None:
    """Box: faces moved out by the margin, corners round. Cylinder: the same about its axis."""
    low, high = np.array([-5.0, -3.0, 1.0]), np.array([7.0, 4.0, 2.0])
    corners = np.array(
        [[x, y, z] for x in (-5, 7) for y in (-3, 4) for z in (1, 2)], dtype=float
    )
    shell = grown(bare(hull(corners)), 2.5)
    np.testing.assert_allclose(shell.bounds, [low - 2.5, high + 2.5], atol=1e-9)
    points = np.asarray(shell.vertices)
    outside = np.linalg.norm(points - np.clip(points, low, high), axis=1)
    np.testing.assert_allclose(outside, 2.5, atol=1e-9)
    column = bare(UprightCylinder((1.0, 2.0, 3.0), 10.0, 30.0))
    points = np.asarray(grown(column, 2.0).vertices) - [1.0, 2.0, 3.0]
    radial = np.maximum(np.hypot(points[:, 0], points[:, 1]) - 10.0, 0.0)
    outside = np.hypot(radial, np.maximum(np.abs(points[:, 2]) - 15.0, 0.0))
    assert outside.max() < 2.0 + 1e-9
    assert outside.min() > 1.9


@pytest.mark.slow
def test_the_scene_draws_the_machines_own_margin() -> None:
    """Bare bodies and bodies grown by the clearance that the guard keeps are two layers."""
    with redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0)
    try:
        for margin in (0.0, 1.0, 40.0):
            machine = MACHINE.model_copy(update={"safety_margin_mm": margin})
            scene = LabScene(server, machine, PROFILE)
            assert set(scene._margins) == (set(scene._hulls) if margin else set())
            for name, shell in scene._margins.items():
                bare = np.asarray(scene._hulls[name].vertices) * 1000.0
                grown = np.asarray(shell.vertices) * 1000.0
                np.testing.assert_allclose(
                    grown.min(axis=0), bare.min(axis=0) - margin, atol=1e-3
                )
                np.testing.assert_allclose(
                    grown.max(axis=0), bare.max(axis=0) + margin, atol=1e-3
                )
        assert not any(
            h.visible for h in (*scene._margins.values(), *scene._hulls.values())
        )

        def seen(kind: str, shown: Shown, near: tuple[str, ...] = ()) -> set[str]:
            nodes = scene.nodes(shown, near)
            return {
                n.split("/")[2] for n in nodes if n.endswith(kind) and nodes[n]["visible"]
            }

        margins = Shown().changed(margin=True)
        assert seen("/margin", margins) == set(scene._margins)
        assert not seen("/body", margins)
        for kind in ("/margin", "/body"):
            near = ("xray_source", "sample_holder")
            assert seen(kind, Shown(), near) == set(near)
        triangle = np.array([[0, 1, 2]], dtype=np.int32)
        skin = Skin("ball", np.eye(3, dtype=np.float32), triangle, (200, 90, 80), False)
        scene.wear(SampleLook((skin,), np.empty((0, 3))))
        # What stands within its volume is told to each page, not built so.
        assert scene.nodes(Shown(), within=True) != scene.plain
        assert scene.nodes(Shown()) == scene.plain
        named = Shown().visible(scene._bodies)
        absent = {node for node in named if server.scene.get_handle_by_name(node) is None}
        assert absent == {n for n in named if n.endswith("/margin") and not margin}
        for layer in LAYERS:  # each is a choice of nodes of its own, or of names
            other = Shown().changed(**{layer.name: not layer.shown})
            assert (layer.name in other) is not layer.shown
            assert (scene.nodes(other) != scene.plain) is (layer.name != "names")
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def test_a_handle_is_at_its_stage_when_the_drag_is_over() -> None:
    """Also if its last update comes after its end, and no state follows."""
    aims: list[Mapping[str, float]] = []
    with redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0)
    try:
        gizmos = Gizmos(
            server, MACHINE, lambda client, targets: aims.append(dict(targets))
        )
        world = placed(MACHINE, PROFILE, CAMERA, AT)
        axes = {
            n: SimpleNamespace(position=AT.get(n, a.home))
            for n, a in MACHINE.axes.items()
        }
        state = cast(State, SimpleNamespace(axes=axes))
        gizmos.update(state, world)
        handle = next(h for h in gizmos._handles if h.stage == "detector")
        here = np.array(handle.control.position)

        async def say(phase: str, shift: float) -> None:
            handle.control.position = tuple(here + [0.0, shift, 0.0])
            for follow in handle.control._impl_aux.update_cb:
                await follow(SimpleNamespace(phase=phase, client_id=1))

        for phase, shift in (
            ("start", 0.0),
            ("update", -0.01),
            ("end", -0.02),
            ("update", -0.02),
        ):
            asyncio.run(say(phase, shift))
        assert [a["mag_det"] for a in aims] == pytest.approx([1010.0, 1000.0])
        np.testing.assert_allclose(handle.control.position, here)
        turntable = next(h for h in gizmos._handles if h.stage == "object")
        turntable.control.wxyz = (0.0, 0.0, 0.0, 1.0)
        for follow in turntable.control._impl_aux.update_cb:
            asyncio.run(follow(SimpleNamespace(phase="start", client_id=1)))
            np.testing.assert_allclose(turntable.control.wxyz, (0.0, 0.0, 0.0, 1.0))
            asyncio.run(follow(SimpleNamespace(phase="end", client_id=1)))
        np.testing.assert_allclose(turntable.control.wxyz, (1.0, 0.0, 0.0, 0.0))
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def test_orbit_of_a_turn_is_a_circle_about_the_axis() -> None:
    from flexdt.twin.script.compose import compose_script
    from flexdt.twin.script.scan_request import ScanRequest

    text = compose_script(ScanRequest(frames=90), MACHINE, PROFILE)
    planned = plan_text(text, MACHINE, PROFILE, None)
    doc = document(planned)
    assert doc["frames"] == 90
    assert sum(kind == "projection" for _, kind in doc["images"]) == 90
    assert "rot_obj" in doc["curves"]
    state = _state()
    points = source_path(projection_positions(planned), MACHINE, PROFILE, state)
    radius = np.hypot(points[:, 0], points[:, 1])
    np.testing.assert_allclose(radius, 600.0, atol=0.01)


def _state() -> Any:
    from flexdt.protocol.state_model import State
    from flexdt.server.twin.state_views import camera_view

    return State.model_construct(
        axes={},
        camera=camera_view(CAMERA, MACHINE),
        correction=None,
        sample=SampleState(name=None),
    )


def test_the_beam_in_the_air_has_the_transmission_of_the_pixels_behind_it() -> None:
    """Where a place's ray ends on the panel is found here, from the rows of the geometry
    alone."""
    rng = np.random.default_rng(4)
    for _ in range(4):
        at = {**AT, "ver_tube": rng.uniform(20, 80), "tra_det": rng.uniform(0, 60)}
        world = placed(MACHINE, PROFILE, CAMERA, at, CORRECTION)
        rows, cols = world.shape
        lines = rng.uniform(0.0, 3.0, (rows, cols))
        source, middle, u, v = world.view.rows[0].reshape(4, 3)
        for k, plane in enumerate(fans(world, lines, 25.0)):
            upright, behind, seen = k < 2, k % 2 == 1, 0
            size, other = (rows, cols) if upright else (cols, rows)
            for r, c in zip(
                rng.integers(0, 160, 200), rng.integers(20, 192, 200), strict=True
            ):
                place = plane.center + plane.axes[:, :2] @ (
                    np.array(plane.size) * [(c + 0.5) / 192 - 0.5, (r + 0.5) / 160 - 0.5]
                )
                depth = (place - world.sample.shift) @ plane.axes[:, 0]
                assert depth > 25.0 if behind else depth < -25.0
                a, b, _ = np.linalg.solve(
                    np.stack([u, v, source - place], axis=1), source - middle
                )
                along, across = (b + rows / 2, a + cols / 2)[:: 1 if upright else -1]
                assert across == pytest.approx(other / 2, abs=1e-6)
                if abs(along % 1.0 - 0.5) > 0.49:
                    continue  # between two pixels
                light = float(0.0 < along < size)
                if light and behind:
                    pixel = (
                        (int(along), cols // 2) if upright else (rows // 2, int(along))
                    )
                    light = math.exp(-lines[pixel])
                assert plane.rgba[r, c, 3] == pytest.approx(MOST * light, abs=1.0)
                seen += light > 0.0
            assert seen > 60


def test_the_beam_is_never_a_wall() -> None:
    """Along looks from anywhere to anywhere in it, half of what lies behind is still seen."""
    rng = np.random.default_rng(7)
    world = placed(MACHINE, PROFILE, CAMERA, AT)
    sheets = fans(world, np.zeros(world.shape), 25.0)
    most = 0.0
    for _ in range(3000):
        part = rng.uniform(0.02, 0.98)
        target = world.source + part * (
            rng.dirichlet(np.ones(4)) @ world.corners - world.source
        )
        way = rng.normal(size=3)
        eye, kept = target - way * rng.uniform(5.0, 800.0) / np.linalg.norm(way), 1.0
        for sheet in sheets:
            a, b, _ = np.linalg.solve(
                np.column_stack([sheet.axes[:, :2], eye - target]), eye - sheet.center
            ) / (*sheet.size, 1.0)
            row, column = int((b + 0.5) * 160 // 1), int((a + 0.5) * 192 // 1)
            if 0 <= row < 160 and 0 <= column < 192:
                kept *= 1.0 - sheet.rgba[row, column, 3] / 255.0
        most = max(most, 1.0 - kept)
    assert 0.3 < most < 0.5


def test_what_is_drawn_of_axis_and_beam_follows_stage_and_tube() -> None:
    with redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host="127.0.0.1", port=0)
    try:
        scene = LabScene(server, MACHINE, PROFILE)
        for sod, on, ready in (
            (640.0, False, True), (500.0, False, True), (500.0, True, False),
            (500.0, True, True), (400.0, True, True),
        ):  # fmt: skip
            world = placed(MACHINE, PROFILE, CAMERA, {**AT, "mag_obj": sod})
            lines = np.full(world.shape, 0.5)
            scene.show_image(np.zeros((8, 8, 3), np.uint8), lines, world)
            tube = SimpleNamespace(on=on, ready=ready)
            scene._show_beam(cast(State, SimpleNamespace(tube=tube)), world)
            np.testing.assert_allclose(
                scene._axis.position, world.axis / 1000.0, atol=1e-9
            )
            shade = server.scene.get_handle_by_name("/beam/shade1")
            assert shade is not None
            assert shade.visible == (on and ready)
            if shade.visible:  # the light begins behind the sample
                begins = shade.position[1] - shade.render_width / 2
                assert begins == pytest.approx(
                    (world.sample.shift[1] + 1.0) / 1000.0, abs=0.002
                )
        # Without an image of there its shadow would begin in the air.
        gone = placed(MACHINE, PROFILE, CAMERA, {**AT, "mag_obj": 300.0})
        scene._show_beam(cast(State, SimpleNamespace(tube=tube)), gone)
        assert not shade.visible
        scene.show_image(np.zeros((8, 8, 3), np.uint8), np.full(gone.shape, 0.5), gone)
        assert shade.visible
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()
