"""A volume compared with the composition of its sample, where the twin knows that.

The truth is the phantom of the scan's record, at its place on the stage, at the energy at
which phantoms state their attenuation. The twin's hidden misalignment is not part of it
and is not read.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from flexdt.library.data_set import DataSet
from flexdt.phantoms import load_phantom
from flexdt.phantoms.placement import placed
from flexdt.phantoms.samples import is_shipped
from flexdt.phantoms.voxelise import voxelise
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Volume
from flexdt.twin.scanner.state import StagePlacement

Mask = npt.NDArray[np.bool_]
LEVELS: Final = 240
"""Number of bins of the attenuation's logarithm in which the sample's main material is
sought."""
VACUUM_PER_MM: Final = 1e-6
"""Less attenuation than any matter's [1/mm]."""
ALIKE_SHARE: Final = 0.1
"""Largest relative difference from the attenuation of the main material."""


def truth_of(dataset: DataSet, like: Volume) -> Float32Array:
    """Compute the sample's attenuation [1/mm] on the grid of a volume.

    Known are the phantoms that ship. Solids are averaged over two half voxels a side; the
    sample's place on the stage is that of the data set's document. Values are interpolated
    linearly, 0 outside the phantom, negative rounding errors clipped to 0. A voxel
    phantom is used as it is. Without a place in the document it is not shifted or turned.

    Args:
        dataset: its sample, and its place on the stage.
        like: the grid.

    Returns:
        (z, y, x) float32.

    Raises:
        TwinError: the sample is not known.
    """
    document = dataset.document
    if document is None:
        name = ""
    else:
        name = document.sample.name
    if not is_shipped(name):
        raise TwinError(
            f"{dataset.where}: what the sample {name!r} is made of is not known here; "
            "known: the phantoms of flexdt, in scans of the twin",
            {"asked": name, "allowed": "a phantom that ships with flexdt"},
        )
    phantom = load_phantom(name)
    stands = (document.sample.offset if document else None) or StagePlacement()
    back = stands.rotation.T
    shift = np.array([stands.x, stands.y, stands.z])
    if phantom.is_voxels:
        whole = phantom.volume()
        data = phantom.volume().data
        half = 0.0
    else:  # means over two voxels a side, centred half a voxel before the later one
        voxel = min(like.voxel_xyz)
        low, high = _seen(like, back, shift, voxel)
        reach = np.array(phantom.size_mm) / 2 + voxel
        low, high = np.maximum(low, -reach), np.minimum(high, reach)
        if (low >= high).any():
            return np.zeros(like.shape, np.float32)
        middle = (low + high) / 2
        around = placed(phantom, "keep", -middle)
        width, depth, height = (high - low).tolist()
        fine = voxelise(
            around.scene, around.surfaces, (width, depth, height), voxel / 2, 2
        )
        whole = replace(fine, center_mm=tuple(middle.tolist()))
        data = np.pad(whole.data, (1, 1))
        half = 0.5
        for axis in range(3):
            data = _means_of_pairs(data, axis)
    nz, ny, nx = like.shape
    axes = [
        (np.arange(n) - (n - 1) / 2) * step + center
        for n, step, center in zip(
            (nx, ny, nz), like.voxel_xyz, like.center_mm, strict=True
        )
    ]
    y, x = np.meshgrid(axes[1], axes[0], indexing="ij")
    out = np.zeros(like.shape, np.float32)
    ends = (np.array(whole.shape[::-1]) - 1) / 2
    for k, z in enumerate(
        axes[2]
    ):  # a layer at a time: places take six times as much as voxels
        seen = np.stack([x - shift[0], y - shift[1], np.full_like(x, z - shift[2])])
        inside = np.tensordot(back, seen, axes=1) - np.reshape(whole.center_mm, (3, 1, 1))
        at = (
            inside / np.reshape(whole.voxel_xyz, (3, 1, 1)) + ends.reshape(3, 1, 1) + half
        )
        out[k] = ndimage.map_coordinates(data, at[::-1], order=1, mode="constant")
    return np.maximum(out, 0.0, out=out)  # a hole leaves a rounding error


def _seen(
    like: Volume, back: FloatArray, shift: FloatArray, margin: float
) -> tuple[FloatArray, FloatArray]:
    """Compute the box (low and high corner [mm]) of a phantom that a grid holds.

    `back`: (3, 3) turn from the stage's frame to the phantom's; `shift`: its place on the
    stage [mm].
    """
    half = np.array(like.shape[::-1]) * like.voxel_xyz / 2
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    corners = (signs * half + like.center_mm - shift) @ back.T
    return corners.min(axis=0) - margin, corners.max(axis=0) + margin


def _means_of_pairs(data: Float32Array, axis: int) -> Float32Array:
    """Compute the means of neighbors along an axis, one fewer than there are."""
    along = np.moveaxis(data, axis, 0)
    means = along[:-1] + along[1:]
    means *= np.float32(0.5)
    return np.moveaxis(means, 0, axis)


def figures(values: Float32Array, truth: Float32Array, voxel_mm: float) -> dict[str, Any]:
    """Measure figures of a volume, and the same of the truth.

    The main material is where the truth is within `ALIKE_SHARE` (10 %) of its main level,
    without its outermost voxels where any remain. Solid is above half the level, measured
    and true alike. Voxels that no data cover are left out.

    Args:
        values: (z, y, x) [1/mm], not a number where no data cover.
        truth: of the same shape.
        voxel_mm: edge of a voxel, the same on all axes.

    Returns:
        Pairs [measured, true], None where it cannot be measured: `attenuation` of the
        main material [1/mm]; `void`, the part of the volume within its outlines, layer by
        layer, that is not solid; `x_mm`, `y_mm`, `z_mm` from face to face. And `rms`, the
        difference [1/mm] in the sample's box, 3 voxels wider on each side, or in all of a
        volume without solid voxels.
    """
    mu = main_level(truth)
    known = np.isfinite(values)
    alike = (np.abs(truth - mu) < ALIKE_SHARE * mu) & known
    inside = ndimage.binary_erosion(alike)
    if not inside.any():  # walls of a few voxels
        inside = alike
    if inside.any():
        seen_mu = float(values[inside].mean())
    else:
        seen_mu = math.nan
    solid = truth > mu / 2
    seen = known & (values > seen_mu / 2)
    enclosed = known & np.stack([ndimage.binary_fill_holes(layer) for layer in solid])
    whole = max(1, int(enclosed.sum()))
    box = ndimage.find_objects(solid.astype(np.int8))
    around = tuple(slice(max(0, s.start - 3), s.stop + 3) for s in box[0]) if box else ...
    apart = (values[around] - truth[around])[known[around]]
    if apart.size:
        rms = float(np.sqrt(np.mean(np.square(apart, dtype=np.float64))))
    else:
        rms = math.nan
    filled = np.where(known, values, 0.0)
    pairs = {
        "attenuation": (seen_mu, mu),
        "void": (
            1 - (seen & enclosed).sum() / whole,
            1 - (solid & enclosed).sum() / whole,
        ),
        **{
            f"{name}_mm": tuple(
                voxel_mm * extent(data, truth, axis, level, mu)
                for data, level in ((filled, seen_mu), (truth, mu))
            )
            for name, axis in (("x", 2), ("y", 1), ("z", 0))
        },
    }
    return {
        "rms": told(rms),
        **{name: [told(float(v)) for v in pair] for name, pair in pairs.items()},
    }


def told(value: float) -> float | None:
    """Convert a figure for JSON: NaN becomes None."""
    return value if math.isfinite(value) else None


def main_level(truth: Float32Array) -> float:
    """Find the attenuation of most of the sample [1/mm]: the median of the fullest
    logarithmic bin; partly filled voxels all differ. nan for an empty volume.

    Only values above `VACUUM_PER_MM` count, in `LEVELS` bins of the logarithm.
    """
    there = np.log(truth[truth > VACUUM_PER_MM].astype(np.float64))
    if not there.size:
        return math.nan
    counts, edges = np.histogram(there, LEVELS)
    most = int(np.argmax(counts))
    last = most == LEVELS - 1
    alike = (there >= edges[most]) & (
        (there <= edges[most + 1]) if last else there < edges[most + 1]
    )
    return float(np.exp(np.median(there[alike])))


def extent(
    values: Float32Array, truth: Float32Array, axis: int, seen: float, mu: float
) -> float:
    """Measure the extent from face to face along an axis, where the truth is widest
    [voxels].

    The profile is the median over all lines within a voxel of the widest, so that neither
    noise nor streaks count; its width is at half of `seen`, interpolated. nan without a
    solid voxel of the truth, or where the profile never exceeds that.

    `values`: measured, or the truth; `seen`: its main material's attenuation [1/mm], `mu`
    in the truth.
    """
    solid = np.moveaxis(truth, axis, -1) > mu / 2
    there = solid.any(axis=-1)
    if not there.any():
        return math.nan
    first = solid.argmax(axis=-1)
    last = solid.shape[-1] - 1 - solid[..., ::-1].argmax(axis=-1)
    widest = there & (last - first >= (last - first)[there].max() - 1)
    profile = np.pad(np.median(np.moveaxis(values, axis, -1)[widest], axis=0), 1)
    above = np.flatnonzero(profile > seen / 2)
    if not above.size:
        return math.nan
    ends = [
        (profile[k] - seen / 2) / (profile[k] - profile[k + step])
        for k, step in ((above[0], -1), (above[-1], 1))
    ]
    return float(above[-1] - above[0] + sum(ends))
