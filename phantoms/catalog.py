"""The phantoms that ship with the package, by name. `normal-7` is a cuboid of Table 6.2 with seven
beads. For files see `load_phantom_file` (text) and `mesh_phantom` (bytes)."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Final

from flexdt.phantoms.beads import CUBOIDS_MM, DEFAULT_BEADS, bead_phantom, chiral_phantom
from flexdt.phantoms.lego import lego_phantom
from flexdt.phantoms.phantom import Phantom
from flexdt.phantoms.shepp_logan import shepp_logan
from flexdt.twin.errors import UnknownNameError

_MAKERS: Final[Mapping[str, Callable[[], Phantom]]] = {
    "lego": lego_phantom,
    "shepp-logan": shepp_logan,
    "chiral": chiral_phantom,
}
_CUBOID: Final = re.compile(r"([a-z]+)-([1-9][0-9]{0,3})")


def phantom_names() -> tuple[str, ...]:
    """Names that `load_phantom` knows; each cuboid also as NAME-K with K beads."""
    return (*CUBOIDS_MM, *_MAKERS)


def is_shipped(name: str) -> bool:
    """Whether `load_phantom` knows `name`, a cuboid with K beads included."""
    match = _CUBOID.fullmatch(name)
    return name in phantom_names() or (match is not None and match[1] in CUBOIDS_MM)


def load_phantom(name: str) -> Phantom:
    """The phantom called `name`; a bare cuboid's name has five beads.

    Raises:
        UnknownNameError: lists the available names.

    >>> load_phantom("normal-7").beads.shape
    (7, 3)
    """
    if name in _MAKERS:
        return _MAKERS[name]()
    if name in CUBOIDS_MM:
        return bead_phantom(name, DEFAULT_BEADS)
    match = _CUBOID.fullmatch(name)
    if match is not None and match[1] in CUBOIDS_MM:
        return bead_phantom(match[1], int(match[2]))
    raise UnknownNameError(
        f"no phantom called {name!r}; there are: {', '.join(phantom_names())}, and cuboids with K "
        "beads such as normal-3",
        {"asked": name, "allowed": list(phantom_names())},
    )
