"""The twin as ophyd-async devices for Bluesky: axes, tube, camera, and a flyer for smooth
scans.

Needs the extra `lab` (ophyd-async and bluesky); names are looked up on first use, so that
importing this package never imports them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flexdt_extensions.bluesky.camera_device import TwinCamera as TwinCamera
    from flexdt_extensions.bluesky.devices import TwinAxis as TwinAxis
    from flexdt_extensions.bluesky.devices import TwinLab as TwinLab
    from flexdt_extensions.bluesky.devices import TwinTube as TwinTube
    from flexdt_extensions.bluesky.flyer import FlyScan as FlyScan
    from flexdt_extensions.bluesky.flyer import TwinFlyer as TwinFlyer
    from flexdt_extensions.bluesky.lab_connection import LabConnection as LabConnection
    from flexdt_extensions.bluesky.lab_connection import LimitsExceeded as LimitsExceeded

_HOMES = {
    "FlyScan": "flexdt_extensions.bluesky.flyer",
    "LabConnection": "flexdt_extensions.bluesky.lab_connection",
    "LimitsExceeded": "flexdt_extensions.bluesky.lab_connection",
    "TwinAxis": "flexdt_extensions.bluesky.devices",
    "TwinCamera": "flexdt_extensions.bluesky.camera_device",
    "TwinFlyer": "flexdt_extensions.bluesky.flyer",
    "TwinLab": "flexdt_extensions.bluesky.devices",
    "TwinTube": "flexdt_extensions.bluesky.devices",
}

__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    """Import a device or plan when it is first used; raises AttributeError on an unknown
    name, and an error naming the package if ophyd-async or bluesky is missing.
    """
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from flexdt.extending import package

    for needed in ("ophyd_async.core", "bluesky"):
        package(needed, __name__, "lab", "flexdt-extensions")
    return getattr(import_module(_HOMES[name]), name)
