"""One pass over the frames of a full turn: their mean, and its possible errors.

Over a full turn the mean projection is that of a body of revolution. Its possible faults
are looked for here: frames that are repeated, gaps between angles, and a step between
neighbors, which after a drift is the one between the last frame and the first; a slip
during the scan leaves both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from flexdt.twin.calibration.repeated_frames import ROBUST, find_repeated
from flexdt.twin.calibration.without_phantom.tile_gap import FRAMES, averaged_rows
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

Image = Callable[[int], Float32Array]

THUMB_COLUMNS: Final = 64
"""Columns of the small copies in which frames are compared, at least where there are as
many."""
DARKEST: Final = 8.0
"""Largest line integral in the model of noise; above it the noise is constant."""
MEDIAN_OF_CHI_SQUARE: Final = 0.4549
"""Of one degree of freedom."""
MIN_STEP_RATIO: Final = 5.0
"""Least ratio of a step between neighbors to the usual spread (assumed)."""
MIN_LEAD_RATIO: Final = 1.5
"""Least ratio of it to the next largest elsewhere: faces along the beam leave several."""
MIN_DIRECTIONS: Final = 24
"""Least number of directions for a mean."""
MAX_RETURN_SHARE: Final = 0.3
"""Sum of two steps relative to one below which they are one to and fro (assumed)."""
WIDEST_GAP: Final = 4.5
"""Largest gap between neighboring angles, relative to the usual one: three frames missing."""
BAND = 12
BAND_PART = 20
GROUPS = 7
"""Rows above and below the plane of the source that are kept, at least; columns over these
rows; groups of rows. Rays further off lean too much to be each other's."""
MOST_BANDS: Final = 1440
"""Of more views every second, third and so on is kept."""
GAP_IMAGES: Final = 6
"""Images in which the effect of gaps is kept; more gaps than that share them."""


@dataclass(frozen=True, eq=False)
class Turn:
    """The frames of a turn, combined.

    Attributes:
        mean: mean line integrals over the angle, (rows, cols).
        doubts: (k, rows, cols). The first is half the difference of every second frame
            from those between, so the noise of `mean` and more than its lack of views.
            Each of the others is the change by leaving out frames next to a gap, as many
            as are missing in it, or by a repeated frame.
        noise: relative variance of a pixel of `mean`, (rows, cols).
        used: indices of the frames in the mean.
        samples: some of these frames, their rows averaged: `averaged_rows`.
        band: means over groups of rows near the plane of the source, (views, groups, cols).
        band_rows: middle row of each group.
        band_frames: frame of each of these views.
        repeated: indices of frames left out as repeated.
        step_px: (columns, rows) by which the images step at most between neighboring
            frames; 0 where no step is significant or separable.
        step_after: the frame before that step.
    """

    mean: FloatArray
    doubts: FloatArray
    noise: FloatArray
    used: tuple[int, ...]
    samples: tuple[Float32Array, ...]
    band: Float32Array
    band_rows: tuple[float, ...]
    band_frames: tuple[int, ...]
    repeated: tuple[int, ...]
    step_px: tuple[float, float]
    step_after: int


def read_turn(
    image: Image,
    angle: FloatArray,
    present: Sequence[int],
    repeated: tuple[int, ...] = (),
    lost: tuple[int, ...] = (),
    source_row: float = 0.0,
) -> Turn:
    """Read the frames and combine them; all once more, without them, where some are found
    repeated.

    Repeated ones are found in the first reading unless they are given. The result has the
    mean, the noise, sample frames, bands of rows and the largest step.

    Args:
        image: line integrals of a frame, (rows, cols).
        angle: of the stage in every frame, (n,) [rad].
        present: indices of the frames that are there.
        repeated: frames among them that are known to be repeated; they are left out.
        lost: frames before which one may be missing, although no angle is; it only adds
            doubts.
        source_row: row of the plane in which the source turns.

    Raises:
        NotIdentifiableError: they are too few, do not close a turn, or have too few rows
            or columns.
    """
    remaining = [i for i in present if i not in repeated]
    index = np.array(
        sorted(remaining, key=lambda i: float(angle[i] % (2 * np.pi))), dtype=np.intp
    )
    gaps, usual = _require_turn(angle[index])
    weights = _coefficients(angle[index], gaps, usual)
    # After a repeated frame all others may be one step behind what their angles say: what was
    # seen twice is then missing between the last frame and the first, or where one was lost.
    ends = np.isin(index, [index.min(), index.max()]) / 2
    for one in repeated:
        near = np.abs(index - one) == np.abs(index - one).min()
        for gap in (ends, *(np.isin(index, [at - 1, at]) / 2 for at in lost)):
            weights = np.vstack([weights, weights[0] * (near / near.sum() - gap)])
    total: FloatArray | float = 0.0
    noise: FloatArray | float = 0.0
    used = tuple(sorted(remaining))
    thumbs = []
    samples = []
    bands = []
    sampled = set(used[:: -(-len(used) // FRAMES)])
    stride = -(-len(index) // MOST_BANDS)
    for weight, i in zip(weights.T, index.tolist(), strict=True):
        g = image(i)
        thumbs.append(_thumb(g))
        if i in sampled:
            samples.append(averaged_rows(g))
        if len(thumbs) % stride == 0:
            groups = _groups(len(g), g.shape[1], source_row)
            bands.append([g[top:end].mean(axis=0) for top, end in groups])
        total = total + weight[:, None, None] * g.astype(np.float64)
        noise = noise + weight[0] * np.exp(np.minimum(g, DARKEST))
    views = np.stack(thumbs)
    if not repeated:
        again, jumps = (index[at].tolist() for at in find_repeated(views, gaps))
        if again:
            return read_turn(
                image, angle, present, tuple(sorted(again)), tuple(jumps), source_row
            )
    images = np.asarray(total)
    (rows, cols) = np.shape(noise)
    (right, down), after = _step(views, gaps, int(index.argmin()))
    step = right * cols / views.shape[2], down * rows / views.shape[1]
    return Turn(
        images[0],
        images[1:],
        np.asarray(noise),
        used,
        tuple(samples),
        np.asarray(bands, dtype=np.float32),
        tuple((top + end - 1) / 2 for top, end in groups),
        tuple(index[stride - 1 :: stride].tolist()),
        repeated,
        step,
        int(index[after]),
    )


def _groups(rows: int, cols: int, middle: float) -> list[tuple[int, int]]:
    """Divide the rows about `middle`, where the source's plane meets the panel, into
    groups.

    There are `GROUPS` at most, of `BAND` rows or a `BAND_PART` of the columns on either
    side, moved inwards at edges. Returns (top, end) of each.
    """
    half = max(BAND, cols // BAND_PART)
    centre = min(
        max(round(middle), min(half, rows // 2)), rows - 1 - min(half, (rows - 1) // 2)
    )
    top = max(0, centre - half)
    end = min(rows, centre + half + 1)
    edges = np.linspace(top, end, min(GROUPS, end - top) + 1).round().astype(int).tolist()
    return list(pairwise(edges))


def _require_turn(angle: FloatArray) -> tuple[FloatArray, float]:
    """Check that angles cover a full turn: at least `MIN_DIRECTIONS`, and no gap above
    `WIDEST_GAP` times the usual (median) one. Repeated angles count as one direction.

    Args:
        angle: (n,) of the frames, sorted modulo a turn [rad].

    Returns:
        The gaps after each angle (n,), and the usual one [rad].

    Raises:
        NotIdentifiableError: too few directions, or a wide gap.
    """
    around = angle % (2 * np.pi)
    gaps = np.diff(around, append=around[:1] + 2 * np.pi)
    own = gaps[gaps > 1e-6]
    if len(own) < MIN_DIRECTIONS:
        raise NotIdentifiableError(
            f"{len(own)} directions; the mean over a turn needs {MIN_DIRECTIONS} at least",
        )
    usual = float(np.median(own))
    widest = float(own.max())
    if widest > WIDEST_GAP * usual:
        raise NotIdentifiableError(
            f"the frames leave {math.degrees(widest):.4g} deg of a full turn without a "
            f"view (usual step {math.degrees(usual):.4g} deg), so only opposite rays can tell",
        )
    return gaps, usual


def _coefficients(angle: FloatArray, gaps: FloatArray, usual: float) -> FloatArray:
    """Compute the weight of each frame in the mean and in the doubts.

    Args:
        angle: sorted, (n,) [rad].
        gaps: after each, (n,) [rad].
        usual: of the gaps [rad].

    Returns:
        (1 + k, n). Row 0 is the mean, row 1 half the difference of even and odd views,
        the others what gaps above 1.5 times the usual may do: the change by leaving out
        as many frames next to them; at most `GAP_IMAGES`, shared with alternating signs.
    """
    n = len(angle)
    keep = np.ones(n, dtype=bool)
    even = np.arange(n) % 2 == 0
    mean = _weights(angle, keep)
    out = [mean, (_weights(angle, even) - _weights(angle, ~even)) / 2]
    wide = np.flatnonzero(gaps > 1.5 * usual)
    doubts = np.zeros((min(len(wide), GAP_IMAGES), n))
    for j, place in enumerate(wide.tolist()):
        missing = round(gaps[place] / usual) - 1
        left_out = keep.copy()
        left_out[(place + 2 + np.arange(missing)) % n] = False
        sign = 1 - 2 * (j // GAP_IMAGES % 2)
        doubts[j % GAP_IMAGES] += sign * (mean - _weights(angle, left_out))
    return np.vstack([*out, doubts])


def _weights(angle: FloatArray, keep: npt.NDArray[np.bool_]) -> FloatArray:
    """Compute weights of the trapezoidal rule on the circle for the kept angles, of sum 1; 0 for
    the others.

    `angle`: (n,) sorted modulo a turn [rad]; `keep`: (n,).
    """
    around = angle[keep] % (2 * np.pi)
    gaps = np.diff(around, append=around[:1] + 2 * np.pi)
    out = np.zeros(len(angle))
    out[keep] = (gaps + np.roll(gaps, 1)) / (4 * np.pi)
    return out


def _thumb(image: Float32Array) -> Float32Array:
    """Average over square blocks, to about `THUMB_COLUMNS` columns; incomplete blocks at
    the ends are left out. Narrower images stay as they are.

    Raises:
        NotIdentifiableError: the image has fewer than two blocks a side.
    """
    factor = max(1, round(image.shape[1] / THUMB_COLUMNS))
    if min(image.shape) < 2 * factor:
        raise NotIdentifiableError.instead(
            f"images of {image.shape[0]} rows and {image.shape[1]} columns show no plane "
            "of the source and no roll",
            list(image.shape),
            f"{2 * factor} rows or more",
        )
    return np.asarray(binned_mean(image, factor), dtype=np.float32)


def _step(
    views: Float32Array, gaps: FloatArray, first: int
) -> tuple[tuple[float, float], int]:
    """Find the largest step between neighbors.

    Each frame is compared with the third-order interpolation of its four neighbors on
    the circle. A shift d between frame i - 1 and frame i leaves -d/2 in one of them and
    +d/2 in the other. A step and its return count as one.

    Args:
        views: (n, rows, cols), sorted by angle.
        gaps: after each, (n,) [rad]; places near uneven ones are not judged.
        first: place of the frame that was taken first.

    Returns:
        The step (columns, rows) [px of the views] and the place before it; zeros if no
        step is significant (`MIN_STEP_RATIO`, `MIN_LEAD_RATIO`) or the images do not
        separate both directions.
    """
    n = len(views)
    soft = gaussian_filter(views, (0, 1, 1))

    def around(by: int) -> Float32Array:
        return np.asarray(np.roll(soft, by, axis=0))

    rest = soft - (4.0 * (around(1) + around(-1)) - around(2) - around(-2)) / 6.0
    rest = rest - np.roll(rest, 1, axis=0)
    down, right = np.gradient(soft, axis=(1, 2))
    shifts = np.empty((n, 2))
    for i in range(n):
        slopes = np.stack([right[i].ravel(), down[i].ravel()])
        slopes -= slopes.mean(axis=1, keepdims=True)
        normal = slopes @ slopes.T
        if not np.linalg.cond(normal) < 1e8:
            return (0.0, 0.0), 0
        shifts[i] = -np.linalg.solve(normal, slopes @ rest[i].ravel())
    even = np.abs(gaps / np.median(gaps) - 1.0) < 0.1
    valid = np.all([np.roll(even, by) for by in (-1, 0, 1, 2)], axis=0)
    if valid.sum() < MIN_DIRECTIONS // 2:
        return (0.0, 0.0), 0
    spread = ROBUST * np.median(np.abs(shifts[valid]), axis=0) + 1e-6
    score = np.where(valid, np.abs(shifts / spread).max(axis=1), 0.0)
    worst = int(score.argmax())
    others = np.where(_far(n, worst), score, 0.0)
    # What steps and stays has to step back between the last frame and the first.
    if worst == first:
        back = int(others.argmax())
    else:
        back = first
    if np.linalg.norm(shifts[back] + shifts[worst]) < MAX_RETURN_SHARE * np.linalg.norm(
        shifts[worst]
    ):
        others = np.where(_far(n, back), others, 0.0)
        worst = back if worst == first else worst
    if score[worst] < max(MIN_STEP_RATIO, MIN_LEAD_RATIO * others.max()):
        return (0.0, 0.0), 0
    return (float(shifts[worst, 0]), float(shifts[worst, 1])), (worst - 1) % n


def _far(n: int, place: int) -> npt.NDArray[np.bool_]:
    """Mark places (n,) on the circle that are no near neighbors of one."""
    apart = np.abs(np.arange(n) - place)
    return np.asarray(np.minimum(apart, n - apart) > 2)
