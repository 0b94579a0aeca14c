"""Faults of detector and beam in the images: are they named, and is no answer confidently
wrong?

`python tests/studies/beam_faults.py [--each 5] [--seed 0] [--kinds a,b] [--json]` makes
radiographs of balls in a body, with all seventeen offsets drawn from their priors, and
calibrates from them. Light of three energies, a detector's blur, lag, distortion, tiles, dead
pixels and scattered light are written out here, with the rays and planes of `prior_coverage`;
nothing of flexdt is in the images. An offset, the axis's image or the magnification that is
offered and more than four sigmas off is a confident wrong answer, and the command fails.
`--json` prints a line as soon as a scan is judged, one scan of every kind before the second of
any, and the sums last.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt
import prior_coverage as own
from scipy import ndimage

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.fit.fit import image_quantities
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import (
    Calibration,
    CalibrationRequest,
    Scan,
    calibrate,
)
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.poses import Poses

Array = npt.NDArray[np.float64]
Rng = np.random.Generator

WRONG_SIGMAS: Final = 4.0
EXPOSED: Final = 12
"""Moments of an exposure while the object turns."""
ENERGIES: Final = {40.0: 0.35, 60.0: 0.40, 90.0: 0.25}
"""Photon energies of the beam [keV] and their parts of the signal."""
ATTENUATION: Final = {
    "steel": (2.86, 0.948, 0.372), "glass": (0.160, 0.0715, 0.0475),
    "aluminium": (0.153, 0.0750, 0.0493), "pmma": (0.0279, 0.0229, 0.0199), "air": (0.0,) * 3,
}  # fmt: skip
"""Linear attenuation at those energies [1/mm] (NIST XCOM; glass as quartz of 2.2 g/cm3)."""


@dataclass(frozen=True)
class Laboratory:
    """What is scanned with what.

    Attributes:
        ball, body: materials.
        radius_mm: of the balls; cast_mm: what they really have.
        body_mm: radius of the upright cylinder that holds the balls.
        mono: light of one energy, the middle one.
        photons: of an open pixel in a frame.
        blur_px: standard deviations of the detector's blur, and the angle of the first [deg].
        lag: part of a frame that the next one still shows.
        scatter: light from everywhere, as part of the open beam; wide and even.
        shift: of the panel's picture, (rows, cols) -> two maps [px], or none.
        dead: part of the pixels without a signal.
        drift: of the beam's brightness over the scan.
        ceiling: largest count as part of the open beam.
        dark: by which the dark image is too bright, as part of the open beam.
        strain: (3, 3) of the phantom, by which its balls are displaced; none.
        arc: part of a step by which the object turns while a frame is exposed.
        shown: (n,) angles of the frames -> those that they show; none: their own.
        rows: part of a step by which the object turns from the first row's reading to the
            last's.
        flat: by which the flat image's beam is stronger at the right edge, and at the lower
            one, than at the panel's middle, as parts of it.
        loose: [mm] from its place, by which the first ball is displaced.
        sharpened: standard deviation [px] and strength of the camera's unsharp mask.
        veil: standard deviation [px] and part of the light that the detector spreads so far.
        wall_mm: thickness of a tube in place of the full cylinder; 0 is full.
    """

    ball: str = "steel"
    body: str = "air"
    radius_mm: float = 1.0
    cast_mm: float = 1.0
    body_mm: float = 15.0
    mono: bool = False
    photons: float = 2e4
    blur_px: tuple[float, float, float] = (0.7, 0.7, 0.0)
    lag: float = 0.0
    scatter: float = 0.0
    shift: tuple[Array, Array] | None = None
    dead: float = 0.0
    drift: float = 0.0
    ceiling: float = math.inf
    dark: float = 0.0
    strain: Array | None = None
    arc: float = 0.0
    shown: Callable[[Array, Rng], Array] | None = None
    rows: float = 0.0
    flat: tuple[float, float] = (0.0, 0.0)
    loose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sharpened: tuple[float, float] = (1.0, 0.0)
    veil: tuple[float, float] = (1.0, 0.0)
    wall_mm: float = 0.0


def rays(truth: Mapping[str, float], step: int = 1) -> Array:
    """Compute unit vectors from the source through every `step`-th pixel, (rows, cols,
    3), with the offsets of `truth`.
    """
    panel, across, down = own.places(np.zeros((1, 3)), np.zeros(1), own.SOD, truth)[1]
    column = np.arange(0, own.SHAPE[1], step) - (own.SHAPE[1] - 1) / 2
    row = np.arange(0, own.SHAPE[0], step) - (own.SHAPE[0] - 1) / 2
    out = panel + column[None, :, None] * across + row[:, None, None] * down
    return np.asarray(out / np.linalg.norm(out, axis=2, keepdims=True))


def cylinder(ray: Array, low: Array, high: Array, radius: float) -> Array:
    """Compute the chords of rays from the origin in the endless cylinder about the line
    from low to high [mm].

    Args:
        ray: (..., 3) unit vectors.
        low, high: (3,) points of the axis [mm].
        radius: [mm].

    Returns:
        (...), 0 where a ray misses it.
    """
    way = (high - low) / np.linalg.norm(high - low)
    across = ray - (ray @ way)[..., None] * way
    start = low - (low @ way) * way
    a, b = (across**2).sum(axis=-1), across @ start
    return np.asarray(
        2.0 * np.sqrt(np.maximum(b * b - a * (start @ start - radius**2), 0.0)) / a
    )


def radiographs(
    lab: Laboratory, rng: Rng, beads: Array, angles: Array, truth: Mapping[str, float]
) -> list[npt.NDArray[np.float32]]:
    """Simulate line integrals as a camera makes them, from flat-corrected counts, one
    image (rows, cols) for each angle.

    Blur, scatter, lag, drift, saturation and dead pixels are those of `lab`.

    Args:
        lab: sample, beam and camera.
        rng: of noise and dead pixels.
        beads: (k, 3) [mm].
        angles: (n,) of the stage [deg].
        truth: offsets [mm, deg].
    """
    if lab.strain is not None:
        beads = beads + (beads - beads.mean(axis=0)) @ lab.strain.T
    beads = beads + np.array(lab.loose) * (np.arange(len(beads)) == 0)[:, None]
    step = angles[1] - angles[0]
    flat = _ramp(lab.flat)
    if lab.shown is not None:
        angles = lab.shown(angles, rng)
    straight = rays(truth)
    dead = rng.random(own.SHAPE) < lab.dead
    before, out = None, []
    parts = (np.arange(EXPOSED) + 0.5) / EXPOSED - 0.5 if lab.arc else np.zeros(1)
    for i, angle in enumerate(angles.tolist()):
        some = angle + lab.arc * step * parts
        shown = np.mean(
            [light(lab, beads, float(a), truth, straight, lab.rows * step) for a in some],
            axis=0,
        )
        if lab.shift is not None:
            shown = _shifted(shown, lab.shift)
        shown = _blurred(shown, lab.blur_px) + lab.scatter
        wide, part = lab.veil
        shown = (1.0 - part) * shown + part * cv2.GaussianBlur(shown, (0, 0), wide)
        lagging = shown if before is None else (1 - lab.lag) * shown + lab.lag * before
        before = shown
        beam = lab.photons * (1.0 + lab.drift * i / len(angles))
        counts = np.minimum(rng.poisson(beam * lagging), lab.ceiling * lab.photons)
        wide, part = lab.sharpened
        counts = counts + part * (counts - cv2.GaussianBlur(counts, (0, 0), wide))
        counts = np.where(dead, 0.0, counts)
        open_beam = lab.photons * (1.0 - lab.dark)
        counts = np.maximum(counts - lab.dark * lab.photons, 0.5)
        out.append((-np.log(counts / (open_beam * flat))).astype(np.float32))
    return out


def _ramp(most: tuple[float, float]) -> Array:
    """Compute a beam, (rows, cols), that grows in a line from 1 in the panel's middle, to the
    right and down by `most` at the edges.
    """
    row, column = (np.linspace(-1.0, 1.0, n) for n in own.SHAPE)
    return np.asarray(1.0 + most[0] * column + most[1] * row[:, None])


def light(
    lab: Laboratory,
    beads: Array,
    angle: float,
    truth: Mapping[str, float],
    straight: Array,
    rows_turn: float = 0.0,
) -> Array:
    """Compute the transmitted share of the beam at one angle, (rows, cols), through the
    balls and their holder.

    Args:
        lab: materials, sizes and spectrum.
        beads: (k, 3) [mm].
        angle: of the stage [deg].
        truth: offsets [mm, deg].
        straight: unit vectors of `rays`.
        rows_turn: the object turns by so much from the first row's reading to the last's
            [deg], and has the angle at the middle row's.
    """
    ends = np.array([[0.0, 0.0, -30.0], [0.0, 0.0, 30.0]])
    turn = np.array([angle])
    (at,), panel = own.places(np.concatenate([beads, ends]), turn, own.SOD, truth)
    energies = [1] if lab.mono else [0, 1, 2]
    parts = np.array(list(ENERGIES.values()))[energies]
    parts /= parts.sum()
    ball, body = (np.array(ATTENUATION[m])[energies] for m in (lab.ball, lab.body))
    shown = np.zeros(own.SHAPE)
    inside = (
        cylinder(straight, *at[-2:], lab.body_mm) if lab.body != "air" else 0.0 * shown
    )
    if lab.wall_mm > 0.0:
        inside = inside - cylinder(straight, *at[-2:], lab.body_mm - lab.wall_mm)
    through = [np.zeros(own.SHAPE) for _ in energies]
    centres = own.pixels(beads, turn, own.SOD, truth)[0]
    for k, centre in enumerate(centres):
        place = at[k]
        where, passed = own.shadow(place, centre, panel, lab.cast_mm, own.SOD)
        if rows_turn:
            where, passed = read_by_rows(lab, beads[k], angle, rows_turn, truth)
        for e in range(len(energies)):  # a ball takes its place in the body
            through[e][where] -= np.log(passed(ball[e] - body[e]))
    for e, weight in enumerate(parts):
        shown += weight * np.exp(-body[e] * inside - through[e])
    return shown


def read_by_rows(
    lab: Laboratory, bead: Array, angle: float, turn: float, truth: Mapping[str, float]
) -> tuple[tuple[Array, ...], Callable[[float], Array]]:
    """Find the pixels about a ball's image whose rows are read one after another, and the part
    of light that passes there, as `prior_coverage.shadow` does.

    Args:
        lab: gives the ball's true radius.
        bead: (3,) of the object [mm].
        angle: of the middle row [deg].
        turn: from the first row to the last [deg].
        truth: offsets [mm, deg].
    """
    times = np.linspace(-0.5, 0.5, 5)
    tracks = own.pixels(bead[None], angle + turn * times, own.SOD, truth)[:, 0]
    seen = (
        tracks[:, 1] / (own.SHAPE[0] - 1) - 0.5 - times
    )  # falls through 0 when it is read
    when = float(np.interp(0.0, seen[::-1], times[::-1]))
    half = lab.cast_mm * own.SDD / (0.7 * own.SOD) / own.PIXEL * 1.3 / own.SHAPE[0]
    ends = angle + turn * (when + half * np.array([-1.0, 0.0, 1.0]))
    at, panel = own.places(bead[None], ends, own.SOD, truth)
    (centre,) = own.pixels(bead[None], ends[1:2], own.SOD, truth)[0]
    speed = (at[2, 0] - at[0, 0]) / (2.0 * half)
    row = (own.SHAPE[0] - 1) * (when + 0.5)

    def place(rows: Array) -> Array:
        return np.asarray(at[1, 0] + (rows - row)[..., None] / (own.SHAPE[0] - 1) * speed)

    return own.shadow(at[1, 0], centre, panel, lab.cast_mm, own.SOD, place)


def _blurred(image: Array, blur: tuple[float, float, float]) -> Array:
    """Blur an image with a Gaussian of two widths [px], the first along a line at an
    angle [deg] to the rows.
    """
    one, two, angle = blur
    if one == two:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), one))
    n = int(4 * max(one, two)) + 1
    y, x = np.mgrid[-n : n + 1, -n : n + 1].astype(float)
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    kernel = np.exp(-0.5 * (((c * x + s * y) / one) ** 2 + ((c * y - s * x) / two) ** 2))
    return np.asarray(
        cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)
    )


def _shifted(image: Array, shift: tuple[Array, Array]) -> Array:
    """Shift an image by `shift` (rows, columns)."""
    row, column = np.mgrid[: own.SHAPE[0], : own.SHAPE[1]].astype(float)
    places = np.array([row - shift[0], column - shift[1]])
    return np.asarray(ndimage.map_coordinates(image, places, order=3, mode="nearest"))


def _radial(rng: Rng) -> tuple[Array, Array]:
    """Draw the shifts (rows, columns) [px] of a panel with a radial distortion of 0.3 to
    1 px at 305 px from its middle.
    """
    row, column = np.mgrid[: own.SHAPE[0], : own.SHAPE[1]].astype(float)
    y, x = (
        (row - (own.SHAPE[0] - 1) / 2) / 305.0,
        (column - (own.SHAPE[1] - 1) / 2) / 305.0,
    )
    size = float(rng.choice([-1, 1]) * rng.uniform(0.3, 1.0)) * (x * x + y * y)
    return size * y, size * x


def _tiles(rng: Rng) -> tuple[Array, Array]:
    """Draw the shifts (rows, columns) [px] of a panel of two tiles with a gap of 0.5 to 2
    px between them, which the image leaves out.
    """
    row, column = np.mgrid[: own.SHAPE[0], : own.SHAPE[1]].astype(float)
    axis, gap = int(rng.integers(2)), float(rng.uniform(0.5, 2.0))
    border = own.SHAPE[axis] * rng.uniform(0.4, 0.6)
    moved = np.where((row, column)[axis] > border, -gap, 0.0)
    return (moved, 0.0 * moved) if axis == 0 else (0.0 * moved, moved)


Change = Callable[[Laboratory, Rng], Laboratory]


def _with(**fields: object) -> Change:
    return lambda lab, rng: replace(lab, **fields)  # type: ignore[arg-type]


def _strained(i: int, j: int) -> Change:
    """Make a fault that strains the phantom by 0.05 to 1 %, by element (i, j) of the
    strain.
    """

    def change(lab: Laboratory, rng: Rng) -> Laboratory:
        """Draw the strain's size and sign, and set it, with light of one energy."""
        strain = np.zeros((3, 3))
        strain[i, j] = rng.choice([-1, 1]) * math.exp(
            rng.uniform(math.log(5e-4), math.log(1e-2))
        )
        return replace(lab, mono=True, strain=strain)

    return change


def _either(rng: Rng, least: float, most: float) -> float:
    """Draw a size, and its sign."""
    return float(rng.choice([-1, 1]) * rng.uniform(least, most))


def _as_assumed(lab: Laboratory, rng: Rng) -> Laboratory:
    return replace(lab, mono=True, strain=1e-3 * rng.normal(size=(3, 3)))


def _renumbered(shift: int, stays: bool) -> Change:
    """Make a fault of frame numbers: from a frame on (`stays`), or in that frame alone,
    images are those of `shift` frames later.
    """

    def shown(angles: Array, rng: Rng) -> Array:
        """Return the angles that the images have, from a drawn frame on or in it alone."""
        n = len(angles)
        at = int(rng.integers(1, n))
        later = np.arange(n) >= at if stays else np.arange(n) == at
        return angles + (angles[1] - angles[0]) * shift * later

    return lambda lab, rng: replace(lab, mono=True, shown=shown)


def _four_tiles(rng: Rng) -> tuple[Array, Array]:
    """Draw the shifts (rows, columns) [px] of a panel of 2 x 2 tiles, with gaps of 0.5 to
    2 px between them.
    """
    row, column = np.mgrid[: own.SHAPE[0], : own.SHAPE[1]].astype(float)
    gaps = rng.uniform(0.5, 2.0, size=2)
    low, right = (
        at > side * rng.uniform(0.42, 0.58)
        for at, side in zip((row, column), own.SHAPE, strict=True)
    )
    return np.where(low, -gaps[0], 0.0), np.where(right, -gaps[1], 0.0)


SHAPED: Final = "phantom_strained|bead_tolerance|causes_open"
BODY: Final = {"body": "pmma", "body_mm": 30.0}
METAL: Final = {"body": "aluminium", "body_mm": 20.0}
KINDS: Final[Mapping[str, tuple[Change, str]]] = {
    # Right scans: to be offered. "" allows any warning; what is offered must be true.
    "one_energy": (_with(mono=True), ""),
    "spectrum": (_with(), ""),
    "spectrum_pmma": (_with(**BODY), ""),
    "spectrum_aluminium": (_with(**METAL), ""),
    "glass_balls": (_with(ball="glass", radius_mm=1.5, cast_mm=1.5), ""),
    "glass_in_pmma": (_with(ball="glass", radius_mm=1.5, cast_mm=1.5, **BODY), ""),
    "faint_in_pmma": (_with(ball="glass", photons=4e3, **BODY), ""),
    "steel_one_energy_aluminium": (_with(**METAL, mono=True), ""),
    "small_balls": (_with(radius_mm=0.5, cast_mm=0.5), ""),
    "blurred": (lambda lab, rng: replace(lab, blur_px=(b := rng.uniform(2, 4), b, 0.0)), ""),
    "blurred_one_way": (
        lambda lab, rng: replace(
            lab, blur_px=(rng.uniform(0.6, 1.2), rng.uniform(2, 4), rng.uniform(0, 180))
        ), "",
    ),
    "low_dose": (lambda lab, rng: replace(lab, photons=rng.uniform(100, 1000)), ""),
    "scattered_light": (lambda lab, rng: replace(lab, **BODY, scatter=rng.uniform(0.02, 0.2)), ""),
    "brightness_drifts": (lambda lab, rng: replace(lab, drift=rng.uniform(-0.2, 0.2)), ""),
    "dead_pixels": (lambda lab, rng: replace(lab, dead=rng.uniform(1e-4, 3e-3)), ""),
    "saturated": (lambda lab, rng: replace(lab, **BODY, ceiling=rng.uniform(0.3, 0.9)), ""),
    "lag": (lambda lab, rng: replace(lab, lag=rng.uniform(0.01, 0.1)), ""),
    "hazed_tube": (
        lambda lab, rng: replace(
            lab, body="glass", body_mm=20.0, wall_mm=2.0, scatter=rng.uniform(0.05, 0.3),
            blur_px=((b := rng.uniform(1, 3)), b, 0.0),
            veil=(rng.uniform(15, 60), rng.uniform(0.1, 0.4)),
        ), "",
    ),
    "lag_in_aluminium": (
        lambda lab, rng: replace(lab, lag=rng.uniform(0.01, 0.1), **METAL), "",
    ),
    # Faults: to be named.
    "dark_too_bright": (
        lambda lab, rng: replace(
            lab, radius_mm=1.5, cast_mm=1.5, dark=rng.uniform(0.007, 0.015), **METAL
        ), "dark_too_bright",
    ),
    "radial": (lambda lab, rng: replace(lab, shift=_radial(rng)), "panel_distorted"),
    "tiles_apart": (lambda lab, rng: replace(lab, shift=_tiles(rng)), "panel_distorted"),
    "radial_in_pmma": (
        lambda lab, rng: replace(lab, shift=_radial(rng), **BODY), "panel_distorted",
    ),
    "larger_balls": (_with(cast_mm=1.08), "bead_size"),
    "smaller_balls": (_with(cast_mm=0.92), "bead_size"),
    "larger_in_aluminium": (
        _with(cast_mm=1.08, **METAL), "bead_size",
    ),
    # A printed phantom as good as is assumed: to be offered; others, and what cameras do.
    "as_assumed": (_as_assumed, ""),
    "strain_x": (_strained(0, 0), SHAPED),
    "strain_z": (_strained(2, 2), SHAPED),
    "strain_shear": (_strained(0, 1), SHAPED),
    "strain_lean": (_strained(0, 2), SHAPED),
    "rows_in_turn": (
        lambda lab, rng: replace(lab, mono=True, rows=_either(rng, 0.1, 1.0)), "rows_in_turn",
    ),
    "rows_under_other_flat": (
        lambda lab, rng: replace(
            lab, mono=True, rows=_either(rng, 0.1, 1.0),
            flat=(_either(rng, 0.02, 0.1), _either(rng, 0.02, 0.1)),
        ), "rows_in_turn",
    ),
    "bead_loose_sharpened": (
        lambda lab, rng: replace(
            lab, mono=True, loose=tuple(rng.normal(0.0, 0.3, size=3).tolist()),
            sharpened=(rng.uniform(0.8, 2.0), rng.uniform(0.5, 1.5)),
        ), "bead_displaced|bead_tolerance",
    ),
    "exposed_long": (
        lambda lab, rng: replace(lab, mono=True, arc=rng.uniform(0.1, 1.0)),
        f"exposure_arc|{SHAPED}",
    ),
    "frame_doubled": (_renumbered(-1, True), "frame_numbers|frames_inconsistent"),
    "frame_lost": (_renumbered(1, True), "frame_numbers|frames_inconsistent"),
    "exposed_again": (_renumbered(-1, False), "frames_inconsistent"),
    "four_tiles": (
        lambda lab, rng: replace(lab, mono=True, shift=_four_tiles(rng)), "panel_distorted",
    ),
}  # fmt: skip
"""Each kind: what it changes, and what names it."""


@dataclass(frozen=True)
class Scored:
    """What came of one scan: the largest error of what was offered [sigma], and what was said.

    `sigmas` are the errors of all that was offered, in standard deviations.
    """

    kind: str
    seed: int
    offered: bool
    named: bool
    worst: float
    where: str
    said: tuple[str, ...]
    sigmas: Mapping[str, float] = field(default_factory=dict)


def magnification(truth: Mapping[str, float]) -> float:
    """Compute the magnification of a line of 1 mm across the beam and along the panel's
    rows, on the axis.
    """
    _, (panel, across, down) = own.places(np.zeros((1, 3)), np.zeros(1), own.SOD, truth)
    tau = np.array([truth["tau_x"], truth["tau_z"], 0.0])
    foot = own.places(tau[None], np.zeros(1), own.SOD, truth)[0][0, 0]
    step = across / np.linalg.norm(across)
    columns = []
    for place in (foot - 0.5 * step, foot + 0.5 * step):
        columns.append(
            np.linalg.solve(np.stack([place, -across, -down], axis=1), panel)[1]
        )
    return float((columns[1] - columns[0]) * own.PIXEL)


def scored(kind: str, seed: int, frames: int = 24) -> Scored:
    """Make a scan of a kind, calibrate it, and compare the answer with the truth.

    Args:
        kind: of KINDS.
        seed: of all draws.
        frames: of the turn.

    Returns:
        The score; not offered where calibration is refused.
    """
    rng = np.random.default_rng([seed, *kind.encode()])
    change, name = KINDS[kind]
    lab = change(Laboratory(), rng)
    beads = own.spread(rng, 4.5 * lab.radius_mm)
    if lab.body != "air":
        beads[:, :2] *= min(1.0, 0.8 * lab.body_mm / 17.0)
    truth = own.drawn(rng, 1.0, False)
    angles = 360.0 * np.arange(frames) / frames
    images = radiographs(lab, rng, beads, angles, truth)
    try:
        result = calibrated(lab, beads, angles, images)
    except TwinError as error:
        return Scored(kind, seed, False, False, 0.0, "", (f"refused: {error}",))
    said = tuple(f"{f.code}: {f.text}" for f in result.findings)
    off = errors_of(result, truth, lab) if result.identifiable else {}
    where = max(off, key=lambda n: off[n], default="")
    named = any(re.match(name, one) for one in said) if name else True
    return Scored(
        kind, seed, result.identifiable, named, off.get(where, 0.0), where, said, off
    )


def calibrated(
    lab: Laboratory,
    beads: Array,
    angles: Array,
    images: Sequence[npt.NDArray[np.float32]],
) -> Calibration:
    """Calibrate from radiographs of a laboratory.

    Args:
        lab: gives the balls' radius.
        beads: (k, 3) their places by the phantom's file [mm].
        angles: (n,) [deg].
        images: n line integrals (rows, cols).

    Raises:
        TwinError: calibration is refused.
    """
    poses = Poses.upright(
        [0, 0, 0], [0, own.SOD, 0], [0, own.SDD, 0], own.PIXEL, np.radians(angles)
    )
    model = BeadModel(beads, np.full(len(beads), lab.radius_mm))
    scan = Scan(ArrayFrames(images, own.SHAPE), poses)
    return calibrate([scan], model, CalibrationRequest())


def errors_of(
    result: Calibration, truth: Mapping[str, float], lab: Laboratory
) -> dict[str, float]:
    """Compute the error [sigma] of every value that a calibration offers, by name.

    Where beads see one tile alone, no border is found, and the axis's column is that of
    its tile.
    """
    fit = result.fit
    assert fit is not None
    image = own.axis_in_image(truth)
    if lab.shift is not None and fit.panel is None:
        middle = own.SHAPE[0] // 2, round(image["axis_column"])
        image["axis_column"] += float(lab.shift[1][middle])
    true = {**truth, **image, "magnification": magnification(truth)}
    found = {**fit.certificate.estimates, **image_quantities(fit)[0]}
    return {
        n: abs(e.value - true[n]) / e.sigma
        for n, e in found.items()
        if e.sigma > 0 and n in true
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate scans of each kind, print a line for each kind and the counts.

    Returns:
        1 if a value is more than WRONG_SIGMAS off, else 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=5, help="scans of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    warnings.simplefilter("ignore")
    scans: list[Scored] = []
    if not args.json:
        print(f"{'kind':28}{'offered':>8}{'named':>7}{'worst':>7}  what was said")
    kinds = args.kinds.split(",")
    runs = [(kind, args.seed + i) for i in range(args.each) for kind in kinds]
    for kind, seed in (
        runs if args.json else sorted(runs, key=lambda run: kinds.index(run[0]))
    ):
        scans.append(scored(kind, seed))
        some = [s for s in scans if s.kind == kind]
        if args.json:
            print(json.dumps(asdict(scans[-1])), flush=True)
        elif len(some) == args.each:
            worst = max(some, key=lambda s: s.worst)
            codes = Counter(line.partition(":")[0] for s in some for line in s.said)
            said = ", ".join(f"{code} {n}" for code, n in codes.most_common())
            print(f"{kind:28}{sum(s.offered for s in some):8}{sum(s.named for s in some):7}"
                  f"{worst.worst:7.1f}  {worst.where}; {said}", flush=True)  # fmt: skip
    wrong = [s for s in scans if s.worst > WRONG_SIGMAS]
    right = [s for s in scans if not KINDS[s.kind][1]]
    faults = [s for s in scans if KINDS[s.kind][1]]
    summary = {
        "scans": len(scans), "confidently wrong": len(wrong),
        "right scans": len(right), "of them refused": sum(not s.offered for s in right),
        "faults": len(faults), "of them named": sum(s.named for s in faults),
        "values of right scans": len(off := [e for s in right for e in s.sigmas.values()]),
        "of them within 1.96 sigma": sum(bool(e <= 1.96) for e in off),
    }  # fmt: skip
    if args.json:
        print(json.dumps(summary))
    else:
        print(", ".join(f"{n}: {v}" for n, v in summary.items()))
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
