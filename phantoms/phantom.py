"""The phantom as a frozen value: one object for X-rays and for the scene, with one origin.

`scene` holds analytic solids (exact for X-rays), `surface` a triangle mesh and `voxels` a
ready volume. Whichever are present share the object's frame, centered on the rotation axis
at the sample's reference height. `mesh()` and `volume()` derive the other representation
on demand, so that the two cannot drift apart; derived arrays are not kept.

`assemble` makes several phantoms one: their solids and meshes together, each at its
place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import PlainSerializer, PlainValidator, ValidationError

from flexdt.phantoms import checked_reading as reading
from flexdt.phantoms.checked_reading import PhantomError, scene_from_dict, scene_to_dict
from flexdt.phantoms.mesh_booleans import cut
from flexdt.phantoms.pieces import Surface, Voxels, boxes, freeze
from flexdt.phantoms.solid_meshes import SurfacePart, joined, parts_of
from flexdt.phantoms.voxelise import as_volume, voxelise
from flexdt.twin.calibration.bead_model import Tolerance
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection import Volume
from flexdt.twin.projection.analytic_solids import Scene
from flexdt.twin.values import ArrayValue, adapter_of, document_errors

if TYPE_CHECKING:
    import trimesh

SCHEMA = 1
"""Version of the document of `to_dict`."""

VOXELS_ALONG_LONGEST = 256
"""Voxels along the longest side in `volume()` by default."""


_Scene = Annotated[
    Scene,
    PlainValidator(partial(scene_from_dict, where="phantom.scene")),
    PlainSerializer(scene_to_dict, when_used="json"),
]
_LIST = PlainSerializer(np.ndarray.tolist, when_used="json")
_PLACES = PlainValidator(
    partial(reading.each, where="phantom.beads", read=reading.vector)
)
_RADII = PlainValidator(
    partial(reading.each, where="phantom.bead_radius_mm", read=reading.positive)
)


_Tolerance = Annotated[
    Tolerance,
    PlainValidator(partial(reading.tolerance, where="phantom.tolerance")),
    PlainSerializer(reading.tolerance_document, when_used="json"),
]


@dataclass(frozen=True, eq=False)
class Phantom(ArrayValue):
    """A named object to scan.

    Attributes:
        name: as the command line and the wire name it.
        description: one line for people.
        scene: analytic solids, additive; may be empty.
        size_mm: full extent along x, y, z [mm], centered on the origin.
        beads: float64 (k, 3) bead centers [mm], object frame, read-only; k may be 0.
        bead_radius_mm: float64 (k,) [mm], read-only.
        assumed: facts without a public source.
        tolerance: how well the places of its beads are known; None: not stated.
        surfaces: filled triangle meshes, for a phantom that came as one or several.
        voxels: ready grid, for a phantom that came as one.
    """

    name: reading.Text
    description: reading.Text
    scene: _Scene
    size_mm: reading.Lengths
    beads: Annotated[FloatArray, _PLACES, _LIST] = field(
        default_factory=lambda: np.zeros((0, 3))
    )
    bead_radius_mm: Annotated[FloatArray, _RADII, _LIST] = field(
        default_factory=lambda: np.zeros(0)
    )
    assumed: tuple[reading.Text, ...] = ()
    surfaces: tuple[Surface, ...] = ()
    voxels: Voxels | None = None
    tolerance: _Tolerance | None = None

    def __post_init__(self) -> None:
        """Copy beads (k, 3) and their radii (k,) [mm] as read-only float64.

        Raises:
            PhantomError: their numbers differ, a position or size is not finite (radii are
                not checked for that), or tolerances are not one for each bead.
        """
        beads = np.array(self.beads, dtype=np.float64).reshape(-1, 3)
        radii = np.array(self.bead_radius_mm, dtype=np.float64).reshape(-1)
        if len(radii) != len(beads):
            raise PhantomError(f"{self.name}: {len(beads)} beads but {len(radii)} radii")
        if not (np.isfinite(beads).all() and np.isfinite(self.size_mm).all()):
            raise PhantomError(f"{self.name}: positions and sizes must be finite")
        own = None if self.tolerance is None else self.tolerance.bead_mm
        if isinstance(own, tuple) and len(own) != len(beads):
            raise PhantomError(
                f"{self.name}: {len(beads)} beads but {len(own)} tolerances of beads"
            )
        freeze(self, beads=beads, bead_radius_mm=radii)

    def __repr__(self) -> str:
        """Format as one line: name, size [mm] and description."""
        size = " x ".join(f"{side:g}" for side in self.size_mm)
        return f"<Phantom {self.name!r}: {size} mm, {self.description}>"

    @property
    def is_analytic(self) -> bool:
        """Whether `scene` alone is the complete object for X-rays (no voxels needed)."""
        return not self.surfaces and self.voxels is None

    @property
    def is_voxels(self) -> bool:
        """Whether a ready grid alone is the complete object."""
        return self.voxels is not None and not self.surfaces and not self.scene.solids

    @property
    def default_voxel_mm(self) -> float:
        """Voxel edge of `volume()` by default [mm]."""
        return max(self.size_mm) / VOXELS_ALONG_LONGEST

    @property
    def bounding_radius_mm(self) -> float:
        """Radius about the origin that contains the phantom [mm]."""
        return float(np.linalg.norm(np.asarray(self.size_mm) / 2.0))

    @property
    def boxes(self) -> FloatArray:
        """Low and high corner of the box around each part, (k, 2, 3) [mm]."""
        return np.array(boxes(self.scene, self.surfaces, self.voxels)).reshape(-1, 2, 3)

    def parts(self) -> tuple[SurfacePart, ...]:
        """Make one closed mesh for each piece, with its material."""
        return parts_of(self.scene, self.surfaces, self.voxels, self.beads)

    def mesh(self, *, around: bool = False) -> trimesh.Trimesh:
        """Join all surfaces into one mesh, holes turned inside out [mm, object frame].

        A bead inside a body appears as a surface of its own inside the body's.

        Args:
            around: for collisions: the polyhedra of round solids hold them, instead of
                lying inside them.
        """
        pieces = self.scene, self.surfaces, self.voxels
        return joined(parts_of(*pieces, self.beads, around=around))

    def volume(self, voxel_mm: float | None = None, *, oversample: int = 2) -> Volume:
        """Convert to voxels of attenuation [1/mm], [z, y, x], about the origin.

        A phantom that came as voxels keeps its own grid, whatever the arguments.
        `voxel_mm`: default: 256 along the longest side. Raises PhantomError: voxels
        together with other parts, or as `voxelise`.
        """
        if self.voxels is not None:
            if not self.is_voxels:
                raise PhantomError(
                    f"{self.name}: voxels cannot be put together with other parts"
                )
            return as_volume(self.voxels)
        if voxel_mm is None:
            voxel = self.default_voxel_mm
        else:
            voxel = voxel_mm
        return voxelise(self.scene, self.surfaces, self.size_mm, voxel, oversample)

    def to_dict(self) -> dict[str, object]:
        """Convert to a JSON-able document with its schema; `from_dict` makes an equal phantom.

        Values that are None, and empty surfaces and materials, are left out.
        """
        document = adapter_of(Phantom).dump_python(self, mode="json", exclude_none=True)
        for place, name in (
            (document, "surfaces"),
            (document.get("voxels", {}), "materials"),
        ):
            if not place.get(name):  # left out where there are none
                place.pop(name, None)
        return {"schema": SCHEMA, **document}

    @classmethod
    def from_dict(cls, document: object) -> Phantom:
        """Make a phantom from a document of `to_dict`.

        A document of version 0.2.0, with one `surface`, is read as well; a missing
        description is empty.

        Raises:
            PhantomError: names the key path, the value and the allowed ones.
        """
        doc = {"description": "", **reading.mapping(document, "phantom")}
        if reading.get(doc, "schema", "phantom") != SCHEMA:
            raise reading.wrong(doc["schema"], "phantom.schema", str(SCHEMA))
        if "surface" in doc:  # one: as 0.2.0 wrote it
            doc["surfaces"] = [doc["surface"]]
        try:
            phantom: Phantom = adapter_of(Phantom).validate_python(doc)
        except ValidationError as error:
            raise PhantomError(*document_errors("phantom", error)) from None
        return phantom


def assemble(
    name: str,
    parts: Sequence[Phantom],
    description: str = "",
    priority: Sequence[float] = (),
) -> Phantom:
    """Join several phantoms; attenuation adds up where they overlap.

    The size is the largest of the parts' along each axis; beads are joined in order, and
    each assumption is kept once.

    Args:
        name: of the whole.
        parts: solids and meshes, in one object frame.
        description: one line; default: the parts' names.
        priority: of each part; where they overlap, the one of the highest is there alone,
            and equal ones add up. Meshes, boxes and convex solids can be cut. Default:
            all alike.

    Returns:
        The phantom; one part alone is renamed.

    Raises:
        PhantomError: there are no parts, another number of priorities, one of several
            parts is voxels, or one cannot be cut.
    """
    _require_joinable(name, parts, priority)
    if len(parts) == 1:
        return replace(
            parts[0], name=name, description=description or parts[0].description
        )
    scene = Scene(tuple(solid for p in parts for solid in p.scene.solids))
    surfaces = tuple(surface for p in parts for surface in p.surfaces)
    if len(set(priority)) > 1:
        ranked = zip(parts, priority, strict=True)
        scene, surfaces = cut([(p.scene, p.surfaces, rank) for p, rank in ranked])
    x, y, z = np.max([p.size_mm for p in parts], axis=0).tolist()
    return Phantom(
        name,
        description or " + ".join(p.name for p in parts),
        scene,
        (x, y, z),
        np.concatenate([p.beads for p in parts]),
        np.concatenate([p.bead_radius_mm for p in parts]),
        tuple(dict.fromkeys(line for p in parts for line in p.assumed)),
        surfaces,
    )


def _require_joinable(
    name: str, parts: Sequence[Phantom], priority: Sequence[float]
) -> None:
    """Check that phantoms can be one: that there are some, with a priority each or none,
    and that voxels stand alone.

    Raises:
        PhantomError: they cannot.
    """
    if priority and len(priority) != len(parts):
        raise PhantomError(
            f"{name}: {len(priority)} priorities for {len(parts)} parts",
            {"asked": len(priority), "allowed": len(parts)},
        )
    if not parts:
        raise PhantomError(
            f"{name}: there is nothing in it", {"asked": 0, "allowed": "1 or more"}
        )
    grids = [p.name for p in parts if p.voxels is not None]
    if grids and len(parts) > 1:
        raise PhantomError(
            f"{name}: voxels ({', '.join(grids)}) stand for a whole sample and cannot be put "
            "together with other parts",
            {"asked": grids, "allowed": "solids and meshes"},
        )
