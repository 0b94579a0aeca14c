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
    "listed": "images are in the order of their angles",
    "interlaced": "the scan was interlaced, its images in the order of exposure:",
    "reversed": "images are in the reverse order",
    "names": "images are in the alphabetical order of their numbers (1, 10, 2)",
    "span": "the views span",
    "sign": "the panel is offset to the other side",
    "middle": "the panel has no offset",
}
"""Kind of error -> its description."""

SIDES: Final = ("direction", "columns")
"""Kinds that mirror the object or its motion, which beads of known places exclude."""


@dataclass(frozen=True, eq=False)
class Suspect:
    """A scan as it would be with some error.

    Attributes:
        kind: of `KINDS`.
        images: (n, rows, cols).
        cone_vec: n views.
        figure: the right value, in words; "" if the kind is enough.
    """

    kind: str
    images: Float32Array
    cone_vec: ConeVec
    figure: str = ""


def reversed_turn(scan: CoarseScan) -> Suspect:
    """Make the scan with the rotation reversed."""
    turn = 2.0 * (scan.angles[0] - scan.angles)
    return Suspect("direction", scan.images, turned(scan, turn))


def suspects(scan: CoarseScan) -> Iterator[Suspect]:
    """Yield the scan as it would be with each error: the rotation reversed, images mirrored
    left to right, the panel on the other side or without offset, if it has one (above
    `CENTRE_TOLERANCE`), other orders and spans.

    Args:
        scan: coarse; images are mirrored about the middle of the panel with its `rest`.
    """
    images, cone_vec = scan.images, scan.cone_vec
    yield reversed_turn(scan)
    mirrored = moved(cone_vec, scan.rest[1])
    yield Suspect("columns", np.ascontiguousarray(images[:, :, ::-1]), mirrored)
    aside = _axis_from_middle(scan)
    if abs(aside) > CENTRE_TOLERANCE:
        yield Suspect("sign", images, moved(cone_vec, 2.0 * aside))
        yield Suspect("middle", images, moved(cone_vec, aside))
    yield from _orders(scan)


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

    `cone_vec`: n views; `along`: by so many pixels along u, one number or (n,); `down`: by so
    many pixels along v, one number or (n,)."""
    step = np.broadcast_to(along, len(cone_vec))[:, None] * cone_vec.u
    step = step + np.broadcast_to(down, len(cone_vec))[:, None] * cone_vec.v
    panel = cone_vec.detector + step
    return ConeVec.from_vectors(cone_vec.source, panel, cone_vec.u, cone_vec.v)


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
    turns = [
        times for times in (2.0 * np.pi / span, np.pi / span) if abs(times - 1) > 0.1
    ]
    for times in dict.fromkeys([0.5, 2.0, *turns]):
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


def _axis_from_middle(scan: CoarseScan) -> float:
    """Compute where the axis falls along rows, from the middle of the panel with the columns
    that the copy leaves out (`CoarseScan.rest`), averaged over about eight views [coarse
    pixels].

    Args:
        scan: coarse.
    """
    shape = (scan.images.shape[1], scan.images.shape[2])
    views = scan.cone_vec[:: max(1, len(scan.angles) // 8)]
    foot = views.source.copy()
    foot[:, :2] = scan.circle.centre
    each = np.arange(len(views))
    at = views.project_points(foot, shape)[each, each, 0]
    return float(at.mean() - (shape[1] + scan.rest[1] - 1.0) / 2.0)
