"""Paints of the scanner's parts."""

from __future__ import annotations

from typing import Final

from flexdt.clients.viewer.scenes.meshes.painted_meshes import Paint

STEEL = Paint((186, 192, 200), 0.25, 0.35)
ALUMINIUM = Paint((205, 210, 217), 0.15, 0.45)
ANODISED = Paint((62, 68, 79), 0.15, 0.5)
GRANITE = Paint((96, 104, 117), 0.0, 0.85)
ENAMEL = Paint((240, 243, 247), 0.0, 0.4)
BRAND = Paint((28, 120, 200), 0.0, 0.45)
BRASS = Paint((206, 168, 92), 0.3, 0.35)
SIGNAL = Paint((255, 140, 0), 0.0, 0.5, (0.25, 0.12, 0.0))
RUBBER = Paint((34, 37, 43), 0.0, 0.8)
PAINTS: Final = {
    name: value for name, value in globals().items() if isinstance(value, Paint)
}
"""Paints by their names in `data/parts.toml`."""
