"""The ways of spoiling a scan: changes of the object, its places, and of the images
themselves.

Each function takes a scan and a random generator and returns the scan spoilt at a random
strength; `spoilt_scans` makes the images and judges the calibration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.fit.priors import ASSUMED
from flexdt.twin.calibration.fit.problem import SIX
from flexdt.twin.calibration.pipeline import CalibrationRequest
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.projection.analytic_solids import Box, Scene, Solid, Sphere
from flexdt_extensions.studies.experiment_4 import moved_beads
from flexdt_extensions.studies.experiments import SHAPE
from flexdt_extensions.studies.rendered_runs import Rendering

FRAMES: Final = 36


Rng = np.random.Generator


@dataclass(frozen=True, eq=False)
class Spoilt:
    """A scan on its way to being spoilt.

    Attributes:
        scene, model: the scanned object.
        believed_scene, believed: the object that calibration is given.
        poses: the true ones; nominal: those that calibration is given.
        truth: offsets the images are made with.
        camera: how the images are made.
        images: line integrals, None where missing; empty until they are made.
        request: of the calibration.
    """

    scene: Scene
    model: BeadModel
    believed_scene: Scene
    believed: BeadModel
    poses: Poses
    nominal: Poses
    truth: Offsets
    camera: Rendering
    images: tuple[Float32Array | None, ...] = ()
    request: CalibrationRequest = field(default_factory=CalibrationRequest)


Change = Callable[[Spoilt, Rng], Spoilt]


@dataclass(frozen=True)
class Kind:
    """One way of spoiling: before the images are made, or the images themselves."""

    before: Change | None = None
    after: Change | None = None


def _moved(scan: Spoilt, shift: npt.NDArray[np.float64]) -> Spoilt:
    scene, model = moved_beads(scan.scene, scan.model, shift)
    return replace(scan, scene=scene, model=model)


def _kept_beads(scan: Spoilt, keep: npt.NDArray[np.bool_]) -> Spoilt:
    """Remove beads from the scanned object; `keep` (k,) selects those that stay."""
    solids = [
        s
        for s in scan.scene.solids
        if not isinstance(s.shape, Sphere)
        or keep[
            int(
                np.argmin(
                    np.linalg.norm(scan.model.beads - np.asarray(s.shape.center), axis=1)
                )
            )
        ]
    ]
    return replace(scan, scene=Scene(tuple(solids)))


def _bead_moved(scan: Spoilt, rng: Rng) -> Spoilt:
    """Move one bead by 0.05 to 3 mm in a random direction."""
    shift = np.zeros_like(scan.model.beads)
    direction = rng.normal(size=3)
    shift[rng.integers(len(shift))] = (
        direction
        / np.linalg.norm(direction)
        * math.exp(rng.uniform(math.log(0.05), math.log(3)))
    )
    return _moved(scan, shift)


def _bead_tolerance(scan: Spoilt, rng: Rng) -> Spoilt:
    sigma = math.exp(rng.uniform(math.log(0.005), math.log(0.2)))
    return _moved(scan, sigma * rng.normal(size=scan.model.beads.shape))


def _bead_lost(scan: Spoilt, rng: Rng) -> Spoilt:
    keep = np.ones(len(scan.model), dtype=bool)
    keep[rng.integers(len(keep))] = False
    return _kept_beads(scan, keep)


def _one_bead(scan: Spoilt, rng: Rng) -> Spoilt:
    keep = np.zeros(len(scan.model), dtype=bool)
    keep[rng.integers(len(keep))] = True
    return _kept_beads(scan, keep)


def _no_beads(scan: Spoilt, rng: Rng) -> Spoilt:
    return _kept_beads(scan, np.zeros(len(scan.model), dtype=bool))


def _mirrored(scan: Spoilt, rng: Rng) -> Spoilt:
    """Let calibration believe in beads mirrored along x, without a body."""
    return replace(
        scan,
        believed=BeadModel(
            scan.believed.beads * [-1.0, 1.0, 1.0], scan.believed.bead_radius_mm
        ),
        believed_scene=Scene(()),
    )


def _scaled(scan: Spoilt, rng: Rng) -> Spoilt:
    """Spread the believed beads 8 to 30 % too far or too near, of the right size, without
    a body.

    A model scaled with its beads looks exactly right at another distance; see
    PLAUSIBLE_SHARE.
    """
    factor = 1.0 + rng.choice([-1.0, 1.0]) * rng.uniform(0.08, 0.3)
    return replace(
        scan,
        believed=BeadModel(scan.believed.beads * factor, scan.believed.bead_radius_mm),
        believed_scene=Scene(()),
    )


def _extra_beads(scan: Spoilt, rng: Rng) -> Spoilt:
    """Add one to three balls like the beads to the scanned object."""
    bead = next(s for s in scan.scene.solids if isinstance(s.shape, Sphere))
    assert isinstance(bead.shape, Sphere)
    more = []
    for _ in range(int(rng.integers(1, 4))):
        x, y, z = rng.uniform([-12, -12, -26], [12, 12, 26]).tolist()
        more.append(
            Solid(Sphere((x, y, z), bead.shape.radius), bead.material, bead.mu_per_mm)
        )
    return replace(scan, scene=Scene((*scan.scene.solids, *more)))


def _foreign_box(scan: Spoilt, rng: Rng) -> Spoilt:
    """Add a steel box with sides of 1 to 10 mm to the scanned object."""
    x, y, z = rng.uniform([-20, -20, -25], [20, 20, 25]).tolist()
    size = tuple(rng.uniform(1.0, 10.0, size=3).tolist())
    box = Solid(Box((x, y, z), (size[0], size[1], size[2])), "steel", 0.8)
    return replace(scan, scene=Scene((*scan.scene.solids, box)))


def _other_body(scan: Spoilt, rng: Rng) -> Spoilt:
    """Move the beads' holder by a few millimetres at most, and remove, keep or change its
    attenuation; the beads stay.
    """
    shift = rng.normal(size=3) * math.exp(rng.uniform(math.log(0.05), math.log(2.0)))
    factor = float(rng.choice([0.0, 1.0, math.exp(rng.normal())]))

    def changed(solid: Solid) -> Solid:
        """Return a solid moved and with its attenuation changed."""
        place = (np.asarray(solid.shape.center) + shift).tolist()  # type: ignore[union-attr]
        shape = replace(solid.shape, center=tuple(place))  # type: ignore[call-arg]
        return replace(solid, shape=shape, mu_per_mm=factor * solid.mu_per_mm)

    solids = scan.scene.solids
    return replace(
        scan,
        scene=Scene(
            tuple(s if isinstance(s.shape, Sphere) else changed(s) for s in solids)
        ),
    )


def _angles(scan: Spoilt, angle: npt.NDArray[np.float64]) -> Spoilt:
    return replace(scan, poses=replace(scan.poses, angle=angle))


def _endpoint(scan: Spoilt, rng: Rng) -> Spoilt:
    return _angles(scan, scan.poses.angle * FRAMES / (FRAMES - 1))


def _endpoint_other_way(scan: Spoilt, rng: Rng) -> Spoilt:
    return _angles(scan, scan.poses.angle * (FRAMES - 1) / FRAMES)


def _small_scale(scan: Spoilt, rng: Rng) -> Spoilt:
    return _angles(
        scan, scan.poses.angle * (1.0 + rng.choice([-1, 1]) * rng.uniform(1e-4, 0.02))
    )


def _reversed(scan: Spoilt, rng: Rng) -> Spoilt:
    return _angles(scan, -scan.poses.angle)


def _renumbered(scan: Spoilt, rng: Rng) -> Spoilt:
    """Turn the stage one to three frames' angles further from a frame on, not among the
    first or last four.
    """
    gap = int(rng.integers(1, 4))
    at = int(rng.integers(4, FRAMES - 4))
    return _angles(
        scan,
        scan.poses.angle
        + np.where(np.arange(FRAMES) >= at, gap * 2 * np.pi / FRAMES, 0.0),
    )


def _slip(scan: Spoilt, rng: Rng) -> Spoilt:
    at = int(rng.integers(4, FRAMES - 4))
    step = math.radians(math.exp(rng.uniform(math.log(0.02), math.log(5.0))))
    return _angles(scan, scan.poses.angle + np.where(np.arange(FRAMES) >= at, step, 0.0))


def _jitter(scan: Spoilt, rng: Rng) -> Spoilt:
    sigma = math.radians(math.exp(rng.uniform(math.log(0.005), math.log(2.0))))
    return _angles(scan, scan.poses.angle + sigma * rng.normal(size=FRAMES))


def _not_turning(scan: Spoilt, rng: Rng) -> Spoilt:
    return _angles(scan, np.zeros(FRAMES))


def _shuffled(scan: Spoilt, rng: Rng) -> Spoilt:
    return _angles(scan, rng.permutation(scan.poses.angle))


def _vibration(scan: Spoilt, rng: Rng) -> Spoilt:
    sigma = math.exp(rng.uniform(math.log(0.001), math.log(0.5)))
    axis = scan.poses.axis + sigma * rng.normal(size=(FRAMES, 3))
    return replace(scan, poses=replace(scan.poses, axis=axis))


def _shifted_halfway(scan: Spoilt, rng: Rng) -> Spoilt:
    step = math.exp(rng.uniform(math.log(0.005), math.log(3.0))) * rng.normal(size=3)
    late = (np.arange(FRAMES) >= int(rng.integers(4, FRAMES - 4)))[:, None]
    return replace(scan, poses=replace(scan.poses, axis=scan.poses.axis + late * step))


def _source_drift(scan: Spoilt, rng: Rng) -> Spoilt:
    """Let the focal spot drift sideways over the scan, by up to a millimetre or so."""
    way = (
        math.exp(rng.uniform(math.log(0.002), math.log(1.0)))
        * rng.normal(size=3)
        * [1, 0, 1]
    )
    ramp = np.linspace(0, 1, FRAMES)[:, None]
    return replace(scan, poses=replace(scan.poses, source=scan.poses.source + ramp * way))


def _out_of_view(scan: Spoilt, rng: Rng) -> Spoilt:
    edge = scan.truth.to_edge()
    edge["dO_x"] = float(rng.choice([-1, 1]) * rng.uniform(40, 58))
    return replace(scan, truth=Offsets.from_edge(edge))


def _low_dose(scan: Spoilt, rng: Rng) -> Spoilt:
    return replace(scan, camera=replace(scan.camera, counts=float(rng.uniform(60, 800))))


def _blurred(scan: Spoilt, rng: Rng) -> Spoilt:
    return replace(
        scan, camera=replace(scan.camera, blur_px=float(rng.uniform(1.5, 5.0)))
    )


def _some_held(scan: Spoilt, rng: Rng, off: Callable[[], float]) -> Spoilt:
    """Hold one to three of the six, `off` from where they are [mm, deg]."""
    held = rng.choice(SIX, size=int(rng.integers(1, 4)), replace=False).tolist()
    edge = scan.truth.to_edge()
    start = Offsets.from_edge({n: edge[n] + off() for n in held})
    free = tuple(n for n in SIX if n not in held)
    return replace(scan, request=CalibrationRequest(free=free, start=start))


def _held_off(scan: Spoilt, rng: Rng) -> Spoilt:
    """Hold some of the six off by 1e-5 to 1 mm or deg, from invisible in any data to
    obvious.
    """
    return _some_held(
        scan,
        rng,
        lambda: rng.choice([-1, 1]) * math.exp(rng.uniform(math.log(1e-5), math.log(1))),
    )


def _held_right(scan: Spoilt, rng: Rng) -> Spoilt:
    return _some_held(scan, rng, lambda: 0.0)


def _scanner_off(scan: Spoilt, rng: Rng) -> Spoilt:
    """Offset detector and axis all at once, each as its prior allows, and half of the
    time hold some of the six, rightly or wrongly.
    """
    off = {n: w * float(np.clip(rng.normal(), -3, 3)) for n, w in ASSUMED.items()}
    scan = replace(scan, truth=Offsets.from_edge(scan.truth.to_edge() | off))
    return (lambda s, _: s, _held_off, lambda s, _: s, _held_right)[int(rng.integers(4))](
        scan, rng
    )


def _detector_off(scan: Spoilt, rng: Rng) -> Spoilt:
    """Shift (3 to 15 mm) or tilt (0.4 to 3 deg) the detector in one way, by far more than
    its prior allows.
    """
    largest = {"dD_x": 15.0, "dD_y": 15.0, "dD_z": 15.0, "det_roll": 2.0, "det_pitch": 3.0,
               "det_yaw": 3.0}  # fmt: skip
    name = str(rng.choice(list(largest)))
    edge = scan.truth.to_edge()
    edge[name] = float(rng.choice([-1, 1]) * rng.uniform(0.2, 1.0) * largest[name])
    return replace(scan, truth=Offsets.from_edge(edge))


# --- the images themselves ----------------------------------------------------------------------


def _each(
    scan: Spoilt, change: Callable[[Float32Array, int], Float32Array | None]
) -> Spoilt:
    """Replace each image by `change(image, number)`; missing ones stay missing."""
    images = tuple(
        None if im is None else change(im, i) for i, im in enumerate(scan.images)
    )
    return replace(scan, images=images)


def _missing(scan: Spoilt, rng: Rng) -> Spoilt:
    gone = rng.random(FRAMES) < rng.uniform(0.05, 0.9)
    return _each(scan, lambda im, i: None if gone[i] else im)


def _dark(scan: Spoilt, rng: Rng) -> Spoilt:
    off = rng.random(FRAMES) < rng.uniform(0.1, 0.9)
    return _each(scan, lambda im, i: np.full_like(im, 9.0) if off[i] else im)


def _half_dark(scan: Spoilt, rng: Rng) -> Spoilt:
    return _each(scan, lambda im, i: np.full_like(im, 9.0) if i >= FRAMES // 2 else im)


def _gradient(scan: Spoilt, rng: Rng) -> Spoilt:
    """Add a linear ramp and a wave along columns to all images."""
    rows, cols = SHAPE
    x, y = rng.normal(size=2) * 1.5
    ramp = (
        x * np.linspace(-1, 1, cols)[None] + y * np.linspace(-1, 1, rows)[:, None]
    ).astype("f4")
    wave = 0.2 * np.sin(np.linspace(0, rng.uniform(2, 40), cols))[None].astype(np.float32)
    return _each(scan, lambda im, i: im + ramp + wave)


def _dead_columns(scan: Spoilt, rng: Rng) -> Spoilt:
    """Set 1 to 29 columns of all images to 9, and 400 pixels to -3."""
    columns = rng.integers(0, SHAPE[1], size=int(rng.integers(1, 30)))
    spots = rng.integers(0, [[SHAPE[0]], [SHAPE[1]]], size=(2, 400))

    def change(im: Float32Array, _: int) -> Float32Array:
        """Return a copy of an image with these columns and pixels."""
        out = im.copy()
        out[:, columns] = 9.0
        out[spots[0], spots[1]] = -3.0
        return out

    return _each(scan, change)


def _flipped_lr(scan: Spoilt, rng: Rng) -> Spoilt:
    return _each(scan, lambda im, i: np.ascontiguousarray(im[:, ::-1]))


def _flipped_ud(scan: Spoilt, rng: Rng) -> Spoilt:
    return _each(scan, lambda im, i: np.ascontiguousarray(im[::-1]))


def _rotated(scan: Spoilt, rng: Rng) -> Spoilt:
    """Turn all images by 0.02 to 5 deg, as a panel rolled by that angle would see them;
    the truth has that roll.

    It is done by a cubic spline at exact places: OpenCV takes them to 1/32 pixel, more
    than a centroid's sigma.
    """
    angle = float(rng.choice([-1, 1]) * rng.uniform(0.02, 5.0))
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    turn, middle = np.array([[c, s], [-s, c]]), (np.array(SHAPE) - 1) / 2
    truth = Offsets.from_edge(scan.truth.to_edge() | {"det_roll": angle})

    def change(im: Float32Array, _: int) -> Float32Array:
        return np.float32(ndimage.affine_transform(im, turn, middle - turn @ middle))

    return replace(_each(scan, change), truth=truth)


def _repeated(scan: Spoilt, rng: Rng) -> Spoilt:
    """Replace each frame but the first, with a chance of 3 to 30 %, by the one before, as
    a camera that stutters.
    """
    stuck = rng.random(FRAMES) < rng.uniform(0.03, 0.3)
    images = list(scan.images)
    for i in range(1, FRAMES):
        if stuck[i]:
            images[i] = images[i - 1]
    return replace(scan, images=tuple(images))


KINDS: Final[Mapping[str, Kind]] = {
    "control": Kind(),
    "frames_missing": Kind(after=_missing),
    "frames_dark": Kind(after=_dark),
    "half_dark": Kind(after=_half_dark),
    "frames_repeated": Kind(after=_repeated),
    "frames_renumbered": Kind(_renumbered),
    "frames_shuffled": Kind(_shuffled),
    "angle_endpoint": Kind(_endpoint),
    "angle_endpoint_other_way": Kind(_endpoint_other_way),
    "angle_scale": Kind(_small_scale),
    "angle_reversed": Kind(_reversed),
    "angle_slip": Kind(_slip),
    "angle_jitter": Kind(_jitter),
    "not_turning": Kind(_not_turning),
    "wrong_phantom": Kind(),
    "mirrored_phantom": Kind(_mirrored),
    "scaled_phantom": Kind(_scaled),
    "no_beads": Kind(_no_beads),
    "one_bead": Kind(_one_bead),
    "bead_lost": Kind(_bead_lost),
    "bead_moved": Kind(_bead_moved),
    "bead_tolerance": Kind(_bead_tolerance),
    "extra_beads": Kind(_extra_beads),
    "foreign_box": Kind(_foreign_box),
    "other_body": Kind(_other_body),
    "out_of_view": Kind(_out_of_view),
    "vibration": Kind(_vibration),
    "shifted_halfway": Kind(_shifted_halfway),
    "source_drift": Kind(_source_drift),
    "low_dose": Kind(_low_dose),
    "blurred": Kind(_blurred),
    "held_parameter": Kind(_held_off),
    "held_right": Kind(_held_right),
    "scanner_off": Kind(_scanner_off),
    "detector_off": Kind(_detector_off),
    "gradient": Kind(after=_gradient),
    "dead_pixels": Kind(after=_dead_columns),
    "image_mirrored": Kind(after=_flipped_lr),
    "image_upside_down": Kind(after=_flipped_ud),
    "image_rotated": Kind(after=_rotated),
}
"""Every way of spoiling a scan."""
