"""What is drawn beside the machine and the sample: the beam, handles, names, and a plan's ghost.

The beam's light in the air is whole before the sample, and behind it as much as came through. Two
planes through the focal spot are drawn, those of the image's middle column and row, and the cone's
sides, faintly. A place behind the sample has the transmission of the pixel at which its ray ends,
so the shadow stands in the air. A look through all of it passes two sides and one sheet of each
plane, and keeps half of what lies behind. The ball around the sample is left out: where in it light
is lost no radiograph says, and a plane through a transparent sample would hide half of it. Units:
mm, m for viser.

Handles drag stages along the directions in which their motors move. A drag becomes motor targets,
clamped to their limits. The twin plans and sweeps them as usual, and the stage follows at its own
speed. A drag counts as a command of the page whose frame it is in.

No name covers another: where they stand is a pure function of boxes in pixels. A name's box goes to
the free place nearest to the point that it names, and a leader joins the two. The names then share
these places so that their leaders are shortest together: none crosses another. `NameTags` draws
them in the views of browsers, whose cameras decide where the boxes are.

A scrubbed plan is a blue ghost of the machine and the focal spot's path, drawn for the viser
clients of one page alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import viser
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from flexdt.clients.viewer.scenes.painted_meshes import bare, plain
from flexdt.clients.viewer.scenes.world import MM, World, motors, quaternion
from flexdt.protocol.state_model import State
from flexdt.twin.collision.collision_scene import CollisionScene
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Machine

SHAPE: Final = (160, 192)
"""Rows and columns of each plane's picture."""
LIGHT: Final = (255, 176, 32)
MOST: Final = 56
"""Opacity of the whole beam in a plane, of 255."""
HULL: Final = 0.08
"""Opacity of the cone's sides."""
SIDES: Final = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4]], dtype=np.uint32)


@dataclass(frozen=True, eq=False)
class BeamPlane:
    """A rectangle with a fan of rays in it.

    Attributes:
        rgba: (rows, cols, 4); columns go along `axes[:, 0]`, rows along `axes[:, 1]`.
        size: width and height [mm].
        center: (3,) [mm].
        axes: (3, 3) its directions.
    """

    rgba: npt.NDArray[np.uint8]
    size: tuple[float, float]
    center: FloatArray
    axes: FloatArray


def fans(world: World, lines: npt.NDArray[np.generic], radius_mm: float) -> list[BeamPlane]:
    """Planes of the middle column before and behind the sample, and of the middle row.

    Args:
        world: of the image's moment.
        lines: line integrals (rows, cols).
        radius_mm: of the ball around the sample.
    """
    rows, cols = lines.shape
    through = np.exp(-np.asarray(lines, dtype=np.float64))
    height, width = world.shape
    planes = []
    for across, behind in (
        (world.v * height, through[:, cols // 2]),
        (world.u * width, through[rows // 2]),
    ):
        for side, light in ((-1.0, np.ones(1)), (1.0, behind)):
            planes.append(_fan(world, across, light, side, radius_mm))
    return planes


def _fan(
    world: World, across: FloatArray, through: FloatArray, side: float, radius: float
) -> BeamPlane:
    """Rays to a line of pixels through the image's middle, which `across` leads along, before the
    sample (`side` -1) or behind it (1)."""
    along = across / np.linalg.norm(across)
    middle = world.detector - world.source
    ahead = middle - (middle @ along) * along
    length = float(np.linalg.norm(ahead))
    ahead = ahead / length
    # In the plane: (distance from the focal spot, along the line of pixels).
    cut = float((world.sample.shift - world.source) @ ahead) + side * radius
    near, far = (0.0, max(cut, 1.0)) if side < 0.0 else (min(max(cut, 0.0), length - 1.0), length)
    half = 0.5 * float(np.linalg.norm(across))
    first, last = middle @ along - half, middle @ along + half
    low, high = min(first * near, first * far) / length, max(last * near, last * far) / length
    rows, cols = SHAPE
    a = near + (np.arange(cols) + 0.5) * (far - near) / cols
    b = low + (np.arange(rows)[:, None] + 0.5) * (high - low) / rows
    part = (b * length / a - first) / (last - first)
    pixel = np.clip(part * len(through), 0, len(through) - 1).astype(int)
    rgba = np.empty((*SHAPE, 4), dtype=np.uint8)
    rgba[..., :3] = LIGHT
    rgba[..., 3] = np.where((part >= 0.0) & (part < 1.0), MOST * through[pixel], 0.0).clip(0, 255)
    center = world.source + 0.5 * (near + far) * ahead + 0.5 * (low + high) * along
    axes = np.stack([ahead, along, np.cross(ahead, along)], axis=1)
    return BeamPlane(rgba, (far - near, float(high - low)), center, axes)


class BeamShade:
    """The planes in a scene."""

    def __init__(self, scene: viser.SceneApi) -> None:
        plain: Any = {"visible": False, "cast_shadow": False, "receive_shadow": False}
        self._planes: list[Any] = [
            scene.add_image(
                f"/beam/shade{name}", np.zeros((2, 2, 4), dtype=np.uint8), 0.01, 0.01, **plain
            )
            for name in range(4)
        ]
        self._hull = scene.add_mesh_simple(
            "/beam/cone", np.zeros((5, 3), np.float32), SIDES, color=LIGHT, opacity=HULL,
            side="double", **plain,
        )  # fmt: skip
        self._newest: tuple[World, npt.NDArray[np.generic], float] | None = None
        self._lit = False

    def show(self, world: World, lines: npt.NDArray[np.generic], radius_mm: float) -> None:
        """Take the newest image (see `fans`)."""
        self._newest = world, lines, max(radius_mm, 1.0)
        self._draw()

    def light(self, on: bool) -> None:
        """Show the beam or not."""
        if on != self._lit:
            self._lit = on
            for handle in (*self._planes, self._hull):
                handle.visible = on
            self._draw()

    def _draw(self) -> None:
        if not self._lit or self._newest is None:
            return
        world = self._newest[0]
        self._hull.vertices = (np.vstack([world.source, world.corners]) * MM).astype(np.float32)
        for handle, plane in zip(self._planes, fans(*self._newest), strict=True):
            handle.image = plane.rgba
            handle.render_width, handle.render_height = (side * MM for side in plane.size)
            handle.position = tuple((plane.center * MM).tolist())
            handle.wxyz = quaternion(plane.axes)


COORDINATES: Final = ("x", "y", "z")
SIZE_M: Final = 0.16
STAGES: Final = ("source", "object", "detector")

Drag = Callable[[int | None, Mapping[str, float]], None]
"""Called with viser's client and the targets axis -> value."""


@dataclass
class _Handle:
    stage: str
    control: Any
    dragging: bool = False
    begun: FloatArray = field(default_factory=lambda: np.zeros(3))
    start: dict[str, float] = field(default_factory=dict)


class Gizmos:
    """One handle a stage, hidden until wanted.

    Args:
        server: to draw in.
        machine: whose stages.
        drag: what to do with a drag.
    """

    def __init__(self, server: viser.ViserServer, machine: Machine, drag: Drag) -> None:
        self._machine, self._drag = machine, drag
        self._positions: dict[str, float] = {}
        self._at: dict[str, tuple[float, ...]] = {}
        self._handles = [self._add(server, stage) for stage in STAGES]

    @property
    def controls(self) -> list[Any]:
        """Their nodes."""
        return [handle.control for handle in self._handles]

    def update(self, state: State, world: World) -> None:
        """Move the handles with their stages, except the one being dragged."""
        self._positions = motors(self._machine, state)
        at = {"source": world.source, "object": world.axis, "detector": world.detector}
        self._at = {stage: tuple((point * MM).tolist()) for stage, point in at.items()}
        for handle in self._handles:
            self._rest(handle)

    def _rest(self, handle: _Handle) -> None:
        """Put a handle back to its stage unless it is being dragged."""
        at = self._at.get(handle.stage)
        if handle.dragging or at is None:
            return
        if tuple(handle.control.position) != at:
            handle.control.position = at
        if handle.stage == "object":
            handle.control.wxyz = (1.0, 0.0, 0.0, 0.0)

    def _add(self, server: viser.ViserServer, stage: str) -> _Handle:
        active = [bool(self._machine.geometry.get(f"{stage}_{c}")) for c in COORDINATES]
        turns = stage == "object" and bool(self._machine.geometry.get("angle"))
        control = server.scene.add_transform_controls(
            f"/gizmos/{stage}", scale=SIZE_M, active_axes=(active[0], active[1], active[2]),
            disable_sliders=True, disable_rotations=not turns, depth_test=False, visible=False,
            line_width=3.0,
        )  # fmt: skip
        handle = _Handle(stage, control)

        # Plain functions would run in threads, in any order.
        async def follow(event: Any) -> None:
            match event.phase:
                case "start":
                    self._begin(handle)
                case "end":
                    handle.dragging = False
                case _:
                    self._moved(handle, event)
            self._rest(
                handle
            )  # no state may follow: the stage is there already, or the move was rejected

        control.on_update(follow)
        return handle

    def _begin(self, handle: _Handle) -> None:
        handle.dragging = True
        handle.begun = np.array(handle.control.position, dtype=float)
        handle.start = dict(self._positions)

    def _moved(self, handle: _Handle, event: Any) -> None:
        # The last update of a drag may come after its end, and counts from where the drag began.
        if not handle.start:
            return
        shift = (np.array(handle.control.position, dtype=float) - handle.begun) / MM
        targets: dict[str, float] = {}
        for i, coordinate in enumerate(COORDINATES):
            self._aim(targets, handle, f"{handle.stage}_{coordinate}", float(shift[i]))
        if handle.stage == "object":
            w, _, _, z = np.array(handle.control.wxyz, dtype=float)
            turned = math.degrees(2.0 * math.atan2(z, w))
            turned = (turned + 180.0) % 360.0 - 180.0
            self._aim(targets, handle, "angle", -turned)  # growing angles turn clockwise
        if targets:
            self._drag(event.client_id, targets)

    def _aim(
        self, targets: dict[str, float], handle: _Handle, quantity: str, change: float
    ) -> None:
        factors = self._machine.geometry.get(quantity, {})
        if len(factors) != 1 or abs(change) < 1e-3:
            return
        ((motor, factor),) = factors.items()
        axis = self._machine.axes[motor]
        target = handle.start.get(motor, axis.home) + change / factor
        targets[motor] = min(axis.upper, max(axis.lower, target))


WAYS, RINGS_PX = 24, (26.0, 44.0, 66.0, 92.0, 124.0, 164.0, 220.0, 300.0, 420.0)
"""Directions and distances in which a place is looked for, the near ones first."""
GAP_PX = 5.0
"""Between boxes, and to the picture's edge."""


def laid_out(anchors: FloatArray, sizes: FloatArray, area: tuple[float, float]) -> FloatArray:
    """Top left corners (n, 2) of the names' boxes; NaN where a name has no room.

    Args:
        anchors: (n, 2) what is named [px]; NaN or outside the picture: no name.
        sizes: (n, 2) widths and heights of the boxes [px].
        area: width and height of the picture [px].
    """
    turns = np.arange(WAYS) * 2.0 * math.pi / WAYS
    ways = np.stack([np.cos(turns), -np.sin(turns)], axis=1)
    rings = np.repeat(np.arange(len(RINGS_PX)), WAYS)
    preference = rings + 0.5 * (1.0 + np.tile(ways[:, 1], len(RINGS_PX)))
    size = sizes.max(axis=0, initial=0.0)  # of every place, so that any name has room in it
    places, named = np.zeros((0, 2)), np.zeros(0, dtype=int)
    for k in np.argsort(anchors[:, 1]):
        if not ((anchors[k] >= 0.0) & (anchors[k] <= area)).all():
            continue
        middles = np.concatenate([anchors[k] + (r + 0.5 * size) * ways for r in RINGS_PX])
        inside = (np.abs(middles - 0.5 * np.array(area)) <= 0.5 * (area - size) - GAP_PX).all(1)
        apart = (np.abs(middles[:, None] - places) >= size + GAP_PX).any(axis=2).all(axis=1)
        covered = (np.abs(middles[:, None] - anchors) < 0.5 * size + GAP_PX).all(axis=2).sum(axis=1)
        cost = np.where(inside & apart, preference + 4.0 * covered, np.inf)
        if np.isfinite(cost).any():
            places, named = np.vstack([places, middles[np.argmin(cost)]]), np.append(named, k)
    # Where two leaders crossed, their names could change places and both would be shorter.
    lengths = np.linalg.norm(places[:, None] - anchors[named], axis=2)
    place, name = linear_sum_assignment(lengths)
    out = np.full((len(anchors), 2), np.nan)
    out[named] = places[place[np.argsort(name)]] - 0.5 * sizes[named]
    return out


def leader_end(anchor: FloatArray, corner: FloatArray, size: FloatArray) -> FloatArray:
    """The point of a box that is nearest to what it names, (2,)."""
    return np.clip(anchor, corner, corner + size)


LETTER_PX, LINE_PX, PAD_PX = 6.6, 17.0, 10.0
"""Widest letter, height and margin of viser's labels on a screen."""
LEAST_PX = 260
"""A view that is narrower has no names."""
LEADER = (40, 150, 235)
Name = tuple[str, FloatArray]
"""Words, and the point (3,) that they name [m, world]."""


def names_of_image(world: World) -> list[Name]:
    """Source, sample and detector."""
    image = world.detector + world.u * (0.25 * world.shape[1]) - world.normal
    named = ("X-ray source", world.source), ("sample", world.sample.shift), ("detector", image)
    return [(words, at * MM) for words, at in named]


def names_of_parts(machine: Machine, poses: Mapping[str, tuple[float, ...]]) -> list[Name]:
    """Parts that move or have a role, at a corner, from their poses (w, x, y, z, place [m])."""
    out = []
    for part in machine.components:
        if (pose := poses.get(part.name)) is not None and (part.axis is not None or part.role):
            (x, _, z), middle = part.size_mm, np.array(part.center_mm)
            turn = Rotation.from_quat(pose[:4], scalar_first=True)
            at = turn.apply((middle + [x / 2, 0.0, z / 2]) * MM) + pose[4:]
            out.append((part.name.replace("_", " "), np.asarray(at)))
    return out


class NameTags:
    """Names in the scene of each client, as its own camera sees them."""

    def __init__(self) -> None:
        self._drawn: dict[int, object] = {}

    def draw(self, client: viser.ClientHandle, names: Sequence[Name]) -> None:
        """Put the names where they have room now; nothing is sent while nothing has moved."""
        camera = client.camera
        area = float(camera.image_width), float(camera.image_height)
        names = names if area[0] >= LEAST_PX else ()
        eye, ahead = camera.position, camera.look_at - camera.position
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, camera.up_direction)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(ahead, right), ahead])
        key = [area, camera.fov, eye.round(4), axes.round(4), [(w, p.round(4)) for w, p in names]]
        if self._drawn.get(client.client_id) == (seen := str(key)):
            return
        self._drawn[client.client_id] = seen
        points = np.array([point for _, point in names]).reshape(-1, 3)
        x, y, depth = axes @ (points - eye).T
        depth[depth < 0.02] = np.nan
        scale = 0.5 * area[1] / math.tan(0.5 * camera.fov)
        middle = 0.5 * np.array(area)
        anchors = middle + scale * np.stack([x, y], axis=1) / depth[:, None]
        sizes = np.array([[PAD_PX + LETTER_PX * len(words), LINE_PX] for words, _ in names])
        sizes = sizes.reshape(-1, 2)
        corners = laid_out(anchors, sizes, area)
        there = np.flatnonzero(~np.isnan(corners[:, 0]))

        def in_space(places: FloatArray, k: int) -> FloatArray:
            flat = np.append((places - middle) * depth[k] / scale, depth[k])
            return np.asarray(eye + flat @ axes)

        with client.atomic():
            for old in range(len(there), 64):
                handle: Any = client.scene.get_handle_by_name(f"/names/{old}")
                if handle is None:
                    break
                handle.remove()
            lines = []
            for n, k in enumerate(there.tolist()):
                place = in_space(corners[k] + 0.5 * sizes[k], k)
                end = leader_end(anchors[k], corners[k], sizes[k])
                lines.append([in_space(end, k), points[k]])
                client.scene.add_label(
                    f"/names/{n}", names[k][0], position=place, anchor="center-center"
                )
            client.scene.add_line_segments(
                "/names/leaders", np.array(lines or np.zeros((1, 2, 3)), np.float32), LEADER,
                thickness=2.0, thickness_units="screen",
            )  # fmt: skip


SCREEN: Any = {"thickness_units": "screen"}
"""Lines have a width in pixels."""
GHOST = (60, 130, 255)
PATH = (90, 120, 255)
HOME = "/object/plan"
"""The node that holds the paths in all scenes: one switch for all of them."""
ORBIT = f"{HOME}/orbit"
RAY, RAY_COLOR = "/ray", (255, 60, 160)


class PlanDrawing:
    """Ghosts and paths in clients' own scenes.

    Args:
        machine: whose parts.
        collision: its collision bodies.
    """

    def __init__(self, machine: Machine, collision: CollisionScene) -> None:
        self._collision = collision
        moving = {part.name for part in machine.components if machine.chain(part)}
        self._moving = [body for body in collision.bodies if body.name in moving]

    def ghost(self, clients: Sequence[viser.ClientHandle], positions: Mapping[str, float]) -> None:
        """Show some clients where the moving parts would be for motor positions [mm, deg]."""
        q = self._collision.vector(positions)
        for client in clients:
            with client.atomic():
                if client.scene.get_handle_by_name("/ghost") is None:
                    client.scene.add_frame("/ghost", show_axes=False)
                for body in self._moving:
                    name = f"/ghost/{body.name}"
                    turn = quaternion(body.rotation(float(q @ body.turns)))
                    at = tuple(((body.origin + q @ body.slides) * MM).tolist())
                    handle = client.scene.get_handle_by_name(name)
                    if handle is None:
                        vertices, faces = plain(bare(body.solid))
                        client.scene.add_mesh_simple(
                            name, vertices, faces, color=GHOST, opacity=0.28,
                            side="double", cast_shadow=False, receive_shadow=False,
                            wxyz=turn, position=at,
                        )  # fmt: skip
                    else:
                        handle.wxyz, handle.position = turn, at

    def unghost(self, clients: Iterable[viser.ClientHandle]) -> None:
        """Show them no longer."""
        _remove(clients, "/ghost")

    def orbit(self, clients: Sequence[viser.ClientHandle], points: FloatArray | None) -> None:
        """Show some clients the focal spot's path as the sample sees it; None: no longer.

        Args:
            clients: that see it.
            points: (n, 3) [mm], object frame.
        """
        steps = None if points is None else np.stack([points[:-1], points[1:]], axis=1)
        _draw_lines(clients, ORBIT, steps, PATH, 1.5)

    def ray(self, clients: Sequence[viser.ClientHandle], ends: FloatArray | None) -> None:
        """Show some clients a ray, (2, 3) [mm, world]; None: no longer."""
        _draw_lines(clients, RAY, None if ends is None else ends[None], RAY_COLOR, 3.0)


def _draw_lines(
    clients: Sequence[viser.ClientHandle], name: str, lines: FloatArray | None,
    color: tuple[int, int, int], px: float,
) -> None:  # fmt: skip
    """Lines (n, 2, 3) [mm] in place of those that clients had under this name; None for none."""
    _remove(clients, name)
    if lines is not None and len(lines):
        for client in clients:
            client.scene.add_line_segments(name, lines * MM, color, thickness=px, **SCREEN)


def _remove(clients: Iterable[viser.ClientHandle], name: str) -> None:
    for client in clients:
        handle = client.scene.get_handle_by_name(name)
        if handle is not None:
            handle.remove()
