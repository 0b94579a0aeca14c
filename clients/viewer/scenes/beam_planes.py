"""The beam's light in the air, in two faint planes through the focal spot.

It has full strength before the sample, and the transmitted part behind it. The planes are
those of the image's middle column and row. A place behind the sample has the transmission
of the pixel at which its ray ends, so the shadow is visible in the air. A look through
all of it passes one sheet of each plane, and keeps half of the background. The ball
around the sample is left out: a radiograph does not show where in it light is lost, and a
plane through a transparent sample would hide half of it. The cone's sides are its edges
alone: viser draws a translucent mesh in front of or behind all of the sample, whatever is
between (`data/translucent.js`). Units: mm, m for viser.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import viser

from flexdt.clients.viewer.scenes.world import MM, World, quaternion
from flexdt.twin.geometry.conventions import FloatArray

SHAPE: Final = (160, 192)
"""Rows and columns of each plane's picture."""
LIGHT: Final = (255, 176, 32)
MOST: Final = 66
"""Largest opacity of the beam in a plane, of 255."""


@dataclass(frozen=True, eq=False)
class BeamPlane:
    """A rectangle with a fan of rays in it.

    Attributes:
        rgba: (rows, cols, 4); columns go along `axes[:, 0]`, rows along `axes[:, 1]`.
        size: width and height [mm].
        center: (3,) [mm].
        axes: (3, 3) its directions.
    """

    rgba: npt.NDArray[np.uint8]
    size: tuple[float, float]
    center: FloatArray
    axes: FloatArray


def fans(
    world: World, lines: npt.NDArray[np.generic], radius_mm: float
) -> list[BeamPlane]:
    """Compute four planes of the beam: through the image's middle column, and its row.

    Each is one before the sample, with all light, and one behind, with exp(-line
    integral). `lines`: (rows, cols); `radius_mm`: of the ball around the sample.
    """
    rows, cols = lines.shape
    through = np.exp(-np.asarray(lines, dtype=np.float64))
    height, width = world.shape
    planes = []
    for across, behind in (
        (world.v * height, through[:, cols // 2]),
        (world.u * width, through[rows // 2]),
    ):
        for side, light in ((-1.0, np.ones(1)), (1.0, behind)):
            planes.append(_fan(world, across, light, side, radius_mm))
    return planes


def _fan(
    world: World, across: FloatArray, through: FloatArray, side: float, radius: float
) -> BeamPlane:
    """Draw the rays to a line of pixels through the image's middle, as one picture of
    `SHAPE` pixels in the plane of focal spot and line.

    Pixels are as opaque as transmission says, transparent where no ray passes. The
    opacity is at most `MOST` of 255, times the transmission of the pixel where the ray
    ends. Before the sample the plane begins at the focal spot; behind it, it ends at the
    panel.

    Args:
        world: geometry.
        across: direction and length of the line of pixels (3,) [mm].
        through: transmission of the pixels (n,).
        side: -1 before the sample, 1 behind it.
        radius: of the ball around the sample that is left out [mm].
    """
    along = across / np.linalg.norm(across)
    middle = world.detector - world.source
    ahead = middle - (middle @ along) * along
    length = float(np.linalg.norm(ahead))
    ahead = ahead / length
    # In the plane: (distance from the focal spot, along the line of pixels).
    cut = float((world.sample.shift - world.source) @ ahead) + side * radius
    near, far = (
        (0.0, max(cut, 1.0)) if side < 0.0 else (min(max(cut, 0.0), length - 1.0), length)
    )
    half = 0.5 * float(np.linalg.norm(across))
    first = middle @ along - half
    last = middle @ along + half
    low = min(first * near, first * far) / length
    high = max(last * near, last * far) / length
    rows, cols = SHAPE
    a = near + (np.arange(cols) + 0.5) * (far - near) / cols
    b = low + (np.arange(rows)[:, None] + 0.5) * (high - low) / rows
    part = (b * length / a - first) / (last - first)
    pixel = np.clip(part * len(through), 0, len(through) - 1).astype(int)
    rgba = np.empty((*SHAPE, 4), dtype=np.uint8)
    rgba[..., :3] = LIGHT
    rgba[..., 3] = np.where(
        (part >= 0.0) & (part < 1.0), MOST * through[pixel], 0.0
    ).clip(0, 255)
    center = world.source + 0.5 * (near + far) * ahead + 0.5 * (low + high) * along
    axes = np.stack([ahead, along, np.cross(ahead, along)], axis=1)
    return BeamPlane(rgba, (far - near, float(high - low)), center, axes)


class BeamShade:
    """The planes in a scene."""

    def __init__(self, scene: viser.SceneApi) -> None:
        """Add the four images of the beam's planes to the scene, hidden and blank."""
        plain: Any = {"visible": False, "cast_shadow": False, "receive_shadow": False}
        self._planes: list[Any] = [
            scene.add_image(
                f"/beam/shade{name}",
                np.zeros((2, 2, 4), dtype=np.uint8),
                0.01,
                0.01,
                **plain,
            )
            for name in range(4)
        ]
        self._newest: tuple[World, npt.NDArray[np.generic], float] | None = None
        self._lit = self._fits = self._shown = False

    def show(
        self, world: World, lines: npt.NDArray[np.generic], radius_mm: float
    ) -> None:
        """Take the newest image (see `fans`), made at `world`."""
        self._newest = world, lines, max(radius_mm, 1.0)
        self._fits = True
        self._change(anew=True)

    def light(self, on: bool) -> None:
        """Show the shaded beam, drawn with the newest image, or hide it.

        `on` is whether X-rays come out.
        """
        self._lit = on
        self._change()

    def follow(self, world: World) -> None:
        """Hide the shaded beam while source, sample or panel stands farther from where it was
        for the newest image than the sample is large: its shadow would begin in the air."""
        if self._newest is not None:
            then, _, radius = self._newest
            self._fits = all(
                float(np.linalg.norm(now - before)) <= radius
                for now, before in (
                    (world.source, then.source),
                    (world.sample.shift, then.sample.shift),
                    (world.detector, then.detector),
                )
            )
            self._change()

    def _change(self, anew: bool = False) -> None:
        """Show the planes where they are lit and fit; draw them as they come, or `anew`."""
        shown = self._lit and self._fits
        if shown and (anew or not self._shown):
            self._draw()
        if shown != self._shown:
            self._shown = shown
            for handle in self._planes:
                handle.visible = shown

    def _draw(self) -> None:
        """Draw the newest image as planes along the beam; sizes are converted to [m]."""
        assert self._newest is not None
        for handle, plane in zip(self._planes, fans(*self._newest), strict=True):
            handle.image = plane.rgba
            handle.render_width, handle.render_height = (side * MM for side in plane.size)
            handle.position = tuple((plane.center * MM).tolist())
            handle.wxyz = quaternion(plane.axes)
