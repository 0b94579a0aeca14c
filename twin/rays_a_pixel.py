"""How many rays a pixel has, as it is stated everywhere: along each side, or "auto"."""

from __future__ import annotations

from operator import index
from typing import Final, Literal

from flexdt.twin.errors import LimitError

Rays = int | Literal["auto"]
"""Rays along each side of a pixel that an edge reaches; "auto": as many as are needed."""
MAX_RAYS: Final = 16
"""Largest number of rays along each side of a pixel."""


def check_rays(rays: object) -> Rays:
    """Check a number of rays along each side of a pixel, and return it.

    Raises:
        LimitError: neither "auto" nor a whole number from 1 to `MAX_RAYS`.

    Example:
        >>> check_rays(3), check_rays("auto")
        (3, 'auto')
    """
    if isinstance(rays, str) and rays == "auto":
        return "auto"
    try:
        whole = 0 if isinstance(rays, bool) else index(rays)  # type: ignore[arg-type]
    except TypeError:
        whole = 0
    if not 1 <= whole <= MAX_RAYS:
        allowed = f'1 to {MAX_RAYS} along each side of a pixel, or "auto"'
        raise LimitError.instead(f"rays is {rays}", str(rays), allowed)
    return whole
