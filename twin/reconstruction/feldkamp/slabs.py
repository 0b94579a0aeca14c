"""Layers of a volume that are worked on one slab after another."""

from __future__ import annotations

from dataclasses import replace

from flexdt.twin.projection import Volume


def layers(volume: Volume, first: int, last: int) -> Volume:
    """Take layers first <= z < last of a volume, as a view; nothing is copied."""
    x, y, z = volume.center_mm
    middle = z + ((first + last) / 2 - volume.shape[0] / 2) * volume.voxel_xyz[2]
    return replace(volume, data=volume.data[first:last], center_mm=(x, y, middle))
