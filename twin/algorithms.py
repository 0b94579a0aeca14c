"""The algorithms that reconstruct, their options, and the windows of the ramp filter: the only
list of each.

`flexdt reconstruct`, its help and completion, the library and the table of
`docs/reconstruction.md` iterate it. The names are available without importing the
code that computes.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Literal, assert_never

__all__ = [
    "ALGORITHMS",
    "DEFAULT",
    "OPTIONS",
    "PLAIN",
    "WINDOWS",
    "Algorithm",
    "Option",
    "having",
    "misfit",
]

Kind = Literal["direct", "iterative"]


@dataclass(frozen=True)
class Algorithm:
    """An algorithm that makes a volume from line integrals.

    Attributes:
        name: as users write it.
        home: its module.
        function: its name there. An iterative one is called with line integrals (n, rows,
            cols), their geometry, a volume like the result, `watch` and those of its options
            that are given.
        kind: direct (goes through the views once, in parts and slab by slab), or iterative (all
            views and the whole volume in memory).
        options: those of `OPTIONS` that it has, of those that not every algorithm has.
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


@dataclass(frozen=True)
class Option:
    """An option of a reconstruction that does not go with everything else.

    Attributes:
        name: in Python, with `_`.
        meaning: what it states.
        general: every algorithm has it.
        needs: without one of these options it would have no effect; () for none.
    """

    name: str
    meaning: str
    general: bool = False
    needs: tuple[str, ...] = ()


_CORRECTIONS: Final = ("material", "scatter_correction")
OPTIONS: Final[dict[str, Option]] = {
    one.name: one
    for one in (
        Option("iterations", "how often an iterative algorithm repeats"),
        Option("weight", "the strength of the total variation"),
        Option("window", "the window of the ramp filter"),
        Option("materials", "several materials, each followed through the volume"),
        Option("errors", "whether images fit, and the bound of the bias", general=True),
        Option("scheduler", "workers that share the slabs"),
        Option("slurm", "workers that share the slabs"),
        Option("tube", "the spectrum of a correction", general=True, needs=_CORRECTIONS),
        Option("kv", "the voltage of a correction", general=True, needs=_CORRECTIONS),
    )
}
"""Name -> option. Python and the command line refuse by this table what does not fit."""


def misfit(
    algorithm: str, given: Container[str], spelled: Callable[[str], str] = str
) -> tuple[str, str] | None:
    """Say which option of a reconstruction would have no effect.

    Args:
        algorithm: one of `ALGORITHMS`.
        given: names of the options that the user states.
        spelled: how the user's door writes an option.

    Returns:
        The first such option of `OPTIONS`, and the sentence that refuses it; None if all
        have an effect.

    Example:
        >>> misfit("sirt", {"window", "iterations"})
        ('window', 'window: sirt has none (the window of the ramp filter); allowed with: fdk')
    """
    for name, one in OPTIONS.items():
        if name not in given:
            continue
        said = spelled(name)
        if not one.general and name not in ALGORITHMS[algorithm].options:
            allowed = ", ".join(having(name))
            return (
                name,
                f"{said}: {algorithm} has none ({one.meaning}); allowed with: {allowed}",
            )
        if one.needs and not any(other in given for other in one.needs):
            allowed = " or ".join(map(spelled, one.needs))
            return name, f"{said}: has no effect ({one.meaning}); allowed with: {allowed}"
    return None


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
            frozenset({"window", "scheduler", "slurm"}),
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
    return frequency**0


def _shepp_logan(frequency: Any) -> Any:
    import numpy as np

    return np.sinc(frequency / 2.0)


def _cosine(frequency: Any) -> Any:
    import numpy as np

    return np.cos(np.pi / 2.0 * frequency)


def _hamming(frequency: Any) -> Any:
    import numpy as np

    return 0.54 + 0.46 * np.cos(np.pi * frequency)


def _hann(frequency: Any) -> Any:
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
