"""Warn of saturated, starved and dark images before line integrals are made of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.image_set import Counts, ImageSet
from flexdt.library.datasets.reference_look import looked_at
from flexdt.runtime.files.dataset_folder import read_image
from flexdt.twin.dataset.dataset_errors import DatasetError, DatasetFormatError
from flexdt.twin.physics.exposure import FEW_COUNTS, WARNING_SHARE
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.reference_images import (
    beam_findings,
    open_beam,
)

MAX_FROM_DISK: Final = 32
"""Radiographs in files that are looked at."""
RADIOGRAPHS: Final = "radiographs"
FLAT_IMAGE: Final = "flat image"
SATURATED: Final = "are saturated, where attenuation comes out wrong"
"""Words that every sentence about saturated images contains."""
UNLIT: Final = "not brighter in the flat image than in the dark one"
"""Words of the sentence about pixels without an open beam."""
DARK: Final = (
    "no pixel of the flat images is brighter than the dark ones: was the tube off?"
)


def saturated_part(what: str, share: float) -> str:
    """Say which part of some images is saturated, with the remedy.

    `what`: which images; `share`: of their pixels, 0 to 1.
    """
    return (
        f"{100.0 * share:.3g} % of the pixels of the {what} {SATURATED}: "
        "lower the tube's power or the exposure"
    )


def first_look(paths: Mapping[str, Path], full_scale: int) -> list[str]:
    """Check images of each kind for saturation before anything is computed from them.

    Returns a sentence of the first kind with `WARNING_SHARE` of its pixels saturated;
    else []. Unreadable images are skipped.
    """
    for kind, path in paths.items():
        try:
            share = float((read_image(path) >= full_scale).mean())
        except (OSError, DatasetError):
            continue
        if share >= WARNING_SHARE:
            return [saturated_part(kind, share)]
    return []


def image_doubts(
    scan: ImageSet, *, needed: bool = False, counts: Callable[[int], Counts] | None = None
) -> list[str]:
    """Find saturated or starved pixels and changes of the beam that make line integrals
    doubtful.

    Saturated pixels have the panel's largest count, or else the images', if converters
    end there (2^bits - 1). All radiographs in memory are examined, `MAX_FROM_DISK` of
    those in files, and the flat image. A share of `WARNING_SHARE` is a doubt; starved
    pixels have fewer than `FEW_COUNTS` above dark. Pixels without an open beam have their
    own; they and interpolated ones are left out of others.

    `counts` gives those of a frame by its index; None reads them. Returns [] where line
    integrals were given.
    Raises DatasetFormatError: these are `needed`, and the images hold none.
    """
    if scan.arrays is not None and scan.arrays.integrals is not None:
        return []  # they were given, not exposed
    flat = scan.flat
    dark = scan.dark
    alive = flat > dark
    unlit = 1.0 - float(alive.mean())
    if scan.interpolated is not None and (alive & ~scan.interpolated).any():
        alive &= ~scan.interpolated
    held = bool(alive.any())
    doubts = [DARK]
    if held:
        shares = _shares(scan, alive, counts)
        held = min(shares.saturated.values()) <= 1.0 - WARNING_SHARE
        doubts = [*_sentences(shares, unlit)]
        if held:
            told = looked_at(scan).references or ()
            doubts += settled(told or beam_findings(shares.beam), DatasetFormatError)
    if needed and not held:
        raise DatasetFormatError(
            f"{scan.where}: the images hold no line integrals; {'; '.join(doubts)}",
            {"path": scan.where},
        )
    return doubts


@dataclass(frozen=True)
class _Shares:
    """Parts of the pixels of a scan's images that are out of range.

    Attributes:
        saturated: kind of image -> part of its pixels.
        starved: part of the radiographs' pixels.
        beam: open beam of each radiograph, as `open_beam` tells it.
    """

    saturated: Mapping[str, float]
    starved: float
    beam: list[float | None]


def _shares(
    scan: ImageSet,
    alive: npt.NDArray[np.bool_],
    counts: Callable[[int], Counts] | None,
) -> _Shares:
    """Measure saturated and starved pixels of radiographs and flat image, and the open
    beam of each radiograph.

    Args:
        scan: the data set.
        alive: pixels to measure, at least one.
        counts: gives those of a frame in a file; None reads them.
    """
    flat = scan.flat
    dark = scan.dark
    wanted = scan.present
    in_files = scan.arrays is None or scan.arrays.counts is None
    look = scan.counts if counts is None or not in_files else counts
    if in_files:
        some = np.linspace(0, len(wanted) - 1, MAX_FROM_DISK).astype(int)
        wanted = tuple(wanted[i] for i in np.unique(some))
    top: float | None = scan.full_scale
    if top is None:
        top = float(max(flat.max(), max(int(look(i).max()) for i in wanted)))
        if not np.log2(top + 1.0).is_integer():
            top = np.inf
    few = dark[alive] + FEW_COUNTS
    opened = np.where(alive, flat - dark, np.nan)
    beam: list[float | None] = []
    each: list[tuple[float, float]] = []
    for i in wanted:
        image = look(i)
        seen = image[alive]
        each.append(((seen >= top).mean(), (seen < few).mean()))
        beam.append(open_beam(image, dark, opened))
    saturated, starved = np.mean(each, axis=0)
    in_flat = float((flat[alive] >= top).mean())
    return _Shares(
        {RADIOGRAPHS: float(saturated), FLAT_IMAGE: in_flat}, float(starved), beam
    )


def _sentences(shares: _Shares, unlit: float) -> Iterator[str]:
    """Yield a sentence for each share that reaches `WARNING_SHARE`: saturated, unlit and
    starved pixels, in this order.

    Args:
        shares: of the images.
        unlit: part of the pixels that has no open beam.
    """
    for kind, share in shares.saturated.items():
        if share >= WARNING_SHARE:
            yield saturated_part(kind, share)
    if unlit >= WARNING_SHARE:
        yield (
            f"{100.0 * unlit:.3g} % of the pixels are {UNLIT}: their line integrals are "
            "interpolated from their neighbours'"
        )
    if shares.starved >= WARNING_SHARE:
        yield (
            f"{100.0 * shares.starved:.3g} % of the pixels of the radiographs are starved "
            f"(fewer than {FEW_COUNTS:g} counts of signal), where attenuation is mostly "
            "noise: raise the tube's power, its voltage or the exposure"
        )
