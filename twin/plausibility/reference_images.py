"""Comparison of dark and flat images with each other and with the projections."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.plausibility.contradictions import PlausibilityCode

MAX_FLAT_DIFFERENCE: Final = 0.015
"""Largest relative difference of flat images' levels by a tube's own variation."""
MAX_BEAM_DIFFERENCE: Final = 0.03
"""Largest relative difference of open beam and flat image by scatter or a tube's
drift."""
NOISE_SIGMAS: Final = 6.0
"""Differences below this many standard deviations count as noise."""
DARK_BLOCK: Final = 8
"""Pixels of a row whose mean is compared with the dark image's."""
MIN_BLOCKS_SHARE: Final = 1e-3
"""Share of blocks that dead pixels may bring below the dark image."""
STRIP_PART: Final = 0.03
"""Width of a strip at an image's edge, as a share of its columns."""
MAX_STRIP_DIFFERENCE: Final = 0.004
"""Largest relative difference of neighboring strips in the open beam."""
STRIP_BLOCKS: Final = 4
"""Parts of a strip that are compared with each other."""
MIN_OPEN_VIEWS_SHARE: Final = 0.8
"""Least share of the views that must see the open beam on both sides."""


def flat_findings(flats: npt.NDArray[Any], dark: npt.NDArray[Any]) -> Iterator[Finding]:
    """Find flat images of different beams.

    Compares each image's median ratio to the mean flat, over pixels with more than one
    count of signal. Yields at most one warning, its figure the difference of levels as a
    share, if that exceeds `MAX_FLAT_DIFFERENCE` and `NOISE_SIGMAS` of noise; nothing for
    one flat image or without signal.

    Args:
        flats: (k, rows, cols) [counts].
        dark: (rows, cols) [counts].
    """
    if len(flats) < 2:
        return
    signal = np.asarray(flats, dtype=np.float32) - dark
    mean = signal.mean(axis=0)
    alive = mean > 1.0
    if not alive.any():
        return
    ratio = signal[:, alive] / mean[alive]
    level = np.median(ratio, axis=1)
    spread = np.median(np.abs(ratio - level[:, None]), axis=1)
    noise = float((1.4826 * 1.2533 * spread).max() / np.sqrt(ratio.shape[1]))
    apart = float(np.ptp(level))
    if apart > max(MAX_FLAT_DIFFERENCE, NOISE_SIGMAS * noise):
        cause = (
            f"the flat images differ by {100 * apart:.3g} %: level {level.min():.3g} to "
            f"{level.max():.3g} of their mean"
        )
        remedy = "was the current changed between them? use those that belong to the scan"
        yield warning(PlausibilityCode.FLATS_DISAGREE, cause, remedy, figure=apart)


def dark_findings(darks: npt.NDArray[Any], opened: npt.NDArray[Any]) -> Iterator[Finding]:
    """Find dark images of different signals.

    Compares each image's median distance from the first with the open beam. Yields at most one
    warning, its figure the difference as a share of the open beam, if that exceeds
    `MAX_FLAT_DIFFERENCE`, as for flat images, and `NOISE_SIGMAS` of noise; nothing for one
    image or without an open beam.

    Args:
        darks: (k, rows, cols) [counts].
        opened: open beam (rows, cols), flat less dark images, of any dark [counts].
    """
    if len(darks) < 2:
        return
    beam = float(np.median(np.abs(opened)))
    apart = np.asarray(darks, dtype=np.float32).reshape(len(darks), -1)
    apart = apart - apart[0]
    level = np.median(apart, axis=1)
    spread = np.median(np.abs(apart - level[:, None]), axis=1)
    noise = float((1.4826 * 1.2533 * spread).max() / np.sqrt(apart.shape[1]))
    off = float(np.ptp(level))
    if beam > 0.0 and off > max(MAX_FLAT_DIFFERENCE * beam, NOISE_SIGMAS * noise):
        cause = (
            f"the dark images differ by {off:.4g} counts, {100 * off / beam:.3g} % of the open "
            "beam"
        )
        remedy = "was the tube off in all of them? leave out those that are not dark"
        yield warning(PlausibilityCode.DARKS_DISAGREE, cause, remedy, figure=off / beam)


def below_dark_findings(
    views: npt.NDArray[Any], dark: npt.NDArray[Any]
) -> Iterator[Finding]:
    """Find projections that are darker than the dark image.

    Without X-rays a panel counts least: a block of `DARK_BLOCK` pixels of a row whose mean is
    below the dark image's by more than `NOISE_SIGMAS` standard errors, and by a count,
    contradicts it. Noise is that of neighbors in a row. Yields at most one warning, its figure
    the share of such blocks, above `MIN_BLOCKS_SHARE`.

    Args:
        views: (k, rows, cols) [counts].
        dark: mean dark image (rows, cols) [counts].
    """
    cols = views.shape[2] // DARK_BLOCK * DARK_BLOCK
    if not cols or not len(views):
        return
    below = np.asarray(views, dtype=np.float32)[..., :cols] - dark[:, :cols]
    steps = np.median(np.abs(np.diff(below, axis=2)))
    error = 1.4826 * float(steps) / np.sqrt(2.0 * DARK_BLOCK)
    means = below.reshape(*below.shape[:2], -1, DARK_BLOCK).mean(axis=-1)
    share = float((means < -max(NOISE_SIGMAS * error, 1.0)).mean())
    if share > MIN_BLOCKS_SHARE:
        cause = f"{100 * share:.3g} % of the projections is darker than the dark image"
        remedy = "was the tube off in it, at the projections' exposure?"
        yield warning(PlausibilityCode.DARK_NOT_DARK, cause, remedy, figure=share)


def beam_findings(levels_seen: Sequence[float | None]) -> Iterator[Finding]:
    """Find an open beam at the object's side that differs from the flat image.

    Yields at most one warning, its figure the highest level: if that exceeds 1 by more
    than `MAX_BEAM_DIFFERENCE`, or the levels differ by as much and drift steadily.
    Nothing if fewer than two views, or than `MIN_OPEN_VIEWS_SHARE` of them, show the
    beam; nor for a beam that is only darker and does not drift.

    Args:
        levels_seen: open beam in some views (`open_beam`), relative to the flat image;
            None where a view does not show it.
    """
    found = [level for level in levels_seen if level is not None]
    if len(found) < max(2.0, MIN_OPEN_VIEWS_SHARE * len(levels_seen)):
        return
    levels = np.array(found)
    high = float(levels.max())
    apart = float(np.ptp(levels))
    if high <= 1.0 + MAX_BEAM_DIFFERENCE and not (
        apart > MAX_BEAM_DIFFERENCE and _drifts(levels)
    ):
        return  # an object that reaches beyond both edges is as dark
    span = " to ".join(dict.fromkeys(f"{level:.3g}" for level in (levels.min(), high)))
    cause = f"the open beam beside the object is {span} times the flat image"
    remedy = "another current (or scatter): a flat image of the scan's own beam is needed"
    yield warning(PlausibilityCode.FLATS_DISAGREE, cause, remedy, figure=high)


def _drifts(levels: FloatArray) -> bool:
    """Return whether levels rise or fall steadily: none is off the fitted straight line by 30 %
    of their range or more.

    `levels`: (k,) in the order of the views."""
    line = np.polyval(
        np.polyfit(np.arange(len(levels)), levels, 1), np.arange(len(levels))
    )
    return float(np.abs(levels - line).max()) < 0.3 * float(np.ptp(levels))


def open_beam(
    counts: npt.NDArray[Any], dark: npt.NDArray[Any], opened: npt.NDArray[Any]
) -> float | None:
    """Compute the open beam's level at an image's left and right edges, relative to the
    flat.

    Each edge is two strips of `STRIP_PART` of the columns. Both strips and their
    `STRIP_BLOCKS` blocks must have one level within `MAX_STRIP_DIFFERENCE` or noise, and
    both edges must agree.

    Args:
        counts: the image (rows, cols).
        dark: (rows, cols) [counts].
        opened: flat less dark image (rows, cols) [counts]; NaN where there is no beam.

    Returns:
        Mean level of both edges; None where the object or its scatter reaches an edge,
        the edges differ, a block has no finite pixel, or the image is too small.
    """
    rows, cols = counts.shape
    wide = max(1, int(STRIP_PART * cols))
    if cols < 8 * wide or rows < 2 * STRIP_BLOCKS:
        return None
    levels = []
    for some in (slice(2 * wide), slice(-1, -2 * wide - 1, -1)):
        turned = (counts[:, some] - dark[:, some]) / opened[:, some]
        outer = _blocks(turned[:, :wide])
        inner = _blocks(turned[:, wide : 2 * wide])
        both = np.concatenate([outer, inner])
        if not np.isfinite(both).all():
            return None
        spread = float(np.nanstd(turned[:, : 2 * wide]))
        sigma = spread / np.sqrt(rows * wide)
        if abs(float(outer.mean() - inner.mean())) > max(
            MAX_STRIP_DIFFERENCE, NOISE_SIGMAS * sigma
        ):
            return None
        if float(np.ptp(both)) > max(
            2.5 * MAX_STRIP_DIFFERENCE, NOISE_SIGMAS * sigma * np.sqrt(2 * STRIP_BLOCKS)
        ):
            return None
        levels.append(float(both.mean()))
    left, right = levels
    if abs(left - right) <= 2.5 * MAX_STRIP_DIFFERENCE * max(left, right):
        return 0.5 * (left + right)
    return None


def _blocks(strip: npt.NDArray[Any]) -> FloatArray:
    """Average `STRIP_BLOCKS` parts of a strip, from top to bottom, over finite pixels;
    NaN for a part without any."""
    parts = [part[np.isfinite(part)] for part in np.array_split(strip, STRIP_BLOCKS)]
    return np.array([float(part.mean()) if part.size else np.nan for part in parts])
