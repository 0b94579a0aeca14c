"""Lag of the camera: a faint second image of a bead at its place in the frame before.

The bead's place in the next frame is still empty: structures that both places have in
common (the body, the panel) are no lag.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.detect.windows import (
    Windows,
    distances2,
)
from flexdt.twin.calibration.frame_source import Frames
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

MIN_LAG_SIGMAS = 5.0
"""Sigmas from which lag is removed. The beads must agree: structures that turn with the
object, ahead of one bead or behind it, look like lag of that bead alone."""
SEEN_AT_LEAST = 0.002
"""Lag below which it is left: a ghost so faint moves no shadow by a thousandth of its width."""
LEAST_LIGHT = 0.005
"""Part of the open beam that is left at least where lag is taken out of a shadow."""
LAG_SAMPLE = 48
"""Frames that are looked at, about."""
FEWEST_BEADS = 3
"""Beads from which lag is estimated at least."""


@dataclass(frozen=True)
class Lag:
    """Part of a frame that the next one shows, and its standard deviation."""

    part: float = 0.0
    sigma: float = math.inf

    @property
    def seen(self) -> bool:
        """It is there beyond doubt."""
        return self.part > max(MIN_LAG_SIGMAS * self.sigma, SEEN_AT_LEAST)


def lag_of(
    images: Float32Array,
    frames: Frames,
    plan: Windows,
    usable: npt.NDArray[np.bool_] | None = None,
) -> Lag:
    """Estimate the lag of a scan, from places far from all beads of the frame itself.

    The shadow of the frame before, less that of the frame after, is searched there in
    about `LAG_SAMPLE` frames; a smooth body is subtracted.

    Args:
        images: (n, k, side, side) windows of the plan, line integrals.
        frames: of the scan, in the order in which they were taken; windows of
            neighboring frames are read.
        plan: windows round the beads of each frame.
        usable: (n,) frames that show the beads where the plan has them; None: all.

    Returns:
        The share of the frame before, 0 or more, and its sigma from the scatter of the
        beads; `Lag()`, which is unseen, if fewer than `FEWEST_BEADS` beads have clear
        places.
    """
    light = np.exp(-images)
    if usable is not None:  # One that shows what the frame before shows is no lag.
        light[~usable] = np.nan
    sums = []
    some = slice(None, None, max(1, len(light) // LAG_SAMPLE))
    for step in (1, -1):
        there = _rolled(plan, step)
        shadow = np.roll(light, step, axis=0)
        shadow[0 if step == 1 else -1] = np.nan  # the first has none before it
        shown = np.exp(-frames.windows(there)[some])
        near = _near(there.corner[some], plan, some)
        if usable is not None:
            shown[~usable[some]] = np.nan
        sums.append(_products(shown, np.where(near, np.nan, shadow[some])))
    (with_before, before), (with_after, after) = sums
    if min(np.count_nonzero(before), np.count_nonzero(after)) < FEWEST_BEADS:
        return Lag()
    one, other = (
        float(p.sum() / q.sum()) for p, q in ((with_before, before), (with_after, after))
    )
    apart = (with_before - one * before) / before.sum() - (
        with_after - other * after
    ) / after.sum()
    part = max(one - other, 0.0)
    return Lag(part / (1.0 + part), math.sqrt(float((apart**2).sum())))


def without_lag(frames: Frames, plan: Windows, lag: Lag) -> Float32Array:
    """Remove the lag of the two frames before from windows round the beads of every
    frame.

    Pixels without a value in a frame before stay as they are; `LEAST_LIGHT` of the open
    beam or more is left. `frames`: of the scan, in the order taken. Returns line
    integrals (n, k, side, side), nan where a frame has no image.
    """
    light = np.full((*plan.corner.shape[:2], plan.side, plan.side), np.nan)
    for back in (2, 1, 0):
        shown = np.exp(-np.roll(frames.windows(_rolled(plan, -back)), back, axis=0))
        shown[:back] = np.nan
        rest = np.maximum((shown - lag.part * light) / (1.0 - lag.part), LEAST_LIGHT)
        light = np.where(np.isfinite(rest), rest, shown)
    return np.asarray(-np.log(light), dtype=np.float32)


def _rolled(plan: Windows, step: int) -> Windows:
    """Return the plan with each frame's places replaced by those of the frame `step` before."""
    names = ("corner", "predicted", "radii", "stretch", "share", "crowded", "whole")
    return replace(plan, **{n: np.roll(getattr(plan, n), step, axis=0) for n in names})


def _near(
    corner: npt.NDArray[np.int64], plan: Windows, some: slice
) -> npt.NDArray[np.bool_]:
    """Mark pixels of windows within reach of any bead that is predicted in that frame: 1.12
    times its longer semi-axis and 3 px.

    `corner`: (n, k, 2) corners of the windows; `plan`: gives predictions and the size of
    windows; `some`: frames of the plan, n of them.
    Returns (n, k, side, side) bool."""
    reach = (1.12 * plan.radii * plan.stretch[..., 2] + 3.0)[some]
    out = np.zeros((*corner.shape[:2], plan.side, plan.side), dtype=bool)
    for bead in range(reach.shape[1]):
        d2 = distances2(corner, plan.side, plan.predicted[some, bead, None])
        out |= d2 <= (reach[:, bead] ** 2)[:, None, None, None]
    return out


def _products(light: Float32Array, shadow: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sum products over windows, less a paraboloid each: shadow times image, shadow
    squared.

    Both are (n, k, side, side); pixels finite in both count. Returns (k,) each, 0 without
    any.
    """
    use = np.isfinite(light) & np.isfinite(shadow)
    one, other = (_bent(values, use) for values in (shadow, light))
    return (one * other).sum(axis=(0, 2, 3)), (one * one).sum(axis=(0, 2, 3))


def _bent(light: npt.NDArray[Any], use: npt.NDArray[np.bool_]) -> FloatArray:
    """Subtract a paraboloid, fitted to the usable pixels of each window (the body), from
    them.

    Args:
        light: (n, k, side, side) values of the windows, square.
        use: (n, k, side, side) usable pixels.

    Returns:
        The residuals, of that shape; 0 in pixels that are not usable.
    """
    x = np.linspace(-1.0, 1.0, light.shape[-1])
    right, down = np.broadcast_arrays(x[None, :], x[:, None])
    terms = np.stack([right**0, right, down, right**2, right * down, down**2])
    normal = np.einsum("nkrc,arc,brc->nkab", use, terms, terms) + 1e-9 * np.eye(
        len(terms)
    )
    values = np.where(use, light, 0.0)
    push = np.einsum("nkrc,arc->nka", values, terms)
    smooth = np.einsum(
        "nka,arc->nkrc", np.linalg.solve(normal, push[..., None])[..., 0], terms
    )
    return np.where(use, values - smooth, 0.0)
