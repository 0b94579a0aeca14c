"""One pass over the frames of a full turn: their mean, and how far it may be from the true one.

Over a full turn the mean projection is that of a body of revolution. What would spoil it is looked
for here: frames that are repeated, gaps between angles, and a step between neighbours, which after
a drift is the one between the last frame and the first; what slips during the scan leaves both.

A gap between two tiles of the panel is looked for in some of the frames. What lies in it is
missing: beyond it everything appears nearer by its width, and the columns beside it differ as
columns do that are further apart. How much columns differ with their distance is seen in the frames
themselves, everywhere else. Where edges of the turning object pass a border, the differences of
neighbouring columns about it are compared with what they would be with a gap of each width: the
likelihood of normal differences, each row of each frame at its own scale. The outline of the object
looks like a gap, too, where its edges turn back, but it does so on both sides of the axis: the gain
at a border's mirror image is subtracted twice. A gap is in all frames, and a few that fit well
prove nothing: what frames scatter by is subtracted as well. What stays the same in all frames
(rings, a wrong flat field) is left out, and so are borders near columns that show nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter, maximum_filter1d, median_filter

from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.panel import Border, Panel

Image = Callable[[int], Float32Array]

THUMB_COLUMNS: Final = 64
"""Columns of the small copies in which frames are compared, at least where there are as many."""
DARKEST: Final = 8.0
"""Line integral above which the noise is taken for that of this one."""
MEDIAN_OF_CHI_SQUARE: Final = 0.4549
"""Of one degree of freedom."""
WHITE: Final = 3.0
"""Standard deviations of white noise's correlation up to which neighbouring pixels are not alike.
From twice that on they are."""
LOST: Final = 2.5
"""A frame may be missing where two differ by more than so many times what is usual there: with one
missing it is about four."""
STEPS: Final = 5.0
"""A step between neighbours is one when it is so many times the usual spread (assumed)."""
CLEAR: Final = 1.5
"""And so many times the next largest elsewhere: faces that lie along the beam leave several."""
FEWEST: Final = 24
"""Directions of which a mean is taken, at least."""
BACK: Final = 0.3
"""Two steps whose sum is smaller than so much of one are one to and fro (assumed)."""
WIDEST_GAP: Final = 4.5
"""Largest gap between neighbouring angles, relative to the usual one: three frames missing."""
GAP_IMAGES: Final = 6
"""Images in which the effect of gaps is kept; more gaps than that share them."""


@dataclass(frozen=True, eq=False)
class Turn:
    """What the frames of a turn come to.

    Attributes:
        mean: mean line integrals over the angle, (rows, cols).
        doubts: (k, rows, cols). The first is half of what every second frame says otherwise than
            those between, so the noise of `mean` and more than its lack of views. Each of the
            others is what leaving out frames beside a gap, as many as are missing in it, changes,
            or what a repeated frame may.
        noise: relative variance of a pixel of `mean`, (rows, cols).
        used: indices of the frames in the mean.
        samples: some of these frames, their rows averaged: `averaged_rows`.
        repeated: indices of frames left out as repeated.
        step_px: (columns, rows) by which the images step at most between neighbouring frames; 0
            where no step is significant or none can be told.
        step_after: the frame before that step.
    """

    mean: FloatArray
    doubts: FloatArray
    noise: FloatArray
    used: tuple[int, ...]
    samples: tuple[Float32Array, ...]
    repeated: tuple[int, ...]
    step_px: tuple[float, float]
    step_after: int


def read_turn(
    image: Image,
    angle: FloatArray,
    present: Sequence[int],
    repeated: tuple[int, ...] = (),
    lost: tuple[int, ...] = (),
) -> Turn:
    """Read the frames, twice where some are repeated.

    Args:
        image: line integrals of a frame, (rows, cols).
        angle: of the stage in every frame, (n,) [rad].
        present: indices of the frames that are there.
        repeated: frames among them that are known to be repeated.
        lost: frames before which one may be missing, although no angle is.

    Raises:
        NotIdentifiableError: they are too few, or do not close a turn.
    """
    kept = [i for i in present if i not in repeated]
    index = np.array(sorted(kept, key=lambda i: float(angle[i] % (2 * np.pi))), dtype=np.intp)
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
    used, thumbs, samples = tuple(sorted(kept)), [], []
    sampled = set(used[:: -(-len(used) // FRAMES)])
    for weight, i in zip(weights.T, index.tolist(), strict=True):
        g = image(i)
        thumbs.append(_thumb(g))
        if i in sampled:
            samples.append(averaged_rows(g))
        total = total + weight[:, None, None] * g.astype(np.float64)
        noise = noise + weight[0] * np.exp(np.minimum(g, DARKEST))
    views = np.stack(thumbs)
    if not repeated:
        again, jumps = (index[places].tolist() for places in _repeated(views, gaps))
        if again:
            return read_turn(image, angle, present, tuple(sorted(again)), tuple(jumps))
    images, (rows, cols) = np.asarray(total), np.shape(noise)
    (right, down), after = _step(views, gaps, int(index.argmin()))
    step = right * cols / views.shape[2], down * rows / views.shape[1]
    return Turn(
        images[0], images[1:], np.asarray(noise), used, tuple(samples), repeated, step,
        int(index[after]),
    )  # fmt: skip


def _require_turn(angle: FloatArray) -> tuple[FloatArray, float]:
    """Gaps behind each of the sorted angles (mod a turn), and the usual one [rad]."""
    around = angle % (2 * np.pi)
    gaps = np.diff(around, append=around[:1] + 2 * np.pi)
    own = gaps[gaps > 1e-6]
    if len(own) < FEWEST:
        raise NotIdentifiableError(
            f"{len(own)} directions; the mean over a turn needs {FEWEST} at least",
        )
    usual, widest = float(np.median(own)), float(own.max())
    if widest > WIDEST_GAP * usual:
        raise NotIdentifiableError(
            f"the frames leave {math.degrees(widest):.4g} deg of a full turn without a view (usual "
            f"step {math.degrees(usual):.4g} deg): only the mean over a full turn is symmetric",
        )
    return gaps, usual


def _coefficients(angle: FloatArray, gaps: FloatArray, usual: float) -> FloatArray:
    """Of each frame (sorted by angle) in the mean and in the doubts, (1 + k, n)."""
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
    """Of the trapezoidal rule on the circle for those that are kept, 0 for the others."""
    around = angle[keep] % (2 * np.pi)
    gaps = np.diff(around, append=around[:1] + 2 * np.pi)
    out = np.zeros(len(angle))
    out[keep] = (gaps + np.roll(gaps, 1)) / (4 * np.pi)
    return out


def _thumb(image: Float32Array) -> Float32Array:
    """Means over square blocks; what is left over at the ends is left out."""
    factor = max(1, round(image.shape[1] / THUMB_COLUMNS))
    if min(image.shape) < 2 * factor:
        raise NotIdentifiableError.instead(
            f"images of {image.shape[0]} rows and {image.shape[1]} columns show no plane of the "
            "source and no roll", list(image.shape), f"{2 * factor} rows or more",
        )  # fmt: skip
    return np.asarray(binned_mean(image, factor), dtype=np.float32)


def _repeated(views: Float32Array, gaps: FloatArray) -> tuple[list[int], list[int]]:
    """Places of frames that show what the one before shows although the stage turned, and of those
    that differ from it as if one were missing.

    Two exposures of the same differ by noise alone, in which neighbouring pixels are not alike;
    what a turn changes spreads over several.
    """
    soft = gaussian_filter(views, (0, 2, 2))  # less noise: a copy may have been exposed anew
    rest = soft - np.roll(soft, 1, axis=0)
    change, correlation = np.empty((2, len(views)))
    for i, (down, right) in enumerate(zip(*np.gradient(soft, axis=(1, 2)), strict=True)):
        # Frames that are shifted against each other change more than a turn makes them.
        slopes = np.stack([right.ravel(), down.ravel(), np.ones(right.size)], axis=1)
        shifted = slopes @ np.linalg.lstsq(slopes, rest[i].ravel(), rcond=None)[0]
        change[i] = np.square(rest[i].ravel() - shifted).mean(dtype=np.float64)
        own = views[i] - views[i - 1] - shifted.reshape(soft[i].shape)
        correlation[i] = _neighbours_correlation(own)
    # Usual for that part of the turn: a round body hardly changes where it turns back.
    usual = median_filter(change, 5, mode="wrap")
    turned = np.roll(gaps, 1) > 1e-6
    ratio = change / np.maximum(usual, 1e-30)
    limit = WHITE / math.sqrt(views[0].size)
    white = correlation <= limit
    white &= median_filter(correlation, 5, mode="wrap") > 2.0 * limit
    same = np.flatnonzero(white & (ratio <= np.quantile(ratio, 0.1)) & turned)
    if len(same) > len(views) // 4:
        return [], []
    jump = np.where(np.roll(gaps, 1) < 1.5 * np.median(gaps), ratio, 0.0)
    return same.tolist(), [int(jump.argmax())] if jump.max() > LOST else []


def _neighbours_correlation(image: FloatArray) -> float:
    """Correlation of neighbouring pixels along rows or columns, whichever is larger; 0 of noise."""
    own = image - image.mean()
    along = [(own[1:] * own[:-1]).mean(), (own[:, 1:] * own[:, :-1]).mean()]
    return float(max(along)) / max(float(np.square(own).mean()), 1e-30)


def _step(views: Float32Array, gaps: FloatArray, first: int) -> tuple[tuple[float, float], int]:
    """The largest step (columns, rows) between neighbours and the place before it; `first` is where
    the frame stands that was taken first. No step where none is significant, or none can be told.

    Each frame is compared with the third-order interpolation of its four neighbours on the circle.
    A shift d between frame i - 1 and frame i leaves -d/2 in one of them and +d/2 in the other.
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
    if valid.sum() < FEWEST // 2:
        return (0.0, 0.0), 0
    spread = 1.4826 * np.median(np.abs(shifts[valid]), axis=0) + 1e-6
    score = np.where(valid, np.abs(shifts / spread).max(axis=1), 0.0)
    worst = int(score.argmax())
    others = np.where(_far(n, worst), score, 0.0)
    # What steps and stays has to step back between the last frame and the first.
    back = int(others.argmax()) if worst == first else first
    if np.linalg.norm(shifts[back] + shifts[worst]) < BACK * np.linalg.norm(shifts[worst]):
        others = np.where(_far(n, back), others, 0.0)
        worst = back if worst == first else worst
    if score[worst] < max(STEPS, CLEAR * others.max()):
        return (0.0, 0.0), 0
    return (float(shifts[worst, 0]), float(shifts[worst, 1])), (worst - 1) % n


def _far(n: int, place: int) -> npt.NDArray[np.bool_]:
    """(n,) places on the circle that are no near neighbours of one."""
    apart = np.abs(np.arange(n) - place)
    return np.asarray(np.minimum(apart, n - apart) > 2)


SIDE: Final = 4
"""Columns on each side of a border that are looked at."""
WIDTHS: Final = np.arange(0.0, 4.01, 0.1)
"""Widths of gaps that are tried [px]."""
ROWS, FRAMES = 48, 96
"""Rows that a frame is averaged to, and frames that are looked at, where there are more."""
EDGES: Final = 0.05
"""Part of all places that is compared, those with most change: edges. Noise says nothing."""
EVIDENCE, STANDS_OUT = 24.0, 5.0
"""Gain in log likelihood from which on there is a gap, and times the gain at any other border. Of
93 drawn scans without a gap one had both, of 69 with one of 0.5 to 2 px 65 (`align_faults.py`)."""


class Gap(NamedTuple):
    """Between two tiles: the first column beyond it, and how wide it is, with sigma [px]."""

    column: int
    width: float
    sigma: float

    def panel(self, shape: tuple[int, int], undone: Panel | None = None) -> Panel:
        """The panel of images (rows, cols) with this gap, beside what is undone in them already."""
        one = undone or Panel.flat(shape)
        at = np.array([self.column - 0.5, (shape[0] - 1) / 2])
        border = Border(0, float((at + one.shift(at))[0]))
        model = replace(one.model, borders=(*one.model.borders, border))
        return replace(one, model=model, coefficients=(*one.coefficients, -self.width, 0.0))


def averaged_rows(image: Float32Array) -> Float32Array:
    """A frame with about ROWS rows, if it has more."""
    return binned_mean(image, (-(-len(image) // ROWS), 1))


def find_gap(
    frames: Sequence[Float32Array], axis: float, closed: Sequence[float] = ()
) -> Gap | None:
    """The gap that stands out, if there is one.

    Args:
        frames: line integrals of `averaged_rows`, some of a turn.
        axis: column of the axis, to a pixel or two.
        closed: columns of borders beside which the images are filled in.

    Raises:
        NotIdentifiableError: two stand out.
    """
    stack = np.asarray(frames, dtype=np.float64)
    if stack.shape[2] < 8 * SIDE:
        return None
    table = (stack - stack.mean(axis=0)).reshape(-1, stack.shape[2])
    spread = table.std(axis=0)
    dead = spread < 0.1 * median_filter(spread, 4 * SIDE + 1)
    for at in closed:
        dead |= np.abs(np.arange(len(dead)) - at) < SIDE
    steps = np.diff(table, axis=1)
    around = np.lib.stride_tricks.sliding_window_view(steps, 2 * SIDE - 1, axis=1)
    power = np.square(around).sum(axis=2)
    power[:, np.lib.stride_tricks.sliding_window_view(dead, 2 * SIDE).any(axis=1)] = 0.0
    row, border = np.nonzero(power > np.quantile(power, 1.0 - EDGES))
    if not len(row):
        return None
    edges = around[row, border] / np.sqrt(power[row, border])[:, None]
    places, of_frame = power.shape[1], row // stack.shape[1]
    gains = _gains(edges, of_frame * places + border, (len(stack), places))
    place = np.arange(places)
    mirror = np.rint(2 * axis - place - 2 * SIDE + 1).astype(np.intp)
    known = (mirror >= 0) & (mirror < len(place)) & (np.abs(mirror - place) > SIDE + 2)
    gain = gains.max(axis=0)
    gain = gain - np.where(known, 2.0 * maximum_filter1d(gain, 5)[np.where(known, mirror, 0)], 0.0)
    best = int(gain.argmax())
    others = np.where(np.abs(place - best) > SIDE, gain, 0.0)
    second = int(others.argmax())
    if gain[best] < max(EVIDENCE, STANDS_OUT * others[second]):
        third = float(others[np.abs(place - second) > SIDE].max())
        if others[second] < max(EVIDENCE, STANDS_OUT * third):
            return None
        both = sorted((best + SIDE, second + SIDE))
        raise NotIdentifiableError(
            f"from columns {both[0]} and {both[1]} on everything appears nearer, as behind two "
            "gaps between tiles of the panel, of which one can be found; calibrate with a phantom, "
            "and give that correction"
        )
    width = float(WIDTHS[gains[:, best].argmax()])
    # Sharper edges than the usual ones look like a wider gap: drawn ones are off by half of that.
    return Gap(best + SIDE, width, 0.2 + 0.3 * width)


def _gains(edges: FloatArray, place: npt.NDArray[np.intp], shape: tuple[int, int]) -> FloatArray:
    """What gaps of all widths gain at each border over none, less what frames scatter by, (w, b).

    Args:
        edges: differences of neighbouring columns, (k, 2 SIDE - 1).
        place: of each in a table of frames and borders, (k,).
        shape: of that table.
    """
    of_distance = _differences(edges)
    without, out = _likelihood(edges, of_distance, 0.0), []
    for width in WIDTHS.tolist():
        gain = _likelihood(edges, of_distance, width) - without
        of_frames = np.bincount(place, gain, math.prod(shape)).reshape(shape)
        out.append(of_frames.sum(axis=0) - np.sqrt(np.square(of_frames).sum(axis=0)))
    return np.array(out)


def _differences(edges: FloatArray) -> PchipInterpolator:
    """Mean squares of the difference of two columns by their distance, 1 and more [px]."""
    place = np.cumsum(np.pad(edges, ((0, 0), (1, 0))), axis=1)
    far = np.arange(1, 2 * SIDE)
    apart = np.array([np.square(place[:, h:] - place[:, :-h]).mean() for h in far.tolist()])
    more = np.arange(1, math.ceil(WIDTHS[-1]) + 1)
    return PchipInterpolator(
        np.append(far, far[-1] + more), np.append(apart, apart[-1] + (apart[-1] - apart[-2]) * more)
    )


def _likelihood(edges: FloatArray, of_distance: PchipInterpolator, width: float) -> FloatArray:
    """Logarithm of the likelihood of each row (k, 2 SIDE - 1) of differences of neighbours about a
    gap of a width, at its own scale, (k,)."""
    at = np.arange(2 * SIDE) + width * (np.arange(2 * SIDE) >= SIDE)
    distance = np.abs(at[:, None] - at)
    squares = np.where(distance > 0.0, of_distance(np.maximum(distance, 1.0)), 0.0)
    variance, ways = np.linalg.eigh(-0.5 * np.diff(np.diff(squares, axis=0), axis=1))
    variance = np.maximum(variance, 1e-3 * variance[-1])
    white = edges @ (ways / np.sqrt(variance))
    spread = np.log(np.square(white).sum(axis=1)) * (SIDE - 0.5)
    return np.asarray(-spread - float(np.log(variance).sum()) / 2)
