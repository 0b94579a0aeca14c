"""The layers of the scenes; what a page shows of them is each person's own choice (`Shown`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

LAYERS: Final[Mapping[str, bool]] = {
    "beam": True, "axis": True, "panel": True, "ranges": False, "bodies": False, "margin": False,
    "sample": True, "machine": True, "orbit": True, "gizmos": False, "labels": False,
    "names": True, "cabinet": True,
}  # fmt: skip
"""Layer -> whether it is shown until somebody chooses."""

Nodes = Mapping[str, Mapping[str, Any]]
"""Name of a node -> its properties; `visible` is one of them."""


@dataclass(frozen=True)
class Shown:
    """The layers that are shown, and the opacity of the sample (0, 1]."""

    layers: frozenset[str] = frozenset(name for name, on in LAYERS.items() if on)
    opacity: float = 0.5

    def __contains__(self, layer: str) -> bool:
        return layer in self.layers

    def changed(self, opacity: float | None = None, **layers: bool | None) -> Shown:
        """The same, but for what is given.

        >>> sorted(Shown(frozenset(["beam", "axis"])).changed(axis=False, names=True).layers)
        ['beam', 'names']
        """
        on = {name for name, wanted in layers.items() if wanted}
        off = {name for name, wanted in layers.items() if wanted is False}
        opaque = self.opacity if opacity is None else opacity
        return replace(self, layers=self.layers - off | on, opacity=opaque)

    @property
    def told(self) -> dict[str, object]:
        """For the page."""
        return {"shown": {name: name in self for name in LAYERS}, "opacity": self.opacity}
