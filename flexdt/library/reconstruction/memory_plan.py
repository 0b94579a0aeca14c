"""The split of a reconstruction between memory and disk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from flexdt.twin.errors import LimitError
from flexdt.twin.projection import Grid

PART_IMAGES: Final = 16
"""Number of images processed at a time."""
WORKING_IMAGES: Final = 100
"""Largest working memory of FDK in addition to a slab, in images of four bytes a pixel
(measured with an object that is cut off: full_size.py --costs of 52ade1c)."""
KEPT_SHARE: Final = 0.25
"""Largest share of the memory for images that are needed again; above it they are on disk."""


@dataclass(frozen=True)
class MemoryPlan:
    """The division of FDK's work.

    Attributes:
        slabs: layers (first, last) of each.
        kept: images that are needed more than once.
        most_pixels: of an image that is kept.
        on_disk: whether they are in a file.
        prepared: whether images are prepared once, and kept for more passes than one.
    """

    slabs: tuple[tuple[int, int], ...]
    kept: int
    most_pixels: int
    on_disk: bool
    prepared: bool

    @property
    def disk_bytes(self) -> int:
        """Room on disk for the images."""
        if self.on_disk:
            return 4 * self.kept * self.most_pixels
        return 0


def plan_memory(
    grid: Grid,
    images: int,
    again: int,
    most_pixels: int,
    memory: int,
    *,
    least: bool = False,
) -> MemoryPlan:
    """Divide a volume into as few slabs as fit into the memory, and keep images there or
    on disk.

    With several slabs all images are kept, as prepared; with one, those that are needed
    `again`. `most_pixels`: of an image; `memory`: to use [bytes]; `least`: with too
    little, a slab for each layer.
    Raises LimitError: a layer and the images worked on (at most `WORKING_IMAGES`) need
    more; not with `least`.
    """
    work = 4 * most_pixels * min(WORKING_IMAGES, 12 * images)
    layer = grid.bytes // grid.shape[0]
    if memory < work + layer and not least:
        raise LimitError(
            f"memory of {memory / 2**20:.0f} MiB; FDK of a layer of {grid.shape[1]} x "
            f"{grid.shape[2]} voxels from images of {most_pixels} pixels takes "
            f"{(work + layer) / 2**20:.0f} MiB or more",
            {"asked": memory, "allowed": work + layer},
        )
    left = max(memory - work, layer)
    whole = _plan(grid, again, most_pixels, left)
    if not whole.prepared:
        return whole
    return _plan(grid, images, most_pixels, left)


def plan_whole(grid: Grid, again: int, most_pixels: int, memory: int) -> MemoryPlan:
    """Keep a volume in one piece, whatever the memory; arguments as for `plan_memory`."""
    on_disk = 4 * again * most_pixels > KEPT_SHARE * memory
    return MemoryPlan(((0, grid.shape[0]),), again, most_pixels, on_disk, prepared=False)


def _plan(grid: Grid, kept: int, most_pixels: int, memory: int) -> MemoryPlan:
    """Plan slabs, and whether kept images are on disk. They are on disk if they need more than
    KEPT_SHARE of the memory, or if the volume fits whole only without them. `prepared` (kept for
    several passes) is set for more than one slab. `grid`: of the volume; `kept`: number of kept
    images; `most_pixels`: of one image; `memory`: free bytes."""
    need = 4 * kept * most_pixels
    # Fewer slabs are better than images in memory: the file's parts are cached until
    # another program needs the memory.
    on_disk = need > KEPT_SHARE * memory or memory - need < grid.bytes <= memory
    slabs = grid.slabs(memory if on_disk else memory - need)
    return MemoryPlan(tuple(slabs), kept, most_pixels, on_disk, prepared=len(slabs) > 1)
