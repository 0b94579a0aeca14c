"""Warn at the line of the caller's program, however deep the function lies in flexdt."""

from __future__ import annotations

import sys
import warnings
from typing import Final

OWN_PACKAGES: Final = ("flexdt", "flexdt_extensions")
"""Our packages, whose lines are no caller's."""


def warn_caller(text: str, category: type[Warning] = UserWarning) -> None:
    """Warn about a call, at the innermost line of the stack that is not of `OWN_PACKAGES`.

    Without such a line it is the outermost one. Python's filters decide whether it is shown, as
    for any warning.

    Args:
        text: of the warning.
        category: of the warning.
    """
    level = 1
    frame = sys._getframe()
    while frame.f_back is not None:
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if package not in OWN_PACKAGES:
            break
        frame = frame.f_back
        level += 1
    warnings.warn(text, category, stacklevel=level)
