"""Views: where each camera stands and, for the beam's eye, how the page crops it.

The overview holds focal spot, sample and image whatever their distances, and the sample's own view
the ball around it, both as large as the picture allows (`fitted`).

The beam's eye stands in the focal spot and looks along the detector's normal, so the panel is an
undistorted rectangle. Where the piercing point is off its centre the picture is rendered larger and
cropped by the page, since a browser's camera is symmetric. Units: m for viser, ratios for the page.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from flexdt.clients.viewer.scenes.world import MM, World
from flexdt.twin.geometry.conventions import FloatArray

Vector = tuple[float, float, float]
WIDEST = 3.0
"""The beam's eye is rendered at most this many times as wide or high as the panel; beyond, the
camera looks at the panel's centre instead and the frame is no longer exact."""
WIDE = 1.35
"""Aspect (width over height) for which cameras are made; narrower pictures open wider (`roomy`)."""
ROOM = 0.86
"""Part of the picture, in width and height, that what is fitted takes."""
TUBE_MM = 60.0
"""Of the tube behind its focal spot that the overview shows."""
ISO_WAY, ISO_FOV = (-0.5, 0.75, -0.42), math.radians(38.0)
SAMPLE_WAY, SAMPLE_FOV = (-0.62, 0.68, -0.39), math.radians(30.0)


@dataclass(frozen=True)
class Standpoint:
    """A camera: metres, and its vertical opening angle [rad]."""

    position: Vector
    look_at: Vector
    up: Vector
    fov: float


SIDE = Standpoint((3.15, 0.52, 0.1), (0.0, 0.52, 0.1), (0.0, 0.0, 1.0), math.radians(30.0))
FREE = Standpoint((-0.95, 0.1, 0.52), (0.0, 0.72, 0.0), (0.0, 0.0, 1.0), math.radians(45.0))
FIXED = {"side": SIDE, "free": FREE}
"""View -> camera, for those that do not depend on the machine's pose."""


def presets(world: World, radius_mm: float) -> dict[str, Standpoint]:
    """View -> the camera that it opens with, for all but the beam's eye.

    Args:
        world: the machine's pose.
        radius_mm: of the ball around the sample.
    """
    middle = world.sample.shift
    ball = middle + max(radius_mm, 5.0) * np.concatenate([np.eye(3), -np.eye(3)])
    tube = world.source + TUBE_MM * np.outer((0.0, 1.0), (0.0, -1.0, 0.0))
    whole = np.concatenate([tube, ball, world.corners])
    iso = fitted(whole * MM, ISO_WAY, ISO_FOV, middle * MM)
    return {**FIXED, "iso": iso, "sample": fitted(ball * MM, SAMPLE_WAY, SAMPLE_FOV, middle * MM)}


def fitted(points: FloatArray, way: Vector, fov: float, around: FloatArray) -> Standpoint:
    """The nearest camera that looks along `way` and holds all points; up is +z.

    Args:
        points: (n, 3) [m].
        way: direction of the look.
        fov: vertical opening of a picture that is `WIDE` [rad].
        around: (3,) [m], what turns of the camera keep at their distance.
    """
    ahead = np.asarray(way) / np.linalg.norm(way)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, ahead), ahead])
    seen = points @ axes.T
    eye, back = np.zeros(3), []
    for k, aspect in ((0, WIDE), (1, 1.0)):
        slope = ROOM * aspect * math.tan(0.5 * fov)
        # On the left each point wants x - eye >= -slope * (depth - eye's depth); right likewise.
        left = (seen[:, k] + slope * seen[:, 2]).min()
        right_of = (seen[:, k] - slope * seen[:, 2]).max()
        back.append((left - right_of) / (2.0 * slope))
        eye[k] = 0.5 * (left + right_of)
    eye[2] = min(back)
    position = eye @ axes
    target = position + ahead * ((around - position) @ ahead)
    return Standpoint(_vector(position), _vector(target), (0.0, 0.0, 1.0), fov)


def roomy(camera: Standpoint, aspect: float) -> Standpoint:
    """The camera with as wide an opening in a narrow picture as in one that is `WIDE`."""
    wider = max(1.0, WIDE / max(aspect, 0.3))
    return replace(camera, fov=2.0 * math.atan(wider * math.tan(0.5 * camera.fov)))


def beam_view(world: World) -> tuple[Standpoint, dict[str, object]]:
    """The beam's eye of a geometry, and how a page crops it to show the image and nothing else.

    Lengths for the page are in units of the image's width: the picture is `width` x `height`, and
    the image, 1 x `aspect`, has its top left corner `left`, `top` inside it; the sample stands
    `sample_height_mm` above the focal spot. Where not `exact` the eye looks at the panel's middle.
    """
    rows, cols = world.shape
    pu, pv = float(np.linalg.norm(world.u)), float(np.linalg.norm(world.v))
    column, row = world.piercing_px.tolist()
    width, height = cols * pu, rows * pv
    left, top = (column + 0.5) * pu, (row + 0.5) * pv
    half_w, half_h = max(left, width - left), max(top, height - top)
    exact = 2.0 * half_w <= WIDEST * width and 2.0 * half_h <= WIDEST * height
    if exact:
        target, far = world.foot, world.distance
    else:
        left, top, half_w, half_h = 0.5 * width, 0.5 * height, 0.5 * width, 0.5 * height
        target, far = world.detector, float(np.linalg.norm(world.detector - world.source))
    up = tuple((-world.v / pv).tolist())
    eye = Standpoint(_m(world.source), _m(target), up, 2.0 * math.atan2(half_h, far))
    return eye, {
        "width": 2.0 * half_w / width,
        "height": 2.0 * half_h / width,
        "left": (half_w - left) / width,
        "top": (half_h - top) / width,
        "aspect": height / width,
        "exact": exact,
        "sample_height_mm": float(world.axis[2] - world.source[2]),
    }


def _m(point: FloatArray) -> Vector:
    return _vector(point * MM)


def _vector(point: FloatArray) -> Vector:
    x, y, z = point.tolist()
    return (x, y, z)
