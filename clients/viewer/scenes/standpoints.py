"""The four views: where each camera stands and, for the beam's eye, how the page crops it.

The beam's eye stands in the focal spot and looks along the detector's normal, so the panel is an
undistorted rectangle. Where the piercing point is off its centre the picture is rendered larger and
cropped by the page, since a browser's camera is symmetric. Units: m for viser, ratios for the page.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexdt.clients.viewer.scenes.sample import MM
from flexdt.clients.viewer.scenes.world import World

Vector = tuple[float, float, float]
WIDEST = 3.0
"""The beam's eye is rendered at most this many times as wide or high as the panel; beyond, the
camera looks at the panel's centre instead and the frame is no longer exact."""


@dataclass(frozen=True)
class Standpoint:
    """A camera: metres, and its vertical opening angle [rad]."""

    position: Vector
    look_at: Vector
    up: Vector
    fov: float


ISO = Standpoint((1.94, -1.16, 1.22), (0.0, 0.42, 0.05), (0.0, 0.0, 1.0), math.radians(38.0))
SIDE = Standpoint((3.15, 0.52, 0.1), (0.0, 0.52, 0.1), (0.0, 0.0, 1.0), math.radians(30.0))
FREE = Standpoint((-0.95, 0.1, 0.52), (0.0, 0.72, 0.0), (0.0, 0.0, 1.0), math.radians(45.0))
FIXED = {"iso": ISO, "side": SIDE, "free": FREE}
"""View -> camera, for those that do not follow the machine."""


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


def _m(point: np.ndarray) -> Vector:
    x, y, z = (point * MM).tolist()
    return (x, y, z)
