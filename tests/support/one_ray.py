"""What stand-ins of a projector answer when they are asked how many rays a pixel needs."""

from __future__ import annotations

from typing import Any

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection.pixel_areas import Within


class OneRay:
    """A projector in whose images no edge reaches a pixel."""

    async def rays_needed(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int], need: Any
    ) -> Within:
        """Return no pixel."""
        return Within.joined([])

    async def paths_within(
        self, name: str, cone_vec: ConeVec, shape: tuple[int, int], within: Within
    ) -> Float32Array:
        """Return no rays, as no pixel needs several."""
        return np.zeros(int(within.starts[-1]), np.float32)
