"""Blocks of frames left out: do the others predict where they show the beads?

The one alarm that has no cause in mind. In a right model the residuals of a bead in neighboring
frames have nothing in common, so that the mean place of each bead in a block of frames is
predicted from the scatter within blocks and the posterior of everything else. All blocks make one
F test, in closed form: to leave a block's mean out is to give it a column of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import fdtrc

from flexdt.twin.calibration.diagnose.table.posterior import Model, Search
from flexdt.twin.geometry.conventions import FloatArray

BLOCKS: Final = 8
"""Blocks of a scan."""
LEAST_FRAMES: Final = 3
"""Frames of a block."""
ROUNDING: Final = 1e-6
"""Part of the largest eigenvalue below which a mean is no news beside the model's columns."""


@dataclass(frozen=True)
class HeldOut:
    """Blocks of frames, beside their predictions.

    Attributes:
        chance: probability of so large a difference in a right model.
        frames: first and last frame of the block that is predicted worst, from 0.
        off_px: root mean square of what is off there, over the beads' means [px].
    """

    chance: float
    frames: tuple[int, int] = (0, 0)
    off_px: float = 0.0


NOT_HELD_OUT: Final = HeldOut(1.0)
"""Of scans with too few frames, or too few positions to spare."""


def held_out(search: Search, model: Model) -> HeldOut:
    """Compare each block's mean places of beads with what all else predicts.

    Args:
        search: of the table.
        model: that explains it.
    """
    table = search.table
    block = _blocks(table.scans, table.n)
    count = int(block.max(initial=-1)) + 1
    if count == 0:
        return NOT_HELD_OUT
    weight = np.repeat(table.weight, 2, axis=1)
    sums = np.zeros((count, table.n))
    sums[block[block >= 0], np.flatnonzero(block >= 0)] = 1.0
    own = (sums @ weight**2).ravel()
    columns = search.columns(model)
    rest = table.values - columns @ model.solved.mean
    values = np.column_stack([columns, rest]).reshape(table.n, weight.shape[1], -1)
    crossed = np.einsum("bn,nq,nqp->bqp", sums, weight, values, optimize=True)
    crossed = crossed.reshape(len(own), -1)
    seen = own > 0.0
    if not seen.any():
        return NOT_HELD_OUT
    root = np.sqrt(own[seen])
    taken, off = crossed[seen, :-1] / root[:, None], crossed[seen, -1] / root
    news = np.eye(len(off)) - taken @ (model.solved.covariance / model.noise2) @ taken.T
    values_, vectors = np.linalg.eigh((news + news.T) / 2)
    told = values_ > ROUNDING
    square = float(np.sum((vectors.T @ off)[told] ** 2 / values_[told]))
    freedom = table.count + search.freedom - table.parameters - int(told.sum())
    left = model.solved.rest + search.freedom * search.spread**2
    left += model.noise2 * model.solved.moved - square
    if not (freedom > 0.0 and left > 0.0 and told.any()):
        return NOT_HELD_OUT
    chance = float(
        fdtrc(int(told.sum()), freedom, square / told.sum() / (left / freedom))
    )
    return HeldOut(chance, *_worst(search, block, crossed[:, -1], own))


def _blocks(scans: Sequence[npt.NDArray[np.intp]], n: int) -> npt.NDArray[np.intp]:
    """Return the number of the block of each frame, (n,); -1 in scans too short for two."""
    out = np.full(n, -1)
    count = 0
    for frames in scans:
        some = min(BLOCKS, len(frames) // LEAST_FRAMES)
        if some < 2:
            continue
        out[frames] = count + np.arange(len(frames)) * some // len(frames)
        count += some
    return out


def _worst(
    search: Search, block: npt.NDArray[np.intp], off: FloatArray, own: FloatArray
) -> tuple[tuple[int, int], float]:
    """Find the block whose beads' means are furthest off.

    Args:
        search: of the table.
        block: (n,) of each frame.
        off, own: (blocks * 2 k,) sums of residuals and of squared weights.

    Returns:
        Its first and last frame, and the root mean square of the means there [px].
    """
    table = search.table
    shape = (int(block.max()) + 1, table.k, 2)
    square = np.divide(off**2, own, where=own > 0.0, out=np.zeros_like(off))
    worst = int(square.reshape(shape[0], -1).sum(axis=1).argmax())
    frames = np.flatnonzero(block == worst)
    mean = np.divide(off, own, where=own > 0.0, out=np.zeros_like(off)).reshape(shape)
    rows = np.zeros((table.n, table.k, 2))
    rows[frames] = mean[worst] * table.weight[frames][..., None]
    shift = table.shift_of(rows.reshape(-1))[frames]
    there = table.weight[frames] > 0.0
    rms = math.sqrt(float(np.square(shift[there]).sum(axis=1).mean()))
    return (int(frames[0]), int(frames[-1])), rms
