"""The four views: where each camera stands and, for the beam's eye, how the page crops it.

The beam's eye stands in the focal spot and looks along the detector's normal, so the panel is an
undistorted rectangle. Where the piercing point is off its centre the picture is rendered larger and
cropped by the page, since a browser's camera is symmetric. Units: m for viser, ratios for the page.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

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


@dataclass(frozen=True)
class Framing:
    """How to crop the beam's eye so that it shows the image and nothing else.

    Lengths are in units of the image's width. The rendered picture is `width` x `height`; the
    image's top left corner lies `left`, `top` inside it, and the image is 1 x `aspect`.
    """

    width: float
    height: float
    left: float
    top: float
    aspect: float
    exact: bool


ISO = Standpoint((1.94, -1.16, 1.22), (0.0, 0.42, 0.05), (0.0, 0.0, 1.0), math.radians(38.0))
SIDE = Standpoint((3.15, 0.52, 0.1), (0.0, 0.52, 0.1), (0.0, 0.0, 1.0), math.radians(30.0))
FREE = Standpoint((-0.95, 0.1, 0.52), (0.0, 0.72, 0.0), (0.0, 0.0, 1.0), math.radians(45.0))
FIXED = {"iso": ISO, "side": SIDE, "free": FREE}
"""View -> camera, for those that do not follow the machine."""


def beam_view(world: World) -> tuple[Standpoint, Framing]:
    """The beam's eye of a geometry."""
    rows, cols = world.shape
    pu, pv = float(np.linalg.norm(world.u)), float(np.linalg.norm(world.v))
    column, row = world.piercing_px
    width, height = cols * pu, rows * pv
    left, top = (column + 0.5) * pu, (row + 0.5) * pv
    half_w, half_h = max(left, width - left), max(top, height - top)
    up = tuple((-world.v / pv).tolist())
    if 2.0 * half_w <= WIDEST * width and 2.0 * half_h <= WIDEST * height:
        fov = 2.0 * math.atan2(half_h, world.distance)
        frame = Framing(
            2.0 * half_w / width,
            2.0 * half_h / width,
            (half_w - left) / width,
            (half_h - top) / width,
            height / width,
            True,
        )
        return Standpoint(_m(world.source), _m(world.foot), up, fov), frame
    distance = float(np.linalg.norm(world.detector - world.source))
    fov = 2.0 * math.atan2(0.5 * height, distance)
    frame = Framing(1.0, height / width, 0.0, 0.0, height / width, False)
    return Standpoint(_m(world.source), _m(world.detector), up, fov), frame


def document(framing: Framing, world: World) -> dict[str, object]:
    """For the page, as plain data; with the sample's height above the focal spot [mm]."""
    height = float(world.axis[2] - world.source[2])
    return {**asdict(framing), "sample_height_mm": height}


def _m(point: np.ndarray) -> Vector:
    x, y, z = (point * MM).tolist()
    return (x, y, z)
