"""The twin as ophyd-async devices for Bluesky: axes, tube, camera, and a flyer for smooth scans.

Needs the extra `lab` (ophyd-async and bluesky); names are looked up on first use, so that importing
`flexdt.clients` never imports them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from flexdt.twin.errors import TwinError

if TYPE_CHECKING:
    from flexdt.clients.lab.axes import LimitsExceeded as LimitsExceeded
    from flexdt.clients.lab.axes import TwinAxis as TwinAxis
    from flexdt.clients.lab.camera_device import TwinCamera as TwinCamera
    from flexdt.clients.lab.devices import TwinLab as TwinLab
    from flexdt.clients.lab.devices import TwinTube as TwinTube
    from flexdt.clients.lab.flyer import FlyScan as FlyScan
    from flexdt.clients.lab.flyer import TwinFlyer as TwinFlyer
    from flexdt.clients.lab.lab_connection import LabConnection as LabConnection

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

__all__ = list(_HOMES)


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
