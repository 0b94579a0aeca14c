"""Lamps of the lab: plain ones for every browser, and finer ones where a graphics processor
draws.

Without one, shadows and an environment take ten times as long as all the rest of a picture.
"""

from __future__ import annotations

from typing import Final

import viser

SKY: Final = "/lights/sky"
GROUND: Final = (120, 116, 112)
SKY_COLOR: Final = (236, 242, 255)
KEY = "/lights/key"
KEY_AT = (1.8, -2.2, 3.2)
FILL_AT: Final = (-2.6, 1.4, 1.2)
"""Position of the fill light [m]."""


def light_plainly(scene: viser.SceneApi) -> None:
    """Replace the scene's lamps by sky, key and fill light without shadows, for all
    clients.

    An environment map is removed.
    """
    scene.configure_environment_map(None)
    scene.add_light_hemisphere(
        SKY, sky_color=SKY_COLOR, ground_color=GROUND, intensity=1.35
    )
    scene.add_light_directional(KEY, intensity=2.5, position=KEY_AT)
    scene.add_light_directional("/lights/fill", intensity=0.8, position=FILL_AT)


def light_finely(scene: viser.SceneApi) -> None:
    """Set a room that shines in metal and lights all around, and a lamp with shadows.

    The environment map is "studio"; sky and key lamp replace the plain ones; the fill
    light stays. `scene`: of one client; its lamps replace those of all clients.
    """
    scene.configure_environment_map("studio", environment_intensity=0.1)
    scene.add_light_hemisphere(
        SKY, sky_color=SKY_COLOR, ground_color=GROUND, intensity=1.1
    )
    scene.add_light_directional(KEY, intensity=1.9, position=KEY_AT, cast_shadow=True)
