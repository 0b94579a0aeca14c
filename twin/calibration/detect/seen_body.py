"""The phantom's own body in the images: its attenuation and its place.

The body is printed or glued together, and its description states neither its attenuation
in this beam nor, to a hundredth of a millimeter, its place relative to the beads:
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
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.analytic_solids import ConvexPolyhedron, Scene, Shape, Solid

BODY_SAMPLE = 24
"""Windows that are looked at first."""
ADJUSTED_SAMPLE = 200
"""Windows to which the body is adjusted in the end."""
NEAR_PX = 0.5
"""Largest move of the body's image that one linear step is believed [px]."""
LEAST_BODY = 0.3
"""Attenuation of a seen body over the described one below which the body is not this one: one
that is absent, turned or elsewhere has 0.01 to 0.03, one of half the attenuation 0.5."""
PRIOR_MM = 0.5
"""Standard deviation of a body's place about its description [mm]; fixes directions
without an edge."""
FAR_MM = 2.0
"""A body found further away than that is another body."""
BLURRED_FINE = 3
"""Rays along a pixel's side with which a body is rendered that is blurred."""
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
    blur: float | None = None,
    start: SeenBody | None = None,
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
        blur: what pixels and `BLURRED_FINE` rays do not explain of the images' blur [px];
            None: single rays are compared.
        start: a first estimate; None: as described.

    Returns:
        The body; as described (factor 1) if no ring would show any of it. Factor 0 if the
        images do not show it: attenuation below `LEAST_BODY` or a shift above `FAR_MM`.
    """
    frames, beads = _lone(windows, BODY_SAMPLE)
    if len(frames) == 0:
        return SeenBody(1.0)
    few = windows.pick(frames, beads)
    near = cone[frames]
    rings = _rings_of(images[frames, beads], few)
    along = _shift_of_beads(near, model, beads, windows.shape)
    body = start or SeenBody(1.0)
    for turn in range(ROUNDS):
        moved = SeenBody(1.0, body.shift_mm).scene(described)
        # In single rays an edge is where the nearest ray is.
        image = render_windows(moved, near, few, 1 if blur is None else BLURRED_FINE)
        if blur:
            image = blurred_windows(image, blur)
        image = image[:, 0]
        if turn == 0:
            here = rings.levelled(image)
            power = np.einsum("mp,mp->m", here, here)
            push = np.einsum("mp,mp->m", here, rings.seen)
            telling = power > 1e-6 * rings.count
            if not telling.any():
                return SeenBody(1.0)
            # One foreign object in a ring must not decide, so the median over the windows is
            # taken.
            factor = _weighted_median(push[telling] / power[telling], power[telling])
            if factor < LEAST_BODY:
                return SeenBody(0.0)
            body = replace(body, factor=factor)
        right, down = (np.asarray(slope) for slope in np.gradient(image, axis=(2, 1)))
        better = rings.improved(image, (right, down), along, body)
        step = np.subtract(better.shift_mm, body.shift_mm)
        body = better
        far = float(np.linalg.norm(body.shift_mm)) > FAR_MM
        if body.factor < LEAST_BODY or far:
            return SeenBody(0.0)
        if float(np.linalg.norm(step)) < STILL_MM:
            break
    return body


def adjusted(
    images: npt.NDArray[np.float32],
    behind: Float32Array,
    cone: ConeVec,
    model: BeadModel,
    windows: Windows,
    body: SeenBody,
) -> tuple[SeenBody, Float32Array]:
    """Adjust a body that is rendered as the images are to the rings round up to
    `ADJUSTED_SAMPLE` uncrowded beads, by one linear step.

    The noise of the few windows of `see_body` leaves its place some thousandths of a
    millimeter off, in all frames alike.

    Args:
        images: (n, k, side, side) line integrals.
        behind: what the body adds to them, of that shape.
        cone: geometry of the n frames.
        model: the k beads.
        windows: places of the images.
        body: with which `behind` is rendered.

    Returns:
        The adjusted body and what it adds; the same where the images do not show it, or
        not near its place.
    """
    frames, beads = _lone(windows, ADJUSTED_SAMPLE)
    if len(frames) == 0 or not body.factor > 0:
        return body, behind
    rings = _rings_of(images[frames, beads], windows.pick(frames, beads))
    every = [np.asarray(slope) for slope in np.gradient(behind, axis=(3, 2))]
    along = _shift_of_beads(cone[frames], model, beads, windows.shape)
    unit = np.float32(1.0 / body.factor)
    slopes = every[0][frames, beads] * unit, every[1][frames, beads] * unit
    better = rings.improved(behind[frames, beads] * unit, slopes, along, body)
    step = np.subtract(better.shift_mm, body.shift_mm)
    n, k = behind.shape[:2]
    f, b = np.divmod(np.arange(n * k), k)
    moved = (_shift_of_beads(cone[f], model, b, windows.shape) @ step).reshape(n, k, 2)
    if not (better.factor > LEAST_BODY and np.abs(moved).max() < NEAR_PX):
        return body, behind
    right, down = np.moveaxis(moved.astype(np.float32)[..., None, None], 2, 0)
    out = behind * np.float32(better.factor / body.factor)
    out -= right * every[0]
    out -= down * every[1]
    return better, out


def _lone(
    windows: Windows, most: int
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Pick frames and beads of up to `most` uncrowded spots, evenly."""
    frames, beads = np.nonzero(~windows.crowded)
    some = np.linspace(0, len(frames) - 1, min(most, len(frames))).astype(np.intp)
    return frames[some], beads[some]


@dataclass(frozen=True, eq=False)
class _Rings:
    """Surroundings of m beads.

    Attributes:
        inside: (m, side, side) pixels that count.
        count: (m,) their number, 1 at least.
        seen: (m, side * side) line integrals in the images, as of `levelled`.
    """

    inside: npt.NDArray[np.bool_]
    count: npt.NDArray[np.intp]
    seen: FloatArray

    def levelled(self, values: npt.NDArray[Any]) -> FloatArray:
        """Subtract the mean of each ring; see `_levelled`."""
        return _levelled(values, self.inside)

    def improved(
        self,
        image: npt.NDArray[Any],
        slopes: tuple[npt.NDArray[Any], npt.NDArray[Any]],
        along: FloatArray,
        body: SeenBody,
    ) -> SeenBody:
        """Improve factor and shift of a body by one step of least squares.

        Args:
            image: (m, side, side) of the body at its shift with factor 1.
            slopes: its changes by a pixel to the right and down.
            along: as of `_shift_of_beads`.
            body: to improve; its place has a prior of `PRIOR_MM`.
        """
        factor = body.factor
        here = self.levelled(image)
        both = -np.stack([self.levelled(slope) for slope in slopes], axis=-1)
        design = np.concatenate([here[..., None], both @ along], axis=2)
        rest = ((self.seen - factor * here) ** 2).sum(axis=1) / self.count
        typical = max(float(np.median(rest)), 1e-8)
        weight = np.minimum(1.0, 2.0 * typical / np.maximum(rest, 1e-12))
        heavy = (design * weight[:, None, None]).reshape(-1, 4)
        flat = design.reshape(-1, 4)
        normal = flat.T @ heavy
        hold = typical / (factor * PRIOR_MM) ** 2 + 1e-12
        normal[1:, 1:] += hold * np.eye(3)
        pull = heavy.T @ self.seen.ravel()
        pull[1:] -= hold * factor * np.asarray(body.shift_mm)
        found = np.linalg.solve(normal, pull)
        x, y, z = (np.asarray(body.shift_mm) + found[1:] / found[0]).tolist()
        return SeenBody(float(found[0]), (x, y, z))


def _rings_of(images: npt.NDArray[np.float32], few: Windows) -> _Rings:
    """Make the rings of windows (m, side, side) with their images."""
    inside = _rings(few) & np.isfinite(images)
    count = np.maximum(inside.sum(axis=(1, 2)), 1)
    return _Rings(inside, count, _levelled(images, inside))


def _shift_of_beads(
    cone: ConeVec, model: BeadModel, beads: npt.NDArray[np.intp], shape: tuple[int, int]
) -> FloatArray:
    """Compute how spots move with their beads, by a difference of 1 mm.

    `beads`: (m,) bead in each view. Returns (m, 2, 3) pixels per mm along x, y, z.
    """
    one = np.arange(len(beads))
    there = cone.project_points(model.beads, shape)[one, beads]
    moved = [cone.project_points(model.beads + e, shape)[one, beads] for e in np.eye(3)]
    return np.stack([each - there for each in moved], axis=-1)


def _rings(windows: Windows) -> npt.NDArray[np.bool_]:
    """Mark pixels around the beads that no bead touches: between 1.15 radii and 2 px, and 1.6
    radii and 4 px, of the one bead a window. Returns (m, side, side) bool."""
    d2 = distances2(windows.corner, windows.side, windows.predicted)[:, 0]
    radii = windows.radii[:, 0, None, None]
    return np.asarray((d2 > (1.15 * radii + 2.0) ** 2) & (d2 < (1.6 * radii + 4.0) ** 2))


def _levelled(values: npt.NDArray[Any], ring: npt.NDArray[np.bool_]) -> FloatArray:
    """Subtract from the values in each ring their mean.

    `values`: (m, side, side); `ring`: (m, side, side).
    Returns (m, side * side); 0 outside the ring.
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
    """Return a copy of a shape (a polyhedron, or one with a center) moved by `shift` (x,
    y, z) [mm].
    """
    if isinstance(shape, ConvexPolyhedron):
        offsets = np.asarray(shape.offsets) + np.asarray(shape.normals) @ np.asarray(
            shift
        )
        return replace(shape, offsets=tuple(offsets.tolist()))
    x, y, z = (math.fsum(pair) for pair in zip(shape.center, shift, strict=True))
    return replace(shape, center=(x, y, z))
