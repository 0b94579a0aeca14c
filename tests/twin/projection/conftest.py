"""A second, independent implementation: exact Siddon in NumPy, double precision, every crossing
of every ray computed on its own and sorted. Slow and plain; shares nothing with the kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import operators as walks


def _siddon(data, voxel, center, cone_vec, shape, pixels=None):
    """Line integrals (n, rows, cols) in double precision, or (n, len(pixels)) for chosen
    pixels.

    data (nz, ny, nx); voxel, center (x, y, z) [mm]; pixels: (k, 2) (row, column).
    """
    data = np.asarray(data, np.float64)
    voxel, center = np.asarray(voxel, np.float64), np.asarray(center, np.float64)
    counts = np.array(data.shape[::-1])
    low = center - counts * voxel / 2
    rows, cols = shape
    if pixels is None:
        pixels = [(r, c) for r in range(rows) for c in range(cols)]
    result = np.zeros((len(cone_vec.rows), len(pixels)))
    for i, g in enumerate(cone_vec.rows):
        for j, (r, c) in enumerate(pixels):
            end = g[3:6] + (c - (cols - 1) / 2) * g[6:9] + (r - (rows - 1) / 2) * g[9:12]
            result[i, j] = _ray(data, voxel, low, counts, g[:3], end)
    return result if len(pixels) != rows * cols else result.reshape(-1, rows, cols)


def _ray(data, voxel, low, counts, start, end):
    d = end - start
    t0, t1 = 0.0, np.inf  # the panel is virtual
    for a in range(3):
        ends = np.array([low[a], low[a] + counts[a] * voxel[a]])
        if d[a] == 0:
            if not ends[0] <= start[a] <= ends[1]:
                return 0.0
            continue
        enter, leave = np.sort((ends - start[a]) / d[a])
        t0, t1 = max(t0, enter), min(t1, leave)
    if t1 <= t0:
        return 0.0
    crossings = [np.array([t0, t1])]
    for a in range(3):
        if d[a] != 0:
            t = (low[a] + np.arange(counts[a] + 1) * voxel[a] - start[a]) / d[a]
            crossings.append(t[(t > t0) & (t < t1)])
    t = np.sort(np.concatenate(crossings))
    middle = start + 0.5 * (t[1:] + t[:-1])[:, None] * d
    index = np.clip(np.floor((middle - low) / voxel).astype(int), 0, counts - 1)
    return float(
        np.sum(np.diff(t) * data[index[:, 2], index[:, 1], index[:, 0]])
    ) * float(np.linalg.norm(d))


def _circle(
    n, sod, sdd, pitch, *, roll=0.0, pitch_tilt=0.0, yaw=0.0, start=0.0, height=0.0
):
    """n views on a circle, object frame; tilts [rad] about normal, u and v of the detector;
    source `height` above the object and the detector as far below as to see its centre."""
    angles = start + 2 * np.pi * np.arange(n) / n
    rows = []
    for angle in angles:
        c, s = np.cos(angle), np.sin(angle)
        across, beam, up = (
            np.array([c, s, 0]),
            np.array([-s, c, 0]),
            np.array([0, 0, 1.0]),
        )
        u, v = across, -up
        u = np.cos(yaw) * u + np.sin(yaw) * beam
        normal = np.cross(u, v)
        v = np.cos(pitch_tilt) * v + np.sin(pitch_tilt) * normal
        u, v = np.cos(roll) * u + np.sin(roll) * v, np.cos(roll) * v - np.sin(roll) * u
        source = -sod * beam + height * up
        detector = (sdd - sod) * beam - height * (sdd / sod - 1) * up
        rows.append(np.concatenate([source, detector, pitch * u, pitch * v]))
    return ConeVec(np.array(rows))


@pytest.fixture(scope="session")
def siddon() -> Callable[..., np.ndarray]:
    return _siddon


@pytest.fixture(scope="session")
def circle() -> Callable[..., ConeVec]:
    return _circle


@pytest.fixture
def one_thread_only() -> Iterator[None]:
    """The kernels use one thread during a test."""
    import numba

    before = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(before)


@pytest.fixture(autouse=True)
def walk(request, monkeypatch) -> None:
    """Fans along z, as large problems are walked, however small the tests' are; or, given
    indirectly, along another axis (an index into ORDERS), ray by ray (NO_FANS) or as chosen
    (None).
    """
    wanted = getattr(request, "param", 0)
    if wanted is not None:
        monkeypatch.setattr(
            walks, "level_axes", lambda rays, *_: np.full(len(rays), wanted)
        )
