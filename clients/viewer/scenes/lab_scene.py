"""The scanner in viser: built once, then moved by every state; meters, one frame for each part.

viser sends only what changes. Setters may be called from any one thread at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from itertools import product
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import viser
from scipy.spatial.transform import Rotation

from flexdt.clients.viewer.scenes import contact_shadows
from flexdt.clients.viewer.scenes.beam_planes import LIGHT, BeamShade
from flexdt.clients.viewer.scenes.drag_handles import Drag, Gizmos
from flexdt.clients.viewer.scenes.lamps import light_plainly
from flexdt.clients.viewer.scenes.layers import Nodes, Shown
from flexdt.clients.viewer.scenes.meshes.cabinet import (
    LAMP,
    cabinet,
    ground_of,
    room_of,
)
from flexdt.clients.viewer.scenes.meshes.collision_bodies import bare, grown
from flexdt.clients.viewer.scenes.meshes.painted_meshes import cylinder, glb, plain
from flexdt.clients.viewer.scenes.meshes.paints import RUBBER
from flexdt.clients.viewer.scenes.meshes.part_looks import pieces_of
from flexdt.clients.viewer.scenes.name_tags import Name, names_of_image, names_of_parts
from flexdt.clients.viewer.scenes.plan_drawing import HOME, SCREEN, PlanDrawing
from flexdt.clients.viewer.scenes.sample_looks import SampleLook
from flexdt.clients.viewer.scenes.still import (
    Shape,
    cone,
    cut,
    image_on,
    placed,
    shape_of,
)
from flexdt.clients.viewer.scenes.views import rim
from flexdt.clients.viewer.scenes.world import MM, World, motors, quaternion
from flexdt.protocol.state_model import State
from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Component, Machine, Profile

LAMP_M: Final = 0.045
"""Radius of the cabinet's lamp in the FleX-ray."""
CONE_OPACITY: Final = 0.2
"""Opacity of the full beam in a picture that needs no browser."""
BEAM_OFF: Final = (120, 140, 165)
FADED_OPACITY: Final = 0.12
"""Largest opacity of a sample whose volume is drawn within it."""
PIERCING: Final = (90, 176, 255)
"""Colour of the piercing point's cross, as in the page's radiograph."""
FLOOR: Final = (140, 150, 165)
RANGE: Final = (240, 150, 40)
RED: Final = (230, 50, 40)
AMBER: Final = (255, 160, 30)
STAND_NODE: Final = "/object/stand"
GAP_MM: Final = 0.6
"""Distance of the image from the panel's face, in front of which it floats."""
NEAR: Final = ("sample_mount", "sample_holder")
"""Roles of the parts that turn with the sample."""
SAMPLE: Final = "sample"
"""What is picked where the sample is clicked."""
Pick = Callable[[int | None, str, str | None], None]
"""Called with viser's client, the part that was clicked, and the motor nearest to it."""
WORLD_POSE: Final = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""The pose of parts in the world's own frame."""
AXIS_REACH_MM: Final = 120.0
SCALE_MM = 500.0
AXES_MM = 150.0


class LabScene:
    """The lab's nodes in one viser server.

    Args:
        server: to draw in.
        machine, profile: to draw.
        drag: called when a stage is dragged.
        pick: called when a part is clicked.
        looks: part -> its own mesh (`own_looks`).
    """

    def __init__(
        self,
        server: viser.ViserServer,
        machine: Machine,
        profile: Profile,
        drag: Drag = lambda client, targets: None,
        looks: Mapping[str, bytes] | None = None,
        pick: Pick = lambda client, part, motor: None,
    ) -> None:
        """Build all nodes, each shown or hidden as in `Shown()`; see the class.

        `looks` holds glTF bytes that replace a component's own look, by its name. Nothing
        is placed before the first `update`. `drag` is called with viser's client and the
        targets when a handle is dragged.
        """
        self._server = server
        self.machine = machine
        self.profile = profile
        self._own = looks or {}
        self._pick = pick
        self._collision = build_scene(machine, profile)
        self._bodies = {b.name: b for b in self._collision.bodies}
        self._frames: dict[str, viser.FrameHandle] = {}
        self._sent: dict[str, tuple[float, ...]] = {}
        self._skins: list[Any] = []
        self._solids: dict[str, list[Shape]] = {}
        self._lit = False
        self._look: SampleLook | None = None
        self._hulls: dict[str, Any] = {}
        self._margins: dict[str, Any] = {}
        self.plan = PlanDrawing(machine, self._collision)
        with server.atomic():
            self._build()
            self._build_bodies()
            self._build_labels()
            self._gizmos = Gizmos(server, machine, drag)
            for node, visible in self._visible(Shown()).items():
                handle: Any = server.scene.get_handle_by_name(node)
                handle.visible = visible
        self.plain = self.nodes(Shown())
        """Properties of all nodes as built; each frame gets the differences of its
        page."""

    # -- building ----------------------------------------------------------------------------

    def _build(self) -> None:
        """Build lights, floor, machine, cabinet, beam, panel and lines, before any state.

        Fills the frames and solids by component; positions [mm] of the machine become
        [m]. The parts that rest on another get a contact shadow. Sample, image, beam,
        axis, cross and ranges are placeholders until the first state.
        """
        scene = self._server.scene
        scene.set_up_direction("+z")
        scene.configure_default_lights(enabled=False, cast_shadow=False)
        light_plainly(scene)
        scene.world_axes.visible = False
        room = room_of(self.machine)
        scene.add_grid(
            "/floor",
            width=8.0,
            height=8.0,
            cell_size=0.25,
            section_size=1.0,
            cell_color=FLOOR,
            section_color=FLOOR,
            cell_thickness=0.5,
            section_thickness=0.9,
            fade_distance=5.0,
            fade_strength=2.0,
            position=(0.0, 0.55, room.floor_mm * MM),
        )
        ground = ground_of(self.machine)
        standing = contact_shadows.standing(self.machine.components, self._bodies)
        for part in self.machine.components:
            frame = scene.add_frame(f"/machine/{part.name}", show_axes=False)
            self._frames[part.name] = frame
            own = self._own.get(part.name)
            pieces = pieces_of(part)
            self._solids[part.name] = cut(pieces)
            look = scene.add_glb(
                f"/machine/{part.name}/look",
                own or glb(pieces),
                position=tuple(
                    np.array(part.mesh_at_mm if own else (0.0, 0.0, 0.0)) * MM
                ),
                receive_shadow=part is ground,  # a part's shadow on itself has stripes
            )
            self._clickable(look, part.name, motor_of(self.machine, part))
            if part.name in standing:
                scene.add_glb(
                    f"/machine/{part.name}/look/shadow",
                    contact_shadows.shadow(part, standing[part.name]),
                    cast_shadow=False,
                    receive_shadow=False,
                )
        pieces, lamp = cabinet(room)
        self._solids["cabinet"] = cut(pieces)
        self._sent["cabinet"] = WORLD_POSE
        still: Any = {"cast_shadow": False, "receive_shadow": False}
        self._lamp = scene.add_icosphere(
            "/cabinet/lamp",
            radius=LAMP_M * room.scale,
            color=LAMP[False],
            position=tuple(lamp * MM),
            **still,
        )
        scene.add_glb("/cabinet/walls", glb(pieces), cast_shadow=False)
        self._frames["sample"] = scene.add_frame("/sample", show_axes=False)
        self._frames["object"] = scene.add_frame("/object", show_axes=False)
        scene.add_frame(STAND_NODE, show_axes=False)
        scene.add_frame(HOME, show_axes=False)
        scene.add_frame("/beam", show_axes=False)
        blank = np.zeros((8, 8, 3), dtype=np.uint8)
        self._image = scene.add_image(
            "/panel",
            blank,
            0.1,
            0.1,
            format="jpeg",
            jpeg_quality=80,
            cast_shadow=False,
            receive_shadow=False,
        )
        self._shade = BeamShade(scene)
        self._edges = scene.add_line_segments(
            "/beam/edges",
            np.zeros((8, 2, 3), np.float32),
            BEAM_OFF,
            thickness=1.6,
            **SCREEN,
        )
        self._spot = scene.add_icosphere(
            "/beam/spot",
            radius=0.004,
            color=LIGHT,
            cast_shadow=False,
            receive_shadow=False,
        )
        self._axis = scene.add_line_segments(
            "/axis", _axis_points(), (40, 160, 235), thickness=2.0, **SCREEN
        )
        self._cross = scene.add_line_segments(
            "/piercing", _cross_points(), PIERCING, thickness=2.5, **SCREEN
        )
        self._ranges = scene.add_line_segments(
            "/ranges",
            np.zeros((1, 2, 3), dtype=np.float32),
            RANGE,
            thickness=2.5,
            **SCREEN,
        )

    def _clickable(self, node: Any, part: str, motor: str | None) -> None:
        """Pass clicks of a node on, with what it is and its motor, to `pick`."""

        async def clicked(event: Any) -> None:
            self._pick(event.client_id, part, motor)

        node.on_click(clicked)

    def _build_bodies(self) -> None:
        """Add the hull of each collision body, and one grown by the safety margin if the
        machine has one.

        Hulls are red, margins amber, both translucent and in the parts' frames.
        """
        margin = self.machine.safety_margin_mm
        for name, body in self._bodies.items():
            hull = bare(body.solid)
            self._hulls[name] = self._hull(f"/machine/{name}/body", hull, RED, 0.35)
            if margin > 0.0:
                shell = grown(hull, margin)
                self._margins[name] = self._hull(
                    f"/machine/{name}/margin", shell, AMBER, 0.25
                )

    def _build_labels(self) -> None:
        """Build the world's axes and a scale on the floor, in [m].

        The scale is `SCALE_MM` long, the axes `AXES_MM`.
        """
        scene = self._server.scene
        (x, y, z) = _scale_mm(self.machine)
        ends = np.array([[[x, y, z], [x, y + SCALE_MM, z]]]) * MM
        scene.add_line_segments("/scale", ends, RANGE, thickness=5.0, **SCREEN)
        scene.add_frame(
            "/axes",
            axes_length=AXES_MM * MM,
            axes_radius=4 * MM,
            position=tuple((np.array([x, y - 2 * AXES_MM, z]) * MM).tolist()),
        )

    def named(self, world: World, shown: Shown) -> list[Name]:
        """List the names shown now, with their places [m].

        With "labels": the scale, three axes and the parts; without them, the image's
        names if "names" is shown, else none. The names of the axes are at 1.1 times their
        length; the parts are those of `names_of_parts`.
        """
        if "labels" not in shown:
            if "names" in shown:
                named = names_of_image(world, self._top_mm(world))
                return [name for name in named if name[0] != SAMPLE or SAMPLE in shown]
            return []
        first = _scale_mm(self.machine)
        out: list[Name] = [
            (f"{SCALE_MM:g} mm", (first + [0.0, 0.5 * SCALE_MM, 0.0]) * MM)
        ]
        for k, words in enumerate(("x traversal", "y source to detector", "z up")):
            end = first - [0.0, 2 * AXES_MM, 0.0] + 1.1 * AXES_MM * np.eye(3)[k]
            out.append((words, end * MM))
        return out + names_of_parts(self.machine, dict(self._sent))

    def subject(self, world: World) -> list[FloatArray]:
        """List what a scene is about, each as points (n, 3) around it [m]: focal spot, sample
        with the parts that turn with it, and image."""
        turning = [world.sample.shift[None] * MM]
        for part in self.machine.components:
            if part.role in NEAR and (pose := self._sent.get(part.name)) is not None:
                middle, half = np.array(part.center_mm), 0.5 * np.array(part.size_mm)
                corners = middle + half * np.array(list(product((-1.0, 1.0), repeat=3)))
                turn = Rotation.from_quat(pose[:4], scalar_first=True)
                turning.append(turn.apply(corners * MM) + pose[4:])
        if (
            self._look is not None
            and (around := rim(world, self._look.hulls_m)) is not None
        ):
            turning.append(around * MM)
        return [world.source[None] * MM, np.concatenate(turning), world.corners * MM]

    def _top_mm(self, world: World) -> float | None:
        """Compute the height of the sample's highest point; None without a sample."""
        around = None if self._look is None else rim(world, self._look.hulls_m)
        return None if around is None else float(around[:, 2].max())

    def _hull(
        self, node: str, mesh: Any, color: tuple[int, int, int], opacity: float
    ) -> Any:
        """Add a translucent, two-sided mesh without shadows to the scene; returns its
        handle.

        Vertices are converted to [m].
        """
        vertices, faces = plain(mesh)
        return self._server.scene.add_mesh_simple(
            node,
            vertices,
            faces,
            color=color,
            opacity=opacity,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )

    # -- moving ------------------------------------------------------------------------------

    def update(self, state: State, world: World) -> None:
        """Move everything to a state.

        Changes parts, sample, beam, panel and drag handles in one message. The tube is
        shifted with the source, the panel with the detector and turned as the image;
        other parts follow their motors.

        Args:
            state: of the twin; its motors and X-rays.
            world: geometry of the state.
        """
        q = self._collision.vector(motors(self.machine, state))
        with self._server.atomic():
            for part in self.machine.components:
                body = self._bodies[part.name]
                at = body.origin + q @ body.slides
                turn = body.rotation(float(q @ body.turns))
                if part.anchor == "source":
                    at = at + world.tube_shift
                if part.role == "panel":
                    turn = _panel_rotation(world)
                    at = at + world.panel_shift
                self._place(part.name, turn, at)
            self._place("sample", world.sample.turn, world.sample.shift)
            self._place("object", world.stage.turn, world.stage.shift)
            self._show_beam(state, world)
            self._show_panel(world)
            self._gizmos.update(state, world)

    def _place(self, name: str, turn: FloatArray, at: FloatArray) -> None:
        """Pose a node's frame in the viewer and keep the pose sent; `at` is in [mm], sent
        in [m].

        `turn` is a rotation (3, 3).
        """
        pose = (*quaternion(turn), *(at * MM).tolist())
        self._sent[name] = pose
        frame = self._frames[name]
        frame.wxyz = pose[:4]
        frame.position = pose[4:]

    def _show_beam(self, state: State, world: World) -> None:
        """Move edges, spot, lamp, cross and axis to a state, and color them by X-rays on
        or off; the lamp is lit while the tube warms up, too.

        Positions become [m]; the spot is hidden while no X-rays come out. Edges are the eight
        lines of the pyramid of focal spot and image corners.

        Args:
            state: of the twin.
            world: geometry of the state.
        """
        on = state.tube.on and state.tube.ready
        points = np.concatenate([world.source[None], world.corners]) * MM
        self._lit = on
        self._lamp.color = LAMP[state.tube.on]
        self._shade.light(on)
        self._shade.follow(world)
        a, b, c, d, e = points
        lines = [(a, b), (a, c), (a, d), (a, e), (b, c), (c, d), (d, e), (e, b)]
        self._edges.points = np.array(lines, dtype=np.float32)
        self._edges.colors = np.full((8, 2, 3), LIGHT if on else BEAM_OFF, dtype=np.uint8)
        self._spot.position = tuple(points[0])
        self._spot.visible = on
        self._cross.position = tuple((world.foot - GAP_MM * 2 * world.normal) * MM)
        self._cross.wxyz = quaternion(_panel_rotation(world))
        self._axis.position = tuple(world.axis * MM)
        self._axis.wxyz = quaternion(world.stage.turn)

    def _show_panel(self, world: World) -> None:
        """Place the live image in front of the panel, as large as it and turned like it.

        It is `GAP_MM` in front, towards the source; sizes are converted to [m].
        """
        rows, cols = world.shape
        at = (world.detector - GAP_MM * world.normal) * MM
        width = float(np.linalg.norm(world.u)) * cols * MM
        height = float(np.linalg.norm(world.v)) * rows * MM
        u = world.u / np.linalg.norm(world.u)
        v = world.v / np.linalg.norm(world.v)
        self._image.render_width = width
        self._image.render_height = height
        self._image.wxyz = quaternion(np.stack([u, v, np.cross(u, v)], axis=1))
        self._image.position = tuple(at)

    def shapes(self, world: World, shown: Shown, near: bool = False) -> list[Shape]:
        """Collect the drawn shapes for a picture that needs no browser, in world frame
        [m].

        `near` leaves out panel, beam, parts that do not turn with the sample, and draws
        the sample opaque unless it has a dense part. The cone is drawn only while X-rays
        are on. Any thread may call.
        """
        poses = dict(self._sent)
        out = self._drawn_parts(poses, shown, near)
        out += self._drawn_sample(poses, shown, near)
        if near:
            return out
        if "panel" in shown:
            out.append(image_on(np.asarray(self._image.image), world))
        if self._lit and "beam" in shown:
            out.append(cone(world, LIGHT, CONE_OPACITY))
        return out

    def _drawn_parts(
        self, poses: Mapping[str, tuple[float, ...]], shown: Shown, near: bool
    ) -> list[Shape]:
        """Collect the shapes of the machine's parts that are shown; `near`: of those alone
        that turn with the sample.
        """
        drawn = [n for n in self._solids if (n if n == "cabinet" else "machine") in shown]
        if near:
            parts = self.machine.components
            turning = {"object", *(part.name for part in parts if part.role in NEAR)}
            drawn = [n for n in drawn if n in turning]
        return [shape for n in drawn for shape in placed(self._solids[n], poses[n])]

    def _drawn_sample(
        self, poses: Mapping[str, tuple[float, ...]], shown: Shown, near: bool
    ) -> list[Shape]:
        """Collect the shapes of the sample, if there is one and it is shown; opaque where
        it is `near` and nothing in it is dense.
        """
        skins = () if self._look is None or "sample" not in shown else self._look.skins
        solid = near and not any(skin.dense for skin in skins)
        opacity = 1.0 if solid else shown.opacity
        return placed([shape_of(skin, opacity) for skin in skins], poses["sample"])

    # -- visible parts -----------------------------------------------------------------------

    def show_image(
        self, rgb: npt.NDArray[np.uint8], lines: npt.NDArray[np.generic], world: World
    ) -> None:
        """Draw an image (rows, cols, 3) on the panel, and its line integrals as the beam.

        The ball around the sample is left out.
        """
        self._image.image = rgb
        with self._server.atomic():
            self._shade.show(
                world, lines, 0.0 if self._look is None else self._look.radius_mm
            )

    def wear(self, look: SampleLook) -> None:
        """Put a sample on the stage.

        Nothing is done if the look is there already. A look that is not exact is drawn as
        wires. The rod below it is drawn anew, and `plain` updated.

        Args:
            look: its meshes; the former ones are removed.
        """
        if look is self._look:
            return
        self._look = look
        with self._server.atomic():
            for handle in self._skins:
                handle.remove()
            self._skins = [
                self._server.scene.add_mesh_simple(
                    f"/sample/{skin.name}",
                    skin.vertices,
                    skin.faces,
                    color=skin.color,
                    **_clear(Shown().opacity, skin.dense),
                    wireframe=not look.exact,
                    cast_shadow=look.exact,
                    receive_shadow=False,
                )
                for skin in look.skins
            ]
            for handle in self._skins:
                self._clickable(handle, SAMPLE, sample_motor(self.machine))
            self._stand(look)
        self.plain = self.nodes(Shown())

    def _stand(self, look: SampleLook) -> None:
        """Draw a thin rod from the mount to the sample; X-rays do not see it.

        A former rod is removed; none is drawn if the machine has no mount or the sample
        touches it. The rod is 5 mm thick and reaches from the mount's top to the lowest
        vertex, about the object's z axis.

        Args:
            look: the sample; without meshes there is no rod.
        """
        name = f"{STAND_NODE}/rod"
        mount = next(
            (p for p in self.machine.components if p.role == "sample_mount"), None
        )
        known = self._server.scene.get_handle_by_name(name)
        if known is not None:
            known.remove()
        self._solids["object"] = []
        if mount is None or not look.skins:
            return
        low = mount.center_mm[2] + mount.size_mm[2] / 2 - self.machine.sample_height_mm
        high = min(float(skin.vertices[:, 2].min()) for skin in look.skins) / MM
        if high > low:
            rod = cylinder(5.0, high - low, (0.0, 0.0, 0.5 * (low + high)), RUBBER)
            self._solids["object"] = cut([rod])
            self._server.scene.add_glb(name, glb([rod]), receive_shadow=False)

    def nodes(
        self, shown: Shown, near: Collection[str] = (), within: bool = False
    ) -> Nodes:
        """Collect the nodes of all layers, for frames of a page that shows `shown`.

        Returns node -> its properties: `visible` for each node, `clickable` for parts and
        sample, and the opacity for the sample's surfaces, at most FADED_OPACITY within a
        drawn volume. Dense skins stay opaque unless the sample fades. Parts are not clicked
        while there are handles: the pointer would not reach those behind them.

        Args:
            near: components near a contact, whose collision bodies and margins are drawn, too.
            within: whether the page's volume is drawn within the sample, which then fades.
        """
        out = {
            n: {"visible": visible} for n, visible in self._visible(shown, near).items()
        }
        skins = () if self._look is None else self._look.skins
        if within:
            opacity = min(shown.opacity, FADED_OPACITY)
        else:
            opacity = shown.opacity
        clear = {
            f"/sample/{s.name}": _clear(opacity, s.dense and not within) for s in skins
        }
        picked = {"clickable": "gizmos" not in shown}
        looks = [f"/machine/{part.name}/look" for part in self.machine.components]
        clicks = {n: {**out.get(n, {}), **picked} for n in looks}
        return {**out, **clicks, **{n: {**of, **picked} for n, of in clear.items()}}

    def _visible(self, shown: Shown, near: Collection[str] = ()) -> dict[str, bool]:
        """Determine for each node that exists whether it is visible; a margin of 0 has no
        node.
        """
        there = self._server.scene.get_handle_by_name
        wanted = shown.visible(self._bodies, near)
        return {node: on for node, on in wanted.items() if there(node) is not None}

    def draw_ranges(self, state: State) -> None:
        """Draw the remaining travel of each stage as a line through its position.

        Only linear axes that carry a part are drawn, with marks at their limits; without
        any, the former lines stay. Each axis has a line between its limits, through the
        part's center, and a mark of 50 mm at each end. Correction shifts are not
        included.

        Args:
            state: of the twin.
        """
        q = self._collision.vector(motors(self.machine, state))
        lines = []
        for part in self.machine.components:
            body = self._bodies[part.name]
            axis = self.machine.axes.get(part.axis or "")
            if part.axis is None or axis is None or axis.kind != "linear":
                continue
            k = self._collision.axes.index(part.axis)
            at = body.origin + q @ body.slides + np.asarray(part.center_mm)
            ends = [
                at + body.slides[k] * (limit - q[k]) for limit in (axis.lower, axis.upper)
            ]
            lines.append(ends)
            side = np.cross(body.slides[k], [0.3, 0.2, 0.9])
            side *= 25.0 / np.linalg.norm(side)
            lines += [[end - side, end + side] for end in ends]
        if lines:
            self._ranges.points = (np.array(lines) * MM).astype(np.float32)
            self._ranges.colors = np.full((len(lines), 2, 3), RANGE, dtype=np.uint8)


def motor_of(machine: Machine, part: Component | None) -> str | None:
    """Name the motor nearest to a part on its chain: its own, or that of the part which
    carries it; None where nothing moves it.

    >>> from flexdt.twin.machine.description import builtin_machine
    >>> flexray = builtin_machine("flexray")
    >>> parts = {part.name: part for part in flexray.components}
    >>> [motor_of(flexray, parts[n]) for n in ("xray_source", "sample_mount", "main_platform")]
    ['ver_tube', 'rot_obj', None]"""
    parts = {each.name: each for each in machine.components}
    while part is not None:
        if part.axis is not None:
            return part.axis
        part = parts.get(part.parent or "")
    return None


def sample_motor(machine: Machine) -> str | None:
    """Name the motor nearest to the sample: that of the last part that carries it."""
    holders = [each for each in machine.components if each.role in NEAR]
    return motor_of(machine, holders[-1] if holders else None)


def _clear(opacity: float, dense: bool) -> dict[str, Any]:
    """Choose opacity and sides of a skin: dense ones stay opaque, others show their rear, too.
    None as opacity is opaque; an opaque skin shows its front only, a dense one of a translucent
    sample both sides."""
    opaque = opacity >= 1.0
    side = "front" if opaque else "double"
    return {"opacity": None if dense or opaque else opacity, "side": side}


def _scale_mm(machine: Machine) -> FloatArray:
    """Compute the scale's first end (3,) [mm]: near a corner of the part that carries the
    others, 2 mm above its top.
    """
    ground = ground_of(machine)
    (x, y, z) = ground.size_mm
    middle = np.array(ground.center_mm)
    return np.asarray(middle + [0.45 * x, -0.4 * y, z / 2 + 2.0])


def _panel_rotation(world: World) -> FloatArray:
    u = world.u / np.linalg.norm(world.u)
    v = world.v / np.linalg.norm(world.v)
    return np.stack([u, np.cross(u, v), -v], axis=1)


def _axis_points() -> npt.NDArray[np.float32]:
    z = np.linspace(-AXIS_REACH_MM, AXIS_REACH_MM, 25) * MM
    pairs = [[[0, 0, a], [0, 0, b]] for a, b in zip(z[:-1:2], z[1::2], strict=False)]
    return np.array(pairs, dtype=np.float32)


def _cross_points() -> npt.NDArray[np.float32]:
    """Return four lines, (4, 2, 3) [m], of an upright cross in the xz plane with an open
    center.

    Each line is from 1.5 to 7 mm from the center.
    """
    r = 7.0 * MM
    g = 1.5 * MM
    return np.array(
        [[[s * g, 0, 0], [s * r, 0, 0]] for s in (-1, 1)]
        + [[[0, 0, s * g], [0, 0, s * r]] for s in (-1, 1)],
        dtype=np.float32,
    )
