"""The phantoms that ship with the package, by name. `normal-7` is a cuboid of Table 6.2 with seven
beads. For files see `load_phantom_file` (text) and `mesh_phantom` (bytes).

The Shepp-Logan head phantom in three dimensions is ten additive ellipsoids, exact for X-rays. Its
attenuation is the table's contrast times that of water.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Final

from flexdt.phantoms.beads import CUBOIDS_MM, DEFAULT_BEADS, bead_phantom, chiral_phantom
from flexdt.phantoms.bricks import lego_phantom
from flexdt.phantoms.materials import material
from flexdt.phantoms.phantom import Phantom
from flexdt.twin.errors import UnknownNameError
from flexdt.twin.geometry.conventions import rotation_z
from flexdt.twin.projection.analytic_solids import Ellipsoid, Scene, Solid
from flexdt.twin.signatures import public

# Contrast, semi-axes (x, y, z), centre (x, y, z), turn about z [deg], in a unit of half the height.
# Ellipsoids: Shepp and Logan 1974 in Kak and Slaney's 3D form (1988); contrasts: Toft 1996.
_ELLIPSOIDS: Final = (
    (1.0, (0.6900, 0.920, 0.810), (0.0, 0.0, 0.0), 0.0),
    (-0.8, (0.6624, 0.874, 0.780), (0.0, -0.0184, 0.0), 0.0),
    (-0.2, (0.1100, 0.310, 0.220), (0.22, 0.0, 0.0), -18.0),
    (-0.2, (0.1600, 0.410, 0.280), (-0.22, 0.0, 0.0), 18.0),
    (0.1, (0.2100, 0.250, 0.410), (0.0, 0.35, -0.15), 0.0),
    (0.1, (0.0460, 0.046, 0.050), (0.0, 0.1, 0.25), 0.0),
    (0.1, (0.0460, 0.046, 0.050), (0.0, -0.1, 0.25), 0.0),
    (0.1, (0.0460, 0.023, 0.050), (-0.08, -0.605, 0.0), 0.0),
    (0.1, (0.0230, 0.023, 0.020), (0.0, -0.606, 0.0), 0.0),
    (0.1, (0.0230, 0.046, 0.020), (0.06, -0.605, 0.0), 0.0),
)


@public
def shepp_logan(size_mm: float = 50.0) -> Phantom:
    """The phantom scaled so that its unit cube [-1, 1] measures `size_mm` [mm] along each side.

    Example:
        >>> len(shepp_logan(50.0).scene.solids)
        10
    """
    half = size_mm / 2.0
    water = material("water").mu_per_mm
    solids = []
    for contrast, semi_axes, center, turn_deg in _ELLIPSOIDS:
        rows = rotation_z(math.radians(turn_deg)).T.tolist()
        a, b, c = (half * s for s in semi_axes)
        x, y, z = (half * p for p in center)
        axes = (tuple(rows[0]), tuple(rows[1]), tuple(rows[2]))
        solids.append(Solid(Ellipsoid((x, y, z), (a, b, c), axes), "water", contrast * water))
    skull = _ELLIPSOIDS[0][1]
    return Phantom(
        "shepp-logan",
        f"Shepp-Logan head phantom of ten ellipsoids in a {size_mm:g} mm cube, contrast times the "
        "attenuation of water",
        Scene(tuple(solids)),
        (size_mm * skull[0], size_mm * skull[1], size_mm * skull[2]),
        assumed=("attenuation 1 of the table is that of water", f"size {size_mm:g} mm"),
    )


_MAKERS: Final[Mapping[str, Callable[[], Phantom]]] = {
    "lego": lego_phantom,
    "shepp-logan": shepp_logan,
    "chiral": chiral_phantom,
}
_CUBOID: Final = re.compile(r"([a-z]+)-([1-9][0-9]{0,3})")


def phantom_names() -> tuple[str, ...]:
    """Names that `load_phantom` knows; each cuboid also as NAME-K with K beads.

    Example:
        >>> "lego" in phantom_names()
        True
    """
    return (*CUBOIDS_MM, *_MAKERS)


def is_shipped(name: str) -> bool:
    """Whether `load_phantom` knows `name`, a cuboid with K beads included.

    Example:
        >>> is_shipped("normal-7"), is_shipped("apple")
        (True, False)
    """
    match = _CUBOID.fullmatch(name)
    return name in phantom_names() or (match is not None and match[1] in CUBOIDS_MM)


@public
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
    raise UnknownNameError.among(
        f"no phantom called {name!r}; there are", name, phantom_names(),
        ", and cuboids with K beads such as normal-3",
    )  # fmt: skip
