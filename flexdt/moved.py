"""Where the modules of flexdt 0.2 are that have left the package.

`import flexdt` appends a finder behind all others, so that it is consulted only for a module that
nobody has. An old import path is then an error that names the new one.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Final

MOVED: Final = {
    "flexdt.clients.client.async_client": "flexdt.clients.client.client",
    "flexdt.clients.batch": "flexdt_extensions.batch",
    "flexdt.clients.calibration.build_sheet": "flexdt_extensions.phantom_design.phantom_design",
    "flexdt.clients.calibration.phantom_design": "flexdt_extensions.phantom_design.phantom_design",
    "flexdt.clients.reconstruction.on_workers": "flexdt_extensions.fdk_on_workers",
    "flexdt.clients.reconstruction.zarr_volume": "flexdt_extensions.fdk_on_workers",
    "flexdt.clients.scenario": "flexdt_extensions.ctsimu.scenario",
    "flexdt.clients.studies": "flexdt_extensions.studies",
    "flexdt.server.files": "flexdt.runtime.files",
    "flexdt.server.runtime": "flexdt.runtime",
    "flexdt.server.wire_errors": "flexdt.runtime.wire_errors",
    "flexdt.server.bench": "flexdt_extensions.bench",
    "flexdt.twin.calibration.design": "flexdt_extensions.phantom_design",
    "flexdt.twin.calibration.online": "flexdt_extensions.online",
    "flexdt.twin.calibration.studies": "flexdt_extensions.studies",
    "flexdt.twin.exchange.ctsimu": "flexdt_extensions.ctsimu.ctsimu_write",
    "flexdt.twin.exchange.ctsimu_read": "flexdt_extensions.ctsimu.ctsimu_read",
    "flexdt.twin.exchange.ctsimu_scan": "flexdt_extensions.ctsimu.ctsimu_scan",
    "flexdt.twin.projection.gpu_astra": "flexdt_extensions.bench.device_page",
    "flexdt.twin.physics.apparatus": "flexdt.twin.physics.detector",
    "flexdt.twin.physics.panel": "flexdt.twin.physics.detector",
    "flexdt.clients.lab": "flexdt_extensions.bluesky",
    "flexdt.clients.learning": "flexdt_extensions.learning",
}
"""Old module or package -> its name now."""


class _Moved:
    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> None:
        """Find nothing.

        Raises:
            ModuleNotFoundError: the module has moved.
        """
        if name in MOVED:
            new = MOVED[name]
            more = (
                "; it is a part of flexdt-extensions: pip install flexdt-extensions"
                if new.startswith("flexdt_extensions")
                else ""
            )
            # Without the error's `name`: Python would drop the message of `from PACKAGE import X`.
            raise ModuleNotFoundError(f"{name} has moved to {new}{more}")


def watch() -> None:
    """Have imports of moved modules name the new place."""
    if _Moved not in sys.meta_path:
        sys.meta_path.append(_Moved)
