"""The phantom's own body in the images: its attenuation and its place.

The body is printed or glued together, and its description states neither its attenuation
in this beam nor, to a hundredth of a millimetre, its place relative to the beads:
`see_body` estimates both from the surroundings of some beads, by least squares with
rendered bodies, before the body is subtracted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.windows import (
    Windows,
    blurred_windows,
    distances2,
    render_windows,
)
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.analytic_solids import ConvexPolyhedron, Scene, Shape, Solid

BODY_SAMPLE = 24
"""Windows that are looked at."""
LEAST_BODY = 0.3
"""Attenuation of a seen body over the described one below which the body is not this one: one
that is absent, turned or elsewhere has 0.01 to 0.03, one of half the attenuation 0.5."""
PRIOR_MM = 0.5
"""Standard deviation of a body's place about its description [mm]; fixes directions
without an edge."""
FAR_MM = 2.0
"""A body found further away than that is another body."""
ROUNDS = 4
STILL_MM = 0.01
"""Step of the shift after which the search stops [mm]; the remainder is of second order."""


@dataclass(frozen=True)
class SeenBody:
    """A body as seen in the images.

    Attributes:
        factor: attenuation over the described one; 0 where the images do not show the
            body, nan without a description.
        shift_mm: of its place from the described one, in the phantom's frame.
    """

    factor: float
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def scene(self, described: Scene) -> Scene:
        """Return a new scene of the described body's solids, each shifted by `shift_mm`
        and with its attenuation times `factor`.
        """
        return Scene(
            tuple(
                Solid(
                    _shifted(s.shape, self.shift_mm),
                    s.material,
                    self.factor * s.mu_per_mm,
                )
                for s in described.solids
            )
        )


NO_BODY = SeenBody(math.nan)
"""Value for a phantom without a described body."""


def see_body(
    images: npt.NDArray[np.float32],
    described: Scene,
    cone: ConeVec,
    model: BeadModel,
    windows: Windows,
    blur: float = 0.0,
) -> SeenBody:
    """Estimate attenuation and place of the body in the rings round up to `BODY_SAMPLE`
    uncrowded beads.

    A body that is moved a little moves in each window as its bead would: the image
    changes by the slope of the rendered body along rows and columns, times that shift of
    the bead. The shift has a prior of `PRIOR_MM`; at most `ROUNDS` rounds.

    Args:
        images: (n, k, side, side) line integrals.
        described: the body's solids.
        cone: geometry of the n frames.
        model: the k beads.
        windows: places of the images.
        blur: of the images [px].

    Returns:
        The body; as described (factor 1) if no ring would show any of it. Factor 0 if the
        images do not show it: attenuation below `LEAST_BODY` or a shift above `FAR_MM`.
    """
    frames, beads = np.nonzero(~windows.crowded)
    some = np.linspace(0, len(frames) - 1, min(BODY_SAMPLE, len(frames))).astype(np.intp)
    frames = frames[some]
    beads = beads[some]
    if len(frames) == 0:
        return SeenBody(1.0)
    few = windows.pick(frames, beads)
    near = cone[frames]
    ring = _rings(few) & np.isfinite(images[frames, beads])
    seen = _levelled(images[frames, beads], ring)
    dof = np.maximum(ring.sum(axis=(1, 2)), 1)
    along = _shift_of_beads(near, model, beads, windows.shape)
    body = SeenBody(1.0)
    shift = np.zeros(3)
    for turn in range(ROUNDS):
        moved = SeenBody(1.0, body.shift_mm).scene(described)
        image = render_windows(moved, near, few)
        image = (blurred_windows(image, blur) if blur > 0 else image)[:, 0]
        here = _levelled(np.asarray(image), ring)
        if turn == 0:
            power = np.einsum("mp,mp->m", here, here)
            push = np.einsum("mp,mp->m", here, seen)
            telling = power > 1e-6 * dof
            if not telling.any():
                return SeenBody(1.0)
            # One foreign object in a ring must not decide, so the median over the windows is
            # taken.
            factor = _weighted_median(push[telling] / power[telling], power[telling])
            if factor < LEAST_BODY:
                return SeenBody(0.0)
        down, right = (np.asarray(slope) for slope in np.gradient(image, axis=(1, 2)))
        slopes = -np.stack([_levelled(right, ring), _levelled(down, ring)], axis=-1)
        design = np.concatenate([here[..., None], slopes @ along], axis=2)
        rest = ((seen - factor * here) ** 2).sum(axis=1) / dof
        typical = max(float(np.median(rest)), 1e-8)
        weight = np.minimum(1.0, 2.0 * typical / np.maximum(rest, 1e-12))
        normal = np.einsum("m,mpi,mpj->ij", weight, design, design)
        hold = typical / (factor * PRIOR_MM) ** 2 + 1e-12
        normal[1:, 1:] += hold * np.eye(3)
        pull = np.einsum("m,mpi,mp->i", weight, design, seen)
        pull[1:] -= hold * factor * shift
        found = np.linalg.solve(normal, pull)
        factor = float(found[0])
        step = found[1:] / float(found[0])
        shift = shift + step
        if factor < LEAST_BODY or float(np.linalg.norm(shift)) > FAR_MM:
            return SeenBody(0.0)
        body = SeenBody(factor, (float(shift[0]), float(shift[1]), float(shift[2])))
        if float(np.linalg.norm(step)) < STILL_MM:
            break
    return body


def _shift_of_beads(
    cone: ConeVec, model: BeadModel, beads: npt.NDArray[np.intp], shape: tuple[int, int]
) -> FloatArray:
    """Compute how the spot of a bead moves with the bead, by a difference of 1 mm.

    Args:
        cone: m views.
        model: the beads.
        beads: (m,) number of the bead in each view.
        shape: (rows, cols).

    Returns:
        (m, 2, 3) pixels (column, row) for a millimetre along x, y and z.
    """
    one = np.arange(len(beads))
    there = cone.project_points(model.beads, shape)[one, beads]
    moved = [cone.project_points(model.beads + e, shape)[one, beads] for e in np.eye(3)]
    return np.stack([each - there for each in moved], axis=-1)


def _rings(windows: Windows) -> npt.NDArray[np.bool_]:
    """Mark pixels around the beads that no bead touches: between 1.15 radii and 2 px, and
    1.6 radii and 4 px, of the one bead a window.

    Returns:
        (m, side, side) bool.
    """
    d2 = distances2(windows.corner, windows.side, windows.predicted)[:, 0]
    radii = windows.radii[:, 0, None, None]
    return np.asarray((d2 > (1.15 * radii + 2.0) ** 2) & (d2 < (1.6 * radii + 4.0) ** 2))


def _levelled(values: npt.NDArray[Any], ring: npt.NDArray[np.bool_]) -> FloatArray:
    """Subtract from the values in each ring their mean.

    Args:
        values: (m, side, side).
        ring: (m, side, side).

    Returns:
        (m, side * side); 0 outside the ring.
    """
    inside = np.where(ring, values, 0.0).astype(np.float64)
    mean = inside.sum(axis=(1, 2)) / np.maximum(ring.sum(axis=(1, 2)), 1)
    return np.asarray(
        np.where(ring, inside - mean[:, None, None], 0.0).reshape(len(ring), -1)
    )


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """Return the value below which half of the weight is; (m,) values and weights, one at
    least.
    """
    order = np.argsort(values)
    heap = np.cumsum(weights[order])
    return float(values[order][int(np.searchsorted(heap, 0.5 * heap[-1]))])


def _shifted(shape: Shape, shift: tuple[float, float, float]) -> Shape:
    """Return a copy of a shape (a polyhedron, or one with a centre) moved by `shift` (x,
    y, z) [mm].
    """
    if isinstance(shape, ConvexPolyhedron):
        offsets = np.asarray(shape.offsets) + np.asarray(shape.normals) @ np.asarray(
            shift
        )
        return replace(shape, offsets=tuple(offsets.tolist()))
    x, y, z = (math.fsum(pair) for pair in zip(shape.center, shift, strict=True))
    return replace(shape, center=(x, y, z))
