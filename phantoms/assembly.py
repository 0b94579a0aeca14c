"""Several phantoms as one: their solids and meshes together, each where it stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexdt.phantoms.phantom import Phantom
from flexdt.phantoms.pieces import PhantomError
from flexdt.twin.projection.analytic_solids import Scene


def assemble(name: str, parts: Sequence[Phantom], description: str = "") -> Phantom:
    """One phantom of several; attenuation adds up where they overlap.

    Args:
        name: of the whole.
        parts: solids and meshes, in one object frame.
        description: one line; default: the parts' names.

    Raises:
        PhantomError: there are none, or one of several is voxels.
    """
    if not parts:
        raise PhantomError(f"{name}: there is nothing in it", {"asked": 0, "allowed": "1 or more"})
    if len(parts) == 1:
        return replace(parts[0], name=name, description=description or parts[0].description)
    grids = [p.name for p in parts if p.voxels is not None]
    if grids:
        raise PhantomError(
            f"{name}: voxels ({', '.join(grids)}) stand for a whole sample and cannot be put "
            "together with other parts",
            {"asked": grids, "allowed": "solids and meshes"},
        )
    x, y, z = np.max([p.size_mm for p in parts], axis=0).tolist()
    return Phantom(
        name,
        description or " + ".join(p.name for p in parts),
        Scene(tuple(solid for p in parts for solid in p.scene.solids)),
        (x, y, z),
        np.concatenate([p.beads for p in parts]),
        np.concatenate([p.bead_radius_mm for p in parts]),
        tuple(dict.fromkeys(line for p in parts for line in p.assumed)),
        tuple(surface for p in parts for surface in p.surfaces),
    )
