"""The sample as colored meshes, one for each material.

Shipped phantoms are made from their names; meshes of uploads come from the twin, by
`sample.mesh`, for a bounded time and up to a bounded size. Until an upload's mesh has
arrived, and where it has too many triangles to send, a box of its size replaces it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt
import trimesh

from flexdt.clients.client.flows import adrive, sample_shape
from flexdt.clients.viewer.scenes.meshes.painted_meshes import SMOOTH_RAD, plain
from flexdt.clients.viewer.scenes.world import MM
from flexdt.phantoms import Phantom, load_phantom, materials, mesh_phantom
from flexdt.protocol import RpcError
from flexdt.protocol.state_model import SampleState
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray

OTHER_COLOR: Final = (214, 170, 90)
"""Of materials by formula, and of those without a color of their own (r, g, b)."""
MAX_LOOKS: Final = 8
MAX_FACES: Final = 200_000
DEFAULT_MATERIAL: Final = "abs"
HAND_MM: Final = 50.0
SAME_VOLUME: Final = 1e-6
"""Rounding of a volume of a mesh, relative."""
"""Radius of the ball that is looked at on an empty stage."""
Key = tuple[str | None, str | None, str | None]
Ask = Callable[[str, Mapping[str, Any]], Awaitable[object]]


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

    @cached_property
    def radius_mm(self) -> float:
        """Of the ball about the sample's origin that holds it; of a hand for an empty stage."""
        far = self._reach(3)
        return HAND_MM if far is None else far

    @cached_property
    def across_mm(self) -> float | None:
        """Diameter of the cylinder about the sample's z axis that holds it; None for an
        empty stage."""
        far = self._reach(2)
        return None if far is None else 2.0 * far

    @cached_property
    def hulls_m(self) -> tuple[npt.NDArray[np.float32], ...]:
        """Corners of each skin's convex hull, (k, 3) [m]; of a flat skin all its vertices."""
        return tuple(_hull(skin.vertices) for skin in self.skins)

    def _reach(self, axes: int) -> float | None:
        """Compute the skins' reach [mm] from the origin (axes: 3), or from the z axis
        (2).
        """
        far = [
            np.linalg.norm(skin.vertices[:, :axes], axis=1).max() for skin in self.skins
        ]
        return float(max(far)) / MM if far else None


def _hull(vertices_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Find the corners of the convex hull of vertices (k, 3); all of them where they lie in a
    plane.

    Also all of them where there are too few; in no particular order otherwise.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        corners = vertices_m[ConvexHull(vertices_m).vertices]
        return np.asarray(corners, np.float32)
    except (QhullError, ValueError):  # flat, or nothing at all
        return vertices_m


NOTHING = SampleLook((), np.zeros((0, 3)))


def _key(sample: SampleState) -> Key:
    return sample.name, sample.revision, sample.material


class MeshCache:
    """Looks of samples, made once each."""

    def __init__(self) -> None:
        self._made: OrderedDict[Key, SampleLook] = OrderedDict()

    def lacks(self, sample: SampleState) -> bool:
        """Check whether the sample is an upload whose mesh has not arrived yet."""
        return sample.revision is not None and _key(sample) not in self._made

    def add(self, sample: SampleState, stl: bytes) -> None:
        """Store the look of an upload from its STL (bytes, mm), kept at its own place. Without a
        material it is `DEFAULT_MATERIAL`. At most `MAX_LOOKS` looks are kept, the oldest goes
        first. Raises TwinError: it is no mesh."""
        material = sample.material or DEFAULT_MATERIAL
        made = mesh_phantom(stl, material=material, file_type="stl", place="keep")
        self._keep(sample, made)

    def look(self, sample: SampleState) -> SampleLook:
        """Return the look of a sample: its own meshes, or a box of its size.

        An empty stage is `NOTHING`. A named phantom is loaded at its first use; one that
        cannot be loaded is a box.
        """
        if sample.name is None:
            return NOTHING
        if sample.revision is None and _key(sample) not in self._made:
            with suppress(TwinError):
                self._keep(sample, load_phantom(sample.name))
        return self._made.get(_key(sample)) or _box(sample)

    def _keep(self, sample: SampleState, phantom: Phantom) -> None:
        self._made[_key(sample)] = _skins(phantom)
        while len(self._made) > MAX_LOOKS:
            self._made.popitem(last=False)


def _skins(phantom: Phantom) -> SampleLook:
    """Make a phantom's look: one skin for each material, smooth up to a number of
    triangles.

    Holes are open (`_with_holes`); steel among other materials is marked as dense. Meshes of
    more than `MAX_FACES` triangles are not smoothed. Skins are in order of their
    materials' first part; unknown materials have `OTHER_COLOR`. Names have _ in place of
    other characters than letters and digits.

    Args:
        phantom: with parts and beads.
    """
    groups: dict[str, tuple[list[trimesh.Trimesh], list[trimesh.Trimesh]]] = {}
    for part in phantom.parts():
        groups.setdefault(part.material, ([], []))[part.hole].append(part.mesh)
    skins = []
    for material, (bodies, holes) in groups.items():
        mesh = _with_holes(bodies, holes)
        if len(mesh.faces) <= MAX_FACES:
            mesh = trimesh.graph.smooth_shade(mesh, angle=SMOOTH_RAD)
        vertices, faces = plain(mesh)
        name = "".join(c if c.isalnum() else "_" for c in material)
        dense = material == "steel" and len(groups) > 1
        named = materials().get(material)
        color = (named and named.color) or OTHER_COLOR
        skins.append(Skin(name, vertices, faces, color, dense))
    return SampleLook(tuple(skins), np.asarray(phantom.beads))


def _with_holes(
    bodies: list[trimesh.Trimesh], holes: list[trimesh.Trimesh]
) -> trimesh.Trimesh:
    """Join bodies of one material, without their holes.

    Where bodies overlap, or one stands in another's hole, there is no such body: all surfaces are
    joined then, holes turned inside out.
    """
    turned = [hole.copy() for hole in holes]
    for hole in turned:
        hole.invert()
    joined = cast("trimesh.Trimesh", trimesh.util.concatenate([*bodies, *turned]))
    if not holes or not bodies:
        return joined
    body = trimesh.util.concatenate(bodies)
    with suppress(ValueError):  # a mesh that is not closed
        cut = trimesh.boolean.difference([body, *holes], engine="manifold")
        if abs(cut.volume - joined.volume) < SAME_VOLUME * joined.volume:
            return cast("trimesh.Trimesh", cut)
    return joined


def _box(sample: SampleState) -> SampleLook:
    """Show a sample of which only the size is known as a box, marked as not exact;
    nothing without a size.

    The box is centered on the sample's origin and has no beads.
    """
    if sample.size_mm is None:
        return NOTHING
    vertices, faces = plain(trimesh.creation.box(extents=sample.size_mm))
    skin = Skin("size", vertices, faces, OTHER_COLOR, False)
    return SampleLook((skin,), np.zeros((0, 3)), exact=False)


async def fetch(ask: Ask, sample: SampleState) -> bytes | None:
    """Get the STL of the sample on the stage; None if the sample has changed or is too large.

    `ask` sends a request to the twin. None too if there is no mesh, and for every error of the
    twin.
    Raises ConnectionLost: the twin has gone.
    """
    try:
        told = await adrive(sample_shape(), lambda asked: ask(asked.method, asked.params))
    except RpcError:  # nothing on the stage any more, too large, or an older twin
        return None
    same = (told.name, told.revision) == (sample.name, sample.revision)
    return told.data or None if same else None
