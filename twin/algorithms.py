"""The algorithms that reconstruct, and the windows of the ramp filter: the only list of either.

`flexdt reconstruct`, its help and completion, the library and the table of
`docs/reconstruction.md` iterate it. Names are there without an import of what computes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Literal, assert_never

__all__ = ["ALGORITHMS", "DEFAULT", "PLAIN", "WINDOWS", "Algorithm", "having"]

Kind = Literal["direct", "iterative"]


@dataclass(frozen=True)
class Algorithm:
    """An algorithm that makes a volume of line integrals.

    Attributes:
        name: as users write it.
        home: its module.
        function: its name there. An iterative one is called with line integrals (n, rows,
            cols), their geometry, a volume like the result, `watch` and those of its options
            that are given.
        kind: direct (goes through the views once, in parts and slab by slab), or iterative (all
            views and the whole volume in memory).
        options: those of iterations, weight, window, materials that it has.
        stacks, grids: arrays as large as all images, and as the volume, that it holds at a
            time.
    """

    name: str
    home: str
    function: str
    kind: Kind = "iterative"
    options: frozenset[str] = frozenset({"iterations"})
    stacks: int = 3
    grids: int = 5

    @property
    def direct(self) -> bool:
        """Whether it goes through the views once."""
        match self.kind:
            case "direct":
                return True
            case "iterative":
                return False
            case _:
                assert_never(self.kind)

    def load(self) -> Callable[..., Any]:
        """Import the algorithm's module and return its function."""
        function: Callable[..., Any] = getattr(import_module(self.home), self.function)
        return function


_ITERATIVE: Final = "flexdt.twin.reconstruction.iterative"
_SEVERAL: Final = frozenset({"iterations", "materials"})
DEFAULT: Final = "fdk"
"""The algorithm where none is named."""
ALGORITHMS: Final[dict[str, Algorithm]] = {
    one.name: one
    for one in (
        Algorithm(
            DEFAULT,
            "flexdt.twin.reconstruction.checked_fdk",
            "fdk",
            "direct",
            frozenset({"window"}),
        ),
        Algorithm("sirt", _ITERATIVE, "sirt", options=_SEVERAL),
        Algorithm("sart", _ITERATIVE, "sart", options=_SEVERAL),
        Algorithm("cgls", _ITERATIVE, "cgls"),
        Algorithm("em", _ITERATIVE, "em"),
        Algorithm(
            "tv",
            "flexdt.twin.reconstruction.total_variation",
            "tv",
            options=frozenset({"iterations", "weight"}),
            stacks=6,
            grids=13,
        ),
    )
}
"""Name -> algorithm, in the order in which users see them."""


def having(option: str) -> list[str]:
    """Names of the algorithms that have an option."""
    return [one.name for one in ALGORITHMS.values() if option in one.options]


def _ram_lak(frequency: Any) -> Any:
    """Compute the Ram-Lak window: 1 at each frequency."""
    return frequency**0


def _shepp_logan(frequency: Any) -> Any:
    """Compute the Shepp-Logan window, sinc(f / 2) with f = 1 at the Nyquist frequency."""
    import numpy as np

    return np.sinc(frequency / 2.0)


def _cosine(frequency: Any) -> Any:
    """Compute the cosine window, cos(pi f / 2) with f = 1 at the Nyquist frequency."""
    import numpy as np

    return np.cos(np.pi / 2.0 * frequency)


def _hamming(frequency: Any) -> Any:
    """Compute the Hamming window, 0.54 + 0.46 cos(pi f) with f = 1 at the Nyquist frequency."""
    import numpy as np

    return 0.54 + 0.46 * np.cos(np.pi * frequency)


def _hann(frequency: Any) -> Any:
    """Compute the Hann window, 0.5 + 0.5 cos(pi f) with f = 1 at the Nyquist frequency."""
    import numpy as np

    return 0.5 + 0.5 * np.cos(np.pi * frequency)


PLAIN: Final = "ram-lak"
"""The window where none is named: none."""
WINDOWS: Final[dict[str, Callable[[Any], Any]]] = {
    PLAIN: _ram_lak,
    "shepp-logan": _shepp_logan,
    "cosine": _cosine,
    "hamming": _hamming,
    "hann": _hann,
}
"""Name -> factor of frequencies (k,) given as parts of the highest."""
