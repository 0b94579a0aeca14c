"""A phantom taken apart by material, for projections with a spectrum and for scatter.

Line integrals at one energy add up whatever the material is; a spectrum needs the path
through each material. A solid may be a difference ("this bead instead of that plastic"):
it is recognized by its attenuation and becomes one material in and the other out. Voxels
of attenuation without a material are treated as water of matching attenuation, which the
result mentions.

Scatter is simulated in a coarse grid of material amounts. For it solids and closed meshes
are sampled as for any voxel phantom, ready voxels are averaged; each keeps its mass, so
that a bead smaller than a voxel still attenuates and scatters as much.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexdt.phantoms.mesh_booleans import united
from flexdt.phantoms.phantom import Phantom
from flexdt.phantoms.pieces import Surface
from flexdt.phantoms.voxelise import as_volume, voxelise
from flexdt.twin.attenuation.materials import Material, material, materials
from flexdt.twin.errors import GeometryError, UnknownNameError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.physics.chain import Chain
from flexdt.twin.physics.detector import Detector
from flexdt.twin.physics.scatter import Object
from flexdt.twin.physics.tube import TubeModel
from flexdt.twin.projection import Body, TriangleMesh, Volume, project_body
from flexdt.twin.projection.analytic_solids import Scene, Solid, Vector

ATTENUATION_TOLERANCE = 1e-6
"""Largest relative difference of attenuations that count as equal."""
STAND_IN = "water"
"""Material assumed for a body that has an attenuation but no composition."""
SUB_COLUMNS = 8
"""Samples of solids and meshes along x and y in each voxel; along z their ends are exact."""


@dataclass(frozen=True, eq=False)
class Channel:
    """One material of a phantom.

    Attributes:
        material: which.
        body: where it is: `project_body` gives the path length [mm] (values and
            `mu_per_mm` are amounts relative to the material's own density).
        thickest_mm: no path through it is longer [mm].
        assumed: assumption about it.
    """

    material: Material
    body: Body
    thickest_mm: float
    assumed: str = ""


def channels(phantom: Phantom) -> tuple[Channel, ...]:
    """Divide a phantom into its materials and where they are; empty for a
    phantom of nothing.

    Voxels without labels are one channel of their material, or of water of varying
    density; such stand-ins are stated in the channel.

    Args:
        phantom: solids, surfaces and voxels.

    Returns:
        A channel for each material of solids, each surface and each label of voxels; a
        material without composition is taken as water.
    """
    amounts: dict[str, list[Solid]] = {}
    stand_ins: set[str] = set()
    names = dict.fromkeys(solid.material for solid in phantom.scene.solids)
    known = {name: one for name in names if (one := _find(name)) is not None}
    for solid in phantom.scene.solids:
        for name, amount in _amounts(solid, known):
            amounts.setdefault(name, []).append(Solid(solid.shape, name, amount))
        if solid.material not in known:
            stand_ins.add(STAND_IN)
    longest = 2.0 * phantom.bounding_radius_mm
    out = [
        Channel(
            material(name),
            Scene(tuple(solids)),
            longest * max(1.0, *(abs(s.mu_per_mm) for s in solids)),
            "materials without composition are taken as water"
            if name in stand_ins
            else "",
        )
        for name, solids in amounts.items()
    ]
    for surface in phantom.surfaces:
        made_of = material(surface.material)
        out.append(Channel(made_of, _mesh(phantom, surface, made_of), longest))
    if phantom.voxels is not None and phantom.voxels.labels is not None:
        volume = as_volume(phantom.voxels)
        for label, name in enumerate(phantom.voxels.materials, 1):
            part = volume.like((phantom.voxels.labels == label).astype(np.float32))
            out.append(Channel(material(name), part, longest))
    elif phantom.voxels is not None:
        made_of = material(phantom.voxels.material or STAND_IN)
        density = _scaled(as_volume(phantom.voxels), made_of)
        thick = longest * max(1.0, float(np.abs(density.data).max()))
        known_as = "voxels are taken as water of varying density"
        if phantom.voxels.material:
            known_as = ""
        out.append(Channel(made_of, density, thick, known_as))
    return tuple(out)


def chain_through(
    parts: Sequence[Channel],
    panel: Detector,
    tube: TubeModel,
    mono_keV: float | None = None,
) -> Chain:
    """Make the chain from the paths through these materials to counts.

    `parts`: of `channels`. `mono_keV`: of all photons; None: the full spectrum.
    """
    return Chain(
        panel,
        tube,
        tuple(p.material.substance for p in parts),
        tuple(p.thickest_mm for p in parts),
        mono_keV,
    )


def attenuating(phantom: Phantom) -> tuple[tuple[Body, float], ...]:
    """List the bodies whose projections, times a factor each, add up to the phantom's
    line integrals.

    Factors are 1, or a mesh's attenuation [1/mm].

    Args:
        phantom: solids, surfaces and voxels.

    Returns:
        (body, factor): all solids as one scene; each mesh, as voxels where it cannot be
        projected exactly; the voxels.
    """
    out: list[tuple[Body, float]] = []
    if phantom.scene.solids:
        out.append((phantom.scene, 1.0))
    for surface in phantom.surfaces:
        mesh = _exact(surface)
        if mesh is not None:
            out.append((mesh, surface.mu_per_mm))
        else:
            grid = voxelise(
                Scene(()), (surface,), phantom.size_mm, phantom.default_voxel_mm, 2
            )
            out.append((grid, 1.0))
    if phantom.voxels is not None:
        out.append((as_volume(phantom.voxels), 1.0))
    return tuple(out)


def line_integrals(
    phantom: Phantom, cone_vec: ConeVec, shape: tuple[int, int]
) -> Float32Array:
    """Compute the attenuation along every ray at the energy at which phantoms state it.

    Args:
        phantom: solids and closed meshes are exact, ready voxels as they are.
        cone_vec: n views in the phantom's frame.
        shape: detector (rows, cols).

    Returns:
        float32 (n, rows, cols), dimensionless.

    Example:
        >>> from flexdt.phantoms import load_phantom
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> image = line_integrals(load_phantom("lego"), view, (64, 64))
        >>> image.shape, bool(image.max() > 0.5)
        ((1, 64, 64), True)
    """
    total = np.zeros((len(cone_vec), *shape), np.float32)
    for body, factor in attenuating(phantom):
        total += np.float32(factor) * project_body(body, cone_vec, shape)
    return total


def _exact(surface: Surface) -> TriangleMesh | None:
    """Convert the surface to an exact mesh, overlapping bodies united.

    None if open, or if it meets itself.
    """
    try:
        return united(TriangleMesh(surface.vertices, surface.faces.astype(np.int64)))
    except GeometryError:
        return None


def _mesh(phantom: Phantom, surface: Surface, made_of: Material) -> Body:
    """Convert a surface to the body of its material, 1 where it has its own density.

    Returns voxels where the mesh is not exact, or its attenuation differs from the
    material's by more than `ATTENUATION_TOLERANCE` of it.
    """
    mesh = _exact(surface)
    if (
        mesh is not None
        and abs(surface.mu_per_mm / made_of.mu_per_mm - 1.0) <= ATTENUATION_TOLERANCE
    ):
        return mesh
    grid = voxelise(Scene(()), (surface,), phantom.size_mm, phantom.default_voxel_mm, 2)
    return _scaled(grid, made_of)


def _find(name: str) -> Material | None:
    """Look up a material; None if it is unknown, LimitError for a wrong formula."""
    try:
        return material(name)
    except UnknownNameError:
        return None


def _amounts(solid: Solid, known: dict[str, Material]) -> list[tuple[str, float]]:
    """List (material, amount) that a solid adds, 1 for the material's own density.

    A material without composition counts as water of the same attenuation; an amount
    within `ATTENUATION_TOLERANCE` of 1 or -1 is exactly that.

    Args:
        solid: with its attenuation.
        known: material's name -> material with composition.

    Returns:
        One entry; two, 1 and -1, where the solid's attenuation is the difference of its
        material's and another known one's.
    """
    made_of = known.get(solid.material)
    if made_of is None:
        return [(STAND_IN, solid.mu_per_mm / materials()[STAND_IN].mu_per_mm)]
    amount = solid.mu_per_mm / made_of.mu_per_mm
    if abs(abs(amount) - 1.0) <= ATTENUATION_TOLERANCE:
        return [(made_of.name, round(amount))]
    for other in known.values():
        difference = made_of.mu_per_mm - other.mu_per_mm
        if (
            other is not made_of
            and abs(solid.mu_per_mm - difference)
            <= ATTENUATION_TOLERANCE * made_of.mu_per_mm
        ):
            return [(made_of.name, 1.0), (other.name, -1.0)]
    return [(made_of.name, amount)]


def _scaled(volume: Volume, made_of: Material) -> Volume:
    """Convert a volume of attenuation to amounts of a material."""
    return volume.like(volume.data / np.float32(made_of.mu_per_mm))


def scatter_object(parts: Sequence[Channel], size_mm: Vector, voxels: int) -> Object:
    """Sample the materials of a phantom on one grid about the origin.

    Negative amounts count as 0. A side of the box is 1e-3 of the longest at least.

    Args:
        parts: from `channels`.
        voxels: about so many cubes fill the box.

    Returns:
        Amounts, float32 (z, y, x, materials), and the substances.

    Raises:
        PhantomError: a mesh that is not closed.

    Example:
        >>> from flexdt.phantoms import load_phantom
        >>> lego = load_phantom("lego")
        >>> [one.name for one in scatter_object(channels(lego), lego.size_mm, 20_000).substances]
        ['abs', 'steel']
    """
    least = max(size_mm) * 1e-3
    box = (max(size_mm[0], least), max(size_mm[1], least), max(size_mm[2], least))
    edge = (math.prod(box) / voxels) ** (1.0 / 3.0)
    empty = voxelise(Scene(()), (), box, edge, 1)
    amounts = [
        np.maximum(_fractions_filled(part.body, empty, box), 0.0) for part in parts
    ]
    if amounts:
        data = np.stack(amounts, axis=-1)
    else:
        data = np.zeros((*empty.data.shape, 0), np.float32)
    return Object(
        np.ascontiguousarray(data, dtype=np.float32),
        empty.voxel_xyz,
        empty.center_mm,
        tuple(part.material.substance for part in parts),
    )


def _fractions_filled(body: Body, grid: Volume, box: Vector) -> Float32Array:
    """Sample a body on a coarse grid: the part of each voxel that it fills, float32 (z,
    y, x).

    Solids and meshes are sampled by sub-columns, fine voxels by exact overlap; voxels are
    cubes.

    Args:
        body: scene, mesh or fine voxels.
        grid: the coarse grid.
        box: its extent along x, y, z [mm].
    """
    edge = grid.voxel_xyz[0]
    if isinstance(body, Scene):
        return voxelise(body, (), box, edge, SUB_COLUMNS).data
    if not isinstance(body, Volume):
        surface = Surface(body.vertices, body.faces.astype(np.int32), "", 1.0)
        return voxelise(Scene(()), (surface,), box, edge, SUB_COLUMNS).data
    # The part of each coarse voxel that each fine one fills, axis by axis.
    x, y, z = (_overlaps(body, grid, axis) for axis in range(3))
    coarse = np.einsum("cz,zyx->cyx", z, body.data, optimize=True)
    coarse = np.einsum("cy,zyx->zcx", y, coarse, optimize=True)
    return np.asarray(
        np.einsum("cx,zyx->zyc", x, coarse, optimize=True), dtype=np.float32
    )


def _overlaps(fine: Volume, coarse: Volume, axis: int) -> FloatArray:
    """Compute which part of a coarse voxel's edge each fine one covers along an axis.

    Args:
        fine: grid of the fine voxels.
        coarse: grid of the coarse ones, in the same frame.
        axis: 0 for x, 1 for y, 2 for z.

    Returns float64 (coarse voxels, fine voxels): shares of the coarse edge, 0 to 1.
    """

    def planes(volume: Volume) -> FloatArray:
        """Compute the planes between the voxels of a volume [mm]."""
        n = volume.data.shape[2 - axis]
        edge = volume.voxel_xyz[axis]
        return np.asarray((np.arange(n + 1) - n / 2.0) * edge + volume.center_mm[axis])

    a, b = planes(coarse), planes(fine)
    high = np.minimum(a[1:, None], b[None, 1:])
    low = np.maximum(a[:-1, None], b[None, :-1])
    return np.asarray(np.maximum(high - low, 0.0) / coarse.voxel_xyz[axis])
