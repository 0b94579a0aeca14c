"""The twin as ophyd-async devices for Bluesky: axes, tube, camera, and a flyer for smooth scans.

Needs the extra `lab` (ophyd-async and bluesky); names are looked up on first use, so that importing
`flexdt.clients` never imports them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from flexdt.twin.errors import TwinError

if TYPE_CHECKING:
    from flexdt.clients.lab.axes import LimitsExceeded, TwinAxis
    from flexdt.clients.lab.camera_device import TwinCamera
    from flexdt.clients.lab.devices import TwinLab, TwinTube
    from flexdt.clients.lab.flyer import FlyScan, TwinFlyer
    from flexdt.clients.lab.lab_connection import LabConnection

_HOMES = {
    "FlyScan": "flexdt.clients.lab.flyer",
    "LabConnection": "flexdt.clients.lab.lab_connection",
    "LimitsExceeded": "flexdt.clients.lab.axes",
    "TwinAxis": "flexdt.clients.lab.axes",
    "TwinCamera": "flexdt.clients.lab.camera_device",
    "TwinFlyer": "flexdt.clients.lab.flyer",
    "TwinLab": "flexdt.clients.lab.devices",
    "TwinTube": "flexdt.clients.lab.devices",
}

__all__ = [
    "FlyScan",
    "LabConnection",
    "LimitsExceeded",
    "TwinAxis",
    "TwinCamera",
    "TwinFlyer",
    "TwinLab",
    "TwinTube",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(_HOMES[name]), name)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("flexdt"):
            raise
        raise TwinError(
            f"flexdt.clients.lab needs {error.name}, which is not installed: "
            "pip install 'flexdt[lab]'",
            {"asked": name, "missing": error.name},
        ) from None
