"""A phantom taken apart by material: what the X-rays of each energy need to know of it.

Line integrals at one energy add up whatever the material; a spectrum needs the path through each.
A solid may stand for a difference ("this bead instead of that plastic"): it is recognised by its
attenuation and becomes one material in and the other out. It refuses to invent a composition: what
has none (voxels of attenuation) is taken as water of matching attenuation, and says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexdt.phantoms.materials import Material, material, materials
from flexdt.phantoms.model import Phantom
from flexdt.phantoms.voxelise import voxelise
from flexdt.twin.errors import UnknownNameError
from flexdt.twin.projection import Volume
from flexdt.twin.projection.shapes import Scene, Solid

SAME = 1e-6
"""Relative difference of attenuations that count as equal."""
STAND_IN = "water"
"""For what has an attenuation but no composition."""


@dataclass(frozen=True, eq=False)
class Channel:
    """One material of a phantom.

    Attributes:
        material: which.
        body: where it is: projecting it gives the path length [mm] (values and `mu_per_mm` are
            amounts relative to the material's own density).
        thickest_mm: no path through it is longer [mm].
        assumed: what is not known about it.
    """

    material: Material
    body: Scene | Volume
    thickest_mm: float
    assumed: str = ""


def channels(phantom: Phantom) -> tuple[Channel, ...]:
    """The phantom's materials and where they are; empty for a phantom of nothing."""
    amounts: dict[str, list[Solid]] = {}
    stand_ins: set[str] = set()
    known = {name: one for name, one in _known(phantom).items() if one is not None}
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
            "materials without composition are taken as water" if name in stand_ins else "",
        )
        for name, solids in amounts.items()
    ]
    if phantom.surface is not None:
        made_of = material(phantom.surface.material)
        grid = voxelise(Scene(()), phantom.surface, phantom.size_mm, phantom.default_voxel_mm, 2)
        out.append(Channel(made_of, _scaled(grid, made_of), longest))
    if phantom.voxels is not None:
        made_of = material(STAND_IN)
        whole = Phantom(
            phantom.name, "", Scene(()), phantom.size_mm, voxels=phantom.voxels
        ).volume()
        density = _scaled(whole, made_of)
        thick = longest * max(1.0, float(np.abs(density.data).max()))
        out.append(Channel(made_of, density, thick, "voxels are taken as water of varying density"))
    return tuple(out)


def _known(phantom: Phantom) -> dict[str, Material | None]:
    names = dict.fromkeys(s.material for s in phantom.scene.solids)
    return {name: _find(name) for name in names}


def _find(name: str) -> Material | None:
    try:
        return material(name)
    except UnknownNameError:
        return None


def _amounts(solid: Solid, known: dict[str, Material]) -> list[tuple[str, float]]:
    """Material -> amount of it (1: its own density) that a solid adds."""
    own = known.get(solid.material)
    if own is None:
        return [(STAND_IN, solid.mu_per_mm / materials()[STAND_IN].mu_per_mm)]
    amount = solid.mu_per_mm / own.mu_per_mm
    if abs(abs(amount) - 1.0) <= SAME:
        return [(own.name, round(amount))]
    for other in known.values():
        difference = own.mu_per_mm - other.mu_per_mm
        if other is not own and abs(solid.mu_per_mm - difference) <= SAME * own.mu_per_mm:
            return [(own.name, 1.0), (other.name, -1.0)]
    return [(own.name, amount)]


def _scaled(volume: Volume, made_of: Material) -> Volume:
    return volume.like(volume.data / np.float32(made_of.mu_per_mm))
