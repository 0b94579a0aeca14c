"""How sharp a volume is: widths of its edges, details that two half scans share, edges that
opposite views show at different places."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.volume import Sharpness, Volume, Width
from flexdt.twin.reconstruction.edge_profiles import edges_of
from flexdt.twin.reconstruction.feldkamp.half_scans import HalfScans

ACROSS: Final = 0.4
ALONG: Final = 0.9
"""Largest share of the axis in the normal of an edge across the layers, and least share in
that of one along the axis."""
RING_WIDTH: Final = 2.0
"""Width of a ring of the spectrum, in steps of it."""
MIN_RING: Final = 2
"""First ring of the spectrum that is looked at: the others hold the object's outline."""
MIN_SIDE: Final = 16
"""Least voxels along a side of a plane whose spectrum is compared."""
BANDS: Final = (0.5, 3.0)
"""Standard deviations of two Gaussians, whose difference leaves edges [voxels]."""
HIGH_PARTS: Final = 2
WIDE_PARTS: Final = 8
"""Parts of a plane along z and x, each of which may be displaced by itself."""
MIN_PART_SHARE: Final = 0.01
"""Least share of a plane's edges that a part has."""
SHIFT_STEPS: Final = 5
MAX_SHIFT: Final = 4.0
"""Steps in which a shift is found, and the largest [voxels]."""


def sharpness_of(volume: Volume) -> Sharpness:
    """Measure the sharpness of a volume.

    Args:
        volume: any; of FDK with its errors, also by half scans.
    """
    voxel = _edge_mm(volume)
    across, along = widths_of(volume)
    noise: Any = getattr(volume, "_noise", None)  # of `volume_errors.with_errors`
    bias: Any = getattr(volume, "_bias", None)
    halves: HalfScans | None = getattr(noise, "half_scans", None)
    measured = None if halves is None else displacement(halves)
    distance, error = (None, None) if measured is None else measured
    cause, told = ("", 0.0) if bias is None else bias.doubling()
    if cause and told > (distance or 0.0):  # two edges far apart are not found as one
        distance, error = told, 0.0
    else:
        cause = ""
    detail = None if halves is None else detail_mm(halves)
    return Sharpness(across, along, detail, distance, error, voxel, cause)


def widths_of(volume: Volume) -> tuple[Width | None, Width | None]:
    """Measure the widths of a volume's edges across the axis and along it; None without enough."""
    found = edges_of(volume.data)
    if found is None:
        return None, None
    edges, every = found
    up = np.abs(edges.normal[:, 2])
    step = every * _edge_mm(volume)
    return edges.width(up < ACROSS, step), edges.width(up > ALONG, step)


def _edge_mm(volume: Volume) -> float:
    """Return the side of a cube as large as a voxel [mm]."""
    return float(np.cbrt(np.prod(volume.voxel_xyz)))


def detail_mm(halves: HalfScans) -> float | None:
    """Compute the size of the finest details that two half scans have in common.

    Their correlation over rings of the spectrum falls below half a bit of information
    (van Heel and Schatz 2005), with the number of independent values of a ring.

    Returns:
        [mm], at least two voxels; None for planes of fewer than `MIN_SIDE` voxels, or
        where not even the coarsest ring correlates.
    """
    even, odd = (
        np.nan_to_num(one).astype(np.float64) for one in (halves.even, halves.odd)
    )
    planes, nz, nx = even.shape
    if min(nz, nx) < MIN_SIDE:
        return None
    window = np.hanning(nz)[:, None] * np.hanning(nx)
    # Share of the plane that is as good as unweighted, and one half for real values.
    independent = 0.5 * (window**2).sum() ** 2 / (window**4).sum() / (nz * nx)
    level = 0.5 * (even + odd).mean(axis=(1, 2), keepdims=True)
    first, second = (np.fft.fft2((one - level) * window) for one in (even, odd))
    dx, dz = halves.voxel_mm
    k = np.hypot(np.fft.fftfreq(nz, dz)[:, None], np.fft.fftfreq(nx, dx))
    top = 0.5 / max(dx, dz)
    width = RING_WIDTH / min(nz * dz, nx * dx)
    ring = np.minimum((k / width).round().astype(int), int(top / width) + 1)
    count = np.bincount(ring.ravel())

    def over_rings(what: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(ring.ravel(), what.sum(axis=0).ravel()), float)

    shared = over_rings((first * second.conj()).real)
    power = over_rings(np.abs(first) ** 2) * over_rings(np.abs(second) ** 2)
    likeness = shared / np.sqrt(np.maximum(power, np.finfo(float).tiny))
    root = np.sqrt(np.maximum(planes * count * independent, 1.0))
    least = (0.2071 + 1.9102 / root) / (1.2071 + 0.9102 / root)
    last = int(top / width)
    # A single ring may be a zero of the object's spectrum.
    under = (likeness < least)[MIN_RING : last + 2]
    below = np.flatnonzero(under[:-1] & under[1:])
    if not len(below):
        return 1.0 / top
    if below[0] == 0:
        return None
    at = MIN_RING + below[0]
    high, low = (likeness - least)[[at - 1, at]]
    crossing = (at - 1 + high / (high - low)) * width
    return float(max(1.0 / crossing, 1.0 / top))


def displacement(halves: HalfScans) -> tuple[float, float] | None:
    """Compute how far apart opposite views show the same edge.

    With the source before or behind a plane, edges that cross it are seen along the
    plane's normal, and shift to opposite sides if the axis is not where it is said to
    be; a turn of one half against the other, or a slip, shifts some. Noise is what even
    and odd views differ by at the same edges.

    Returns:
        Root mean square of the distance, less noise, and by how much it scatters where
        there is none [mm]; None without edges in the layers about the source's height.
    """
    rows = halves.middle
    if rows.sum() < 2:
        return None
    squares, noises, sizes, shifts = [], [], [], []
    planes = zip(halves.before, halves.behind, halves.even, halves.odd, strict=True)
    for plane in planes:
        before, behind, even, odd = (_edges_alone(one[rows]) for one in plane)
        shift = _shift_between(before, behind)
        before, behind = _moved(before, -shift), _moved(behind, shift)
        slope = np.gradient(before + behind, axis=1)
        size = _in_parts(slope**2)
        some = size > MIN_PART_SHARE * size.sum()
        size = size[some]
        rest = _in_parts((before - behind) * slope)[some]
        squares.append((shift * size + rest) ** 2 / size)
        noises.append(_in_parts((even - odd) * slope)[some] ** 2 / size)
        sizes.append(size)
        shifts.append(shift)
    square, noise, size = (np.concatenate(one) for one in (squares, noises, sizes))
    if not len(size):
        return None
    usual = float(noise.mean())
    total = float(size.sum())
    apart = np.sqrt(max(float(square.sum()) - len(size) * usual, 0.0) / total)
    error = np.sqrt(usual * np.sqrt(2.0 * len(size)) / total)
    # Each half has half of the values, and of the distance.
    return 2.0 * apart * halves.voxel_mm[0], 2.0 * float(error) * halves.voxel_mm[0]


def _edges_alone(plane: Float32Array) -> FloatArray:
    """Filter a plane (nz, nx) along x, so that its edges are left."""
    from scipy.ndimage import gaussian_filter1d

    values = np.nan_to_num(plane).astype(np.float64)
    fine, wide = (gaussian_filter1d(values, band, axis=1) for band in BANDS)
    return np.asarray(fine - wide)


def _shift_between(first: FloatArray, second: FloatArray) -> float:
    """Find the shift of which one plane has half and the other has half with the other
    sign, along x [voxels].
    """
    shift = 0.0
    for _ in range(SHIFT_STEPS):
        one, other = _moved(first, -shift), _moved(second, shift)
        slope = np.gradient(one + other, axis=1)
        size = float((slope**2).sum())
        if not size:
            return 0.0
        shift -= float(((one - other) * slope).sum()) / size
    return shift if abs(shift) <= MAX_SHIFT else 0.0


def _moved(plane: FloatArray, shift: float) -> FloatArray:
    """Move a plane (nz, nx) along x by a fraction of voxels, by cubic splines."""
    from scipy.ndimage import shift as moved

    return np.asarray(moved(plane, (0.0, shift), order=3, mode="nearest"))


def _in_parts(values: FloatArray) -> FloatArray:
    """Sum values (nz, nx) over parts of the plane, (k,)."""
    return np.array(
        [
            part.sum()
            for rows in np.array_split(values, HIGH_PARTS)
            for part in np.array_split(rows, WIDE_PARTS, axis=1)
        ]
    )
