"""The sample and the scanner's parts as coloured meshes.

The sample has one mesh for each material. Shipped phantoms are made from their names; meshes of
uploads come from the twin. Until an upload's mesh has arrived, and where it has too many triangles
to send, a box of its size stands in.

Shipped shapes are bevelled boxes, extrusions and cylinders, mm in and metres out, as a list of
painted meshes that becomes one GLB. Uploads are fetched by `sample.mesh`, for a bounded time and up
to a bounded size.

The scanner's components are recognisable machine parts, from the machine file's boxes alone.

`data/parts.toml` says of which pieces a look consists. Components of other names and roles become
bevelled boxes or cylinders, so another machine file still draws; a part with a mesh of its own is
drawn as that.

The lead cabinet around the machine is drawn only; no collision knows of it. Its walls are seen from
the inside alone, so whatever stands between a camera and the machine is cut away. A kerb shows
where they go; the wall opposite the operator has the door, with a window of lead glass and the lamp
that says whether X-rays are on. Lengths are in mm.
"""

from __future__ import annotations

import io
import tomllib
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.visual.material import PBRMaterial

from flexdt.clients.client.flows import adrive, sample_shape
from flexdt.clients.viewer.scenes.world import MM
from flexdt.phantoms import Phantom, load_phantom, mesh_phantom
from flexdt.phantoms.files.mesh_files import read_part
from flexdt.protocol import RpcError
from flexdt.protocol.state_model import SampleState
from flexdt.twin.collision.convex_solids import ConvexSolid, Polytope, UprightCylinder
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray, rotation_about
from flexdt.twin.machine.description import Component, Machine

SMOOTH_RAD = 0.6
"""Edges sharper than this stay sharp when shaded."""

Vector = Sequence[float]


@dataclass(frozen=True)
class Paint:
    """A surface: colour (r, g, b in 0 to 255), metalness and roughness in 0 to 1."""

    color: tuple[int, int, int]
    metal: float = 0.0
    rough: float = 0.6
    glow: tuple[float, float, float] = (0.0, 0.0, 0.0)


STEEL = Paint((186, 192, 200), 0.25, 0.35)
ALUMINIUM = Paint((205, 210, 217), 0.15, 0.45)
ANODISED = Paint((62, 68, 79), 0.15, 0.5)
GRANITE = Paint((96, 104, 117), 0.0, 0.85)
ENAMEL = Paint((240, 243, 247), 0.0, 0.4)
BRAND = Paint((28, 120, 200), 0.0, 0.45)
BRASS = Paint((206, 168, 92), 0.3, 0.35)
SIGNAL = Paint((255, 140, 0), 0.0, 0.5, (0.25, 0.12, 0.0))
RUBBER = Paint((34, 37, 43), 0.0, 0.8)
PAINTS: Final = {name: value for name, value in globals().items() if isinstance(value, Paint)}
"""By their names in `data/parts.toml`."""


@dataclass(frozen=True, eq=False)
class PaintedMesh:
    """A mesh [mm] and its paint."""

    mesh: trimesh.Trimesh
    paint: Paint


def bevelled(size: Vector, center: Vector, paint: Paint, bevel: float = 2.0) -> PaintedMesh:
    """A box [mm] whose edges are cut, so that they catch the light."""
    h = np.asarray(size, dtype=float) / 2.0
    b = min(bevel, 0.35 * float(h.min()))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    points = np.concatenate(
        [corners * (h - b * np.array(k)) for k in ((0, 1, 1), (1, 0, 1), (1, 1, 0))]
    )
    mesh = trimesh.convex.convex_hull(points)
    mesh.apply_translation(center)
    return PaintedMesh(mesh, paint)


def cylinder(
    diameter: float,
    height: float,
    center: Vector,
    paint: Paint,
    axis: str = "z",
    sections: int = 48,
) -> PaintedMesh:
    """A cylinder [mm] along z (or y)."""
    mesh = trimesh.creation.cylinder(radius=diameter / 2, height=height, sections=sections)
    return _standing(mesh, center, paint, axis)


def lathe(
    profile: Sequence[tuple[float, float]], center: Vector, paint: Paint, axis: str = "z"
) -> PaintedMesh:
    """A body of revolution [mm]: (radius, height) from bottom to top, about z (or y)."""
    mesh = trimesh.creation.revolve(np.asarray(profile, dtype=float), sections=64)
    return _standing(mesh, center, paint, axis)


def _standing(mesh: trimesh.Trimesh, center: Vector, paint: Paint, axis: str) -> PaintedMesh:
    """What was made about z, about z or y."""
    if axis == "y":
        mesh.apply_transform(turn_matrix((1, 0, 0), -np.pi / 2))
    mesh.apply_translation(center)
    return PaintedMesh(mesh, paint)


def glb(pieces: Iterable[PaintedMesh]) -> bytes:
    """One binary glTF of the pieces, in metres; pieces of one paint share a mesh."""
    groups: dict[Paint, list[trimesh.Trimesh]] = {}
    for piece in pieces:
        groups.setdefault(piece.paint, []).append(piece.mesh)
    scene = trimesh.Scene()
    for i, (paint, meshes) in enumerate(groups.items()):
        scene.add_geometry(_painted(meshes, paint), geom_name=f"part{i}", node_name=f"part{i}")
    out = io.BytesIO()
    export: Any = scene.export
    export(out, file_type="glb", include_normals=True)
    return out.getvalue()


def _painted(meshes: Sequence[trimesh.Trimesh], paint: Paint) -> trimesh.Trimesh:
    shaded = [trimesh.graph.smooth_shade(m, angle=SMOOTH_RAD) for m in meshes]
    mesh: Any = trimesh.util.concatenate(shaded)
    mesh.apply_scale(MM)
    mesh.metadata.clear()  # notes of the mesh library, which would travel to every page
    r, g, b = (_linear(c) for c in paint.color)
    make: Any = PBRMaterial
    material = make(
        baseColorFactor=[r, g, b, 1.0],
        metallicFactor=paint.metal,
        roughnessFactor=paint.rough,
        emissiveFactor=list(paint.glow),
    )
    visuals: Any = trimesh.visual.TextureVisuals
    mesh.visual = visuals(material=material)
    return cast("trimesh.Trimesh", mesh)


def _linear(channel: int) -> float:
    """A channel of sRGB as glTF wants it: linear, 0 to 1."""
    c = channel / 255.0
    return c / 12.92 if c <= 0.04045 else float(((c + 0.055) / 1.055) ** 2.4)


def turn_matrix(axis: Vector, angle: float) -> FloatArray:
    """A right-handed turn about an axis through the origin, (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = rotation_about(axis, angle)
    return out


def plain(mesh: trimesh.Trimesh) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """Vertices [m] and faces of a mesh in mm."""
    return (
        (np.asarray(mesh.vertices) * MM).astype(np.float32),
        np.asarray(mesh.faces, dtype=np.uint32),
    )


COLORS: Mapping[str, tuple[int, int, int]] = {
    "steel": (206, 212, 220),
    "abs": (222, 66, 48),
    "aluminium": (188, 198, 210),
    "pmma": (150, 205, 230),
    "water": (110, 170, 235),
    "bone": (240, 226, 196),
}
"""Material -> colour; others get the last one's."""
OTHER = (214, 170, 90)
KEPT = 8
MAX_FACES = 200_000


@dataclass(frozen=True, eq=False)
class Skin:
    """One mesh of a sample.

    Attributes:
        name: of the node.
        vertices: (n, 3) float32 [m], the sample's own frame.
        faces: (m, 3) uint32.
        color: (r, g, b).
        dense: metal beads and the like, drawn opaque inside a translucent body.
    """

    name: str
    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[np.uint32]
    color: tuple[int, int, int]
    dense: bool


@dataclass(frozen=True, eq=False)
class SampleLook:
    """A sample as the scene needs it.

    Attributes:
        skins: its meshes.
        beads: (k, 3) [mm], the sample's own frame.
        exact: whether this is the sample's shape, or only a box of its size.
    """

    skins: tuple[Skin, ...]
    beads: FloatArray
    exact: bool = True

    @property
    def radius_mm(self) -> float:
        """Of the ball about the sample's origin that holds it; of a hand for an empty stage."""
        far = [float(np.linalg.norm(skin.vertices, axis=1).max()) for skin in self.skins]
        return max(far) / MM if far else 50.0


DEFAULT_MATERIAL = "abs"
Key = tuple[str | None, str | None, str | None]

NOTHING = SampleLook((), np.zeros((0, 3)))


def _key(sample: SampleState) -> Key:
    return sample.name, sample.revision, sample.material


class MeshCache:
    """Looks of samples, made once each."""

    def __init__(self) -> None:
        self._made: OrderedDict[Key, SampleLook] = OrderedDict()

    def lacks(self, sample: SampleState) -> bool:
        """Whether the sample is an upload whose mesh has not arrived yet."""
        return sample.revision is not None and _key(sample) not in self._made

    def add(self, sample: SampleState, stl: bytes) -> None:
        """The shape of an upload.

        Raises:
            TwinError: it is no mesh.
        """
        material = sample.material or DEFAULT_MATERIAL
        made = mesh_phantom(stl, material=material, file_type="stl", place="keep")
        self._keep(sample, made)

    def look(self, sample: SampleState) -> SampleLook:
        """How `sample` looks, an upload whose mesh is lacking as a box; it may take a second."""
        if sample.name is None:
            return NOTHING
        if sample.revision is None and _key(sample) not in self._made:
            with suppress(TwinError):
                self._keep(sample, load_phantom(sample.name))
        return self._made.get(_key(sample)) or _box(sample)

    def _keep(self, sample: SampleState, phantom: Phantom) -> None:
        self._made[_key(sample)] = _skins(phantom)
        while len(self._made) > KEPT:
            self._made.popitem(last=False)


def _skins(phantom: Phantom) -> SampleLook:
    groups: dict[str, list[trimesh.Trimesh]] = {}
    for part in phantom.parts():
        mesh = part.mesh
        if part.hole:
            mesh = mesh.copy()
            mesh.invert()
        groups.setdefault(part.material, []).append(mesh)
    skins = []
    for material, meshes in groups.items():
        mesh = cast("trimesh.Trimesh", trimesh.util.concatenate(meshes))
        if len(mesh.faces) <= MAX_FACES:
            mesh = trimesh.graph.smooth_shade(mesh, angle=SMOOTH_RAD)
        vertices, faces = plain(mesh)
        name = "".join(c if c.isalnum() else "_" for c in material)
        dense = material == "steel" and len(groups) > 1
        skins.append(Skin(name, vertices, faces, COLORS.get(material, OTHER), dense))
    return SampleLook(tuple(skins), np.asarray(phantom.beads))


def _box(sample: SampleState) -> SampleLook:
    if sample.size_mm is None:
        return NOTHING
    vertices, faces = plain(trimesh.creation.box(extents=sample.size_mm))
    skin = Skin("size", vertices, faces, OTHER, False)
    return SampleLook((skin,), np.zeros((0, 3)), exact=False)


Ask = Callable[[str, Mapping[str, Any]], Awaitable[object]]


async def fetch(ask: Ask, sample: SampleState) -> bytes | None:
    """The STL of the sample on the stage; None if the sample has changed or is too large.

    Raises:
        ConnectionLost: the twin has gone.
    """
    try:
        told = await adrive(sample_shape(), lambda asked: ask(asked.method, asked.params))
    except RpcError:  # nothing on the stage any more, too large, or an older twin
        return None
    same = (told.name, told.revision) == (sample.name, sample.revision)
    return told.data or None if same else None


MIDDLE: Final = (0.0, 0.0, 0.0)
_TABLE = resources.files("flexdt.clients.viewer.scenes") / "data" / "parts.toml"
LOOKS: Final[Mapping[str, Any]] = tomllib.loads(_TABLE.read_text(encoding="utf-8"))


def own_looks(machine: Machine, folder: Path) -> dict[str, bytes]:
    """Part -> its own mesh as a GLB file [m], for those that have one.

    Args:
        machine: whose parts.
        folder: of its machine file, in which the meshes lie.

    Raises:
        PhantomError: a file cannot be read any more.
    """
    looks = {}
    for part in machine.components:
        if part.mesh:
            file = folder / part.mesh
            own = file.suffix.lower() == ".glb"  # with its colours
            looks[part.name] = (
                file.read_bytes() if own else glb([PaintedMesh(read_part(file), ALUMINIUM)])
            )
    return looks


def pieces_of(part: Component) -> list[PaintedMesh]:
    """The part's painted meshes, in its own frame [mm]."""
    if part.points_mm:
        return [PaintedMesh(trimesh.convex.convex_hull(np.array(part.points_mm)), ALUMINIUM)]
    role = part.role if part.role in LOOKS["looks"] else part.shape
    look = LOOKS["looks"][LOOKS["components"].get(part.name, role)]
    pieces = [made for piece in look for made in _pieces(piece, np.array(part.size_mm))]
    for made in pieces:
        made.mesh.apply_translation(part.center_mm)
    return pieces


def _pieces(piece: Mapping[str, Any], sides: FloatArray) -> list[PaintedMesh]:
    """One piece of a look, as often as it is turned; about the middle of a box of these sides."""
    size, place = (
        (sides * piece.get(share, MIDDLE) + piece.get(more, MIDDLE)).tolist()
        for share, more in (("share", "mm"), ("at", "at_mm"))
    )
    paint, axis = PAINTS[piece["paint"]], piece.get("axis", "z")
    made = []
    for angle in np.radians(piece.get("turned_deg", [0.0])):
        match piece["solid"]:
            case "box":
                one = bevelled(size, place, paint, piece.get("bevel", 2.0))
            case "cylinder":
                along = size["xyz".index(axis)]
                one = cylinder(size[0], along, place, paint, axis, piece.get("sections", 48))
            case _:
                wide = max(sides[0], sides[2])
                profile = [(r * wide + a, h * sides[1] + b) for r, a, h, b in piece["profile"]]
                one = lathe(profile, place, paint, axis)
        one.mesh.apply_transform(turn_matrix((0, 0, 1), angle))
        made.append(one)
    return made


FINENESS = 2
"""Of the ball that a body is grown by: an icosphere, whose points lie along the axes too."""


def bare(solid: ConvexSolid) -> trimesh.Trimesh:
    """A convex solid [mm]."""
    if isinstance(solid, UprightCylinder):
        size = 2.0 * solid.radius, solid.height
        return cylinder(*size, solid.center, STEEL).mesh
    assert isinstance(solid, Polytope)
    return _hull(solid.vertices)


def grown(body: trimesh.Trimesh, margin_mm: float) -> trimesh.Trimesh:
    """A convex body and everything within `margin_mm` of it."""
    ball = trimesh.creation.icosphere(subdivisions=FINENESS, radius=margin_mm).vertices
    corners = np.asarray(body.vertices)[:, None, :] + np.asarray(ball)[None, :, :]
    return _hull(corners.reshape(-1, 3))


def _hull(points: FloatArray) -> trimesh.Trimesh:
    hull: trimesh.Trimesh = trimesh.convex.convex_hull(points)
    return hull


ROOM_MM: Final = (150.0, 150.0, 450.0)
"""Between the machine's largest part and the walls; above that part, what towers need and more."""
DOOR_MM: Final = (900.0, 1050.0)
WALL = Paint((208, 213, 220), 0.0, 0.9)
FLOOR = Paint((120, 127, 138), 0.0, 0.95)
DOOR = Paint((232, 236, 241), 0.0, 0.7)
GLASS = Paint((58, 92, 104), 0.1, 0.25)
LAMP = {False: (92, 98, 106), True: (255, 243, 196)}
"""X-rays on or not -> colour of the lamp: no red, in which the page draws parts that touch."""


def ground_of(machine: Machine) -> Component:
    """The part on which the others stand."""
    return max(machine.components, key=lambda part: part.size_mm[0] * part.size_mm[1])


def cabinet(machine: Machine, floor_mm: float) -> tuple[list[PaintedMesh], FloatArray]:
    """The cabinet's pieces, and where its lamp is, (3,).

    Args:
        machine: around the largest of whose parts it stands.
        floor_mm: height of the floor.
    """
    ground = ground_of(machine)
    towers = max(part.size_mm[2] for part in machine.components)
    half = np.array(ground.size_mm) / 2 + ROOM_MM
    low = np.array(ground.center_mm) - half
    high = np.array(ground.center_mm) + half
    low[2], high[2] = floor_mm, ground.center_mm[2] + towers + ROOM_MM[2]
    (x0, y0, z0), (x1, y1, _) = low, high
    door_y, (wide, door_top) = 0.3 * y0 + 0.7 * y1, (DOOR_MM[0], z0 + DOOR_MM[1])
    left, right = door_y - wide / 2, door_y + wide / 2
    room = trimesh.creation.box(bounds=[low, high])
    upward = room.face_normals[:, 2].copy()
    room.invert()  # it is seen from within
    walls, floor = room, room.copy()
    walls.update_faces(abs(upward) < 0.5)
    floor.update_faces(upward < -0.5)
    middle, tall = (door_top + z0) / 2, DOOR_MM[1]
    on_wall = [
        bevelled((8, wide + 60, tall + 60), (x0 + 4, door_y, middle), ANODISED),
        bevelled((14, wide, tall), (x0 + 7, door_y, middle), DOOR, 4.0),
        bevelled((18, 440, 340), (x0 + 9, door_y, door_top - 280), ANODISED),
        bevelled((20, 400, 300), (x0 + 10, door_y, door_top - 280), GLASS),
        bevelled((40, 26, 220), (x0 + 30, left + 90, door_top - 560), STEEL, 8.0),
        bevelled((16, 150, 150), (x0 + 9, right - 170, door_top - 590), SIGNAL),
    ]
    for piece in on_wall:  # as the wall, it is seen from within alone
        piece.mesh.update_faces(piece.mesh.face_normals[:, 0] > 0.2)
    kerb = [
        bevelled((x1 - x0 + 80, 40, 60), (0.5 * (x0 + x1), y, z0 + 30), STEEL)
        for y in (y0 - 20, y1 + 20)
    ] + [
        bevelled((40, y1 - y0, 60), (x, 0.5 * (y0 + y1), z0 + 30), STEEL)
        for x in (x0 - 20, x1 + 20)
    ]
    pieces = [PaintedMesh(walls, WALL), PaintedMesh(floor, FLOOR), *on_wall, *kerb]
    return pieces, np.array([x0 + 45.0, door_y, door_top + 130.0])
