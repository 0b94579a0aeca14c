"""The layers of the scenes; each person chooses the shown ones (`Shown`).

`LAYERS` is the one list: the page's boxes, the methods' parameters and the nodes that the
scenes show or hide are made from it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

Nodes = Mapping[str, Mapping[str, Any]]
"""Name of a node -> its properties; `visible` is one of them."""


@dataclass(frozen=True)
class Layer:
    """Group of nodes that a page shows or hides together.

    Attributes:
        name: on the wire.
        title: of its box on the page.
        shown: by default.
        nodes: names of its nodes in the scene, where `{part}` is replaced by each
            component; none for names, which each view has drawn for itself.
        near: show the components near a contact, whatever is chosen.
    """

    name: str
    title: str
    shown: bool
    nodes: tuple[str, ...] = ()
    near: bool = False

    def nodes_of(self, parts: Collection[str]) -> Iterator[tuple[str, str | None]]:
        """Name its nodes, each with its component or None.

        Nodes keep the layer's order; `{part}` gives one node a part. >>> list(Layer("margin",
        "safety margin", False, ("/{part}/margin",)).nodes_of(["tube"])) [('/tube/margin',
        'tube')]"""
        for node in self.nodes:
            if "{part}" in node:
                yield from ((node.format(part=part), part) for part in parts)
            else:
                yield node, None


LAYERS: Final[tuple[Layer, ...]] = (
    Layer("beam", "X-ray cone", True, ("/beam",)),
    Layer("panel", "image on the panel", True, ("/panel",)),
    Layer("axis", "axis, piercing point", True, ("/axis", "/piercing")),
    Layer("ranges", "travel ranges", False, ("/ranges",)),
    Layer("bodies", "collision bodies", False, ("/machine/{part}/body",), near=True),
    Layer("margin", "safety margin", False, ("/machine/{part}/margin",), near=True),
    Layer("sample", "sample", True, ("/sample",)),
    Layer("machine", "machine", True, ("/machine/{part}/look", "/object/stand")),
    Layer("cabinet", "cabinet", False, ("/cabinet/walls", "/cabinet/lamp")),
    Layer("orbit", "planned trajectory", True, ("/object/plan",)),
    Layer(
        "gizmos",
        "handles to drag",
        False,
        ("/gizmos/source", "/gizmos/object", "/gizmos/detector"),
    ),
    Layer("names", "names of source, sample, detector", True),
    Layer("labels", "all names, axes, scale", False, ("/scale", "/axes")),
)
"""All layers, in the page's order."""


def first_shown() -> frozenset[str]:
    """Name the layers that are shown by default."""
    return frozenset(layer.name for layer in LAYERS if layer.shown)


@dataclass(frozen=True)
class Shown:
    """The layers that are shown, and the opacity of the sample (0, 1]."""

    layers: frozenset[str] = field(default_factory=first_shown)
    opacity: float = 0.5

    def __contains__(self, layer: str) -> bool:
        return layer in self.layers

    def changed(self, opacity: float | None = None, **layers: bool | None) -> Shown:
        """Replace the opacity and some layers in a copy.

        Layers that are None stay, and so does an opacity of None. Unknown names are added
        as they are.

        >>> sorted(Shown(frozenset(["beam", "axis"])).changed(axis=False, names=True).layers)
        ['beam', 'names']"""
        on = {name for name, wanted in layers.items() if wanted}
        off = {name for name, wanted in layers.items() if wanted is False}
        if opacity is None:
            opaque = self.opacity
        else:
            opaque = opacity
        return replace(self, layers=self.layers - off | on, opacity=opaque)

    @property
    def told(self) -> dict[str, object]:
        """Return the page's copy: "shown" (layer -> bool, of all layers) and
        "opacity".
        """
        return {
            "shown": {layer.name: layer.name in self for layer in LAYERS},
            "opacity": self.opacity,
        }

    def visible(
        self, parts: Collection[str], near: Collection[str] = ()
    ) -> dict[str, bool]:
        """Determine whether each node of all layers is visible.

        `near`: parts near a contact, which layers with `near` show.
        """
        return {
            node: layer.name in self or (layer.near and part in near)
            for layer in LAYERS
            for node, part in layer.nodes_of(parts)
        }
