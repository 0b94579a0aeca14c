"""Soft shadows of parts of the machine on others below them, for every browser.

A shadow is a dark pad with soft edges on the lower part, which moves with the upper one.
It belongs to a GLB, whose translucent materials write no depth in any of viser's
versions.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from flexdt.clients.viewer.scenes.world import MM
from flexdt.twin.collision.stages import Body
from flexdt.twin.machine.description import Component

SIDE_PX: Final = 48
"""Number of rows and columns of a shadow's picture."""
MAX_OPACITY: Final = 0.55
"""Opacity of a shadow under the part itself."""
SPREAD_SHARE: Final = 0.16
"""Reach of a shadow beyond each side, over the part's own size."""
ABOVE_MM: Final = 0.8
"""Height of a shadow above the surface below it [mm]."""
TOUCHING_MM: Final = 12.0
"""Largest gap between two parts of which the upper one rests on the lower one [mm]."""


def standing(parts: Sequence[Component], bodies: Mapping[str, Body]) -> dict[str, float]:
    """List the parts that rest on another one, with the height of its top.

    Only parts that touch within `TOUCHING_MM` and do not rise against each other; the
    highest counts. Parts are boxes at their home places; they have to overlap in x and y.
    Parts on nothing are left out.

    Args:
        parts: of a machine.
        bodies: part -> its place and travel.

    Returns:
        part -> height of the other one's top in the part's own frame [mm].
    """
    low = {}
    high = {}
    for part in parts:
        middle = bodies[part.name].origin + np.asarray(part.center_mm)
        half = np.asarray(part.size_mm) / 2.0
        low[part.name] = middle - half
        high[part.name] = middle + half
    found: dict[str, float] = {}
    for part in parts:
        for other in parts:
            over = (low[part.name] < high[other.name])[:2] & (
                low[other.name] < high[part.name]
            )[:2]
            gap = low[part.name][2] - high[other.name][2]
            rises = bodies[part.name].slides[:, 2] - bodies[other.name].slides[:, 2]
            if over.all() and abs(gap) <= TOUCHING_MM and not rises.any():
                top = float(high[other.name][2] - bodies[part.name].origin[2])
                found[part.name] = max(top, found.get(part.name, top))
    return found


def shadow(part: Component, top_mm: float) -> bytes:
    """Make the shadow of a part as a GLB file [m], in the part's own frame.

    A transparent rectangle with soft edges, slightly larger than the part, just above the
    surface. The rectangle is larger by `SPREAD_SHARE` of the part's size on each side,
    and `ABOVE_MM` above the surface.

    Args:
        part: that casts it.
        top_mm: height of the surface below [mm].
    """
    width, depth, _ = (1.0 + 2.0 * SPREAD_SHARE) * np.asarray(part.size_mm)
    x, y, _ = part.center_mm
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, depth / 2] + [
        x,
        y,
    ]
    place = np.column_stack([corners, np.full(4, top_mm + ABOVE_MM)]) * MM
    mesh = trimesh.Trimesh(place, [[0, 1, 2], [0, 2, 3]], process=False)
    make: Any = PBRMaterial
    material = make(
        baseColorTexture=_soft(),
        alphaMode="BLEND",
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    visuals: Any = trimesh.visual.TextureVisuals
    mesh.visual = visuals(
        uv=np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), material=material
    )
    out = io.BytesIO()
    export: Any = trimesh.Scene(mesh).export
    export(out, file_type="glb", include_normals=True)
    return out.getvalue()


def _soft() -> Image.Image:
    """Draw the shadow's texture: a black square whose edges fade to transparent, RGBA
    (SIDE_PX, SIDE_PX).

    The opacity is `MAX_OPACITY` under the part itself and falls smoothly to 0 at the
    border.
    """
    at = np.abs((np.arange(SIDE_PX) + 0.5) / SIDE_PX * 2.0 - 1.0)
    inner = 1.0 / (1.0 + 2.0 * SPREAD_SHARE)
    share = np.clip((1.0 - at) / (1.0 - inner), 0.0, 1.0)
    smooth = share**2 * (3.0 - 2.0 * share)
    rgba = np.zeros((SIDE_PX, SIDE_PX, 4), dtype=np.uint8)
    rgba[..., 3] = np.round(255.0 * MAX_OPACITY * np.outer(smooth, smooth))
    return Image.fromarray(rgba)
