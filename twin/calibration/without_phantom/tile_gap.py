"""A gap between two tiles of the panel in single frames of a turn.

Structures in a gap are missing: beyond it everything appears nearer by its width, and the
columns next to it differ as columns do that are further apart. The change of columns with
their distance is seen in the frames themselves, everywhere else. Where edges of the
turning object pass a border, the differences of neighboring columns about it are
compared with those expected for a gap of each width: the likelihood of normal
differences, each row of each frame at its own scale. The outline of the object looks like
a gap, too, where its edges turn back, but it does so on both sides of the axis: the gain
at a border's mirror image is subtracted twice. A gap is in all frames, and a few that fit
well prove nothing: the scatter of the frames is subtracted too. Structures that are the
same in all frames (rings, a wrong flat field) are left out, and so are borders near
columns without information.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import maximum_filter1d, median_filter
from scipy.special import ndtr

from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.geometry.panel import Border, Panel

SIDE: Final = 4
"""Number of columns on each side of a border that are compared."""
WIDTHS: Final = np.arange(0.0, 4.01, 0.1)
"""Trial widths of gaps [px]."""
ROWS = 48
FRAMES = 96
"""Rows that a frame is averaged to, and frames that are looked at, where there are more."""
EDGE_SHARE: Final = 0.05
"""Part of all places that is compared, those with most change: edges. Noise has no
information."""
LEAST_VARIANCE: Final = 0.02
"""Least variance of differences, as a share of the largest: possible error of the normal
model."""
EVIDENCE = 24.0
STANDS_OUT = 5.0
"""Gain in log likelihood from which on there is a gap, and times the gain at any other border.
Of 93 drawn scans without a gap one had both, of 69 with one of 0.5 to 2 px 65
(`align_faults.py`)."""


class Gap(NamedTuple):
    """A gap between two tiles: the first column beyond it, and its width, with sigma [px].

    Near the axis a gap moves both ends of all rays alike, so only single frames determine
    its width.
    """

    column: int
    width: float
    sigma: float
    beside_axis: bool = False

    @property
    def text(self) -> str:
        """Description of the gap, in words."""
        return (
            f"from column {self.column} on everything appears nearer by {self.width:.2f} +- "
            f"{self.sigma:.2g} px, as behind a gap between two tiles of the panel"
        )

    def panel(self, shape: tuple[int, int], undone: Panel | None = None) -> Panel:
        """Make the panel of images with this gap, in addition to the distortion undone already.

        `shape`: (rows, cols) of the images. `undone`: that distortion; None: a flat panel.
        Returns a new panel with one border more, at its place before the distortion was undone.
        """
        one = undone or Panel.flat(shape)
        at = np.array([self.column - 0.5, (shape[0] - 1) / 2])
        border = Border(0, float((at + one.shift(at))[0]))
        model = replace(one.model, borders=(*one.model.borders, border))
        return replace(
            one, model=model, coefficients=(*one.coefficients, -self.width, 0.0)
        )


def averaged_rows(image: Float32Array) -> Float32Array:
    """Average a frame to about ROWS rows, if it has more."""
    return binned_mean(image, (-(-len(image) // ROWS), 1))


def local_gaps(
    frames: Sequence[Float32Array], axis: float, closed: Sequence[float] = ()
) -> list[Gap]:
    """Find the borders between panel tiles, at most two, whose likelihood of a gap is
    significant: `EVIDENCE`, and `STANDS_OUT` times that at other borders.

    Edges that mirrored edges at the other side of the axis explain do not count, nor do
    dead columns.

    Args:
        frames: line integrals of `averaged_rows`, some of a turn.
        axis: column of the axis, to a pixel or two.
        closed: columns of borders next to which the images are filled in.

    Returns:
        Gaps with their likeliest width, the best first; empty for fewer than 8 SIDE
        columns, without edges, or if no border stands out.
    """
    stack = np.asarray(frames, dtype=np.float64)
    if stack.shape[2] < 8 * SIDE:
        return []
    table = (stack - stack.mean(axis=0)).reshape(-1, stack.shape[2])
    dead = dead_columns(table)
    for at in closed:
        dead |= np.abs(np.arange(len(dead)) - at) < SIDE
    steps = np.diff(table, axis=1)
    around = np.lib.stride_tricks.sliding_window_view(steps, 2 * SIDE - 1, axis=1)
    power = np.square(around).sum(axis=2)
    power[:, np.lib.stride_tricks.sliding_window_view(dead, 2 * SIDE).any(axis=1)] = 0.0
    row, border = np.nonzero(power > np.quantile(power, 1.0 - EDGE_SHARE))
    if not len(row):
        return []
    edges = around[row, border] / np.sqrt(power[row, border])[:, None]
    places = power.shape[1]
    of_frame = row // stack.shape[1]
    gains = _gains(edges, of_frame * places + border, (len(stack), places))
    place = np.arange(places)
    mirror = np.rint(2 * axis - place - 2 * SIDE + 1).astype(np.intp)
    known = (mirror >= 0) & (mirror < len(place)) & (np.abs(mirror - place) > SIDE + 2)
    gain = gains.max(axis=0)
    gain = gain - np.where(
        known, 2.0 * maximum_filter1d(gain, 5)[np.where(known, mirror, 0)], 0.0
    )
    best = int(gain.argmax())
    others = np.where(np.abs(place - best) > SIDE, gain, 0.0)
    second = int(others.argmax())
    standing = [best]
    if gain[best] < max(EVIDENCE, STANDS_OUT * others[second]):
        third = float(others[np.abs(place - second) > SIDE].max())
        if others[second] >= max(EVIDENCE, STANDS_OUT * third):
            standing = [best, second]
        else:
            standing = []
    found = []
    for one in standing:
        width = float(WIDTHS[gains[:, one].argmax()])
        found.append(Gap(one + SIDE, width, float(local_sigma(width))))
    return found


def dead_columns(table: FloatArray) -> npt.NDArray[np.bool_]:
    """Mark columns that hardly change from frame to frame, as those about them do, (c,).
    `table`: rows of frames without the mean of the frames, (m, c)."""
    spread = table.std(axis=0)
    return np.asarray(spread < 0.1 * median_filter(spread, 4 * SIDE + 1))


def local_sigma(width: FloatArray | float) -> FloatArray:
    """Return the standard deviation of a width that single frames show [px].

    Sharper edges than the usual ones look like a wider gap: drawn ones are off by half of it."""
    return np.asarray(0.2 + 0.3 * np.asarray(width))


def _gains(
    edges: FloatArray, place: npt.NDArray[np.intp], shape: tuple[int, int]
) -> FloatArray:
    """Compute gains in log likelihood of gaps of all WIDTHS at each border over none, less the
    scatter of frames.

    `edges`: differences of neighboring columns, (k, 2 SIDE - 1); `place`: of each in a table of
    frames and borders, (k,); `shape`: of that table.
    Returns (w, b).
    """
    of_distance = squares_by_distance(edges)
    without = likelihood(edges, of_distance, 0.0)
    out = []
    for width in WIDTHS.tolist():
        gain = likelihood(edges, of_distance, width) - without
        of_frames = np.bincount(place, gain, math.prod(shape)).reshape(shape)
        out.append(of_frames.sum(axis=0) - np.sqrt(np.square(of_frames).sum(axis=0)))
    return np.array(out)


def squares_by_distance(edges: FloatArray) -> PchipInterpolator:
    """Fit the mean square of the difference of two columns by their distance, 1 and more
    [px]; continued linearly beyond the columns compared.

    Args:
        edges: differences of neighboring columns, (k, 2 SIDE - 1).

    Returns:
        Function of the distance.
    """
    place = np.cumsum(np.pad(edges, ((0, 0), (1, 0))), axis=1)
    far = np.arange(1, 2 * SIDE)
    apart = np.array(
        [np.square(place[:, h:] - place[:, :-h]).mean() for h in far.tolist()]
    )
    more = np.arange(1, math.ceil(WIDTHS[-1]) + 1)
    return PchipInterpolator(
        np.append(far, far[-1] + more),
        np.append(apart, apart[-1] + (apart[-1] - apart[-2]) * more),
    )


def likelihood(
    edges: FloatArray, of_distance: PchipInterpolator, width: float, blur: float = 0.0
) -> FloatArray:
    """Compute the logarithm of the likelihood of each row of differences about a gap,
    (k,), but for a constant and whatever the row's scale (Student).

    Args:
        edges: differences of neighboring columns, each row at its own scale, (k, 2 SIDE
            - 1).
        of_distance: as `squares_by_distance` gives it.
        width: of the gap [px]; 0: none.
        blur: standard deviation over which the gap is smeared [px].
    """
    columns = np.arange(2 * SIDE)
    beyond = columns - SIDE + 0.5
    if blur > 0.0:
        share = ndtr(beyond / blur)
    else:
        share = (beyond > 0.0).astype(np.float64)
    at = columns + width * share
    distance = np.abs(at[:, None] - at)
    squares = np.where(distance > 0.0, of_distance(np.maximum(distance, 1.0)), 0.0)
    variance, ways = np.linalg.eigh(-0.5 * np.diff(np.diff(squares, axis=0), axis=1))
    variance = np.maximum(variance, LEAST_VARIANCE * variance[-1])
    white = edges @ (ways / np.sqrt(variance))
    spread = np.log(np.square(white).sum(axis=1)) * (SIDE - 0.5)
    return np.asarray(-spread - float(np.log(variance).sum()) / 2)
