"""The records that the fan kernels pass around: plain named tuples, which cost nothing because
numba takes them apart when it compiles.
"""

from __future__ import annotations

from typing import Any, NamedTuple


class Box(NamedTuple):
    """Voxels (ix, iy, iz) at flat[base + ix * hop_x + iy * hop_y + iz]; counts; edges [mm].

    spans (ny, nx, 2): occupied voxels of a column, first <= iz < last.
    """

    flat: Any
    spans: Any
    base: int
    hop_x: int
    hop_y: int
    nx: int
    ny: int
    nz: int
    size_x: float
    size_y: float
    size_z: float


class Fans(NamedTuple):
    """views (n, 12): source, first pixel minus source, u, v in voxel units; lines (m, 2): fan
    boundaries c = a + b r; jobs (k, 3): view, first line, last line; room: rays in the largest
    fan; widest: columns of the widest job.
    """

    views: Any
    lines: Any
    jobs: Any
    room: int
    widest: int


class Grid(NamedTuple):
    """A box as one fan sees it: axis of t (0 x, 1 y), signs of the mirroring, offset and steps
    in the voxels and in their spans, counts, source, and squares of the voxel's edges [mm^2].
    """

    axis: int
    sign_l: float
    sign_t: float
    base: int
    hop_l: int
    hop_t: int
    span_base: int
    span_l: int
    span_t: int
    nl: int
    nt: int
    nz: int
    sl: float
    st: float
    sz: float
    square_l: float
    square_t: float
    square_z: float


class Fan(NamedTuple):
    """Reference slope, lowest tilt, range of tilts, range of rises, slabs [j0, j1), t where the
    rays begin, whether they spread, whether they may share a line.
    """

    m0: float
    low: float
    width: float
    rise_low: float
    rise_high: float
    j0: int
    j1: int
    begin: float
    spread: bool
    together: bool


class Collected(NamedTuple):
    """Rays as collected from the detector: row, column, slope dl / dt, rise dz / dt, t of the
    pixel from the source, place in the job's buffer, and bin of slope (-1: misses the box).
    """

    row: Any
    column: Any
    slope: Any
    rise: Any
    span: Any
    slot: Any
    bin: Any


class Rays(NamedTuple):
    """Rays of a fan in order of slope.

    slope; rise; slot as in Collected; cross: t of the next z crossing; pace: t between
    them, signed by direction; acc: integral so far (transposed: the value to spread);
    weight: 1 / slope; tilt: slope - m0; ratio: m0 / slope - 1; level; following: next ray
    with a crossing in the same slab; length: mm a unit of t; picked: spare.
    """

    slope: Any
    rise: Any
    slot: Any
    cross: Any
    pace: Any
    acc: Any
    weight: Any
    tilt: Any
    ratio: Any
    level: Any
    following: Any
    length: Any
    picked: Any


class Work(NamedTuple):
    """A worker's arrays by slab (head of the list of crossings), by bin (first ray) and
    by level (S or, transposed, the level's part; the same for Q; jump at a vertex;
    zeros).
    """

    head: Any
    bins: Any
    total: Any
    moment: Any
    jump: Any
    zeros: Any
