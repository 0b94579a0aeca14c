"""The sample on the stage, as coloured meshes: one for each material.

Shipped phantoms are made from their names; meshes of uploads come from the twin (see
`uploaded_meshes`). Until an upload's mesh has arrived, and where it has too many triangles to send,
a box of its size stands in.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt
import trimesh

from flexdt.clients.viewer.scenes.drawn_solids import SMOOTH_RAD, plain
from flexdt.phantoms import Phantom, PhantomError, load_phantom, mesh_phantom
from flexdt.protocol.state_model import SampleState
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray

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
class Look:
    """A sample as the scene needs it.

    Attributes:
        skins: its meshes.
        beads: (k, 3) [mm], the sample's own frame.
        exact: whether this is the sample's shape, or only a box of its size.
    """

    skins: tuple[Skin, ...]
    beads: FloatArray
    exact: bool = True


DEFAULT_MATERIAL = "abs"
Key = tuple[str | None, str | None, str | None]

NOTHING = Look((), np.zeros((0, 3)))


def _key(sample: SampleState) -> Key:
    return sample.name, sample.revision, sample.material


class Wardrobe:
    """Looks of samples, made once each."""

    def __init__(self) -> None:
        self._uploads: OrderedDict[Key, Phantom] = OrderedDict()
        self._known: OrderedDict[tuple[object, ...], Look] = OrderedDict()

    def lacks(self, sample: SampleState) -> bool:
        """Whether the sample is an upload whose mesh has not arrived yet."""
        return sample.revision is not None and _key(sample) not in self._uploads

    def add(self, sample: SampleState, stl: bytes) -> None:
        """The shape of an upload.

        Raises:
            TwinError: it is no mesh.
        """
        self._uploads[_key(sample)] = mesh_phantom(
            stl,
            material=sample.material or DEFAULT_MATERIAL,
            file_type="stl",
            name=sample.name,
            place="keep",
        )
        while len(self._uploads) > KEPT:
            self._uploads.popitem(last=False)
        for key in [k for k in self._known if k[0] == sample.name]:
            del self._known[key]

    def look(self, sample: SampleState) -> Look:
        """How `sample` looks; it may take a second."""
        if sample.name is None:
            return NOTHING
        key = (*_key(sample), sample.size_mm)
        if key not in self._known:
            self._known[key] = self._make(sample)
            while len(self._known) > KEPT:
                self._known.popitem(last=False)
        return self._known[key]

    def phantom(self, sample: SampleState) -> Phantom | None:
        """The phantom behind a sample; None for an empty stage or an unknown upload."""
        if sample.name is None or sample.revision is not None:
            return self._uploads.get(_key(sample))
        try:
            return load_phantom(sample.name)
        except (TwinError, PhantomError):
            return None

    def _make(self, sample: SampleState) -> Look:
        phantom = self.phantom(sample)
        return _box(sample) if phantom is None else _skins(phantom)


def _skins(phantom: Phantom) -> Look:
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
        skins.append(
            Skin(name, vertices, faces, COLORS.get(material, OTHER), _dense(material, groups))
        )
    return Look(tuple(skins), np.asarray(phantom.beads))


def _dense(material: str, groups: Mapping[str, object]) -> bool:
    return material == "steel" and len(groups) > 1


def _box(sample: SampleState) -> Look:
    if sample.size_mm is None:
        return NOTHING
    vertices, faces = plain(trimesh.creation.box(extents=sample.size_mm))
    skin = Skin("size", vertices, faces, OTHER, False)
    return Look((skin,), np.zeros((0, 3)), exact=False)
