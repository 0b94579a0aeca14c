"""Possible errors of a scan: images and geometries as each would make them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.coarse_scan import CoarseScan

INTERLACED_PASSES: Final = (2, 3, 4)
"""Numbers of passes of interlaced scans that are tried."""
MAX_STEP_SCATTER: Final = 0.5
"""Largest difference of the steps between views that counts as even, over their median."""
CENTRE_TOLERANCE: Final = 0.25
"""Largest distance of the axis from the panel's middle that counts as zero [coarse
pixels]."""

KINDS: Final = {
    "direction": "the rotation runs the other way",
    "columns": "images are mirrored left to right",
    "rows": "images are mirrored top to bottom",
    "turned": "images are turned by 180 degrees",
    "listed": "images are in the order of their angles",
    "interlaced": "the scan was interlaced, its images in the order of exposure:",
    "reversed": "images are in the reverse order",
    "names": "images are in the alphabetical order of their numbers (1, 10, 2)",
    "span": "the views span",
    "sign": "the panel is offset to the other side",
    "middle": "the panel has no offset",
    "height": "the panel's offset along the axis has the other sign",
    "offset": "the panel, or the axis, is moved:",
    "movement": "object or scanner moved between views:",
}
"""Kind of error -> its description."""

SIDES: Final = ("direction", "columns", "rows", "turned")
"""Kinds that mirror the object or its motion, which beads of known places exclude."""


@dataclass(frozen=True, eq=False)
class Suspect:
    """A scan as it would be with some error.

    Attributes:
        kind: of `KINDS`.
        images: (n, rows, cols).
        cone_vec: n views.
        figure: the right value, in words; "" if the kind is enough.
        shifts: (n, 2) by which each image is to the right and below [coarse pixels], or
            None. Images are shifted back before they are reconstructed.
    """

    kind: str
    images: Float32Array
    cone_vec: ConeVec
    figure: str = ""
    shifts: FloatArray | None = None


def reversed_turn(scan: CoarseScan) -> Suspect:
    """Make the scan with the rotation reversed."""
    turn = 2.0 * (scan.angles[0] - scan.angles)
    return Suspect("direction", scan.images, turned(scan, turn))


def suspects(scan: CoarseScan, *, whole: bool) -> Iterator[Suspect]:
    """Yield all suspects except the reversed rotation and other distances of the panel.

    Args:
        scan: coarse.
        whole: the panel sees the complete object; if not, only mirrored columns, a panel
            offset to the other side and one without offset are suspected, which make an
            object seem cut off.

    Yields:
        Mirrored columns (of a truncated scan only with an offset), offsets along rows if
        above `CENTRE_TOLERANCE`; for a whole scan also mirrored rows, both mirrored,
        other orders and spans, and the opposite offset along columns if above it. Images
        are mirrored about the middle of the panel with `CoarseScan.rest`.
    """
    images = scan.images
    cone_vec = scan.cone_vec
    below, beside = scan.rest
    aside, above = _axis_from_middle(scan)
    offset = abs(aside) > CENTRE_TOLERANCE
    if whole or offset:
        mirrored = moved(cone_vec, beside)
        yield Suspect("columns", np.ascontiguousarray(images[:, :, ::-1]), mirrored)
    if offset:
        yield Suspect("sign", images, moved(cone_vec, 2.0 * aside))
        yield Suspect("middle", images, moved(cone_vec, aside))
    if not whole:
        return
    upside_down = moved(cone_vec, 0.0, below)
    yield Suspect("rows", np.ascontiguousarray(images[:, ::-1]), upside_down)
    turned_panel = moved(cone_vec, beside, below)
    yield Suspect("turned", np.ascontiguousarray(images[:, ::-1, ::-1]), turned_panel)
    yield from _orders(scan)
    if abs(above) > CENTRE_TOLERANCE:
        yield Suspect("height", images, moved(cone_vec, 0.0, 2.0 * above))


def turned(scan: CoarseScan, turn: FloatArray, *, rising: bool = False) -> ConeVec:
    """Rotate source and panel of each view about the scan's axis, each by its own angle;
    the images stay.

    Args:
        scan: n views.
        turn: (n,) along the scan's angles [rad]: counter-clockwise, and of a helix that
            rises clockwise the other way.
        rising: along the helix, if it is one, not at the same height.
    """
    sense = _sense(scan)
    cos = np.cos(sense * turn)
    sin = np.sin(sense * turn)
    up = np.zeros((len(turn), 3))
    if rising:
        up[:, 2] = scan.circle.rise * turn / (2.0 * np.pi)
    centre = np.append(scan.circle.centre, 0.0)

    def about(vectors: FloatArray) -> FloatArray:
        x, y, z = vectors.T
        return np.column_stack([cos * x - sin * y, sin * x + cos * y, z])

    views = scan.cone_vec
    source, panel = (
        about(place - centre) + centre + up for place in (views.source, views.detector)
    )
    return ConeVec.from_vectors(source, panel, about(views.u), about(views.v))


def _sense(scan: CoarseScan) -> float:
    """Return -1 for a helix that rises clockwise, whose angles are counted upwards; else
    1.
    """
    if not scan.circle.rise:
        return 1.0
    first, second = scan.cone_vec.source[:2, :2] - scan.circle.centre
    return float(np.sign(first[0] * second[1] - first[1] * second[0]))


def moved(
    cone_vec: ConeVec, along: float | FloatArray, down: float | FloatArray = 0.0
) -> ConeVec:
    """Move panels along their rows and down their columns; the source stays.

    Args:
        cone_vec: n views.
        along: by so many pixels along u, one number or (n,).
        down: by so many pixels along v, one number or (n,).
    """
    step = np.broadcast_to(along, len(cone_vec))[:, None] * cone_vec.u
    step = step + np.broadcast_to(down, len(cone_vec))[:, None] * cone_vec.v
    panel = cone_vec.detector + step
    return ConeVec.from_vectors(cone_vec.source, panel, cone_vec.u, cone_vec.v)


def shifts_of(scan: CoarseScan, suspect: Suspect) -> FloatArray:
    """Compute the shifts of images to the right and below that a panel at another place
    makes, (n, 2) [coarse pixels].

    Args:
        scan: coarse, n views.
        suspect: the same images, and each panel moved in its plane.
    """
    stated = scan.cone_vec
    step = suspect.cone_vec.detector - stated.detector
    along, down = (
        (step * axis).sum(axis=1) / np.square(axis).sum(axis=1)
        for axis in (stated.u, stated.v)
    )
    return -np.column_stack([along, down])


def _orders(scan: CoarseScan) -> Iterator[Suspect]:
    """Yield suspected scans whose images belong to other angles: in another order
    (`_permutations`), then over half and twice the span; each with the same images and
    its views turned.

    Args:
        scan: coarse; orders are those of all its original views.
    """
    angle = scan.circle.angle
    count = len(angle)
    for kind, order, figure in _permutations(angle):
        turn = angle[order][scan.numbers] - scan.angles
        views = turned(scan, turn, rising=True)
        yield Suspect(kind, scan.images, views, figure)
    run = np.unwrap(angle) - angle[0]
    span = float(np.ptp(run)) * count / max(count - 1, 1)
    for times in (0.5, 2.0):
        figure = f"{np.rad2deg(times * span):.0f} and not {np.rad2deg(span):.0f} degrees"
        turn = (times - 1.0) * run[scan.numbers]
        yield Suspect("span", scan.images, turned(scan, turn), figure)


def _permutations(angle: FloatArray) -> Iterator[tuple[str, npt.NDArray[np.intp], str]]:
    """Yield orders in which images may have been taken.

    Args:
        angle: (n,) of the views [rad].

    Yields:
        Kind, the view whose angle each image has (n,), and a description. For angles that
        steadily grow or fall: interlaced in each of `INTERLACED_PASSES`, the alphabetical
        order of numbers, and where steps are uneven the reverse order, with the first
        view first and last; else only sorted by angle ("listed").
    """
    count = len(angle)
    listed = np.arange(len(angle))
    steps = np.diff(np.unwrap(angle))
    if (steps > 0.0).all() or (steps < 0.0).all():
        for passes in INTERLACED_PASSES:
            order = np.concatenate([listed[first::passes] for first in range(passes)])
            yield "interlaced", order, f"in {passes} passes"
        names = np.array(sorted(range(count), key=str))
        yield "names", names, ""
        if np.ptp(steps) > MAX_STEP_SCATTER * abs(float(np.median(steps))):
            # With even steps they are the opposite rotation.
            yield "reversed", listed[::-1], ""
            yield "reversed", np.roll(listed[::-1], 1), ""
        return
    yield "listed", np.argsort(angle, kind="stable"), ""


def _axis_from_middle(scan: CoarseScan) -> tuple[float, float]:
    """Compute where the source's foot on the axis falls, from the middle of the panel
    with the rows and columns that the copy leaves out (`CoarseScan.rest`), averaged over
    about eight views.

    Args:
        scan: coarse.

    Returns:
        offset along rows and down columns [coarse pixels].
    """
    shape = (scan.images.shape[1], scan.images.shape[2])
    x, y = scan.circle.centre
    views = scan.cone_vec[:: max(1, len(scan.angles) // 8)]
    foot = views.source.copy()
    foot[:, :2] = x, y
    each = np.arange(len(views))
    at = views.project_points(foot, shape)[each, each]
    middle = (np.array(shape[::-1]) + scan.rest[::-1] - 1.0) / 2.0
    along, down = at.mean(axis=0) - middle
    return float(along), float(down)
