"""Views: the place of each camera and, for the beam's eye, how the page crops it.

Every view but the beam's eye holds tube, sample and image whatever their distances, as
large as a pane of its width and height allows (`Fitted`); the sample's own picture next
to it is made in the same way. Source and detector are meters apart and a sample is
centimeters high, so in none of them can the sample itself be large: the page shows it
close up in each pane.

The beam's eye is in the focal spot and looks along the detector's normal, so the panel is
an undistorted rectangle. Where the piercing point is off its center the picture is
rendered larger and cropped by the page, since a browser's camera is symmetric. Units: m
for viser, ratios for the page.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.clients.viewer.scenes.world import MM, World
from flexdt.twin.geometry.conventions import FloatArray

Vector = tuple[float, float, float]
MAX_SIZE_RATIO = 3.0
"""Largest width or height of the beam's eye, over the panel's; beyond, the camera
looks at the panel's center instead and the frame is no longer exact."""
WIDE = 1.35
"""Aspect (width over height) of a pane whose size is not known yet."""
MIN_ASPECT = 0.3
MAX_ASPECT = 4.0
"""Range of aspects for which cameras are made."""
ROOM = 0.9
"""Part of the picture, in width and height, that fitted points take."""
TUBE_MM = (110.0, 110.0, 100.0)
"""Size of the tube around and behind its focal spot in views: width, length, height
[mm]."""
RIM_CORNERS: Final = 12
"""Number of corners of the polygon around the cylinder in which a sample turns."""
FOV_RAD: Final = {
    "iso": math.radians(30.0),
    "side": math.radians(24.0),
    "free": math.radians(34.0),
    "sample": math.radians(30.0),
}
"""View -> vertical opening of its camera [rad]."""


def _way(yaw_deg: float, pitch_deg: float) -> Vector:
    """Compute the unit direction (x, y, z) of a look along the beam, turned to the side
    (positive: from the right) and down. >>> _way(0.0, 0.0) (-0.0, 1.0, -0.0) The direction (x,
    y, z) is of length 1; angles in degrees."""
    yaw = math.radians(yaw_deg)
    pitch = math.radians(pitch_deg)
    level = math.cos(pitch)
    return (-math.sin(yaw) * level, math.cos(yaw) * level, -math.sin(pitch))


WAYS: Final = {
    "iso": tuple(_way(yaw, pitch) for yaw in (40.0, 48.0) for pitch in (20.0, 26.0)),
    "side": (_way(90.0, 0.0),),
    "free": tuple(_way(-yaw, pitch) for yaw in (40.0, 50.0) for pitch in (24.0, 30.0)),
    "sample": (_way(42.0, 20.0),),
}
"""View -> directions from which its camera may look; it takes the one that shows most."""


@dataclass(frozen=True)
class Standpoint:
    """A camera: meters, and its vertical opening angle [rad]."""

    position: Vector
    look_at: Vector
    up: Vector
    fov: float


FREE = Standpoint(
    (-0.95, 0.1, 0.52), (0.0, 0.72, 0.0), (0.0, 0.0, 1.0), math.radians(45.0)
)
"""Camera of exported scenes for which no person has chosen one."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """Points of a view, and the directions from which it may be seen.

    Attributes:
        points: (n, 3) [m], all of which are in the picture.
        ways: directions of the look.
        fov: vertical opening [rad].
        around: (3,) [m], center of the camera's turns.
    """

    points: FloatArray
    ways: tuple[Vector, ...]
    fov: float
    around: FloatArray

    def at(self, aspect: float) -> Standpoint:
        """Choose a pane's camera: of those that hold all points, the nearest to the
        middle.

        `aspect`: width over height.
        """
        cameras = [
            fitted(self.points, way, self.fov, self.around, aspect) for way in self.ways
        ]
        return min(
            cameras, key=lambda one: float(np.linalg.norm(self.around - one.position))
        )

    def fits(self, camera: Standpoint, aspect: float) -> bool:
        """Check that a camera holds all points and wastes no room.

        False as well if a point is behind it. Wasted is a largest extent below
        `LEAST_REACH` of the picture.

        Args:
            camera: its present place.
            aspect: the pane's width over its height.
        """
        eye = np.asarray(camera.position)
        ahead = np.asarray(camera.look_at) - eye
        axes = _axes(ahead / np.linalg.norm(ahead))
        x, y, depth = axes @ (self.points - eye).T
        if depth.min() <= 0.0:
            return False
        slope = depth * math.tan(0.5 * camera.fov)
        reach = max(
            float(np.abs(x / slope).max()) / bounded(aspect),
            float(np.abs(y / slope).max()),
        )
        return LEAST_REACH < reach < 1.0


LEAST_REACH: Final = 0.75
"""Part of the picture below which a view's points have become too small."""


def bounded(aspect: float) -> float:
    """Cut an aspect to the range of the cameras."""
    return min(MAX_ASPECT, max(MIN_ASPECT, aspect))


def presets(
    world: World, radius_mm: float, rim_mm: FloatArray | None = None
) -> dict[str, Fitted]:
    """Compute the fitted views that the scene opens with: view -> `Fitted`, for all but
    the beam's eye.

    "iso", "side" and "free" show tube, ball and panel whole; "sample" shows the cylinder
    (or the ball). The ball has at least 5 mm radius; the cylinder is that of `rim`.
    Points are converted to [m].

    Args:
        world: the machine's pose.
        radius_mm: of the ball around the sample.
        rim_mm: (n, 3) of the cylinder in which the sample turns (`rim`); None is the ball.
    """
    middle = world.sample.shift
    ball = middle + max(radius_mm, 5.0) * np.concatenate([np.eye(3), -np.eye(3)])
    width, length, height = TUBE_MM
    tube = world.source + [
        [0.5 * x * width, -y * length, 0.5 * z * height]
        for x, y, z in ((0, 0, 0), (-1, 1, -1), (-1, 1, 1), (1, 1, -1), (1, 1, 1))
    ]
    whole = np.concatenate([tube, ball, world.corners]) * MM
    near = (ball if rim_mm is None else rim_mm) * MM
    center = 0.5 * (near.min(axis=0) + near.max(axis=0))
    views = {
        view: Fitted(whole, WAYS[view], FOV_RAD[view], middle * MM)
        for view in ("iso", "side", "free")
    }
    return {**views, "sample": Fitted(near, WAYS["sample"], FOV_RAD["sample"], center)}


def rim(world: World, vertices_m: Sequence[npt.NDArray[np.float32]]) -> FloatArray | None:
    """Compute points (n, 3) [mm] around the cylinder in which the sample turns; None without a
    sample.

    At its lower and upper end, a polygon outside the circle. The cylinder is upright through the
    rotation axis, from the lowest to the highest vertex; None for meshes without vertices, too.
    The lower end's points come first.

    `world`: pose of the sample; `vertices_m`: of its meshes, or of their convex hulls, in its
    own frame.
    """
    if not any(len(some) for some in vertices_m):
        return None
    corners = world.sample @ (np.concatenate(vertices_m).astype(np.float64) / MM)
    middle = world.axis
    radius = float(np.linalg.norm((corners - middle)[:, :2], axis=1).max())
    angles = np.arange(RIM_CORNERS) * 2.0 * np.pi / RIM_CORNERS
    outer = radius / math.cos(np.pi / RIM_CORNERS)  # so that the polygon holds the circle
    circle = outer * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    levels = [corners[:, 2].min(), corners[:, 2].max()]
    return np.concatenate([circle + [middle[0], middle[1], level] for level in levels])


def _axes(ahead: FloatArray) -> FloatArray:
    """Compute right, up and ahead of a camera as rows (3, 3); the world's z is
    upwards."""
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, ahead), ahead])


def fitted(
    points: FloatArray, way: Vector, fov: float, around: FloatArray, aspect: float = WIDE
) -> Standpoint:
    """Find the nearest camera that looks along `way` and holds all points; up is +z.

    The points fill at most `ROOM` of the picture; the camera looks at the point of its
    line nearest to `around`.

    Args:
        points: (n, 3) [m].
        way: direction of the look.
        fov: vertical opening [rad].
        around: (3,) [m], center of the camera's turns.
        aspect: the pane's width over its height.
    """
    ahead = np.asarray(way) / np.linalg.norm(way)
    axes = _axes(ahead)
    seen = points @ axes.T
    eye = np.zeros(3)
    back = []
    for k, share in ((0, bounded(aspect)), (1, 1.0)):
        slope = ROOM * share * math.tan(0.5 * fov)
        # On the left each point wants x - eye >= -slope * (depth - eye's depth); right
        # likewise.
        left = (seen[:, k] + slope * seen[:, 2]).min()
        right_of = (seen[:, k] - slope * seen[:, 2]).max()
        back.append((left - right_of) / (2.0 * slope))
        eye[k] = 0.5 * (left + right_of)
    eye[2] = min(back)
    position = eye @ axes
    target = position + ahead * ((around - position) @ ahead)
    return Standpoint(_vector(position), _vector(target), (0.0, 0.0, 1.0), fov)


def beam_view(world: World) -> tuple[Standpoint, dict[str, object]]:
    """Compute the beam's eye of a geometry, and how a page crops it to the image alone.

    The eye is at the focal spot and looks at the foot of the perpendicular, or at the
    panel's middle if that needs a picture of more than `MAX_SIZE_RATIO` times the image
    in width or height. Up is the image's -v; distances of the camera are in [m].

    Args:
        world: geometry.

    Returns:
        Camera and framing, whose lengths are in units of the image's width: the picture
        is `width` x `height`, and the image, 1 x `aspect`, has its top left corner
        `left`, `top` inside it. `exact` is False where the eye looks at the panel's
        middle; `sample_height_mm` is the sample's height above the focal spot.
    """
    rows, cols = world.shape
    pu = float(np.linalg.norm(world.u))
    pv = float(np.linalg.norm(world.v))
    column, row = world.piercing_px.tolist()
    width = cols * pu
    height = rows * pv
    left = (column + 0.5) * pu
    top = (row + 0.5) * pv
    half_w = max(left, width - left)
    half_h = max(top, height - top)
    exact = (
        2.0 * half_w <= MAX_SIZE_RATIO * width and 2.0 * half_h <= MAX_SIZE_RATIO * height
    )
    if exact:
        target = world.foot
        far = world.distance
    else:
        left = 0.5 * width
        top = 0.5 * height
        half_w = 0.5 * width
        half_h = 0.5 * height
        target = world.detector
        far = float(np.linalg.norm(world.detector - world.source))
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
