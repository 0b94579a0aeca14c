"""Do images decide in which direction an object turned? A likelihood beside `fdk`'s.

    python tests/studies/direction_likelihood.py --sample lego --views 48 --rows 55 115

Simulates a right scan and says what `reconstruct` says of its geometry. Then makes a volume
without negative values (accelerated SIRT), once as the scan is and once with the rotation
reversed, from all views and from every second one, and projects it into those it was made
from or into the others. NumPy and SciPy alone, with rays of its own. Prints both residuals
over the largest line integral, and the logarithm of the ratio of their squares with its
standard error over 12 arcs of views: above three of them the images decide.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import warnings
from collections.abc import Iterator

import numpy as np
import scipy.sparse as sp

import flexdt as fx

PANEL_MM = 229.8
"""Height of the panel; its width is a third more."""
ARCS = 12
STEP = 0.5
"""Distance of samples along a ray [voxels]."""


def samples(
    places: np.ndarray, count: tuple[int, int, int]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Voxels and weights by which values at places are interpolated.

    Args:
        places: (rays, samples, 3) x, y, z [voxels from the first].
        count: voxels (z, y, x).

    Yields:
        Numbers of rays, of voxels, and weights, of each corner of the voxels' cells.
    """
    whole = np.floor(places).astype(int)
    part = places - whole
    ray = np.broadcast_to(np.arange(len(places))[:, None], places.shape[:2])
    most = np.array(count[::-1])
    for corner in itertools.product((0, 1), repeat=3):
        at = whole + corner
        weight = np.where(corner, part, 1.0 - part).prod(axis=2)
        inside = ((at >= 0) & (at < most)).all(axis=2) & (weight > 0.0)
        x, y, z = at[inside].T
        yield ray[inside], (z * count[1] + y) * count[2] + x, weight[inside]


def system(
    rows: np.ndarray,
    middle: tuple[float, float],
    count: tuple[int, int, int],
    voxel: float,
) -> sp.csr_matrix:
    """Lengths of rays in voxels, (views rows cols, voxels) [mm].

    Args:
        rows: (n, 12) of a `ConeVec`.
        middle: row and column of the panel's centre.
        count: voxels (z, y, x), of as many rows and columns of the panel.
        voxel: their edge [mm].
    """
    row, column = np.indices((count[0], count[2]))
    reach = 0.5 * voxel * np.linalg.norm(count)
    along = np.arange(-reach, reach, STEP * voxel)
    blocks = []
    for source, centre, u, v in rows.reshape(-1, 4, 3):
        steps = (column - middle[1])[..., None] * u + (row - middle[0])[..., None] * v
        ray = (centre + steps - source).reshape(-1, 3)
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        nearest = -(ray @ source)
        places = source + (nearest[:, None] + along)[..., None] * ray[:, None]
        places = places / voxel + (np.array(count[::-1]) - 1.0) / 2.0
        found = [
            np.concatenate(parts) for parts in zip(*samples(places, count), strict=True)
        ]
        values = (found[2] * STEP * voxel).astype(np.float32)
        shape = (len(ray), int(np.prod(count)))
        blocks.append(sp.coo_matrix((values, (found[0], found[1])), shape).tocsr())
    return sp.vstack(blocks).tocsr()


def volume_of(matrix: sp.csr_matrix, values: np.ndarray, iterations: int) -> np.ndarray:
    """Volume without negative values whose projections are nearest to the values."""
    back = matrix.T.tocsr()
    lengths = np.maximum(np.asarray(matrix.sum(axis=1)).ravel(), 1e-3)
    weights = np.maximum(np.asarray(matrix.sum(axis=0)).ravel(), 1e-3)
    before = ahead = np.zeros(matrix.shape[1], np.float32)
    pace = 1.0
    for _ in range(iterations):
        step = back @ ((values - matrix @ ahead) / lengths) / weights
        now = np.maximum(ahead + step, 0.0).astype(np.float32)
        faster = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * pace * pace))
        ahead = now + np.float32((pace - 1.0) / faster) * (now - before)
        before, pace = now, faster
    return before


def reversed_turn(rows: np.ndarray) -> np.ndarray:
    """The views (n, 12) with each angle from the first negated."""
    angle = np.arctan2(rows[:, 1], rows[:, 0])
    turn = 2.0 * (angle[0] - angle)
    out = rows.reshape(-1, 4, 3).copy()
    for view, (c, s) in zip(
        out, zip(np.cos(turn), np.sin(turn), strict=True), strict=True
    ):
        view[:] = view @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return out.reshape(-1, 12)


def said_of(data: fx.DataSet) -> str:
    """What is said of the geometry, in short."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        data.reconstruct("fdk", progress=False)
    texts = [str(one.message) for one in told]
    if any("do not decide" in text for text in texts):
        return "not decided"
    if any("contradict each other" in text for text in texts):
        return "contradicted"
    return "taken as it is"


def main() -> int:
    """Simulate, reconstruct both ways, and print the likelihoods."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sample", default="lego")
    parser.add_argument("--views", type=int, nargs="+", default=[48])
    parser.add_argument("--rows", type=int, nargs="+", default=[55, 115])
    parser.add_argument("--iterations", type=int, default=60)
    chosen = parser.parse_args()
    for panel_rows, views in itertools.product(chosen.rows, chosen.views):
        pixel = PANEL_MM / panel_rows
        shape = (panel_rows, round(4 * panel_rows / 3))
        scan = fx.ConeVec.circular(
            sod=600.0, sdd=1059.0, angles=views, shape=shape, pixel=pixel
        )
        data = fx.simulate(chosen.sample, scan, noise=1, progress=False)
        images = np.asarray(data.line_integrals(), np.float32)
        # What holds the object, as wide as high, with the axis in the middle.
        centre = (np.array(shape) - 1.0) / 2.0
        signal = np.argwhere(images.max(axis=0) > 0.05 * images.max())
        reach = int(np.abs(signal - centre).max()) + 3
        first = np.maximum(np.floor(centre - reach).astype(int), 0)
        side = int(min(2 * reach + 1, *(np.array(shape) - first)))
        images = images[:, first[0] : first[0] + side, first[1] : first[1] + side]
        flat = images.reshape(len(images), -1)
        rows = np.array(scan.rows)
        voxel = pixel * 600.0 / 1059.0
        residuals = []
        for way in (rows, reversed_turn(rows)):
            matrix = system(way, tuple(centre - first), (side,) * 3, voxel)
            whole = volume_of(matrix, flat.ravel(), chosen.iterations)
            inner = np.square((matrix @ whole).reshape(flat.shape) - flat).mean(axis=1)
            outer = np.empty(views)
            number = np.arange(flat.size).reshape(flat.shape)
            for part in (0, 1):
                used, left = number[part::2].ravel(), number[1 - part :: 2]
                half = volume_of(matrix[used], flat[part::2].ravel(), chosen.iterations)
                again = (matrix[left.ravel()] @ half).reshape(left.shape)
                outer[1 - part :: 2] = np.square(again - flat[1 - part :: 2]).mean(axis=1)
            residuals.append((inner, outer))
        print(f"{chosen.sample}, {views} views, {shape}: {said_of(data)} by reconstruct")
        for name, stated, other in zip(("all", "left out"), *residuals, strict=True):
            arcs = [arc.mean() for arc in np.array_split(np.log(other / stated), ARCS)]
            error = np.std(arcs, ddof=1) / np.sqrt(ARCS)
            size = [np.sqrt(one.mean()) / images.max() for one in (stated, other)]
            print(
                f"  {name} views: residual {size[0]:.4f}, reversed {size[1]:.4f}; "
                f"log ratio {np.mean(arcs):.3f} +- {error:.3f}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
